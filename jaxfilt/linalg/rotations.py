"""Rotations of vectors in space, with derivatives that stay finite at no rotation."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array


def skew(v: Array) -> Array:
    """``[v x]`` (3, 3), the matrix of the cross product: ``skew(v) @ u = cross(v, u)``."""
    zero = jnp.zeros((), v.dtype)
    x, y, z = v[0], v[1], v[2]
    return jnp.stack([jnp.stack(row) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))])


def rotation(v: Array) -> Array:
    """``exp([v x])`` (3, 3): the rotation by the vector v (3,) [rad], by Rodrigues' formula."""
    square = jnp.sum(v * v)
    small = square < jnp.finfo(v.dtype).eps  # the series is exact there to rounding, and the root has a derivative
    angle = jnp.sqrt(jnp.where(small, jnp.ones_like(square), square))
    # 1 - cos(a) = 2 sin(a/2)^2: no cancellation.
    half = jnp.sin(0.5 * angle) / angle
    first = jnp.where(small, 1.0 - square / 6.0, jnp.sin(angle) / angle)
    second = jnp.where(small, 0.5 - square / 24.0, 2.0 * half * half)
    outer = v[:, None] * v[None, :]
    return (1.0 - second * square) * jnp.eye(3, dtype=v.dtype) + first * skew(v) + second * outer
