"""Measurement updates of Gaussian filters, each written once for all filters that end in it."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array

from jaxfilt.core import Info, StepInput
from jaxfilt.filters.common import decoupled, innovate, likelihood, masked_rows
from jaxfilt.linalg import chol, solve_chol, solve_lower, sym, tria

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
    S = sym(H @ P @ H.T + R)
    Hm = masked_rows(mask, H)
    L = chol(decoupled(mask, S))
    nis, log_lik, singular = likelihood(mask, L, solve_lower(L, nu))
    K = solve_chol(L, Hm @ P).T
    A = jnp.eye(P.shape[0], dtype=P.dtype) - K @ Hm
    cov = sym(A @ P @ A.T + K @ R @ K.T)
    return Info(mean + K @ nu, cov, nu, S, nis, log_lik, status | singular, noise_cov=R), cov


def factor_update(
    inp: StepInput, mean: Array, L: Array, predicted: Array, D: Array, R: Array, residual: Residual | None = None
) -> tuple[Info, Array]:
    """The update of sigma-point filters: Joseph's form with ``D = H L`` in place of H, where ``P = L L'``.

    ``S = D D' + R``, ``K = L D' S^-1``, ``P+ = (L - K D)(L - K D)' + K R K'``: no H is formed and P+ is PSD.
    Arguments as in :func:`joseph_update`.
    """
    nu, mask, status = innovate(inp, predicted, residual)
    S = sym(D @ D.T + R)
    Dm = masked_rows(mask, D)
    L_S = chol(decoupled(mask, S))
    nis, log_lik, singular = likelihood(mask, L_S, solve_lower(L_S, nu))
    K = solve_chol(L_S, Dm @ L.T).T
    rest = L - K @ Dm
    cov = sym(rest @ rest.T + K @ R @ K.T)
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
    array = tria(jnp.concatenate([top, bottom]))
    L_S, KL, L_new = array[:m, :m], array[m:, :m], array[m:, m:]
    whitened = solve_lower(L_S, nu)
    nis, log_lik, singular = likelihood(mask, L_S, whitened)
    S = sym(D @ D.T + R)
    info = Info(mean + KL @ whitened, sym(L_new @ L_new.T), nu, S, nis, log_lik, status | singular, noise_cov=R)
    return info, L_new
