"""Noticing a maneuver, and three simple answers to it: a higher gain, more process noise, more covariance."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt import maneuver
from jaxfilt.core import Filter, Info, PyTree, Static, Status, Wrapped, check_filter, multiply, present, wrap
from jaxfilt.filters.common import decoupled, masked_rows
from jaxfilt.linalg import chol, solve_chol, sym
from jaxfilt.models.linear import check_positive
from jaxfilt.wrappers.common import covariances


class _Detected(NamedTuple):
    inner: Filter
    detector: Static


class _Inflated(NamedTuple):
    inner: Filter
    factor: Any  # ()


class _Floor(NamedTuple):
    inner: Filter
    alpha: Any  # ()
    beta: Any  # ()
    dt: Any  # ()


def detected(
    filt: Filter,
    statistic: str = "fading",
    *,
    p_false: float = 1e-3,
    forgetting: float = 0.8,
    window: int = 5,
) -> Filter:
    """Reports whether the innovations say that the target maneuvers; changes nothing else.

    Info: ``extra["statistic"]`` () and ``extra["alarm"]`` () bool, after the step's sample. A missed (or gated) sample
    leaves both as they were. :func:`q_inflated`, :func:`p_inflated` and :func:`gain_floor` go around this one::

        filt = jf.q_inflated(jf.detected(jf.kalman(model), p_false=1e-3), 200.0)

    Args:
        filt: the filter; must report nis (for ``"sum"`` innovation_cov).
        statistic: ``"nis"``, ``"fading"``, ``"window"`` or ``"sum"``, see :func:`jaxfilt.maneuver.detector`.
        p_false: probability of a false alarm per sample. Static, as are the next two.
        forgetting: of ``"fading"``.
        window: of ``"window"`` and ``"sum"``, in samples.

    Raises:
        ValueError: an unknown statistic or a value out of range; at trace time, a filter without nis.
        TypeError: p_false or forgetting is traced.

    Source: Bar-Shalom, Li and Kirubarajan 2001, section 11.2; thesis on lost targets, eqs. (3-17) to (3-21).
    """
    detector = maneuver.detector(statistic, p_false=p_false, forgetting=forgetting, window=window)
    return wrap(_Detected(filt, Static(detector)), init=_detected_init, update=_detected_update)


def q_inflated(filt: Filter, factor: Any = 200.0) -> Filter:
    """Multiplies the process noise while there is an alarm: ``Q -> factor Q`` in the prediction after an alarm.

    Args:
        filt: reports ``extra["alarm"]`` (:func:`detected`) and honors ``q_scale``.
        factor: > 0; 1 changes nothing. May be traced.

    Raises:
        ValueError: factor <= 0; at trace time, a filter that reports no alarm.

    Source: Bar-Shalom, Li and Kirubarajan 2001, section 11.2.
    """
    check_positive("factor", factor, scalar=True)
    return wrap(_Inflated(filt, factor), init=_alarm_init, predict=_q_predict, update=_alarm_update)


def p_inflated(filt: Filter, factor: Any = 5.0) -> Filter:
    """Multiplies the predicted covariance while there is an alarm: ``P- -> factor P-`` in the step after an alarm.

    Only in steps with a measurement: over a gap the factors would pile up.

    Args:
        filt: reports ``extra["alarm"]`` (:func:`detected`) and has moments that can be replaced.
        factor: >= 1 to be of use, > 0; 1 changes nothing. May be traced.

    Raises:
        ValueError: factor <= 0, a filter without ``with_moments``; at trace time, a filter that reports no alarm.

    Source: Bar-Shalom, Li and Kirubarajan 2001, section 11.2.
    """
    check_positive("factor", factor, scalar=True)
    _check_moments(filt, "p_inflated")
    return wrap(_Inflated(filt, factor), init=_alarm_init, predict=_p_predict, update=_alarm_update)


def gain_floor(filt: Filter, *, alpha: Any, beta: Any, dt: Any) -> Filter:
    """Keeps the gain from falling below an alpha-beta filter's in the step after an alarm.

    For filters whose state begins with the m measured positions and their m velocities (the library's order). With
    ``K = P- H' S^-1`` and ``H = [I 0]``, in every present channel i::

        K[i, i] >= alpha,     K[m + i, i] >= beta / dt,     P = (I - K H) P- (I - K H)' + K R K'

    Joseph's form is right for any gain, so the covariance stays honest about the noise that the higher gain lets in
    (and knows as little of the maneuver as before). The sample that raises the alarm is itself taken in as usual: a
    false alarm would otherwise give the highest gain to the worst sample.

    Args:
        filt: reports ``extra["alarm"]`` (:func:`detected`), S and R, has moments that can be replaced, and measures
            position linearly. That H is ``[I 0]`` cannot be checked here.
        alpha: floor of the position gain, in [0, 1]. May be traced, like the others.
        beta: floor of the velocity gain times the interval, >= 0.
        dt: the model's own interval [s]; ``jf.filter(..., dt=)`` overrides it per step.

    Raises:
        ValueError: alpha or beta < 0, dt <= 0, a filter without ``with_moments``; at trace time, a filter that reports
            no alarm, innovation_cov or noise_cov, or has fewer than 2 m states.

    Source: Bar-Shalom, Li and Kirubarajan 2001, section 11.2; thesis on lost targets, section 3-3-4.
    """
    check_positive("alpha", alpha, zero=True, scalar=True)
    check_positive("beta", beta, zero=True, scalar=True)
    check_positive("dt", dt, scalar=True)
    _check_moments(filt, "gain_floor")
    return wrap(_Floor(filt, alpha, beta, dt), init=_alarm_init, update=_gain_update)


def _check_moments(filt, wrapper):
    check_filter(filt)
    if filt.moments is None or filt.with_moments is None:
        raise ValueError(f"filt: {wrapper} needs a filter with moments and with_moments")


def _alarm(info: Info) -> Array:
    if "alarm" not in info.extra:
        raise ValueError('filt: expected a filter that reports extra["alarm"]; wrap it in jf.detected')
    return info.extra["alarm"]


def select(condition: Array, a: PyTree, b: PyTree) -> PyTree:
    """``a`` where the condition () holds, else ``b``, leaf by leaf."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def _detected_init(p, inp):
    return Wrapped(p.inner.init(inp), maneuver.start(p.detector.value, inp.y))


def _detected_update(p, s, inp):
    inner, info = p.inner.update(s.inner, inp)
    usable = present(inp) & jnp.isfinite(inp.y)
    memory = maneuver.advance(p.detector.value, s.memory, info, usable)
    statistic, alarm = maneuver.evaluate(p.detector.value, memory, inp.y.shape[0])
    return Wrapped(inner, memory), info._replace(extra={**info.extra, "statistic": statistic, "alarm": alarm})


def _alarm_init(p, inp):
    return Wrapped(p.inner.init(inp), jnp.zeros((), bool))


def _alarm_update(p, s, inp):
    inner, info = p.inner.update(s.inner, inp)
    return Wrapped(inner, _alarm(info)), info


def _q_predict(p, s, inp):
    one = jnp.ones((), inp.y.dtype)
    factor = jnp.where(s.memory, jnp.asarray(p.factor, inp.y.dtype), one)
    inner, prediction = p.inner.predict(s.inner, inp._replace(q_scale=multiply(inp.q_scale, factor)))
    return s._replace(inner=inner), prediction


def _p_predict(p, s, inp):
    inner, prediction = p.inner.predict(s.inner, inp)
    inflate = s.memory & present(inp).any()
    mean, cov = p.inner.moments(inner)
    cov = jnp.asarray(p.factor, cov.dtype) * cov
    inner = select(inflate, p.inner.with_moments(inner, mean, cov), inner)
    return s._replace(inner=inner), prediction._replace(cov=jnp.where(inflate, cov, prediction.cov))


def _gain_update(p, s, inp):
    mean, P = p.inner.moments(s.inner)
    after, info = p.inner.update(s.inner, inp)
    alarm = s.memory
    S, R = covariances(info, "gain_floor")
    n, m = mean.shape[0], inp.y.shape[0]
    if n < 2 * m:
        raise ValueError(f"filt: gain_floor needs positions and velocities of {m} axes, but the state has {n}")
    mask = present(inp) & ((info.status & int(Status.MISSED)) == 0)  # a wrapper inside may have refused the sample
    H = masked_rows(mask, jnp.eye(m, n, dtype=P.dtype))
    K = solve_chol(chol(decoupled(mask, S)), H @ P).T
    alpha, beta = jnp.asarray(p.alpha, P.dtype), jnp.asarray(p.beta, P.dtype)
    dt = jnp.asarray(p.dt, P.dtype) if inp.dt is None else inp.dt
    moving = dt > 0
    rate = beta / jnp.where(moving, dt, jnp.ones_like(dt))
    position, velocity = np.eye(n, m, dtype=bool), np.eye(n, m, -m, dtype=bool)
    K = jnp.where(position & mask[None, :], jnp.maximum(K, alpha), K)
    K = jnp.where(velocity & mask[None, :] & moving, jnp.maximum(K, rate), K)
    A = jnp.eye(n, dtype=P.dtype) - K @ H
    cov = sym(A @ P @ A.T + K @ R @ K.T)
    mean = mean + K @ info.innovation
    inner = select(alarm, p.inner.with_moments(after, mean, cov), after)
    info = info._replace(mean=jnp.where(alarm, mean, info.mean), cov=jnp.where(alarm, cov, info.cov))
    return Wrapped(inner, _alarm(info)), info
