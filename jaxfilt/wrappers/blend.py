"""Reporting a position inside a gap: the filter's and the fits', weighted by how well each has predicted before."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxfilt.core import Filter, PyTree, Static, Wrapped, multiply, present, wrap
from jaxfilt.models.linear import check_positive
from jaxfilt.wrappers.common import check_count, covariances, predict_measurement
from jaxfilt.wrappers.window import Window, advance, check_fit, empty, extrapolate, push, select


class Memory(NamedTuple):
    """What the wrapper carries.

    The ghosts answer what the filter, had it lost the target h steps ago, would expect now: ghost i is the posterior of
    i steps ago, predicted since but never updated. The fits of h steps ago need no memory of their own: they are made
    anew from the samples that are old enough.
    """

    window: Window
    ghosts: PyTree  # the inner filter's states, leading h
    squares: Array  # (J, C + 1, m) squared errors of the last J backtests: filter, then fits
    ratios: Array  # (J, m) the filter's squared error over the variance that it claimed
    tests: Array  # (m,) int32, backtests so far, at most J


class _Options(NamedTuple):
    candidates: tuple[tuple[int, int], ...]
    horizon: int
    origins: int


class _Params(NamedTuple):
    inner: Filter
    exponent: Any  # ()
    floor: Any  # ()
    options: Static


def blend(
    filt: Filter,
    *,
    candidates: Sequence[tuple[int, int]] = ((10, 1), (20, 2)),
    horizon: int = 5,
    origins: int = 6,
    exponent: Any = 2.0,
    floor: Any = 0.25,
) -> Filter:
    """Reports, inside a gap, a weighted mean of the coasting filter and polynomial fits, and feeds nothing back.

    Every real sample is a backtest: what would the coasting filter (c = 0) and the fits (c >= 1) have predicted for it
    from the data up to ``horizon`` steps before? Over the last J = ``origins`` backtests, per channel::

        risk_c = mean_j (z_j - zhat_c,j)^2,     w_c ~ max(risk_c, floor R)^-exponent
        s = max(1, mean_j e_0j^2 / S_j)

    with ``e_0``, ``S`` the innovation of the filter of ``horizon`` steps ago and the variance ``H P H' + R`` it claims.
    In a step with no measurement at all the filter is predicted with ``s^2 Q``, s the mean over channels. A channel
    with fewer than J backtests has all its weight on the filter, and does not count in s.

    Info: ``mean`` and ``cov`` are the filter's. ``extra["reported"]`` (m,) is the blend, in measurement space: where
    the component is absent ``sum_c w_c zhat_c``, where present the measurement that the posterior expects.
    ``extra["weights"]`` (C + 1, m) are the w_c. No status bit of its own: nothing invented enters the filter.

    s depends on each run's data, so a batch with a mask has covariances per run, unlike with the other wrappers.

    Args:
        filt: the filter; must report innovation_cov and noise_cov, and honor ``q_scale``.
        candidates: fits as (window, degree), e.g. 10 samples and a line.
        horizon: h of the backtests, in steps; about the length of the gaps to bridge.
        origins: J.
        exponent: of the risks, > 0. May be traced, like ``floor``.
        floor: of the risks as a fraction of R, >= 0; keeps luck in few backtests from deciding.

    Raises:
        ValueError: no candidates, a window < 1, a degree < 0 or >= its window, horizon or origins < 1, exponent <= 0,
            floor < 0; at trace time, a filter without innovation_cov or noise_cov.
    """
    if not isinstance(candidates, Sequence):
        raise TypeError(f"candidates: expected pairs (window, degree), got {candidates!r}")
    pairs = all(isinstance(candidate, Sequence) and len(candidate) == 2 for candidate in candidates)
    if not candidates or not pairs:
        raise ValueError(f"candidates: expected pairs (window, degree), got {candidates}")
    candidates = tuple((window, degree) for window, degree in candidates)
    for window, degree in candidates:
        try:
            check_fit(window, degree, 1.0, None)
        except ValueError as error:
            raise ValueError(f"candidates: ({window}, {degree}): {error}") from None
    check_count("horizon", horizon, 1)
    check_count("origins", origins, 1)
    check_positive("exponent", exponent, scalar=True)
    check_positive("floor", floor, zero=True, scalar=True)
    params = _Params(filt, exponent, floor, Static(_Options(candidates, horizon, origins)))
    return wrap(params, init=_init, predict=_predict, update=_update)


def _init(p, inp):
    options = p.options.value
    inner = p.inner.init(inp)
    m = inp.y.shape[0]
    # As of h steps ago the newest h - 1 samples are left out, so so many more are kept.
    window = empty(max(window for window, _ in options.candidates) + options.horizon - 1, inp.y)
    ghosts = jax.tree.map(lambda x: jnp.broadcast_to(x[None], (options.horizon, *x.shape)), inner)
    squares = jnp.zeros((options.origins, len(options.candidates) + 1, m), inp.y.dtype)
    return Wrapped(inner, Memory(window, ghosts, squares, squares[:, 0], jnp.zeros((m,), jnp.int32)))


def _predict(p, s, inp):
    memory = s.memory
    ghosts, _ = jax.vmap(p.inner.predict, (0, None))(memory.ghosts, inp)
    memory = memory._replace(window=advance(memory.window, inp.dt), ghosts=ghosts)
    if inp.mask is not None:
        one = jnp.ones((), inp.y.dtype)
        scale = jnp.where(present(inp).any(), one, _excess(s.memory) ** 2)
        inp = inp._replace(q_scale=multiply(inp.q_scale, scale))
    inner, prediction = p.inner.predict(s.inner, inp)
    return Wrapped(inner, memory), prediction


def _update(p, s, inp):
    memory = s.memory
    mask = present(inp)
    inner, info = p.inner.update(s.inner, inp)
    coast, _ = predict_measurement(p.inner, inner, inp)
    _, noise_cov = covariances(info, "blend")
    weights = _weights(p, memory, jnp.diagonal(noise_cov))
    guesses = jnp.stack([coast, *(fit.value for fit in _fits(p, memory.window, origin=0))])
    # A channel without any sample has no fit; then it has no backtest either, and no weight on one.
    reported = jnp.where(mask, coast, jnp.sum(weights * guesses, axis=0))

    # An unmasked NaN is the filter's to report; here it is no news.
    sample = jnp.where(mask & jnp.isfinite(inp.y), inp.y, coast)
    memory = _backtest(p, memory, inp, sample, mask)
    ghosts = jax.tree.map(lambda new, old: jnp.concatenate([new[None], old[:-1]]), inner, memory.ghosts)
    memory = memory._replace(window=push(memory.window, sample, mask), ghosts=ghosts)
    return Wrapped(inner, memory), info._replace(extra={**info.extra, "reported": reported, "weights": weights})


def _fits(p, window, origin):
    """The candidates' fits as of ``origin`` steps ago, at the present."""
    fits = []
    for size, degree in p.options.value.candidates:
        used = select(window, size, 3 * size, origin)
        fits.append(extrapolate(window, used, degree))
    return fits


def _backtest(p, memory, inp, sample, mask):
    """The memory with the errors at a real sample (m,) pushed, where there were data ``horizon`` steps ago."""
    ghost = jax.tree.map(lambda x: x[-1], memory.ghosts)
    coast, dry = predict_measurement(p.inner, ghost, inp)
    fits = _fits(p, memory.window, p.options.value.horizon)
    squares = (sample[None, :] - jnp.stack([coast, *(fit.value for fit in fits)])) ** 2
    valid = mask & fits[0].available
    variance = jnp.diagonal(covariances(dry, "blend")[0])
    positive = variance > 0
    ratio = jnp.where(positive, squares[0] / jnp.where(positive, variance, jnp.ones_like(variance)), 0.0)
    return memory._replace(
        squares=jnp.where(valid[None, None, :], jnp.concatenate([squares[None], memory.squares[:-1]]), memory.squares),
        ratios=jnp.where(valid[None, :], jnp.concatenate([ratio[None], memory.ratios[:-1]]), memory.ratios),
        tests=jnp.minimum(memory.tests + valid.astype(jnp.int32), p.options.value.origins),
    )


def _excess(memory):
    """s (), how many times the variance that the filter claims its squared errors were."""
    ready = memory.tests >= memory.ratios.shape[0]
    count = jnp.maximum(ready.sum(), 1).astype(memory.ratios.dtype)
    mean = jnp.sum(jnp.where(ready, jnp.mean(memory.ratios, axis=0), 0.0)) / count
    return jnp.maximum(mean, jnp.ones_like(mean))


def _weights(p, memory, variance):
    """w (C + 1, m), from the risks and the measurement variances (m,); in logs, so that nothing overflows."""
    dtype = variance.dtype
    floor = jnp.maximum(jnp.asarray(p.floor, dtype) * variance, jnp.finfo(dtype).tiny)
    risk = jnp.maximum(jnp.mean(memory.squares, axis=0), floor[None, :])
    weights = jax.nn.softmax(-jnp.asarray(p.exponent, dtype) * jnp.log(risk), axis=0)
    ready = memory.tests >= memory.ratios.shape[0]
    coast = (jnp.arange(weights.shape[0]) == 0).astype(dtype)
    return jnp.where(ready[None, :], weights, coast[:, None])
