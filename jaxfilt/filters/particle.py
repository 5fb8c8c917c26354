"""Particle filters: bootstrap, guided by a Gaussian filter, auxiliary."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import Filter, Info, Prediction, Static, Status, bind, check_callable, check_filter, check_flag, flag
from jaxfilt.filters.common import check_dtype, check_measurement, decoupled, likelihood, step_key
from jaxfilt.filters.resampling import (
    SCHEMES,
    ancestors,
    effective_sample_size,
    is_low,
    score_correction,
    soften,
    transport,
)
from jaxfilt.linalg import chol, scale_cov, solve_lower, sym
from jaxfilt.models.linear import LinearGaussian, check_positive
from jaxfilt.models.nonlinear import Nonlinear, as_nonlinear, covariance


class ParticleState(NamedTuple):
    """Weighted particles. After ``predict`` they are without the process noise, which ``update`` draws."""

    particles: Array  # (N, n)
    log_weights: Array  # (N,); normalized after an update with a sample
    spread: Array  # (n, n), or (N, n, n) if Q is a function: lower factor of the noise still to be drawn
    ancestors: Array  # (N,) int32: which particle of the step before each one comes from


GRADIENTS = ("score", "full_score", "none", "soft", "transport")


class _Options(NamedTuple):
    count: int
    scheme: str
    auxiliary: bool
    gradient: str
    sweeps: int
    keep: bool


class _Params(NamedTuple):
    model: Nonlinear
    guide: Filter | None
    threshold: Any  # ()
    alpha: Any  # ()
    epsilon: Any  # ()
    options: Static


def particle(
    model: Nonlinear | LinearGaussian,
    count: int,
    *,
    guide: Callable[[Nonlinear], Filter] | None = None,
    auxiliary: bool = False,
    resampling: str = "systematic",
    threshold: Any = 0.5,
    gradient: str = "score",
    alpha: Any = 0.5,
    epsilon: Any = 0.25,
    sweeps: int = 50,
    keep: bool = False,
) -> Filter:
    """A particle filter: the posterior as ``count`` weighted draws, for models that no Gaussian filter fits.

    Before each prediction the particles are resampled if the effective sample size is below ``threshold`` times their
    number. **Bootstrap** (default): moved by the model, weighted by the likelihood. **Guided**: each particle is drawn
    from what a Gaussian filter makes of its prediction and the measurement, and weighted for it: better where the
    sensor is far more precise than the prediction. **Auxiliary**: particles are chosen by the likelihood of their
    prediction before they move (in every step with a measurement).

    ``exp(sum of log_lik)`` is an unbiased estimate of the likelihood of the series in each of these forms (except with
    ``gradient="transport"``); the log of it is biased downwards by half its variance.

    **Gradient.** Which particles go on is a draw and has no derivative. ``gradient`` says what is done about it. In
    brackets: what came out with 2000 particles on a linear model whose log-likelihood has the derivatives -16.9 (by the
    sensor's noise) and -2.5 (by the process noise); see ``experiments/particle_gradients``.

    * ``"score"``: the derivative of each draw's probability is put into the new weight, which is unchanged in value to
      the bit. The gradient of the likelihood estimate is then unbiased (for multinomial draws), that of ``log_lik``
      biased by O(1 / N) [-16.7, -2.4]; its variance grows with the length of the series.
    * ``"full_score"``: the same for the process noise: particles have no derivative, the density of their noise has.
      Here of less variance by the process noise. Needs a Q of full rank if f depends on the parameters.
    * ``"none"``: nothing. Biased, however many particles there are [-11.5, -18.9].
    * ``"soft"``: drawn from ``alpha W + (1 - alpha) / N``, weighted by the ratio. Biased like ``"none"`` [-10.4, -18.6
      with alpha 0.9; -9.0, -15.3 with 0.5], and the estimates get noisier as alpha falls; alpha = 1 is ``"none"``.
    * ``"transport"``: not drawn but moved to equally weighted places (:func:`~jaxfilt.filters.resampling.transport`).
      Smooth, but the estimate of the likelihood and the gradient are biased, the more the larger epsilon [with 300
      particles resampled in every step -7.0, 16.5 at epsilon 0.25, log-likelihood 3.4 too low]. O(sweeps N^2), for
      some hundreds of particles.

    Without resampling (threshold 0) all of them are the exact gradient of the same draws, but for ``"full_score"``.

    Random: ``jf.filter(..., key=)`` is needed; under ``vmap`` over series give each its own. Info: mean and covariance
    of the particles before resampling; ``innovation``, ``innovation_cov`` and ``nis`` of the predicted measurement's
    moments; ``extra["ess"]`` () effective sample size after the update, and with ``keep`` ``extra["particles"]``
    (N, n), ``extra["log_weights"]`` (N,) and ``extra["ancestors"]`` (N,), as :func:`jaxfilt.smooth_particles` needs
    them (after a transport, which has no ancestors, 0 to N - 1).

    Status: LOW_ESS where the effective sample size is below the threshold; MISSED; NONFINITE also where no particle has
    a finite likelihood (the weights are then kept); SINGULAR where a perfect sensor (R = 0) cannot be weighted.

    Args:
        model: from :func:`jaxfilt.models.nonlinear` or a linear-Gaussian model (its S must be None).
        count: number of particles N, static.
        guide: a factory as ``jf.extended`` or ``jf.unscented``.
        auxiliary: see above; not together with a guide, nor with soft resampling or transport.
        resampling: ``"systematic"``, ``"stratified"``, ``"multinomial"`` or ``"residual"``.
        threshold: share of N in [0, 1]; 1 resamples in every step, 0 never. May be traced.
        gradient: see above.
        alpha: of ``"soft"``, in (0, 1]. May be traced.
        epsilon: of ``"transport"``, > 0, in units of the cloud's variance. May be traced.
        sweeps: of ``"transport"``, static.
        keep: report particles and weights.

    Raises:
        ValueError: count or sweeps < 1, an unknown scheme or gradient, what does not go with ``auxiliary``, a
            threshold outside [0, 1], an alpha outside (0, 1], epsilon <= 0; at trace time, no key.

    Source: Gordon, Salmond and Smith 1993; Doucet, Godsill and Andrieu 2000; Pitt and Shephard 1999. Gradients: Scibior
    and Wood 2021; Karkus, Hsu and Lee 2018; Corenflos, Thornton, Deligiannidis and Doucet 2021.
    """
    check_count("count", count, "particles")
    check_count("sweeps", sweeps, "sweeps")
    for name, option, known in (("resampling", resampling, SCHEMES), ("gradient", gradient, GRADIENTS)):
        if option not in known:
            raise ValueError(f"{name}: expected one of {', '.join(known)}, got {option!r}")
    check_flag("auxiliary", auxiliary)
    check_flag("keep", keep)
    if auxiliary and guide is not None:
        raise ValueError("guide: not together with auxiliary, which is another way to look ahead")
    if auxiliary and gradient in ("soft", "transport"):
        raise ValueError(f"gradient: {gradient!r} is another way to resample than auxiliary's")
    check_share("threshold", threshold)
    check_share("alpha", alpha)
    check_positive("alpha", alpha, scalar=True)
    check_positive("epsilon", epsilon, scalar=True)
    model = as_nonlinear(model)
    options = _Options(count, resampling, auxiliary, gradient, sweeps, keep)
    if guide is not None:
        check_callable("guide", guide)
    inner = None if guide is None else guide(model)
    if inner is not None:
        check_filter(inner, "guide")
    if inner is not None and (inner.moments is None or inner.with_moments is None):
        raise ValueError("guide: needs a filter with moments and with_moments")
    params = _Params(model, inner, threshold, alpha, epsilon, Static(options))
    return bind(params, _init, _predict, _update, _moments)


def check_count(name: str, count: Any, of: str) -> None:
    """Raises a ValueError if ``count`` is no whole number >= 1."""
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise ValueError(f"{name}: expected a whole number of {of} >= 1, got {count!r}")


def check_share(name: str, share: Any) -> None:
    """Raises a ValueError if ``share`` is concrete and not in [0, 1]."""
    check_positive(name, share, zero=True, scalar=True)
    check_positive(f"1 - {name}", 1 - jnp.asarray(share), zero=True)


def _init(p, inp):
    N, m0 = p.options.value.count, p.model.m0
    n = m0.shape[0]
    noise = jax.random.normal(step_key(inp, 0), (N, n), m0.dtype)
    particles = m0[None, :] + noise @ chol(p.model.P0).T
    shape = (N, n, n) if callable(p.model.Q) else (n, n)
    predicted = p.model.h(particles[0], inp.u, inp.dt)
    check_measurement(inp, predicted.shape[0], "the model's h")
    return ParticleState(particles, _equal(N, m0.dtype), jnp.zeros(shape, m0.dtype), jnp.arange(N, dtype=jnp.int32))


def _equal(N, dtype):
    return jnp.full((N,), -np.log(N), dtype)


def _predict(p, state, inp):
    options, model = p.options.value, p.model
    N, dtype = options.count, state.particles.dtype
    key = step_key(inp, 0)
    # After a missed step the weights need not sum to 1, and what they sum to belongs to the likelihood still to come.
    sum_before = jax.nn.logsumexp(state.log_weights)
    log_weights = state.log_weights - sum_before
    index = jnp.arange(N, dtype=jnp.int32)
    if options.auxiliary:
        origin, moved = state.particles, _move(p, state.particles, inp)
        ahead, _ = _log_likelihood(p, moved, inp, *_residuals(p, moved, inp)[1:])
        # Looking ahead rules nobody out: what seems impossible now may be where the noise moves a particle.
        largest = jnp.where(jnp.isfinite(ahead), ahead, jnp.asarray(-np.inf, dtype)).max()
        largest = jnp.where(jnp.isfinite(largest), largest, jnp.zeros((), dtype))
        ahead = jnp.where(jnp.isfinite(ahead), jnp.maximum(ahead, largest - 50), largest - 50)
        first = jax.lax.stop_gradient(log_weights + ahead)
        total = jax.nn.logsumexp(first)
        index = ancestors(first - total, key, options.scheme)
        log_weights = log_weights if options.gradient != "none" else jax.lax.stop_gradient(log_weights)
        log_weights = (log_weights - first)[index] + total - float(np.log(N))  # this is the score correction too
        origin, particles = origin[index], moved[index]
    else:
        low = is_low(effective_sample_size(log_weights), p.threshold, N)
        origin, resampled = state.particles, _equal(N, dtype)
        if options.gradient == "transport":
            moved = transport(origin, log_weights, p.epsilon, options.sweeps)
            origin = jnp.where(low, moved, origin)
        else:
            soft = soften(log_weights, p.alpha) if options.gradient == "soft" else log_weights
            drawn = ancestors(jax.lax.stop_gradient(soft), key, options.scheme)
            index = jnp.where(low, drawn, index)
            origin = origin[index]
            if options.gradient == "soft":
                resampled = resampled + (log_weights - soft)[index]
            elif options.gradient != "none":
                resampled = resampled + score_correction(log_weights, index)
        log_weights = jnp.where(low, resampled, log_weights)
        particles = _move(p, origin, inp)
    log_weights = log_weights + sum_before
    if callable(model.Q):
        spread = jax.vmap(lambda x: chol(scale_cov(covariance(model.Q, x, inp.u, inp.dt), inp.q_scale)))(origin)
    else:
        spread = chol(scale_cov(model.Q, inp.q_scale))
    state = ParticleState(particles, log_weights, spread, index)
    return state, Prediction(*_moments(p, state))


def _per_particle(p):
    """The axis of ``vmap`` for what depends on the process noise."""
    return 0 if callable(p.model.Q) else None


def _move(p, particles, inp):
    return jax.vmap(lambda x: p.model.f(x, inp.u, inp.dt))(particles)


def weighted(log_weights: Array, x: Array) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n) of weighted particles x (N, n)."""
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


def _log_likelihood(p, particles, inp, nu, usable):
    """log p(y | x) (N,) over the usable components with residuals nu (N, m), and the status."""
    model = p.model

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
    noise = jax.random.normal(step_key(inp, 1), (N, n), state.particles.dtype)
    prior = state.particles + jax.vmap(jnp.matmul, (_per_particle(p), 0))(state.spread, noise)
    before = state.log_weights - jax.nn.logsumexp(state.log_weights)
    if options.gradient == "full_score":
        prior = jax.lax.stop_gradient(prior)
    if p.guide is not None:
        particles, correction = _guided(p, state, inp, noise)
    elif options.gradient == "full_score":
        particles = prior
        correction = score_correction(
            jax.vmap(log_density, (_per_particle(p), 0))(state.spread, prior - state.particles)
        )
    else:
        particles, correction = prior, jnp.zeros((N,), prior.dtype)
    predicted, residuals, usable = _residuals(p, prior, inp)
    if p.guide is not None:  # its particles are others
        _, residuals, _ = _residuals(p, particles, inp)
    log_lik, singular = _log_likelihood(p, particles, inp, residuals, usable)

    centre = predicted[0]  # about one of them, since angles are not averaged as they are
    apart = (
        predicted - centre[None, :]
        if model.residual is None
        else jax.vmap(model.residual, (0, None))(predicted, centre)
    )
    shift, spread_y = weighted(before, apart)
    R = scale_cov(covariance(model.R, weighted(before, prior)[0], inp.u, inp.dt), inp.r_scale)
    S = sym(spread_y + R)
    y = jnp.where(usable, inp.y, centre + shift)
    nu = y - centre - shift if model.residual is None else model.residual(y, centre + shift)
    nu = jnp.where(usable, nu, jnp.zeros_like(nu))
    L = chol(decoupled(usable, S))
    nis, _, _ = likelihood(usable, L, solve_lower(L, nu))

    missed = joint = state.log_weights + log_lik + correction
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
    status = status | flag(is_low(ess, p.threshold, N), Status.LOW_ESS)
    mean, cov = weighted(log_weights, particles)
    extra = {"ess": ess}
    if options.keep:
        extra |= {"particles": particles, "log_weights": log_weights, "ancestors": state.ancestors}
    info = Info(mean, cov, nu, S, nis, log_total, status, noise_cov=R, extra=extra)
    log_weights = jnp.where(present.any(), log_weights, missed)
    return ParticleState(particles, log_weights, jnp.zeros_like(state.spread), state.ancestors), info


def _guided(p, state, inp, noise):
    """Draws from what the guide makes of each particle, and ``log p(x | x_-) - log q(x)``."""
    guide: Any = p.guide  # one with moments that can be replaced
    start = guide.init(inp)
    stop = jax.lax.stop_gradient if p.options.value.gradient == "full_score" else lambda x: x

    def one(x, L, e):
        inner, _ = guide.update(guide.with_moments(start, x, sym(L @ L.T)), inp._replace(key=None))
        mean, cov = guide.moments(inner)
        C = chol(cov)
        drawn = mean + C @ e
        # Both densities over the directions that have noise; their constants cancel.
        log_q = -0.5 * jnp.sum(jnp.where(jnp.diagonal(C) != 0, e, 0.0) ** 2) - _log_det(C)
        ok = jnp.isfinite(drawn).all() & jnp.isfinite(log_density(L, drawn - x) - log_q)
        drawn = stop(jnp.where(ok, drawn, x + L @ e))
        log_p = log_density(L, drawn - x)
        return drawn, log_p - stop(jnp.where(ok, log_q, log_p))

    return jax.vmap(one, (0, _per_particle(p), 0))(state.particles, state.spread, noise)


def log_density(L: Array, apart: Array) -> Array:
    """Of ``apart`` (n,) in N(0, L L') but for a constant, over the directions that have noise."""
    whitened = solve_lower(L, apart)
    return -0.5 * jnp.sum(whitened * whitened) - _log_det(L)


def _log_det(L):
    diagonal = jnp.diagonal(L)
    ok = diagonal != 0
    return jnp.sum(jnp.where(ok, jnp.log(jnp.where(ok, diagonal, 1.0)), 0.0))


def _moments(p, state):
    log_weights = state.log_weights - jax.nn.logsumexp(state.log_weights)
    mean, cov = weighted(log_weights, state.particles)
    noise = jax.vmap(lambda w, L: w * (L @ L.T), (0, _per_particle(p)))(jnp.exp(log_weights), state.spread)
    return mean, sym(cov + noise.sum(axis=0))
