"""Elementwise primitives on scalars: what they give for known values, and what is known for some values."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxfilt.linalg.entries import is_known, is_value, is_zero

# Without parameters that matter; called by their functions, which know those that JAX adds for itself.
PLAIN: dict[str, Callable[..., Any]] = {
    "add": lax.add, "add_any": lax.add, "sub": lax.sub, "mul": lax.mul, "div": lax.div, "neg": lax.neg,
    "max": lax.max, "min": lax.min, "eq": lax.eq, "ne": lax.ne, "lt": lax.lt, "le": lax.le, "gt": lax.gt,
    "ge": lax.ge, "and": lax.bitwise_and, "or": lax.bitwise_or, "not": lax.bitwise_not, "select_n": lax.select_n,
}  # fmt: skip
COMMUTATIVE = {"add", "mul", "max", "min", "and", "or", "xor", "eq", "ne", "add_any"}
_NUMPY: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative, "sqrt": np.sqrt,
    "max": np.maximum, "min": np.minimum, "abs": np.abs, "sign": np.sign, "floor": np.floor, "exp": np.exp,
    "log": np.log, "sin": np.sin, "cos": np.cos, "atan2": np.arctan2, "square": np.square, "is_finite": np.isfinite,
    "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
    "and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor, "not": np.invert, "add_any": np.add,
    "pow": np.power,
}  # fmt: skip
ELEMENTWISE = {
    *_NUMPY, "log1p", "expm1", "tan", "tanh", "asin", "acos", "atan", "sinh", "cosh", "asinh", "acosh", "atanh",
    "logistic", "rsqrt", "cbrt", "erf", "erfc", "erf_inv", "igamma", "igammac", "lgamma", "digamma", "integer_pow",
    "round", "ceil", "rem",
    "nextafter", "clamp", "select_n", "convert_element_type",  "stop_gradient", "reduce_precision", "exp2", "copy",
    "shift_left", "shift_right_logical", "shift_right_arithmetic", "population_count", "copy_p", "lt_to", "le_to",
}  # fmt: skip


def evaluate(primitive: Any, params: dict[str, Any], dtype: Any, xs: tuple[Any, ...]) -> Any:
    """The value of a primitive of known scalars."""
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


def _fold_add(self, dtype, params, a, b):
    return b if is_zero(a) else a if is_zero(b) else None


def _fold_sub(self, dtype, params, a, b):
    if is_zero(b):
        return a
    if is_zero(a):
        return self.op(lax.neg_p, {}, dtype, b)
    return np.zeros((), dtype)[()] if a is b and not np.issubdtype(dtype, np.floating) else None


def _fold_mul(self, dtype, params, a, b):
    for x, y in ((a, b), (b, a)):
        if is_zero(x):
            return np.zeros((), dtype)[()]
        if is_value(x, 1):
            return y
        if is_value(x, -1):
            return self.op(lax.neg_p, {}, dtype, y)
    return None


def _fold_div(self, dtype, params, a, b):
    if not np.issubdtype(dtype, np.floating):
        return None
    if is_zero(a):
        return np.zeros((), dtype)[()]
    if is_known(b):
        with np.errstate(all="ignore"):
            inverse = np.asarray(np.divide(1, b), dtype)[()]
        return self.mul(a, inverse) if np.isfinite(inverse) and np.frexp(b)[0] in (0.5, -0.5) else None
    if is_value(a, 1):
        return None
    # One reciprocal for all that is divided by b: XLA keeps every division, and a division costs several products.
    return self.mul(a, self.op(lax.div_p, {}, dtype, np.ones((), dtype)[()], b))


def _fold_and(self, dtype, params, a, b):
    if dtype != np.bool_:
        return None
    for x, y in ((a, b), (b, a)):
        if is_known(x):
            return y if x else np.False_
    return a if a is b else None


def _fold_or(self, dtype, params, a, b):
    if dtype != np.bool_:
        return b if is_zero(a) else a if is_zero(b) else None
    for x, y in ((a, b), (b, a)):
        if is_known(x):
            return np.True_ if x else y
    return a if a is b else None


def _fold_select(self, dtype, params, which, *cases):
    if is_known(which):
        return cases[int(which)]
    first = cases[0]
    same = all(c is first or (is_known(c) and is_value(first, c)) for c in cases[1:])
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


def _fold_max(self, dtype, params, a, b):
    return a if a is b else None


FOLDS: dict[str, Callable[..., Any]] = {
    "add": _fold_add, "add_any": _fold_add, "sub": _fold_sub, "mul": _fold_mul, "div": _fold_div, "and": _fold_and,
    "or": _fold_or, "select_n": _fold_select, "integer_pow": _fold_power, "convert_element_type": _fold_convert,
    "square": lambda self, dtype, params, x: self.mul(x, x), "copy": lambda self, dtype, params, x: x,
    "max": _fold_max, "min": _fold_max,
}  # fmt: skip
