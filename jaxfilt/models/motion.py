"""Linear motion models: white noise on some derivative of position.

State order: position block, velocity block, acceleration block, ... (``[x, y, vx, vy, ax, ay]``), so that models nest.
The axes are independent and share ``q``, or have one each.
"""

from __future__ import annotations

from math import factorial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from jaxfilt.core import Static
from jaxfilt.linalg.structure import array, repeat
from jaxfilt.models.linear import (
    LinearGaussian,
    check_positive,
    check_shape,
    common_dtype,
    linear_gaussian,
    measurement_covariance,
)

# The direction g of one step's noise for noise="piecewise", as powers dt^p / p!: by how many derivatives
# the state holds. Constant acceleration over the interval for CV, an acceleration (jerk) increment for CA (CJ).
_PIECEWISE_POWERS = {2: (2, 1), 3: (2, 1, 0), 4: (3, 2, 1, 0)}


class _Motion(NamedTuple):
    dt: Any  # (), the model's own interval
    q: Array  # (d,)
    order: Static  # derivatives in the state, position included
    noise: Static


def constant_velocity(*, dt: Any, q: Any, r: Any, m0: Any, P0: Any, noise: str = "continuous") -> LinearGaussian:
    """Nearly constant velocity: state ``[positions, velocities]``, position measured.

    Args:
        dt: interval [s]; per step, ``jf.filter(..., dt=)`` overrides it.
        q: noise, scalar or one per axis. ``"continuous"``: spectral density of white acceleration [m^2/s^3], per axis
            ``Q = q [[dt^3/3, dt^2/2], [dt^2/2, dt]]``. ``"piecewise"``: variance of an acceleration constant over each
            interval [m^2/s^4], ``Q = q g g'`` with ``g = [dt^2/2, dt]``.
        r: measurement variance [m^2]: scalar, one per axis, or (m, m).
        m0: (2d,) prior mean; its length gives the number d of axes.
        P0: (2d, 2d) prior covariance.
        noise: ``"continuous"`` or ``"piecewise"``.

    Source: Bar-Shalom, Li and Kirubarajan 2001, sections 6.2.2 and 6.3.2; thesis, eqs. (3-2) to (3-7).

    Raises:
        ValueError: bad shapes, dt <= 0, q < 0, an indefinite r or P0.
        TypeError: integer arrays or mixed float dtypes.
    """
    return _motion_model(2, dt, q, r, m0, P0, noise)


def constant_acceleration(*, dt: Any, q: Any, r: Any, m0: Any, P0: Any, noise: str = "continuous") -> LinearGaussian:
    """Nearly constant acceleration (Wiener acceleration): state ``[positions, velocities, accelerations]``.

    As :func:`constant_velocity` with ``q`` the spectral density of white jerk [m^2/s^5], or for ``"piecewise"`` the
    variance of the acceleration increment per interval [m^2/s^4], ``g = [dt^2/2, dt, 1]``.

    Source: Bar-Shalom, Li and Kirubarajan 2001, sections 6.2.3 and 6.3.3; thesis, eqs. (3-8) to (3-13).
    """
    return _motion_model(3, dt, q, r, m0, P0, noise)


def constant_jerk(*, dt: Any, q: Any, r: Any, m0: Any, P0: Any, noise: str = "continuous") -> LinearGaussian:
    """Nearly constant jerk: state ``[positions, velocities, accelerations, jerks]``.

    As :func:`constant_velocity` with ``q`` the spectral density of the white derivative of jerk [m^2/s^7], or for
    ``"piecewise"`` the variance of the jerk increment per interval [m^2/s^6], ``g = [dt^3/6, dt^2/2, dt, 1]``.

    Source: Mehrotra and Mahapatra 1997.
    """
    return _motion_model(4, dt, q, r, m0, P0, noise)


def _motion_model(order, dt, q, r, m0, P0, noise):
    if noise not in ("continuous", "piecewise"):
        raise ValueError(f'noise: expected "continuous" or "piecewise", got {noise!r}')
    check_positive("dt", dt)
    check_positive("q", q, zero=True)
    dtype = common_dtype({"dt": dt, "q": q, "r": r, "m0": m0, "P0": P0})
    check_shape("dt", dt, ())
    m0 = array(m0, dtype)
    if m0.ndim != 1 or m0.size == 0 or m0.size % order:
        raise ValueError(f"m0: expected shape ({order} d,) for d axes, got {m0.shape}")
    d = m0.size // order
    q, r = array(q, dtype), array(r, dtype)
    if q.shape not in ((), (d,)):
        raise ValueError(f"q: expected a scalar or shape ({d},), got {q.shape}")
    params = _Motion(array(dt, dtype), repeat(q, d), Static(order), Static(noise))
    R = measurement_covariance(r, d)
    H = np.eye(d, order * d).astype(dtype)
    return linear_gaussian(Partial(_transition, params), H, Partial(_process_noise, params), R, m0, P0)


def _transition(p: _Motion, u, dt):
    del u
    dt = p.dt if dt is None else dt
    order, d = p.order.value, p.q.shape[0]
    lag = np.arange(order)[None, :] - np.arange(order)[:, None]  # F_ij = dt^lag / lag! above the diagonal
    coefficients = np.where(lag >= 0, 1.0 / _factorials(np.maximum(lag, 0)), 0.0)
    F = jnp.asarray(coefficients, dt.dtype) * _powers(dt, np.maximum(lag, 0))
    return jnp.kron(F, jnp.eye(d, dtype=dt.dtype))


def _process_noise(p: _Motion, u, dt):
    del u
    dt = p.dt if dt is None else dt
    order = p.order.value
    if p.noise.value == "continuous":
        # The integral over the interval of g(s) g(s)', with g_i(s) = s^e_i / e_i! and e_i = order - 1 - i.
        e = np.arange(order - 1, -1, -1)
        powers = e[:, None] + e[None, :] + 1
        coefficients = 1.0 / (np.outer(_factorials(e), _factorials(e)) * powers)
        block = jnp.asarray(coefficients, dt.dtype) * _powers(dt, powers)
    else:
        e = np.array(_PIECEWISE_POWERS[order])
        g = jnp.asarray(1.0 / _factorials(e), dt.dtype) * _powers(dt, e)
        block = g[:, None] * g[None, :]
    return jnp.kron(block, jnp.diag(p.q))


def _powers(dt, exponents):
    # Integer powers, exact at dt = 0 and with finite derivatives there.
    return jnp.stack([dt ** int(e) for e in exponents.ravel()]).reshape(exponents.shape)


def _factorials(e):
    return np.vectorize(factorial)(e).astype(float)
