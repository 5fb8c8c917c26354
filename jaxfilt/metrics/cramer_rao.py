"""Cramer-Rao bounds: how small the error covariance of any unbiased estimator can be."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxfilt.core import PyTree, check_count, check_flag, inputs
from jaxfilt.linalg import chol, solve_chol, solve_lower, sym, tria
from jaxfilt.models.linear import LinearGaussian, check_covariance, check_finite, check_shape, common_dtype
from jaxfilt.models.nonlinear import Nonlinear, as_nonlinear, covariance, jacobian
from jaxfilt.noise_free import noise_free, weighted


class Bound(NamedTuple):
    """The bound after each step."""

    cov: Array  # (T, n, n); with `start_bound` (..., n, n) infinite on the diagonal while there is no information
    condition: Array  # (T,) condition number of the information matrix, scaled to a unit diagonal: free of units


def posterior_bound(
    model: Nonlinear | LinearGaussian,
    states: Any,
    *,
    P0: Any = None,
    u: PyTree = None,
    dt: Any = None,
    mask: Any = None,
    first_update_only: bool = False,
) -> Bound:
    """The posterior Cramer-Rao bound, with process noise, by recursion along drawn (or one known) trajectories.

    With F, H the Jacobians at the true states, Q and R there, and E the mean over draws::

        B- = Q + E[F] (B^-1 + E[(F - E F)' Q^-1 (F - E F)])^-1 E[F]'
        B^-1 = B-^-1 + E[H' R^-1 H]

    which is the recursion of Tichavsky, Muravchik and Nehorai (1998), computed on covariances: Q may be singular (in
    directions in which F does not vary), and with Q = 0 and one trajectory it is the bound of noise-free motion with a
    drawn start. On linear-Gaussian models it is the covariance of the Kalman filter. Q and R may depend on u, dt and
    the state; their dependence on the state adds information that is not counted, and Q's mean is taken.

    The mean square error of any estimator is at least this if the start really is drawn with covariance P0, the bound
    is averaged over the starts, and the estimator's error has no bias given the state. A filter that is started at the
    wrong velocity with a wide P0 of its own is not such an estimator before its data outweigh the start.

    Args:
        model: its f, h, Q, R are used, its own P0 only as the default below; y is not.
        states: (T + 1, n) or (draws, T + 1, n) true states, the start first (see ``first_update_only``).
        P0: (n, n) covariance of the start really drawn; default the model's.
        u: as in :func:`jaxfilt.filter`.
        dt: as in :func:`jaxfilt.filter`.
        mask: as in :func:`jaxfilt.filter`.
        first_update_only: takes ``states[0]`` as the state of the first sample: there are then T states for T samples.

    Returns:
        The bound after each of the T samples.

    Raises:
        ValueError: wrong shapes, a (concrete) P0 that is no covariance.
    """
    model = as_nonlinear(model)
    common_dtype({"states": states, "m0": model.m0, "P0": 0.0 if P0 is None else P0})
    check_finite("states", states)
    check_flag("first_update_only", first_update_only)
    states = jnp.asarray(states, model.m0.dtype)
    states = states[None] if states.ndim == 2 else states
    n = model.m0.shape[0]
    if states.ndim != 3 or states.shape[-1] != n or states.shape[1] < 2 - first_update_only:
        raise ValueError(f"states: expected shape (draws, T + 1, {n}) or (T + 1, {n}), got {states.shape}")
    P0 = model.P0 if P0 is None else jnp.asarray(P0, model.m0.dtype)
    check_shape("P0", P0, (n, n))
    check_covariance("P0", P0)
    after = states if first_update_only else states[:, 1:]
    before = jnp.concatenate([states[:, :1], states[:, :-1]], axis=1) if first_update_only else states[:, :-1]
    stacked = _inputs(model, after.shape[1], u, dt, mask)
    return _posterior(model, P0, jnp.swapaxes(before, 0, 1), jnp.swapaxes(after, 0, 1), stacked, first_update_only)


def start_bound(
    model: Nonlinear | LinearGaussian,
    x0: Any,
    steps: int,
    *,
    prior: Any = None,
    u: PyTree = None,
    dt: Any = None,
    mask: Any = None,
    first_update_only: bool = False,
) -> tuple[Bound, Bound]:
    """The bound for noise-free motion from an unknown start x0: of the start itself, and of the state at each step.

    The information about the start is ``J_k = prior^-1 + sum_{i <= k} (H_i Phi_i)' R^-1 H_i Phi_i`` with
    ``Phi = d x_i / d x0`` by automatic differentiation; the state's bound is ``Phi_k J_k^-1 Phi_k'``. Without a prior
    this is what a batch estimator (:func:`jaxfilt.initial.batch_ml`) can reach.

    Args:
        model: its f, h and R; Q is ignored.
        x0: (n,) the true start.
        steps: T.
        prior: (n, n) covariance of the start; None = nothing is known of it.
        u: as in :func:`jaxfilt.filter`.
        dt: as in :func:`jaxfilt.filter`.
        mask: as in :func:`jaxfilt.filter`.
        first_update_only: the first sample is of x0 itself.

    Returns:
        ``(of the start, of the state)`` given the samples up to each step. Where the information matrix is singular to
        working precision, the bound is infinite on the diagonal and so is the condition number.

    Raises:
        ValueError: wrong shapes, a (concrete) prior that is no covariance.
    """
    model = as_nonlinear(model)
    common_dtype({"x0": x0, "m0": model.m0, "prior": 0.0 if prior is None else prior})
    check_count("steps", steps, 1)
    check_flag("first_update_only", first_update_only)
    check_finite("x0", x0)
    x0 = jnp.asarray(x0, model.m0.dtype)
    if x0.shape != model.m0.shape:
        raise ValueError(f"x0: expected shape {model.m0.shape}, got {x0.shape}")
    if prior is not None:
        prior = jnp.asarray(prior, x0.dtype)
        check_shape("prior", prior, (*x0.shape, *x0.shape))
        check_covariance("prior", prior)
    return _start(model, x0, _inputs(model, steps, u, dt, mask), prior, first_update_only)


def condition(J: Array) -> Array:
    """The condition number of an information matrix (n, n) scaled to a unit diagonal; infinite where it is singular."""
    scaled, _ = _unit_diagonal(J)
    eigenvalues = jnp.linalg.eigvalsh(scaled)
    ok = eigenvalues[0] > J.shape[0] * jnp.finfo(J.dtype).eps * eigenvalues[-1]
    return jnp.where(ok, eigenvalues[-1] / jnp.where(ok, eigenvalues[0], 1.0), jnp.inf)


def inverse_information(J: Array) -> Array:
    """The covariance J^-1 (n, n), formed on a unit diagonal; infinite on the diagonal where J is singular."""
    scaled, d = _unit_diagonal(J)
    L = chol(scaled)
    eye = jnp.eye(J.shape[0], dtype=J.dtype)
    # A factor whose pivots are all kept may still be that of a singular matrix, rounded.
    ok = (jnp.diagonal(L) ** 2 > 10 * J.shape[0] * jnp.finfo(J.dtype).eps).all()
    P = solve_chol(jnp.where(ok, L, eye), eye) * d[:, None] * d[None, :]
    return jnp.where(ok, sym(P), jnp.where(eye > 0, jnp.inf, 0.0))


def _unit_diagonal(J):
    diagonal = jnp.diagonal(J)
    d = jnp.where(diagonal > 0, 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0)), 0.0)
    return J * d[:, None] * d[None, :], d


def _inputs(model, T, u, dt, mask):
    inputs(jnp.zeros((T, 1), model.m0.dtype), u=u, dt=dt)  # refuses these by name before the model sees them
    m = jax.eval_shape(model.h, model.m0, *_first(u, dt, model.m0.dtype)).shape[0]
    return inputs(jnp.zeros((T, m), model.m0.dtype), u=u, dt=dt, mask=mask)


def _first(u, dt, dtype):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], u), None if dt is None else jnp.zeros((), dtype)


@partial(jax.jit, static_argnames="first_update_only")
def _posterior(model, P0, before, after, stacked, first_update_only):
    draws = before.shape[1]

    def body(B, step):
        x0, x1, inp, is_first = step
        Fs = jax.vmap(lambda x: jacobian(model.f, model.f_jacobian, x, inp.u, inp.dt))(x0)
        Qs = jax.vmap(lambda x: covariance(model.Q, x, inp.u, inp.dt))(x0)
        F, Q = jnp.mean(Fs, axis=0), jnp.mean(Qs, axis=0)
        prior = B
        if draws > 1:  # what F's variation tells; nothing where all are alike
            L_Q = chol(Q)
            prior = _with_information(B, _mean_factor(jax.vmap(lambda dF: solve_lower(L_Q, dF))(Fs - F[None])))
        predicted = sym(F @ prior @ F.T + Q)
        if is_first is not None:
            predicted = jnp.where(is_first, B, predicted)
        L, H = jax.vmap(lambda x: weighted(model, x, inp, inp.mask))(x1)
        B = _with_information(predicted, _mean_factor(jax.vmap(solve_lower)(L, H)))
        scaled, _ = _unit_diagonal(B)
        J = solve_chol(chol(scaled), jnp.eye(B.shape[0], dtype=B.dtype))
        return B, Bound(B, condition(sym(J)))

    is_first = jnp.arange(stacked.y.shape[0]) == 0 if first_update_only else None
    with jax.default_matmul_precision("highest"):
        return jax.lax.scan(body, P0, (before, after, stacked, is_first))[1]


@partial(jax.jit, static_argnames="first_update_only")
def _start(model, x0, stacked, prior, first_update_only):
    path = noise_free(model, x0, stacked, first_update_only=first_update_only)
    n = x0.shape[0]
    with jax.default_matmul_precision("highest"):
        J = jnp.cumsum(jnp.einsum("tmi,tmj->tij", path.sensitivity, path.sensitivity), axis=0)
        if prior is not None:
            J = J + solve_chol(chol(prior), jnp.eye(n, dtype=x0.dtype))[None]
        conditions = jax.vmap(condition)(J)
        start = jax.vmap(inverse_information)(J)
        known = jnp.isfinite(start).all(axis=(1, 2))[:, None, None]
        state = jnp.einsum("tia,tab,tjb->tij", path.transition, jnp.where(known, start, 0.0), path.transition)
        unknown = jnp.where(jnp.eye(n, dtype=bool), jnp.inf, 0.0).astype(x0.dtype)[None]
        return Bound(start, conditions), Bound(jnp.where(known, state, unknown), conditions)


def _mean_factor(rows):
    """C (n, k) with ``C C' = E[W' W]`` over the draws of W (m, n), without forming the product."""
    draws, m, n = rows.shape
    stacked = rows.reshape(draws * m, n).T
    return stacked if draws == 1 else tria(stacked) / draws**0.5


def _with_information(B, C):
    """``(B^-1 + C C')^-1`` in Joseph's form."""
    S = sym(C.T @ B @ C) + jnp.eye(C.shape[1], dtype=B.dtype)
    K = solve_chol(chol(S), C.T @ B).T
    A = jnp.eye(B.shape[0], dtype=B.dtype) - K @ C.T
    return sym(A @ B @ A.T + K @ K.T)
