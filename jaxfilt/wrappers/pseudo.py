"""Pseudo-measurements: a function fitted to the last real samples replaces what is missing, and is fed to the filter.

This is the classical remedy for a lost target. It counts data twice: the fit is a function of measurements that the
filter has used already. Where the filter's model is right, coasting (doing nothing) is the optimum and a fit can only
be worse; it can win where the model is wrong. ``weighted=True`` is its least harmful form. Compare
:func:`jaxfilt.blend`, which reports fits and feeds nothing back.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxfilt.core import Filter, Static, Status, Wrapped, aspartial, check_flag, flag, multiply, present, wrap
from jaxfilt.linalg import chol, solve_chol
from jaxfilt.models.linear import check_positive
from jaxfilt.wrappers.common import check_count, predict_measurement
from jaxfilt.wrappers.window import Fit, check_fit, extrapolate, init_window, predict_window, push, select

# The grid of angular rates that a sinusoid is fitted at, relative to the filter's own estimate.
_RATES = (0.6, 1.4, 33)


class _Options(NamedTuple):
    window: int
    degree: int
    weighted: bool
    max_age: int | None


class _Polynomial(NamedTuple):
    inner: Filter
    forgetting: Any  # ()
    options: Static


class _Sinusoid(NamedTuple):
    inner: Filter
    omega: Any  # Static index of a state component, or a Partial: mean -> omega
    interval: Any  # ()
    options: Static


def hold_last(filt: Filter) -> Filter:
    """Feeds the last real measurement back while data are missing: :func:`polynomial_fit` of degree 0 to one sample.

    Source: thesis on lost targets, chapter 4 (a baseline there).
    """
    return polynomial_fit(filt, window=1, degree=0)


def mean_of_recent(filt: Filter, n: int = 5) -> Filter:
    """Feeds the mean of the last n real measurements back: :func:`polynomial_fit` of degree 0 to n samples.

    Raises:
        ValueError: n < 1.

    Source: thesis on lost targets, chapter 4 (a baseline there).
    """
    check_count("n", n, 1)
    return polynomial_fit(filt, window=n, degree=0)


def polynomial_fit(
    filt: Filter,
    *,
    window: int = 10,
    degree: int = 1,
    weighted: bool = False,
    forgetting: Any = 1.0,
    max_age: int | None = None,
) -> Filter:
    """Replaces missing measurements by a polynomial fitted to the last real ones, in each channel by itself.

    An absent component is filled with the fit's value and handed to the filter as if it were present; what is present
    is used as it is. The window holds real samples only. Fewer than ``degree + 1`` samples lower the degree; without
    any the component stays absent (the filter coasts).

    Info: ``mean`` and ``cov`` are the filter's, after the pseudo-measurement. Innovation, its covariance, NIS, R and
    ``log_lik`` are those of the real data only, so ``log_lik`` is exactly 0 in a gap. ``extra["measurement"]`` (m,) is
    what the filter was given: real, fitted, or its own predicted measurement where neither exists.

    Status: PSEUDO where a component was filled. MISSED stays set when none was really present, so that wrappers
    which learn from the data skip the step.

    Args:
        filt: the filter.
        window: number N of samples of each channel.
        degree: of the polynomial, less than ``window``; in time, so irregular ``dt`` is allowed for.
        weighted: multiplies R by ``1 + leverage``, the variance of a new sample at the fitted curve, instead of taking
            the pseudo-measurement for as good as a real one. The filter must honor ``r_scale``.
        forgetting: weight of a sample per step of its age, in (0, 1]. May be traced.
        max_age: samples more than this number of steps older than the newest one are not used, so that a window does
            not reach far across an earlier gap. None: ``3 * window``.

    Raises:
        ValueError: window < 1, degree < 0 or >= window, forgetting outside (0, 1], max_age < 1.

    Source: thesis on lost targets, chapter 4.
    """
    max_age = 3 * window if max_age is None and isinstance(window, int) else max_age
    check_fit(window, degree, forgetting, max_age)
    check_flag("weighted", weighted)
    options = _Options(window, degree, weighted, max_age)
    return wrap(
        _Polynomial(filt, forgetting, Static(options)),
        init=init_window,
        predict=predict_window,
        update=_polynomial_update,
    )


def sinusoid_fit(
    filt: Filter,
    *,
    omega: int | Callable[[Array], Array],
    window: int = 50,
    weighted: bool = False,
    interval: Any = 1.0,
    max_age: int | None = None,
) -> Filter:
    """Replaces missing measurements by a sinusoid fitted to the last real ones: for what oscillates.

    ``b1 sin(w t) + b2 cos(w t)``: for each of 33 angular rates w between 0.6 and 1.4 times the filter's own estimate,
    linear least squares for b; the one with the smallest residual is taken. Otherwise as :func:`polynomial_fit`. Fewer
    than three samples: the component stays absent. The choice among the rates is hard: gradients go through the chosen
    one only.

    Args:
        filt: the filter.
        omega: index of the state component that is the angular rate [rad/s], or a function of the mean (n,) that gives
            it. Its sign does not matter.
        window: number N of samples of each channel; should span more than half a period.
        weighted: as in :func:`polynomial_fit`; the leverage is that of b at the chosen rate.
        interval: the model's own interval [s], used where no ``dt`` is given to the filter.
        max_age: as in :func:`polynomial_fit`.

    Raises:
        ValueError: window < 3, interval <= 0, max_age < 1.
        TypeError: omega is neither an integer nor a function.

    Source: thesis on lost targets, chapter 4, which leaves the family of functions open.
    """
    check_count("window", window, 3)
    check_positive("interval", interval, scalar=True)
    max_age = 3 * window if max_age is None else max_age
    check_fit(window, 0, 1.0, max_age)
    if not callable(omega) and (isinstance(omega, bool) or not isinstance(omega, int)):
        raise TypeError(f"omega: expected an index of the state or a function of the mean, got {omega!r}")
    rate = aspartial(omega) if callable(omega) else Static(omega)
    check_flag("weighted", weighted)
    options = _Options(window, 1, weighted, max_age)
    return wrap(
        _Sinusoid(filt, rate, interval, Static(options)),
        init=init_window,
        predict=predict_window,
        update=_sinusoid_update,
    )


def _polynomial_update(p, s, inp):
    def fit(samples, mean):
        del mean
        used = select(samples, options.window, options.max_age)
        return extrapolate(samples, used, options.degree, p.forgetting)

    options = p.options.value
    return _fill(p.inner, s, inp, fit, options.weighted)


def _sinusoid_update(p, s, inp):
    def fit(samples, mean):
        omega = mean[p.omega.value] if isinstance(p.omega, Static) else p.omega(mean)
        if inp.dt is None:
            samples = samples._replace(ages=samples.ages * p.interval)
        used = select(samples, p.options.value.window, p.options.value.max_age)
        # 33 fits are dear: skipped in steps that miss nothing, unless each run of a batch has its own mask.
        unused = Fit(samples.values[0], jnp.zeros_like(samples.values[0]), jnp.zeros(mask.shape, bool))
        return jax.lax.cond(mask.all(), lambda: unused, lambda: _sinusoid(samples, used, omega))

    mask = present(inp)
    return _fill(p.inner, s, inp, fit, p.options.value.weighted)


def _fill(inner, s, inp, fit, weighted):
    """The update with absent components filled by ``fit(window, mean) -> Fit``."""
    predicted, _ = predict_measurement(inner, s.inner, inp)
    mask = present(inp)
    # An unmasked NaN is the filter's to report; the window gets what the filter makes of it, no news.
    sample = jnp.where(mask & jnp.isfinite(inp.y), inp.y, predicted)
    memory = push(s.memory, sample, mask)
    after, real = inner.update(s.inner, inp)
    if inp.mask is None:
        return Wrapped(after, memory), real._replace(extra={**real.extra, "measurement": sample})
    guess = fit(s.memory, real.mean)
    filled = ~mask & guess.available
    sample = jnp.where(filled, guess.value, sample)
    pseudo = inp._replace(y=jnp.where(mask, inp.y, sample), mask=mask | filled)
    if weighted:
        factor = jnp.where(filled, 1 + guess.leverage, jnp.ones((), inp.y.dtype))
        pseudo = pseudo._replace(r_scale=multiply(inp.r_scale, factor))
    after, info = inner.update(s.inner, pseudo)
    info = real._replace(
        mean=info.mean,
        cov=info.cov,
        status=real.status | info.status | flag(filled.any(), Status.PSEUDO),
        extra={**info.extra, "measurement": sample},
    )
    return Wrapped(after, memory), info


def _sinusoid(window, used, omega):
    """The best of the sinusoids on the grid of rates, per channel, at the present."""
    low, high, count = _RATES
    rates = jnp.abs(omega) * jnp.linspace(low, high, count, dtype=omega.dtype)
    candidates = jax.vmap(_sinusoid_at, (0, None, None))(rates, window, used)  # residual, value, leverage: (33, m)
    best = jnp.argmin(candidates[0], axis=0)[None, :]
    _, value, leverage = (jnp.take_along_axis(x, best, axis=0)[0] for x in candidates)
    return Fit(value, leverage, used.sum(axis=0) >= 3)


def _sinusoid_at(rate, window, used):
    def channel(values, ages, used):
        zero = jnp.zeros((), ages.dtype)
        angle = -rate * jnp.where(used, ages, zero)  # time runs from the present, where the basis is [0, 1]
        Phi = jnp.where(used[:, None], jnp.stack([jnp.sin(angle), jnp.cos(angle)], axis=1), zero)
        z = jnp.where(used, values, zero)
        L = chol(Phi.T @ Phi)
        b = solve_chol(L, Phi.T @ z)
        leverage = solve_chol(L, jnp.asarray([0.0, 1.0], ages.dtype))[1]
        return jnp.sum((z - Phi @ b) ** 2), b[1], leverage

    return jax.vmap(channel, 1)(window.values, window.ages, used)
