"""Sigma-point Kalman filters: unscented and cubature, in covariance and in array form."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxfilt.core import Filter, Prediction, Static, Status, bind, flag, is_concrete
from jaxfilt.filters.extended import init_mean
from jaxfilt.filters.update import array_update, factor_update
from jaxfilt.linalg import chol, mirror, scale_cov, solve_lower, sym, tria
from jaxfilt.models.linear import LinearGaussian, check_finite, check_positive, check_shape, common_dtype
from jaxfilt.models.nonlinear import Nonlinear, as_nonlinear, covariance


class UnscentedState(NamedTuple):
    """Posterior moments, and the status of the prediction before them."""

    mean: Array  # (n,)
    cov: Array  # (n, n)
    status: Array  # () int32


class SqrtUnscentedState(NamedTuple):
    """Posterior mean and lower Cholesky factor of its covariance, and the status of the prediction before them."""

    mean: Array  # (n,)
    chol: Array  # (n, n)
    status: Array  # () int32


class _Params(NamedTuple):
    model: Nonlinear
    alpha: Any
    beta: Any
    kappa: Any
    downdates: Static  # whether the points' weights may make a covariance indefinite


class _Spread(NamedTuple):
    """What a function makes of a Gaussian: its mean, and its covariance as ``D D' + B B' - v v'``."""

    mean: Array  # (k,)
    D: Array  # (k, n), odd in the state's deviation, and linear in its factor L: the cross-covariance is L D'
    B: Array  # (k, n), even: 0 for a linear function
    v: Array  # (k,), 0 unless alpha^2 kappa + beta n < 0
    status: Array  # () int32


def unscented(model: Nonlinear | LinearGaussian, *, alpha: Any = 1.0, beta: Any = 2.0, kappa: Any = 0.0) -> Filter:
    """The unscented Kalman filter with additive noise, in covariance form.

    2 n + 1 points ``m``, ``m +- sqrt(n + lambda) L_i`` with ``P = L L'``, ``lambda = alpha^2 (n + kappa) - n`` and
    weights ``W_i = 1 / (2 (n + lambda))``, ``W_0^m = lambda / (n + lambda)``, ``W_0^c = W_0^m + 1 - alpha^2 + beta``;
    redrawn around the prediction before the update. Everything is formed on deviations from the central point: no
    digits are lost to large means, and measurements that wrap are averaged by the model's ``residual``. On a linear
    model this is :func:`jaxfilt.kalman`. On a curved one the choice of the root L matters in the fourth order: turning
    the state's axes changes it, and so the estimate a little.

    The covariance of the transformed points is split into the part that is odd in the deviations, ``D D'``, and the
    even rest. In the update the rest counts as measurement noise, in ``info.noise_cov`` too, and Joseph's form makes
    the posterior PSD. A negative central weight does no harm as long as ``alpha^2 kappa + beta n >= 0``, since the rest
    is then PSD whatever the function. Below that a rank-one part is subtracted; where nothing PSD would be left it is
    dropped (the covariance is then too large rather than too small) and BOUND is set.

    Status: MISSED, NONFINITE, SINGULAR as in :func:`jaxfilt.kalman`; BOUND as above, or where traced alpha and kappa
    give ``n + lambda <= 0`` (n is used).

    Args:
        model: from :func:`jaxfilt.models.nonlinear` or a builder; a linear-Gaussian model without S is accepted.
        alpha: spread of the points, > 0. Below 0.1 float32 loses the covariance's digits: a UserWarning says so.
        beta: 2 is best for Gaussians.
        kappa: > -n.

    Raises:
        ValueError: alpha <= 0 or n + kappa <= 0, so that n + lambda <= 0 (if concrete).
        TypeError: parameters of another float dtype than the model's.

    Source: Julier and Uhlmann 1997; Wan and van der Merwe 2000; thesis, eqs. (2-101) to (2-110).
    """
    return bind(_params(model, alpha, beta, kappa), _init, _predict, _update, _moments, _with_moments)


def sqrt_unscented(model: Nonlinear | LinearGaussian, *, alpha: Any = 1.0, beta: Any = 2.0, kappa: Any = 0.0) -> Filter:
    """The unscented Kalman filter in array form: PSD by construction. Otherwise as :func:`unscented`.

    Source: van der Merwe and Wan 2001.
    """
    p = _params(model, alpha, beta, kappa)
    return bind(p, _sqrt_init, _sqrt_predict, _sqrt_update, _sqrt_moments, _sqrt_with_moments)


def cubature(model: Nonlinear | LinearGaussian) -> Filter:
    """The cubature Kalman filter: 2 n equally weighted points. It is :func:`unscented` with (1, 0, 0).

    Source: Arasaratnam and Haykin 2009.
    """
    return unscented(model, alpha=1.0, beta=0.0, kappa=0.0)


def sqrt_cubature(model: Nonlinear | LinearGaussian) -> Filter:
    """The cubature Kalman filter in array form: PSD by construction. Otherwise as :func:`cubature`.

    Source: Arasaratnam and Haykin 2009, appendix B.
    """
    return sqrt_unscented(model, alpha=1.0, beta=0.0, kappa=0.0)


def _params(model, alpha, beta, kappa):
    model = as_nonlinear(model)
    n = model.m0.shape[0]
    common_dtype({"alpha": alpha, "beta": beta, "kappa": kappa, "m0": model.m0})
    downdates = True
    for name, x in (("alpha", alpha), ("beta", beta), ("kappa", kappa)):
        check_shape(name, x, ())
    check_positive("alpha", alpha)
    check_finite("beta", beta)
    check_finite("kappa", kappa)
    if is_concrete((alpha, beta, kappa)):
        if not n + kappa > 0:
            raise ValueError(f"kappa: expected n + kappa > 0 with n = {n}, got {kappa}")
        if alpha < 0.1 and model.m0.dtype == jnp.float32:
            warnings.warn(f"alpha: with {alpha} < 0.1 a covariance loses its digits in float32", stacklevel=3)
        downdates = bool(alpha**2 * kappa + beta * n < 0)
    return _Params(model, alpha, beta, kappa, Static(downdates))


def _spread(p, fn, mean, L, inp, residual=None):
    """What ``fn`` makes of N(mean, L L')."""
    n, dtype = mean.shape[0], mean.dtype
    zero, one = jnp.zeros((), dtype), jnp.ones((), dtype)
    alpha, beta, kappa = (jnp.asarray(x, dtype) for x in (p.alpha, p.beta, p.kappa))
    c = alpha**2 * (n + kappa)  # n + lambda
    valid = c > 0
    c = jnp.where(valid, c, n * one)
    # Deviations g from the central point, g+- = even +- odd. With W = 1 / (2 c) and the mean of the 2 n + 1 points at
    # s = sum(even) / c, the covariance is odd' odd / c + (even - s)' (even - s) / c + W_0 s s', and the last two are
    # (even - e)' (even - e) / c + rho n / c e e', where e is the plain average and rho = 1 + (beta - alpha^2) n / c.
    root = jnp.sqrt(c)
    center = fn(mean, inp.u, inp.dt)
    points = jnp.concatenate([mean[None, :] + root * L.T, mean[None, :] - root * L.T])
    g = jax.vmap(lambda x: fn(x, inp.u, inp.dt))(points)
    g = g - center[None, :] if residual is None else jax.vmap(residual, (0, None))(g, center)
    even, odd = 0.5 * (g[:n] + g[n:]), 0.5 * (g[:n] - g[n:])
    e = jnp.mean(even, axis=0)
    rho = (alpha**2 * kappa + beta * n) / c
    grown, lost = (jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, one)), zero) for x in (rho, -rho))
    B = (even - (e - grown * e)[None, :]).T / root
    status = flag(~valid, Status.BOUND)
    if not p.downdates.value:  # a parameter replaced after the filter was built
        status = status | flag(rho < 0, Status.BOUND)
    return _Spread(center + n / c * e, odd.T / root, B, jnp.sqrt(n / c) * lost * e, status)


def _whitened(L, v):
    """``(x, status)`` with ``v = L x`` if ``L L' - v v'`` is PSD; else x = 0, and BOUND is set."""
    x = solve_lower(L, v)
    off = v - L @ x  # not 0 where L is singular and v outside its range
    variance = jnp.sum(L * L, axis=1)
    tolerance = 10 * L.shape[0] * float(jnp.finfo(L.dtype).eps)
    ok = (jnp.sum(x * x) <= 1) & (off * off <= tolerance**2 * variance).all()
    return jnp.where(ok, x, jnp.zeros((), x.dtype)), flag(~ok, Status.BOUND)


def _total(p, out, P):
    """``(P + B B' - v v', status)``, with v dropped where that is not PSD."""
    P = sym(P) + mirror(out.B @ out.B.T)
    if not p.downdates.value:
        return P, out.status
    L = chol(P)
    x, status = _whitened(L, out.v)
    v = L @ x
    return mirror(P - v[:, None] * v[None, :]), out.status | status


def _transition(p, state, inp, L):
    Q = scale_cov(covariance(p.model.Q, state.mean, inp.u, inp.dt), inp.q_scale)
    return _spread(p, p.model.f, state.mean, L, inp), Q


def _measurement(p, state, inp, L):
    """The spread of h, and R with what curvature adds."""
    R = scale_cov(covariance(p.model.R, state.mean, inp.u, inp.dt), inp.r_scale)
    out = _spread(p, p.model.h, state.mean, L, inp, p.model.residual)
    R, status = _total(p, out, R)
    return out, R, state.status | status


def _init(p, inp):
    return UnscentedState(init_mean(p.model, inp), p.model.P0, jnp.int32(0))


def _predict(p, state, inp):
    L = chol(state.cov)
    out, Q = _transition(p, state, inp, L)
    cov, status = _total(p, out, out.D @ out.D.T + Q)
    return UnscentedState(out.mean, cov, status), Prediction(out.mean, cov, L @ out.D.T)


def _update(p, state, inp):
    L = chol(state.cov)
    out, R, status = _measurement(p, state, inp, L)
    info, cov = factor_update(inp, state.mean, L, out.mean, out.D, R, p.model.residual)
    return UnscentedState(info.mean, cov, status), info._replace(status=info.status | status)


def _moments(p, state):
    return state.mean, state.cov


def _with_moments(p, state, mean, cov):
    return state._replace(mean=mean, cov=cov)


def _sqrt_init(p, inp):
    return SqrtUnscentedState(init_mean(p.model, inp), chol(p.model.P0), jnp.int32(0))


def _sqrt_predict(p, state, inp):
    out, Q = _transition(p, state, inp, state.chol)
    L, status = tria(jnp.concatenate([out.D, chol(Q), out.B], axis=1)), out.status
    if p.downdates.value:
        x, lost = _whitened(L, out.v)
        L, status = L @ chol(jnp.eye(x.shape[0], dtype=x.dtype) - x[:, None] * x[None, :]), status | lost
    return SqrtUnscentedState(out.mean, L, status), Prediction(out.mean, sym(L @ L.T), state.chol @ out.D.T)


def _sqrt_update(p, state, inp):
    out, R, status = _measurement(p, state, inp, state.chol)
    info, L = array_update(inp, state.mean, state.chol, out.mean, out.D, R, residual=p.model.residual)
    return SqrtUnscentedState(info.mean, L, status), info._replace(status=info.status | status)


def _sqrt_moments(p, state):
    return state.mean, sym(state.chol @ state.chol.T)


def _sqrt_with_moments(p, state, mean, cov):
    return state._replace(mean=mean, chol=chol(cov))
