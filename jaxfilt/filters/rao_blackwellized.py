"""The Rao-Blackwellized particle filter over a discrete mode: particles carry a mode and a Gaussian filter's state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import Filter, Info, Prediction, PyTree, Static, Status, bind, check_flag, flag
from jaxfilt.filters.common import decoupled, likelihood, stack, step_key
from jaxfilt.filters.imm import (
    _check_index,
    _check_probabilities,
    _collapse,
    _lift,
    _log_probabilities,
    _mix,
    _never,
    _spread,
    _union,
)
from jaxfilt.filters.particle import check_count, check_share
from jaxfilt.filters.resampling import SCHEMES, _at, ancestors, effective_sample_size, is_low, score_correction
from jaxfilt.linalg import chol, solve_lower
from jaxfilt.models.linear import common_dtype


class RaoBlackwellizedState(NamedTuple):
    """N particles with r hypotheses each: the state of every filter, as if its mode were in force."""

    states: tuple[PyTree, ...]  # r filters' states, each with a leading N
    log_joint: Array  # (N, r) log-weights of particles and modes; after update all but the drawn mode's are never
    modes: Array  # (N,) int32, drawn
    ancestors: Array  # (N,) int32


class _Options(NamedTuple):
    count: int
    index: tuple[tuple[int, ...], ...] | None
    mixing: str
    proposal: str
    scheme: str
    keep: bool


class _Params(NamedTuple):
    filters: tuple[Filter, ...]
    transition: Any  # (r, r)
    mu0: Any  # (r,)
    threshold: Any  # ()
    options: Static


def rao_blackwellized(
    filters: Sequence[Filter],
    transition: Any,
    count: int,
    *,
    mu0: Any = None,
    index: Sequence[Sequence[int]] | None = None,
    mixing: str = "own",
    proposal: str = "optimal",
    resampling: str = "systematic",
    threshold: Any = 0.5,
    keep: bool = False,
) -> Filter:
    """A particle filter over the modes of a Markov chain alone, with a Gaussian filter in each particle.

    Where :func:`jaxfilt.imm` merges the r^2 hypotheses of each step into r, this filter keeps ``count`` histories of
    modes, drawn by their probability. Given its history a particle's state is what the filters make of it, without any
    sampling: exact for linear-Gaussian modes, for which ``exp(sum of log_lik)`` is an unbiased estimate of the series'
    likelihood.

    Predict: resample if the effective sample size is below ``threshold`` times ``count``, then every filter predicts
    from every particle. Update: all r filters see the sample. ``"optimal"``: each particle's mode is drawn by its
    posterior, ``pi_mj Lambda_j``, and its weight grows by their sum. ``"prior"``: drawn by ``pi_mj``, weighted by the
    drawn mode's likelihood; no cheaper here, and never better. Moments and mode probabilities are reported before the
    draw, of all ``count r`` hypotheses that have a weight.

    Filters may differ in kind, and in the size of their states, as in :func:`jaxfilt.imm`: the particle's moments go
    from its mode to every filter before the prediction, memories of wrappers stay with each filter. Filters of equal
    structure are run as one, which compiles faster. Gradients of ``log_lik`` have the score correction (see
    :func:`jaxfilt.particle`) for the choice of ancestors and of modes.

    Random: ``jf.filter(..., key=)`` is needed; under ``vmap`` over series give each its own. Info: as an IMM's;
    ``extra["mode_probabilities"]`` (r,), ``extra["ess"]`` () after the update; with ``keep`` ``extra["modes"]`` (N,),
    ``extra["log_weights"]`` (N,), ``extra["ancestors"]`` (N,). No cross-covariance: not for :func:`jaxfilt.smooth`.

    Status: the bits of all filters in all particles; LOW_ESS; NONFINITE also where no hypothesis has a finite
    likelihood (the weights are then kept).

    Args:
        filters: r filters with ``moments`` and ``with_moments`` that report ``log_lik`` and draw nothing themselves.
        transition: (r, r) ``pi_ij``, probability of mode j after mode i; rows sum to 1. A leaf, as ``mu0``.
        count: number of particles N, static.
        mu0: (r,) probabilities of the modes at the start; None = equal.
        index: as in :func:`jaxfilt.imm`.
        mixing: as in :func:`jaxfilt.imm`.
        proposal: ``"optimal"`` or ``"prior"``.
        resampling: ``"systematic"``, ``"stratified"``, ``"multinomial"`` or ``"residual"``.
        threshold: share of N in [0, 1]; 1 resamples in every step, 0 never. May be traced.
        keep: report modes, weights and ancestors.

    Raises:
        ValueError: count < 1, a filter that lacks what is asked for, wrong shapes, (concrete) probabilities that are
            negative or do not sum to 1, an index with repeated positions or gaps, an unknown option, a threshold
            outside [0, 1]; at trace time, no key.
        TypeError: integer arrays, another float dtype than the filters', or what is no Filter.

    Source: Chen and Liu 2000; Doucet, Gordon and Krishnamurthy 2001.
    """
    filters = tuple(filters) if isinstance(filters, tuple | list) and not isinstance(filters, Filter) else ()
    if not filters or not all(isinstance(f, Filter) for f in filters):
        raise TypeError("filters: expected a tuple of one or more Filters")
    r = len(filters)
    for j, f in enumerate(filters):
        lacking = [name for name in ("moments", "with_moments") if getattr(f, name) is None]
        if lacking:
            raise ValueError(f"filters[{j}]: has no {' and no '.join(lacking)}, so a particle cannot enter its mode")
    check_count("count", count, "particles")
    if mu0 is None:
        mu0 = (1 / r,) * r
    common_dtype({"transition": transition, "mu0": mu0})
    _check_probabilities("transition", transition, (r, r))
    _check_probabilities("mu0", mu0, (r,))
    check_share("threshold", threshold)
    check_flag("keep", keep)
    for name, option, known in (
        ("mixing", mixing, ("own", "zero")),
        ("proposal", proposal, ("optimal", "prior")),
        ("resampling", resampling, SCHEMES),
    ):
        if option not in known:
            raise ValueError(f"{name}: expected one of {', '.join(known)}, got {option!r}")
    index = None if index is None else _check_index(index, r)
    options = _Options(count, index, mixing, proposal, resampling, keep)
    params = _Params(filters, transition, mu0, threshold, Static(options))
    return bind(params, _init, _predict, _update, _moments)


def _without_key(inp):
    return inp._replace(key=None)  # one that draws would give all particles the same draw


def _each(filters, dtype, fn, *trees):
    """``fn(filter, *one of each tree)`` for every filter; one ``vmap`` where all are of the same structure."""
    jobs = [(f, *rest) for f, *rest in zip(filters, *trees, strict=True)]
    flat = [jax.tree.flatten(job) for job in jobs]
    leaves, structure = [leaf for leaf, _ in flat], flat[0][1]
    alike = all(tree == structure for _, tree in flat) and all(
        len({(jnp.shape(leaf), jnp.result_type(leaf)) for leaf in same}) == 1 for same in zip(*leaves, strict=True)
    )
    if len(jobs) == 1 or not alike:
        return [fn(*job) for job in jobs]

    out = jax.vmap(lambda job: fn(*job))(stack(jobs, dtype))
    return [jax.tree.map(lambda leaf, j=j: leaf[j], out) for j in range(len(jobs))]


def _lifted(p, states):
    """The union, means (r, N, n) and covariances (r, N, n, n) of all hypotheses in it."""
    moments = [jax.vmap(f.moments)(s) for f, s in zip(p.filters, states, strict=True)]
    union = _union(p.options.value.index, tuple(mean.shape[1] for mean, _ in moments))

    def lift(*arrays):
        return _lift(union, arrays)

    X = jax.vmap(lift, out_axes=1)(*[mean for mean, _ in moments])
    return union, X, jax.vmap(lift, out_axes=1)(*[cov for _, cov in moments])


def _starts(p, states, modes):
    """Means (N, n_j) and covariances (N, n_j, n_j) with which each filter goes on from the particles' own modes."""
    union, X, P = _lifted(p, states)
    if union.has.all() and all((at == np.arange(X.shape[2])).all() for at in union.index):
        each = jnp.arange(len(modes))
        return [(X[modes, each], P[modes, each])] * len(X)
    own = jax.nn.one_hot(modes, len(X), dtype=X.dtype)

    def mix(j):
        return jax.vmap(lambda w, X, P: _mix(union, p.options.value.mixing, w, X, P, j)[:2], (0, 1, 1))(own, X, P)

    return [mix(j) for j in range(len(X))]


def _mixture(log_joint, X, P):
    """Mean and covariance over all hypotheses; ``log_joint`` (N, r) is normalized."""
    n = X.shape[-1]
    return _collapse(jnp.exp(log_joint).T.reshape(-1), X.reshape(-1, n), P.reshape(-1, n, n))


def _init(p, inp):
    N, r = p.options.value.count, len(p.filters)
    key = step_key(inp, 0)
    alone = [f.init(_without_key(inp)) for f in p.filters]
    states = tuple(jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (N, *jnp.shape(leaf))), s) for s in alone)
    _, X, _ = _lifted(p, states)
    dtype = X.dtype
    for name in ("transition", "mu0"):
        for leaf in jax.tree.leaves(getattr(p, name)):
            strong = hasattr(leaf, "dtype") and not getattr(leaf, "weak_type", False)
            if strong and jax.dtypes.canonicalize_dtype(leaf.dtype) != dtype:
                raise TypeError(f"{name}: is {leaf.dtype}, but the filters are {dtype}; convert one of them")
    log_mu = _log_probabilities(p.mu0, dtype)
    # Equidistant points, so that each mode starts with its share of the particles; which ones does not matter.
    points = (jnp.arange(N, dtype=dtype) + jax.random.uniform(key, (), dtype)) / N
    modes = _at(jnp.exp(log_mu), points)
    log_joint = jnp.broadcast_to(log_mu[None, :], (N, r)) - jnp.log(jnp.asarray(N, dtype))
    return RaoBlackwellizedState(states, log_joint, modes, jnp.arange(N, dtype=jnp.int32))


def _predict(p, state, inp):
    options, dtype = p.options.value, state.log_joint.dtype
    N = options.count
    log_weights = jax.nn.logsumexp(state.log_joint, axis=1)
    # After a missed step the weights need not sum to 1 for a gradient, and it belongs to the likelihood still to come.
    sum_before = jax.nn.logsumexp(log_weights)
    log_weights = log_weights - sum_before
    low = is_low(effective_sample_size(log_weights), p.threshold, N)
    index = ancestors(jax.lax.stop_gradient(log_weights), step_key(inp, 0), options.scheme)
    index = jnp.where(low, index, jnp.arange(N, dtype=jnp.int32))
    resampled = -jnp.log(jnp.asarray(N, dtype)) + score_correction(log_weights, index)
    log_weights = jnp.where(low, resampled, log_weights) + sum_before
    modes, states = state.modes[index], jax.tree.map(lambda leaf: leaf[index], state.states)

    starts = _starts(p, states, modes)

    def move(f, states, start):
        one = lambda s, mean, cov: f.predict(f.with_moments(s, mean, cov), _without_key(inp))[0]  # noqa: E731
        return jax.vmap(one)(states, *start)

    states = tuple(_each(p.filters, dtype, move, states, starts))
    log_joint = log_weights[:, None] + _log_probabilities(p.transition, dtype)[modes]
    state = RaoBlackwellizedState(states, log_joint, modes, index)
    return state, Prediction(*_moments(p, state))


def _drawn(log_joint, key):
    """Draws a mode for each particle: ``(modes (N,), log_joint)`` with the particle's whole weight on it."""
    log_weights = jax.nn.logsumexp(log_joint, axis=1)
    modes = jax.random.categorical(key, jax.lax.stop_gradient(log_joint), axis=1).astype(jnp.int32)
    taken = jax.nn.one_hot(modes, log_joint.shape[1], dtype=bool)
    chance = jnp.take_along_axis(log_joint - log_weights[:, None], modes[:, None], axis=1)
    weight = log_weights[:, None] + score_correction(chance)
    return modes, jnp.where(taken, weight, jnp.asarray(_never(log_joint.dtype), log_joint.dtype))


def _update(p, state, inp):
    options, dtype = p.options.value, state.log_joint.dtype
    N, _ = state.log_joint.shape
    never = jnp.asarray(_never(dtype), dtype)

    def see(f, states):
        return jax.vmap(lambda s: f.update(s, _without_key(inp)))(states)

    results = _each(p.filters, dtype, see, state.states)
    states, infos = tuple(s for s, _ in results), [info for _, info in results]
    for j, info in enumerate(infos):
        if info.log_lik is None:
            raise ValueError(f"filters[{j}]: reports no log_lik, so its mode cannot be weighted")
    log_liks = jnp.stack([info.log_lik for info in infos], axis=1)  # (N, r)

    prior, modes = state.log_joint, state.modes
    before = posterior = prior - jax.nn.logsumexp(prior)
    if options.proposal == "prior":
        modes, prior = _drawn(prior, step_key(inp, 1))
        posterior = prior - jax.nn.logsumexp(prior)
    finite = jnp.isfinite(log_liks)
    joint = jnp.maximum(prior + jnp.where(finite, log_liks, never), never)
    largest = jax.lax.stop_gradient(joint.max())
    total = largest + jax.nn.logsumexp(joint - largest)
    alive = finite.any() & (largest > never)
    present = jnp.ones(inp.y.shape, bool) if inp.mask is None else inp.mask
    told = alive & present.any()
    joint = jnp.maximum(joint - total, never)
    posterior, after = jnp.where(told, joint, posterior), jnp.where(told, joint, prior)
    log_lik = jnp.where(present.any(), total, jnp.zeros((), dtype))
    _, X, P = _lifted(p, states)
    mean, cov = _mixture(posterior, X, P)
    if options.proposal == "optimal":
        modes, after = _drawn(after, step_key(inp, 1))
    log_weights = jax.nn.logsumexp(posterior, axis=1)
    ess = effective_sample_size(log_weights)

    status = flag(~alive, Status.NONFINITE) | flag(is_low(ess, p.threshold, N), Status.LOW_ESS)
    for info in infos:
        status = status | jax.lax.reduce(info.status, jnp.int32(0), jax.lax.bitwise_or, (0,))
    c = jnp.exp(before).T.reshape(-1)
    nu = jnp.stack([info.innovation for info in infos]).reshape(c.shape[0], -1)
    innovation, S, nis, noise = c @ nu, None, None, None
    if all(info.innovation_cov is not None for info in infos):
        covs = jnp.stack([info.innovation_cov for info in infos]).reshape(*nu.shape, -1)
        S = _spread(c, nu - innovation[None, :], covs)
        nis, _, _ = likelihood(inp.mask, L := chol(decoupled(inp.mask, S)), solve_lower(L, innovation))
    if all(info.noise_cov is not None for info in infos):
        noise = jnp.einsum("i,iab->ab", c, jnp.stack([info.noise_cov for info in infos]).reshape(*nu.shape, -1))
    extra = {"mode_probabilities": jnp.exp(jax.nn.logsumexp(posterior, axis=0)), "ess": ess}
    if options.keep:
        extra |= {"modes": modes, "log_weights": log_weights, "ancestors": state.ancestors}
    info = Info(mean, cov, innovation, S, nis, log_lik, status, noise_cov=noise, extra=extra)
    return RaoBlackwellizedState(states, after, modes, state.ancestors), info


def _moments(p, state):
    _, X, P = _lifted(p, state.states)
    return _mixture(state.log_joint - jax.nn.logsumexp(state.log_joint), X, P)
