"""Interacting multiple models of linear filters: a smaller state in a larger one, in either mixing."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from tests.examples import GAP, Example


def _filters(p):
    """A model of two components and one of one component, which is the second of the union."""
    return [jf.models.linear_gaussian(**p[name]) for name in ("large", "small")]


def _transition(stay):
    """Two modes, each kept with its own probability: rows that sum to 1 whatever the parameters are."""
    return jnp.stack([jnp.stack([stay[0], 1 - stay[0]]), jnp.stack([1 - stay[1], stay[1]])])


def _imm(p):
    large, small = _filters(p)
    return jf.imm((jf.kalman(large), jf.kalman(small)), _transition(p["stay"]), index=((0, 1), (1,)))


def _imm_zero(p):
    """The other options, around a wrapped filter, through a gap."""
    large, small = _filters(p)
    filters = (jf.kalman(small), jf.coast_inflated(jf.kalman(large), 2.0))
    return jf.imm(filters, _transition(p["stay"]), mu0=(0.7, 0.3), mixing="zero", missed="freeze")


_PARAMS = {
    "large": {
        "F": np.array([[0.8, 0.2], [-0.3, 0.9]]),
        "H": np.array([[0.4, 1.0], [1.0, 0.1]]),
        "Q": np.array([[0.4, 0.1], [0.1, 0.3]]),
        "R": np.array([[1.5, 0.2], [0.2, 1.0]]),
        "m0": np.array([0.3, 0.8]),
        "P0": np.array([[1.0, 0.2], [0.2, 1.5]]),
    },
    "small": {
        "F": np.array([[0.95]]),
        "H": np.array([[1.0], [0.6]]),
        "Q": np.array([[0.5]]),
        "R": np.array([[1.0, 0.3], [0.3, 2.0]]),
        "m0": np.array([0.5]),
        "P0": np.array([[2.0]]),
    },
    "stay": np.array([0.9, 0.8]),
}

EXAMPLES: dict[str, Example] = {
    "imm": Example(jf.imm, _imm, _PARAMS),
    "imm_zero": Example(jf.imm, _imm_zero, _PARAMS, options=GAP, twin=True),
}
