"""Wrappers that adapt the noise covariances, and the filter that forgets."""

from __future__ import annotations

import numpy as np

import jaxfilt as jf
from tests.examples import GAP, LINEAR, Example


def _model(p):
    return jf.models.linear_gaussian(**p["model"])


def _fuzzy_scaled(p):
    """Max-min inference of the innovations, with corners of its own."""
    system = jf.fuzzy.mamdani(p["universe"], sets=3, corners=jf.fuzzy.partition(p["universe"], 3, p["logits"]))
    return jf.fuzzy_scaled(jf.kalman(_model(p)), system, reference=p["reference"])


def _fuzzy_difference(p):
    system = jf.fuzzy.mamdani(p["universe"], sets=3)
    options = {"input": "difference", "scale": "r", "r_exponent": 0.5, "reference": p["reference"]}
    return jf.fuzzy_scaled(jf.sqrt_kalman(_model(p)), system, **options)


def _fuzzy_noise(p):
    parameters = jf.FuzzyNoise(p["forgetting"], p["gaps"], p["widths"], p["r"], p["q"])
    return jf.fuzzy_noise(jf.kalman(_model(p)), parameters)


def _fuzzy_stationary(p):
    """A general rule table around the filter that solves for its covariance in each step."""
    parameters = jf.FuzzyNoise(p["forgetting"], p["gaps"], p["widths"], p["r"], p["q"])
    inner = jf.mixed_hinf(_model(p), p["theta"], stationary=True)
    return jf.fuzzy_noise(inner, parameters, rules=[[0, 1, 1], [1, 1, 2], [0, 2, 2]])


def _sage_husa(p):
    return jf.sage_husa(jf.kalman(_model(p)), forgetting=p["forgetting"], prior=p["prior"])


def _sage_husa_q(p):
    return jf.sage_husa(jf.sqrt_kalman(_model(p)), scale="q", forgetting=p["forgetting"], prior=p["prior"])


def _covariance_matching(p):
    return jf.covariance_matching(jf.kalman(_model(p)), window=5)


def _covariance_matching_q(p):
    return jf.covariance_matching(jf.kalman(_model(p)), scale="q", window=5)


def _fading_memory(p):
    return jf.fading_memory(jf.kalman(_model(p)), p["factor"])


def _example(factory, make, twin=False, exempt=None, **parameters):
    values = {name: np.array(x) for name, x in parameters.items()}
    return Example(factory, make, {"model": LINEAR, **values}, options=GAP, exempt=exempt or {}, twin=twin)


_KINKS = {
    "differences": "the centroid's derivative is a step function of the strengths, one step for each of the 1001 points"
}
_SMOOTH = {
    "forgetting": 0.6,
    "gaps": [[0.8, 1.1], [1.0, 0.9]],
    "widths": [[0.3, 0.5], [0.4, 0.3]],
    "r": [0.5, 0.1, -0.8],
    "q": [0.3, -0.2, -0.6],
}

EXAMPLES: dict[str, Example] = {
    "fuzzy_scaled": _example(
        jf.fuzzy_scaled, _fuzzy_scaled, exempt=_KINKS,
        universe=[3.0, 4.0], logits=[0.2, -0.1, 0.0, 0.3, 0.1], reference=30.0,
    ),
    "fuzzy_difference": _example(
        jf.fuzzy_scaled, _fuzzy_difference, True, _KINKS, universe=[3.0, 4.0], reference=30.0
    ),
    "fuzzy_noise": _example(jf.fuzzy_noise, _fuzzy_noise, **_SMOOTH),
    "fuzzy_stationary": _example(jf.fuzzy_noise, _fuzzy_stationary, True, **_SMOOTH, theta=0.2),
    "sage_husa": _example(jf.sage_husa, _sage_husa, forgetting=0.8, prior=2.0),
    "sage_husa_q": _example(jf.sage_husa, _sage_husa_q, True, forgetting=0.8, prior=2.0),
    "covariance_matching": _example(jf.covariance_matching, _covariance_matching, True),
    "covariance_matching_q": _example(jf.covariance_matching, _covariance_matching_q, True),
    "fading_memory": _example(jf.fading_memory, _fading_memory, True, factor=1.1),
}  # fmt: skip
