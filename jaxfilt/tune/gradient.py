"""Gradient descent on the unconstrained coordinates: any optax optimizer, many starts at once."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxfilt.core import aspartial, check_count, check_flag, check_key, number
from jaxfilt.linalg import structure
from jaxfilt.models.linear import check_finite
from jaxfilt.progress import rounds
from jaxfilt.tune import params as spaces
from jaxfilt.tune.result import TuneResult, check_time_limit, make_result

PyTree = Any

_ADAM = optax.adam(0.1)  # made once: an optimizer is compared by identity, so a new one traces anew


class _Search(NamedTuple):
    """One start, or a stack of them."""

    z: Array  # (d,) where it is
    optimizer: PyTree  # the optimizer's state
    best_z: Array  # (d,) the best point evaluated
    best_loss: Array  # ()


def gradient(
    loss: Callable[[PyTree, PyTree], Array],
    space: PyTree,
    data: PyTree = None,
    *,
    key: Array,
    optimizer: optax.GradientTransformation | None = None,
    steps: int = 300,
    starts: int = 1,
    spread: float = 1.0,
    block: int = 10,
    time_limit: float | None = None,
    progress: bool = False,
) -> TuneResult:
    """Minimizes a loss by gradient descent from several starts at once, projected onto the space's box.

    The best point of the whole path of every start is kept. A start that meets a non-finite loss or gradient skips the
    optimizer's update and steps back halfway to the best point it knows; the other starts are not touched.

    Args:
        loss: ``(params, data) -> ()``, differentiable and deterministic: random numbers belong to ``data``.
        space: a pytree of specs (see :mod:`jaxfilt.tune.params`).
        data: a pytree of arrays passed to the loss.
        key: random key, for the starts.
        optimizer: an optax optimizer; default ``optax.adam(0.1)``.
        steps: steps of each start, and so its evaluations. What a line search evaluates besides is not counted.
        starts: number of starts. The first is the space's initial value, the others are random.
        spread: how far from the initial value the random starts lie: 1 = uniform in the box, 0 = not at all.
        block: steps between two rows of the history.
        time_limit: seconds after which no new block is begun, compilation excluded.
        progress: shows a bar (needs tqdm).

    Returns:
        The result; ``evaluations`` counts one value-and-gradient of one start.

    Raises:
        ValueError: nothing to tune in ``space``, or counts below 1.
    """
    if not (optimizer is None or isinstance(optimizer, optax.GradientTransformation)):
        raise TypeError(f"optimizer: expected an optax optimizer, got {type(optimizer).__name__}")
    check_key(key)
    spread = number("spread", spread)
    check_finite("spread", spread)
    check_time_limit(time_limit)
    check_flag("progress", progress)
    optimizer = optax.with_extra_args_support(_ADAM if optimizer is None else optimizer)
    for name, count in (("steps", steps), ("starts", starts), ("block", block)):
        check_count(name, count, 1)
    if spaces.size(space) == 0:
        raise ValueError("space: expected at least one spec, but every leaf is a plain value")
    begun = time.perf_counter()
    loss = aspartial(loss, "loss")
    z0 = spaces.to_vector(space)
    others = z0[None, :] + spread * (spaces.sample(space, key, starts - 1) - z0[None, :])
    search = _begin(jnp.concatenate([z0[None, :], others]), optimizer)
    labels = structure.of(loss)
    advance = _advance.lower(loss, space, data, search, jnp.int32(0), optimizer, labels).compile()
    bars = rounds(-(-steps // block), "gradient", progress)
    compile_time = time.perf_counter() - begun

    rows, done = [], 0
    begun = time.perf_counter()
    for _ in bars:
        count = min(block, steps - done)
        search = jax.block_until_ready(advance(loss, space, data, search, jnp.int32(count)))
        done += count
        elapsed = time.perf_counter() - begun
        rows.append((done * starts, elapsed, float(search.best_loss.min())))
        if time_limit is not None and elapsed >= time_limit:
            break
    winner = jnp.argmin(search.best_loss)
    best = spaces.constrain(space, search.best_z[winner])
    return make_result(best, float(search.best_loss[winner]), rows, compile_time, "gradient")


@partial(jax.jit, static_argnames="optimizer")
def _begin(z, optimizer):
    best_loss = jnp.full(z.shape[:1], jnp.inf, z.dtype)
    return _Search(z, jax.vmap(optimizer.init)(z), z, best_loss)


@partial(jax.jit, static_argnames=("optimizer", "labels"))
def _advance(loss, space, data, search, count, optimizer, labels):
    """``count`` steps of all starts. The count is traced, so that a shorter last block is not compiled again."""
    loss = structure.noted(loss, labels)
    low, high = spaces.bounds(space)

    def value(z):
        return loss(spaces.constrain(space, z), data).astype(z.dtype)

    def one(s):
        current, slope = jax.value_and_grad(value)(s.z)
        better = current < s.best_loss  # false for NaN
        best_z = jnp.where(better, s.z, s.best_z)
        best_loss = jnp.where(better, current, s.best_loss)

        ok = jnp.isfinite(current) & jnp.isfinite(slope).all()
        slope = jnp.where(ok, slope, jnp.zeros_like(slope))
        # optax mixes int32 counters with floats, which a caller's strict promotion would refuse.
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            updates, state = optimizer.update(slope, s.optimizer, s.z, value=current, grad=slope, value_fn=value)
        z = optax.projections.projection_box(optax.apply_updates(s.z, updates), low, high)
        ok = ok & jnp.isfinite(z).all()
        z = jnp.where(ok, z, 0.5 * (s.z + best_z))
        state = jax.tree.map(lambda new, old: jnp.where(ok, new, old), state, s.optimizer)
        return _Search(z, state, best_z, best_loss)

    return jax.lax.fori_loop(jnp.int32(0), count, lambda _, s: jax.vmap(one)(s), search)
