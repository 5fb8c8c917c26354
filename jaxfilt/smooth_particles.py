"""Backward smoothing of particles: exactly, by drawn paths, or at linear cost."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt import core, describe
from jaxfilt.core import Info, PyTree, Status, flag
from jaxfilt.filters.particle import log_density, weighted
from jaxfilt.linalg import chol, scale_cov
from jaxfilt.models.linear import LinearGaussian
from jaxfilt.models.nonlinear import Nonlinear, as_nonlinear, covariance


class SmoothedParticles(NamedTuple):
    """Weighted draws of p(x_k | y_1..T) and their moments. N: particles, or paths."""

    mean: Array  # (T, n)
    cov: Array  # (T, n, n)
    particles: Array  # (T, N, n); with paths, particles[:, i] is a draw of the whole trajectory
    log_weights: Array  # (T, N), normalized
    status: Array  # (T,) int32: SINGULAR where the step to k + 1 has no transition density

    def __repr__(self) -> str:
        """Shapes."""
        return describe.fields(self)


def smooth_particles(
    model: Nonlinear | LinearGaussian,
    out: Info,
    *,
    paths: int | None = None,
    proposals: int | None = None,
    key: Array | None = None,
    dt: Any = None,
    u: PyTree = None,
    q_scale: Any = None,
) -> SmoothedParticles:
    """Smooths the output of ``jf.filter(jf.particle(model, N, ..., keep=True), ...)`` backwards in time.

    * ``paths=None``: the particles of each step get the weights of p(x_k | y_1..T),
      ``w_i = W_i sum_j w'_j p(x'_j | x_i) / sum_l W_l p(x'_j | x_l)`` with ``'`` for k + 1. Nothing is drawn.
      O(N^2) operations and memory (8 MB for each array of 1000 particles in double precision).
    * ``paths=M``: M trajectories are drawn backwards, each step by ``W_i p(x' | x_i)`` over all particles. O(M N).
    * ``paths=M, proposals=K``: the same by K Metropolis steps for each path and step, which begin at the ancestor of
      the path's next particle and propose by ``W``. O(N + M K). Approximate; with ancestors from multinomial resampling
      in every step even the start is a right draw, and the steps make the paths different. After transport there are
      no ancestors, and K must be large enough to forget where the steps began.

    Model, ``dt``, ``u`` and ``q_scale`` as given to the filter. Batch it with ``jax.vmap``. Smoothing needs a density
    of the transition: where Q is singular (``noise="piecewise"``) no particle but its own ancestor can have led to
    another.

    Args:
        model: the filter's.
        out: the filter's output.
        paths: see above, static.
        proposals: see above, static.
        key: random key, for paths.
        dt: (T,) or scalar.
        u: pytree with leading T.
        q_scale: scalar, (T,) or (T, n).

    Raises:
        ValueError: an output without particles, no key for paths, a key or proposals without paths, paths or proposals
            < 1, (concrete) a singular Q; under a transformation it sets SINGULAR.

    Source: Doucet, Godsill and Andrieu 2000; Godsill, Doucet and West 2004; Bunch and Godsill 2013.
    """
    if not isinstance(out, Info):
        raise TypeError(f"out: expected the Info that jf.filter returns, got {type(out).__name__}")
    lacking = [name for name in ("particles", "log_weights", "ancestors") if name not in out.extra]
    if lacking:
        raise ValueError(f"out: has no {', '.join(lacking)}; filter with jf.particle(..., keep=True)")
    for name, count in (("paths", paths), ("proposals", proposals)):
        if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < 1):
            raise ValueError(f"{name}: expected a whole number >= 1, got {count!r}")
    if paths is None and not (proposals is None and key is None):
        raise ValueError("paths: without them nothing is drawn, so proposals and key have no meaning")
    if paths is not None and key is None:
        raise ValueError("key: paths are drawn; give a key")
    model = as_nonlinear(model)
    steps = core.inputs(out.mean, dt=dt, u=u, q_scale=q_scale)
    found = _smooth(model, out.extra, steps, key, paths, proposals)
    if core.is_concrete(found.status) and (np.asarray(found.status) & int(Status.SINGULAR)).any():
        k = int(np.argmax(np.asarray(found.status) != 0))
        raise ValueError(f"Q: is singular on the interval that ends at k = {k + 1}, so there is no transition density")
    return found


@partial(jax.jit, static_argnames=("paths", "proposals"))
def _smooth(model, extra, steps, key, paths, proposals):
    with jax.default_matmul_precision("highest"):
        particles, log_weights, ancestors = extra["particles"], extra["log_weights"], extra["ancestors"]
        T = particles.shape[0]
        earlier = particles[:-1], log_weights[:-1]
        later = jax.tree.map(lambda leaf: leaf[1:], (steps, ancestors, particles))
        if paths is None:
            _, (weights, status) = jax.lax.scan(
                lambda carry, x: _marginal(model, carry, x), log_weights[-1], (earlier, later), reverse=True
            )
            weights = jnp.concatenate([weights, log_weights[-1:]])
        else:
            keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(T))
            last = jax.random.categorical(keys[-1], log_weights[-1], shape=(paths,)).astype(jnp.int32)
            _, (index, status) = jax.lax.scan(
                lambda carry, x: _path(model, proposals, carry, x), last, (earlier, later, keys[:-1]), reverse=True
            )
            index = jnp.concatenate([index, last[None]])
            particles = jnp.take_along_axis(particles, index[:, :, None], axis=1)
            weights = jnp.full((T, paths), -np.log(paths), particles.dtype)
    mean, cov = jax.vmap(weighted)(weights, particles)
    return SmoothedParticles(mean, cov, particles, weights, jnp.concatenate([status, jnp.zeros((1,), jnp.int32)]))


def _forward(model, particles, inp):
    """Where each particle goes without noise (N, n), the factor of its noise (N, n, n), and the status."""

    def one(x):
        L = chol(scale_cov(covariance(model.Q, x, inp.u, inp.dt), inp.q_scale))
        return model.f(x, inp.u, inp.dt), L

    moved, L = jax.vmap(one)(particles)
    singular = (jnp.diagonal(L, axis1=1, axis2=2) == 0).any()
    return moved, L, flag(singular, Status.SINGULAR)


def _log_density(moved, L, x):
    """log p(x | where the particle came from) but for a constant."""
    return log_density(L, x - moved)


def _marginal(model, smoothed, x):
    (particles, log_weights), (inp, _, following) = x
    moved, L, status = _forward(model, particles, inp)
    pairs = jax.vmap(jax.vmap(_log_density, (0, 0, None)), (None, None, 0))(moved, L, following)  # (N', N)
    joint = log_weights[None, :] + pairs
    backward = joint - jax.nn.logsumexp(joint, axis=1, keepdims=True)
    weights = jax.nn.logsumexp(smoothed[:, None] + backward, axis=0)
    weights = weights - jax.nn.logsumexp(weights)
    return weights, (weights, status)


def _path(model, proposals, index, x):
    (particles, log_weights), (inp, ancestors, following), key = x
    moved, L, status = _forward(model, particles, inp)
    target = following[index]
    if proposals is None:
        pairs = jax.vmap(jax.vmap(_log_density, (0, 0, None)), (None, None, 0))(moved, L, target)  # (M, N)
        index = jax.random.categorical(key, log_weights[None, :] + pairs, axis=1).astype(jnp.int32)
        return index, (index, status)

    log_density = jax.vmap(lambda i, x: _log_density(moved[i], L[i], x))
    shape, dtype = (proposals, index.shape[0]), particles.dtype
    cumulated = jnp.cumsum(jnp.exp(log_weights))
    points = jax.random.uniform(jax.random.fold_in(key, 0), shape, dtype) * cumulated[-1]
    proposed = jnp.minimum(jnp.searchsorted(cumulated, points, side="right"), particles.shape[0] - 1).astype(jnp.int32)
    thresholds = jnp.log(jax.random.uniform(jax.random.fold_in(key, 1), shape, dtype))

    def metropolis(carry, x):
        at, value = carry
        candidate, threshold = x
        other = log_density(candidate, target)
        accept = threshold < other - value
        return (jnp.where(accept, candidate, at), jnp.where(accept, other, value)), None

    start = ancestors[index]
    (index, _), _ = jax.lax.scan(metropolis, (start, log_density(start, target)), (proposed, thresholds))
    return index, (index, status)
