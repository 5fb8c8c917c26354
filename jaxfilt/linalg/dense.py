"""Factorisations of small matrices that never return NaN and whose gradients stay finite on singular input.

Everything is unrolled over columns: under ``vmap`` it becomes elementwise work, which XLA runs far faster on CPUs than
batched LAPACK calls. Every tolerance is relative to the entry it protects, so results do not depend on units.
A pivot that is zero to working precision gives a zero column, and the solves skip it.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.linalg.scalarize import instead


def sym(A: Array) -> Array:
    """The symmetric part of A (n, n), symmetric to the bit."""
    return 0.5 * (A + A.T)


@jax.jit
def mirror(A: Array) -> Array:
    """As :func:`sym`, for products that are symmetric but for rounding, as F P F': on scalars one triangle serves."""
    return sym(A)


def _lower_mirrored(A):
    return jnp.where(np.tri(A.shape[0], dtype=bool), A, A.T)


instead(mirror, _lower_mirrored, (2,), lambda A: True)


def scale_cov(A: Array, scale: Array | None) -> Array:
    """D A D with D = diag(sqrt(scale)); ``scale`` is None, () or (n,)."""
    if scale is None:
        return A
    if jnp.ndim(scale) == 0:
        return A * scale
    d = _sqrt(scale)
    return d[:, None] * d[None, :] * A  # in this order it is as symmetric as A, to the bit


def scale_factor(L: Array, scale: Array | None) -> Array:
    """D L, the factor of :func:`scale_cov` of L L'."""
    if scale is None:
        return L
    d = _sqrt(scale)
    return L * d if jnp.ndim(d) == 0 else d[:, None] * L


def chol(A: Array) -> Array:
    """Lower Cholesky factor of a positive semidefinite A (n, n).

    A pivot below ``n eps |A_jj|`` counts as zero and gives a zero column: no NaN, and a finite gradient. NaN and
    infinity in A give NaN, so that a filter reports them.
    """
    n = A.shape[0]
    tolerance = n * jnp.finfo(A.dtype).eps * jnp.abs(jnp.diagonal(A))
    columns = []
    rest = A
    for j in range(n):
        pivot = rest[j, j]
        ok = pivot > tolerance[j]
        root = jnp.sqrt(jnp.where(ok, pivot, jnp.ones((), A.dtype)))
        nothing = jnp.where(np.arange(n) == j, pivot - pivot, jnp.zeros((), A.dtype))  # 0; of NaN and infinity NaN
        column = jnp.where(ok & (np.arange(n) >= j), rest[:, j] / root, nothing)
        columns.append(column)
        if j < n - 1:
            rest = rest - column[:, None] * column[None, :]
    return jnp.stack(columns, axis=1)


def solve_lower(L: Array, b: Array) -> Array:
    """x with L x = b for lower-triangular L (n, n) and b (n,) or (n, k); components of zero pivots are 0."""
    return _substitute(L, b, range(L.shape[0]), transpose=False)


def solve_lower_t(L: Array, b: Array) -> Array:
    """x with L' x = b for lower-triangular L (n, n) and b (n,) or (n, k); components of zero pivots are 0."""
    return _substitute(L, b, range(L.shape[0] - 1, -1, -1), transpose=True)


def solve_chol(L: Array, b: Array) -> Array:
    """x with L L' x = b."""
    return solve_lower_t(L, solve_lower(L, b))


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def tria(A: Array, summed: int = 0) -> Array:
    """The lower-triangular L (n, n) with L L' = A A' and a nonnegative diagonal, for A (n, k).

    Householder reflections from the right, with large rows best placed first (Powell and Reid 1969). A row that depends
    on the rows above it to working precision gets a zero pivot and its column stays free for the rows below, so that
    the whole column of L is zero and L L' = A A' still holds. The derivative is that of the triangular factor, exact
    wherever the pivots are nonzero and finite everywhere. NaN and infinity in A give NaN.

    A pivot counts as zero below ``k eps`` times what reflections have moved in its row, at most the row's largest
    entry: that is the rounding they leave. So a row keeps what it has apart from the others, however small. The first
    ``summed`` rows are sums that may have cancelled before (H L): for them it is the largest entry.
    """
    return _reflect(A, A.shape[0], summed)


@tria.defjvp
def _tria_jvp(summed, primals, tangents):
    # With A = L Q': dL = L (lower(C) + lower(C') without the diagonal twice), C = L^-1 dA Q. Written as dA Q minus its
    # part above the diagonal, which stays finite (and is cut) where a pivot is zero.
    (A,), (dA,) = primals, tangents
    n, k = A.shape
    LQ = _reflect(jnp.concatenate([A, jnp.eye(k, dtype=A.dtype)]), n, summed)
    L, Q = LQ[:n], LQ[n:]
    dAQ = dA @ Q
    above = jnp.triu(solve_lower(L, dAQ), 1)
    return L, jnp.tril(dAQ - L @ (above - above.T))


def _reflect(A, n, summed):
    """Reduces the first n rows of A (r, k) to lower-triangular form; all rows are reflected, n columns are returned."""
    r, k = A.shape
    if k < n:
        A = jnp.concatenate([A, jnp.zeros((r, n - k), A.dtype)], axis=1)
        k = n
    zero, one = jnp.zeros((), A.dtype), jnp.ones((), A.dtype)
    eps = jnp.finfo(A.dtype).eps
    columns, rows = np.arange(k), np.arange(r)[:, None]
    largest = jnp.max(jnp.abs(A[:n]), axis=1)
    free = jnp.ones((k,), bool)  # columns not yet taken by a pivot
    moved = jnp.zeros((n,), A.dtype)  # the sum of what each row's columns that are left have been changed by
    signs = []
    for j in range(n):
        x = jnp.where(free, A[j], zero)
        size = jnp.max(jnp.abs(x))
        ok = size > k * eps * (largest[j] if j < summed else jnp.minimum(moved[j], largest[j]))
        # Scaled before squaring, so that tiny units do not underflow.
        scaled = x / jnp.where(ok, size, jnp.inf)
        scaled = jnp.where(~ok & (columns == j), one, scaled)
        norm = jnp.sqrt(jnp.sum(scaled * scaled))
        sign = jnp.where(scaled[j] > 0, -one, one)  # of the pivot: no cancellation in v
        v = scaled - jnp.where(columns == j, sign * norm, zero)
        beta = jnp.where(ok, one / (norm * (norm + jnp.abs(scaled[j]))), zero)  # 2 / v'v
        along = beta * (A @ v)
        reflected = A - along[:, None] * v[None, :]
        moved = moved + jnp.abs(along[:n]) * (jnp.abs(scaled) @ (columns != j).astype(A.dtype))
        pivot = jnp.where(ok, sign * norm * size, size - size)  # 0; of NaN and infinity NaN
        pivot_row = jnp.where(columns == j, pivot, jnp.where(free, zero, A[j]))
        A = jnp.where(rows > j, reflected, jnp.where(rows == j, pivot_row[None, :], A))
        free = free & ~(ok & (columns == j))
        signs.append(sign)
    A = A[:, :n] * jnp.stack(signs)[None, :]
    return jnp.where(columns[None, :n] <= rows, A, zero)


def _sqrt(x):
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, jnp.ones_like(x))), jnp.zeros_like(x))


def _substitute(L, b, order, transpose):
    zero, one = jnp.zeros((), L.dtype), jnp.ones((), L.dtype)
    diagonal = jnp.diagonal(L)
    ok = diagonal != 0
    inverse = jnp.where(ok, 1.0 / jnp.where(ok, diagonal, one), zero)
    x = [jnp.zeros(())] * L.shape[0]
    order = list(order)
    for i in order:
        x[i] = b[i] * inverse[i]
        if i != order[-1]:
            column = L[i, :] if transpose else L[:, i]
            b = b - (column * x[i] if b.ndim == 1 else column[:, None] * x[i][None, :])
    return jnp.stack(x)
