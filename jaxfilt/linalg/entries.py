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


def entries(x: Any, labels: np.ndarray | None = None) -> Entries:
    """Entries of an array; 0 or the same where its ``labels`` say so. NumPy arrays are known altogether."""
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
    same = {0: np.zeros((), x.dtype)[()]}
    for number, index in enumerate(np.ndindex(x.shape)):
        label = -1 - number if labels is None else int(labels[index])
        if label not in same:
            same[label] = x[index]
        out[index] = same[label]
    return out


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
