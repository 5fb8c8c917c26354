"""How each primitive that is not elementwise acts on entries: movement, reductions and products, control.

A rule is ``(interpreter, equation, entries of its inputs) -> entries of its outputs``, or NotImplemented.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfilt.linalg.entries import is_known, known, line, shaped

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
    return all(is_known(e) for e in x.ravel())


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
        table = line([_fill(eqn), *itertools.chain.from_iterable(ins[i].ravel() for i in operands)])
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
    if is_known(which[()]):
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
        out = self.run_closed(p["jaxpr"], [*consts, *carry, *(x[t : t + 1].reshape(x.shape[1:]) for x in xs)])
        carry, ys[t] = out[: p["num_carry"]], out[p["num_carry"] :]
    return [*carry, *(np.stack(column) for column in zip(*ys, strict=True))]


def _custom_jvp(self, eqn, ins):
    """Scalars in, scalars out, with the derivative rule kept: it is there because that of the program is not finite."""
    flat = [x for entry in ins for x in entry.ravel()]
    traced = [i for i, x in enumerate(flat) if not is_known(x)]
    if not traced:
        return self.run_closed(eqn.params["call_jaxpr"], ins)
    known_outputs: list[Any] = []
    weight: list[int] = []

    def arrays(scalars, rest):
        values = list(rest)
        for i, x in zip(traced, scalars, strict=True):
            values[i] = x
        return shaped(values, [entry.shape for entry in ins])

    def dense(*args):
        return eqn.primitive.bind(*args, **eqn.primitive.get_bind_params(eqn.params))

    def program(*scalars):
        inner = type(self)(self.limit)
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
        out = type(self)(self.limit).run_closed(closed, [*x, *(dx[i] for i in moving)])
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
        if is_known(x):
            constants[index] = x
        else:
            which[index] = numbers.setdefault(id(x), len(numbers))
    return which, constants


RULES: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast_in_dim, "reshape": _reshape, "slice": _slice, "pad": _pad, "iota": _iota,
    "split": _split, "stack": _stack, "tile": _tile, "cumsum": _cumsum, "dot_general": _dot_general, "scan": _scan,
    "squeeze": _reshape, "expand_dims": _reshape,
    "reshard": lambda self, eqn, ins: [ins[0]],  # of a constant, within shard_map
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
