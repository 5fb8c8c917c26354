"""Logarithm, sine, cosine and arc tangent from operations that XLA vectorizes on CPUs.

There XLA computes ``log`` of float64 and ``sin``, ``cos``, ``atan2`` of any float by one call of the C library per
element. Here they are bit operations, polynomials and selections, without branches or tables. On other backends, and
for the float32 ``log``, which XLA vectorizes itself, these functions are those of ``jax.numpy``; which backend counts
is decided while tracing, by ``jax.default_backend()``.

XLA's code for CPUs takes subnormal numbers for 0; ``log`` reads them bit by bit and has them right.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jax.experimental.xla_metadata import set_xla_metadata

Array = Any


class _Format(NamedTuple):
    """A floating point format, and what is known for it."""

    integer: Any
    mantissa: int  # bits stored
    half_pi: tuple[float, ...]  # parts whose sum it is; products of all but the last with small integers are exact
    sin: tuple[float, ...]  # sin r = r + r z p(z), z = r^2, |r| <= pi / 4
    cos: tuple[float, ...]  # cos r = 1 - z / 2 + z^2 p(z)
    atan: tuple[float, ...]  # atan t = t + t z p(z), z = t^2, |t| <= 1 / 2
    quarter_pi: tuple[float, float]  # small multiples of the first part are exact


# Sine and cosine in float64: K. C. Ng's of fdlibm (Sun Microsystems, 1993). The others are minimax fits of our own.
_FORMATS = {
    np.dtype(np.float64): _Format(
        np.int64,
        52,
        (1.570796251296997, 7.549789415861596e-08, 5.390302529957765e-15, 3.2820035428735005e-22),
        (-1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04,
         2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10),
        (4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05,
         -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11),
        (-0.33333333333332993, 0.19999999999905646, -0.14285714276590103, 0.11111110667839881, -0.09090896436201185,
         0.07692076722623878, -0.06663837637082146, 0.05858471704724795, -0.05122734101451285, 0.04188448236114514,
         -0.027464723298765027, 0.010136782582460915),
        (0.7853981633974483, 3.061616997868383e-17),
    ),
    np.dtype(np.float32): _Format(
        np.int32,
        23,
        (1.5703125, 0.0004837512969970703, 7.549533620476723e-08, 2.5633440682570896e-12),
        (-0.16666654908581846, 0.008332175846921114, -0.0001951697763294446),
        (0.04166664680736568, -0.001388736449090838, 2.4438091340308837e-05),
        (-0.3333323671174205, 0.19994320179120842, -0.1417614041316634, 0.10165395156729554, -0.051414286952925534),
        (0.7853982448577881, -8.146033977632184e-08),
    ),
}  # fmt: skip

# The logarithm's polynomial, as that of fdlibm.
_LOG = (6.666666666666735130e-01, 3.999999999940941908e-01, 2.857142874366239149e-01, 2.222219843214978396e-01,
        1.818357216161805012e-01, 1.531383769920937332e-01, 1.479819860511658591e-01)  # fmt: skip
_LN2 = (6.93147180369123816490e-01, 1.90821492927058770002e-10)  # multiples of the first part are exact


def log(x: Array) -> Array:
    """Natural logarithm, at most 1 ulp from the true value for all float64, subnormal ones included."""
    x = jnp.asarray(x)
    return (instead_of("log", x.dtype) or jnp.log)(x)


def sincos(x: Array) -> tuple[Array, Array]:
    """Sine and cosine.

    At most 1 ulp from the true value where |x| <= 1e5 (float32: 1e3). Up to 2^30 (2^13) that holds of all but values
    next to 0, since pi has so many digits here: they are right to 4e-29 (2e-15). Beyond, the values are those for an
    argument at most 4 ulp from x.

    Args:
        x: angle (rad), any shape.
    """
    return sin(x), cos(x)


def sin(x: Array) -> Array:
    """Sine; see :func:`sincos`."""
    x = jnp.asarray(x)
    return (instead_of("sin", x.dtype) or jnp.sin)(x)


def cos(x: Array) -> Array:
    """Cosine; see :func:`sincos`."""
    x = jnp.asarray(x)
    return (instead_of("cos", x.dtype) or jnp.cos)(x)


def arctan2(y: Array, x: Array) -> Array:
    """Angle of the point (x, y) in [-pi, pi], at most 2 ulp from the true value; signs and infinities as in NumPy."""
    dtype = jnp.result_type(y, x)
    y, x = jnp.broadcast_arrays(jnp.asarray(y, dtype), jnp.asarray(x, dtype))
    return (instead_of("atan2", dtype) or jnp.arctan2)(y, x)


def instead_of(primitive: str, dtype: Any) -> Callable[..., Array] | None:
    """What computes a primitive's value faster than XLA, for arguments of one type and shape, or None."""
    if primitive not in _INSTEAD or jax.default_backend() != "cpu":
        return None
    program, dtypes = _INSTEAD[primitive]
    return program if np.dtype(dtype) in dtypes else None


def _apart(program):
    """A program as a call that XLA does not inline: it would repeat it in every kernel that uses what it gives."""
    program = jax.jit(program)

    @functools.wraps(program)
    def call(*args):
        with set_xla_metadata(inlineable="false"):
            return program(*args)

    return call


@jax.custom_jvp
@_apart
def _log(x):
    bits = lax.bitcast_convert_type(x, np.int64)
    exponent, one = np.int64(0x7FF0000000000000), np.int64(0x3FF0000000000000)
    subnormal = bits < np.int64(1 << 52)
    normalized = lax.bitcast_convert_type(bits | one, x.dtype) - 1.0  # x 2^1022
    whole = lax.select(subnormal, lax.bitcast_convert_type(normalized, np.int64), bits)
    # x = 2^k m with m between sqrt(1/2) and sqrt(2).
    root = np.int64(0x3FE6A09E00000000)
    shifted = whole + (one - root)
    k = _small_integer(lax.shift_right_logical(shifted, np.int64(52)))
    k = k - _pick(subnormal, 1023.0 + 1022.0, 1023.0, x)
    m = lax.bitcast_convert_type((shifted & np.int64((1 << 52) - 1)) + root, x.dtype)
    f = m - 1.0
    s = f / (2.0 + f)
    z = s * s
    half = 0.5 * f * f
    y = k * _LN2[0] - ((half - (s * (half + z * _polynomial(_LOG, z)) + k * _LN2[1])) - f)
    y = _pick(bits == exponent, np.inf, y, x)
    y = _pick((bits < 0) | (bits > exponent), np.nan, y, x)
    return _pick((bits & np.int64(0x7FFFFFFFFFFFFFFF)) == 0, -np.inf, y, x)


@_log.defjvp
def _log_jvp(primals, tangents):
    return _log(*primals), tangents[0] / primals[0]


@jax.custom_jvp
@_apart
def _sincos(x):
    form, dtype = _FORMATS[x.dtype], x.dtype.type
    first, second, third, last = map(dtype, form.half_pi)
    size = abs(x)
    n = lax.round(size * dtype(2 / np.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    near = (size - n * first) - n * second  # exact, as are the products
    r = near - n * third
    rest = ((near - r) - n * third) - n * last  # |x| = n pi/2 + r + rest
    r, rest = (r + rest), rest - ((r + rest) - r)
    # Beyond 2^50 (float32: 2^21) neighbours of x are a radian apart, and nothing is left of what has been subtracted.
    inside = abs(r) <= dtype(1)
    r, rest = lax.select(inside, r, r * dtype(0)), _pick(inside, rest, 0.0, x)
    z = r * r
    cube = z * r
    tail = _polynomial(form.sin[1:], z)
    s = r - ((z * (dtype(0.5) * rest - cube * tail) - rest) - cube * dtype(form.sin[0]))
    half = dtype(0.5) * z
    w = dtype(1) - half
    c = w + (((dtype(1) - w) - half) + (z * (z * _polynomial(form.cos, z)) - r * rest))
    # The last two bits of n end the sum with a large number. The second of them is moved to the sign's place.
    quadrant = lax.bitcast_convert_type(n + dtype(2.0**form.mantissa), form.integer)
    to_sign = form.integer(8 * x.dtype.itemsize - 2)
    odd = (quadrant & form.integer(1)) != 0
    return (
        _flip(lax.select(odd, c, s), (quadrant << to_sign) ^ lax.bitcast_convert_type(x, form.integer)),
        _flip(lax.select(odd, s, c), (quadrant + form.integer(1)) << to_sign),
    )


@_sincos.defjvp
def _sincos_jvp(primals, tangents):
    s, c = _sincos(*primals)
    return (s, c), (c * tangents[0], -(s * tangents[0]))


@jax.custom_jvp
@_apart
def _arctan2(y, x):
    form, dtype = _FORMATS[x.dtype], x.dtype.type
    up, along = abs(y), abs(x)
    steep, backward = up > along, lax.bitcast_convert_type(x, form.integer) < 0
    a, b = lax.select(steep, along, up), lax.select(steep, up, along)
    scale = _pick(b > dtype(np.finfo(x.dtype).max / 4), 0.25, 1.0, x)
    a, b = a * scale, b * scale
    # atan(a / b) is pi/4 + atan((a - b) / (a + b)): the argument is at most 1/2.
    far = (a > dtype(0.5) * b) | (a == dtype(np.inf))
    t = lax.select(far, a - b, a) / lax.select(far, a + b, b)
    t = _pick(a == b, 0.0, t, x)  # both may be 0 or infinite
    k = _pick(far, 1.0, 0.0, x)
    k = lax.select(steep, dtype(2) - k, k)
    k = lax.select(backward, dtype(4) - k, k)
    t = lax.select(steep != backward, -t, t)
    z = t * t
    high, low = map(dtype, form.quarter_pi)
    angle = k * high + (t + (t * (z * _polynomial(form.atan, z)) + k * low))
    return _flip(angle, lax.bitcast_convert_type(y, form.integer))


@functools.partial(_arctan2.defjvp, symbolic_zeros=True)
def _arctan2_jvp(primals, tangents):
    y, x = primals
    square = x * x + y * y
    tangent = lax.full_like(x, 0)
    for d, part in zip(tangents, (x / square, -y / square), strict=True):
        tangent = tangent if isinstance(d, SymbolicZero) else tangent + d * part
    return _arctan2(y, x), tangent


_INSTEAD: dict[str, tuple[Callable[..., Array], Collection[Any]]] = {
    "log": (_log, (np.dtype(np.float64),)),
    "sin": (lambda x: _sincos(x)[0], _FORMATS),
    "cos": (lambda x: _sincos(x)[1], _FORMATS),
    "atan2": (_arctan2, _FORMATS),
}


def _polynomial(coefficients, z):
    total = lax.full_like(z, coefficients[-1])
    for c in coefficients[-2::-1]:
        total = total * z + z.dtype.type(c)
    return total


def _pick(condition, a, b, like):
    """Where the condition holds a, else b; numbers are taken as arrays like ``like``."""
    a, b = (lax.full_like(like, v) if isinstance(v, float) else v for v in (a, b))
    return lax.select(condition, a, b)


def _flip(x, bits):
    """X with its sign changed where the sign bit of the integers is set."""
    sign = bits & bits.dtype.type(np.iinfo(bits.dtype).min)
    return lax.bitcast_convert_type(lax.bitcast_convert_type(x, bits.dtype) ^ sign, x.dtype)


def _small_integer(n):
    """An int64 in [0, 2^52) as float64; AVX2 has no such conversion."""
    return lax.bitcast_convert_type(n | np.int64(0x4330000000000000), np.float64) - 2.0**52
