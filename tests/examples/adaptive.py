"""Maneuver detection and the answers to it, gates and association."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from tests.examples import GAP, Example

# p_false is large, so that twelve samples see alarms and refusals.
_MODEL = {"q": np.array(0.1), "r": np.array([0.5, 0.8]), "m0": np.zeros(4), "P0": np.diag([1.0, 1.0, 0.5, 0.5])}


def _kalman(p):
    return jf.kalman(jf.models.constant_velocity(dt=1.0, **p))


def _detected(p):
    return jf.detected(_kalman(p["model"]), p_false=0.3)


def _detected_sum(p):
    return jf.detected(_kalman(p["model"]), "sum", p_false=0.3, window=3)


def _q_inflated(p):
    return jf.q_inflated(_detected(p), p["factor"])


def _p_inflated(p):
    sqrt = jf.sqrt_kalman(jf.models.constant_velocity(dt=1.0, **p["model"]))
    return jf.p_inflated(jf.detected(sqrt, "window", p_false=0.3, window=3), p["factor"])


def _gain_floor(p):
    return jf.gain_floor(_detected(p), alpha=p["alpha"], beta=p["beta"], dt=1.0)


def _variable_dimension(p):
    cv, ca = p["model"], p["ca"]
    zeros, eye = jnp.zeros((6,), cv["q"].dtype), jnp.eye(6, dtype=cv["q"].dtype)
    model_ca = jf.models.constant_acceleration(dt=1.0, q=ca["q"], r=ca["r"], m0=zeros, P0=eye)
    model_cv = jf.models.constant_velocity(dt=1.0, **cv)
    return jf.variable_dimension(model_cv, model_ca, p_false=0.3, lookback=2)


def _gated(p):
    return jf.gated(_kalman(p["model"]), p["p_false"])


class _Scanned(NamedTuple):
    inner: Any


def _scan(inp):
    """y, between a detection that is near in one step of three and one far off; and a slot that holds nothing."""
    near = inp.y - jnp.sin(3 * inp.y)
    detections = jnp.stack([inp.y + 30, inp.y, near, jnp.full_like(inp.y, jnp.nan)])
    return inp._replace(u={"detections": detections, "valid": jnp.array([True, True, True, False])})


def _scanned_init(p, inp):
    return p.inner.init(_scan(inp))


def _scanned_predict(p, s, inp):
    return p.inner.predict(s, _scan(inp))


def _scanned_update(p, s, inp):
    return p.inner.update(s, _scan(inp))


def _nearest_neighbor(p):
    """The series of the generic properties made into scans."""
    inner = jf.nearest_neighbor(_kalman(p["model"]), p["p_false"])
    return jf.bind(_Scanned(inner), _scanned_init, _scanned_predict, _scanned_update)


def _example(factory, make, **parameters):
    return Example(factory, make, {"model": _MODEL, **parameters}, options=GAP)


EXAMPLES: dict[str, Example] = {
    "detected": _example(jf.detected, _detected),
    "detected_sum": _example(jf.detected, _detected_sum)._replace(twin=True),
    "q_inflated": _example(jf.q_inflated, _q_inflated, factor=np.array(20.0)),
    "p_inflated": _example(jf.p_inflated, _p_inflated, factor=np.array(3.0))._replace(twin=True),
    "gain_floor": _example(jf.gain_floor, _gain_floor, alpha=np.array(0.9), beta=np.array(0.6)),
    "variable_dimension": _example(
        jf.variable_dimension, _variable_dimension, ca={"q": np.array(0.05), "r": np.array([0.6, 0.7])}
    ),
    "gated": _example(jf.gated, _gated, p_false=np.array(0.3))._replace(twin=True),
    "nearest_neighbor": _example(jf.nearest_neighbor, _nearest_neighbor, p_false=np.array(0.2)),
}
