"""The homotopy perturbation series as polynomial arithmetic: z' = F(z, t) from z_0, in powers of the local time.

Polynomials are arrays (D, N), the lowest power first. The series' terms are z_0, z_{m+1} = int [p^m] F(sum p^k z_k).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.experimental import jet


def evaluate(poly: Array, t: Array | float) -> Array:
    """The value (N,) of a polynomial (D, N)."""
    return jax.lax.scan(lambda value, c: (value * t + c, None), jnp.zeros_like(poly[0]), poly, reverse=True)[0]


def product(a: Array, b: Array, contract: Callable[[Array, Array], Array] = jnp.multiply) -> Array:
    """The full product of two polynomials: coefficients (r, ...) and (D, ...) meet by ``contract``."""
    r = a.shape[0]
    parts = [jax.vmap(contract, (None, 0))(a[j], b) for j in range(r)]
    return sum(
        (jnp.pad(part, [(j, r - 1 - j)] + [(0, 0)] * (part.ndim - 1)) for j, part in enumerate(parts[1:], 1)),
        start=jnp.pad(parts[0], [(0, r - 1)] + [(0, 0)] * (parts[0].ndim - 1)),
    )


def integral(poly: Array) -> Array:
    """The antiderivative (D + 1, N) that is 0 at 0."""
    powers = jnp.arange(1, poly.shape[0] + 1).astype(poly.dtype)
    return jnp.pad(poly / powers[:, None], [(1, 0), (0, 0)])


def shifted(poly: np.ndarray, by: float) -> np.ndarray:
    """The coefficients in t of a polynomial in t - by."""
    out = np.zeros_like(poly)
    for k, c in enumerate(poly):
        for j in range(k + 1):
            out[j] += math.comb(k, j) * (-by) ** (k - j) * c
    return out


def affine_series(M: Array, b: Array, z0: Array, terms: int) -> Array:
    """All terms z_m of z' = M(t) z + b(t), as polynomials; their partial sums are the Picard iterates.

    Args:
        M: (r, N, N) coefficients.
        b: (r, N) coefficients.
        z0: (N,).
        terms: s >= 2.

    Returns:
        (s, D, N) with D = (s - 1) r + 1. Nothing is truncated.
    """
    r, size = M.shape[0], (terms - 1) * M.shape[0] + 1

    def advance(term, forcing):
        derivative = product(M, term, jnp.matmul)[: size + r - 1]
        out = integral(derivative.at[:r].add(forcing))[:size]
        return out, out

    start = jnp.zeros((size, z0.shape[0]), z0.dtype).at[0].set(z0)
    forcing = jnp.zeros((terms - 1, *b.shape), z0.dtype).at[0].set(b)
    return jnp.concatenate([start[None], jax.lax.scan(advance, start, forcing)[1]])


class Quadratic(NamedTuple):
    """z' = constant + linear(z) + bilinear(z, z); sines and cosines are states of their own."""

    constant: Array  # (N,)
    linear: Callable[[Array], Array]  # (N,) -> (N,)
    bilinear: Callable[[Array, Array], Array]  # (N,), (N,) -> (N,)


def quadratic_series(field: Quadratic, z0: Array, degree: int) -> Array:
    """Taylor coefficients (degree + 1, N) of z' = field(z): for an autonomous field the homotopy terms are c_m t^m."""
    lags = jnp.arange(degree + 1)

    def advance(c, k):
        at = k - lags
        reverse = jnp.where((at >= 0)[:, None], c[jnp.maximum(at, 0)], jnp.zeros((), c.dtype))
        products = jax.vmap(field.bilinear)(c, reverse).sum(axis=0)
        derivative = field.linear(c[k]) + products + jnp.where(k == 0, field.constant, jnp.zeros((), c.dtype))
        return c.at[k + 1].set(derivative / (k + 1).astype(c.dtype)), None

    start = jnp.zeros((degree + 1, z0.shape[0]), z0.dtype).at[0].set(z0)
    return jax.lax.scan(advance, start, jnp.arange(degree))[0]


def taylor_series(F: Callable[[Array], Array], z0: Array, degree: int) -> Array:
    """The same for any smooth autonomous F, order by order by Taylor-mode differentiation.

    Compiles for long beyond degree 5, and k! spoils it beyond 20: a check of :func:`quadratic_series`.
    """
    c = [z0]
    for k in range(degree):
        # jet gives derivatives, not coefficients; a linear order is padded, since jet wants at least one
        series = [math.factorial(j) * c[j] for j in range(1, k + 1)] or [jnp.zeros_like(z0)]
        value, derivatives = jet.jet(F, (z0,), (series,))
        c.append((value if k == 0 else derivatives[k - 1] / math.factorial(k)) / (k + 1))
    return jnp.stack(c)


def chebyshev_series(F: Callable, z0: Array, t0: float, T: float, terms: int, nodes: int = 24) -> tuple[Array, Array]:
    """The terms z_m of any smooth z' = F(z, t), at Chebyshev-Lobatto nodes of [t0, t0 + T].

    Returns:
        The local times (nodes + 1,) and the terms (s, nodes + 1, N).
    """
    x = -np.cos(np.pi * np.arange(nodes + 1) / nodes)
    basis = np.polynomial.chebyshev.chebvander(x, nodes)
    antiderivative = np.stack([_chebyshev_integral(k, x) for k in range(nodes + 1)], axis=1)
    W = jnp.asarray(0.5 * T * np.linalg.solve(basis.T, antiderivative.T).T)
    times = jnp.asarray(0.5 * T * (x + 1))
    z = [jnp.broadcast_to(z0, (nodes + 1, z0.shape[0]))]
    for m in range(terms - 1):
        series = [math.factorial(k) * z[k] for k in range(1, m + 1)] or [jnp.zeros_like(z[0])]
        value, derivatives = jet.jet(lambda v: jax.vmap(F)(v, t0 + times), (z[0],), (series,))
        z.append(W @ (value if m == 0 else derivatives[m - 1] / math.factorial(m)))
    return times, jnp.stack(z)


def _chebyshev_integral(k: int, x: np.ndarray) -> np.ndarray:
    """The integral of T_k from -1 to x."""
    unit = np.zeros(k + 1)
    unit[k] = 1.0
    return np.polynomial.chebyshev.chebval(x, np.polynomial.chebyshev.chebint(unit, lbnd=-1))


def picard(M: Array, b: Array, z0: Array, iterations: int) -> Array:
    """Picard iterates z_0 + int (M phi + b), a check of :func:`affine_series`: (iterations r + 1, N)."""
    r, size = M.shape[0], iterations * M.shape[0] + 1
    start = jnp.zeros((size, z0.shape[0]), z0.dtype).at[0].set(z0)

    def advance(phi, _):
        derivative = product(M, phi, jnp.matmul).at[:r].add(b)
        return integral(derivative)[:size].at[0].set(z0), None

    return jax.lax.scan(advance, start, length=iterations)[0]
