"""Exact discretization of linear stochastic differential equations."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import expm

from jaxfilt.linalg import sym
from jaxfilt.models.linear import check_covariance, check_finite, check_shape, common_dtype


def van_loan(A: Array, Qc: Array, dt: Any) -> tuple[Array, Array]:
    """``(F, Q)`` of ``dx = A x dt + dw``, ``Cov(dw) = Qc dt``, over an interval.

    From one matrix exponential, ``exp([[-A, Qc], [0, A']] dt)``: no closed form that loses its digits for small
    intervals, and differentiable. It holds ``exp(-A dt)`` too: keep dt times the fastest decay rate below about 10 (it
    overflows at 700, in float32 at 80).

    Args:
        A: (n, n) drift [1/s].
        Qc: (n, n) spectral density of the noise.
        dt: () interval [s].

    Returns:
        F (n, n) and the symmetric Q (n, n).

    Raises:
        ValueError: wrong shapes, or (concrete arrays) non-finite values or an asymmetric or indefinite Qc.
        TypeError: integer arrays or different float dtypes.

    Source: Van Loan 1978.
    """
    common_dtype({"A": A, "Qc": Qc, "dt": dt})
    A, Qc = jnp.asarray(A), jnp.asarray(Qc)
    check_shape("A", A, (A.shape[0] if A.ndim else None,) * 2)
    n = A.shape[0]
    if n == 0:
        raise ValueError(f"A: expected shape (n, n) with n >= 1, got {A.shape}")
    check_shape("Qc", Qc, (n, n))
    check_finite("A", A)
    check_covariance("Qc", Qc)
    check_finite("dt", dt)
    check_shape("dt", dt, ())
    block = expm(
        jnp.concatenate([jnp.concatenate([-A, Qc], axis=1), jnp.concatenate([jnp.zeros_like(A), A.T], axis=1)]) * dt
    )
    F = block[n:, n:].T
    return F, sym(F @ block[:n, n:])
