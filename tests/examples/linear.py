"""The linear filters, and the wrappers for lost measurements."""

from __future__ import annotations

import numpy as np

import jaxfilt as jf
from tests.examples import GAP, LINEAR, Example


def _kalman(p):
    return jf.kalman(jf.models.linear_gaussian(**p))


def _sqrt_kalman(p):
    return jf.sqrt_kalman(jf.models.linear_gaussian(**p))


def _alpha_beta(p):
    return jf.alpha_beta(p["alpha"], p["beta"], dt=p["dt"], r=p["r"])


def _alpha_beta_gamma(p):
    return jf.alpha_beta_gamma(p["alpha"], p["beta"], p["gamma"], dt=p["dt"], r=p["r"], m0=p["m0"])


def _coast_inflated(p):
    return jf.coast_inflated(_kalman(p["model"]), p["factor"])


def _hold_last(p):
    return jf.hold_last(_kalman(p["model"]))


def _mean_of_recent(p):
    return jf.mean_of_recent(_kalman(p["model"]), 3)


def _polynomial_fit(p):
    return jf.polynomial_fit(_kalman(p["model"]), window=4, weighted=True, forgetting=p["forgetting"])


def _sinusoid_fit(p):
    return jf.sinusoid_fit(_kalman(p["model"]), omega=2, window=6)


def _covariance_intersection(p):
    return jf.covariance_intersection(_sqrt_kalman(p["model"]), window=4, forgetting=p["forgetting"])


def _blend(p):
    options = {"candidates": ((4, 1), (5, 2)), "horizon": 2, "origins": 3}
    return jf.blend(_kalman(p["model"]), exponent=p["exponent"], floor=p["floor"], **options)


def _nested(p):
    """Three wrappers around a filter."""
    inner = jf.coast_inflated(jf.polynomial_fit(_kalman(p["model"]), window=4), p["factor"])
    return jf.blend(inner, candidates=((4, 1),), horizon=2, origins=3)


_AB = {"alpha": np.array(0.5), "beta": np.array(0.21), "dt": np.array(1.0), "r": np.array([2.0, 1.0])}
_ABG = {**_AB, "gamma": np.array(0.06), "r": np.array([[2.0, 0.3], [0.3, 1.0]]), "m0": np.linspace(0.0, 1.0, 6)}


def _wrapped(factory, make, exempt=None, **parameters):
    params = {"model": LINEAR, **{name: np.array(x) for name, x in parameters.items()}}
    return Example(factory, make, params, options=GAP, exempt=exempt or {})


EXAMPLES: dict[str, Example] = {
    "kalman": Example(jf.kalman, _kalman, LINEAR),
    "sqrt_kalman": Example(jf.sqrt_kalman, _sqrt_kalman, LINEAR),
    "alpha_beta": Example(jf.alpha_beta, _alpha_beta, _AB),
    "alpha_beta_gamma": Example(jf.alpha_beta_gamma, _alpha_beta_gamma, _ABG, twin=True),
    "coast_inflated": _wrapped(jf.coast_inflated, _coast_inflated, factor=3.0),
    "hold_last": _wrapped(jf.hold_last, _hold_last)._replace(twin=True),
    "mean_of_recent": _wrapped(jf.mean_of_recent, _mean_of_recent)._replace(twin=True),
    "polynomial_fit": _wrapped(jf.polynomial_fit, _polynomial_fit, forgetting=0.9),
    "sinusoid_fit": _wrapped(
        jf.sinusoid_fit,
        _sinusoid_fit,
        {"differences": "the best rate of the grid is a step function of the data; differences reach across a step"},
    ),
    "covariance_intersection": _wrapped(jf.covariance_intersection, _covariance_intersection, forgetting=0.9),
    "blend": _wrapped(jf.blend, _blend, exponent=2.0, floor=0.25),
    "nested": _wrapped(jf.blend, _nested, factor=3.0)._replace(twin=True),
}
