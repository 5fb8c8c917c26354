"""Small-matrix programs as programs on scalars, for batches.

Under ``vmap`` a step on 4x4 matrices becomes batched products, factorisations and slices, none of which XLA runs well
on CPUs. Interpreted entry by entry the same step becomes a few hundred scalar operations; ``vmap`` turns each into one
elementwise operation over the batch. What is known while tracing (zeros of a transition matrix, masks that pick a
triangle) is computed then and costs nothing later, and equal expressions are computed once, so that the two triangles
of a symmetric matrix are one.

An array is interpreted as a NumPy object array, the *entries*: NumPy scalars where the value is known, 0-d JAX values
elsewhere. Primitives without a rule here run as they are on the assembled array (``opaque`` counts them).

``0 * x`` is taken as 0: a NaN or infinity in x does not spread through entries that are zero by structure.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax

Entries = np.ndarray  # of dtype object

LARGEST = 1024  # entries of one array; beyond, a program on scalars is neither compiled nor run in reasonable time


class NoScalarForm(Exception):
    """A program has too many scalars, or something that is not made of scalars."""


class Interpreter:
    """Evaluates jaxprs on entries. One per trace: equal expressions are emitted once.

    Args:
        limit: number of scalar operations beyond which :class:`NoScalarForm` is raised.
    """

    def __init__(self, limit: int) -> None:  # noqa: D107
        self.count = 0  # scalar operations emitted
        self.opaque: list[str] = []  # primitives that ran on arrays
        self.limit = limit
        self._known: dict[Any, Any] = {}
        self._inputs: dict[int, tuple[Any, ...]] = {}  # by id of what was emitted; keeps all values, so ids stay valid
        self._weights: dict[int, int] = {}  # operations of what is more than one

    def run(self, jaxpr: Any, consts: Sequence[Any], args: Sequence[Any]) -> list[Any]:
        """The outputs, as entries, of an open jaxpr."""
        env: dict[Any, Any] = {}

        def read(v):
            return known(np.asarray(v.val, v.aval.dtype)) if hasattr(v, "val") else env[v]

        for variables, values in ((jaxpr.constvars, consts), (jaxpr.invars, args)):
            for variable, x in zip(variables, values, strict=True):
                env[variable] = x
        for eqn in jaxpr.eqns:
            out = self._equation(eqn, [read(v) for v in eqn.invars])
            for variable, x in zip(eqn.outvars, out, strict=True):
                env[variable] = x
        return [read(v) for v in jaxpr.outvars]

    def _equation(self, eqn, ins):
        name, params = eqn.primitive.name, eqn.params
        if name in _INLINED:
            inner = next(params[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in params)
            if name == "jit" and params["name"] in _INSTEAD:
                out = self._shorter(ins, *_INSTEAD[params["name"]])
                if out is not None:
                    return out
            return self.run_closed(inner, ins)
        if name in _ELEMENTWISE:
            return [self._elementwise(eqn, ins)]
        if (rule := _RULES.get(name)) is not None:
            out = rule(self, eqn, ins)
            if out is not NotImplemented:
                return out
        return self._as_it_is(eqn, ins)

    def _shorter(self, ins, program, ranks, serves):
        """What the other program gives (see :func:`instead`), or None if it does not serve."""
        if any(x.ndim != rank for x, rank in zip(ins, ranks[-len(ins) :], strict=True)):
            return None  # under a vmap within the step, along axes that cannot be told from the shapes
        if not serves(*ins):
            return None
        missing = len(ranks) - len(ins)  # leading arguments that are None
        avals = [jax.ShapeDtypeStruct(x.shape, x.ravel()[0].dtype) for x in ins]
        return self.run_closed(jax.make_jaxpr(functools.partial(program, *[None] * missing))(*avals), ins)

    def run_closed(self, closed: Any, args: Sequence[Any]) -> list[Any]:
        """As :meth:`run` for a closed jaxpr (or an open one without constants)."""
        if not hasattr(closed, "jaxpr"):
            return self.run(closed, (), args)
        return self.run(closed.jaxpr, [entries(c) for c in closed.consts], args)

    def _as_it_is(self, eqn, ins):
        self.opaque.append(eqn.primitive.name)
        params = eqn.primitive.get_bind_params(eqn.params)
        out = eqn.primitive.bind(*(assemble(x, v.aval) for x, v in zip(ins, eqn.invars, strict=True)), **params)
        return [entries(x) for x in (out if eqn.primitive.multiple_results else [out])]

    def _elementwise(self, eqn, ins):
        out = eqn.outvars[0].aval
        ins = [np.broadcast_to(x, out.shape) for x in ins]
        result = np.empty(out.shape, object)
        emit = functools.partial(self.op, eqn.primitive, eqn.params, out.dtype)
        for index in np.ndindex(out.shape):
            result[index] = emit(*(x[index] for x in ins))
        return result

    def op(self, primitive: Any, params: dict[str, Any], dtype: Any, *xs: Any) -> Any:
        """One scalar operation, folded if its value is known, emitted once if it is not."""
        name = primitive.name
        if all(isinstance(x, np.generic) for x in xs):
            return _evaluate(primitive, params, dtype, xs)
        if name in _FOLDS and (folded := _FOLDS[name](self, dtype, params, *xs)) is not None:
            return folded
        keys = [(x.dtype.str, x.tobytes()) if isinstance(x, np.generic) else id(x) for x in xs]
        if name in _COMMUTATIVE:
            keys.sort(key=repr)
        plain = _PLAIN.get(name)
        key = (name, None if plain else repr(sorted(params.items(), key=lambda item: item[0])), *keys)
        if key not in self._known:
            self.count += 1
            if self.count > self.limit:
                raise NoScalarForm(f"more than {self.limit} scalar operations")
            self._known[key] = plain(*xs) if plain else primitive.bind(*xs, **params)
            self._inputs[id(self._known[key])] = xs
        return self._known[key]

    def needed(self, outputs: Any) -> int:
        """How many of the operations emitted the ``outputs`` (scalars) need; the compiler leaves the others out."""
        seen: set[int] = set()
        todo = list(outputs)
        while todo:
            x = todo.pop()
            if id(x) not in seen and id(x) in self._inputs:
                seen.add(id(x))
                todo.extend(self._inputs[id(x)])
        return sum(self._weights.get(i, 1) for i in seen)

    def _choose(self, condition, a, b):
        """Entries of a where the scalar condition holds, else of b."""
        out = np.empty(a.shape, object)
        for index in np.ndindex(a.shape):
            out[index] = self.op(lax.select_n_p, {}, a[index].dtype, condition, b[index], a[index])
        return out

    # Shorthands for rules.
    def add(self, a: Any, b: Any) -> Any:
        """a + b."""
        return self.op(lax.add_p, {}, _dtype(a), a, b)

    def sub(self, a: Any, b: Any) -> Any:
        """a - b."""
        return self.op(lax.sub_p, {}, _dtype(a), a, b)

    def mul(self, a: Any, b: Any) -> Any:
        """a * b."""
        return self.op(lax.mul_p, {}, _dtype(a), a, b)

    def dot(self, a: Sequence[Any], b: Sequence[Any], dtype: Any) -> Any:
        """The inner product of two sequences of scalars."""
        total = np.dtype(dtype).type(0)
        for x, y in zip(a, b, strict=True):
            total = self.add(total, self.mul(x, y))
        return total


def _array(x):
    return x if isinstance(x, np.ndarray) else _line([x]).reshape(())


def _dtype(x):
    return x.dtype


def known(x: Any) -> Entries:
    """Entries of known values."""
    x = np.asarray(x)
    out = np.empty(x.shape, object)
    for index in np.ndindex(x.shape):
        out[index] = x[index]
    return out


def entries(x: Any, zeros: np.ndarray | None = None) -> Entries:
    """Entries of an array; those where ``zeros`` is true are known to be 0. NumPy arrays are known altogether."""
    if isinstance(x, Entries) and x.dtype == object:
        return x
    if isinstance(x, np.ndarray | np.generic):
        return known(x)
    x = jnp.asarray(x)
    if jnp.issubdtype(x.dtype, jax.dtypes.extended):  # random keys have no entries that could be computed with
        out = np.empty((), object)
        out[()] = x
        return out
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


# Elementwise primitives: what they give for known values, and what is known for some values.

_INLINED = {"jit", "pjit", "closed_call", "core_call", "custom_vjp_call", "remat", "checkpoint", "custom_lin"}
# Without parameters that matter; called by their functions, which know those that JAX adds for itself.
_PLAIN: dict[str, Callable[..., Any]] = {
    "add": lax.add, "add_any": lax.add, "sub": lax.sub, "mul": lax.mul, "div": lax.div, "neg": lax.neg,
    "max": lax.max, "min": lax.min, "eq": lax.eq, "ne": lax.ne, "lt": lax.lt, "le": lax.le, "gt": lax.gt,
    "ge": lax.ge, "and": lax.bitwise_and, "or": lax.bitwise_or, "not": lax.bitwise_not, "select_n": lax.select_n,
}  # fmt: skip
_COMMUTATIVE = {"add", "mul", "max", "min", "and", "or", "xor", "eq", "ne", "add_any"}
_NUMPY: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative, "sqrt": np.sqrt,
    "max": np.maximum, "min": np.minimum, "abs": np.abs, "sign": np.sign, "floor": np.floor, "exp": np.exp,
    "log": np.log, "sin": np.sin, "cos": np.cos, "atan2": np.arctan2, "square": np.square, "is_finite": np.isfinite,
    "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
    "and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor, "not": np.invert, "add_any": np.add,
    "pow": np.power,
}  # fmt: skip
_ELEMENTWISE = {
    *_NUMPY, "log1p", "expm1", "tan", "tanh", "asin", "acos", "atan", "sinh", "cosh", "asinh", "acosh", "atanh",
    "logistic", "rsqrt", "cbrt", "erf", "erfc", "erf_inv", "igamma", "igammac", "lgamma", "digamma", "integer_pow",
    "round", "ceil", "rem",
    "nextafter", "clamp", "select_n", "convert_element_type",  "stop_gradient", "reduce_precision", "exp2", "copy",
    "shift_left", "shift_right_logical", "shift_right_arithmetic", "population_count", "copy_p", "lt_to", "le_to",
}  # fmt: skip


def _evaluate(primitive, params, dtype, xs):
    name = primitive.name
    if name == "convert_element_type":
        return np.asarray(xs[0]).astype(dtype)[()]
    if name in ("copy", "copy_p", "stop_gradient"):
        return xs[0]
    if name == "select_n":
        return xs[1 + int(xs[0])]
    if name == "integer_pow" and params["y"] >= 0:
        return np.asarray(xs[0] ** params["y"], dtype)[()]
    if name == "div" and not np.issubdtype(dtype, np.floating):
        name = "integer division"  # rounds towards zero, NumPy does not
    if name in _NUMPY:
        with np.errstate(all="ignore"):
            return np.asarray(_NUMPY[name](*xs), dtype)[()]
    with jax.ensure_compile_time_eval():
        return np.asarray(primitive.bind(*(jnp.asarray(x) for x in xs), **params), dtype)[()]


def _is(x, value):
    return isinstance(x, np.generic) and x == value


def _fold_add(self, dtype, params, a, b):
    return b if _is(a, 0) else a if _is(b, 0) else None


def _fold_sub(self, dtype, params, a, b):
    if _is(b, 0):
        return a
    if _is(a, 0):
        return self.op(lax.neg_p, {}, dtype, b)
    return np.zeros((), dtype)[()] if a is b and not np.issubdtype(dtype, np.floating) else None


def _fold_mul(self, dtype, params, a, b):
    for x, y in ((a, b), (b, a)):
        if _is(x, 0):
            return np.zeros((), dtype)[()]
        if _is(x, 1):
            return y
        if _is(x, -1):
            return self.op(lax.neg_p, {}, dtype, y)
    return None


def _fold_div(self, dtype, params, a, b):
    if not np.issubdtype(dtype, np.floating):
        return None
    if _is(a, 0):
        return np.zeros((), dtype)[()]
    if isinstance(b, np.generic):
        with np.errstate(all="ignore"):
            inverse = np.asarray(np.divide(1, b), dtype)[()]
        return self.mul(a, inverse) if np.isfinite(inverse) and np.frexp(b)[0] in (0.5, -0.5) else None
    if _is(a, 1):
        return None
    # One reciprocal for all that is divided by b: XLA keeps every division, and a division costs several products.
    return self.mul(a, self.op(lax.div_p, {}, dtype, np.ones((), dtype)[()], b))


def _fold_and(self, dtype, params, a, b):
    if dtype != np.bool_:
        return None
    for x, y in ((a, b), (b, a)):
        if isinstance(x, np.generic):
            return y if x else np.False_
    return a if a is b else None


def _fold_or(self, dtype, params, a, b):
    if dtype != np.bool_:
        return b if _is(a, 0) else a if _is(b, 0) else None
    for x, y in ((a, b), (b, a)):
        if isinstance(x, np.generic):
            return np.True_ if x else y
    return a if a is b else None


def _fold_select(self, dtype, params, which, *cases):
    if isinstance(which, np.generic):
        return cases[int(which)]
    first = cases[0]
    same = all(c is first or (isinstance(c, np.generic) and _is(first, c)) for c in cases[1:])
    return first if same else None


def _fold_power(self, dtype, params, x):
    y = params["y"]
    if y == 0:
        return np.ones((), dtype)[()]
    if y == 1:
        return x
    return self.mul(x, x) if y == 2 else None


def _fold_convert(self, dtype, params, x):
    return x if x.dtype == dtype and not getattr(x, "weak_type", False) else None


def _fold_neg(self, dtype, params, x):
    return None


def _fold_max(self, dtype, params, a, b):
    return a if a is b else None


_FOLDS: dict[str, Callable[..., Any]] = {
    "add": _fold_add, "add_any": _fold_add, "sub": _fold_sub, "mul": _fold_mul, "div": _fold_div, "and": _fold_and,
    "or": _fold_or, "select_n": _fold_select, "integer_pow": _fold_power, "convert_element_type": _fold_convert,
    "square": lambda self, dtype, params, x: self.mul(x, x), "copy": lambda self, dtype, params, x: x,
    "max": _fold_max, "min": _fold_max,
}  # fmt: skip


# Movement of data: the same movement of the entries.


def _broadcast_in_dim(self, eqn, ins):
    x, shape = ins[0], eqn.params["shape"]
    if len(ins) > 1:
        return NotImplemented
    wide = [1] * len(shape)
    for axis, size in zip(eqn.params["broadcast_dimensions"], x.shape, strict=True):
        wide[axis] = size
    return [np.broadcast_to(x.reshape(wide), shape)]


def _reshape(self, eqn, ins):
    return [ins[0].reshape(eqn.outvars[0].aval.shape)]


def _slice(self, eqn, ins):
    p = eqn.params
    strides = p["strides"] or (1,) * len(p["start_indices"])
    return [ins[0][tuple(map(slice, p["start_indices"], p["limit_indices"], strides))]]


def _pad(self, eqn, ins):
    x, value = ins
    out = np.empty(eqn.outvars[0].aval.shape, object)
    out.fill(value[()])
    target, source = [], []
    for (low, _, interior), size, total in zip(eqn.params["padding_config"], x.shape, out.shape, strict=True):
        positions = low + np.arange(size) * (interior + 1)
        inside = (positions >= 0) & (positions < total)
        target.append(positions[inside])
        source.append(np.arange(size)[inside])
    out[np.ix_(*target)] = x[np.ix_(*source)]
    return [out]


def _iota(self, eqn, ins):
    out = eqn.outvars[0].aval
    along = np.arange(out.shape[eqn.params["dimension"]]).astype(out.dtype)
    wide = [1] * len(out.shape)
    wide[eqn.params["dimension"]] = -1
    return [known(np.broadcast_to(along.reshape(wide), out.shape))]


def _split(self, eqn, ins):
    return np.split(ins[0], np.cumsum(eqn.params["sizes"])[:-1], axis=eqn.params["axis"])


def _stack(self, eqn, ins):
    return [np.stack(ins, axis=eqn.params.get("axis", eqn.params.get("dimension", 0)))]


def _tile(self, eqn, ins):
    return [np.tile(ins[0], eqn.params["reps"])]


def _all_known(x):
    return all(isinstance(e, np.generic) for e in x.ravel())


def _values(x, aval):
    return np.array(list(x.ravel()), aval.dtype).reshape(aval.shape)


def _moved(operands):
    """Rule of a primitive that only moves entries: it is run on labels. The other operands (indices) must be known."""

    def rule(self, eqn, ins):
        if not all(_all_known(x) for i, x in enumerate(ins) if i not in operands):
            return NotImplemented
        labels, first = {}, 1
        for i in operands:
            labels[i] = np.arange(first, first + ins[i].size, dtype=np.int32).reshape(ins[i].shape)
            first += ins[i].size
        with jax.ensure_compile_time_eval():
            args = [
                jnp.asarray(labels[i] if i in labels else _values(x, eqn.invars[i].aval)) for i, x in enumerate(ins)
            ]
            params = dict(eqn.params)
            if "fill_value" in params:
                params["fill_value"] = 0
            out = np.asarray(eqn.primitive.bind(*args, **params))
        table = _line([_fill(eqn), *itertools.chain.from_iterable(ins[i].ravel() for i in operands)])
        return [table[out]]

    return rule


def _fill(eqn):
    dtype = eqn.outvars[0].aval.dtype
    fill = eqn.params.get("fill_value")
    if fill is None:  # what jnp reads beyond the end
        fill = np.nan if np.issubdtype(dtype, np.floating) else 0
    return np.asarray(fill).astype(dtype)[()]


def _scatter_add(self, eqn, ins):
    (operand, indices, updates), p = ins, eqn.params
    if not _all_known(indices):
        return NotImplemented
    with jax.ensure_compile_time_eval():
        labels = jnp.zeros(operand.shape, jnp.int32)
        numbers = jnp.asarray(np.arange(1, updates.size + 1, dtype=np.int32).reshape(updates.shape))
        index = jnp.asarray(_values(indices, eqn.invars[1].aval))
        numbered = lax.scatter(labels, index, numbers, p["dimension_numbers"], mode=p["mode"])
        out = np.asarray(numbered)
        count = np.asarray(lax.scatter_add(labels, index, numbers * 0 + 1, p["dimension_numbers"], mode=p["mode"]))
    if (count > 1).any():
        return NotImplemented
    flat = updates.ravel()
    result = operand.copy()
    for at in np.argwhere(out > 0):
        at = tuple(at)
        result[at] = self.add(result[at], flat[out[at] - 1])
    return [result]


def _dynamic_slice(self, eqn, ins):
    """With an index known only when it runs (a ring buffer's): chosen from all places it may point to."""
    if (out := _moved((0,))(self, eqn, ins)) is not NotImplemented:
        return out
    x, *starts = ins
    sizes = eqn.params["slice_sizes"]
    out = x
    for axis, (start, size) in enumerate(zip(starts, sizes, strict=True)):
        last = out.shape[axis] - size
        rows = [np.take(out, range(at, at + size), axis) for at in range(last + 1)]
        chosen = rows[0]
        for at in range(1, last + 1):
            here = self.op(lax.ge_p, {}, np.dtype(bool), start[()], start[()].dtype.type(at))
            chosen = self._choose(here, rows[at], chosen)
        out = chosen
    return [out]


def _dynamic_update_slice(self, eqn, ins):
    if (out := _moved((0, 1))(self, eqn, ins)) is not NotImplemented:
        return out
    x, update, *starts = ins
    open_axes = [i for i, (total, size) in enumerate(zip(x.shape, update.shape, strict=True)) if total != size]
    if len(open_axes) != 1:
        return NotImplemented
    (axis,) = open_axes
    start, size = starts[axis][()], update.shape[axis]
    last = x.shape[axis] - size
    result = x
    for at in range(last + 1):
        within = [slice(None)] * x.ndim
        within[axis] = slice(at, at + size)
        comparison = lax.le_p if at == 0 else lax.ge_p if at == last else lax.eq_p  # clamped, as the primitive does
        here = self.op(comparison, {}, np.dtype(bool), start, start.dtype.type(at))
        result = result.copy()
        result[tuple(within)] = self._choose(here, update, result[tuple(within)])
    return [result]


def _arg(better):
    def rule(self, eqn, ins):
        (axis,) = eqn.params["axes"]
        dtype = np.dtype(eqn.params["index_dtype"])
        rows = np.moveaxis(ins[0], axis, -1)
        result = np.empty(rows.shape[:-1], object)
        for index in np.ndindex(result.shape):
            best, where = rows[index][0], dtype.type(0)
            for i, x in enumerate(rows[index][1:], 1):
                nan = self.op(lax.ne_p, {}, np.dtype(bool), x, x)
                found = self.op(lax.or_p, {}, np.dtype(bool), nan, self.op(better, {}, np.dtype(bool), x, best))
                found = self.op(lax.and_p, {}, np.dtype(bool), found, self.op(lax.eq_p, {}, np.dtype(bool), best, best))
                best = self.op(lax.select_n_p, {}, x.dtype, found, best, x)
                where = self.op(lax.select_n_p, {}, dtype, found, where, dtype.type(i))
            result[index] = where
        return [result]

    return rule


# Reductions and products.


def _reduce(primitive):
    def rule(self, eqn, ins):
        x = ins[0]
        axes = tuple(eqn.params["axes"])
        out = eqn.outvars[0].aval
        rest = [i for i in range(x.ndim) if i not in axes]
        rows = np.transpose(x, [*rest, *axes]).reshape(*[x.shape[i] for i in rest], -1)
        if rows.shape[-1] == 0:
            return NotImplemented
        result = np.empty(out.shape, object)
        for index in np.ndindex(out.shape):
            row = rows[index]
            total = row[0]
            for y in row[1:]:
                total = self.op(primitive, {}, out.dtype, total, y)
            result[index] = total
        return [result]

    return rule


def _dot_general(self, eqn, ins):
    a, b = ins
    (contract_a, contract_b), (batch_a, batch_b) = eqn.params["dimension_numbers"]
    free_a = [i for i in range(a.ndim) if i not in (*contract_a, *batch_a)]
    free_b = [i for i in range(b.ndim) if i not in (*contract_b, *batch_b)]
    out = eqn.outvars[0].aval
    batch = [a.shape[i] for i in batch_a]
    n = int(np.prod([a.shape[i] for i in contract_a]))
    A = np.transpose(a, [*batch_a, *free_a, *contract_a]).reshape(*batch, -1, n)
    B = np.transpose(b, [*batch_b, *free_b, *contract_b]).reshape(*batch, -1, n)
    result = np.empty((*batch, A.shape[-2], B.shape[-2]), object)
    for index in np.ndindex(*batch):
        for i, j in itertools.product(range(A.shape[-2]), range(B.shape[-2])):
            result[(*index, i, j)] = self.dot(A[(*index, i)], B[(*index, j)], out.dtype)
    return [result.reshape(out.shape)]


def _cumsum(self, eqn, ins):
    axis = eqn.params["axis"]
    x = np.moveaxis(np.flip(ins[0], axis) if eqn.params["reverse"] else ins[0], axis, 0).copy()
    for i in range(1, x.shape[0]):
        for index in np.ndindex(x.shape[1:]):
            x[(i, *index)] = self.add(x[(i - 1, *index)], x[(i, *index)])
    x = np.moveaxis(x, 0, axis)
    return [np.flip(x, axis) if eqn.params["reverse"] else x]


# Control.


def _platform_index(self, eqn, ins):
    platform = jax.default_backend()
    for index, names in enumerate(eqn.params["platforms"]):
        if names is None or platform in names or (platform == "gpu" and {"cuda", "rocm"} & set(names)):
            return [known(np.int32(index))]
    return NotImplemented


def _cond(self, eqn, ins):
    which, *rest = ins
    branches = eqn.params["branches"]
    if isinstance(which[()], np.generic):
        return self.run_closed(branches[int(np.clip(which[()], 0, len(branches) - 1))], rest)
    # All are computed, as under vmap.
    out = self.run_closed(branches[0], rest)
    for i, branch in enumerate(branches[1:], 1):
        here = self.op(lax.ge_p, {}, np.dtype(bool), which[()], which[()].dtype.type(i))
        out = [self._choose(here, new, old) for new, old in zip(self.run_closed(branch, rest), out, strict=True)]
    return out


def _scan(self, eqn, ins):
    p = eqn.params
    if p["length"] * len(p["jaxpr"].jaxpr.eqns) > 200:
        return NotImplemented
    consts, carry, xs = (
        ins[: p["num_consts"]],
        ins[p["num_consts"] : p["num_consts"] + p["num_carry"]],
        ins[p["num_consts"] + p["num_carry"] :],
    )
    ys: list[Any] = [None] * p["length"]
    for t in range(p["length"])[:: -1 if p["reverse"] else 1]:
        out = self.run_closed(p["jaxpr"], [*consts, *carry, *(_array(x[t]) for x in xs)])
        carry, ys[t] = out[: p["num_carry"]], out[p["num_carry"] :]
    return [*carry, *(np.stack(column) for column in zip(*ys, strict=True))]


def _line(values):
    """A 1-d object array; assigned one by one, since NumPy would convert a slice of traced values."""
    out = np.empty(len(values), object)
    for i, x in enumerate(values):
        out[i] = x
    return out


def _custom_jvp(self, eqn, ins):
    """Scalars in, scalars out, with the derivative rule kept: it is there because that of the program is not finite."""
    flat = [x for entry in ins for x in entry.ravel()]
    traced = [i for i, x in enumerate(flat) if not isinstance(x, np.generic)]
    if not traced:
        return self.run_closed(eqn.params["call_jaxpr"], ins)
    known_outputs: list[Any] = []
    weight: list[int] = []

    def arrays(scalars, rest):
        values = list(rest)
        for i, x in zip(traced, scalars, strict=True):
            values[i] = x
        parts = np.split(_line(values), np.cumsum([entry.size for entry in ins])[:-1])
        return [part.reshape(entry.shape) for part, entry in zip(parts, ins, strict=True)]

    def dense(*args):
        return eqn.primitive.bind(*args, **eqn.primitive.get_bind_params(eqn.params))

    def program(*scalars):
        inner = Interpreter(self.limit)
        out = inner.run_closed(eqn.params["call_jaxpr"], arrays(scalars, flat))
        weight[:] = [inner.count]
        numbers: dict[int, int] = {}  # entries that are the same are one output, known ones are none
        known_outputs[:] = [_numbered(entry, numbers) for entry in out]
        distinct = {id(x): x for entry in out for x in entry.ravel()}
        return tuple(distinct[i] for i in numbers)

    f = jax.custom_jvp(program)

    @f.defjvp
    def f_jvp(primals, tangents):
        """What the primitive's own rule gives, interpreted; booleans and integers have no tangent."""
        if not known_outputs:  # differentiated before it ran
            jax.eval_shape(program, *primals)
        avals = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in eqn.invars]
        moving = [i for i, aval in enumerate(avals) if jnp.issubdtype(aval.dtype, jnp.floating)]

        def derivative(args, dargs):
            return jax.jvp(lambda *xs: dense(*_put(args, moving, xs)), [args[i] for i in moving], dargs)

        closed = jax.make_jaxpr(derivative)(avals, [avals[i] for i in moving])
        x, dx = arrays(primals, flat), arrays(tangents, [np.zeros((), e.dtype)[()] for e in flat])
        out = Interpreter(self.limit).run_closed(closed, [*x, *(dx[i] for i in moving)])
        pairs: dict[int, Any] = {}
        for (numbers, _), y, dy in zip(known_outputs, out[: len(out) // 2], out[len(out) // 2 :], strict=True):
            for number, a, b in zip(numbers.ravel(), y.ravel(), dy.ravel(), strict=True):
                if number >= 0:
                    pairs.setdefault(int(number), (jnp.asarray(a), jnp.asarray(b)))
        ordered = [pairs[i] for i in range(len(pairs))]
        return tuple(a for a, _ in ordered), tuple(b for _, b in ordered)

    values = f(*(flat[i] for i in traced))
    self.count += weight[0]
    for x in values:
        self._inputs[id(x)] = (*(flat[i] for i in traced), *values)
        self._weights[id(x)] = weight[0] if x is values[0] else 0
    result = []
    for numbers, constants in known_outputs:
        array = constants.copy()
        for index in np.argwhere(numbers >= 0):
            array[tuple(index)] = values[numbers[tuple(index)]]
        result.append(array)
    return result


def _put(args, at, xs):
    out = list(args)
    for i, x in zip(at, xs, strict=True):
        out[i] = x
    return out


def _numbered(entry, numbers):
    """``(numbers, entries)``: which distinct traced value each entry is, -1 for known ones, which are the entries."""
    which, constants = np.full(entry.shape, -1), np.empty(entry.shape, object)
    for index in np.ndindex(entry.shape):
        x = entry[index]
        if isinstance(x, np.generic):
            constants[index] = x
        else:
            which[index] = numbers.setdefault(id(x), len(numbers))
    return which, constants


_RULES: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast_in_dim, "reshape": _reshape, "slice": _slice, "pad": _pad, "iota": _iota,
    "split": _split, "stack": _stack, "tile": _tile, "cumsum": _cumsum, "dot_general": _dot_general, "scan": _scan,
    "squeeze": _reshape, "expand_dims": _reshape,
    "transpose": lambda self, eqn, ins: [np.transpose(ins[0], eqn.params["permutation"])],
    "concatenate": lambda self, eqn, ins: [np.concatenate(ins, axis=eqn.params["dimension"])],
    "rev": lambda self, eqn, ins: [np.flip(ins[0], eqn.params["dimensions"])],
    "gather": _moved((0,)), "dynamic_slice": _dynamic_slice, "scatter": _moved((0, 2)),
    "dynamic_update_slice": _dynamic_update_slice, "scatter-add": _scatter_add,
    "argmin": _arg(lax.lt_p), "argmax": _arg(lax.gt_p), "reduce_sum": _reduce(lax.add_p),
    "reduce_max": _reduce(lax.max_p), "reduce_min": _reduce(lax.min_p),
    "reduce_prod": _reduce(lax.mul_p), "reduce_or": _reduce(lax.or_p), "reduce_and": _reduce(lax.and_p),
    "platform_index": _platform_index, "cond": _cond, "custom_jvp_call": _custom_jvp,
}  # fmt: skip

# Functions under jit that have another program for scalars, by name.
_INSTEAD: dict[str, tuple[Callable[..., Any], tuple[int, ...], Callable[..., bool]]] = {}


def instead(function: Any, program: Callable[..., Any], ranks: tuple[int, ...], serves: Callable[..., bool]) -> None:
    """Where ``function`` is met, interprets ``program`` if it serves.

    Args:
        function: under ``jax.jit``, known by its name.
        program: the same function of the same arguments, written so that it is short on scalars.
        ranks: of the arguments. Leading ones may be None.
        serves: ``(*entries) -> bool`` of the arguments that are not None, whether ``program`` is valid for them.
    """
    _INSTEAD[function.__name__] = program, ranks, serves


def is_zero(x: Any) -> bool:
    """Whether an entry is known to be 0."""
    return _is(x, 0)
