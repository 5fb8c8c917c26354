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
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax import lax

from jaxfilt.linalg import elementary
from jaxfilt.linalg.entries import NoScalarForm, assemble, entries, is_known, known
from jaxfilt.linalg.scalar_ops import COMMUTATIVE, ELEMENTWISE, FOLDS, PLAIN, evaluate
from jaxfilt.linalg.scalar_rules import RULES

_INLINED = {"jit", "pjit", "closed_call", "core_call", "custom_vjp_call", "remat", "checkpoint", "custom_lin"}


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
        if name in ELEMENTWISE:
            return [self._elementwise(eqn, ins)]
        if (rule := RULES.get(name)) is not None:
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
        if all(is_known(x) for x in xs):
            return evaluate(primitive, params, dtype, xs)
        if name in FOLDS and (folded := FOLDS[name](self, dtype, params, *xs)) is not None:
            return folded
        keys = [(x.dtype.str, x.tobytes()) if is_known(x) else id(x) for x in xs]
        if name in COMMUTATIVE:
            keys.sort(key=repr)
        plain = PLAIN.get(name) or elementary.instead_of(name, dtype)
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
        return self.op(lax.add_p, {}, a.dtype, a, b)

    def sub(self, a: Any, b: Any) -> Any:
        """a - b."""
        return self.op(lax.sub_p, {}, a.dtype, a, b)

    def mul(self, a: Any, b: Any) -> Any:
        """a * b."""
        return self.op(lax.mul_p, {}, a.dtype, a, b)

    def dot(self, a: Sequence[Any], b: Sequence[Any], dtype: Any) -> Any:
        """The inner product of two sequences of scalars."""
        total = np.dtype(dtype).type(0)
        for x, y in zip(a, b, strict=True):
            total = self.add(total, self.mul(x, y))
        return total


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
