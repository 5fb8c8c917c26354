"""Gains of fixed-gain tracking filters: the rules by which they are chosen, and what a choice costs.

One axis, interval ``dt``: ``e = z - p``, then ``p += alpha e``, ``v += (beta / dt) e``, ``a += (kappa / dt^2) e``.
A rule of order 1 (the motion is a line) returns ``(alpha, beta)``, one of order 2 (a parabola)
``(alpha, beta, kappa)``::

    jf.alpha_beta(*jf.gains.kalata(0.3), dt=1.0)
    jf.alpha_beta_gamma(*jf.gains.kalata(0.3, order=2), dt=1.0)

Everything is a pure elementwise function: it can be traced, batched and differentiated. Invalid concrete arguments
raise a ValueError that names them; under a transformation nothing raises. Equation numbers "thesis, eq. (c-n)" are
those of "Target tracking when the target is lost on a part of its path" (master's thesis, in Persian), corrected where
the printed formula is wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import is_concrete, numbers

Pair = tuple[Any, Any]
Triple = tuple[Any, Any, Any]

# kappa = factor * gamma
_CONVENTIONS = {"kappa": 1.0, "double": 2.0, "kalata": 0.5}
# beta (2 - alpha) - alpha^2 = c beta^2 in the steady state, for each kind of process noise; see `kalata`.
_NOISE = {"piecewise": 1 / 4, "velocity": 0.0, "continuous": 1 / 6}


def to_kappa(gamma: Any, convention: str) -> Any:
    """The acceleration gain kappa (``a += kappa / dt^2 e``) of a published gamma.

    Args:
        gamma: as published, any shape.
        convention: ``"kappa"``: kappa = gamma (Simpson 1963); ``"double"``: kappa = 2 gamma (thesis, eqs. (2-35),
            (2-44), (2-49)); ``"kalata"``: kappa = gamma / 2 (Kalata 1984; Bar-Shalom, Li and Kirubarajan 2001).

    Raises:
        ValueError: unknown convention.
    """
    _numbers("gamma", gamma)
    return gamma * _option("convention", convention, _CONVENTIONS)


def from_kappa(kappa: Any, convention: str) -> Any:
    """The gamma of a convention that has the acceleration gain kappa; the inverse of :func:`to_kappa`."""
    _numbers("kappa", kappa)
    return kappa / _option("convention", convention, _CONVENTIONS)


def benedict_bordner(alpha: Any) -> Pair:
    """``(alpha, beta)`` with ``beta = alpha^2 / (2 - alpha)``, the best transient for a given noise reduction.

    Args:
        alpha: in (0, 4 - 2 sqrt(2)), where the rule is stable.

    Raises:
        ValueError: alpha outside that interval.

    Source: Benedict and Bordner 1962; thesis, eq. (2-24).
    """
    limit = 4 - 2 * np.sqrt(2.0)
    _require("alpha", alpha, lambda x: (x > 0) & (x < limit), "in (0, 4 - 2 sqrt(2))")
    return alpha, alpha * alpha / (2 - alpha)


def simpson(alpha: Any, beta: Any) -> Triple:
    """``(alpha, beta, kappa)`` that satisfies ``2 beta = alpha (alpha + beta + kappa / 2)``.

    The counterpart of :func:`benedict_bordner` for order 2. kappa is 0 where beta is Benedict and Bordner's, negative
    (unstable) below it.

    Raises:
        ValueError: alpha not in (0, 2).

    Source: Simpson 1963; Neal 1967; thesis, eq. (2-50).
    """
    _require("alpha", alpha, lambda x: (x > 0) & (x < 2), "in (0, 2)")
    _require("beta", beta, np.isfinite, "finite values")
    return alpha, beta, 2 * beta * (2 - alpha) / alpha - 2 * alpha


def cohen() -> tuple[float, float]:
    """``(0.5, 0.167)``, Benedict and Bordner's rule at alpha = 1/2 to three digits. Source: Cohen, in the thesis."""
    return 0.5, 0.167


def fading_memory(xi: Any, *, order: int = 1) -> tuple[Any, ...]:
    """Gains of the exponentially weighted least-squares line or parabola: critically damped, all poles at ``xi``.

    Order 1: ``(1 - xi^2, (1 - xi)^2)``. Order 2: ``(1 - xi^3, 3/2 (1 - xi)^2 (1 + xi), (1 - xi)^3)``.

    Args:
        xi: in [0, 1); towards 1 the memory grows and the smoothing with it.
        order: 1 (line) or 2 (parabola).

    Raises:
        ValueError: xi outside [0, 1), or another order.

    Source: Morrison 1969; thesis, eqs. (2-27), (2-28); order 2: Brookner 1998, section 1.3.
    """
    _require("xi", xi, lambda x: (x >= 0) & (x < 1), "in [0, 1)")
    left = 1 - xi
    if _order(order) == 1:
        return left * (1 + xi), left * left
    return left * (1 + xi + xi * xi), 1.5 * left * left * (1 + xi), left * left * left


def growing_memory(k: Any, *, order: int = 1) -> tuple[Array, ...]:
    """Gains of the k-th measurement that give the least-squares line or parabola through the first k.

    Order 1: ``alpha = 2 (2k - 1) / (k (k+1))``, ``beta = 6 / (k (k+1))`` for k >= 2. Order 2, with
    ``d = k (k+1) (k+2)``: ``alpha = 3 (3k^2 - 3k + 2) / d``, ``beta = 18 (2k - 1) / d``, ``kappa = 60 / d`` for k >= 3.
    While k measurements do not determine the curve, the gains are those of the curve of degree k - 1 through them:
    ``(1, 0)``, and for order 2 ``(1, 0, 0)`` and ``(1, 1, 0)``. The gains go to 0: floor them to follow a target, as
    ``jf.alpha_beta(start="growing")`` does.

    Args:
        k: number of the measurement, counted from 1, any shape; float, or integer (then the gains have the default
            float dtype).
        order: 1 (line) or 2 (parabola).

    Raises:
        ValueError: k < 1, or another order.

    Source: thesis, eq. (2-32) (Simpson); order 2: Brookner 1998, section 1.2; the first gains are ours.
    """
    _require("k", k, lambda x: x >= 1, ">= 1")
    _order(order)
    if isinstance(k, int):
        k = float(k)  # stays weakly typed
    elif hasattr(k, "dtype") and not jnp.issubdtype(k.dtype, jnp.floating):
        k = jnp.asarray(k).astype(jnp.result_type(float))
    k = jnp.maximum(jnp.asarray(k), 1.0)
    if order == 1:
        d = k * (k + 1)
        return 2 * (2 * k - 1) / d, jnp.where(k < 2, 0.0, 6 / d)
    d = k * (k + 1) * (k + 2)
    beta = jnp.where(k < 2, 0.0, jnp.where(k < 3, 1.0, 18 * (2 * k - 1) / d))
    return 3 * (3 * k * k - 3 * k + 2) / d, beta, jnp.where(k < 3, 0.0, 60 / d)


def tracking_index(q: Any, r: Any, *, dt: Any, noise: str = "piecewise") -> Any:
    """The tracking index of :func:`kalata`: how far the target's unpredictable motion exceeds the sensor's noise.

    Args:
        q: process noise. ``"piecewise"``: variance of the acceleration, constant over each interval [m^2/s^4] (order 2:
            of its increment), index ``sqrt(q / r) dt^2``. ``"velocity"``: variance of the velocity's increment per
            interval [m^2/s^2], index ``sqrt(q / r) dt``. ``"continuous"``: spectral density of white acceleration
            [m^2/s^3], index ``sqrt(q / r) dt^(3/2)``.
        r: measurement variance [m^2].
        dt: interval [s].
        noise: as above.

    Raises:
        ValueError: q, r or dt not positive, or another noise.

    Source: Kalata 1984.
    """
    _option("noise", noise, _NOISE)
    for name, x in (("q", q), ("r", r), ("dt", dt)):
        _positive(name, x)
    power = {"piecewise": 4, "velocity": 2, "continuous": 3}[noise]
    return jnp.sqrt(q / r * dt**power)


def kalata(index: Any, *, order: int = 1, noise: str = "piecewise") -> tuple[Array, ...]:
    """The steady-state Kalman gains of a target with the given tracking index, in closed form.

    Order 1: with ``s = sqrt(1 - alpha)`` the steady state satisfies ``beta = index s`` and
    ``beta (2 - alpha) - alpha^2 = c beta^2``, where c = 1/4 for piecewise constant white acceleration, 1/6 for
    continuous white acceleration and 0 for noise in the velocity only (Benedict and Bordner's rule). Both are solved by
    ``w = s + 1/s = (index + sqrt((1 - 4c) index^2 + 16)) / 2``. For c = 1/4 it is Kalata's
    ``alpha = 1 - s^2, s = (4 + index - sqrt(8 index + index^2)) / 4``.
    Order 2 (an acceleration that jumps by white increments): ``beta = 2 (2 - alpha) - 4 sqrt(1 - alpha)``,
    ``kappa = beta^2 / (2 alpha)``, ``index = kappa / sqrt(1 - alpha)``.

    The derivative is infinite at index = 0: tune its logarithm.

    Args:
        index: positive, any shape; see :func:`tracking_index`.
        order: 1 (constant velocity) or 2 (constant acceleration, ``noise="piecewise"`` only).
        noise: ``"piecewise"``, ``"continuous"`` or ``"velocity"``.

    Returns:
        ``(alpha, beta)``, or ``(alpha, beta, kappa)`` for order 2.

    Raises:
        ValueError: index not positive, another order or noise, or no closed form for them.

    Source: Kalata 1984; Gray and Murray 1993; the form for all three noises is ours, from the Riccati equation.
    """
    _positive("index", index)
    c = _option("noise", noise, _NOISE)
    if _order(order) == 1:
        w = 0.5 * (index + jnp.sqrt((1 - 4 * c) * index * index + 16))
        difference = jnp.sqrt(index * (w - c * index))  # 1/s - s = sqrt(w^2 - 4), without its cancellation
        s = 2 / (w + difference)
        return s * difference, index * s
    if noise != "piecewise":
        raise ValueError(f'noise: order 2 has a closed form for "piecewise" only, got {noise!r}')
    # With s = sqrt(1 - alpha) = (t - 1) / (t + 1) the condition is t^3 - t = 8 / index. Newton's method from above the
    # root converges monotonically, and unlike Cardano's formula it has no seam where three roots become one.
    target = 8 / jnp.asarray(index)
    t = jax.lax.fori_loop(0, 8, lambda _, t: t - (t * (t * t - 1) - target) / (3 * t * t - 1), 1 + jnp.cbrt(target))
    u = t + 1
    return 4 * t / (u * u), 8 / (u * u), 8 / (t * u * u)


def is_stable(alpha: Any, beta: Any, kappa: Any = None) -> Any:
    """Whether a filter with these gains is stable (Jury's test, exact): bool, elementwise.

    Order 1: ``0 < alpha < 2``, ``0 < beta < 4 - 2 alpha``. Order 2 moreover ``kappa > 0`` and
    ``2 alpha beta > kappa (2 - alpha)``.

    Source: Jury 1964; thesis, eq. (2-23) corrected (its bound on beta is missing).
    """
    for name, x in (("alpha", alpha), ("beta", beta), ("kappa", 0.0 if kappa is None else kappa)):
        _numbers(name, x)
    stable = (alpha > 0) & (alpha < 2) & (beta > 0) & (beta < 4 - 2 * alpha)
    return stable if kappa is None else stable & (kappa > 0) & (2 * alpha * beta > kappa * (2 - alpha))


def variance_reduction(alpha: Any, beta: Any, kappa: Any = None, *, dt: Any) -> tuple[Any, ...]:
    """Steady variances of the estimates per unit variance of white measurement noise.

    Returns:
        ``(position [1], velocity [1/s^2])``, for order 2 also ``acceleration [1/s^4]``. Meaningless for unstable gains.

    Raises:
        ValueError: dt not positive, or gains that are not stable.

    Source: thesis, eqs. (2-18), (2-19) and (2-45) to (2-47), the latter with kappa.
    """
    C = _scaled_covariance(alpha, beta, kappa, dt)
    return tuple(C[i][i] / dt ** (2 * i) for i in range(len(C)))


def steady_covariance(alpha: Any, beta: Any, kappa: Any = None, *, dt: Any, r: Any = 1.0) -> Array:
    """Steady covariance of the estimates of one axis under white measurement noise of variance ``r``.

    The solution of ``C = A C A' + r K K'``, ``A = (I - K G) F``, for scalar gains (batch with vmap). The lag behind
    a maneuver is not in it: see :func:`steady_lag`.

    Returns:
        (2, 2), or (3, 3) for order 2, over position, velocity (, acceleration).

    Raises:
        ValueError: dt or r not positive, or gains that are not stable.

    Source: thesis, eq. (2-17); order 2 off the diagonal is ours.
    """
    _positive("r", r)
    C = _scaled_covariance(alpha, beta, kappa, dt)
    rows = [jnp.stack([jnp.asarray(r * x / dt ** (i + j)) for j, x in enumerate(row)]) for i, row in enumerate(C)]
    return jnp.stack(rows)


def steady_lag(alpha: Any, beta: Any, kappa: Any = None, *, dt: Any, rate: Any = 1.0) -> tuple[Any, ...]:
    """Steady errors (truth minus estimate) behind a target that moves by one derivative more than the filter models.

    Args:
        alpha: position gain.
        beta: velocity gain.
        kappa: acceleration gain, None for order 1.
        dt: interval [s].
        rate: the target's constant acceleration [m/s^2], for order 2 its constant jerk [m/s^3].

    Returns:
        ``(position, predicted position, velocity)``, for order 2 also ``acceleration``. Order 1:
        ``a dt^2 (1 - alpha) / beta``, ``a dt^2 / beta``, ``a dt (2 alpha - beta) / (2 beta)``.

    Raises:
        ValueError: dt not positive, or gains that are not stable.

    Source: Sklansky 1957; order 2 is ours.
    """
    _positive("dt", dt)
    _require("rate", rate, np.isfinite, "finite values")
    check_stable(alpha, beta, kappa)
    if kappa is None:
        predicted = rate * dt * dt / beta
        return (1 - alpha) * predicted, predicted, rate * dt * (2 * alpha - beta) / (2 * beta)
    predicted = rate * dt * dt * dt / kappa
    velocity = rate * dt * dt * ((2 * alpha - beta) / (2 * kappa) + 1 / 12)
    return (1 - alpha) * predicted, predicted, velocity, rate * dt * (beta / kappa - 0.5)


def from_unconstrained(a: Any, b: Any, c: Any = None) -> tuple[Array, ...]:
    """Stable gains from any real numbers, for tuning: a smooth map onto the whole stable region.

    ``alpha = 2 sigmoid(a)``, ``beta = (4 - 2 alpha) sigmoid(b)``, and for order 2
    ``kappa = 2 alpha beta / (2 - alpha) sigmoid(c)``.
    """
    for name, x in (("a", a), ("b", b), ("c", 0.0 if c is None else c)):
        _numbers(name, x)
    a, b, c = (x if x is None or jnp.issubdtype(jnp.result_type(x), jnp.floating) else x * 1.0 for x in (a, b, c))
    alpha = 2 * jax.nn.sigmoid(a)
    rest = 2 * jax.nn.sigmoid(-jnp.asarray(a))  # 2 - alpha, without its cancellation
    beta = 2 * rest * jax.nn.sigmoid(b)
    return (alpha, beta) if c is None else (alpha, beta, 2 * alpha * beta / rest * jax.nn.sigmoid(c))


def to_unconstrained(alpha: Any, beta: Any, kappa: Any = None) -> tuple[Array, ...]:
    """The inverse of :func:`from_unconstrained`.

    Raises:
        ValueError: gains that are not stable.
    """
    check_stable(alpha, beta, kappa)
    rest = 2 - alpha
    a = jnp.log(alpha / rest)
    b = jnp.log(beta / (2 * rest - beta))
    return (a, b) if kappa is None else (a, b, jnp.log(kappa * rest / (2 * alpha * beta - kappa * rest)))


def _scaled_covariance(alpha, beta, kappa, dt):
    """Rows of the steady covariance for unit noise and interval; entry (i, j) is still to be divided by dt^(i+j)."""
    _positive("dt", dt)
    check_stable(alpha, beta, kappa)
    common = 2 * alpha * alpha - 3 * alpha * beta + 2 * beta
    outer = 4 - 2 * alpha - beta
    if kappa is None:
        d = alpha * outer
        cross = beta * (2 * alpha - beta) / d
        return [[common / d, cross], [cross, 2 * beta * beta / d]]
    d = outer * (2 * alpha * beta + alpha * kappa - 2 * kappa)
    xx = (2 * beta * common - alpha * kappa * outer) / d
    xv = beta * (2 * alpha - beta) * (2 * beta - kappa) / d
    xa = kappa * (2 * beta * (2 * alpha - beta) + kappa * (2 * alpha + beta - 4)) / d
    vv = (4 * beta * beta * (beta - kappa) + 2 * kappa * kappa * (2 - alpha)) / d
    va = 2 * beta * kappa * (2 * beta - kappa) / d
    return [[xx, xv, xa], [xv, vv, va], [xa, va, 4 * beta * kappa * kappa / d]]


def check_stable(alpha, beta, kappa=None, *, third="kappa"):
    """Raises a ValueError if concrete gains are not stable."""
    names = "alpha, beta" if kappa is None else f"alpha, beta, {third}"
    given = [alpha, beta] if kappa is None else [alpha, beta, kappa]
    if is_concrete(given):
        # NumPy on purpose: inside a transformation JAX would trace even what is concrete.
        values = [numbers(name, x) for name, x in zip(names.split(", "), given, strict=True)]
        if not np.all(is_stable(*values)):
            region = "0 < alpha < 2, 0 < beta < 4 - 2 alpha"
            if kappa is not None:
                region += ", 0 < kappa < 2 alpha beta / (2 - alpha)"
            listed = ", ".join(str(x) for x in values)
            raise ValueError(f"{names}: expected stable gains ({region}), got {listed}")


def _require(name: str, x: Any, valid: Callable[[np.ndarray], Any], expected: str) -> None:
    if is_concrete(x) and not np.all(valid(numbers(name, x))):
        raise ValueError(f"{name}: expected {expected}, got {np.asarray(x)}")


def _numbers(name, x):
    if is_concrete(x):
        numbers(name, x)


def _positive(name, x):
    _require(name, x, lambda a: (a > 0) & np.isfinite(a), "a finite value > 0")


def _order(order):
    if not isinstance(order, int) or order not in (1, 2):
        raise ValueError(f"order: expected 1 (line) or 2 (parabola), got {order!r}")
    return order


def _option(name, value, options):
    if not isinstance(value, str) or value not in options:
        raise ValueError(f"{name}: expected one of {', '.join(map(repr, options))}, got {value!r}")
    return options[value]
