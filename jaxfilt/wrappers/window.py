"""The last real samples of each channel, and polynomials through them.

What a window holds (:class:`Window`) ages instead of bearing time stamps, so float32 loses no digits however long the
run. Ages and flags depend on the mask and ``dt`` alone: a batch that shares these shares the ages, the regression and
its leverage too, and only the values are per run.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxfilt.core import Prediction, StepInput, Wrapped, is_concrete
from jaxfilt.linalg import chol, solve_chol
from jaxfilt.models.linear import check_positive, check_shape
from jaxfilt.wrappers.common import check_count


class Window(NamedTuple):
    """Ring buffer of N real samples per channel, the newest first."""

    values: Array  # (N, m)
    ages: Array  # (N, m) time since the sample, in the unit of dt; in steps where no dt is given
    steps: Array  # (N, m) int32, steps since the sample
    valid: Array  # (N, m) bool, whether the slot holds a sample


class Fit(NamedTuple):
    """A regression evaluated at the present, per channel."""

    value: Array  # (m,)
    leverage: Array  # (m,) variance of ``value`` over that of one sample
    available: Array  # (m,) bool, false where there is no sample to fit


def empty(size: int, y: Array) -> Window:
    """A window of ``size`` samples, none held yet, for measurements like y (m,)."""
    shape = (size, y.shape[0])
    zeros = jnp.zeros(shape, y.dtype)
    return Window(zeros, zeros, jnp.zeros(shape, jnp.int32), jnp.zeros(shape, bool))


def advance(window: Window, dt: Array | None) -> Window:
    """Lets the samples age by one step: by ``dt``, or by 1 where the model's own interval is in force."""
    elapsed = jnp.ones((), window.ages.dtype) if dt is None else dt
    return window._replace(ages=window.ages + elapsed, steps=window.steps + 1)


def push(window: Window, y: Array, mask: Array) -> Window:
    """Takes in the present components of y (m,), each for its channel's oldest sample; absent ones change nothing."""

    def shift(new, old):
        return jnp.where(mask[None, :], jnp.concatenate([new[None, :], old[:-1]]), old)

    zeros = jnp.zeros(y.shape, window.ages.dtype)
    return Window(
        shift(y, window.values),
        shift(zeros, window.ages),
        shift(jnp.zeros(y.shape, jnp.int32), window.steps),
        shift(jnp.ones(y.shape, bool), window.valid),
    )


def select(window: Window, size: int, max_age: int | None, origin: int = 0) -> Array:
    """Which slots (N, m) a fit uses: the newest ``size`` samples of each channel.

    Args:
        window: the samples.
        size: at most so many samples.
        max_age: leaves out samples more than this number of steps older than the newest one used. Relative to the
            newest sample, because the window is frozen during a gap. None: no limit.
        origin: as the window stood so many steps ago, later samples left out.
    """
    eligible = window.valid & (window.steps >= origin)
    used = eligible & (jnp.cumsum(eligible.astype(jnp.int32), axis=0) <= size)
    if max_age is None:
        return used
    return used & (window.steps - _newest(window.steps, used)[None, :] <= max_age)


def extrapolate(window: Window, used: Array, degree: int, forgetting: Any = 1.0) -> Fit:
    """Fits a polynomial to the samples ``used`` (N, m) of each channel and evaluates it at the present.

    Weighted least squares with ``Phi`` the basis at the samples, ``phi`` the basis now and
    ``W = diag(forgetting ** age)``, age in steps::

        c = W Phi (Phi' W Phi)^-1 phi,     value = c' z,     leverage = c' c

    which is ``phi' (Phi' W Phi)^-1 Phi' W^2 Phi (Phi' W Phi)^-1 phi``. With r the variance of one sample,
    ``r leverage`` is the variance of the extrapolated noise-free value. The basis is Chebyshev's in centered and scaled
    time: the same polynomials as powers of ``tau = (t - t_last) / (t_last - t_first)``, far better conditioned.

    The degree is lowered to (number of samples - 1) where there are fewer samples; duplicate times lower it too.

    Args:
        window: the samples.
        used: from :func:`select`.
        degree: of the polynomial; 0 is the mean.
        forgetting: factor per step of age, in (0, 1].

    Source: thesis on lost targets, chapter 4; leverage: Seber and Lee 2003, section 3.3.
    """
    forgetting = jnp.asarray(forgetting, window.values.dtype)
    lag = (window.steps - _newest(window.steps, used)[None, :]).astype(window.values.dtype)
    weights = jnp.where(used, forgetting ** jnp.where(used, lag, 0.0), 0.0)
    coefficients = jax.vmap(_coefficients, (1, 1, 1, None), 1)(window.ages, used, weights, degree)
    # The coefficients sum to 1: taken from a nearby value, float32 keeps its digits far from the origin.
    reference = window.values[0]
    value = reference + jnp.sum(coefficients * (window.values - reference[None, :]), axis=0)
    return Fit(value, jnp.sum(coefficients**2, axis=0), used.any(axis=0))


def init_window(p: Any, inp: StepInput) -> Wrapped:
    """``init`` of a wrapper whose only memory is a window of ``p.options.value.window`` samples."""
    return Wrapped(p.inner.init(inp), empty(p.options.value.window, inp.y))


def predict_window(p: Any, s: Wrapped, inp: StepInput) -> tuple[Wrapped, Prediction]:
    """``predict`` of such a wrapper: the samples age."""
    inner, prediction = p.inner.predict(s.inner, inp)
    return Wrapped(inner, advance(s.memory, inp.dt)), prediction


def check_fit(window: Any, degree: Any, forgetting: Any, max_age: Any) -> None:
    """Raises a ValueError that names the argument if these are no options of a fit."""
    check_count("window", window, 1)
    check_count("degree", degree, 0)
    if degree >= window:
        raise ValueError(f"degree: expected less than window = {window}, got {degree}")
    if max_age is not None:
        check_count("max_age", max_age, 1)
    check_positive("forgetting", forgetting, scalar=True)
    check_shape("forgetting", forgetting, ())
    if is_concrete(forgetting) and not forgetting <= 1:
        raise ValueError(f"forgetting: expected a value in (0, 1], got {forgetting}")


def _newest(steps, used):
    return jnp.min(jnp.where(used, steps, jnp.iinfo(jnp.int32).max), axis=0)


def _coefficients(ages, used, weights, degree):
    """c (N,) of one channel."""
    zero, one = jnp.zeros((), ages.dtype), jnp.ones((), ages.dtype)
    first = jnp.max(jnp.where(used, ages, zero))
    last = jnp.min(jnp.where(used, ages, first))
    distinct = first > last
    span = jnp.where(distinct, first - last, one)
    # From 1 at the newest to -1 at the oldest sample used.
    Phi = _chebyshev(1 - 2 * (jnp.where(used, ages, last) - last) / span, degree)
    phi = _chebyshev(1 + 2 * last / span, degree)
    order = jnp.arange(degree + 1)
    kept = (order < used.sum()) & (distinct | (order == 0))
    Phi = jnp.where(used[:, None] & kept[None, :], Phi, zero)
    # A column that is left out has a zero pivot, which the solve skips.
    return weights * (Phi @ solve_chol(chol(Phi.T @ (weights[:, None] * Phi)), phi))


def _chebyshev(x, degree):
    columns = [jnp.ones_like(x), x]
    for _ in range(degree - 1):
        columns.append(2 * x * columns[-1] - columns[-2])
    return jnp.stack(columns[: degree + 1], axis=-1)
