"""The angle of a sine/cosine sensor as a state-space model, on request with the sensor's imperfections as states."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array
from jax.tree_util import Partial

from jaxfilt.core import is_concrete
from jaxfilt.linalg.structure import array
from jaxfilt.models.linear import check_positive, check_shape, common_dtype, measurement_covariance
from jaxfilt.models.nonlinear import Nonlinear, nonlinear
from jaxfilt.sincos import Parameters, check_parameters, signals


class _Motion(NamedTuple):
    dt: Any  # ()
    q: Array  # ()
    drift: Array  # (6,) or (0,)


def sine_cosine(
    *, dt: Any, q: Any, r: Any, m0: Any, P0: Any, parameters: Parameters | None = None, drift: Any = None
) -> Nonlinear:
    """An angle that turns at a nearly constant rate, seen by a sine/cosine sensor: the two signals are measured.

    The state is ``[theta, omega]`` with the sensor's parameters given, or with 8 states ``[theta, omega, offset_a,
    offset_b, amplitude, gain, quadrature, h3]``: then a filter calibrates the sensor while it turns. The angle is not
    wrapped in the state. About a cycle of motion is needed; a constant angle cannot be told from a wrong mounting, and
    harmonics that are not modelled alias into those that are. ``jaxfilt.sincos.calibrated`` says when to trust it.

    With 2 states and an ideal sensor of amplitude A the extended Kalman filter is the tracking loop
    ``phase_locked(alpha_beta(...), amplitude=A, normalize=False)`` with gains that it computes; in steady state they
    are :func:`jaxfilt.gains.kalata` of the tracking index ``sqrt(q) dt^2 A / sqrt(r)``.

    Args:
        dt: interval [s]; per step, ``jf.filter(..., dt=)`` overrides it.
        q: variance of an acceleration constant over each interval [rad^2/s^4]; ``Q = q g g'``, ``g = [dt^2/2, dt]``.
        r: variance of the signals: scalar, (2,) or (2, 2).
        m0: (2,) or (8,) prior mean. Start the angle from the first sample (``jaxfilt.sincos.reacquire``).
        P0: (2, 2) or (8, 8) prior covariance. A parameter with no variance there and no drift stays as it is.
        parameters: of the sensor; with 8 states only its h5 and h2 are used. None = ideal.
        drift: 8 states only: variances per second by which the six parameters wander, scalar or (6,). None = 0.

    The 8 states with slow parameters want float64: a variance of 1e-12 beside one of 1 is lost in float32.

    Raises:
        ValueError: bad shapes, dt <= 0, q < 0, r not positive, drift < 0 or given with 2 states, an indefinite P0.
        TypeError: integer arrays or mixed float dtypes.
    """
    p = Parameters() if parameters is None else parameters
    check_parameters(p)
    given = {"dt": dt, "q": q, "r": r, "m0": m0, "P0": P0, "drift": 0.0 if drift is None else drift}
    dtype = common_dtype({**given, "parameters": tuple(p)})
    check_shape("dt", dt, ())
    check_shape("q", q, ())
    check_positive("dt", dt)
    check_positive("q", q, zero=True)
    m0 = array(m0, dtype)
    if m0.shape not in ((2,), (8,)):
        raise ValueError(f"m0: expected shape (2,) or (8,), got {m0.shape}")
    own = m0.shape == (8,)
    if drift is not None and not own:
        raise ValueError("drift: expected None with 2 states, which have no parameters")
    rate = jnp.zeros((), dtype) if drift is None else array(drift, dtype)
    check_positive("drift", rate, zero=True)
    if rate.shape not in ((), (6,)):
        raise ValueError(f"drift: expected a scalar or shape (6,), got {rate.shape}")
    r = array(r, dtype)
    if r.ndim < 2 or is_concrete(r):
        check_positive("r", r if r.ndim < 2 else jnp.diagonal(r))
    motion = _Motion(dt, array(q, dtype), jnp.broadcast_to(rate, (6 if own else 0,)))
    h = Partial(_own if own else _given, Parameters(*(jnp.asarray(x, dtype) for x in p)))
    return nonlinear(
        Partial(_transition, motion), h, Partial(_noise, motion), measurement_covariance(r, 2), m0, P0,
        f_jacobian=Partial(_transition_jacobian, motion),
    )  # fmt: skip


def _interval(p, x, dt):
    return jnp.asarray(p.dt, x.dtype) if dt is None else dt


def _transition(p, x, u, dt):
    del u
    return x.at[0].add(_interval(p, x, dt) * x[1])


def _transition_jacobian(p, x, u, dt):
    del u
    return jnp.eye(x.shape[0], dtype=x.dtype).at[0, 1].set(_interval(p, x, dt))


def _noise(p, x, u, dt):
    del u
    h = _interval(p, x, dt)
    g = jnp.stack([0.5 * h * h, h])
    Q = jnp.diag(jnp.concatenate([jnp.zeros((2,), x.dtype), h * p.drift]))
    return Q.at[:2, :2].set(p.q * g[:, None] * g[None, :])


def _given(parameters, x, u, dt):
    del u, dt
    return signals(x[0], parameters)


def _own(parameters, x, u, dt):
    del u, dt
    theta, _, offset_a, offset_b, amplitude, gain, quadrature, h3 = x
    p = Parameters(offset_a, offset_b, amplitude, gain, quadrature, h3)
    return signals(theta, p._replace(h5=parameters.h5, h2_a=parameters.h2_a, h2_b=parameters.h2_b))
