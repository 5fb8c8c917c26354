"""Sensors for planar motion models, whose states begin with ``[x, y, vx, vy, ...]``.

Give one to a motion model with :func:`jaxfilt.models.with_sensor`. R is an array (checked) or a function
``(x, u, dt)``. The observer is at the origin, or where ``observer`` says: an array or a function ``(u, dt)`` of what is
in force, either ``[x, y]`` or ``[x, y, vx, vy]``. Bearings are counter-clockwise from the x axis [rad], unless a sensor
offers the compass's; their residuals are wrapped to [-pi, pi], and by the same residual sigma points are averaged, so
the line where bearings jump is nowhere special.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from jaxfilt.core import Static, aspartial, check_flag, is_concrete
from jaxfilt.models.linear import check_covariance, check_finite, check_positive, common_dtype
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


def bearing_doppler(
    R: Any, *, speed: Any = 1500.0, observer: Any = None, doppler: str = "first", compass: bool = False
) -> Sensor:
    """Measures ``[bearing, received frequency]`` of a target that emits a tone; R (2, 2) [rad^2, Hz^2].

    The state is ``[x, y, vx, vy, f_B]`` with the emitted frequency f_B [Hz]. With ``u`` the unit vector from observer
    to target and ``V_D`` the rate of the range [m/s]::

        first:  f_r = f_B (1 - V_D / speed)
        exact:  f_r = f_B (speed + u v_observer) / (speed + u v_target)

    They differ by about ``f_B (u v_target) V_D / speed^2``.

    Where the target is at the observer the derivatives of the bearing are 0. Closer than some distance no linearization
    of it is good: :func:`jaxfilt.usable_where` with :func:`apart` leaves such samples out.

    Args:
        R: array, positive definite, or function.
        speed: of propagation [m/s], > 0; the default is that of sound in sea water. May be traced.
        observer: as in this module's head.
        doppler: ``"first"`` order in V_D / speed, or ``"exact"`` for a medium at rest.
        compass: bearings clockwise from the y axis (north), ``atan2(dx, dy)``, instead.

    Raises:
        ValueError: speed <= 0, a (concrete) R that is not positive definite, another doppler.
    """
    check_positive("speed", speed, scalar=True)
    check_flag("compass", compass)
    if doppler not in ("first", "exact"):
        raise ValueError(f'doppler: expected "first" or "exact", got {doppler!r}')
    noise = _covariance(R, 2)
    if not callable(R) and is_concrete(R):
        A = np.asarray(R, np.float64)
        if not (A[0, 0] > 0 and A[0, 0] * A[1, 1] > A[0, 1] * A[1, 0]):
            raise ValueError(f"R: expected a positive definite matrix, got {A.tolist()}")
    h = Partial(_bearing_doppler, _observer(observer), speed, Static((doppler, compass)))
    return Sensor(h, noise, Partial(wrap_at, Static((0,))))


def apart(distance: Any, observer: Any, mean: Array, y: Array, u: Any, dt: Array | None) -> Array:
    """Whether the bearing is usable: the target is expected ``distance`` [m] or more from the observer.

    For :func:`jaxfilt.usable_where`, as ``Partial(apart, distance, observer)``: the first component (the bearing) is
    judged, the others are usable.
    """
    dx, dy = _relative(_observer(observer), mean, u, dt, 2)
    far = dx * dx + dy * dy >= jnp.asarray(distance, mean.dtype) ** 2
    return jnp.ones(y.shape, bool).at[0].set(far)


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
    if observer is None or callable(observer):
        return observer if observer is None else aspartial(observer)
    common_dtype({"observer": observer})
    check_finite("observer", observer)
    if jnp.shape(jnp.asarray(observer)) not in ((2,), (4,)):
        raise ValueError(f"observer: expected shape (2,) or (4,), got {jnp.shape(jnp.asarray(observer))}")
    return observer


def _covariance(R: Any, m: int) -> Any:
    if callable(R):
        return aspartial(R)
    common_dtype({"R": R})
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


def _bearing_doppler(observer, speed, options, x, u, dt):
    doppler, compass = options.value
    if x.shape[0] < 5:
        raise ValueError(f"x: the sensor needs a state [x, y, vx, vy, f_B], got {x.shape[0]} components")
    dx, dy, dvx, dvy = _relative(observer, x, u, dt, 4)
    distance, _ = _polar(dx, dy)
    angle = _polar(dy, dx)[1] if compass else _polar(dx, dy)[1]
    safe = jnp.where(distance > 0, distance, 1.0)
    speed = jnp.asarray(speed, x.dtype)
    rate = (dx * dvx + dy * dvy) / safe
    if doppler == "first":
        return jnp.stack([angle, x[4] * (1 - rate / speed)])
    away = (dx * x[2] + dy * x[3]) / safe  # the target's own part
    return jnp.stack([angle, x[4] * (speed + away - rate) / (speed + away)])
