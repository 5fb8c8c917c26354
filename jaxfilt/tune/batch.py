"""Batches of series: how they are filtered, masked and averaged in the losses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt import core
from jaxfilt.core import Filter, Info

PyTree = Any


class Options(TypedDict, total=False):
    """How the series are filtered, as in :func:`jaxfilt.filter`, for a batch of B runs.

    Attributes:
        mask: (T,) or (T, m) bool shared by all runs (covariances then stay shared too, which is fast), or (B, T, m).
        dt: scalar or (T,) shared, or (B, T).
        u: pytree with leading T, shared by all runs; with ``u_axis=0`` leading (B, T).
        u_axis: None or 0.
        first_update_only: takes the filter's initial state as the prior on the first sample.
    """

    mask: Array | None
    dt: Any
    u: PyTree
    u_axis: int | None
    first_update_only: bool


def filter_batch(
    outputs: Callable[[PyTree, Info], PyTree],
    filt: Filter,
    ys: Array,
    key: Array | None,
    *,
    mask: Array | None = None,
    dt: Any = None,
    u: PyTree = None,
    u_axis: int | None = None,
    first_update_only: bool = False,
) -> PyTree:
    """The outputs of all runs, leading (B, T). Give a module-level function as ``outputs``: another one traces anew."""
    core.check_filter(filt)
    runs, _, _ = batch_shape(ys)
    mask = None if mask is None else full_mask(ys, mask)
    keys = None if key is None else run_keys(key, runs)

    def one(y, mask, dt, u, key):
        given = {"mask": mask, "dt": dt, "u": u, "key": key}
        return core.filter(filt, y, **given, outputs=outputs, first_update_only=first_update_only)

    mask_axis = 0 if mask is not None and mask.ndim == 3 else None  # a shared mask keeps the covariances shared
    return jax.vmap(one, (0, mask_axis, dt_axis(dt), u_axis, 0))(ys, mask, dt, u, keys)


def batch_shape(ys: Array) -> tuple[int, int, int]:
    """(B, T, m). Raises ValueError for another rank."""
    core.check_float("ys", ys)
    if np.ndim(ys) != 3:
        raise ValueError(f"ys: expected shape (B, T, m), got {jnp.shape(ys)}")
    runs, T, m = jnp.shape(ys)
    if 0 in (runs, T, m):
        raise ValueError(f"ys: expected at least one sample, got shape {jnp.shape(ys)}")
    return runs, T, m


def dt_axis(dt: Any) -> int | None:
    """The axis over which ``vmap`` takes ``dt``."""
    return 0 if np.ndim(dt) == 2 else None


def run_keys(key: Array, runs: int) -> Array:
    """One key (B,) per run, the same for any number of runs."""
    core.check_key(key)
    return jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(runs))


def full_mask(ys: Array, mask: Array | None) -> Array:
    """The mask as (T, m) or (B, T, m); all true if None."""
    runs, T, m = batch_shape(ys)
    if mask is None:
        return jnp.ones((T, m), bool)
    mask = jnp.asarray(mask)
    if mask.shape not in {(T,), (T, m), (runs, T, m)}:
        raise ValueError(f"mask: expected shape ({T},), ({T}, {m}) or ({runs}, {T}, {m}), got {mask.shape}")
    return jnp.broadcast_to(mask[:, None], (T, m)) if mask.ndim == 1 else mask


def any_present(ys: Array, mask: Array | None, warmup: int) -> Array:
    """(B, T) bool: at least one component present, none of these non-finite, and not in the warm-up."""
    core.check_count("warmup", warmup, 0)
    runs, T, _ = batch_shape(ys)
    mask = full_mask(ys, mask)
    # Filters ignore the innovation of an unmasked NaN: to score it as zero would flatter.
    usable = (jnp.isfinite(ys) | ~jnp.broadcast_to(mask, ys.shape)).all(axis=-1)
    return usable & jnp.broadcast_to(mask.any(axis=-1), (runs, T)) & (np.arange(T) >= warmup)[None, :]


def weighted_mean(x: Array, weights: Array) -> Array:
    """Mean of x (B, T) where weights (B, T) are true; infinite if nowhere."""
    count = jnp.sum(weights.astype(x.dtype))
    total = jnp.sum(jnp.where(weights, x, jnp.zeros((), x.dtype)))
    some = count > 0
    return jnp.where(some, total / jnp.where(some, count, jnp.ones((), x.dtype)), jnp.full((), jnp.inf, x.dtype))
