"""The interval observer."""

from __future__ import annotations

import numpy as np

import jaxfilt as jf
from tests.examples import GAP, Example


def _interval_observer(p):
    return jf.interval_observer(**p, nonnegative=True)


def _certain(p):
    """One model, states of either sign."""
    return jf.interval_observer(p["A"], p["A"], p["C"], p["L"], **p["bounds"])


_A = np.array([[0.5, 0.1, 0.2], [0.2, 0.4, 0.1], [0.1, 0.3, 0.3]])
_C = np.array([[0.6, 0.3, 0.2], [0.1, 0.5, 0.4]])
_L = np.array([[0.1, 0.05], [0.06, 0.08], [0.07, 0.11]])
_BOUNDS = {
    "w_low": np.array([0.3, 0.2, 0.4]),
    "w_high": np.array([0.5, 0.6, 0.7]),
    "v_bound": np.array([0.2, 0.3]),
    "x_low": np.array([0.5, 0.4, 0.3]),
    "x_high": np.array([1.0, 1.2, 0.8]),
}

EXAMPLES: dict[str, Example] = {
    "interval_observer": Example(
        jf.interval_observer, _interval_observer,
        {"A_low": _A - 0.02, "A_high": _A + 0.03, "C": _C, "L": _L, **_BOUNDS}, options=GAP,
    ),
    "interval_certain": Example(
        jf.interval_observer, _certain, {"A": _A, "C": _C, "L": _L, "bounds": _BOUNDS}, options=GAP, twin=True
    ),
}  # fmt: skip
