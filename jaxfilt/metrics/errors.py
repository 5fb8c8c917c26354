"""Estimation errors over time windows and components."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxfilt.core import is_concrete, numbers, real_array

Components = Sequence[int] | slice | None


def squared_error(estimate: ArrayLike, truth: ArrayLike, *, components: Components = None) -> Array:
    """The squared length of the error vector at each time.

    Args:
        estimate: (..., T, n).
        truth: (..., T, n), the same shape.
        components: the entries that make up the vector, as a sequence of indices or a slice; None = all n.

    Returns:
        (..., T), in the squared unit of the components. Divide by their number for the mean per axis.

    Raises:
        ValueError: different shapes.
    """
    estimate, truth = real_array("estimate", estimate), real_array("truth", truth)
    if estimate.ndim == 0 or estimate.dtype != truth.dtype:
        raise TypeError(f"estimate, truth: expected arrays of one dtype, got {estimate.dtype} and {truth.dtype}")
    if jnp.shape(estimate) != jnp.shape(truth):
        raise ValueError(f"estimate: expected the shape of truth {jnp.shape(truth)}, got {jnp.shape(estimate)}")
    error = _pick(estimate, components) - _pick(truth, components)
    return jnp.sum(error * error, axis=-1)


def mse(estimate: ArrayLike, truth: ArrayLike, *, components: Components = None, window: Any = None) -> Array:
    """The mean over a time window of :func:`squared_error`.

    In a Monte-Carlo score return this and let :func:`jaxfilt.metrics.root_mean` take the root over runs: a mean of
    per-run RMSEs is another, smaller number.

    Args:
        estimate: (..., T, n).
        truth: (..., T, n).
        components: as in :func:`squared_error`.
        window: ``(first, last)`` samples, both included (as in :func:`jaxfilt.simulate.gap_mask`), or a mask (T,) bool,
            True = counted; None = all.

    Returns:
        (...), in the squared unit of the components. NaN where a traced mask counts no sample.

    Raises:
        ValueError: a (concrete) window that is empty or reaches beyond the series.
    """
    errors = squared_error(estimate, truth, components=components)
    T = errors.shape[-1]
    if window is None:
        return jnp.mean(errors, axis=-1)
    if isinstance(window, tuple):
        first, last = window
        if not 0 <= first <= last < T:
            raise ValueError(f"window: expected 0 <= first <= last < {T}, got ({first}, {last})")
        return jnp.mean(errors[..., first : last + 1], axis=-1)
    window = real_array("window", window)
    if window.shape != (T,) or window.dtype != np.dtype(bool):
        raise ValueError(f"window: expected (first, last) or a bool mask ({T},), got {window.dtype} {window.shape}")
    if is_concrete(window) and not np.asarray(window).any():
        raise ValueError("window: the mask counts no sample")
    window = jnp.asarray(window)
    total = jnp.sum(jnp.where(window, errors, jnp.zeros((), errors.dtype)), axis=-1)
    return total / window.sum().astype(errors.dtype)


def rmse(estimate: ArrayLike, truth: ArrayLike, *, components: Components = None, window: Any = None) -> Array:
    """The root of :func:`mse`, in the components' own unit; arguments as there."""
    return jnp.sqrt(mse(estimate, truth, components=components, window=window))


def _pick(x, components):
    if components is None or isinstance(components, slice):
        return x[..., components or slice(None)]
    index = check_components(components, x.shape[-1])
    return x[..., index]


def check_components(components: Any, n: int) -> np.ndarray:
    """The indices as an array, or an error that names ``components`` if they are none of 0..n - 1 (or from the end)."""
    index = numbers("components", components)
    if index.size and not np.issubdtype(index.dtype, np.integer):
        raise TypeError(f"components: expected integers, got {index.dtype}")
    if index.ndim != 1 or index.size == 0:
        raise ValueError(f"components: expected one or more indices, got {components!r}")
    if ((index < -n) | (index >= n)).any():
        raise ValueError(f"components: expected indices of {n} components, got {index.tolist()}")
    return index.astype(np.int32)
