"""Particle filters: bootstrap, guided by a Gaussian filter, auxiliary."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import Filter, Info, Prediction, Static, Status, bind, flag
from jaxfilt.filters.common import check_dtype, check_measurement, decoupled, likelihood
from jaxfilt.filters.resampling import SCHEMES, ancestors, effective_sample_size
from jaxfilt.linalg import chol, scale_cov, solve_lower, sym
from jaxfilt.models.linear import LinearGaussian, check_positive
from jaxfilt.models.nonlinear import Nonlinear, as_nonlinear, covariance


class ParticleState(NamedTuple):
    """Weighted particles. After ``predict`` they are without the process noise, which ``update`` draws."""

    particles: Array  # (N, n)
    log_weights: Array  # (N,); normalized after update
    spread: Array  # (n, n) or (N, n, n) lower factor of the noise still to be drawn


class _Options(NamedTuple):
    count: int
    scheme: str
    auxiliary: bool
    keep: bool


class _Params(NamedTuple):
    model: Nonlinear
    guide: Filter | None
    threshold: Any  # ()
    options: Static


def particle(
    model: Nonlinear | LinearGaussian,
    count: int,
    *,
    guide: Callable[[Nonlinear], Filter] | None = None,
    auxiliary: bool = False,
    resampling: str = "systematic",
    threshold: Any = 0.5,
    keep: bool = False,
) -> Filter:
    """A particle filter: the posterior as ``count`` weighted draws, for models that no Gaussian filter fits.

    Before each prediction the particles are resampled if the effective sample size is below ``threshold`` times their
    number. **Bootstrap** (default): moved by the model, weighted by the likelihood. **Guided**: each particle is drawn
    from what a Gaussian filter makes of its prediction and the measurement, and weighted for it: better where the
    sensor is far more precise than the prediction. **Auxiliary**: particles are chosen by the likelihood of their
    prediction before they move (in every step with a measurement).

    ``exp(sum of log_lik)`` is an unbiased estimate of the likelihood of the series in each of these forms; the log of
    it is biased downwards by half its variance. Gradients pass through the draws but not through the choice of
    ancestors, so the slope of ``log_lik`` is biased as soon as there is resampling.

    Random: ``jf.filter(..., key=)`` is needed; under ``vmap`` over series give each its own. Info: mean and covariance
    of the particles before resampling; ``innovation``, ``innovation_cov`` and ``nis`` of the predicted measurement's
    moments; ``extra["ess"]`` () effective sample size after the update, and with ``keep`` ``extra["particles"]``
    (N, n) and ``extra["log_weights"]`` (N,).

    Status: LOW_ESS where the effective sample size is below the threshold; MISSED; NONFINITE also where no particle has
    a finite likelihood (the weights are then kept); SINGULAR where a perfect sensor (R = 0) cannot be weighted.

    Args:
        model: from :func:`jaxfilt.models.nonlinear` or a linear-Gaussian model (its S must be None).
        count: number of particles N, static.
        guide: a factory as ``jf.extended`` or ``jf.unscented``.
        auxiliary: see above; not together with a guide.
        resampling: ``"systematic"``, ``"stratified"``, ``"multinomial"`` or ``"residual"``.
        threshold: share of N in [0, 1]; 1 resamples in every step, 0 never. May be traced.
        keep: report particles and weights.

    Raises:
        ValueError: count < 1, an unknown scheme, a guide and ``auxiliary`` together, a threshold outside [0, 1]; at
            trace time, no key.

    Source: Gordon, Salmond and Smith 1993; Doucet, Godsill and Andrieu 2000; Pitt and Shephard 1999.
    """
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise ValueError(f"count: expected a whole number of particles >= 1, got {count!r}")
    if resampling not in SCHEMES:
        raise ValueError(f"resampling: expected one of {', '.join(SCHEMES)}, got {resampling!r}")
    if guide is not None and auxiliary:
        raise ValueError("guide: not together with auxiliary, which is another way to look ahead")
    check_positive("threshold", threshold, zero=True)
    check_positive("1 - threshold", 1 - threshold, zero=True)
    if isinstance(model, LinearGaussian):
        model = as_nonlinear(model)
    options = _Options(count, resampling, auxiliary, keep)
    inner = None if guide is None else guide(model)
    if inner is not None and (inner.moments is None or inner.with_moments is None):
        raise ValueError("guide: needs a filter with moments and with_moments")
    return bind(_Params(model, inner, threshold, Static(options)), _init, _predict, _update, _moments)


def _key(inp, number):
    if inp.key is None:
        raise ValueError("key: a particle filter draws random numbers; give jf.filter a key")
    return jax.random.fold_in(inp.key, number)


def _init(p, inp):
    N, m0 = p.options.value.count, p.model.m0
    n = m0.shape[0]
    noise = jax.random.normal(_key(inp, 0), (N, n), m0.dtype)
    particles = m0[None, :] + noise @ chol(p.model.P0).T
    shape = (N, n, n) if callable(p.model.Q) else (n, n)
    predicted = p.model.h(particles[0], inp.u, inp.dt)
    check_measurement(inp, predicted.shape[0], "the model's h")
    return ParticleState(particles, _equal(N, m0.dtype), jnp.zeros(shape, m0.dtype))


def _equal(N, dtype):
    return jnp.full((N,), -np.log(N), dtype)


def _predict(p, state, inp):
    options, model = p.options.value, p.model
    N, dtype = options.count, state.particles.dtype
    log_weights = state.log_weights
    if options.auxiliary:
        moved = _move(p, state.particles, inp)
        ahead, _ = _log_likelihood(p, moved, inp)
        # Looking ahead rules nobody out: what seems impossible now may be where the noise moves a particle.
        largest = jnp.where(jnp.isfinite(ahead), ahead, jnp.asarray(-np.inf, dtype)).max()
        largest = jnp.where(jnp.isfinite(largest), largest, jnp.zeros((), dtype))
        ahead = jnp.where(jnp.isfinite(ahead), jnp.maximum(ahead, largest - 50), largest - 50)
        first = jax.lax.stop_gradient(log_weights + ahead)
        total = jax.nn.logsumexp(first)
        index = ancestors(first - total, _key(inp, 0), options.scheme)
        log_weights = (log_weights - first)[index] + total - float(np.log(N))
        particles = moved[index]
        origin = state.particles[index]
    else:
        low = effective_sample_size(log_weights) < jnp.asarray(p.threshold, dtype) * N * (1 - 1e-6)
        index = ancestors(jax.lax.stop_gradient(log_weights), _key(inp, 0), options.scheme)
        index = jnp.where(low, index, jnp.arange(N, dtype=jnp.int32))
        log_weights = jnp.where(low, _equal(N, dtype), log_weights)
        origin = state.particles[index]
        particles = _move(p, origin, inp)
    if callable(model.Q):
        spread = jax.vmap(lambda x: chol(scale_cov(covariance(model.Q, x, inp.u, inp.dt), inp.q_scale)))(origin)
        noise = jnp.einsum("i,iab,icb->ac", jnp.exp(log_weights), spread, spread)
    else:
        spread = chol(scale_cov(model.Q, inp.q_scale))
        noise = spread @ spread.T
    mean, cov = _weighted(log_weights - jax.nn.logsumexp(log_weights), particles)
    return ParticleState(particles, log_weights, spread), Prediction(mean, sym(cov + noise))


def _move(p, particles, inp):
    return jax.vmap(lambda x: p.model.f(x, inp.u, inp.dt))(particles)


def _weighted(log_weights, x):
    weights = jnp.exp(log_weights)
    mean = weights @ x
    apart = x - mean[None, :]
    return mean, sym((weights[:, None] * apart).T @ apart)


def _residuals(p, particles, inp):
    """Predicted measurements (N, m), and y minus them; absent and non-finite components are 0."""
    model = p.model
    predicted = jax.vmap(lambda x: model.h(x, inp.u, inp.dt))(particles)
    usable = jnp.isfinite(inp.y) if inp.mask is None else inp.mask & jnp.isfinite(inp.y)

    def one(at):
        y = jnp.where(usable, inp.y, at)
        difference = y - at if model.residual is None else model.residual(y, at)
        return jnp.where(usable, difference, jnp.zeros_like(at))

    return predicted, jax.vmap(one)(predicted), usable


def _log_likelihood(p, particles, inp):
    """log p(y | x) (N,) over the usable components, and the status."""
    model = p.model
    _, nu, usable = _residuals(p, particles, inp)

    def one(x, nu):
        R = scale_cov(covariance(model.R, x, inp.u, inp.dt), inp.r_scale)
        L = chol(decoupled(usable, R))
        _, log_lik, status = likelihood(usable, L, solve_lower(L, nu))
        return log_lik, status

    log_lik, status = jax.vmap(one)(particles, nu)
    return log_lik, status.max()


def _update(p, state, inp):
    options, model = p.options.value, p.model
    N, n = state.particles.shape
    check_dtype(inp, state.particles)
    noise = jax.random.normal(_key(inp, 1), (N, n), state.particles.dtype)
    spread = state.spread if state.spread.ndim == 3 else None
    moved = noise @ state.spread.T if spread is None else jnp.einsum("iab,ib->ia", spread, noise)
    prior = state.particles + moved
    before = state.log_weights - jax.nn.logsumexp(state.log_weights)
    if p.guide is None:
        particles, correction = prior, jnp.zeros((N,), prior.dtype)
    else:
        particles, correction = _guided(p, state, inp, noise)
    log_lik, singular = _log_likelihood(p, particles, inp)

    predicted, _, usable = _residuals(p, prior, inp)
    centre = predicted[0]  # about one of them, since angles are not averaged as they are
    apart = (
        predicted - centre[None, :]
        if model.residual is None
        else jax.vmap(model.residual, (0, None))(predicted, centre)
    )
    shift, spread_y = _weighted(before, apart)
    R = scale_cov(covariance(model.R, _weighted(before, prior)[0], inp.u, inp.dt), inp.r_scale)
    S = sym(spread_y + R)
    y = jnp.where(usable, inp.y, centre + shift)
    nu = y - centre - shift if model.residual is None else model.residual(y, centre + shift)
    nu = jnp.where(usable, nu, jnp.zeros_like(nu))
    L = chol(decoupled(usable, S))
    nis, _, _ = likelihood(usable, L, solve_lower(L, nu))

    joint = state.log_weights + log_lik + correction
    joint = jnp.where(jnp.isfinite(joint), joint, jnp.asarray(-np.inf, joint.dtype))
    largest = joint.max()
    alive = jnp.isfinite(largest)
    # Less the largest first: beside log-likelihoods of -1e8 single precision has no digits left for weights.
    joint = jnp.where(alive, joint - jnp.where(alive, largest, jnp.zeros_like(largest)), before)
    normalizer = jax.nn.logsumexp(joint)
    floor = float(jnp.finfo(joint.dtype).min) / 8  # finite, so that differences of weights are no NaN
    log_weights = jnp.maximum(joint - normalizer, floor)
    log_total = jnp.where(alive, largest + normalizer, jnp.asarray(floor, joint.dtype))
    bad = ~jnp.isfinite(inp.y)
    present = jnp.ones_like(bad) if inp.mask is None else inp.mask
    log_total = jnp.where(present.any(), log_total, jnp.zeros_like(log_total))
    ess = effective_sample_size(log_weights)
    status = flag(~present.any(), Status.MISSED) | flag((bad & present).any() | ~alive, Status.NONFINITE) | singular
    status = status | flag(ess < jnp.asarray(p.threshold, ess.dtype) * N * (1 - 1e-6), Status.LOW_ESS)
    mean, cov = _weighted(log_weights, particles)
    extra = {"ess": ess}
    if options.keep:
        extra |= {"particles": particles, "log_weights": log_weights}
    info = Info(mean, cov, nu, S, nis, log_total, status, noise_cov=R, extra=extra)
    return ParticleState(particles, log_weights, jnp.zeros_like(state.spread)), info


def _guided(p, state, inp, noise):
    """Draws from what the guide makes of each particle, and ``log p(x | x_-) - log q(x)``."""
    guide: Any = p.guide  # one with moments that can be replaced
    start = guide.init(inp)

    def one(x, L, e):
        inner, _ = guide.update(guide.with_moments(start, x, sym(L @ L.T)), inp._replace(key=None))
        mean, cov = guide.moments(inner)
        C = chol(cov)
        drawn = mean + C @ e
        back = solve_lower(L, drawn - x)
        # Both densities over the directions that have noise; their constants cancel.
        log_p = -0.5 * jnp.sum(back * back) - _log_det(L)
        log_q = -0.5 * jnp.sum(jnp.where(jnp.diagonal(C) != 0, e, 0.0) ** 2) - _log_det(C)
        ok = jnp.isfinite(drawn).all() & jnp.isfinite(log_p - log_q)
        return jnp.where(ok, drawn, x + L @ e), jnp.where(ok, log_p - log_q, jnp.zeros_like(log_p))

    spread = state.spread
    axes = (0, None if spread.ndim == 2 else 0, 0)
    return jax.vmap(one, axes)(state.particles, spread, noise)


def _log_det(L):
    diagonal = jnp.diagonal(L)
    ok = diagonal != 0
    return jnp.sum(jnp.where(ok, jnp.log(jnp.where(ok, diagonal, 1.0)), 0.0))


def _moments(p, state):
    mean, cov = _weighted(state.log_weights - jax.nn.logsumexp(state.log_weights), state.particles)
    if state.spread.ndim == 2:
        return mean, sym(cov + state.spread @ state.spread.T)
    weights = jnp.exp(state.log_weights)
    return mean, sym(cov + jnp.einsum("i,iab,icb->ac", weights, state.spread, state.spread))
