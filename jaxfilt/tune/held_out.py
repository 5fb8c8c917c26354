"""A loss for lost measurements: real samples are hidden in artificial gaps and scored by the filter's prediction."""

from __future__ import annotations

from typing import NamedTuple, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt import core
from jaxfilt.core import Filter, Status
from jaxfilt.linalg import chol, solve_lower
from jaxfilt.tune.batch import Options, any_present, batch_shape, dt_axis, full_mask, run_keys, weighted_mean


def masked_nll(
    filt: Filter,
    ys: Array,
    key: Array,
    *,
    length: tuple[int, int],
    warmup: int = 1,
    **options: Unpack[Options],
) -> Array:
    """Predictive negative log-likelihood of samples hidden in artificial gaps: how well a filter bridges a loss.

    Each run gets one gap of random start and length. Every real sample in the gap, and the first after it, is scored
    under the filter's density for it, given the samples before the gap: horizons 1, 2, ..., length + 1.

    * Inside the gap the density is that of the state which the filter reports there, ``N(h(mean), H cov H' + R)``, so
      wrappers that fill the gap with pseudo-measurements are scored by what they make of it. A wrapper that reports a
      measurement, ``Info.extra["reported"]`` (:func:`jaxfilt.blend`), is scored by that, with the filter's covariance.
    * For the first sample after the gap, and for filters without ``with_moments`` (IMM), it is the prediction.
    * A sample that a gate refuses is scored all the same, as a Gaussian.

    Args:
        filt: the filter; it must define ``log_lik`` and ``innovation_cov``.
        ys: (B, T, m) measurements.
        key: random key of the gaps (run i: :func:`random_gap` of ``fold_in(fold_in(key, i), 0)``) and of the filter.
        length: shortest and longest gap, in samples.
        warmup: first samples of each run that no gap touches.
        **options: see :class:`Options`. Samples that ``mask`` calls missing are not scored.

    Returns:
        () in nats per scored sample, the constant ``m log(2 pi) / 2`` kept; infinite if nothing is scored.

    Raises:
        ValueError: gaps that do not fit, a filter without likelihood, or wrong shapes.
    """
    core.check_filter(filt)
    runs, T, _ = batch_shape(ys)
    dt, u, u_axis = (options.get(name) for name in ("dt", "u", "u_axis"))
    keys = run_keys(key, runs)
    gaps = jax.vmap(lambda k: random_gap(jax.random.fold_in(k, 0), T, length=length, warmup=warmup))(keys)
    real = jnp.broadcast_to(full_mask(ys, options.get("mask")), ys.shape)
    draws = jax.vmap(jax.random.fold_in, (0, None))(keys, 1)
    scored = _held_out(filt)

    def one(y, real, gap, dt, u, key):
        given = {"mask": real & ~gap[:, None], "dt": dt, "u": (real, u), "key": key}
        first_update_only = options.get("first_update_only", False)
        return core.filter(scored, y, **given, outputs=_held_out_log_lik, first_update_only=first_update_only)

    log_lik = jax.vmap(one, (0, 0, 0, dt_axis(dt), u_axis, 0))(ys, real, gaps, dt, u, draws)
    first_after = jnp.concatenate([jnp.zeros((runs, 1), bool), gaps[:, :-1] & ~gaps[:, 1:]], axis=1)
    return weighted_mean(-log_lik, (gaps | first_after) & any_present(ys, options.get("mask"), 0))


def random_gap(key: Array, T: int, *, length: tuple[int, int], warmup: int = 1) -> Array:
    """A random segment (T,) bool, True inside: uniform length in ``[length[0], length[1]]``, then uniform start.

    It begins at ``warmup`` or later and ends before the last sample.

    Raises:
        ValueError: if the longest gap does not fit.
    """
    core.check_key(key)
    core.check_count("T", T, 1)
    if not isinstance(length, tuple | list) or len(length) != 2:
        raise ValueError(f"length: expected (shortest, longest), got {length!r}")
    shortest, longest = length
    for end in length:
        core.check_count("length", end, 1)
    core.check_count("warmup", warmup, 0)
    if not 1 <= shortest <= longest:
        raise ValueError(f"length: expected 1 <= shortest <= longest, got {length}")
    if warmup < 0 or warmup + longest >= T:
        raise ValueError(f"warmup: {warmup} samples and a gap of {longest} do not fit into T = {T} with one to follow")
    length_key, start_key = jax.random.split(key)
    n = jax.random.randint(length_key, (), shortest, longest + 1, jnp.int32)
    start = jax.random.randint(start_key, (), jnp.int32(warmup), jnp.int32(T) - n, jnp.int32)
    k = jnp.arange(T, dtype=jnp.int32)
    return (k >= start) & (k < start + n)


class _HeldOut(NamedTuple):
    inner: Filter


def _held_out(filt):
    """A wrapper that scores each real sample by a filter which is told only of those in ``inp.mask``.

    The real samples' mask travels in ``inp.u = (real, u)``. ``update`` is pure, so the score is a dry run: the wrapped
    filter meets the hidden sample as a present one, and the state that comes of it is dropped.
    """
    return core.wrap(_HeldOut(filt), init=_held_out_init, predict=_held_out_predict, update=_held_out_update)


def _held_out_init(p, inp):
    return core.Wrapped(p.inner.init(inp._replace(u=inp.u[1])))


def _held_out_predict(p, s, inp):
    inner, prediction = p.inner.predict(s.inner, inp._replace(u=inp.u[1]))
    return s._replace(inner=inner), prediction


def _held_out_update(p, s, inp):
    real, u = inp.u
    inp = inp._replace(u=u)
    inner, info = p.inner.update(s.inner, inp)
    hidden = real.any() & ~inp.mask.any()
    # What the filter believes without the sample: inside the gap what it reports, otherwise its prediction.
    before = s.inner
    if p.inner.with_moments is not None and info.cov is not None:
        told = p.inner.with_moments(before, info.mean, info.cov)
        before = jax.tree.map(lambda a, b: jnp.where(hidden, a, b), told, before)
    _, dry = p.inner.update(before, inp._replace(mask=real))
    if dry.log_lik is None or dry.innovation_cov is None:
        raise ValueError("filt: masked_nll needs a filter with log_lik and innovation_cov")
    innovation = dry.innovation
    as_gaussian = (dry.status & jnp.int32(int(Status.GATED))) != jnp.int32(0)
    if "reported" in info.extra:
        innovation = jnp.where(hidden, inp.y - info.extra["reported"], innovation)
        as_gaussian = as_gaussian | hidden
    score = jnp.where(as_gaussian, _gaussian_log_density(innovation, dry.innovation_cov, real), dry.log_lik)
    return s._replace(inner=inner), info._replace(extra={**info.extra, "held_out_log_lik": score})


def _held_out_log_lik(state, info):
    del state
    return info.extra["held_out_log_lik"]


def _gaussian_log_density(nu, S, mask):
    """Log density of the present components of nu (m,) under N(0, S)."""
    L = chol(jnp.where(mask[:, None] & mask[None, :], S, jnp.eye(len(nu), dtype=S.dtype)))
    pivots = jnp.diagonal(L)
    log_pivots = jnp.log(jnp.where(pivots > 0, pivots, jnp.ones_like(pivots)))
    x = solve_lower(L, jnp.where(mask, nu, jnp.zeros_like(nu)))
    count = jnp.sum(mask.astype(S.dtype))
    return -0.5 * (jnp.sum(x * x) + count * np.log(2.0 * np.pi).item()) - jnp.sum(log_pivots)
