"""A sine/cosine sensor: the tracking loop, and a filter that calibrates the sensor and watches itself."""

from __future__ import annotations

import numpy as np

import jaxfilt as jf
from tests.examples import GAP, Example


def _loop(p):
    loop = jf.alpha_beta(p["alpha"], p["beta"], dt=p["dt"], m0=p["m0"], r=p["r"])
    # without a floor: whether a sample counts is a step function of the amplitude
    return jf.phase_locked(loop, amplitude=p["amplitude"], normalize=False, floor=0.0)


def _watched(p):
    return jf.watched(jf.extended(jf.models.sine_cosine(**p)), limit=1.0, count=2)


_LOOP = {"alpha": 0.4, "beta": 0.1, "dt": 0.5, "m0": [0.3, 0.2], "r": 0.1, "amplitude": 1.5}
_OWN = {
    "dt": 0.5, "q": 0.02, "r": 0.3, "m0": [0.3, 0.2, 0.1, -0.1, 1.1, 0.05, 0.04, 0.02],
    "P0": np.diag([0.3, 0.2, 0.05, 0.05, 0.1, 0.02, 0.03, 0.01]), "drift": [0.001, 0.002, 0.003, 0.001, 0.002, 0.001],
}  # fmt: skip

EXAMPLES: dict[str, Example] = {
    "phase_locked": Example(jf.phase_locked, _loop, {k: np.array(x) for k, x in _LOOP.items()}, options=GAP),
    "watched": Example(jf.watched, _watched, {k: np.array(x) for k, x in _OWN.items()}, options=GAP, twin=True),
}
