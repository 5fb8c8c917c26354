"""The interval observer: bounds on the state that hold for every model in a box and every noise within its bounds."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import Filter, Info, Prediction, Static, Status, bind, check_flag, flag, is_concrete
from jaxfilt.filters.common import check_dtype, check_measurement, innovate
from jaxfilt.models.linear import check_finite, check_shape, common_dtype


class IntervalState(NamedTuple):
    """Bounds on x_k from y_1..k-1, and the sample that the next prediction uses."""

    lower: Array  # (n,)
    upper: Array  # (n,)
    y: Array  # (m,) 0 where absent
    usable: Array  # (m,) bool


class _Params(NamedTuple):
    A_low: Array
    A_high: Array
    C: Array
    L: Array
    w_low: Array
    w_high: Array
    v_bound: Array
    x_low: Array
    x_high: Array
    B: Array | None
    nonnegative: Static


def interval_observer(
    A_low: Any,
    A_high: Any,
    C: Any,
    L: Any,
    *,
    w_low: Any,
    w_high: Any,
    v_bound: Any,
    x_low: Any,
    x_high: Any,
    B: Any = None,
    nonnegative: bool = False,
) -> Filter:
    """Guaranteed bounds for ``x_k = A_k x_{k-1} + B u_k + w_k``, ``y_k = C x_k + v_k``.

    ``A_low <= A_k <= A_high`` (it may vary from step to step), ``w_low <= w_k <= w_high`` and ``|v_k| <= v_bound``,
    elementwise; nothing is assumed about distributions. With ``M+ = A_high - L C``, ``M- = A_low - L C``::

        upper_k = M+ upper_{k-1} + L y_{k-1} + B u_k + |L| v_bound + w_high
        lower_k = M- lower_{k-1} + L y_{k-1} + B u_k - |L| v_bound + w_low

    ``M- >= 0`` makes both errors positive recursions, so ``lower <= x <= upper`` at every step if it holds before the
    first; a Schur ``M+`` keeps the width bounded. Find L by a linear program (Ait Rami and Tadeo).

    An absent component of y_{k-1} takes its column of L with it. What is then negative in M+ and M- meets the opposite
    bound, so the bounds still hold, but widen, without limit if A itself is not Schur.

    Step k's bounds rest on the samples before it: y_k enters through the next prediction. ``info.mean`` is the middle
    of the interval, ``info.extra["lower"]`` and ``["upper"]`` (n,) are its ends. There is no covariance and no
    likelihood: the filter states what is possible, not what is probable.

    Status: MISSED, NONFINITE (the component is treated as absent), BOUND (a sample that no state within the bounds and
    no noise within its own explains: the model is wrong; the bounds go on as if it were not).

    Args:
        A_low: (n, n).
        A_high: (n, n), nowhere below A_low.
        C: (m, n).
        L: (n, m) gain.
        w_low: (n,) or scalar.
        w_high: (n,) or scalar.
        v_bound: (m,) or scalar, >= 0.
        x_low: (n,) or scalar, bounds before the first prediction.
        x_high: (n,) or scalar.
        B: (n, p) input matrix; None = no input.
        nonnegative: the user guarantees x >= 0. The lower bound is kept at 0 or above, and A_low may differ from
            A_high; for x < 0 the two would not bound A x.

    Raises:
        ValueError: wrong shapes; (concrete arrays) non-finite values, ``A_low > A_high`` (names the entry), a negative
            entry of ``A_low - L C``, ``A_high - L C`` not Schur, bounds the wrong way round, an uncertain A without
            ``nonnegative``; at trace time ``dt``, ``q_scale``, ``r_scale``, or ``u`` without B.
        TypeError: integer arrays or mixed float dtypes.

    Source: Gouze, Rapaport and Hadj-Sadok 2000; the dual of the output feedback of Bagheri and Binazadeh 2019.
    """
    given: dict[str, Any] = {"A_low": A_low, "A_high": A_high, "C": C, "L": L, "w_low": w_low, "w_high": w_high,
                             "v_bound": v_bound, "x_low": x_low, "x_high": x_high}  # fmt: skip
    if B is not None:
        given["B"] = B
    dtype = common_dtype(given)
    a = {name: jnp.asarray(x, dtype) for name, x in given.items()}
    check_shape("A_low", a["A_low"], (None, None))
    check_shape("C", a["C"], (None, None))
    n, m = a["A_low"].shape[0], a["C"].shape[0]
    if n == 0:
        raise ValueError(f"A_low: expected shape (n, n) with n >= 1, got {a['A_low'].shape}")
    for name, shape in {"A_low": (n, n), "A_high": (n, n), "C": (m, n), "L": (n, m)}.items():
        check_shape(name, a[name], shape)
    for name, size in (("w_low", n), ("w_high", n), ("v_bound", m), ("x_low", n), ("x_high", n)):
        if a[name].ndim == 0:
            a[name] = jnp.broadcast_to(a[name], (size,))
        check_shape(name, a[name], (size,))
    if B is not None:
        check_shape("B", a["B"], (n, None))
    for name, x in a.items():
        check_finite(name, x)
    check_flag("nonnegative", nonnegative)
    if is_concrete(a):
        _check({name: np.asarray(x) for name, x in a.items()}, nonnegative)
    params = _Params(**{"B": None, **a}, nonnegative=Static(nonnegative))
    return bind(params, _init, _predict, _update)


def _check(a: dict[str, np.ndarray], nonnegative: bool) -> None:
    """What the guarantee rests on."""
    for low, high in (("A_low", "A_high"), ("w_low", "w_high"), ("x_low", "x_high")):
        wrong = np.argwhere(a[low] > a[high])
        if len(wrong):
            at = tuple(int(i) for i in wrong[0])
            raise ValueError(f"{low}: is above {high} at {list(at)}: {a[low][at]} > {a[high][at]}")
    if (a["v_bound"] < 0).any():
        raise ValueError(f"v_bound: expected bounds >= 0, got {a['v_bound']}")
    if not nonnegative and (a["A_low"] != a["A_high"]).any():
        raise ValueError(
            "A_high: differs from A_low, which bounds A x only where x >= 0; guarantee that by nonnegative"
        )
    if nonnegative and (a["x_high"] < 0).any():
        raise ValueError(f"x_high: expected values >= 0 with nonnegative, got {a['x_high']}")
    LC = a["L"] @ a["C"]
    low, high = a["A_low"] - LC, a["A_high"] - LC
    # relative to what was subtracted, so that a design with zero entries survives rounding
    rounding = 10 * np.finfo(low.dtype).eps * (np.abs(a["A_low"]) + np.abs(a["L"]) @ np.abs(a["C"]))
    if (low < -rounding).any():
        raise ValueError(f"L: expected A_low - L C >= 0, got {low.tolist()}")
    radius = np.abs(np.linalg.eigvals(high.astype(np.float64))).max()
    if radius >= 1:
        raise ValueError(f"L: expected A_high - L C to be Schur, but its spectral radius is {radius:.6g}")


def _init(p, inp):
    check_dtype(inp, p.x_low)
    check_measurement(inp, p.C.shape[0], "the observer's C")
    zero = jnp.zeros((), inp.y.dtype)
    lower = jnp.maximum(p.x_low, zero) if p.nonnegative.value else p.x_low
    return IntervalState(lower, p.x_high, jnp.zeros_like(inp.y), jnp.zeros(inp.y.shape, bool))


def _predict(p, state, inp):
    for name in ("dt", "q_scale", "r_scale"):
        if getattr(inp, name) is not None:
            raise ValueError(f"{name}: the interval observer cannot honour it")
    if inp.u is not None and p.B is None:
        raise ValueError("u: given, but the observer has no B")
    zero = jnp.zeros((), state.y.dtype)
    L = jnp.where(state.usable[None, :], p.L, zero)
    known = L @ state.y
    if p.B is not None and inp.u is not None:
        known = known + p.B @ inp.u
    spread = jnp.abs(L) @ p.v_bound
    high, low = p.A_high - L @ p.C, p.A_low - L @ p.C
    upper = _above(high, state.lower, state.upper) + known + spread + p.w_high
    lower = -_above(-low, state.lower, state.upper) + known - spread + p.w_low
    if p.nonnegative.value:
        lower = jnp.maximum(lower, zero)
    return state._replace(lower=lower, upper=upper), Prediction(_middle(lower, upper))


def _update(p, state, inp):
    middle = _middle(state.lower, state.upper)
    innovation = innovate(inp, p.C @ middle)
    usable = jnp.isfinite(inp.y) if inp.mask is None else jnp.isfinite(inp.y) & inp.mask
    y = jnp.where(usable, inp.y, jnp.zeros((), inp.y.dtype))
    possible = (y <= _above(p.C, state.lower, state.upper) + p.v_bound) & (
        y >= -_above(-p.C, state.lower, state.upper) - p.v_bound
    )
    status = innovation.status | flag((usable & ~possible).any(), Status.BOUND)
    info = Info(
        middle, None, innovation.value, None, None, None, status, extra={"lower": state.lower, "upper": state.upper}
    )
    return state._replace(y=y, usable=usable), info


def _above(M: Array, lower: Array, upper: Array) -> Array:
    """The largest M x for x in the interval."""
    zero = jnp.zeros((), M.dtype)
    return jnp.maximum(M, zero) @ upper + jnp.minimum(M, zero) @ lower


def _middle(lower: Array, upper: Array) -> Array:
    return 0.5 * (lower + upper)
