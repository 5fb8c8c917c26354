"""Resampling schemes: which particles go on, and how often."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

SCHEMES = ("systematic", "stratified", "multinomial", "residual")


def effective_sample_size(log_weights: Array) -> Array:
    """``1 / sum w^2`` () of normalized log-weights (N,): N for equal weights, 1 where one particle has them all."""
    return jnp.exp(-jax.nn.logsumexp(2 * log_weights))


def ancestors(log_weights: Array, key: Array, scheme: str = "systematic") -> Array:
    """The indices (N,) int32 of N particles drawn by their weights, in ascending order.

    Each particle is drawn ``N w_i`` times on average (all schemes are unbiased). ``"systematic"``: one uniform number,
    N equidistant points. ``"stratified"``: one in each of N equal parts. ``"multinomial"``: independent.
    ``"residual"``: ``floor(N w_i)`` times for certain, the rest multinomial. Systematic has the least variance of the
    counts, and results that depend on the order of the particles.

    Args:
        log_weights: (N,) normalized.
        key: random key.
        scheme: static.

    Raises:
        ValueError: an unknown scheme.

    Source: Douc, Cappe and Moulines 2005; Hol, Schon and Gustafsson 2006.
    """
    if scheme not in SCHEMES:
        raise ValueError(f"scheme: expected one of {', '.join(SCHEMES)}, got {scheme!r}")
    N, dtype = log_weights.shape[0], log_weights.dtype
    weights = jnp.exp(log_weights)
    if scheme == "residual":
        return _residual(weights, key)
    if scheme == "multinomial":
        points = _sorted_uniform(key, N, dtype)
    else:
        u = jax.random.uniform(key, (N,) if scheme == "stratified" else (), dtype)
        points = (jnp.arange(N, dtype=dtype) + u) / N
    return _at(weights, points)


def _at(weights, points):
    """Where points in [0, 1) fall in the cumulated weights, which end at exactly 1 whatever was lost to rounding."""
    cumulated = jnp.cumsum(weights)
    cumulated = cumulated / cumulated[-1]
    found = jnp.searchsorted(cumulated, points, side="right").astype(jnp.int32)
    # A point that rounding has put at 1 belongs to the last particle with a weight.
    last = jnp.int32(weights.shape[0] - 1) - jnp.argmax(weights[::-1] > 0).astype(jnp.int32)
    return jnp.minimum(found, last)


def _sorted_uniform(key, N, dtype):
    """N sorted uniform numbers without sorting, by the gaps of a Poisson process."""
    gaps = jnp.cumsum(jax.random.exponential(key, (N + 1,), dtype))
    return gaps[:-1] / gaps[-1]


def _residual(weights, key):
    N, dtype = weights.shape[0], weights.dtype
    expected = N * weights
    certain = jnp.floor(expected * (1 + 4 * N * jnp.finfo(dtype).eps))  # N w = 1 may come out a little below
    rest = jnp.maximum(expected - certain, jnp.zeros((), dtype))
    total = jnp.sum(rest)
    some = total > 0
    rest = jnp.where(some, rest / jnp.where(some, total, jnp.ones((), dtype)), weights)
    # The first places take the certain ones, the others are drawn: draw N, use as many as are left.
    drawn = _at(rest, jax.random.permutation(jax.random.fold_in(key, 1), _sorted_uniform(key, N, dtype)))
    ends = jnp.cumsum(certain.astype(jnp.int32))
    places = jnp.arange(N, dtype=jnp.int32)
    fixed = jnp.searchsorted(ends, places, side="right").astype(jnp.int32)
    return jnp.sort(jnp.where(places < ends[-1], jnp.minimum(fixed, jnp.int32(N - 1)), drawn))
