"""Constrained parameters: a pytree of specs and its unconstrained coordinates.

A *space* is a pytree, of any shape you like, whose leaves are specs (:func:`positive`, :func:`interval`, ...) or plain
values, which stay as they are. The optimizers work on one vector ``z (d,)`` without constraints, inside a finite box
that is the same for the gradient and for evolution; the parameters are shown in their own constraints.

    space = {"q": positive(0.1), "alpha": interval(0.5, 0.0, 2.0), "m0": m0}
    z = to_vector(space)             # (2,)
    constrain(space, z)              # {"q": 0.1, "alpha": 0.5, "m0": m0}

All coordinates have a similar reach (about 14 from end to end), so that one step of an optimizer means the same in
any units. Specs are pytrees: a space crosses ``jit`` and ``vmap``, and another initial value does not recompile.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt import core
from jaxfilt.tune.transforms import REACH, TRANSFORMS

PyTree = Any


@partial(jax.tree_util.register_dataclass, data_fields=("init", "low", "high", "args"), meta_fields=("kind", "dtype"))
@dataclass(frozen=True, eq=False)
class Spec:
    """One constrained parameter. Make it with :func:`positive`, :func:`interval`, ...

    Attributes:
        init: initial value, in the parameter's own constraints.
        low: (size,) lower end of the box, in the unconstrained coordinates.
        high: (size,) upper end.
        args: what the transformation needs besides ``z``.
        kind: name of the transformation.
        dtype: the float dtype of an array given as ``init``; None for Python numbers, which take the space's dtype.
    """

    init: Any
    low: Any
    high: Any
    args: tuple
    kind: str
    dtype: np.dtype | None


def positive(init: Any, low: Any = None, high: Any = None) -> Spec:
    """A positive parameter on a log scale, elementwise.

    Args:
        init: scalar or array, > 0.
        low: ends of the box, in the parameter's unit; default ``init / 1000``.
        high: default ``1000 * init``.

    Raises:
        ValueError: unless ``0 < low <= init <= high``.
    """
    x, dtype = _concrete("init", init)
    low = x / 1e3 if low is None else _like(x, "low", low)
    high = x * 1e3 if high is None else _like(x, "high", high)
    if not (x > 0).all():
        raise ValueError(f"init: expected positive values, got {init}")
    if not (low > 0).all():
        raise ValueError(f"low: expected positive values, got {low}")
    _check_box(x, low, high)
    return Spec(x, np.log(low).ravel(), np.log(high).ravel(), (), "positive", dtype)


def unit(init: Any) -> Spec:
    """A parameter in (0, 1), elementwise: :func:`interval` with these ends."""
    return interval(init, 0.0, 1.0)


def interval(init: Any, low: Any, high: Any) -> Spec:
    """A parameter strictly between ``low`` and ``high``, on a logit scale, elementwise.

    The box leaves out 0.1 % of the interval at either end, or less where ``init`` is nearer to it.

    Raises:
        ValueError: unless ``low < init < high``.
    """
    x, dtype = _concrete("init", init)
    low, high = _like(x, "low", low), _like(x, "high", high)
    if not ((low < x) & (x < high)).all():
        raise ValueError(f"init: expected values strictly between low and high, got {init}")
    return _with_reach(x, (low, high), "interval", dtype)


def real(init: Any, low: Any, high: Any) -> Spec:
    """A parameter of either sign on a linear scale, elementwise, in the box ``[low, high]``.

    Raises:
        ValueError: unless ``low <= init <= high`` and ``low < high``.
    """
    x, dtype = _concrete("init", init)
    low, high = _like(x, "low", low), _like(x, "high", high)
    if not (low < high).all():
        raise ValueError(f"low: expected low < high, got {low} and {high}")
    _check_box(x, low, high)
    reach = np.full(x.size, REACH)
    return Spec(x, -reach, reach, (low, high), "real", dtype)


def ordered(init: Any, low: float, high: float) -> Spec:
    """Strictly increasing corners between ``low`` and ``high``, by cumulative softplus.

    ``x_i = low + (high - low) (g_1 + ... + g_i) / (1 + g_1 + ... + g_k)`` with ``g = softplus(z)``: the gap between
    the last corner and ``high`` is the unit in which the other gaps are measured.

    Args:
        init: (k,) increasing.
        low: what the first corner stays above.
        high: what the last corner stays below.

    Raises:
        ValueError: unless ``low < init[0] < ... < init[-1] < high``.
    """
    x, dtype = _concrete("init", init)
    if x.ndim != 1 or x.size == 0:
        raise ValueError(f"init: expected shape (k,), got {x.shape}")
    ends = np.concatenate([_like(x[:1], "low", low), x, _like(x[:1], "high", high)])
    if not (np.diff(ends) > 0).all():
        raise ValueError(f"init: expected low < init[0] < ... < init[-1] < high, got {ends.tolist()}")
    return _with_reach(x, (ends[0], ends[-1]), "ordered", dtype)


def covariance(init: Any, factor: float = 1e3) -> Spec:
    """A symmetric positive-definite matrix by its Cholesky factor with log diagonal.

    ``L = D C`` with ``D = diag(exp(z_1..z_n))`` and C unit lower triangular, so that the coordinates have no unit.

    Args:
        init: (n, n), symmetric positive definite.
        factor: the squares of L's diagonal may move by this factor either way; the entries of C by 3.

    Raises:
        ValueError: if ``init`` is not symmetric positive definite, or ``factor`` not above 1.
    """
    x, dtype = _concrete("init", init)
    if x.ndim != 2 or x.shape[0] != x.shape[1]:
        raise ValueError(f"init: expected shape (n, n), got {x.shape}")
    if not np.allclose(x, x.T, rtol=1e-5, atol=0.0):
        raise ValueError("init: expected a symmetric matrix")
    if not 1 < core.number("factor", factor) < np.inf:
        raise ValueError(f"factor: expected more than 1, got {factor}")
    try:
        L = np.linalg.cholesky(x)
    except np.linalg.LinAlgError:
        raise ValueError("init: expected a positive-definite matrix") from None
    n = x.shape[0]
    d = np.diagonal(L)
    z = np.concatenate([np.log(d), (L / d[:, None])[np.tril_indices(n, -1)]])
    reach = np.where(np.arange(z.size) < n, 0.5 * np.log(factor), 3.0)
    return Spec(x, z - reach, z + reach, (), "covariance", dtype)


def frozen(value: PyTree) -> PyTree:
    """Takes a value out of the tuning. Specs inside it are replaced by their initial values; the rest is unchanged."""
    return jax.tree.map(lambda leaf: _initial(leaf, leaf.dtype) if _is_spec(leaf) else leaf, value, is_leaf=_is_spec)


def size(space: PyTree) -> int:
    """The number d of unconstrained coordinates."""
    return sum(np.size(spec.low) for spec in _specs(space))


def to_vector(space: PyTree) -> Array:
    """The initial values as ``z (d,)``."""
    return unconstrain(space, initial(space))


def initial(space: PyTree) -> PyTree:
    """The initial values in their own constraints, in the space's dtype."""
    dtype = _dtype(space)
    return jax.tree.map(lambda leaf: _initial(leaf, dtype) if _is_spec(leaf) else leaf, space, is_leaf=_is_spec)


def unconstrain(space: PyTree, params: PyTree) -> Array:
    """``z (d,)`` of parameters given in their own constraints; inverse of :func:`constrain`.

    Raises:
        ValueError: if ``params`` and ``space`` differ in structure, or in the shape of a tuned leaf.
    """
    dtype = _dtype(space)

    def coordinates(leaf, x):
        if not _is_spec(leaf):
            return jnp.zeros((0,), dtype)
        x = jnp.asarray(x, dtype)
        if x.shape != np.shape(leaf.init):
            raise ValueError(f"params: expected a leaf of shape {np.shape(leaf.init)}, got {x.shape}")
        return TRANSFORMS[leaf.kind][1](x, *_args(leaf, dtype)).ravel()

    try:
        parts = jax.tree.map(coordinates, space, params, is_leaf=_is_spec)
    except (ValueError, TypeError) as error:
        if str(error).startswith("params: "):
            raise
        raise ValueError(f"params: expected the structure of space; {error}") from None
    return jnp.concatenate([jnp.zeros((0,), dtype), *jax.tree.leaves(parts)])


def constrain(space: PyTree, z: Array) -> PyTree:
    """The parameters at ``z (d,)``, in their own constraints and in the dtype of ``z``; plain values are unchanged.

    Raises:
        ValueError: if ``z`` has another shape.
    """
    z = core.real_array("z", z)
    if jnp.shape(z) != (size(space),):
        raise ValueError(f"z: expected shape ({size(space)},) for this space, got {jnp.shape(z)}")
    leaves, structure = jax.tree.flatten(space, is_leaf=_is_spec)
    start, values = 0, []
    for leaf in leaves:
        if _is_spec(leaf):
            stop = start + np.size(leaf.low)
            value = TRANSFORMS[leaf.kind][0](z[start:stop], np.shape(leaf.init), *_args(leaf, z.dtype))
            leaf, start = value, stop
        values.append(leaf)
    return jax.tree.unflatten(structure, values)


def bounds(space: PyTree) -> tuple[Array, Array]:
    """The box ``(low (d,), high (d,))`` in the unconstrained coordinates: finite, with the initial values inside."""
    dtype, specs = _dtype(space), _specs(space)
    empty = jnp.zeros((0,), dtype)
    low = jnp.concatenate([empty, *(jnp.asarray(spec.low, dtype) for spec in specs)])
    high = jnp.concatenate([empty, *(jnp.asarray(spec.high, dtype) for spec in specs)])
    return low, high


def sample(space: PyTree, key: Array, n: int) -> Array:
    """``n`` points ``z (n, d)``, uniform in the box."""
    core.check_key(key)
    core.check_count("n", n, 0)
    low, high = bounds(space)
    u = jax.random.uniform(key, (n, low.size), low.dtype)
    return low[None, :] + u * (high - low)[None, :]


def _is_spec(leaf: Any) -> bool:
    return isinstance(leaf, Spec)


def _specs(space: PyTree) -> list[Spec]:
    return [leaf for leaf in jax.tree.leaves(space, is_leaf=_is_spec) if _is_spec(leaf)]


def _dtype(space: PyTree) -> np.dtype:
    """One float dtype for all: that of the arrays in the specs, else of the frozen arrays, else JAX's default."""
    dtypes = {jax.dtypes.canonicalize_dtype(spec.dtype) for spec in _specs(space) if spec.dtype is not None}
    if len(dtypes) > 1:
        raise TypeError(f"space: expected one float dtype, got {sorted(map(str, dtypes))}")
    if not dtypes:
        plain = [leaf for leaf in jax.tree.leaves(space, is_leaf=_is_spec) if not _is_spec(leaf)]
        dtypes = {
            jax.dtypes.canonicalize_dtype(leaf.dtype)
            for leaf in plain
            if _is_float_array(leaf) and not getattr(leaf, "weak_type", False)  # Python floats become weak under jit
        }
    return dtypes.pop() if len(dtypes) == 1 else jax.dtypes.canonicalize_dtype(float)


def _is_float_array(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.floating)


def _initial(spec: Spec, dtype: np.dtype | None) -> Any:
    if dtype is None:  # given as Python numbers: a scalar stays one, so that it takes the dtype of what it meets
        return float(spec.init) if np.ndim(spec.init) == 0 else jnp.asarray(spec.init, float)
    return jnp.asarray(spec.init, dtype)


def _args(spec: Spec, dtype: Any) -> tuple[Array, ...]:
    return tuple(jnp.asarray(arg, dtype) for arg in spec.args)


def _concrete(name: str, x: Any) -> tuple[np.ndarray, np.dtype | None]:
    array = core.numbers(name, x).astype(np.float64)
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite values, got {x}")
    return array, x.dtype if _is_float_array(x) else None


def _like(x: np.ndarray, name: str, end: Any) -> np.ndarray:
    end, _ = _concrete(name, end)
    if end.shape not in {(), x.shape}:
        raise ValueError(f"{name}: expected a scalar or shape {x.shape}, got {end.shape}")
    return np.broadcast_to(end, x.shape)


def _check_box(x: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    if not ((low <= x) & (x <= high)).all():
        raise ValueError(f"init: expected values in [low, high], got {x} outside [{low}, {high}]")


def _with_reach(x: np.ndarray, args: tuple, kind: str, dtype: np.dtype | None) -> Spec:
    """A spec with the box [-REACH, REACH], widened where the initial value lies outside it."""
    z = np.asarray(TRANSFORMS[kind][1](jnp.asarray(x, float), *(jnp.asarray(arg, float) for arg in args)), np.float64)
    return Spec(x, np.minimum(z.ravel(), -REACH), np.maximum(z.ravel(), REACH), args, kind, dtype)
