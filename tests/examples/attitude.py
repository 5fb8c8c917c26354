"""The attitude filters, with a gyro reading that is one of their parameters: the same for all steps."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

import jaxfilt as jf
from jaxfilt.core import Wrapped
from tests.examples import Example

GAP3 = {"mask": np.array([[True] * 3] * 8 + [[True, False, True], [False] * 3, [False] * 3, [True] * 3])}


class _Turning(NamedTuple):
    inner: jf.Filter
    rate: Any


def _turning(inner, rate):
    """Feeds the reading to a filter in place of ``u``."""
    return jf.wrap(_Turning(inner, rate), init=_init, predict=_predict, update=_update)


def _init(p, inp):
    return Wrapped(p.inner.init(inp._replace(u=p.rate)))


def _predict(p, s, inp):
    inner, prediction = p.inner.predict(s.inner, inp._replace(u=p.rate))
    return s._replace(inner=inner), prediction


def _update(p, s, inp):
    inner, info = p.inner.update(s.inner, inp._replace(u=p.rate))
    return s._replace(inner=inner), info


def _make(factory, frame="up", **options):
    def make(p):
        given = {name: x for name, x in p.items() if name != "rate"}
        return _turning(factory(frame=frame, **options, **given), p["rate"])

    return make


_ARRAYS = {"dt": 0.3, "z0": [0.3, -0.4, 0.8], "gravity": 1.3, "rate": [0.2, -0.5, 0.3]}
_NOISE = {"gyro_var": 0.02, "acc_var": 0.3, "bias_var": 0.05}
_SHAPE = {"shape": "an accelerometer has three components, so the message names another number"}


def _example(factory, make, twin=False, exempt=_SHAPE, **parameters):
    params = {name: np.array(x, float) for name, x in {**_ARRAYS, **parameters}.items()}
    return Example(factory, make, params, m=3, options=GAP3, exempt=exempt, twin=twin)


EXAMPLES: dict[str, Example] = {
    "attitude": _example(jf.attitude, _make(jf.attitude), True, **_NOISE, kappa=0.4, c=0.3),
    "attitude_peak": _example(
        jf.attitude_peak, _make(jf.attitude_peak), True, **_NOISE, kappa=0.2, rho=0.5, decay=0.8
    ),
    "attitude_switched": _example(
        jf.attitude_switched, _make(jf.attitude_switched), True, **_NOISE, threshold=0.5, width=0.3, moving_var=5.0
    ),
    "attitude_velocity": _example(jf.attitude_velocity, _make(jf.attitude_velocity), **_NOISE, velocity_var=0.4),
    "complementary": _example(jf.complementary, _make(jf.complementary), True, tau=0.9),
    "mahony": _example(jf.mahony, _make(jf.mahony, "down"), True, proportional=0.7, integral=0.1),
    "madgwick": _example(jf.madgwick, _make(jf.madgwick), True, beta=0.4),
}  # fmt: skip
