"""A bank of whole filters side by side: which hypothesis explains the measurements best."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxfilt.core import Filter, Info, Prediction, PyTree, StepInput, aspartial, bind
from jaxfilt.filters.common import decoupled, likelihood, stack
from jaxfilt.filters.imm import _check_probabilities, _collapse, _log_probabilities, _spread, _weigh
from jaxfilt.linalg import chol, solve_lower


class BankState(NamedTuple):
    """The filters' states, group by group, and the log-probabilities of the hypotheses."""

    states: tuple[PyTree, ...]  # a group of several has a leading axis
    log_probabilities: Array  # (s,)


class _Params(NamedTuple):
    filters: tuple[Filter, ...]
    prior: Any  # (s,)
    score: Callable | None


def bank(
    filters: Sequence[Filter], *, prior: Any = None, score: Callable[[Array, Array], Array] | None = None
) -> Filter:
    """The static multiple-model estimator: s filters on the same measurements, each for one fixed hypothesis.

    The filters never mix: ``p_k(j) ~ p_{k-1}(j) Lambda_j`` with ``Lambda_j`` the likelihood of the sample in filter j.
    Mean and covariance are those of the mixture. Filters that are built alike run as one batch. For hypotheses that may
    change over time see :func:`jaxfilt.imm`.

    Info: ``innovation`` and ``innovation_cov`` are the moments of the predictive mixture, ``nis`` is formed of them,
    ``log_lik`` is the mixture's. ``extra``: ``log_probabilities`` (s,) of the hypotheses, ``means`` (s, n), and
    ``filters``, the extras of each where they have some. A bank has ``moments`` if its filters do, and a prediction
    with a cross-covariance if theirs have one, so that :func:`jaxfilt.smooth` works.

    Status: the bits of all filters; NONFINITE also where none has a finite likelihood (the probabilities then stay).

    Args:
        filters: s filters that report ``log_lik``, with states (n,) of the same meaning.
        prior: (s,) probabilities of the hypotheses; None = equal. Negative ones count as 0 under a transformation, and
            the sum is normalized.
        score: ``(mean (n,), hypothesis ()) -> ()`` log of a potential at each filter's updated mean, added to its
            log-likelihood in each step with a measurement.

    Raises:
        ValueError: no filters, a filter without ``log_lik``, states or measurements of different size, (concrete)
            probabilities that are negative or do not sum to 1.
        TypeError: what is no Filter.

    Source: Magill 1965; Bar-Shalom, Li and Kirubarajan 2001, section 11.6.2.
    """
    filters = tuple(filters) if isinstance(filters, tuple | list) and not isinstance(filters, Filter) else ()
    if not filters or not all(isinstance(f, Filter) for f in filters):
        raise TypeError("filters: expected a tuple of one or more Filters")
    s = len(filters)
    prior = (1 / s,) * s if prior is None else prior
    _check_probabilities("prior", prior, (s,))
    has_moments = all(f.moments is not None for f in filters)
    params = _Params(filters, prior, None if score is None else aspartial(score, "score"))
    return bind(params, _init, _predict, _update, _moments if has_moments else None)


def _groups(filters) -> list[list[int]]:
    """The filters' numbers, those of equal structure together."""
    groups: dict[Any, list[int]] = {}
    for j, f in enumerate(filters):
        leaves, structure = jax.tree.flatten(f)
        groups.setdefault((structure, tuple(jnp.shape(leaf) for leaf in leaves)), []).append(j)
    return list(groups.values())


def _keys(inp, group):
    """The step's input for a group: its members differ in their random keys only."""
    if inp.key is None:
        return inp, None
    keys = jax.vmap(jax.random.fold_in, (None, 0))(inp.key, jnp.asarray(group))
    return inp._replace(key=keys), StepInput(None, key=0)  # pyright: ignore[reportArgumentType]


def _run(p, what, dtype, inp, states=None):
    """``[filter.what(state, inp)]``, a stacked result for each group."""
    out = []
    for i, group in enumerate(_groups(p.filters)):
        rest = () if states is None else (states[i],)
        if len(group) == 1:
            f = p.filters[group[0]]
            key = None if inp.key is None else jax.random.fold_in(inp.key, group[0])
            out.append(jax.tree.map(lambda x: x[None], getattr(f, what)(*_first(rest), inp._replace(key=key))))
            continue
        stacked = stack([p.filters[j] for j in group], dtype)
        keyed, axes = _keys(inp, group)
        call = jax.vmap(lambda f, *a: getattr(f, what)(*a), (0, *(0 for _ in rest), axes))
        out.append(call(stacked, *rest, keyed))
    return tuple(out)


def _first(rest):
    return jax.tree.map(lambda x: x[0], rest)


def _member(groups, results, j):
    """Filter j's part of the results by group."""
    for group, result in zip(groups, results, strict=True):
        if j in group:
            at = group.index(j)
            return jax.tree.map(lambda x, at=at: x[at], result)
    raise AssertionError


def _each(p, results):
    groups = _groups(p.filters)
    return [_member(groups, results, j) for j in range(len(p.filters))]


def _together(p, results) -> Any:
    """(s, ...) of an array that each filter has, or None where one has not."""
    if len(results) == 1:  # all are built alike
        return results[0]
    parts = _each(p, results)
    if any(part is None for part in parts):
        return None
    if len({part.shape for part in parts}) > 1:
        raise ValueError(f"filters: expected states of one size, got {[part.shape for part in parts]}")
    return jnp.stack(parts)


def _init(p, inp):
    states = _run(p, "init", inp.y.dtype, inp)
    return BankState(states, _log_probabilities(p.prior, inp.y.dtype))


def _all_moments(p, state, dtype):
    moments = []
    for group, s in zip(_groups(p.filters), state.states, strict=True):
        if len(group) == 1:
            found = p.filters[group[0]].moments(_first(s))
            moments.append(jax.tree.map(lambda x: x[None], found))
        else:
            stacked = stack([p.filters[j] for j in group], dtype)
            moments.append(jax.vmap(lambda f, a: f.moments(a))(stacked, s))
    return _together(p, [m for m, _ in moments]), _together(p, [c for _, c in moments])


def _predict(p, state, inp):
    results = _run(p, "predict", inp.y.dtype, inp, state.states)
    predictions = [prediction for _, prediction in results]
    weights = jnp.exp(state.log_probabilities)
    X = _together(p, [prediction.mean for prediction in predictions])
    P, C = (_together(p, [getattr(q, name) for q in predictions]) for name in ("cov", "cross"))
    mean = weights @ X
    cov = None if P is None else _spread(weights, X - mean[None, :], P)
    cross = None
    if C is not None and all(f.moments is not None for f in p.filters):
        before, _ = _all_moments(p, state, inp.y.dtype)
        apart = before - (weights @ before)[None, :]
        cross = jnp.einsum("i,iab->ab", weights, C + apart[:, :, None] * (X - mean[None, :])[:, None, :])
    states = tuple(s for s, _ in results)
    return BankState(states, state.log_probabilities), Prediction(mean, cov, cross)


def _update(p, state, inp):
    results = _run(p, "update", inp.y.dtype, inp, state.states)
    infos = [info for _, info in results]
    for group, info in zip(_groups(p.filters), infos, strict=True):
        if info.log_lik is None:
            raise ValueError(f"filters[{group[0]}]: reports no log_lik, so its hypothesis cannot be weighted")

    def together(name):
        return _together(p, [getattr(info, name) for info in infos])

    X, P, nu, log_liks, words = (together(name) for name in ("mean", "cov", "innovation", "log_lik", "status"))
    if p.score is not None:
        seen = jnp.isfinite(inp.y).any() if inp.mask is None else (jnp.isfinite(inp.y) & inp.mask).any()
        scores = jax.vmap(p.score)(X, jnp.arange(len(X), dtype=jnp.int32))
        log_liks = log_liks + jnp.where(seen, scores, jnp.zeros_like(scores))
    before = state.log_probabilities
    log_p, log_lik, status = _weigh(before, log_liks, inp.mask)
    for word in words:
        status = status | word
    mean, cov = jnp.exp(log_p) @ X, None
    if P is not None:
        mean, cov = _collapse(jnp.exp(log_p), X, P)
    c = jnp.exp(before)
    innovation = c @ nu
    each_S, noise = together("innovation_cov"), together("noise_cov")
    S = nis = None
    if each_S is not None:
        S = _spread(c, nu - innovation[None, :], each_S)
        L = chol(decoupled(inp.mask, S))
        nis, _, _ = likelihood(inp.mask, L, solve_lower(L, innovation))
    noise = None if noise is None else jnp.einsum("i,iab->ab", c, noise)
    extra: dict[str, PyTree] = {"log_probabilities": log_p, "means": X}
    if any(info.extra for info in infos):
        extra["filters"] = tuple(_each(p, [info.extra for info in infos]))
    info = Info(mean, cov, innovation, S, nis, log_lik, status, noise_cov=noise, extra=extra)
    return BankState(tuple(s for s, _ in results), log_p), info


def _moments(p, state):
    X, P = _all_moments(p, state, state.log_probabilities.dtype)
    return _collapse(jnp.exp(state.log_probabilities), X, P)
