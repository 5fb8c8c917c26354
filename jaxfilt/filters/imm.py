"""The interacting multiple model estimator over any filters, also with states of different size."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import (
    Filter,
    Info,
    Prediction,
    PyTree,
    Static,
    Status,
    StepInput,
    bind,
    flag,
    is_concrete,
    real_array,
)
from jaxfilt.filters.common import decoupled, likelihood
from jaxfilt.linalg import chol, solve_chol, solve_lower, sym
from jaxfilt.models.linear import common_dtype


class ImmState(NamedTuple):
    """The filters' states, and the logarithms of the mode probabilities."""

    states: tuple[PyTree, ...]
    log_mu: Array  # (r,) after predict: of the predicted probabilities c


class _Options(NamedTuple):
    index: tuple[tuple[int, ...], ...] | None
    mixing: str
    missed: str


class _Params(NamedTuple):
    filters: tuple[Filter, ...]
    transition: Any  # (r, r)
    mu0: Any  # (r,)
    options: Static


class _Union(NamedTuple):
    """Where the models' components stand in the union of their states."""

    index: tuple[np.ndarray, ...]  # positions in the union, per model
    source: tuple[np.ndarray, ...]  # per model (N,): which of its components, or n_j where it has none
    has: np.ndarray  # (r, N) bool


def imm(
    filters: Sequence[Filter],
    transition: Any,
    *,
    mu0: Any = None,
    index: Sequence[Sequence[int]] | None = None,
    mixing: str = "own",
    missed: str = "mix",
) -> Filter:
    """The interacting multiple model estimator: r filters, one per mode of a Markov chain.

    Predict: ``c_j = sum_i Pi_ij mu_i``; filter j starts from the mixture of all filters' moments with weights
    ``Pi_ij mu_i / c_j`` and predicts. Update: each filter with the same measurement, then ``mu_j ~ c_j Lambda_j`` with
    ``Lambda_j`` its likelihood. The output is the mixture's mean and covariance. Probabilities are kept as logarithms.

    Filters may have states of different size. All moments are reported in the union of the states, where a component
    that a model lacks counts as 0 with variance 0 (a model without turn rate goes straight). Info: ``innovation`` and
    ``innovation_cov`` are the moments of the predictive mixture, ``nis`` is formed of them (of absent components the
    spread between the models is not counted), ``log_lik`` is the mixture's, ``sum_j c_j Lambda_j``, and
    ``noise_cov`` the mean of the filters'. ``extra["mode_probabilities"]`` (r,) is mu, ``extra["models"]`` the filters'
    own extras where they have some. The prediction's moments and cross-covariance are the mixture's too, so
    :func:`jaxfilt.smooth` works. An IMM has ``moments`` but no ``with_moments``: there is none inside another.

    Transition probabilities, ``mu0`` and all parameters of the filters are leaves, tunable by gradient. Where
    ``Pi_ij = 0`` the transition never happens and its derivative counts as 0: tune rows by softmax.

    Status: the bits of all filters; NONFINITE also where no model has a finite likelihood (mu is then c).

    Args:
        filters: r filters with ``moments`` and ``with_moments`` that report ``log_lik``. Wrappers may stand around
            them; mixing replaces moments only, so that memories persist.
        transition: (r, r) ``Pi_ij``, probability of mode j after mode i; rows sum to 1. Under a transformation nothing
            can be checked: negative entries count as 0 and rows are normalized.
        mu0: (r,) probabilities of the modes at the start, normalized likewise; None = equal.
        index: for each filter the positions of its components in the union, which has no gaps. For
            ``[x, y, vx, vy]``, ``[x, y, vx, vy, ax, ay]`` and ``[x, y, vx, vy, omega]`` together:
            ``((0, 1, 2, 3), (0, 1, 2, 3, 4, 5), (0, 1, 2, 3, 6))``. None = each state is the beginning of the largest.
            This is refused (when the filter is started) where a state that is not the largest has a size that is not
            1 to 4 blocks of positions and derivatives in 1 to 3 axes: a turn with 5 components is no beginning of an
            acceleration with 6.
        mixing: what model j receives of model i for a component that i lacks. ``"own"``: j's own mean and variance,
            uncorrelated with the rest, so the component is mixed without bias. ``"zero"``: mean 0, variance 0 and no
            spread, which pulls it to 0 in each step. Equal where all states have the same components.
        missed: ``"mix"``: a missed sample is a step without measurement, mu = c. ``"freeze"``: in it the models do not
            mix and mu stays as it is.

    Raises:
        ValueError: a filter that lacks what is asked for, wrong shapes, (concrete) probabilities that are negative or
            do not sum to 1, an index with repeated positions or gaps, an unknown option.
        TypeError: integer arrays, another float dtype than the filters', or what is no Filter.

    Source: Blom and Bar-Shalom 1988; Bar-Shalom, Li and Kirubarajan 2001, section 11.6; mixing with states of different
    size: Glass, Blair and Bar-Shalom 2013.
    """
    filters = tuple(filters) if isinstance(filters, tuple | list) and not isinstance(filters, Filter) else ()
    if not filters or not all(isinstance(f, Filter) for f in filters):
        raise TypeError("filters: expected a tuple of one or more Filters")
    r = len(filters)
    for j, f in enumerate(filters):
        lacking = [name for name in ("moments", "with_moments") if getattr(f, name) is None]
        if lacking:
            raise ValueError(f"filters[{j}]: has no {' and no '.join(lacking)}, so its moments cannot be mixed")
    if mu0 is None:
        mu0 = (1 / r,) * r
    common_dtype({"transition": transition, "mu0": mu0})
    _check_probabilities("transition", transition, (r, r))
    _check_probabilities("mu0", mu0, (r,))
    for name, option, known in (("mixing", mixing, ("own", "zero")), ("missed", missed, ("mix", "freeze"))):
        if option not in known:
            raise ValueError(f'{name}: expected "{known[0]}" or "{known[1]}", got {option!r}')
    options = _Options(None if index is None else _check_index(index, r), mixing, missed)
    return bind(_Params(filters, transition, mu0, Static(options)), _init, _predict, _update, _moments)


def _check_probabilities(name, x, shape):
    got = real_array(name, x)
    if got.shape != shape:
        raise ValueError(f"{name}: expected shape {shape} for {shape[0]} filters, got {got.shape}")
    if not is_concrete(x):
        return
    a = np.asarray(x, np.float64)
    eps = float(jnp.finfo(got.dtype).eps) if jnp.issubdtype(got.dtype, jnp.floating) else 0.0
    tolerance = max(1e-8, 10 * shape[0] * eps)
    if not ((a >= 0).all() and (np.abs(a.sum(axis=-1) - 1) <= tolerance).all()):
        rows = "rows of " * (len(shape) == 2)
        raise ValueError(f"{name}: expected {rows}probabilities that sum to 1, got {a.tolist()}")


def _check_index(index, r):
    try:
        index = tuple(tuple(operator.index(i) for i in positions) for positions in index)
    except TypeError:
        raise TypeError(f"index: expected positions for each filter, got {index!r}") from None
    if len(index) != r:
        raise ValueError(f"index: expected positions for {r} filters, got {len(index)}")
    for j, positions in enumerate(index):
        if len(set(positions)) != len(positions) or min(positions, default=-1) < 0:
            raise ValueError(f"index[{j}]: expected different positions >= 0, got {positions}")
    covered = {i for positions in index for i in positions}
    if gaps := set(range(max(covered) + 1)) - covered:
        raise ValueError(f"index: no filter has the positions {sorted(gaps)} of the union")
    return index


def _union(index, sizes):
    if index is None:
        largest = max(sizes)
        axes = [d for d in (1, 2, 3) if all(n == largest or (n % d == 0 and n <= 4 * d) for n in sizes)]
        if not axes:
            raise ValueError(
                f"index: it is not clear which components the filters' states of sizes {sizes} share; give index"
            )
        index = tuple(tuple(range(n)) for n in sizes)
    for j, (positions, n) in enumerate(zip(index, sizes, strict=True)):
        if len(positions) != n:
            raise ValueError(f"index[{j}]: expected {n} positions as the filter's state, got {len(positions)}")
    size = 1 + max(i for positions in index for i in positions)
    source = np.empty((len(sizes), size), int)
    for j, positions in enumerate(index):
        source[j] = sizes[j]
        source[j, list(positions)] = np.arange(sizes[j])
    return _Union(tuple(np.array(i) for i in index), tuple(source), source != np.array(sizes)[:, None])


def _take(a, positions):
    """Components of a (n,) or (n, n)."""
    if (positions == np.arange(len(positions))).all():
        return a[(slice(len(positions)),) * a.ndim]
    return a[positions] if a.ndim == 1 else a[positions[:, None], positions[None, :]]


def _lift(union, arrays):
    """The models' vectors (n_j,) or matrices (n_j, n_j) in the union, 0 elsewhere: (r, N) or (r, N, N)."""
    lifted = []
    for a, source in zip(arrays, union.source, strict=True):
        beginning = (np.diff(source) >= 0).all() and source[0] == 0
        padded = jnp.pad(a, (0, len(source) - len(a) if beginning else 1))
        lifted.append(padded if beginning else _take(padded, source))
    return jnp.stack(lifted)


def _lifted_moments(p, states):
    moments = [f.moments(s) for f, s in zip(p.filters, states, strict=True)]  # pyright: ignore[reportOptionalCall]
    union = _union(p.options.value.index, tuple(mean.shape[0] for mean, _ in moments))
    return union, _lift(union, [mean for mean, _ in moments]), _lift(union, [cov for _, cov in moments])


def _collapse(weights, X, P):
    """Mean and covariance of a mixture with weights (r,), means (r, n) and covariances (r, n, n)."""
    mean = weights @ X
    return mean, _spread(weights, X - mean[None, :], P)


def _spread(weights, D, P):
    return sym(jnp.einsum("i,iab->ab", weights, P + D[:, :, None] * D[:, None, :]))


def _mix(union, mixing, weights, X, P, j):
    """How model j starts: mean (n_j,), cov (n_j, n_j), and its cross-covariance (N, n_j) with the state in the union.

    The cross-covariance is None where it is the covariance, because all models have the same components.
    """
    at = union.index[j]
    has = union.has[:, at]  # (r, n_j) which of j's components model i has
    lacks = ~has
    x, C = X[:, at], P[:, at[:, None], at[None, :]]
    if mixing == "own":
        x = jnp.where(has, x, x[j][None, :])
        # What a model lacks is 0 in P already; so are its covariances with the rest.
        C = jnp.where(lacks[:, :, None] & lacks[:, None, :], C[j][None], C)
    mean = weights @ x
    spread = x - mean[None, :]
    if mixing == "zero":
        spread = jnp.where(has, spread, jnp.zeros((), X.dtype))
    cov = _spread(weights, spread, C)
    if union.has.all():
        return mean, cov, None
    before = X - (weights @ X)[None, :]
    cross = jnp.einsum("i,iab->ab", weights, P[:, :, at] + before[:, :, None] * spread[:, None, :])
    return mean, cov, cross


def _cross(union, j, cross, cov, with_union):
    """Cov(x_{k-1}, x_k | mode j) (N, N) in the union, of model j's own cross-covariance (n_j, n_j).

    x_{k-1} reaches x_k through model j's start s: Cov(x_{k-1}, s) Cov(s)^-1 Cov(s, x_k).
    """
    if cross is None:
        return None
    if with_union is None:
        return _take(cross, union.source[j])
    cross = with_union @ solve_chol(chol(cov), cross)
    padded = jnp.pad(cross, ((0, 0), (0, 1)))
    return padded[:, union.source[j]]


def _never(dtype):
    """Log-probability of the impossible: finite, so that differences are not NaN, and beyond what data can outweigh."""
    return float(jnp.finfo(dtype).min) / 8


def _log_probabilities(x, dtype):
    x = jnp.asarray(x, dtype)
    possible = x > 0
    logs = jnp.where(possible, jnp.log(jnp.where(possible, x, jnp.ones((), dtype))), _never(dtype))
    return logs - jax.nn.logsumexp(logs, axis=-1, keepdims=True)


def _inputs(inp: StepInput, r):
    """The step's input for each filter: they differ in their random keys only."""
    if inp.key is None:
        return [inp] * r
    return [inp._replace(key=jax.random.fold_in(inp.key, j)) for j in range(r)]


def _init(p, inp):
    states = tuple(f.init(x) for f, x in zip(p.filters, _inputs(inp, len(p.filters)), strict=True))
    _, X, _ = _lifted_moments(p, states)
    for name in ("transition", "mu0"):
        for leaf in jax.tree.leaves(getattr(p, name)):
            strong = hasattr(leaf, "dtype") and not getattr(leaf, "weak_type", False)
            if strong and jax.dtypes.canonicalize_dtype(leaf.dtype) != X.dtype:
                raise TypeError(f"{name}: is {leaf.dtype}, but the filters are {X.dtype}; convert one of them")
    return ImmState(states, _log_probabilities(p.mu0, X.dtype))


def _predict(p, state, inp):
    options = p.options.value
    union, X, P = _lifted_moments(p, state.states)
    joint = state.log_mu[:, None] + _log_probabilities(p.transition, X.dtype)  # (i, j)
    log_c = jax.nn.logsumexp(joint, axis=0)
    weights = jnp.exp(joint - log_c[None, :])
    frozen = None
    if options.missed == "freeze" and inp.mask is not None:
        frozen = ~inp.mask.any()
        log_c = jnp.where(frozen, state.log_mu, log_c)
    states, befores, crosses = [], [], []
    for j, (f, s, x) in enumerate(zip(p.filters, state.states, _inputs(inp, len(p.filters)), strict=True)):
        weight = weights[:, j]
        if frozen is not None:
            weight = jnp.where(frozen, jnp.asarray(np.arange(len(X)) == j, X.dtype), weight)
        mean, cov, with_union = _mix(union, options.mixing, weight, X, P, j)
        s, prediction = f.predict(f.with_moments(s, mean, cov), x)  # pyright: ignore[reportOptionalCall]
        states.append(s)
        befores.append(weight @ X)
        crosses.append(_cross(union, j, prediction.cross, cov, with_union))
    c = jnp.exp(log_c)
    _, X, P = _lifted_moments(p, states)
    mean, cov = _collapse(c, X, P)
    cross = None
    if all(C is not None for C in crosses):
        before = jnp.stack(befores)
        before, after = before - (c @ before)[None, :], X - mean[None, :]
        cross = jnp.einsum("i,iab->ab", c, jnp.stack(crosses) + before[:, :, None] * after[:, None, :])
    return ImmState(tuple(states), log_c), Prediction(mean, cov, cross)


def _update(p, state, inp):
    results = [f.update(s, x) for f, s, x in zip(p.filters, state.states, _inputs(inp, len(p.filters)), strict=True)]
    states, infos = tuple(s for s, _ in results), [info for _, info in results]
    for j, info in enumerate(infos):
        if info.log_lik is None:
            raise ValueError(f"filters[{j}]: reports no log_lik, so its mode cannot be weighted")
    log_c = state.log_mu
    log_mu, log_lik, status = _weigh(log_c, jnp.stack([info.log_lik for info in infos]), inp.mask)
    for info in infos:
        status = status | info.status
    mu, c = jnp.exp(log_mu), jnp.exp(log_c)
    union = _union(p.options.value.index, tuple(info.mean.shape[0] for info in infos))
    mean, cov = _collapse(mu, _lift(union, [info.mean for info in infos]), _lift(union, [info.cov for info in infos]))
    nu = jnp.stack([info.innovation for info in infos])
    noise = None
    if all(info.noise_cov is not None for info in infos):
        noise = jnp.einsum("i,iab->ab", c, jnp.stack([info.noise_cov for info in infos]))
    S = nis = None
    innovation = c @ nu
    if all(info.innovation_cov is not None for info in infos):
        S = _spread(c, nu - innovation[None, :], jnp.stack([info.innovation_cov for info in infos]))
        L = chol(decoupled(inp.mask, S))
        nis, _, _ = likelihood(inp.mask, L, solve_lower(L, innovation))
    extra: dict[str, PyTree] = {"mode_probabilities": mu}
    if any(info.extra for info in infos):
        extra["models"] = tuple(info.extra for info in infos)
    info = Info(mean, cov, innovation, S, nis, log_lik, status, noise_cov=noise, extra=extra)
    return ImmState(states, log_mu), info


def _weigh(log_c, log_liks, mask):
    """``(log_mu, log_lik, status)`` of the models' likelihoods; a missed sample says nothing about the mode."""
    finite = jnp.isfinite(log_liks)
    never = _never(log_c.dtype)
    joint = log_c + jnp.where(finite, log_liks, never)
    # Less the largest first: beside log-likelihoods of -1e6 single precision has no digits left for probabilities.
    largest = jax.lax.stop_gradient(joint.max())
    joint = joint - largest
    normalizer = jax.nn.logsumexp(joint)
    log_lik = largest + normalizer
    usable = finite.any()
    status = flag(~usable, Status.NONFINITE)
    told = usable if mask is None else usable & mask.any()
    log_mu = jnp.where(told, joint - normalizer, log_c)
    if mask is not None:
        log_lik = jnp.where(mask.any(), log_lik, jnp.zeros((), log_lik.dtype))
    return log_mu, log_lik, status


def _moments(p, state):
    _, X, P = _lifted_moments(p, state.states)
    return _collapse(jnp.exp(state.log_mu), X, P)
