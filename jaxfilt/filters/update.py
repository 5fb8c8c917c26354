"""Measurement updates of Gaussian filters, each written once for all filters that end in it."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import Info, Status, StepInput, flag
from jaxfilt.filters.common import decoupled, innovate, likelihood, masked_rows
from jaxfilt.linalg import chol, instead, is_zero, mirror, solve_chol, solve_lower, sym, tria

Residual = Callable[[Array, Array], Array]


def joseph_update(
    inp: StepInput, mean: Array, P: Array, predicted: Array, H: Array, R: Array, residual: Residual | None = None
) -> tuple[Info, Array]:
    """The update with a measurement matrix, in Joseph form (valid for any gain).

    Args:
        inp: the step's input.
        mean: (n,) predicted mean.
        P: (n, n) predicted covariance.
        predicted: (m,) predicted measurement.
        H: (m, n) measurement matrix or Jacobian.
        R: (m, m) measurement noise covariance, whatever the linearization adds to it included.
        residual: ``(y, predicted) -> (m,)``; None = the difference.

    Returns:
        The Info, and the posterior covariance (n, n).
    """
    nu, mask, status = innovate(inp, predicted, residual)
    R = sym(R)
    S = mirror(H @ P @ H.T) + R
    change, cov, nis, log_lik, singular = joseph_form(mask, nu, P, H, R, S)
    return Info(mean + change, cov, nu, S, nis, log_lik, status | singular, noise_cov=R), cov


@jax.jit
def joseph_form(mask, nu, P, H, R, S):
    """``(K nu, posterior covariance, nis, log_lik, status)``; R and S symmetric."""
    Hm = masked_rows(mask, H)
    L = chol(decoupled(mask, S))
    nis, log_lik, singular = likelihood(mask, L, solve_lower(L, nu))
    K = solve_chol(L, Hm @ P).T
    A = jnp.eye(P.shape[0], dtype=P.dtype) - K @ Hm
    return K @ nu, mirror(A @ P @ A.T + K @ R @ K.T), nis, log_lik, singular


def _sequential_form(mask, nu, P, H, R, S):
    """The same for a diagonal R, one component after the other, which needs no factorisation.

    The innovation variances are the squared pivots of the factor of S, so that the same components count as singular.
    """
    m, n = H.shape
    H = masked_rows(mask, H)
    zero, one = jnp.zeros((), P.dtype), jnp.ones((), P.dtype)
    counted = jnp.ones((m,), bool) if mask is None else mask
    change = jnp.zeros((n,), P.dtype)
    nis, variances, status = zero, [], jnp.int32(0)
    for i in range(m):
        h, r = H[i], R[i, i]
        g = P @ h
        s = h @ g + r
        ok = s > m * jnp.finfo(P.dtype).eps * jnp.abs(S[i, i])
        inverse = jnp.where(ok, 1.0 / jnp.where(ok, s, one), zero)
        k = g * inverse
        nu_i = nu[i] - h @ change
        change = change + k * nu_i
        nis = nis + nu_i * nu_i * inverse
        variances.append(jnp.where(ok & counted[i], s, one))
        status = status | flag(counted[i] & ~ok, Status.SINGULAR)
        A = P - k[:, None] * g[None, :]  # (I - k h) P
        P = mirror(A + (r * k - A @ h)[:, None] * k[None, :])  # A (I - k h)' + k r k'
    if m <= 3 and P.dtype == jnp.float64:  # one logarithm; beyond, the product could leave the range
        log_det = jnp.log(functools.reduce(jnp.multiply, variances))
    else:
        log_det = sum((jnp.log(s) for s in variances), zero)
    count = counted.sum().astype(P.dtype)
    log_lik = -0.5 * (nis + count * float(np.log(2 * np.pi)) + log_det)
    return change, P, nis, log_lik, status


def _noise_is_diagonal(*entries):
    R = entries[-2]
    return all(is_zero(R[i, j]) for i, j in np.ndindex(R.shape) if i != j)


instead(joseph_form, _sequential_form, (1, 1, 2, 2, 2, 2), _noise_is_diagonal)


def factor_update(
    inp: StepInput, mean: Array, L: Array, predicted: Array, D: Array, R: Array, residual: Residual | None = None
) -> tuple[Info, Array]:
    """The update of sigma-point filters: Joseph's form with ``D = H L`` in place of H, where ``P = L L'``.

    ``S = D D' + R``, ``K = L D' S^-1``, ``P+ = (L - K D)(L - K D)' + K R K'``: no H is formed and P+ is PSD.
    Arguments as in :func:`joseph_update`.
    """
    nu, mask, status = innovate(inp, predicted, residual)
    R = sym(R)
    S = mirror(D @ D.T) + R
    Dm = masked_rows(mask, D)
    L_S = chol(decoupled(mask, S))
    nis, log_lik, singular = likelihood(mask, L_S, solve_lower(L_S, nu))
    K = solve_chol(L_S, Dm @ L.T).T
    rest = L - K @ Dm
    cov = mirror(rest @ rest.T + K @ R @ K.T)
    return Info(mean + K @ nu, cov, nu, S, nis, log_lik, status | singular, noise_cov=R), cov


def array_update(
    inp: StepInput,
    mean: Array,
    L: Array,
    predicted: Array,
    D: Array,
    R: Array,
    chol_R: Array | None = None,
    residual: Residual | None = None,
) -> tuple[Info, Array]:
    """The update in array form: ``tria [[D, L_R], [L, 0]] = [[L_S, 0], [K L_S, L+]]``, with ``D = H L``.

    The prior's block comes first (large rows first: Powell and Reid 1969). Arguments as in :func:`factor_update`, and
    ``chol_R``, the lower factor of R, if it is known. Returns the Info, and the posterior factor (n, n).
    """
    nu, mask, status = innovate(inp, predicted, residual)
    m, n = D.shape
    L_R = chol(decoupled(mask, R)) if chol_R is None or mask is not None else chol_R
    top = jnp.concatenate([masked_rows(mask, D), L_R], axis=1)
    bottom = jnp.concatenate([L, jnp.zeros((n, m), L.dtype)], axis=1)
    array = tria(jnp.concatenate([top, bottom]), m)
    L_S, KL, L_new = array[:m, :m], array[m:, :m], array[m:, m:]
    whitened = solve_lower(L_S, nu)
    nis, log_lik, singular = likelihood(mask, L_S, whitened)
    S = mirror(D @ D.T) + sym(R)
    info = Info(mean + KL @ whitened, mirror(L_new @ L_new.T), nu, S, nis, log_lik, status | singular, noise_cov=R)
    return info, L_new
