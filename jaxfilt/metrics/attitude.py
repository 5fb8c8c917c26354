"""Errors of an attitude."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from jaxfilt.core import real_array


def tilt_error(estimate: ArrayLike, truth: ArrayLike) -> Array:
    """The angle [rad] between vertical axes (..., 3), whatever their lengths: free of Euler angles' singularity.

    By the chord's half angle, so that small angles are exact. The derivative at no error is undefined: put a loss on
    the squared difference of the axes.
    """
    a, b = real_array("estimate", estimate), real_array("truth", truth)
    for name, x in (("estimate", a), ("truth", b)):
        if x.ndim == 0 or x.shape[-1] < 3 or not jnp.issubdtype(x.dtype, jnp.floating):
            raise ValueError(f"{name}: expected float axes (..., 3), got {x.dtype} {x.shape}")
    if a.dtype != b.dtype or a.shape[:-1] != b.shape[:-1]:
        raise ValueError(f"truth: expected as estimate {a.dtype} {a.shape}, got {b.dtype} {b.shape}")
    a, b = a[..., :3], b[..., :3]
    a, b = (x / jnp.linalg.norm(x, axis=-1, keepdims=True) for x in (a, b))
    return 2.0 * jnp.arctan2(jnp.linalg.norm(a - b, axis=-1), jnp.linalg.norm(a + b, axis=-1))
