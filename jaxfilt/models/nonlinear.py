"""Nonlinear state-space models with additive noise, and sensors that a motion model can be given."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.tree_util import Partial

from jaxfilt import describe
from jaxfilt.core import PyTree, aspartial
from jaxfilt.linalg.structure import array
from jaxfilt.models.linear import (
    LinearGaussian,
    check_covariance,
    check_finite,
    check_linear,
    check_shape,
    common_dtype,
    value,
)

Function = Callable[[Array, PyTree, Array | None], Array]


class Nonlinear(NamedTuple):
    """x_k = f(x_{k-1}, u, dt) + w, y_k = h(x_k, u, dt) + v. Build it with :func:`nonlinear`."""

    f: Function  # (x, u, dt) -> (n,)
    h: Function  # (x, u, dt) -> (m,)
    Q: Array | Function  # (n, n), or (x, u, dt) -> (n, n)
    R: Array | Function  # (m, m), or (x, u, dt) -> (m, m)
    m0: Array  # (n,)
    P0: Array  # (n, n)
    residual: Callable[[Array, Array], Array] | None = None  # (y, predicted) -> (m,), for angles
    f_jacobian: Function | None = None  # (n, n); None = by automatic differentiation
    h_jacobian: Function | None = None  # (m, n)

    def __repr__(self) -> str:
        """Functions with what they hold, matrices by shape."""
        return describe.fields(self)


class Sensor(NamedTuple):
    """A measurement function with its noise and the way its residuals wrap."""

    h: Function
    R: Array | Function  # (m, m); takes the motion model's float dtype where it has none of its own
    residual: Callable[[Array, Array], Array] | None = None

    def __repr__(self) -> str:
        """The functions with what they hold."""
        return describe.fields(self)


def nonlinear(
    f: Function,
    h: Function,
    Q: Any,
    R: Any,
    m0: Any,
    P0: Any,
    *,
    residual: Callable[[Array, Array], Array] | None = None,
    f_jacobian: Function | None = None,
    h_jacobian: Function | None = None,
) -> Nonlinear:
    """A nonlinear model with additive Gaussian noise, checked.

    Args:
        f: ``(x, u, dt) -> (n,)`` state transition over the interval that ends at k.
        h: ``(x, u, dt) -> (m,)`` measurement.
        Q: (n, n) process noise covariance, or a function ``(x, u, dt)`` of the state before the step.
        R: (m, m) measurement noise covariance, or a function ``(x, u, dt)`` of the predicted state.
        m0: (n,) prior mean.
        P0: (n, n) prior covariance.
        residual: ``(y, predicted) -> (m,)`` for measurements that wrap, such as angles. Sigma points are averaged by
            their residuals to the central one, so a scene may be rotated without changing anything.
        f_jacobian: ``(x, u, dt) -> (n, n)``; None = by automatic differentiation.
        h_jacobian: ``(x, u, dt) -> (m, n)``; None = by automatic differentiation.

    Write the functions with ``def`` at module level and bind traced values with ``jax.tree_util.Partial``.

    Raises:
        ValueError: wrong shapes, or (concrete arrays) non-finite values or an asymmetric or indefinite Q, R or P0.
        TypeError: integer arrays or different float dtypes.
    """
    given = {"Q": Q, "R": R, "m0": m0, "P0": P0}
    dtype = common_dtype({name: x for name, x in given.items() if not callable(x)})
    a: dict[str, Any] = {name: aspartial(x) if callable(x) else array(x, dtype) for name, x in given.items()}
    if a["m0"].ndim != 1 or a["m0"].size == 0:
        raise ValueError(f"m0: expected shape (n,) with n >= 1, got {a['m0'].shape}")
    check_finite("m0", a["m0"])
    n = a["m0"].shape[0]
    m = None if callable(R) else jnp.shape(a["R"])[0] if jnp.ndim(a["R"]) else None
    for name, size in (("Q", n), ("R", m), ("P0", n)):
        if not callable(a[name]):
            check_shape(name, a[name], (size, size), f" with m0 of {n} components")
            check_covariance(name, a[name])
    return Nonlinear(
        aspartial(f, "f"), aspartial(h, "h"), **a, residual=_optional("residual", residual),
        f_jacobian=_optional("f_jacobian", f_jacobian), h_jacobian=_optional("h_jacobian", h_jacobian),
    )  # fmt: skip


def with_sensor(motion: LinearGaussian | Nonlinear, sensor: Sensor) -> Nonlinear:
    """A motion model with another sensor: its f, Q and prior are kept, h, R and the residual are the sensor's.

    Args:
        motion: a nonlinear or linear-Gaussian model.
        sensor: from :mod:`jaxfilt.models.sensors`, or a :class:`Sensor` of your own.

    Raises:
        ValueError: an indefinite R, or a motion model whose noise is correlated with its old sensor's (S).
        TypeError: R of another float dtype than the motion model's.
    """
    motion = as_nonlinear(motion, "motion")
    if not isinstance(sensor, Sensor):
        raise TypeError(f"sensor: expected a Sensor, got {type(sensor).__name__}")
    R, residual = sensor.R, _optional("residual", sensor.residual)
    if not callable(R):
        R = array(R, common_dtype({"R": R, "m0": motion.m0}))
        check_shape("R", R, (R.shape[0] if R.ndim else None,) * 2)
        check_covariance("R", R)
    return motion._replace(
        h=aspartial(sensor.h), R=aspartial(R) if callable(R) else R, residual=residual, h_jacobian=None
    )


def as_nonlinear(model: LinearGaussian | Nonlinear, name: str = "model") -> Nonlinear:
    """A linear-Gaussian model in nonlinear form, with its matrices as Jacobians; a nonlinear one as it is.

    Raises:
        ValueError: a model with correlated noise (S), which the nonlinear form does not have.
        TypeError: what is no model; it names the argument.
    """
    if isinstance(model, Nonlinear):
        return model
    check_linear(model, name)
    if model.S is not None:
        raise ValueError(f"{name}: noise correlated between process and measurement (S) has no nonlinear form")
    Q = Partial(_linear_covariance, model.Q) if callable(model.Q) else model.Q
    R = Partial(_linear_covariance, model.R) if callable(model.R) else model.R
    return Nonlinear(
        Partial(_linear_transition, model.F, model.B), Partial(_linear_measurement, model.H, model.D), Q, R,
        model.m0, model.P0,
        f_jacobian=Partial(_linear_jacobian, model.F), h_jacobian=Partial(_linear_jacobian, model.H),
    )  # fmt: skip


def covariance(matrix: Array | Function, x: Array, u: PyTree, dt: Array | None) -> Array:
    """A noise covariance of a nonlinear model at a state."""
    return matrix(x, u, dt) if callable(matrix) else matrix


def jacobian(fn: Function, given: Function | None, x: Array, u: PyTree, dt: Array | None) -> Array:
    """The Jacobian of a model function at x: the given one, or by forward-mode differentiation."""
    return jax.jacfwd(fn)(x, u, dt) if given is None else given(x, u, dt)


def _optional(name, fn):
    return None if fn is None else aspartial(fn, name)


def _linear_transition(F, B, x, u, dt):
    if dt is not None and not callable(F):
        raise ValueError("dt: given, but the model's F is a fixed matrix; make it a function (u, dt)")
    return _affine("B", F, B, x, u, dt)


def _linear_measurement(H, D, x, u, dt):
    return _affine("D", H, D, x, u, dt)


def _affine(name, matrix, shift, x, u, dt):
    out = value(matrix, u, dt) @ x
    if shift is None:
        return out
    if callable(shift):
        return out + shift(u, dt)
    if u is None:
        raise ValueError(f"u: the model has an input matrix {name}, but no input was given")
    return out + shift @ u


def _linear_jacobian(matrix, x, u, dt):
    del x
    return value(matrix, u, dt)


def _linear_covariance(matrix, x, u, dt):
    del x
    return matrix(u, dt)
