"""Singer's maneuver model: exponentially correlated acceleration."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from jaxfilt.core import is_concrete
from jaxfilt.linalg.structure import array, repeat
from jaxfilt.models.discretise import van_loan
from jaxfilt.models.linear import (
    LinearGaussian,
    check_positive,
    check_shape,
    common_dtype,
    linear_gaussian,
    measurement_covariance,
)


class _Singer(NamedTuple):
    dt: Array  # ()
    tau: Array  # ()
    variance: Array  # (d,)


def singer(*, dt: Any, tau: Any, variance: Any, r: Any, m0: Any, P0: Any) -> LinearGaussian:
    """Singer's model: the acceleration is a first-order Markov process, ``da = -a / tau dt + dw``.

    State ``[positions, velocities, accelerations]``, position measured. F and Q come from the matrix exponential (Van
    Loan) up to ``dt / tau = 2``, since Singer's closed form loses its digits at small dt / tau, and beyond from the
    closed form, since the exponential overflows there. For tau -> infinity at fixed ``q = 2 variance / tau`` it is
    :func:`constant_acceleration`, for tau -> 0 at fixed ``q = 2 variance tau`` :func:`constant_velocity`.

    Args:
        dt: interval [s]; per step, ``jf.filter(..., dt=)`` overrides it.
        tau: correlation time of the acceleration [s].
        variance: of the acceleration [m^2/s^4], scalar or one per axis; :func:`maneuver_variance` gives it from the
            largest acceleration.
        r: measurement variance [m^2]: scalar, one per axis, or (m, m).
        m0: (3d,) prior mean.
        P0: (3d, 3d) prior covariance.

    Raises:
        ValueError: bad shapes, dt <= 0, tau <= 0, variance < 0, an indefinite r or P0.
        TypeError: integer arrays or mixed float dtypes.

    Source: Singer 1970; Bar-Shalom, Li and Kirubarajan 2001, section 8.2.
    """
    check_positive("dt", dt)
    check_positive("tau", tau)
    check_positive("variance", variance, zero=True)
    dtype = common_dtype({"dt": dt, "tau": tau, "variance": variance, "r": r, "m0": m0, "P0": P0})
    check_shape("dt", dt, ())
    check_shape("tau", tau, ())
    m0 = array(m0, dtype)
    if m0.ndim != 1 or m0.size == 0 or m0.size % 3:
        raise ValueError(f"m0: expected shape (3 d,) for d axes, got {m0.shape}")
    d = m0.size // 3
    variance, r = array(variance, dtype), array(r, dtype)
    if variance.shape not in ((), (d,)):
        raise ValueError(f"variance: expected a scalar or shape ({d},), got {variance.shape}")
    params = _Singer(array(dt, dtype), array(tau, dtype), repeat(variance, d))
    R = measurement_covariance(r, d)
    H = np.eye(d, 3 * d).astype(dtype)
    return linear_gaussian(Partial(_transition, params), H, Partial(_process_noise, params), R, m0, P0)


def maneuver_variance(largest: Any, *, p_largest: Any, p_zero: Any) -> Any:
    """Singer's variance of an acceleration that is 0 with p_zero, +-largest with p_largest each, else uniform between.

    ``largest^2 / 3 (1 + 4 p_largest - p_zero)`` [m^2/s^4].

    Raises:
        ValueError: a negative argument (if concrete), or probabilities that add up to more than 1.

    Source: Singer 1970.
    """
    for name, x in (("largest", largest), ("p_largest", p_largest), ("p_zero", p_zero)):
        check_positive(name, x, zero=True)
    if is_concrete((p_largest, p_zero)) and np.any(2 * np.asarray(p_largest) + np.asarray(p_zero) > 1):
        raise ValueError(f"p_largest: expected 2 p_largest + p_zero <= 1, got {p_largest} and p_zero = {p_zero}")
    return largest**2 / 3 * (1 + 4 * p_largest - p_zero)


def _unit(rate):
    """``(F, Q)`` of one axis over an interval 1, for a noise of spectral density 1 and a decay rate 1 / tau."""
    dtype = rate.dtype
    small = rate < 2
    A = jnp.asarray(np.eye(3, k=1), dtype) - jnp.asarray(np.diag([0.0, 0, 1]), dtype) * jnp.where(small, rate, 1.0)
    F, Q = van_loan(A, jnp.asarray(np.diag([0.0, 0, 1]), dtype), 1.0)
    e = jnp.where(small, 2.0, rate)
    E = jnp.exp(-e)
    one, zero = jnp.ones((), dtype), jnp.zeros((), dtype)
    q11 = (1 - E**2 + 2 * e + 2 / 3 * e**3 - 2 * e**2 - 4 * e * E) / (2 * e**5)
    q12 = (e - 1 + E) ** 2 / (2 * e**4)
    q13 = (1 - E**2 - 2 * e * E) / (2 * e**3)
    q22 = (4 * E - 3 - E**2 + 2 * e) / (2 * e**3)
    q23 = (1 - E) ** 2 / (2 * e**2)
    q33 = (1 - E**2) / (2 * e)
    F_closed = [[one, one, (e - 1 + E) / e**2], [zero, one, (1 - E) / e], [zero, zero, E]]
    Q_closed = [[q11, q12, q13], [q12, q22, q23], [q13, q23, q33]]
    return jnp.where(small, F, _matrix(F_closed)), jnp.where(small, Q, _matrix(Q_closed))


def _matrix(rows):
    return jnp.stack([jnp.stack(row) for row in rows])


def _powers(dt, exponents):
    return _matrix([[dt ** max(int(e), 0) for e in row] for row in exponents])


def _transition(p, u, dt):
    del u
    dt = p.dt if dt is None else dt
    i = np.arange(3)
    F = _unit(dt / p.tau)[0] * _powers(dt, i[None, :] - i[:, None])  # what is below the diagonal is 0
    return jnp.kron(F, jnp.eye(p.variance.shape[0], dtype=F.dtype))


def _process_noise(p, u, dt):
    del u
    dt = p.dt if dt is None else dt
    i = np.arange(3)
    Q = _unit(dt / p.tau)[1] * _powers(dt, 5 - i[None, :] - i[:, None])
    return jnp.kron(Q, jnp.diag(2 * p.variance / p.tau))
