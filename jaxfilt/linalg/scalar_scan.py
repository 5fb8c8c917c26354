"""``lax.scan`` of a small-matrix step as a scan over scalars; see :mod:`jaxfilt.linalg.scalarize`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfilt import checkpointed
from jaxfilt.linalg import segments, structure
from jaxfilt.linalg.entries import NoScalarForm, entries, is_known, shaped
from jaxfilt.linalg.scalarize import Interpreter

PyTree = Any

# Scalar operations in a step up to which the scalar form runs faster than the dense one, and the most that are traced.
WORTHWHILE, MOST = 2000, 20_000


def scan(
    init: Callable[[PyTree, PyTree], PyTree],
    step: Callable[[PyTree, PyTree, PyTree], tuple[PyTree, PyTree]],
    params: PyTree,
    xs: PyTree,
    labels: tuple[structure.Labels | None, ...],
    *,
    keep: str,
    limit: int,
    segment: int | None = None,
) -> PyTree:
    """The outputs of ``step`` over the leading axis of ``xs``, from ``init(params, first x)``; see :func:`collect`.

    Only what varies is carried: entries of the state that stay equal to each other (the two triangles of a covariance)
    are carried once, those that keep a known value (zeros) not at all. Which these are is found by assuming all that
    holds of the initial state and dropping what a step breaks, until a step breaks nothing.

    Args:
        init: ``(params, x) -> state``.
        step: ``(params, state, x) -> (state, outputs)``.
        params: pytree of arrays.
        xs: pytree with leading T.
        labels: for each leaf of ``params`` what is known of its entries, or None.
        keep: "stack", "sum" or "last".
        segment: as in :func:`collect`.
        limit: largest number of scalar operations in a step, those that the outputs do not need apart.

    Raises:
        NoScalarForm: more operations than ``limit``, too large an array, or a primitive that has no scalar form.
    """
    first = jax.tree.map(lambda leaf: leaf[0], xs)
    const = []
    for leaf, known in zip(jax.tree.leaves(params), labels, strict=True):
        const.append(entries(leaf, None if known is None else structure.unpack(known)))

    closed, spec = jax.make_jaxpr(init, return_shape=True)(params, first)
    start = Interpreter(MOST)
    state = start.run_closed(closed, [*const, *(entries(x) for x in jax.tree.leaves(first))])
    _refuse(start.opaque)
    state_avals = [v.aval for v in closed.jaxpr.outvars]
    spec = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), spec)
    closed, (_, out_spec) = jax.make_jaxpr(step, return_shape=True)(params, spec, first)
    out_tree = jax.tree.structure(out_spec)
    out_avals = [v.aval for v in closed.jaxpr.outvars[len(state_avals) :]]

    flat = [x for entry in state for x in entry.ravel()]
    dtypes = [a.dtype for a, entry in zip(state_avals, state, strict=True) for _ in range(entry.size)]
    rows = jax.tree.leaves(xs)
    split = [_columns(leaf) for leaf in rows]
    shapes = [*(a.shape for a in state_avals), *(leaf.shape[1:] for leaf in rows)]

    def run(classes, carry, x):
        """One step: ``(flat entries of the next state, entries of the outputs, operations that they need)``."""
        interpreter = Interpreter(MOST)
        values = [c if is_known(c) else carry[c] for c in classes]
        given = shaped([*values, *(entry for columns in x for entry in columns)], shapes)
        out = interpreter.run_closed(closed, [*const, *given])
        _refuse(interpreter.opaque)
        flat = [y for entry in out for y in entry.ravel()]
        return flat[: len(classes)], out[len(state) :], interpreter.needed(flat)

    classes = _classes(flat, dtypes, [None] * len(flat))
    while True:
        after: list[Any] = []

        def trace(carry, x, classes=classes, after=after):
            after[:] = run(classes, carry, x)
            return 0

        carry = _carry(classes, flat, dtypes)
        jax.eval_shape(trace, carry, jax.tree.map(lambda column: column[0], split))
        refined = _classes(after[0], dtypes, classes)
        if refined == classes:
            break
        classes = refined
    if after[2] > limit:
        raise NoScalarForm(f"more than {limit} scalar operations")

    # Of the outputs too a step gives what varies; the rest is put in at the end.
    plans = [_distinct(entry)[0] for entry in after[1]]

    def body(carry, x):
        after, outs, _ = run(classes, carry, x)
        given = [
            jnp.stack(_distinct(entry)[1] or [jnp.zeros((), a.dtype)]) for entry, a in zip(outs, out_avals, strict=True)
        ]
        return _carry(classes, after, dtypes), given

    carry = _carry(classes, flat, dtypes)
    if after[2] > segments.MANY:
        body = segments.segmented(body, carry, jax.tree.map(lambda column: column[0], split))
    # Checkpointed: the reverse pass keeps the carry only and computes one step again.
    body = jax.checkpoint(body, prevent_cse=False)
    _, outs = collect(body, carry, split, keep, segment)
    steps = rows[0].shape[0] if keep == "sum" else 1
    expanded = [_expand(x, plan, a, steps) for x, plan, a in zip(outs, plans, out_avals, strict=True)]
    return jax.tree.unflatten(out_tree, expanded)


def collect(
    body: Callable[[PyTree, PyTree], tuple[PyTree, PyTree]],
    carry: PyTree,
    xs: PyTree,
    keep: str,
    segment: int | None = None,
) -> PyTree:
    """``lax.scan`` that stacks the outputs, or returns without a history their sum or the last.

    In a sum the bits of integers (status words) are united, as are booleans. With a ``segment`` it is checkpointed
    every so many steps.
    """
    run = lax.scan if segment is None else partial(checkpointed.scan, segment=segment)
    if keep == "stack":
        return run(body, carry, xs)
    _, spec = jax.eval_shape(body, carry, jax.tree.map(lambda leaf: leaf[0], xs))
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), spec)

    def both(state, x):
        carry, kept, lost = state
        carry, out = body(carry, x)
        if keep == "last":
            return (carry, out, lost), None
        leaves, tree = jax.tree.flatten(kept)
        added = [_add(*each) for each in zip(leaves, jax.tree.leaves(lost), jax.tree.leaves(out), strict=True)]
        return (carry, *(tree.unflatten(part) for part in zip(*added, strict=True))), None

    carry, kept, _ = run(both, (carry, empty, empty), xs)[0]
    return carry, kept


def _add(total, lost, x):
    """The sum and what its rounding lost, which in float32 goes into the next one (Kahan): 1e6 steps add up."""
    if not jnp.issubdtype(x.dtype, jnp.inexact):
        return total | x, lost
    if x.dtype == jnp.float64:
        return total + x, lost
    x = x - lost
    new = total + x
    return new, (new - total) - x


def _distinct(out):
    """For each entry its value, if it is known, or its number among the distinct ones; and these."""
    numbers: dict[int, int] = {}
    distinct: list[Any] = []
    plan: list[Any] = []
    for x in out.ravel():
        if not is_known(x) and id(x) not in numbers:
            numbers[id(x)] = len(distinct)
            distinct.append(x)
        plan.append(x if is_known(x) else numbers[id(x)])
    return plan, distinct


def _expand(x, plan, aval, steps):
    """The output (..., *shape) from its distinct entries (..., k); known floats are those of ``steps`` steps."""
    if plan == list(range(x.shape[-1])):
        return x.reshape(*x.shape[:-1], *aval.shape)
    columns = []
    for entry in plan:
        if is_known(entry):
            value = entry * steps if jnp.issubdtype(aval.dtype, jnp.inexact) else entry
            columns.append(jnp.broadcast_to(jnp.asarray(value, aval.dtype), x.shape[:-1]))
        else:
            columns.append(x[..., entry])
    return jnp.stack(columns, axis=-1).reshape(*x.shape[:-1], *aval.shape)


def _columns(leaf):
    """An input (T, ...) as one (T,) array per entry: over a batch these are contiguous rows, not columns."""
    if jnp.issubdtype(leaf.dtype, jax.dtypes.extended):
        raise NoScalarForm("random keys")
    return [leaf[(slice(None), *index)] for index in np.ndindex(leaf.shape[1:])]


def _refuse(opaque):
    if left := set(opaque) - {"eigh"}:  # which costs the same in either form
        raise NoScalarForm(f"no scalar form of {', '.join(sorted(left))}")


def _classes(flat, dtypes, before):
    """Numbers the distinct traced entries among those of one class before; known entries that were known stay so."""
    numbers: dict[Any, int] = {}
    out: list[Any] = []
    for x, dtype, old in zip(flat, dtypes, before, strict=True):
        if is_known(x) and (old is None or (is_known(old) and old.tobytes() == x.tobytes())):
            out.append(x)
        else:
            was = old.tobytes() if is_known(old) else old
            now = x.tobytes() if is_known(x) else id(x)
            out.append(numbers.setdefault((dtype.str, was, now), len(numbers)))
    return out


def _carry(classes, flat, dtypes):
    carry: dict[int, Any] = {}
    for c, x, dtype in zip(classes, flat, dtypes, strict=True):
        if not is_known(c) and c not in carry:
            carry[c] = lax.convert_element_type(x, dtype)
    return [carry[c] for c in range(len(carry))]
