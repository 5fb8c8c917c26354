"""Arrays as NumPy object arrays of scalars, the *entries*: what is known and what is traced; see scalarize.py."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeGuard

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

Entries = np.ndarray  # of dtype object

LARGEST = 1024  # entries of one array; beyond, a program on scalars is neither compiled nor run in reasonable time


class NoScalarForm(Exception):
    """A program has too many scalars, or something that is not made of scalars."""


def is_known(x: Any) -> TypeGuard[np.generic]:
    """Whether the value of an entry is known while tracing."""
    return isinstance(x, np.generic)


def is_value(x: Any, value: Any) -> bool:
    """Whether an entry is known to be ``value``."""
    return is_known(x) and x == value


def is_zero(x: Any) -> bool:
    """Whether an entry is known to be 0."""
    return is_value(x, 0)


def known(x: Any) -> Entries:
    """Entries of known values."""
    x = np.asarray(x)
    return line(list(x.ravel())).reshape(x.shape)


def entries(x: Any, zeros: np.ndarray | None = None) -> Entries:
    """Entries of an array; those where ``zeros`` is true are known to be 0. NumPy arrays are known altogether."""
    if isinstance(x, Entries) and x.dtype == object:
        return x
    if isinstance(x, np.ndarray | np.generic):
        return known(x)
    x = jnp.asarray(x)
    if jnp.issubdtype(x.dtype, jax.dtypes.extended):  # random keys have no entries that could be computed with
        return line([x]).reshape(())
    if x.size > LARGEST:
        raise NoScalarForm(f"an array of shape {x.shape}")
    out = np.empty(x.shape, object)
    for index in np.ndindex(x.shape):
        out[index] = np.zeros((), x.dtype)[()] if zeros is not None and zeros[index] else x[index]
    return out


def zeros(tree: Any) -> tuple[tuple[tuple[int, ...], bytes] | None, ...]:
    """For each leaf shape and bytes of where it is 0; None where nothing is, or where no value can be seen.

    Only of matrices: vectors and numbers are parameters, and a parameter that becomes 0 should not compile anew.
    Under ``vmap`` an entry is 0 if it is in all runs.
    """
    seen: dict[int, Any] = {}
    out = []
    for leaf in jax.tree.leaves(tree):
        if id(leaf) not in seen:
            seen[id(leaf)] = _zeros(leaf) if hasattr(leaf, "dtype") else None
        out.append(seen[id(leaf)])
    return tuple(out)


def batch_sizes(leaf: Any) -> list[int]:
    """Over how many runs ``vmap`` computes here, for each ``vmap`` around; the derivative's in between are passed."""
    sizes = []
    while isinstance(leaf, jax.core.Tracer):
        axis = getattr(leaf, "batch_dim", None)  # of vmap's tracers, whose class is not public
        inner: Any = getattr(leaf, "val", getattr(leaf, "primal", None))
        if axis is not None:
            sizes.append(jnp.shape(inner)[axis])
        leaf = inner
    return sizes


def _zeros(leaf: Any):
    batched = []
    while isinstance(leaf, jax.core.Tracer) and hasattr(leaf, "batch_dim"):
        axis, leaf = getattr(leaf, "batch_dim"), getattr(leaf, "val")  # noqa: B009
        batched += [] if axis is None else [axis]
    if isinstance(leaf, jax.core.Tracer) or not jnp.issubdtype(leaf.dtype, jnp.floating):
        return None
    where = np.asarray(leaf) == 0
    for axis in batched[::-1]:
        where = where.all(axis=axis)
    return (where.shape, where.tobytes()) if where.ndim >= 2 and where.any() else None


def assemble(x: Entries, aval: Any) -> Any:
    """The array that entries stand for."""
    if jnp.issubdtype(aval.dtype, jax.dtypes.extended):
        return x[()]
    flat = list(x.ravel())
    if all(isinstance(e, np.generic) for e in flat):
        return jnp.asarray(np.array(flat, aval.dtype).reshape(aval.shape))
    flat = [jnp.asarray(e, aval.dtype) if isinstance(e, np.generic) else e for e in flat]
    return flat[0].reshape(aval.shape) if len(flat) == 1 else jnp.stack(flat).reshape(aval.shape)


def line(values: Sequence[Any]) -> Entries:
    """Entries (k,), assigned one by one, since NumPy would convert a slice of traced values."""
    out = np.empty(len(values), object)
    for i, x in enumerate(values):
        out[i] = x
    return out


def shaped(values: Sequence[Any], shapes: Sequence[tuple[int, ...]]) -> list[Entries]:
    """Arrays of entries of these shapes from all their values, one after the other."""
    parts = np.split(line(values), np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]
