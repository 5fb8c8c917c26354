"""How good a predictor with a constant gain is: on average, and in the worst case."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import check_count
from jaxfilt.linalg import chol, sym
from jaxfilt.models.linear import check_covariance, check_finite, check_shape, common_dtype

_DOUBLINGS = 30


class PredictorGains(NamedTuple):
    """What noise of unit size makes of the errors of a predictor."""

    mean_square: Array  # () tr of the stationary error covariance; infinite if unstable
    worst_case: Array  # () the largest ratio of error energy to noise energy; infinite if unstable
    stable: Array  # () bool


def predictor_gains(
    F: Any, H: Any, Q: Any, R: Any, K: Any, *, weight: Any = None, frequencies: int = 1500
) -> PredictorGains:
    """Mean-square and worst-case error of ``x^_{k+1} = F x^_k + K (y_k - H x^_k)``.

    ``J2 = tr(S Sigma)`` with ``Sigma = A Sigma A' + Q + K R K'``, ``A = F - K H``, for white noise of covariances Q and
    R; ``J_inf`` the squared largest singular value over all frequencies of the map from noise in units of its weight
    (``w' Q^-1 w``, ``v' R^-1 v``) to errors (``e' S e``). Differentiable in all arguments; batch with ``jax.vmap``.

    Args:
        F: (n, n) transition.
        H: (m, n) measurement.
        Q: (n, n) process noise covariance, or design weight.
        R: (m, m) measurement noise covariance, or design weight.
        K: (n, m) gain of the predictor.
        weight: (n, n) S; None = the identity.
        frequencies: size of the grid: 0, and logarithmically spaced from 1e-5 to pi per sample.

    Source: Simon 2006, sections 11.3 and 12.1.
    """
    given = {"F": F, "H": H, "Q": Q, "R": R, "K": K}
    dtype = common_dtype({**given, "weight": 0.0 if weight is None else weight})
    check_count("frequencies", frequencies, 1)
    n, m = (*jnp.shape(K), 0, 0)[:2]
    if jnp.ndim(K) != 2 or 0 in (n, m):
        raise ValueError(f"K: expected shape (n, m), got {jnp.shape(K)}")
    shapes = {"F": (n, n), "H": (m, n), "Q": (n, n), "R": (m, m), "K": (n, m)}
    for name, shape in shapes.items():
        check_shape(name, given[name], shape, f" with K of shape ({n}, {m})")
        (check_covariance if name in "QR" else check_finite)(name, given[name])
    if weight is not None:
        check_shape("weight", weight, (n, n))
        check_covariance("weight", weight)
    F, H, Q, R, K = (jnp.asarray(x, dtype) for x in (F, H, Q, R, K))
    A = F - K @ H
    S = jnp.eye(n, dtype=F.dtype) if weight is None else jnp.asarray(weight, F.dtype)
    noise = sym(Q + K @ R @ K.T)

    def double(_, x):
        A, Sigma = x
        return A @ A, sym(Sigma + A @ Sigma @ A.T)

    power, Sigma = jax.lax.fori_loop(0, _DOUBLINGS, double, (A, noise))
    stable = jnp.isfinite(Sigma).all() & (jnp.abs(power).max() < 1e-3)
    infinite = jnp.asarray(np.inf, F.dtype)
    # An unstable gain has no answer; NaN from the branch not taken would spoil its derivative.
    safe = jnp.where(stable, A, jnp.zeros_like(A))
    root, weigh = chol(noise), chol(S).T
    grid = np.concatenate([[0.0], np.geomspace(1e-5, np.pi, frequencies)])
    turn = jnp.asarray(np.exp(1j * grid), jnp.complex128 if F.dtype == jnp.float64 else jnp.complex64)

    def size(z):
        response = jnp.linalg.solve(z * jnp.eye(n, dtype=z.dtype) - safe.astype(z.dtype), root.astype(z.dtype))
        response = weigh.astype(z.dtype) @ response
        return jnp.linalg.eigvalsh(response @ response.conj().T)[-1]

    worst = jax.vmap(size)(turn).max()
    mean = jnp.trace(S @ jnp.where(stable, Sigma, jnp.zeros_like(Sigma)))
    return PredictorGains(jnp.where(stable, mean, infinite), jnp.where(stable, worst, infinite), stable)
