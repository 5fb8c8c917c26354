"""Coordinated turns in the plane, with known and with unknown turn rate."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from jaxfilt.core import is_concrete
from jaxfilt.linalg.structure import array
from jaxfilt.models.linear import (
    LinearGaussian,
    check_finite,
    check_positive,
    check_shape,
    common_dtype,
    linear_gaussian,
    measurement_covariance,
)
from jaxfilt.models.nonlinear import Nonlinear, nonlinear


class _Turn(NamedTuple):
    dt: Array  # ()
    omega: Array | None  # () if known
    q: Array  # (), on the velocities
    q_omega: Array | None  # ()


def coordinated_turn(*, dt: Any, q_omega: Any, r: Any, m0: Any, P0: Any, q: Any = 0.0) -> Nonlinear:
    """A turn at unknown rate: state ``[x, y, vx, vy, omega]``, position measured, omega a random walk.

    Over an interval the velocity turns by ``omega dt`` (counter-clockwise for omega > 0) and the position follows the
    arc. At ``omega dt -> 0`` a series takes over, value and derivatives included; omega = 0 is constant velocity.

    Args:
        dt: interval [s]; per step, ``jf.filter(..., dt=)`` overrides it.
        q_omega: spectral density of the noise on omega [rad^2/s^3]; ``Q_omega = q_omega dt``.
        r: measurement variance [m^2]: scalar, one per axis, or (2, 2). For other sensors see
            :func:`jaxfilt.models.with_sensor`.
        m0: (5,) prior mean.
        P0: (5, 5) prior covariance.
        q: spectral density of white acceleration in x and y [m^2/s^3], as in :func:`constant_velocity`.

    Raises:
        ValueError: bad shapes, dt <= 0, q or q_omega < 0, an indefinite r or P0.
        TypeError: integer arrays or mixed float dtypes.

    Source: Bar-Shalom, Li and Kirubarajan 2001, section 11.7; thesis, eq. (4-2).
    """
    check_positive("q_omega", q_omega, zero=True)
    p, m0, R = _check(dt, q, r, m0, P0, 5, q_omega=q_omega)
    return nonlinear(Partial(_turn, p), _position, Partial(_turn_noise, p), R, m0, P0)


def known_turn(*, dt: Any, omega: Any, q: Any, r: Any, m0: Any, P0: Any) -> LinearGaussian:
    """A turn at known rate: state ``[x, y, vx, vy]``, linear, position measured; omega = 0 is constant velocity.

    Args:
        dt: interval [s]; per step, ``jf.filter(..., dt=)`` overrides it.
        omega: turn rate [rad/s], counter-clockwise positive.
        q: spectral density of white acceleration [m^2/s^3], as in :func:`constant_velocity`.
        r: measurement variance [m^2]: scalar, one per axis, or (2, 2).
        m0: (4,) prior mean.
        P0: (4, 4) prior covariance.

    Warns:
        UserWarning: if ``|omega| dt > pi`` (concrete values): the turn is aliased, a slower one the other way fits too.

    Raises:
        ValueError: bad shapes, dt <= 0, q < 0, an indefinite r or P0.
        TypeError: integer arrays or mixed float dtypes.

    Source: Bar-Shalom, Li and Kirubarajan 2001, section 11.7.
    """
    p, m0, R = _check(dt, q, r, m0, P0, 4, omega=omega)
    check_finite("omega", omega)
    if is_concrete((omega, dt)) and abs(angle := float(omega) * float(dt)) > np.pi:
        warnings.warn(f"omega: a turn of {angle:.3g} rad per interval is aliased", stacklevel=2)
    H = np.eye(2, 4).astype(R.dtype)
    return linear_gaussian(Partial(_known_transition, p), H, Partial(_velocity_noise, p), R, m0, P0)


def arc(omega: Array, dt: Array) -> tuple[Array, Array, Array, Array]:
    """``(sin u / omega, (cos u - 1) / omega, cos u, sin u)`` with ``u = omega dt``, right to rounding at any omega.

    The first two by series below ``|u| = 0.01`` (0.2 in single precision), inside a double ``where`` so that
    derivatives of any order are finite there; elsewhere the second as ``-2 sin^2(u / 2) / omega``, which does not
    cancel.
    """
    u = omega * dt
    limit = 0.01 if u.dtype == jnp.float64 else 0.2
    small = jnp.abs(u) < limit
    w = jnp.where(small, jnp.ones((), u.dtype), omega)
    v = w * dt
    z = u * u
    s_series = dt * (1 - z / 6 * (1 - z / 20 * (1 - z / 42 * (1 - z / 72))))
    c_series = -dt * u / 2 * (1 - z / 12 * (1 - z / 30 * (1 - z / 56 * (1 - z / 90))))
    s = jnp.where(small, s_series, jnp.sin(v) / w)
    c = jnp.where(small, c_series, -2 * jnp.sin(v / 2) ** 2 / w)
    return s, c, jnp.cos(u), jnp.sin(u)


def _check(dt, q, r, m0, P0, n, omega=None, q_omega=None):
    check_positive("dt", dt)
    check_positive("q", q, zero=True)
    given = {"dt": dt, "q": q, "r": r, "m0": m0, "P0": P0, "omega": omega, "q_omega": q_omega}
    unused = "q_omega" if q_omega is None else "omega"
    dtype = common_dtype({name: x for name, x in given.items() if name != unused})
    m0 = array(m0, dtype)
    check_shape("m0", m0, (n,))
    r = array(r, dtype)
    R = measurement_covariance(r, 2)
    scalars: dict[str, Any] = {"dt": dt, "omega": omega, "q": q, "q_omega": q_omega}
    for name, x in scalars.items():
        if x is not None:
            scalars[name] = array(x, dtype)
            check_shape(name, scalars[name], ())
    p = _Turn(**scalars)
    return p, m0, R


def _matrix(omega, dt):
    s, c, cos, sin = arc(omega, dt)
    one, zero = jnp.ones((), s.dtype), jnp.zeros((), s.dtype)
    rows = [[one, zero, s, c], [zero, one, -c, s], [zero, zero, cos, -sin], [zero, zero, sin, cos]]
    return jnp.stack([jnp.stack(row) for row in rows])


def _turn(p, x, u, dt):
    del u
    moved = _matrix(x[4], p.dt if dt is None else dt) @ x[:4]
    return jnp.concatenate([moved, x[4:]])


def _position(x, u, dt):
    del u, dt
    return x[:2]


def _velocity_noise(p, u, dt):
    del u
    dt = p.dt if dt is None else dt
    block = jnp.stack([jnp.stack([dt**3 / 3, dt**2 / 2]), jnp.stack([dt**2 / 2, dt])])
    return p.q * jnp.kron(block, jnp.eye(2, dtype=block.dtype))


def _turn_noise(p, x, u, dt):
    del x
    Q = _velocity_noise(p, u, dt)
    corner = (p.q_omega * (p.dt if dt is None else dt)).reshape(1, 1)
    zeros = jnp.zeros((4, 1), Q.dtype)
    return jnp.block([[Q, zeros], [zeros.T, corner]])


def _known_transition(p, u, dt):
    del u
    return _matrix(p.omega, p.dt if dt is None else dt)
