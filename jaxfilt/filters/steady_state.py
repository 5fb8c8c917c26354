"""The steady-state Kalman filter: the gain to which the Kalman filter of a constant model converges."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import Filter, Info, Prediction, Status, bind, flag, is_concrete
from jaxfilt.filters.common import innovate, likelihood
from jaxfilt.filters.kalman import (
    Correlated,
    correlate,
    effective_dynamics,
    init_correlated,
    init_mean,
    measurement,
    propagate,
)
from jaxfilt.filters.transfer import Transfer, join
from jaxfilt.filters.update import joseph_update
from jaxfilt.linalg import chol, solve_chol, solve_lower, sym
from jaxfilt.models.linear import LinearGaussian, check_linear

# Each stands for as many steps as all before it. 2^40 steps tell every decay from none.
_DOUBLINGS = 40


class Steady(NamedTuple):
    """What :func:`steady_state` computes with, and never changes."""

    predicted: Array  # (n, n) covariance before the update
    cov: Array  # (n, n) after it
    gain: Array  # (n, m)
    S: Array  # (m, m) innovation covariance
    chol_S: Array  # (m, m)
    cross: Array  # (n, n) of consecutive states
    exists: Array  # () bool


class SteadyState(NamedTuple):
    """The mean; the covariance is one of the constant ones."""

    mean: Array  # (n,)
    cov: Array  # (n, n)
    correlated: Correlated | None = None


class _Params(NamedTuple):
    model: LinearGaussian
    steady: Steady


def steady_state(model: LinearGaussian) -> Filter:
    """The Kalman filter with its steady gain from the first sample on; P0 does not matter.

    The gain comes from the discrete algebraic Riccati equation, solved by doubling when the filter is made, and is
    differentiable with respect to F, H, Q, R (and S). Each step then costs a few products with vectors: under a
    ``vmap`` over runs no covariance is predicted, and without a mask none is computed at all. A constant model forgets
    its start, so that after the transient this is :func:`jaxfilt.kalman` to rounding.

    Missing samples: the mean coasts and the reported covariance is the steady predicted one, however long the gap (that
    of :func:`jaxfilt.kalman` would grow); a sample of which some components are present is used with the gain, the
    likelihood and the posterior covariance that the steady predicted covariance gives them. ``with_moments`` replaces
    the mean for good, the covariance until the next prediction.

    Status: MISSED, NONFINITE, SINGULAR (as :func:`jaxfilt.kalman`); BOUND in every step if there is no steady state
    (traced models only; others are refused): the gain is then that of the first step from P0.

    Args:
        model: from :func:`jaxfilt.models.linear_gaussian` or a motion builder. F, H, Q, R (S) are matrices, or
            functions that need neither ``u`` nor ``dt``. Q and R may be singular, but not so that H Q H' + R is.

    Raises:
        ValueError: a matrix that depends on ``u`` or ``dt``; a model without a steady state (something that does not
            decay is not seen by H, or not driven by Q), or with a singular H Q H' + R. In :func:`jaxfilt.filter`:
            ``dt``, ``q_scale``, ``r_scale``.

    Source: Anderson and Moore 1979, chapter 4; doubling: Chu, Fan, Lin and Wang 2004.
    """
    check_linear(model)
    matrices = {name: _constant(name, getattr(model, name)) for name in ("F", "H", "Q", "R", "S")}
    model = model._replace(**matrices)
    steady = _steady(model.F, model.H, model.Q, model.R, model.P0, model.S)
    if is_concrete(steady.exists) and not np.asarray(steady.exists).all():
        raise ValueError(
            "model: has no steady state; what does not decay by itself must be seen by H and driven by Q, "
            "and H Q H' + R must be regular"
        )
    return bind(_Params(model, steady), _init, _predict, _update, _moments, _with_moments)


def _constant(name: str, matrix: Any) -> Any:
    if not callable(matrix):
        return matrix
    try:
        return matrix(None, None)
    except Exception as error:
        raise ValueError(f"model: {name} must not depend on u or dt in a steady-state filter") from error


@jax.jit
def _steady(F, H, Q, R, P0, S):
    with jax.default_matmul_precision("highest"):
        Q, R, P0 = sym(Q), sym(R), sym(P0)
        if S is not None:  # what is left of the process noise once the measurement is known
            J = solve_chol(chol(R), S.T).T
            F, Q = F - J @ H, sym(Q - J @ S.T)
        cov, found = riccati_posterior(F, H, Q, R)
        exists = found > 0
        predicted = _predicted(F, Q, jnp.where(exists, cov, P0))
        innovation_cov = sym(H @ predicted @ H.T) + R
        L = chol(innovation_cov)
        K = solve_chol(L, H @ predicted).T
        cov = _joseph(predicted, H, R, K)
        return Steady(predicted, cov, K, innovation_cov, L, cov @ F.T, exists)


@jax.custom_jvp
def riccati_posterior(F: Array, H: Array, Q: Array, R: Array) -> tuple[Array, Array]:
    """The steady posterior covariance: P with ``P- = F P F' + Q``, ``P = (P-^-1 + H' R^-1 H)^-1``.

    Differentiable any number of times, by the implicit function theorem.

    Returns:
        P (n, n), and 1.0 () if it exists; else 0 and 0.0.
    """
    K = _gain(Q, H, R)
    L = chol(sym(H @ Q @ H.T) + R)
    HF = solve_lower(L, H @ F)
    zero = jnp.zeros_like(Q[0])
    one_step = Transfer(F - K @ (H @ F), zero, _joseph(Q, H, R, K), zero, sym(HF.T @ HF))
    P = jax.lax.fori_loop(0, _DOUBLINGS, lambda _, x: join(x, x), one_step).C
    # One step of Newton's method removes the rounding that the doublings have gathered.
    K = _gain(_predicted(F, Q, P), H, R)
    P = _sum_of_powers(F - K @ (H @ F), _joseph(Q, H, R, K))
    predicted = _predicted(F, Q, P)
    K = _gain(predicted, H, R)
    residual = jnp.max(jnp.abs(_joseph(predicted, H, R, K) - P))
    solved = residual <= float(jnp.finfo(P.dtype).eps) ** 0.5 * jnp.max(jnp.abs(P))  # false for NaN too
    exists = solved & _decays(F - K @ (H @ F))
    return jnp.where(exists, P, jnp.zeros_like(P)), exists.astype(P.dtype)


@riccati_posterior.defjvp
def _riccati_jvp(primals, tangents):
    # The gain minimizes the covariance, so its own change does not matter to first order.
    F, H, Q, R = primals
    dF, dH, dQ, dR = tangents
    P, exists = riccati_posterior(F, H, Q, R)
    predicted = _predicted(F, Q, P)
    K = _gain(predicted, H, R)
    B = jnp.eye(F.shape[0], dtype=F.dtype) - K @ H
    moved = dF @ P @ F.T
    turned = K @ dH @ predicted @ B.T
    change = B @ (moved + moved.T + dQ) @ B.T - turned - turned.T + K @ dR @ K.T
    # Without a steady state A would grow beyond all numbers.
    return (P, exists), (_sum_of_powers(exists * (B @ F), exists * sym(change)), jnp.zeros_like(exists))


def _sum_of_powers(A, M):
    """X = A X A' + M, the sum of A^k M A'^k."""

    def double(_, x):
        A, X = x
        return A @ A, X + sym(A @ X @ A.T)

    return jax.lax.fori_loop(0, _DOUBLINGS, double, (A, M))[1]


def _decays(A):
    """Whether A^k goes to 0: every eigenvalue inside the unit circle. False for NaN."""
    power = jax.lax.fori_loop(0, _DOUBLINGS, lambda _, x: x @ x, A)
    return jnp.max(jnp.abs(power)) < 1e-3


def _predicted(F, Q, P):
    return sym(F @ P @ F.T) + Q


def _gain(predicted, H, R):
    return solve_chol(chol(sym(H @ predicted @ H.T) + R), H @ predicted).T


def _joseph(P, H, R, K):
    B = jnp.eye(P.shape[0], dtype=P.dtype) - K @ H
    return sym(B @ P @ B.T + K @ R @ K.T)


def _init(p, inp):
    for name, given in (("dt", inp.dt), ("q_scale", inp.q_scale), ("r_scale", inp.r_scale)):
        if given is not None:
            raise ValueError(f"{name}: given, but the steady-state filter has one fixed interval and constant noise")
    return SteadyState(init_mean(p.model, inp), p.steady.predicted, init_correlated(p.model))


def _predict(p, state, inp):
    F, _, shift = effective_dynamics(p.model, inp, state.correlated)
    mean = propagate(F, state.mean, shift, state.correlated)
    predicted = p.steady.predicted
    return SteadyState(mean, predicted, state.correlated), Prediction(mean, predicted, p.steady.cross)


def _update(p, state, inp):
    steady = p.steady
    H, R, predicted = measurement(p.model, inp, state.mean)
    if inp.mask is None:
        nu, _, status = innovate(inp, predicted)
        nis, log_lik, singular = likelihood(None, steady.chol_S, solve_lower(steady.chol_S, nu))
        mean = state.mean + steady.gain @ nu
        info = Info(mean, steady.cov, nu, steady.S, nis, log_lik, status | singular, noise_cov=sym(R))
    else:
        info, _ = joseph_update(inp, state.mean, steady.predicted, predicted, H, R)
    info = info._replace(status=info.status | flag(~steady.exists, Status.BOUND))
    memory = correlate(p.model, inp, H, R, info.innovation, state.mean)
    return SteadyState(info.mean, info.cov, memory), info  # pyright: ignore[reportArgumentType]


def _moments(p, state):
    return state.mean, state.cov


def _with_moments(p, state, mean, cov):
    return state._replace(mean=mean, cov=cov)
