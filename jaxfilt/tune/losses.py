"""Losses over a batch of series: what makes one filter better than another, as one number.

All take ``(filt, ys (B, T, m), ...)``, run the batch by ``vmap`` and share the options of :class:`Options`. They are
differentiable, and deterministic given their arguments: with the same key two candidates meet the same noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt import core
from jaxfilt.core import Filter, Info, Status
from jaxfilt.linalg import chol, solve_lower
from jaxfilt.tune.batch import Options, any_present, batch_shape, filter_batch, weighted_mean

PyTree = Any


def innovation_nll(
    filt: Filter,
    ys: Array,
    *,
    warmup: int = 0,
    key: Array | None = None,
    **options: Unpack[Options],
) -> Array:
    """Mean innovation negative log-likelihood per valid sample, ``-sum(log_lik) / samples``.

    For a Gaussian filter a sample gives ``(nu' S^-1 nu + log det S + m log(2 pi)) / 2`` over its m present components;
    the constant ``m log(2 pi) / 2`` is kept. Samples do not count that are masked altogether, that hold an unmasked
    NaN or infinite value, or that a gate refused: the loss cannot tune a gate, which could always refuse more. Inside a
    gate it cannot be trusted with Q and R either, since a smaller S refuses more: let a refused sample cost a constant.

    Args:
        filt: the filter; it must define ``log_lik``.
        ys: (B, T, m) measurements.
        warmup: first samples of each run that are not scored.
        key: random key, for filters that draw; run i gets ``fold_in(key, i)``.
        **options: see :class:`Options`.

    Returns:
        () in nats; infinite if no sample is valid.

    Raises:
        ValueError: the filter has no likelihood, or wrong shapes.
    """
    log_lik, status = filter_batch(_likelihood, filt, ys, key, **options)
    valid = any_present(ys, options.get("mask"), warmup) & ((status & jnp.int32(int(Status.GATED))) == jnp.int32(0))
    return weighted_mean(-log_lik, valid)


def prediction_mse(
    filt: Filter,
    ys: Array,
    *,
    warmup: int = 0,
    key: Array | None = None,
    **options: Unpack[Options],
) -> Array:
    """Mean squared innovation ``|nu|^2`` per valid sample: one-step prediction, for filters without a covariance.

    Arguments as in :func:`innovation_nll`. Returns () in the measurement's unit squared.
    """
    innovation = filter_batch(_innovation, filt, ys, key, **options)
    return weighted_mean(jnp.sum(innovation * innovation, axis=-1), any_present(ys, options.get("mask"), warmup))


def rmse(
    filt: Filter,
    ys: Array,
    truth: Array,
    *,
    components: Sequence[int] | slice | None = None,
    window: slice | Array | None = None,
    key: Array | None = None,
    **options: Unpack[Options],
) -> Array:
    """Root of the mean squared distance between estimate and truth, over runs and the samples of the window.

    Args:
        filt: the filter.
        ys: (B, T, m) measurements.
        truth: (B, T, n) true states.
        components: which components of the state make up the distance, e.g. ``(0, 1)`` for a position; default all.
        window: which samples count: a slice of time, or bool weights (T,) or (B, T); default all.
        key: random key, for filters that draw; run i gets ``fold_in(key, i)``.
        **options: see :class:`Options`.

    Returns:
        () in the components' unit; infinite if the window is empty.
    """
    index = _indices(ys, truth, components)
    mean = filter_batch(_posterior_mean, filt, ys, key, **options)
    error = mean[..., index] - truth[..., index]
    mse = weighted_mean(jnp.sum(error * error, axis=-1), _in_window(ys, window))
    positive = mse > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, mse, jnp.ones_like(mse))), mse)


def consistency(
    filt: Filter,
    ys: Array,
    truth: Array,
    *,
    components: Sequence[int] | slice | None = None,
    window: slice | Array | None = None,
    key: Array | None = None,
    **options: Unpack[Options],
) -> Array:
    """How far the stated covariance is from the errors met: ``|log(mean NEES / n)|``, 0 for an honest filter.

    NEES is ``e' P^-1 e`` (Bar-Shalom et al. 2001, section 5.4) over the n chosen components, averaged over runs and the
    window. Too confident by a factor and too timid by the same factor cost the same.

    Arguments as in :func:`rmse`. Raises ValueError if the filter has no covariance.
    """
    index = _indices(ys, truth, components)
    mean, cov = filter_batch(_posterior, filt, ys, key, **options)
    error = mean[..., index] - truth[..., index]
    nees = jax.vmap(jax.vmap(_squared_norm))(error, cov[..., index[:, None], index[None, :]])
    return jnp.abs(jnp.log(weighted_mean(nees, _in_window(ys, window)) / len(index)))


def _likelihood(state: PyTree, info: Info) -> tuple[Array, Array]:
    del state
    if info.log_lik is None:
        raise ValueError("filt: this loss needs a filter with log_lik")
    return info.log_lik, info.status


def _innovation(state: PyTree, info: Info) -> Array:
    del state
    return info.innovation


def _posterior_mean(state: PyTree, info: Info) -> Array:
    del state
    return info.mean


def _posterior(state: PyTree, info: Info) -> tuple[Array, Array]:
    del state
    if info.cov is None:
        raise ValueError("filt: consistency needs a filter with a covariance")
    return info.mean, info.cov


def _in_window(ys, window):
    """(B, T) bool."""
    runs, T, _ = batch_shape(ys)
    if window is None or isinstance(window, slice):
        inside = np.zeros(T, bool)
        inside[slice(None) if window is None else window] = True
        window = inside
    if not hasattr(window, "dtype"):
        window = core.numbers("window", window)
    if window.shape not in {(T,), (runs, T)}:
        raise ValueError(f"window: expected a slice or shape ({T},) or ({runs}, {T}), got {window.shape}")
    if window.dtype != np.dtype(bool):
        raise TypeError(f"window: expected bool, got {window.dtype}")
    return jnp.broadcast_to(window, (runs, T))


def _indices(ys, truth, components):
    """The chosen components as an index array; ``truth`` may lack components after the last of them."""
    batch_shape(ys)
    core.check_float("truth", truth)
    if getattr(truth, "dtype", None) != getattr(ys, "dtype", None):
        raise TypeError(f"truth: expected an array of the dtype of ys, {getattr(ys, 'dtype', None)}")
    if jnp.ndim(truth) != 3 or jnp.shape(truth)[:2] != jnp.shape(ys)[:2]:
        raise ValueError(f"truth: expected shape (B, T, n), got {jnp.shape(truth)} with ys {jnp.shape(ys)}")
    n = jnp.shape(truth)[-1]
    chosen = slice(None) if components is None else components
    if not isinstance(chosen, slice | tuple | list | np.ndarray):
        raise TypeError(f"components: expected indices or a slice, got {components!r}")
    if not isinstance(chosen, slice):
        chosen = list(chosen)
    try:
        found = np.atleast_1d(np.arange(n)[chosen])
        if found.ndim == 1 and found.size:
            return found
        raise ValueError(f"components: expected one or more indices, got {components}")
    except (IndexError, TypeError):
        raise ValueError(f"components: {components} do not exist in truth of shape {jnp.shape(truth)}") from None


def _squared_norm(error, cov):
    x = solve_lower(chol(cov), error)
    return jnp.sum(x * x)
