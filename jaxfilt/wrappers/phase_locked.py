"""A filter of an angle made to track a sine/cosine pair: the phase-locked loop of resolver converters."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import Filter, Prediction, Static, Status, StepInput, Wrapped, check_flag, flag, present, wrap
from jaxfilt.filters.common import check_dtype, check_measurement
from jaxfilt.models.linear import check_positive
from jaxfilt.wrappers.common import predict_measurement


class _Params(NamedTuple):
    inner: Filter
    amplitude: Any  # ()
    floor: Any  # ()
    normalize: Static


class LoopMemory(NamedTuple):
    """What the loop looks back on."""

    angle: Array  # () the last estimate [rad]
    known: Array  # () bool, whether there is one


def phase_locked(filt: Filter, *, amplitude: Any = 1.0, normalize: bool = True, floor: Any = 0.2) -> Filter:
    """A filter that tracks the angle of two signals ``[A cos theta, A sin theta]`` by their phase error.

    The filter inside measures an angle (m = 1, the first of its states). Its innovation becomes
    ``e = (b cos p - a sin p) / A = sin(theta - p)`` with the predicted angle p, which needs no arc tangent, no
    wrapping and no start at the right cycle. Around ``alpha_beta(alpha, beta, dt=T, m0=[theta0, omega0])`` it is the
    type-II loop of resolver converters: from e to p it is ``K z^-1 (1 - a z^-1) / (1 - z^-1)^2`` with
    ``K = alpha + beta`` and ``a = alpha / K``, two integrators and a lead. Around ``alpha_beta_gamma`` it is type III;
    around ``kalman`` the gains are computed.

    Beyond 90 degrees of error e falls again, and at 180 it is 0. ``info.extra``: ``"error"`` () the e used,
    ``"radius"`` () of the sample (0 where a signal is absent), ``"fast"`` () bool where the angle was predicted to move
    by more than a quarter of a cycle since the last estimate. The innovation is that of the signals; its covariance is
    None; NIS and likelihood are those of e in the filter inside. A wrapper that needs its covariance goes inside too.

    Status: BOUND where the signal is lost (radius below ``floor``), which is then predicted only, or where ``fast``;
    MISSED where either signal is absent; NONFINITE (e is taken as 0).

    Args:
        filt: a filter of an angle, with one measured component.
        amplitude: nominal A of the signals. May be traced.
        normalize: divides e by the radius of the sample; else by ``amplitude``, as converters do, whose loop gain
            therefore scales with the signal.
        floor: part of ``amplitude`` below which the signal counts as lost. 0 = never.

    Raises:
        ValueError: amplitude <= 0 or floor < 0; at trace time, a sample that has not two components.

    Source: Analog Devices, AD2S1210 data sheet (the loop); the identity with alpha-beta: Kalata 1984 for the gains.
    """
    check_positive("amplitude", amplitude, scalar=True)
    check_positive("floor", floor, zero=True, scalar=True)
    check_flag("normalize", normalize)
    return wrap(_Params(filt, amplitude, floor, Static(normalize)), init=_init, predict=_predict, update=_update)


def _angle(inp: StepInput, y: Array, mask: Array | None) -> StepInput:
    if inp.r_scale is not None and inp.r_scale.ndim > 0:
        raise ValueError("r_scale: expected a scalar per step: the loop has one measurement, the angle")
    return inp._replace(y=y[None], mask=None if mask is None else mask[None])


def _both(inp: StepInput) -> Array | None:
    return None if inp.mask is None else inp.mask.all()


def _init(p, inp):
    check_measurement(inp, 2, "a sine and a cosine")
    zero = jnp.zeros((), inp.y.dtype)
    return Wrapped(p.inner.init(_angle(inp, zero, _both(inp))), LoopMemory(zero, jnp.zeros((), bool)))


def _predict(p, s, inp) -> tuple[Wrapped, Prediction]:
    inner, prediction = p.inner.predict(s.inner, _angle(inp, jnp.zeros((), inp.y.dtype), _both(inp)))
    return s._replace(inner=inner), prediction


def _update(p, s, inp):
    dtype = inp.y.dtype
    predicted = predict_measurement(p.inner, s.inner, _angle(inp, jnp.zeros((), dtype), None))[0][0]
    check_dtype(inp, predicted)
    here = present(inp)
    bad = here & ~jnp.isfinite(inp.y)
    a, b = jnp.where(here & ~bad, inp.y, 0.0)
    square = a * a + b * b
    off = square > 0
    radius = jnp.where(off, jnp.sqrt(jnp.where(off, square, 1.0)), 0.0)
    amplitude = jnp.asarray(p.amplitude, dtype)
    scale = jnp.where(off, radius, 1.0) if p.normalize.value else amplitude
    error = (b * jnp.cos(predicted) - a * jnp.sin(predicted)) / scale
    error = jnp.where(bad.any(), 0.0, error)
    # What is not finite does not count as lost: whether a sample counts would then differ between the runs of a batch.
    lost = here.all() & ~bad.any() & (radius < jnp.asarray(p.floor, dtype) * amplitude)
    inner, info = p.inner.update(s.inner, _angle(inp, predicted + error, here.all() & ~lost))
    fast = s.memory.known & (jnp.abs(predicted - s.memory.angle) > 0.5 * np.pi)
    status = info.status | flag(bad.any(), Status.NONFINITE) | flag(lost | fast, Status.BOUND)
    expected = amplitude * jnp.stack([jnp.cos(predicted), jnp.sin(predicted)])
    info = info._replace(
        innovation=jnp.where(here & ~bad, inp.y - expected, 0.0), innovation_cov=None, noise_cov=None, status=status,
        extra={**info.extra, "error": info.innovation[0], "radius": jnp.where(here.all(), radius, 0.0), "fast": fast},
    )  # fmt: skip
    return Wrapped(inner, LoopMemory(info.mean[0], jnp.ones((), bool))), info
