"""A stretch of steps of a linear-Gaussian model as one element, so that stretches can be joined in any grouping.

Of a stretch from the state x_0 before it to the state x after it, the element holds::

    p(x | x_0, ys) = N(A x_0 + b, C),    p(ys | x_0) proportional to exp(eta' x_0 - x_0' J x_0 / 2)

Only positive definite matrices ``I + L' J L`` are factored, never a covariance inverted: C and J may be singular. All
covariances are formed as sums of squares. No likelihood is carried: differences of large terms would spoil it.

Source: Särkkä and García-Fernández 2021, IEEE Trans. Automatic Control 66(1); the factored form is ours.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxfilt.core import Filter, Info, Prediction, bind
from jaxfilt.filters.common import decoupled, innovate, masked_rows
from jaxfilt.filters.kalman import effective_dynamics, measurement, propagate
from jaxfilt.linalg import chol, mirror, solve_chol, solve_lower, sym
from jaxfilt.models.linear import LinearGaussian


class Transfer(NamedTuple):
    """One stretch of steps."""

    A: Array  # (n, n)
    b: Array  # (n,)
    C: Array  # (n, n)
    eta: Array  # (n,)
    J: Array  # (n, n)


class Stretch(NamedTuple):
    """The state of :func:`transfer`."""

    transfer: Transfer
    lossy: (
        Array  # () bool: a component whose H C H' + R is 0 would have told the state before exactly, and was not used
    )


def transfer(model: LinearGaussian) -> Filter:
    """A filter whose state, after some steps, holds the Transfer of these steps. Its Info says nothing of use.

    It is the Kalman filter from the known state 0, which besides carries how far its mean depends on that state (A),
    and what the innovations tell of it (eta, J).
    """
    return bind(model, _init, _predict, _update)


def _init(model, inp):
    del inp
    n, dtype = model.m0.shape[0], model.m0.dtype
    zero = jnp.zeros((n, n), dtype)
    return Stretch(Transfer(jnp.eye(n, dtype=dtype), zero[0], zero, zero[0], zero), jnp.zeros((), bool))


def _predict(model, state, inp):
    A, b, C, eta, J = state.transfer
    F, Q, shift = effective_dynamics(model, inp, None)
    b = propagate(F, b, shift, None)
    return Stretch(Transfer(F @ A, b, mirror(F @ C @ F.T) + Q, eta, J), state.lossy), Prediction(b)


def _update(model, state, inp):
    A, b, C, eta, J = state.transfer
    H, R, predicted = measurement(model, inp, b)
    # The filter takes a value that is not finite as what it predicts, which is no linear map: here it counts as absent.
    usable = jnp.isfinite(inp.y)
    inp = inp._replace(mask=usable if inp.mask is None else inp.mask & usable)
    nu, mask, status = innovate(inp, predicted)
    H, R = masked_rows(mask, H), sym(R)
    L = chol(decoupled(mask, mirror(H @ C @ H.T) + R))
    unused = jnp.diagonal(L) == 0
    seen = solve_lower(L, H @ A)
    K = solve_chol(L, H @ C).T
    B = jnp.eye(b.shape[0], dtype=b.dtype) - K @ H
    after = Transfer(
        A - K @ (H @ A),
        b + K @ nu,
        mirror(B @ C @ B.T + K @ R @ K.T),
        eta + seen.T @ solve_lower(L, nu),
        J + mirror(seen.T @ seen),
    )
    lossy = state.lossy | (unused & mask).any()
    return Stretch(after, lossy), Info(after.b, after.C, nu, None, None, None, status)


def prior(mean: Array, cov: Array) -> Transfer:
    """A known state, whatever came before it."""
    zero = jnp.zeros_like(cov)
    return Transfer(zero, mean, cov, jnp.zeros_like(mean), zero)


def apply(stretch: Transfer, mean: Array, cov: Array) -> tuple[Array, Array]:
    """Moments (n,), (n, n) after a stretch from those before it."""
    A, b, C, eta, J = stretch
    cov = _parallel_sum(cov, J)
    return A @ (mean + cov @ (eta - J @ mean)) + b, sym(A @ cov @ A.T) + C


def join(first: Transfer, second: Transfer) -> Transfer:
    """Two stretches, one after the other, as one."""
    A1, b1, C1, eta1, J1 = first
    A2, b2, C2, eta2, J2 = second
    between = _parallel_sum(C1, J2)  # the covariance where they meet, once the second's measurements are known
    gap = eta2 - J2 @ b1
    D = A1 - between @ (J2 @ A1)  # (I + C1 J2)^-1 A1
    return Transfer(
        A2 @ D,
        A2 @ (b1 + between @ gap) + b2,
        sym(A2 @ between @ A2.T) + C2,
        eta1 + D.T @ gap,
        J1 + sym(A1.T @ _parallel_sum(J2, C1) @ A1),
    )


@jax.custom_jvp
def _parallel_sum(P: Array, J: Array) -> Array:
    """(P^-1 + J)^-1, for positive semidefinite matrices: with P = L L' it is L (I + L' J L)^-1 L'."""
    L = chol(P)
    M = chol(jnp.eye(L.shape[0], dtype=L.dtype) + sym(L.T @ J @ L))
    T = solve_lower(M, L.T)
    return sym(T.T @ T)


@_parallel_sum.defjvp
def _parallel_sum_jvp(primals, tangents):
    # Exact where P is singular, at which the derivative of its factor is not.
    (P, J), (dP, dJ) = primals, tangents
    out = _parallel_sum(P, J)
    D = jnp.eye(P.shape[0], dtype=P.dtype) - out @ J
    return out, D @ dP @ D.T - out @ dJ @ out
