"""Sensors for planar motion models, whose states begin with ``[x, y, vx, vy, ...]``.

Give one to a motion model with :func:`jaxfilt.models.with_sensor`. R is an array (checked) or a function
``(x, u, dt)``. The observer is at the origin, or where ``observer`` says: an array or a function ``(u, dt)`` of what is
in force, either ``[x, y]`` or ``[x, y, vx, vy]``. Bearings are counter-clockwise from the x axis [rad]; their residuals
are wrapped to [-pi, pi], and by the same residual sigma points are averaged, so the line where bearings jump is nowhere
special.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array
from jax.tree_util import Partial

from jaxfilt.core import Static, aspartial
from jaxfilt.models.linear import check_covariance, common_dtype
from jaxfilt.models.nonlinear import Sensor


def position(R: Any) -> Sensor:
    """Measures ``[x, y]``; R (2, 2) [m^2]."""
    return Sensor(Partial(_first, Static(2)), _covariance(R, 2))


def position_velocity(R: Any) -> Sensor:
    """Measures ``[x, y, vx, vy]``; R (4, 4) [m^2, m^2/s^2]."""
    return Sensor(Partial(_first, Static(4)), _covariance(R, 4))


def range_bearing(R: Any, *, observer: Any = None) -> Sensor:
    """Measures ``[range, bearing]``; R (2, 2) [m^2, rad^2]."""
    return Sensor(Partial(_range_bearing, _observer(observer)), _covariance(R, 2), Partial(wrap_at, Static((1,))))


def bearing(R: Any, *, observer: Any = None) -> Sensor:
    """Measures ``[bearing]``; R (1, 1) [rad^2]."""
    return Sensor(Partial(_bearing, _observer(observer)), _covariance(R, 1), Partial(wrap_at, Static((0,))))


def range_rate(R: Any, *, observer: Any = None) -> Sensor:
    """Measures ``[range, bearing, range rate]``; R (3, 3) [m^2, rad^2, m^2/s^2].

    The rate is relative to the observer's velocity if ``observer`` gives one, else the observer is at rest.
    """
    return Sensor(Partial(_range_rate, _observer(observer)), _covariance(R, 3), Partial(wrap_at, Static((1,))))


def wrap(angle: Array) -> Array:
    """The angle in [-pi, pi] [rad]; one that is there already keeps every digit."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def wrap_at(components: Static, y: Array, predicted: Array) -> Array:
    """The residual ``y - predicted`` (m,) with the given components wrapped to [-pi, pi].

    For a sensor of your own: ``residual=Partial(wrap_at, Static((1,)))``.
    """
    difference = y - predicted
    index = jnp.asarray(components.value)
    return difference.at[index].set(wrap(difference[index]))


def _observer(observer: Any) -> Any:
    return aspartial(observer) if callable(observer) else observer


def _covariance(R: Any, m: int) -> Any:
    if callable(R):
        return aspartial(R)
    if jnp.shape(jnp.asarray(R)) != (m, m):
        raise ValueError(f"R: expected shape ({m}, {m}), got {jnp.shape(jnp.asarray(R))}")
    check_covariance("R", R)
    return R


def _relative(observer, x, u, dt, size):
    """The first ``size`` (2 or 4) components of the state relative to the observer's."""
    if x.shape[0] < size:
        raise ValueError(f"x: the sensor needs a state that begins with {size} components, got {x.shape[0]}")
    if observer is None:
        return x[:size]
    place = observer(u, dt) if callable(observer) else observer
    place = jnp.asarray(place, common_dtype({"observer": place, "m0": x}))
    if place.shape not in ((2,), (4,)):
        raise ValueError(f"observer: expected shape (2,) or (4,), got {place.shape}")
    place = jnp.concatenate([place, jnp.zeros((4 - place.shape[0],), place.dtype)])
    return x[:size] - place[:size]


def _polar(dx, dy):
    """Range and bearing, with finite (zero) derivatives at the observer itself."""
    square = dx * dx + dy * dy
    apart = square > 0
    distance = jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1.0)), 0.0)
    angle = jnp.arctan2(jnp.where(apart, dy, 0.0), jnp.where(apart, dx, 1.0))
    return distance, angle


def _first(size, x, u, dt):
    return _relative(None, x, u, dt, size.value)


def _range_bearing(observer, x, u, dt):
    dx, dy = _relative(observer, x, u, dt, 2)
    return jnp.stack(_polar(dx, dy))


def _bearing(observer, x, u, dt):
    dx, dy = _relative(observer, x, u, dt, 2)
    return _polar(dx, dy)[1][None]


def _range_rate(observer, x, u, dt):
    dx, dy, dvx, dvy = _relative(observer, x, u, dt, 4)
    distance, angle = _polar(dx, dy)
    rate = (dx * dvx + dy * dvy) / jnp.where(distance > 0, distance, 1.0)
    return jnp.stack([distance, angle, rate])
