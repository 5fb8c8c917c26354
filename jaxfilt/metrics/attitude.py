"""Errors of an attitude."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike


def tilt_error(estimate: ArrayLike, truth: ArrayLike) -> Array:
    """The angle [rad] between vertical axes (..., 3), whatever their lengths: free of Euler angles' singularity.

    By the chord's half angle, so that small angles are exact. The derivative at no error is undefined: put a loss on
    the squared difference of the axes.
    """
    a, b = jnp.asarray(estimate)[..., :3], jnp.asarray(truth)[..., :3]
    a, b = (x / jnp.linalg.norm(x, axis=-1, keepdims=True) for x in (a, b))
    return 2.0 * jnp.arctan2(jnp.linalg.norm(a - b, axis=-1), jnp.linalg.norm(a + b, axis=-1))
