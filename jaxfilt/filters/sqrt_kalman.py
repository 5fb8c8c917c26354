"""The Kalman filter in square-root (array) form."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxfilt.core import Filter, Prediction, bind
from jaxfilt.filters.kalman import (
    Correlated,
    correlate,
    effective_dynamics,
    init_correlated,
    init_mean,
    measurement,
    propagate,
)
from jaxfilt.filters.update import array_update
from jaxfilt.linalg import chol, scale_factor, sym, tria
from jaxfilt.models.linear import LinearGaussian, check_linear


class SqrtKalmanState(NamedTuple):
    """Posterior mean and lower Cholesky factor of its covariance."""

    mean: Array  # (n,)
    chol: Array  # (n, n)
    correlated: Correlated | None = None


class _Params(NamedTuple):
    model: LinearGaussian
    chol_P0: Array
    chol_Q: Array | None  # None where the model computes Q anew
    chol_R: Array | None


def sqrt_kalman(model: LinearGaussian) -> Filter:
    """The Kalman filter in array form: factors instead of covariances, PSD by construction, twice the digits.

    Predict: ``tria [F L, L_Q]``. Update: ``tria [[H L, L_R], [L, 0]] = [[L_S, 0], [K L_S, L+]]``, the prior's block
    first (large rows first: Powell and Reid 1969). Otherwise as :func:`jaxfilt.kalman`; ``q_scale`` and ``r_scale``
    scale the factors. ``info.cov`` is computed from the factor.

    Status: MISSED, NONFINITE, SINGULAR (a row of [H L, L_R] that depends on the rows above it to working precision;
    that component is not used).

    Args:
        model: from :func:`jaxfilt.models.linear_gaussian` or a motion builder.

    Source: Kaminski, Bryson and Schmidt 1971; Grewal and Andrews 2001, chapter 6.
    """
    check_linear(model)
    params = _Params(
        model,
        chol(model.P0),
        None if callable(model.Q) or model.S is not None else chol(model.Q),
        None if callable(model.R) else chol(model.R),
    )
    return bind(params, _init, _predict, _update, _moments, _with_moments)


def _init(p, inp):
    return SqrtKalmanState(init_mean(p.model, inp), p.chol_P0, init_correlated(p.model))


def _predict(p, state, inp):
    F, Q, shift = effective_dynamics(p.model, inp, state.correlated)
    L_Q = chol(Q) if p.chol_Q is None else scale_factor(p.chol_Q, inp.q_scale)
    mean = propagate(F, state.mean, shift, state.correlated)
    FL = F @ state.chol
    L = tria(jnp.concatenate([FL, L_Q], axis=1))
    return SqrtKalmanState(mean, L, state.correlated), Prediction(mean, sym(L @ L.T), state.chol @ FL.T)


def _update(p, state, inp):
    H, R, predicted = measurement(p.model, inp, state.mean)
    L_R = None if p.chol_R is None else scale_factor(p.chol_R, inp.r_scale)
    info, L = array_update(inp, state.mean, state.chol, predicted, H @ state.chol, R, L_R)
    return SqrtKalmanState(info.mean, L, correlate(p.model, inp, H, R, info.innovation, state.mean)), info


def _moments(p, state):
    return state.mean, sym(state.chol @ state.chol.T)


def _with_moments(p, state, mean, cov):
    return state._replace(mean=mean, chol=chol(cov))
