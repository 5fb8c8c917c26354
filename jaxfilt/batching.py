"""Batches: one function of one run over many, on all devices, in chunks that stay in the processor's cache."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxfilt.core import Filter, PyTree, Static, aspartial, check_count
from jaxfilt.linalg import structure
from jaxfilt.models.linear import LinearGaussian
from jaxfilt.models.nonlinear import Nonlinear

_SHARED = object()  # in place of an axis None, which would not be a leaf


def batch(
    fn: Callable[..., PyTree],
    in_axes: Any = 0,
    *,
    chunk: int = 256,
    devices: Sequence[Any] | None = None,
) -> Callable[..., PyTree]:
    """``jax.jit(jax.vmap(fn, in_axes))``, split over the devices and computed in chunks; several times as fast.

    What it adds: the batch goes in equal parts to all devices (on a CPU the cores, after :func:`use_cores`), each
    computes its part ``chunk`` runs at a time, so that what a step works on stays in the cache, and the structure of
    the filters and models among the arguments (entries that are 0 or equal) is seen, which inside a ``jit`` it is not.
    Results do not depend on chunk or devices up to rounding. Compiled once per shape.

    Example: ``jf.batch(loss)(log_r, ys)`` with ``loss`` of one run, ``jf.batch(jax.grad(loss), chunk=128)(log_r, ys)``.

    Args:
        fn: a function of one run, module-level or a ``jax.tree_util.Partial`` of such (another one compiles anew).
        in_axes: as in ``jax.vmap``: the axis of each argument that counts the runs, None for what they share.
        chunk: most runs that a device computes at once. 128 suits gradients, 64 long histories of large states.
        devices: JAX devices; None = all local devices of the default backend.

    Returns:
        A function of the batched arguments; its results have the runs as leading axis.

    Raises:
        ValueError: when it is called with nothing to batch over, or with different numbers of runs.
    """
    check_count("chunk", chunk, 1)
    return partial(_call, aspartial(fn), in_axes, int(chunk), None if devices is None else tuple(devices))


def use_cores(count: int) -> None:
    """Makes ``count`` JAX devices of the CPU, over which batches are split; call it before anything else of JAX.

    XLA hands small work to a thread pool, which costs what it gains: with one device per core, each computes its part
    of a batch alone, about twice as fast.

    Raises:
        RuntimeError: if JAX has already begun with another number of devices.
    """
    jax.config.update("jax_num_cpu_devices", count)


def _call(fn, in_axes, chunk, devices, *args):
    axes = _axes(in_axes, args)
    leaves, tree = jax.tree.flatten(args)
    counts = {jnp.shape(x)[axis] for x, axis in zip(leaves, axes, strict=True) if axis is not None}
    if len(counts) != 1:
        found = f"got {sorted(counts)}" if counts else "got no batched argument"
        raise ValueError(f"in_axes: expected arguments with one number of runs, {found}")
    if (runs := counts.pop()) == 0:
        raise ValueError("in_axes: expected at least one run, got an empty batch")
    devices = tuple(jax.local_devices()) if devices is None else devices
    labels = structure.of(fn) + _model_labels(args, axes)
    return _compute(fn, leaves, Static((tree, axes, runs, chunk, labels)), devices)


def _axes(in_axes, args):
    """The batched axis of each leaf, or None."""
    in_axes = tuple(in_axes) if isinstance(in_axes, list) else in_axes
    given = jax.tree.map(lambda a: _SHARED if a is None else a, in_axes, is_leaf=lambda a: a is None)
    axes = [None if a is _SHARED else a for a in jax.tree.leaves(jax.tree.broadcast(given, args))]
    sizes = [jnp.ndim(x) for x in jax.tree.leaves(args)]
    return tuple(None if a is None else a % n if n else a for a, n in zip(axes, sizes, strict=True))


def _model_labels(tree, axes):
    """What is known of the leaves of filters and models; data are not looked at."""

    def is_model(x):
        return isinstance(x, Filter | LinearGaussian | Nonlinear)

    labels: list[Any] = []
    for part in jax.tree.leaves(tree, is_leaf=is_model):
        leaves = jax.tree.leaves(part)
        here = axes[len(labels) : len(labels) + len(leaves)]
        if not is_model(part):
            labels += [None] * len(leaves)
        elif any(axis is not None for axis in here):
            seen: list[Any] = []
            with jax.ensure_compile_time_eval():
                jax.vmap(lambda *xs: seen.extend(structure.of(xs)), here)(*leaves)  # noqa: B023
            labels += seen
        else:
            labels += structure.of(part)
    return tuple(labels)


@partial(jax.jit, static_argnames=("static", "devices"))
def _compute(fn, leaves, static, devices):
    tree, axes, runs, chunk, labels = static.value
    batched = [jnp.moveaxis(x, axis, 0) for x, axis in zip(leaves, axes, strict=True) if axis is not None]
    shared = [x for x, axis in zip(leaves, axes, strict=True) if axis is None]

    def one(fn, shared, batched):
        rest = iter(shared), iter(batched)
        args = jax.tree.unflatten(tree, [next(rest[axis is not None]) for axis in axes])
        structure.noted((fn, *args), labels)
        return fn(*args)

    return in_parts(one, (fn, shared), batched, runs, chunk, devices)


def in_parts(
    fn: Callable[..., PyTree],
    shared: tuple[PyTree, ...],
    batched: PyTree,
    runs: int,
    chunk: int,
    devices: Sequence[Any],
) -> PyTree:
    """``fn(*shared, batched)`` for each of the ``runs``, the leading axis of ``batched``; under ``jit``."""
    # Parts of equal size, as large as the chunk allows, for each device the same number.
    rounds = math.ceil(runs / (len(devices) * chunk))
    parts = rounds * len(devices)
    size = math.ceil(runs / parts)
    index = np.minimum(np.arange(parts * size), runs - 1)  # the last part is filled up with the last run

    def split(x):
        x = x if len(index) == runs else x[index]
        return x.reshape(parts, size, *x.shape[1:])

    def part(shared, batched):
        several = jax.vmap(lambda xs: fn(*shared, xs))
        if rounds == 1:
            out = several(jax.tree.map(lambda x: x[0], batched))
            return jax.tree.map(lambda x: x[None], out)
        return jax.lax.map(several, batched)

    if len(devices) > 1:
        everywhere, own = PartitionSpec(), PartitionSpec("runs")
        mesh = Mesh(np.array(devices), ("runs",))
        part = jax.shard_map(part, mesh=mesh, in_specs=(everywhere, own), out_specs=own, check_vma=False)
    out = part(shared, jax.tree.map(split, batched))
    return jax.tree.map(lambda x: x.reshape(parts * size, *x.shape[2:])[:runs], out)
