"""What is known of the entries of an array whose values are traced: which are 0, and which are equal to each other.

Structure is written as *labels*, one per entry: 0 where the entry is 0, and equal numbers where entries are equal. It
is read off values where these can be seen, or remembered of an array by whoever made it (:func:`note`).
"""

from __future__ import annotations

import weakref
from functools import partial
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import Array

Labels = tuple[tuple[int, ...], bytes]  # shape and labels (int16): hashable, as a static argument must be

_NOTED: dict[int, tuple[weakref.ref, Labels]] = {}  # by identity: a changed array is another one, and has no note


def note(x: Array, labels: np.ndarray) -> Array:
    """Remembers of an array that its entries are 0 or equal as these labels say; returns the array."""
    key = id(x)
    _NOTED[key] = weakref.ref(x, lambda _: _NOTED.pop(key, None)), _pack(labels)
    return x


def array(x: Any, dtype: Any) -> Array:
    """``jnp.asarray``; if the values of x can be seen, then they still can of the array, inside ``jit`` too."""
    return _early(partial(jnp.asarray, dtype=dtype), x)


def diagonal(v: Array) -> Array:
    """The diagonal matrix (d, d) of v (d,), known to be one when its values are traced."""
    of_v = _noted(v)
    return note(_early(jnp.diag, v), np.diag(np.arange(1, v.size + 1) if of_v is None else unpack(of_v)))


def repeat(x: Array, d: int) -> Array:
    """(d,) of a number x (), known to be equal; an x (d,) stays as it is."""
    return note(_early(partial(jnp.broadcast_to, shape=(d,)), x), np.ones(d)) if x.ndim == 0 else x


def of(tree: Any) -> tuple[Labels | None, ...]:
    """The labels of each leaf; None where nothing is known.

    Values are looked at in matrices only: vectors and numbers are parameters, and a parameter that becomes 0 should not
    compile anew. Under ``vmap`` entries are 0 or equal if they are in all runs.
    """
    seen: dict[int, Any] = {}
    for leaf in jax.tree.leaves(tree):
        if id(leaf) not in seen:
            seen[id(leaf)] = _labels(leaf) if hasattr(leaf, "dtype") else None
    return tuple(seen[id(leaf)] for leaf in jax.tree.leaves(tree))


def noted(tree: Any, labels: tuple[Labels | None, ...]) -> Any:
    """The tree, with what :func:`of` said of it remembered of its leaves; for the inner side of a ``jit``."""
    for leaf, known in zip(jax.tree.leaves(tree), labels, strict=True):
        if known is not None:
            note(leaf, unpack(known))
    return tree


def unpack(labels: Labels) -> np.ndarray:
    """The labels as an array."""
    shape, values = labels
    return np.frombuffer(values, np.int16).reshape(shape)


def _early(function, x):
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(x)):
        return function(x)
    with jax.ensure_compile_time_eval():
        return function(x)


def _pack(labels):
    return labels.shape, np.asarray(labels, np.int16).tobytes()


def _noted(x):
    ref, labels = _NOTED.get(id(x), (lambda: None, None))
    return labels if ref() is x else None


def _labels(leaf):
    if not jnp.issubdtype(leaf.dtype, jnp.floating):
        return None
    batched = []
    while (known := _noted(leaf)) is None and hasattr(
        leaf, "batch_dim"
    ):  # of vmap's tracers: their class is not public
        axis, leaf = getattr(leaf, "batch_dim"), getattr(leaf, "val")  # noqa: B009
        batched += [] if axis is None else [axis]
    if known is not None and (batched or isinstance(leaf, jax.core.Tracer) or jnp.ndim(leaf) < 2):
        x = unpack(known)
    elif isinstance(leaf, jax.core.Tracer):
        return None
    else:
        x = np.asarray(leaf)
    for axis in batched[::-1]:  # the runs last
        x = np.moveaxis(x, axis, -1)
    shape = x.shape[: x.ndim - len(batched)]
    if known is None and (len(shape) < 2 or np.prod(shape) > np.iinfo(np.int16).max):
        return None
    rows = x.reshape(int(np.prod(shape)), -1)
    numbers: dict[bytes, int] = {}
    out = [numbers.setdefault(row.tobytes(), len(numbers) + 1) if row.any() else 0 for row in rows]
    return None if out == list(range(1, len(out) + 1)) else _pack(np.reshape(out, shape))
