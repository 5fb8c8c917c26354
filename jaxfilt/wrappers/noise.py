"""Noise covariances learned from the innovations while filtering, and a filter that forgets.

What these and the fuzzy wrappers have in common: they act through ``q_scale`` and ``r_scale``, multiplied onto what the
caller gives; the scales in force after a step are in ``extra["r_scale"]`` and ``extra["q_scale"]``; a sample that was
missed, refused by a gate or not finite teaches nothing; and a scale that ran into its bounds sets ``Status.BOUND``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import (
    Filter,
    Info,
    Static,
    Status,
    StepInput,
    Wrapped,
    check_filter,
    flag,
    is_concrete,
    multiply,
    present,
    wrap,
)
from jaxfilt.filters.common import decoupled
from jaxfilt.linalg import chol, solve_chol, solve_lower
from jaxfilt.models.linear import check_positive
from jaxfilt.wrappers.common import check_count, covariances

R_BOUNDS = (0.01, 100.0)  # times the model's R
Q_BOUNDS = (1e-4, 1e4)  # times the model's Q


class _SageHusa(NamedTuple):
    inner: Filter
    forgetting: Any  # ()
    prior: Any  # ()
    bounds: Any  # (2,)
    scale: Static


class _Matching(NamedTuple):
    inner: Filter
    bounds: Any  # (2,)
    rate: Any  # ()
    options: Static  # (scale, window)


class _Fading(NamedTuple):
    inner: Filter
    factor: Any  # ()


class _Estimate(NamedTuple):
    scale: Array  # (m,) of R, or () of Q
    count: Array  # as scale: effective number of samples in it


class _Recent(NamedTuple):
    scale: Array  # (m,) of R, or () of Q
    values: Array  # (N, m) or (2, N, m), the newest first


def sage_husa(
    filt: Filter,
    *,
    scale: str = "r",
    forgetting: Any = 0.95,
    prior: Any = 10.0,
    bounds: tuple[Any, Any] | None = None,
) -> Filter:
    """Estimates the diagonal of R, or the size of Q, by a fading mean over what each update says about them.

    With ``eps = R S^-1 nu`` the residual ``y - H m+`` of an update, and ``H P+ H' = R - R S^-1 R``, per channel i::

        R_ii <- (1 - d) R_ii + d (eps_i^2 + (H P+ H')_ii),      d_k = 1 / n_k,  n_k = forgetting n_{k-1} + 1

    and for Q one factor, by how far the measured prediction error was from the predicted one::

        Q <- Q ((1 - d) + d sum_i ((nu_i - eps_i)^2 + (H P+ H')_ii) / R_ii / sum_i (H P- H')_ii / R_ii)

    Both are sums of squares: nothing can become negative. What step k teaches is in force from step k+1 on.

    Helps where the one that is adapted is wrong or drifts slowly: it takes several times ``1 / (1 - forgetting)``
    samples, since each estimate is corrected by residuals of a filter that used the last one. Slowest where the filter
    trusts its measurements, because then their residuals are small whatever R is. Harms a little where the model is
    right, as any estimate has a spread, and much where the other one is wrong: from the size of the innovations one
    cannot tell R from Q, so all that is unexpected is put down to the one adapted. (Both at once would wander along a
    line of pairs that explain the innovations equally well, so only one is offered.)

    Info: ``extra["r_scale"]`` (m,), or ``extra["q_scale"]`` (): estimates times the model's own, after the step.

    Status: BOUND where an estimate ran into its bounds and was clipped.

    Args:
        filt: reports innovation_cov and noise_cov, and honors the scale. R's off-diagonal entries keep their
            correlation.
        scale: ``"r"`` or ``"q"``.
        forgetting: b in (0, 1). May be traced, as the next two.
        prior: number of samples that the model's own covariance counts for at the start, >= 0; 0 is Sage and Husa's
            ``d_k = (1 - b) / (1 - b^(k+1))``, whose first sample replaces it.
        bounds: smallest and largest factor; default (0.01, 100) for R, (1e-4, 1e4) for Q.

    Raises:
        ValueError: forgetting outside (0, 1), prior < 0, bounds not in order, an unknown scale; at trace time, a filter
            without innovation_cov or noise_cov.

    Source: Sage and Husa 1969; the positive form for R: Mohamed and Schwarz 1999 (there over a window).
    """
    check_forgetting(forgetting)
    check_positive("prior", prior, zero=True, scalar=True)
    bounds = _check_scale(scale, bounds)
    return wrap(
        _SageHusa(filt, forgetting, prior, bounds, Static(scale)),
        init=_sage_init, predict=_scaled_predict, update=_sage_update,
    )  # fmt: skip


def covariance_matching(
    filt: Filter, *, scale: str = "r", window: int = 30, rate: Any = 1.0, bounds: tuple[Any, Any] | None = None
) -> Filter:
    """Makes the predicted innovation covariance match the observed one over the last samples, by R or by Q.

    Per channel i, with means over the last ``window`` samples of the channel::

        R_ii <- mean(nu_i^2 - (H P- H')_ii)
        Q <- Q ratio^(1 / window),    ratio = sum_i mean(nu_i^2 - R_ii) / R_ii / sum_i mean(H P- H')_ii / R_ii

    The window starts full of what the model expects. The power 1 / window, where Ding and others have 1/2, is because a
    window answers late: the ratio that it shows is that of the Q of half a window ago. With ``rate < 1`` the estimate
    goes only that part of the way from the last one to the new (for Q: the power is ``rate / window``). What step k
    teaches is in force from step k+1 on.

    Quicker than :func:`sage_husa` where the filter trusts its measurements, and noisier: a difference of squares may be
    negative and then meets the lower bound. When it helps and when it harms is said there. Do not use it for R where
    the noise changes about as fast as the window: after a burst S is still large while innovations are small again, R
    falls to its lower bound, and the next burst finds a filter that trusts every measurement. (Bounds of (1, 100) cure
    the worst of it.)

    Info: ``extra["r_scale"]`` (m,), or ``extra["q_scale"]`` (): estimates times the model's own, after the step.

    Status: BOUND where an estimate ran into its bounds and was clipped.

    Args:
        filt: reports innovation_cov and noise_cov, and honors the scale.
        scale: ``"r"`` or ``"q"``.
        window: samples per channel.
        rate: in [0, 1]; 0 leaves the filter as it is. May be traced.
        bounds: smallest and largest factor; default (0.01, 100) for R, (1e-4, 1e4) for Q.

    Raises:
        ValueError: window < 2, rate outside [0, 1], bounds not in order, an unknown scale; at trace time, a filter
            without innovation_cov or noise_cov.

    Source: Mehra 1972; Maybeck 1982, section 10.8; for Q: Ding, Wang, Rizos and Kinlyside 2007.
    """
    check_count("window", window, 2)
    check_rate(rate, closed=True)
    bounds = _check_scale(scale, bounds)
    return wrap(
        _Matching(filt, bounds, rate, Static((scale, window))),
        init=_matching_init, predict=_scaled_predict, update=_matching_update,
    )  # fmt: skip


def fading_memory(filt: Filter, factor: Any = 1.02) -> Filter:
    """Forgets old measurements: the covariance is multiplied before each prediction, ``P- = factor F P F' + Q``.

    A sample that is j steps old then counts ``factor^-j`` of what it would. Helps against slow errors of the model
    (an input that is not known, a wrong F), which more Q would answer as well; harms where the model is right, the more
    the larger the factor. Covariances are then too large, or no more than a tuning.

    Only in steps with a measurement: over a gap the factors would pile up. The prediction's cross-covariance is that of
    P itself, as if the forgetting were process noise, so that smoothing works.

    Args:
        filt: has moments that can be replaced.
        factor: >= 1; 1 changes nothing. May be traced.

    Raises:
        ValueError: factor < 1, a filter without ``with_moments``.

    Source: Fagin 1964; Sorenson and Sacks 1971; Simon 2006, section 7.4 (his alpha is the root of the factor).
    """
    check_positive("factor", factor, scalar=True)
    if is_concrete(factor) and not (np.asarray(factor) >= 1).all():
        raise ValueError(f"factor: expected a value >= 1, got {factor}")
    check_filter(filt)
    if filt.moments is None or filt.with_moments is None:
        raise ValueError("filt: fading_memory needs a filter with moments and with_moments")
    return wrap(_Fading(filt, factor), predict=_fading_predict)


# What the fuzzy wrappers use too


def check_forgetting(forgetting: Any) -> None:
    """Raises a ValueError unless forgetting is in (0, 1), if concrete."""
    check_positive("forgetting", forgetting, scalar=True)
    if is_concrete(forgetting) and not (np.asarray(forgetting) < 1).all():
        raise ValueError(f"forgetting: expected a value in (0, 1), got {forgetting}")


def check_rate(rate: Any, *, closed: bool = False) -> None:
    """Raises a ValueError unless rate is in [0, 1), or with ``closed`` in [0, 1], if concrete."""
    check_positive("rate", rate, zero=True, scalar=True)
    if is_concrete(rate) and not (np.asarray(rate) < 1).all() and not (closed and (np.asarray(rate) == 1).all()):
        raise ValueError(f"rate: expected a value in [0, 1{']' if closed else ')'}, got {rate}")


def check_bounds(name: str, bounds: Any) -> tuple[Any, Any]:
    """``(smallest, largest)``, or a ValueError that names them."""
    if not hasattr(bounds, "__len__") or len(bounds) != 2:
        raise ValueError(f"{name}: expected (smallest, largest), got {bounds}")
    check_positive(name, bounds[0])
    if is_concrete(bounds) and not bounds[0] <= bounds[1]:
        raise ValueError(f"{name}: expected smallest <= largest, got {bounds}")
    return tuple(bounds)


def clip(x: Array, bounds: Any) -> tuple[Array, Array]:
    """``x`` within the bounds, and its status: BOUND where some of it was clipped."""
    low, high = (jnp.asarray(bound, x.dtype) for bound in bounds)
    return jnp.clip(x, low, high), flag(((x < low) | (x > high)).any(), Status.BOUND)


def usable(inp: StepInput, info: Info) -> Array:
    """Which components (m,) an update has used: none of a sample that was missed, refused or not finite in part."""
    refused = int(Status.MISSED | Status.GATED | Status.NONFINITE)
    return present(inp) & jnp.isfinite(inp.y) & ((info.status & refused) == 0)


def _check_scale(scale, bounds):
    if scale not in ("r", "q"):
        raise ValueError(f'scale: expected "r" or "q", got {scale!r}')
    if bounds is None:
        return R_BOUNDS if scale == "r" else Q_BOUNDS
    return check_bounds("bounds", bounds)


def scaled(which: str, inp: StepInput, factor: Array) -> StepInput:
    """The step's input with its noise ``"r"`` or ``"q"`` scaled by a factor.

    Q is scaled at the update too: a stationary filter solves for its covariance there.
    """
    if which == "r":
        return inp._replace(r_scale=multiply(inp.r_scale, factor))
    return inp._replace(q_scale=multiply(inp.q_scale, factor))


def _which(p):
    return p.scale.value if isinstance(p, _SageHusa) else p.options.value[0]


def _scaled_predict(p, s, inp):
    inner, prediction = p.inner.predict(s.inner, scaled(_which(p), inp, s.memory.scale))
    return s._replace(inner=inner), prediction


def _start(which, inp):
    return jnp.ones(inp.y.shape if which == "r" else (), inp.y.dtype)


def _finish(p, inner, info, memory, status):
    extra = {**info.extra, f"{_which(p)}_scale": memory.scale}
    return Wrapped(inner, memory), info._replace(status=info.status | status, extra=extra)


def _ratio(numerator, denominator):
    """A ratio of positive numbers; 1 where there is nothing to divide by."""
    ok = denominator > 0
    return jnp.where(ok, numerator / jnp.where(ok, denominator, jnp.ones_like(denominator)), jnp.ones_like(numerator))


def _sage_init(p, inp):
    scale = _start(_which(p), inp)
    return Wrapped(
        p.inner.init(inp), _Estimate(scale, jnp.broadcast_to(jnp.asarray(p.prior, inp.y.dtype), scale.shape))
    )


def _sage_update(p, s, inp):
    which, (scale, count) = _which(p), s.memory
    inner, info = p.inner.update(s.inner, scaled(which, inp, scale))
    S, R = covariances(info, "sage_husa")
    used = usable(inp, info)
    zero = jnp.zeros((), R.dtype)
    nu = jnp.where(used, info.innovation, zero)
    known = jnp.where(used[:, None] & used[None, :], R, zero)
    L = chol(decoupled(used, S))
    residual = known @ solve_chol(L, nu)
    variance = jnp.diagonal(R)
    remaining = jnp.maximum(variance - jnp.sum(solve_lower(L, known) ** 2, axis=0), zero)  # H P+ H'
    if which == "r":
        taught = used
        ratio = _ratio(residual**2 + remaining, variance)
    else:
        taught = used.any()
        weights = _ratio(jnp.where(used, jnp.ones_like(variance), zero), variance)
        expected = jnp.sum(weights * (jnp.diagonal(S) - variance))
        ratio = _ratio(jnp.sum(weights * ((nu - residual) ** 2 + remaining)), expected)
    counted = jnp.asarray(p.forgetting, R.dtype) * count + 1
    new, status = clip(scale * (1 + (ratio - 1) / counted), p.bounds)
    memory = _Estimate(jnp.where(taught, new, scale), jnp.where(taught, counted, count))
    return _finish(p, inner, info, memory, status)


def _matching_init(p, inp):
    which, window = p.options.value
    shape = (window, inp.y.shape[0])
    values = jnp.ones(shape if which == "r" else (2, *shape), inp.y.dtype)
    return Wrapped(p.inner.init(inp), _Recent(_start(which, inp), values))


def _matching_update(p, s, inp):
    (which, window), (scale, values) = p.options.value, s.memory
    inner, info = p.inner.update(s.inner, scaled(which, inp, scale))
    S, R = covariances(info, "covariance_matching")
    used = usable(inp, info)
    variance, predicted = jnp.diagonal(R), jnp.diagonal(S - R)
    squared = info.innovation**2
    if which == "r":
        values = _push(values, scale * _ratio(squared - predicted, variance), used)
        new, status = clip(jnp.mean(values, axis=0), p.bounds)
        rate = jnp.asarray(p.rate, scale.dtype)
        scale = jnp.where(used, (1 - rate) * scale + rate * new, scale)
    else:
        observed = _push(values[0], _ratio(squared - variance, variance), used)
        predicted = _push(values[1], _ratio(predicted, variance), used)
        values = jnp.stack([observed, predicted])
        ratio = jnp.clip(_ratio(jnp.sum(observed), jnp.sum(predicted)), *Q_BOUNDS)
        new, status = clip(scale * ratio ** (jnp.asarray(p.rate, scale.dtype) / window), p.bounds)
        scale = jnp.where(used.any(), new, scale)
    return _finish(p, inner, info, _Recent(scale, values), jnp.where(used.any(), status, jnp.int32(0)))


def _push(values, new, used):
    """Takes in a sample (m,) of the channels that were used, each for its channel's oldest."""
    return jnp.where(used[None, :], jnp.concatenate([new[None, :], values[:-1]]), values)


def _fading_predict(p, s, inp):
    mean, cov = p.inner.moments(s.inner)
    factor = jnp.where(present(inp).any(), jnp.asarray(p.factor, cov.dtype), jnp.ones((), cov.dtype))
    inner, prediction = p.inner.predict(p.inner.with_moments(s.inner, mean, factor * cov), inp)
    if prediction.cross is not None:
        prediction = prediction._replace(cross=prediction.cross / factor)
    return s._replace(inner=inner), prediction
