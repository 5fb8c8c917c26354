"""The mixed Kalman/H-infinity filter in its forms."""

from __future__ import annotations

import numpy as np

import jaxfilt as jf
from tests.examples import GAP, LINEAR, Example


def _model(p):
    return jf.models.linear_gaussian(**p["model"])


def _mixed(p):
    return jf.mixed_hinf(_model(p), p["theta"], weight=p["weight"])


def _posterior(p):
    return jf.mixed_hinf(_model(p), p["theta"], stationary=True, output="posterior")


def _hinf(p):
    return jf.hinf(_model(p), p["theta"], output="pred")


def _sqrt(p):
    return jf.sqrt_mixed_hinf(_model(p), p["theta"], weight=p["weight"])


_PARAMS = {"model": LINEAR, "theta": np.array(0.3), "weight": np.diag([1.0, 0.5, 0.2])}
_PLAIN = {"model": LINEAR, "theta": np.array(0.2)}

EXAMPLES: dict[str, Example] = {
    "mixed_hinf": Example(jf.mixed_hinf, _mixed, _PARAMS, options=GAP),
    "stationary_hinf": Example(jf.mixed_hinf, _posterior, _PLAIN, options=GAP, twin=True),
    "hinf": Example(jf.hinf, _hinf, _PLAIN, options=GAP, twin=True),
    "sqrt_mixed_hinf": Example(jf.sqrt_mixed_hinf, _sqrt, _PARAMS, options=GAP, twin=True),
}
