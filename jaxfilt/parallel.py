"""Long series: Kalman filter and smoother in parallel over time.

A series is cut into blocks. What each block does to any state is computed for all blocks at once, one step of each
after the other (:mod:`jaxfilt.filters.transfer`); with these, an associative scan over the blocks gives the moments at
which each starts; then the filter itself runs through all blocks at once. So every step that is reported is an ordinary
step of the Kalman filter: its likelihood, status and covariance are as exact as in sequence, in float32 too. Only the
moments at which the blocks start come by another way.

The blocks are a batch. It pays on one core already, where a batch of small filters costs little more than one filter.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.tree_util import Partial

from jaxfilt import core
from jaxfilt.core import Info, PyTree, Status, StepInput, flag
from jaxfilt.filters.common import decoupled, innovate, masked_rows
from jaxfilt.filters.kalman import init_mean, input_term, kalman
from jaxfilt.filters.transfer import Transfer, apply, join, prior, transfer
from jaxfilt.linalg import chol, entries, scalar_scan, scale_cov, solve_chol, structure, sym
from jaxfilt.models.linear import LinearGaussian, check_linear, value
from jaxfilt.smooth import Smoothed, check_smoothable


def filter_parallel(
    model: LinearGaussian,
    ys: Any,
    *,
    mask: Any = None,
    dt: Any = None,
    u: PyTree = None,
    q_scale: Any = None,
    r_scale: Any = None,
    outputs: Callable[[PyTree, Info], PyTree] = core.summary,
    first_update_only: bool = False,
    block: int | None = None,
    associative: bool | None = None,
) -> Any:
    """What ``jf.filter(jf.kalman(model), ys, ...)`` gives, computed in parallel over time; for one long series.

    Args:
        model: from :func:`jaxfilt.models.linear_gaussian` or a motion builder.
        ys: (T, m) measurements.
        mask: as in :func:`jaxfilt.filter`, like all that is not listed here.
        dt: intervals.
        u: inputs.
        q_scale: factor on Q.
        r_scale: factor on R.
        outputs: ``(state, info) -> pytree``.
        first_update_only: takes m0, P0 as the prior on the first sample.
        block: steps in a block; None = about sqrt(T), on accelerators at most 64. Results depend on it by rounding.
        associative: whether blocks are joined by an associative scan, in log2 of their number of levels; else one after
            the other, which is half the work. None = on accelerators.

    Returns:
        As :func:`jaxfilt.filter`. Where H Q H' + R of the present components is singular, a block learns less of the
        state before it than there is to learn: all blocks after it then carry ``Status.SINGULAR``. Filter in sequence
        there. An unmasked NaN under a transformation (``Status.NONFINITE``) counts as absent from the next block on.

    Raises:
        ValueError: as :func:`jaxfilt.filter`; a block that is no int >= 1.
        TypeError: as :func:`jaxfilt.filter`.

    Source: Särkkä and García-Fernández 2021.
    """
    check_linear(model)
    core.check_callable("outputs", outputs)
    core.check_flag("first_update_only", first_update_only)
    stacked = core.inputs(ys, mask=mask, dt=dt, u=u, q_scale=q_scale, r_scale=r_scale)
    block = _block(block, stacked.y.shape[0])
    return _filter(model, stacked, outputs, first_update_only, block, _associative(associative), structure.of(model))


def rts_parallel(out: Info, *, block: int | None = None, associative: bool | None = None) -> Smoothed:
    """What :func:`jaxfilt.rts` gives, computed in parallel over time; for any filter that can be smoothed.

    Args:
        out: of ``jf.filter`` or :func:`filter_parallel` with ``outputs=jf.everything``.
        block: as in :func:`filter_parallel`.
        associative: likewise.

    Raises:
        ValueError: as :func:`jaxfilt.rts`.
    """
    check_smoothable(out)
    return _rts(out.mean, out.cov, out.prediction, _block(block, out.mean.shape[0]), _associative(associative))


def smooth_parallel(
    model: LinearGaussian, ys: Any, *, block: int | None = None, associative: bool | None = None, **options: Any
) -> Smoothed:
    """Filters and smooths one long series in parallel; arguments as :func:`filter_parallel` except ``outputs``."""
    cut = {"block": block, "associative": associative}
    return rts_parallel(filter_parallel(model, ys, outputs=core.everything, **cut, **options), **cut)


def _block(block, T):
    if block is None:
        block = max(1, round(T**0.5))
        return block if jax.default_backend() == "cpu" else min(block, 64)
    core.check_count("block", block, 1)
    return min(int(block), T)


def _associative(given):
    if given is None:
        return jax.default_backend() != "cpu"
    core.check_flag("associative", given)
    return given


@partial(jax.jit, static_argnames=("outputs", "first_update_only", "block", "associative", "labels"))
def _filter(model, stacked, outputs, first_update_only, block, associative, labels):
    T = stacked.y.shape[0]
    init_mean(model, jax.tree.map(lambda leaf: leaf[0], stacked))
    model, stacked = _independent_steps(structure.noted(model, labels), stacked, first_update_only)
    blocks = _cut(stacked, block)
    number = blocks.y.shape[0]

    def run(filt, inp, **options):
        arguments = {"mask": inp.mask, "dt": inp.dt, "u": inp.u, "q_scale": inp.q_scale, "r_scale": inp.r_scale}
        return core.filter(filt, inp.y, **arguments, **options)

    mean, cov, lossy = model.m0[None], sym(model.P0)[None], jnp.zeros((1,), bool)
    if number > 1:
        but_last = jax.tree.map(lambda leaf: leaf[:-1], blocks)
        stretches = jax.vmap(lambda inp: run(transfer(model), inp, outputs=_state, keep="last"))(but_last)
        with jax.default_matmul_precision("highest"):
            mean, cov = _starts(stretches.transfer, mean[0], cov[0], associative)
        lossy = jnp.concatenate([lossy, jnp.cumsum(stretches.lossy, dtype=jnp.int32) > 0])
    out = jax.vmap(lambda m, P, lost, inp: run(_from(model, m, P, lost), inp, outputs=outputs))(
        mean, cov, lossy, blocks
    )
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:T], out)


def _cut(tree, block):
    """Leaves (T, ...) as (blocks, block, ...); the last block is filled up with the last step."""

    def cut(leaf):
        T = leaf.shape[0]
        number = -(-T // block)
        if number * block > T:
            leaf = jnp.concatenate([leaf, jnp.broadcast_to(leaf[-1:], (number * block - T, *leaf.shape[1:]))])
        return leaf.reshape(number, block, *leaf.shape[1:])

    return jax.tree.map(cut, tree)


def _state(state, info):
    del info
    return state


def _starts(stretches: Transfer, mean: Array, cov: Array, associative: bool) -> tuple[Array, Array]:
    """Moments (B, n), (B, n, n) before each of B blocks, from the stretches of all but the last."""
    if not associative:

        def body(moments, stretch):
            moments = apply(stretch, *moments)
            return moments, moments

        means, covs = jax.lax.scan(body, (mean, cov), stretches)[1]
        return jnp.concatenate([mean[None], means]), jnp.concatenate([cov[None], covs])
    first = jax.tree.map(lambda leaf: leaf[None], prior(mean, cov))
    elements = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, stretches)
    joined = jax.lax.associative_scan(jax.vmap(join), elements)
    return joined.b, joined.C


class _Block(NamedTuple):
    kalman: core.Filter
    lossy: Array  # () bool


def _from(model, mean, cov, lossy):
    """The Kalman filter from these moments, with the status of what they rest on."""
    filt = kalman(model._replace(m0=mean, P0=cov))
    return filt._replace(update=Partial(_update, _Block(filt, lossy)))


def _update(p, state, inp):
    state, info = p.kalman.update(state, inp)
    return state, info._replace(status=info.status | flag(p.lossy, Status.SINGULAR))


class _Known(NamedTuple):
    """What a step is given in ``u`` so that it does not need the step before, nor its own number."""

    u: PyTree
    first: Array | None  # bool: no prediction in this step
    memory: tuple[Array, Array, Array] | None  # J H, J S', J (y - D u) of the step before (correlated noise)
    q_scale: Array | None  # with a memory, which Q must not scale


def _independent_steps(model: LinearGaussian, stacked: StepInput, first_update_only: bool):
    """A model without S and a series for which every step is a plain prediction and update."""
    if model.S is None and not first_update_only:
        return model, stacked
    T = stacked.y.shape[0]
    first = jnp.arange(T) == 0 if first_update_only else None
    memory = None
    if model.S is not None:
        after = jax.vmap(partial(_memory, model))(stacked)
        memory = jax.tree.map(lambda leaf: jnp.concatenate([jnp.zeros_like(leaf[:1]), leaf[:-1]]), after)
    known = _Known(stacked.u, first, memory, None if memory is None else stacked.q_scale)
    stacked = stacked._replace(u=known, q_scale=stacked.q_scale if memory is None else None)
    changed = {"F": Partial(_F, model), "Q": Partial(_Q, model), "B": Partial(_B, model), "S": None}
    for name in ("H", "R"):
        if callable(matrix := getattr(model, name)):
            changed[name] = Partial(_of_u, matrix)
    if model.D is not None:
        changed["D"] = Partial(_term, model.D)
    return model._replace(**changed), stacked


def _memory(model, inp):
    H = masked_rows(inp.mask, value(model.H, inp.u, inp.dt))
    R = decoupled(inp.mask, scale_cov(value(model.R, inp.u, inp.dt), inp.r_scale))
    S = value(model.S, inp.u, inp.dt)
    S = S if inp.mask is None else jnp.where(inp.mask[None, :], S, jnp.zeros((), S.dtype))
    J = solve_chol(chol(R), S.T).T
    shift = input_term(model.D, inp)
    predicted = jnp.zeros_like(inp.y) if shift is None else shift
    return J @ H, J @ S.T, J @ innovate(inp, predicted).value


def _F(model, known, dt):
    F = value(model.F, known.u, dt)
    if known.memory is not None:
        F = F - known.memory[0]
    return F if known.first is None else jnp.where(known.first, jnp.eye(F.shape[0], dtype=F.dtype), F)


def _Q(model, known, dt):
    Q = value(model.Q, known.u, dt)
    if known.memory is not None:
        Q = sym(scale_cov(Q, known.q_scale) - known.memory[1])
    return Q if known.first is None else jnp.where(known.first, jnp.zeros((), Q.dtype), Q)


def _B(model, known, dt):
    shift: Any = jnp.zeros_like(model.m0) if model.B is None else _term(model.B, known, dt)
    if known.memory is not None:
        shift = shift + known.memory[2]
    return shift if known.first is None else jnp.where(known.first, jnp.zeros((), shift.dtype), shift)


def _term(matrix, known, dt):
    return matrix(known.u, dt) if callable(matrix) else matrix @ known.u


def _of_u(matrix, known, dt):
    return matrix(known.u, dt)


class _Backward(NamedTuple):
    """The smoothed state of a step, as it depends on that of the step after the block: N(E x + g, D)."""

    E: Array | None  # (n, n), None where g, D are the moments themselves
    g: Array
    D: Array


@partial(jax.jit, static_argnames=("block", "associative"))
def _rts(mean, cov, prediction, block, associative):
    if mean.shape[0] == 1:
        return Smoothed(mean, cov)
    later = jax.tree.map(lambda leaf: leaf[1:], prediction)
    backwards = jax.tree.map(lambda leaf: leaf[:-1][::-1], (mean, cov)), jax.tree.map(lambda leaf: leaf[::-1], later)
    blocks = _cut(backwards, block)
    number = blocks[0][0].shape[0]
    n, dtype = mean.shape[1], mean.dtype
    means, covs = mean[-1:], cov[-1:]
    if number > 1:
        but_last = jax.tree.map(lambda leaf: leaf[:-1], blocks)
        zero = jnp.zeros((n, n), dtype)
        start = _Backward(jnp.eye(n, dtype=dtype), zero[0], zero)
        maps = jax.vmap(lambda xs: _steps(start, xs, "last"))(but_last)
        with jax.default_matmul_precision("highest"):
            means, covs = _ends(maps, mean[-1], cov[-1], associative)
    out = jax.vmap(lambda m, P, xs: _steps(_Backward(None, m, P), xs, "stack"))(means, covs, blocks)
    join = lambda x, last: jnp.concatenate([x.reshape(-1, *x.shape[2:])[: mean.shape[0] - 1][::-1], last[None]])  # noqa: E731
    return Smoothed(join(out.g, mean[-1]), join(out.D, cov[-1]))


def _steps(start, xs, keep):
    """Runs the smoother backwards through a block, on scalars where that is possible."""
    labels = tuple(None for _ in jax.tree.leaves(start))
    try:
        return scalar_scan.scan(_given, _smooth_step, start, xs, labels, keep=keep, limit=scalar_scan.WORTHWHILE)
    except entries.NoScalarForm:
        return scalar_scan.collect(partial(_smooth_step, None), start, xs, keep)[1]


def _given(params, x):
    del x
    return params


def _smooth_step(params, after, x):
    del params
    (m, P), later = x
    with jax.default_matmul_precision("highest"):
        G = solve_chol(chol(later.cov), later.cross.T).T
        g = m + G @ (after.g - later.mean)
        D = P + sym(G @ (after.D - later.cov) @ G.T)
        out = _Backward(None if after.E is None else G @ after.E, g, D)
    return out, out


def _ends(maps, mean, cov, associative):
    """Smoothed moments (B, n), (B, n, n) after each of B blocks, the last block first."""
    if not associative:

        def body(moments, x):
            E, g, D = x
            moments = E @ moments[0] + g, sym(E @ moments[1] @ E.T) + D
            return moments, moments

        means, covs = jax.lax.scan(body, (mean, cov), maps)[1]
        return jnp.concatenate([mean[None], means]), jnp.concatenate([cov[None], covs])
    elements = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), _Backward(jnp.zeros_like(cov), mean, cov), maps)
    joined = jax.lax.associative_scan(jax.vmap(_then), elements)
    return joined.g, joined.D


def _then(first, second):
    """Two maps of :class:`_Backward`, one after the other."""
    E, g, D = second
    return _Backward(E @ first.E, E @ first.g + g, sym(E @ first.D @ E.T) + D)
