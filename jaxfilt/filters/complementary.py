"""Attitude filters with fixed gains: complementary, Mahony, Madgwick.

Conventions as in :mod:`jaxfilt.filters.attitude`. They have no covariance. A
sample of which a component is missing gives no direction and counts as missed.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxfilt.core import Filter, Info, Prediction, Status, bind, flag, present
from jaxfilt.filters.attitude import GRAVITY, angles, check_frame, check_start, held_rate, interval, start_axis, unit
from jaxfilt.linalg import rotation
from jaxfilt.models.linear import check_positive, check_shape, common_dtype


class ComplementaryState(NamedTuple):
    """The estimate, and what the next step needs."""

    mean: Array  # (3,) vertical axis, Mahony: and gyro bias (6,)
    quaternion: Array | None  # (4,) body to earth, scalar first; Madgwick
    rate: Array  # (3,) the last finite gyro reading
    roll: Array  # () the last defined one
    pending: Array  # () int32, status that the next update reports


class _Params(NamedTuple):
    dt: Any
    gravity: Any  # signed; only its sign, and the innovation, depend on it
    z0: Any
    gains: tuple[Any, ...]


def complementary(*, dt: Any, tau: Any = 2.0, frame: str = "up", gravity: Any = GRAVITY, z0: Any = None) -> Filter:
    """The complementary filter of the vertical axis: the gyro carries it, the accelerometer pulls at it.

    ``Z- = exp(-dt [u x]) Z``, ``Z = Z- + dt / (tau + dt) (y / |y| - Z-)``, made a unit vector again. State Z (3,).
    ``info.innovation`` is ``y - G Z-``; ``info.extra`` and the status as in :func:`jaxfilt.attitude`.

    Args:
        dt: interval [s]; per step, ``jf.filter(..., dt=)`` overrides it.
        tau: [s] the time over which it averages accelerations.
        frame: ``"up"`` or ``"down"``, where Z points.
        gravity: [m/s^2].
        z0: (3,) the initial vertical axis; None = from the first sample.

    Raises:
        ValueError: an interval, tau or gravity not positive, an unknown frame, a z0 of no length; at trace time scales
            of noise, of which it has none.
        TypeError: integer arrays or mixed float dtypes.
    """
    check_positive("tau", tau)
    return bind(_params(dt, frame, gravity, z0, {"tau": tau}), _init, _predict, _update_complementary)


def mahony(
    *,
    dt: Any,
    proportional: Any = 0.74,
    integral: Any = 0.0012,
    frame: str = "up",
    gravity: Any = GRAVITY,
    z0: Any = None,
) -> Filter:
    """Mahony's complementary filter on rotations, without a magnetometer.

    ``e = y / |y| x Z-``, ``b = b - integral e dt``, ``Z = exp(-dt [proportional e x]) Z-``, where Z- was carried by
    ``u - b``. State ``[Z, b]`` (6,), b the gyro's bias. Otherwise as :func:`complementary`.

    Args:
        dt: interval [s].
        proportional: [rad/s] per radian.
        integral: [rad/s^2] per radian, >= 0.
        frame: as in :func:`complementary`.
        gravity: likewise.
        z0: likewise.

    Source: Mahony, Hamel and Pflimlin 2008, IEEE Trans. Automat. Contr. 53(5).
    """
    check_positive("proportional", proportional)
    check_positive("integral", integral, zero=True)
    gains = {"proportional": proportional, "integral": integral}
    return bind(_params(dt, frame, gravity, z0, gains), _init_mahony, _predict, _update_mahony)


def madgwick(*, dt: Any, beta: Any = 0.12, frame: str = "up", gravity: Any = GRAVITY, z0: Any = None) -> Filter:
    """Madgwick's filter without a magnetometer: a step of fixed length down the gradient, whatever the error.

    The quaternion q is carried by the gyro, then ``q = q - beta dt g / |g|`` with g the gradient of
    ``|Z(q) - y / |y||^2 / 2``. State Z (3,); the heading is meaningless. Otherwise as :func:`complementary`.

    Args:
        dt: interval [s].
        beta: [rad/s], half the rate at which it turns towards the accelerometer.
        frame: as in :func:`complementary`.
        gravity: likewise.
        z0: likewise.

    Source: Madgwick, Harrison and Vaidyanathan 2011, ICORR.
    """
    check_positive("beta", beta)
    return bind(_params(dt, frame, gravity, z0, {"beta": beta}), _init_madgwick, _predict_madgwick, _update_madgwick)


def _params(dt, frame, gravity, z0, gains):
    check_positive("dt", dt)
    check_positive("gravity", gravity)
    p = _Params(dt, check_frame(frame) * gravity, check_start(z0), tuple(gains.values()))
    named = {"dt": dt, "gravity": gravity, "z0": p.z0, **gains}
    common_dtype({name: x for name, x in named.items() if x is not None})
    for name, x in named.items():
        if name != "z0":
            check_shape(name, x, ())
    return p


def _init(p, inp):
    for name in ("q_scale", "r_scale"):
        if getattr(inp, name) is not None:
            raise ValueError(f"{name}: a filter with fixed gains has no noise to scale")
    Z, pending = start_axis(p, inp)
    zero = jnp.zeros((3,), Z.dtype)
    return ComplementaryState(Z, None, zero, angles(Z, zero[0])[0], pending)


def _init_mahony(p, inp):
    s = _init(p, inp)
    return s._replace(mean=jnp.concatenate([s.mean, jnp.zeros_like(s.mean)]))


def _init_madgwick(p, inp):
    s = _init(p, inp)
    x, y, z = s.mean
    # The shortest turn between Z and the third axis; half a turn about the first where they are opposite.
    opposite = z < -1 + 1e-6
    one = jnp.ones_like(z)
    w = jnp.sqrt(0.5 * (1 + jnp.where(opposite, one, z)))
    zero = jnp.zeros_like(z)
    turned = jnp.stack([w, 0.5 * y / w, -0.5 * x / w, zero])
    q = jnp.where(opposite, jnp.stack([zero, one, zero, zero]), turned)
    return s._replace(mean=_axis(q), quaternion=q)


def _predict(p, s, inp):
    rate, status = held_rate(s.rate, inp)
    b = s.mean[3:]
    turned = rotation(-interval(p, inp) * (rate - b if b.shape[0] else rate)) @ s.mean[:3]
    mean = jnp.concatenate([turned, b])
    return s._replace(mean=mean, rate=rate, pending=s.pending | status), Prediction(mean)


def _predict_madgwick(p, s, inp):
    rate, status = held_rate(s.rate, inp)
    half = 0.5 * interval(p, inp) * rate
    square = jnp.sum(half * half)
    small = square < jnp.finfo(half.dtype).eps
    angle = jnp.sqrt(jnp.where(small, jnp.ones_like(square), square))
    cosine = jnp.where(small, 1 - 0.5 * square, jnp.cos(angle))
    x, y, z = half * jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
    w0, x0, y0, z0 = s.quaternion
    q = jnp.stack([
        w0 * cosine - x0 * x - y0 * y - z0 * z,
        w0 * x + x0 * cosine + y0 * z - z0 * y,
        w0 * y - x0 * z + y0 * cosine + z0 * x,
        w0 * z + x0 * y - y0 * x + z0 * cosine,
    ])  # fmt: skip
    mean = _axis(q)
    return s._replace(mean=mean, quaternion=q, rate=rate, pending=s.pending | status), Prediction(mean)


def _axis(q):
    w, x, y, z = q
    return jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])


def _direction(p, inp):
    """The direction of the sample along Z, and whether there is one."""
    usable = (jnp.isfinite(inp.y) & present(inp)).all()
    y = jnp.where(usable, inp.y, jnp.ones((), inp.y.dtype))
    square = jnp.sum(y * y)
    usable = usable & (square > 0)
    length = jnp.sqrt(jnp.where(usable, square, jnp.ones_like(square)))
    return jnp.sign(jnp.asarray(p.gravity, y.dtype)) * y / length, usable


def _update_complementary(p, s, inp):
    direction, usable = _direction(p, inp)
    dt = interval(p, inp)
    pulled = s.mean + dt / (p.gains[0] + dt) * (direction - s.mean)
    Z, _, lost = unit(pulled, s.mean)
    return _finish(p, s, inp, s._replace(mean=Z), usable, lost)


def _update_mahony(p, s, inp):
    proportional, integral = p.gains
    direction, usable = _direction(p, inp)
    dt, Z = interval(p, inp), s.mean[:3]
    error = jnp.cross(direction, Z)
    turned, _, lost = unit(rotation(-dt * proportional * error) @ Z, Z)
    mean = jnp.concatenate([turned, s.mean[3:] - integral * dt * error])
    return _finish(p, s, inp, s._replace(mean=mean), usable, lost)


def _update_madgwick(p, s, inp):
    direction, usable = _direction(p, inp)
    w, x, y, z = q = s.quaternion
    rows = [[-2 * y, 2 * z, -2 * w, 2 * x], [2 * x, 2 * w, 2 * z, 2 * y], [0 * w, -4 * x, -4 * y, 0 * w]]
    gradient = jnp.stack([jnp.stack(row) for row in rows]).T @ (s.mean - direction)
    square = jnp.sum(gradient * gradient)
    some = square > jnp.finfo(q.dtype).eps ** 2
    step = jnp.where(some, gradient / jnp.sqrt(jnp.where(some, square, jnp.ones_like(square))), 0.0 * gradient)
    q, _, lost = unit(q - p.gains[0] * interval(p, inp) * step, q)
    return _finish(p, s, inp, s._replace(mean=_axis(q), quaternion=q), usable, lost)


def _finish(p, before, inp, after, usable, lost):
    """Takes the update where there was a sample; the same outputs for all."""
    s = jax.tree.map(lambda new, old: jnp.where(usable, new, old), after, before)
    here = present(inp)
    bad = ~jnp.isfinite(inp.y) & here
    nu = jnp.where(here & ~bad, inp.y - p.gravity * before.mean[:3], jnp.zeros((), inp.y.dtype))
    roll, pitch, undefined = angles(s.mean[:3], before.roll)
    status = before.pending | flag((lost & usable) | undefined, Status.BOUND) | flag(bad.any(), Status.NONFINITE)
    status = status | flag(~here.any(), Status.MISSED)
    a_ext = jnp.where(usable, inp.y - p.gravity * s.mean[:3], jnp.zeros((), inp.y.dtype))
    extra = {"a_ext": a_ext, "roll": roll, "pitch": pitch}
    s = s._replace(roll=roll, pending=jnp.int32(0))
    return s, Info(s.mean, None, nu, None, None, None, status, extra=extra)
