"""Resampling: which particles go on, how often, and what a gradient sees of it."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

SCHEMES = ("systematic", "stratified", "multinomial", "residual")
_RELAXATION = 1.5  # of Sinkhorn's sweeps: at epsilon 0.125 thirty times as close after 50 of them as plain ones


def effective_sample_size(log_weights: Array) -> Array:
    """``1 / sum w^2`` () of normalized log-weights (N,): N for equal weights, 1 where one particle has them all."""
    return jnp.exp(-jax.nn.logsumexp(2 * log_weights))


def is_low(ess: Array, threshold: Any, count: Any) -> Array:
    """Whether an effective sample size is below a share ``threshold`` of ``count``, rounding apart."""
    return ess < jnp.asarray(threshold, ess.dtype) * count * (1 - 1e-6)


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


def score_correction(log_weights: Array, index: Array | None = None) -> Array:
    """Zeros whose derivative is that of the drawn ``log_weights``: added to a new log-weight, it corrects the gradient.

    A draw with probabilities that depend on parameters has no derivative of its own; this is its score. After a
    resampling the new log-weight is ``-log N + score_correction(log W, index)`` with normalized ``log W``, not stopped.
    The same holds for any discrete draw: add ``score_correction(log p)`` of what was drawn.

    Args:
        log_weights: (N,) finite log-probabilities.
        index: what was drawn of them, any shape; None = ``log_weights`` are those of what was drawn.

    Source: Scibior and Wood 2021.
    """
    drawn = log_weights if index is None else log_weights[index]
    return drawn - jax.lax.stop_gradient(drawn)


def soften(log_weights: Array, alpha: Any) -> Array:
    """``log(alpha W + (1 - alpha) / N)`` (N,) of normalized log-weights: what soft resampling draws from.

    Source: Karkus, Hsu and Lee 2018.
    """
    N, dtype = log_weights.shape[0], log_weights.dtype
    alpha = jnp.asarray(alpha, dtype)
    return jnp.log(alpha * jnp.exp(log_weights) + (1 - alpha) / N)


@partial(jax.checkpoint, static_argnums=3)  # else a filter's gradient keeps N x N numbers of every sweep and step
def transport(particles: Array, log_weights: Array, epsilon: Any, sweeps: int) -> Array:
    """Moves weighted particles to N equally weighted places, by entropic optimal transport.

    With the plan P of least ``sum P_ij |x_i - x_j|^2 / n + epsilon KL`` whose rows sum to the weights and columns to
    1/N, particle j goes to ``N sum_i P_ij x_i``. Distances are in units of the standard deviation of the particles,
    unweighted, along each component. The mean is kept exactly; the larger epsilon, the closer the cloud is drawn to it.
    Columns sum exactly, rows up to what the sweeps leave (Sinkhorn's in logarithms, overrelaxed, from a coarse epsilon
    down to the asked): some dozens do for epsilon 0.25, hundreds are needed below 0.05.

    O(sweeps N^2) operations, O(N^2) memory also for the gradient, which is that of these sweeps (they are computed
    again for it).

    Args:
        particles: (N, n).
        log_weights: (N,) normalized.
        epsilon: strength of the regularization, in the units of the squared distance.
        sweeps: number of sweeps, static.

    Returns:
        (N, n).

    Source: Corenflos, Thornton, Deligiannidis and Doucet 2021.
    """
    N, dtype = log_weights.shape[0], log_weights.dtype
    weights = jnp.exp(log_weights)
    mean = weights @ particles
    apart = particles - mean[None, :]
    variance = jnp.var(particles, axis=0)  # unweighted: where one particle has all the weight, the weighted is 0
    size = jnp.sqrt(jnp.where(variance > 0, variance, jnp.ones((), dtype)))
    scaled = apart / size[None, :]
    cost = jnp.mean((scaled[:, None, :] - scaled[None, :, :]) ** 2, axis=2)
    epsilon = jnp.asarray(epsilon, dtype)
    target = float(-np.log(N))
    log_weights = jnp.maximum(log_weights, -200.0)  # of no effect already, and still far from overflow

    def columns(f, eps):
        return eps * (target - jax.nn.logsumexp((f[:, None] - cost) / eps, axis=0))

    @jax.checkpoint
    def sweep(f, k):
        eps = epsilon * jnp.maximum(jnp.ones((), dtype), 16 * 0.7**k)
        g = columns(f, eps)
        full = eps * (log_weights - jax.nn.logsumexp((g[None, :] - cost) / eps, axis=1))
        return f + _RELAXATION * (full - f), None

    f, _ = jax.lax.scan(sweep, jnp.zeros_like(log_weights), jnp.arange(sweeps, dtype=dtype))
    g = columns(f, epsilon)
    moved = N * jnp.exp((f[:, None] + g[None, :] - cost) / epsilon).T @ apart
    return mean[None, :] + moved - moved.mean(axis=0)[None, :]


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
