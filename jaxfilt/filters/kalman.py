"""The Kalman filter in covariance form, updated in Joseph form."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxfilt.core import Filter, Prediction, StepInput, bind
from jaxfilt.filters.common import check_measurement, decoupled, masked_rows
from jaxfilt.filters.update import joseph_update
from jaxfilt.linalg import chol, mirror, scale_cov, solve_chol, sym
from jaxfilt.models.linear import LinearGaussian, check_linear, value


class Correlated(NamedTuple):
    """What the next prediction needs when process and measurement noise are correlated (S of the model).

    With J = S R^-1 over the present components, ``w`` splits into ``J v`` and a part independent of ``v``
    (Anderson and Moore 1979, section 5.5): x' = (F - J H) x + J (y - D u) + w', Cov(w') = Q - J S'.
    """

    shift: Array  # (n,) J (y - D u)
    JH: Array  # (n, n)
    JS: Array  # (n, n)


class KalmanState(NamedTuple):
    """Posterior moments."""

    mean: Array  # (n,)
    cov: Array  # (n, n)
    correlated: Correlated | None = None


def kalman(model: LinearGaussian) -> Filter:
    """The Kalman filter of a linear-Gaussian model, in covariance form with the Joseph update.

    Predict: ``m- = F m + B u``, ``P- = F P F' + Q``. Update: ``nu = y - H m- - D u``, ``S = H P- H' + R``,
    ``K = P- H' S^-1``, ``m = m- + K nu``, ``P = (I - K H) P- (I - K H)' + K R K'``. Absent components are left out,
    which equals dropping their rows. For ill-conditioned problems use :func:`jaxfilt.sqrt_kalman`.

    Status: MISSED, NONFINITE, SINGULAR (a pivot of S below ``m eps`` of its diagonal: that component is not used).

    Args:
        model: from :func:`jaxfilt.models.linear_gaussian` or a motion builder.

    Source: Kalman 1960; Bucy and Joseph 1968; Bar-Shalom, Li and Kirubarajan 2001, section 5.2.
    """
    check_linear(model)
    return bind(model, _init, _predict, _update, _moments, _with_moments)


def init_mean(model: LinearGaussian, inp: StepInput) -> Array:
    """Checks the first input against the model, and gives the prior mean."""
    check_measurement(inp, value(model.H, inp.u, inp.dt).shape[0])
    if inp.dt is not None:
        for name in ("F", "Q"):
            if not callable(getattr(model, name)):
                raise ValueError(f"dt: given, but the model's {name} is a fixed matrix; make it a function (u, dt)")
    for name, given in (("B", model.B), ("D", model.D)):
        if given is not None and not callable(given) and inp.u is None:
            raise ValueError(f"u: the model has an input matrix {name}, but no input was given")
    return model.m0


def init_correlated(model: LinearGaussian) -> Correlated | None:
    """Zero memory: no measurement noise is known before the first sample."""
    if model.S is None:
        return None
    n = model.m0.shape[0]
    zeros = jnp.zeros((n, n), model.m0.dtype)
    return Correlated(zeros[0], zeros, zeros)


def effective_dynamics(
    model: LinearGaussian, inp: StepInput, correlated: Correlated | None
) -> tuple[Array, Array, Array | None]:
    """``(F, Q, shift)`` of a prediction, correlated noise taken into account; shift is the whole input term."""
    F = value(model.F, inp.u, inp.dt)
    Q = sym(scale_cov(value(model.Q, inp.u, inp.dt), inp.q_scale))
    shift = input_term(model.B, inp)
    if correlated is not None:
        F, Q = F - correlated.JH, sym(Q - correlated.JS)
    return F, Q, shift


def input_term(B: Any, inp: StepInput) -> Any:
    """B u, or what the function B gives."""
    if B is None:
        return None
    return B(inp.u, inp.dt) if callable(B) else B @ inp.u


def propagate(F: Array, mean: Array, shift: Array | None, correlated: Correlated | None) -> Array:
    """F m + B u, plus J times the last residual for correlated noise (F is then F - J H)."""
    out = F @ mean
    if correlated is not None:
        out = out + correlated.shift
    return out if shift is None else out + shift


def measurement(model: LinearGaussian, inp: StepInput, mean: Array) -> tuple[Array, Array, Array]:
    """``(H, R, predicted measurement)`` of an update."""
    H = value(model.H, inp.u, inp.dt)
    R = scale_cov(value(model.R, inp.u, inp.dt), inp.r_scale)
    shift = input_term(model.D, inp)
    return H, R, H @ mean if shift is None else H @ mean + shift


def correlate(
    model: LinearGaussian, inp: StepInput, H: Array, R: Array, innovation: Array, predicted_mean: Array
) -> Correlated | None:
    """The memory for the next prediction, in which F - J H acts on the posterior mean."""
    if model.S is None:
        return None
    S = value(model.S, inp.u, inp.dt)
    S = S if inp.mask is None else jnp.where(inp.mask[None, :], S, jnp.zeros((), S.dtype))
    J = solve_chol(chol(decoupled(inp.mask, R)), S.T).T
    H = masked_rows(inp.mask, H)
    return Correlated(J @ (innovation + H @ predicted_mean), J @ H, J @ S.T)


def _init(model, inp):
    return KalmanState(init_mean(model, inp), sym(model.P0), init_correlated(model))


def _predict(model, state, inp):
    F, Q, shift = effective_dynamics(model, inp, state.correlated)
    mean = propagate(F, state.mean, shift, state.correlated)
    cross = state.cov @ F.T
    cov = mirror(F @ cross) + Q
    return KalmanState(mean, cov, state.correlated), Prediction(mean, cov, cross)


def _update(model, state, inp):
    H, R, predicted = measurement(model, inp, state.mean)
    info, cov = joseph_update(inp, state.mean, state.cov, predicted, H, R)
    return KalmanState(info.mean, cov, correlate(model, inp, H, R, info.innovation, state.mean)), info


def _moments(model, state):
    return state.mean, state.cov


def _with_moments(model, state, mean, cov):
    return state._replace(mean=mean, cov=cov)
