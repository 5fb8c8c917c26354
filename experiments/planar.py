"""Targets in the plane by CV, CA, CT and IMM: the filters that the experiments on recorded tracks tune and compare."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

import jaxfilt as jf
from jaxfilt import tune

# The modes of each filter. An IMM of two or three modes, a bank of one otherwise.
MODES = {
    "CV": ("CV",),
    "CA": ("CA",),
    "CT": ("CT",),
    "IMM (CV, CT)": ("CV", "CT"),
    "IMM (CV, CA, CT)": ("CV", "CA", "CT"),
}
# Where each mode's state stands in [x, y, vx, vy, ax, ay, omega], or in its beginning without what no mode has.
_COMPONENTS = {"CV": "xyuv", "CA": "xyuvab", "CT": "xyuvw"}


class Start(NamedTuple):
    """The prior of all modes."""

    mean: Any  # (4,) position and velocity
    cov: Any  # (4, 4)
    acceleration: Any = 1.0  # variance per axis, mean 0 [m^2/s^4]
    turn_rate: Any = 0.01  # variance, mean 0 [rad^2/s^2]


class Scale(NamedTuple):
    """Where the search for the noise begins: the same for every filter that has the parameter."""

    r: float  # measurement variance per axis [m^2]
    q: float = 1.0  # white acceleration of CV and CT [m^2/s^3]
    q_jerk: float = 0.1  # white jerk of CA [m^2/s^5]
    q_omega: float = 1e-3  # white turn acceleration of CT [rad^2/s^3]
    stay: float = 0.95  # probability that a mode lasts from one sample to the next


def space(name: str, scale: Scale) -> dict[str, Any]:
    """The parameters of a filter of :data:`MODES`, for :mod:`jaxfilt.tune`."""
    modes = MODES[name]
    specs: dict[str, Any] = {"r": _noise(scale.r)}
    if "CV" in modes:
        specs["cv_q"] = _noise(scale.q)
    if "CA" in modes:
        specs["ca_q"] = _noise(scale.q_jerk)
    if "CT" in modes:
        specs["ct_q"] = _noise(scale.q)
        specs["ct_q_omega"] = _noise(scale.q_omega)
    if len(modes) > 1:
        specs["stay"] = tune.interval(jnp.full(len(modes), scale.stay), 0.5, 0.9999)
    return specs


def _noise(initial: float) -> tune.Spec:
    return tune.positive(initial, 1e-5 * initial, 1e5 * initial)


def make(name: str, params: dict[str, Any], start: Start, sensor: jf.models.Sensor | None = None) -> jf.Filter:
    """A filter of :data:`MODES` for its parameters; linear modes by the Kalman filter, the others by the EKF.

    Args:
        name: a key of :data:`MODES`.
        params: values for the specs of :func:`space`.
        start: the prior.
        sensor: instead of the position with variance ``params["r"]``.
    """
    modes = MODES[name]
    filters = [_mode(mode, params, start, sensor) for mode in modes]
    if len(filters) == 1:
        return filters[0]
    union = "".join(c for c in "xyuvabw" if any(c in _COMPONENTS[mode] for mode in modes))
    index = [[union.index(c) for c in _COMPONENTS[mode]] for mode in modes]
    stay = jnp.asarray(params["stay"])
    r = len(modes)
    leave = ((1 - stay) / (r - 1))[:, None] * jnp.ones((r, r), stay.dtype)
    transition = jnp.where(jnp.eye(r, dtype=bool), stay[:, None], leave)
    return jf.imm(filters, transition, index=index)


def _mode(mode: str, params: dict[str, Any], start: Start, sensor: jf.models.Sensor | None) -> jf.Filter:
    mean, cov = jnp.asarray(start.mean), jnp.asarray(start.cov)
    r = params["r"]
    model: Any
    if mode == "CV":
        model = jf.models.constant_velocity(dt=1.0, q=params["cv_q"], r=r, m0=mean, P0=cov)
    elif mode == "CA":
        m0, P0 = _extend(mean, cov, 2, start.acceleration)
        model = jf.models.constant_acceleration(dt=1.0, q=params["ca_q"], r=r, m0=m0, P0=P0)
    else:
        m0, P0 = _extend(mean, cov, 1, start.turn_rate)
        model = jf.models.coordinated_turn(dt=1.0, q=params["ct_q"], q_omega=params["ct_q_omega"], r=r, m0=m0, P0=P0)
    if sensor is not None:
        return jf.extended(jf.models.with_sensor(model, sensor))
    return jf.extended(model) if mode == "CT" else jf.kalman(model)


def _extend(mean: Array, cov: Array, count: int, variance: Any) -> tuple[Array, Array]:
    """The prior with further components of mean 0."""
    extra = jnp.asarray(variance, mean.dtype) * jnp.eye(count, dtype=mean.dtype)
    zeros = jnp.zeros((len(mean), count), mean.dtype)
    return jnp.pad(mean, (0, count)), jnp.block([[cov, zeros], [zeros.T, extra]])


def in_parallel(function, jobs):
    """``[function(job) for job in jobs]``. Nearly all the time goes into compiling, which two threads can share."""
    with ThreadPoolExecutor(max_workers=2) as pool:
        return list(pool.map(function, jobs))
