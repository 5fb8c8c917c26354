"""Extended Kalman filters: first order, second order, iterated; in covariance and in array form."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxfilt.core import Filter, Info, Prediction, Static, StepInput, bind, check_count, check_flag
from jaxfilt.filters.common import check_dtype, check_measurement
from jaxfilt.filters.update import array_update, joseph_update
from jaxfilt.linalg import chol, mirror, scale_cov, sym, tria
from jaxfilt.models.linear import LinearGaussian
from jaxfilt.models.nonlinear import Nonlinear, as_nonlinear, covariance, jacobian


class ExtendedState(NamedTuple):
    """Posterior moments."""

    mean: Array  # (n,)
    cov: Array  # (n, n)


class SqrtExtendedState(NamedTuple):
    """Posterior mean and lower Cholesky factor of its covariance."""

    mean: Array  # (n,)
    chol: Array  # (n, n)


class _Params(NamedTuple):
    model: Nonlinear
    order: Static
    iterations: Static
    relinearize: Static


def extended(
    model: Nonlinear | LinearGaussian, *, order: int = 1, iterations: int = 1, relinearize: bool = False
) -> Filter:
    """The extended Kalman filter, in covariance form with the Joseph update.

    Predict: ``m- = f(m)``, ``P- = F P F' + Q`` with F the Jacobian of f at m. Update: as :func:`jaxfilt.kalman` with H
    the Jacobian of h at m-. On a linear model it is that filter, whatever the options.

    ``order=2`` adds what curvature does to a Gaussian: ``tr(f_i'' P) / 2`` to the predicted mean and
    ``tr(f_i'' P f_j'' P) / 2`` to its covariance, and for h likewise. The latter counts as measurement noise, in
    ``info.noise_cov`` too, and so Joseph's form holds.

    ``iterations > 1`` linearizes h again at the updated mean (Gauss-Newton steps towards the maximum of the posterior
    density). The covariance is that of the last linearization, applied once, so no measurement counts twice;
    innovation, NIS and likelihood are those of the prediction.

    ``relinearize`` computes the posterior covariance with H at the updated mean, which itself stays as it is: the
    "modified-covariance" filter.

    Status: MISSED, NONFINITE, SINGULAR as in :func:`jaxfilt.kalman`.

    Args:
        model: from :func:`jaxfilt.models.nonlinear` or a builder; a linear-Gaussian model without S is accepted.
        order: 1 or 2. Second derivatives are automatic.
        iterations: linearizations of h per update, >= 1; more than one with order 1 only.
        relinearize: one more linearization, for the covariance; with order 1 only.

    Raises:
        ValueError: another order, iterations < 1, or order 2 with iterations > 1 or relinearize.

    Source: Jazwinski 1970; Bar-Shalom, Li and Kirubarajan 2001, section 10.3; thesis, eqs. (2-81) to (2-89); iterated:
    Bell and Cathey 1993; relinearized: Hashemi and Alfi 2019, eqs. (10) and (11).
    """
    return bind(_params(model, order, iterations, relinearize), _init, _predict, _update, _moments, _with_moments)


def sqrt_extended(model: Nonlinear | LinearGaussian, *, order: int = 1, iterations: int = 1) -> Filter:
    """The extended Kalman filter in array form: PSD by construction. Otherwise as :func:`extended`."""
    p = _params(model, order, iterations, False)
    return bind(p, _sqrt_init, _sqrt_predict, _sqrt_update, _sqrt_moments, _sqrt_with_moments)


def init_mean(model: Nonlinear, inp: StepInput) -> Array:
    """Checks the first input, and what the model functions return, and gives the prior mean."""
    check_dtype(inp, model.m0)
    if inp.dt is not None and not callable(model.Q):
        raise ValueError("dt: given, but the model's Q is a fixed matrix; make it a function (x, u, dt)")
    shapes = {}
    for name in ("f", "h", "Q", "R"):
        x = getattr(model, name)
        shapes[name] = jax.eval_shape(x, model.m0, inp.u, inp.dt).shape if callable(x) else x.shape
    n, m = model.m0.shape[0], shapes["h"][0] if shapes["h"] else None
    for name, expected in {"f": (n,), "h": (m,), "Q": (n, n), "R": (m, m)}.items():
        if shapes[name] != expected:
            raise ValueError(f"{name}: expected shape {expected}, got {shapes[name]}")
    check_measurement(inp, shapes["h"][0], "the model's h gives")
    return model.m0


def _params(model, order, iterations, relinearize):
    if not isinstance(order, int) or order not in (1, 2):
        raise ValueError(f"order: expected 1 or 2, got {order!r}")
    check_count("iterations", iterations, 1)
    check_flag("relinearize", relinearize)
    if order == 2 and iterations > 1:
        raise ValueError(f"iterations: expected 1 with order=2, got {iterations}")
    if order == 2 and relinearize:
        raise ValueError("relinearize: expected False with order=2")
    model = as_nonlinear(model)
    return _Params(model, Static(order), Static(iterations), Static(relinearize))


def _linearize(fn, given, mean, P, inp, order, noise):
    """``(value, J, noise)``: the function's mean, its Jacobian, and the noise with what curvature adds (order 2)."""
    J = jacobian(fn, given, mean, inp.u, inp.dt)
    out = fn(mean, inp.u, inp.dt)
    if order == 1:
        return out, J, noise
    curvature = jax.hessian(fn)(mean, inp.u, inp.dt) @ P  # (k, n, n)
    out = out + 0.5 * jnp.trace(curvature, axis1=1, axis2=2)
    return out, J, sym(noise + 0.5 * jnp.einsum("iab,jba->ij", curvature, curvature))


def _transition(p, inp, mean, P):
    model = p.model
    Q = scale_cov(covariance(model.Q, mean, inp.u, inp.dt), inp.q_scale)
    return _linearize(model.f, model.f_jacobian, mean, P, inp, p.order.value, Q)


def _measurement(p, inp, mean, P):
    model = p.model
    R = scale_cov(covariance(model.R, mean, inp.u, inp.dt), inp.r_scale)
    return _linearize(model.h, model.h_jacobian, mean, P, inp, p.order.value, R)


def _iterate(p, inp: StepInput, mean: Array, predicted: Array, H: Array, update: Callable) -> tuple[Info, Array]:
    """The update with the linearization at the predicted mean, and after it those of the further iterations.

    ``update(inp, predicted, H, residual)`` gives the Info, and the posterior covariance or its factor, from the prior.
    """
    model, count = p.model, p.iterations.value
    info, posterior = update(inp, predicted, H, model.residual)
    if count == 1:
        return info, posterior
    # What is not finite is ignored by taking the prediction in its place, the same one in all iterations.
    inp = inp._replace(y=jnp.where(jnp.isfinite(inp.y), inp.y, predicted))

    def relinearized(eta):
        H = jacobian(model.h, model.h_jacobian, eta, inp.u, inp.dt)
        back = H @ (mean - eta)

        def residual(y, at_eta):
            return (y - at_eta if model.residual is None else model.residual(y, at_eta)) - back

        return update(inp, model.h(eta, inp.u, inp.dt), H, residual)

    eta = info.mean
    if count > 2:
        eta, _ = jax.lax.scan(lambda eta, _: (relinearized(eta)[0].mean, None), eta, length=count - 2)
    last, posterior = relinearized(eta)
    return info._replace(mean=last.mean, cov=last.cov, status=info.status | last.status), posterior


def _init(p, inp):
    return ExtendedState(init_mean(p.model, inp), sym(p.model.P0))


def _predict(p, state, inp):
    mean, F, Q = _transition(p, inp, state.mean, state.cov)
    cross = state.cov @ F.T
    cov = mirror(F @ cross) + sym(Q)
    return ExtendedState(mean, cov), Prediction(mean, cov, cross)


def _update(p, state, inp):
    mean, P = state
    predicted, H, R = _measurement(p, inp, mean, P)

    def update(inp, predicted, H, residual):
        return joseph_update(inp, mean, P, predicted, H, R, residual)

    info, cov = _iterate(p, inp, mean, predicted, H, update)
    if p.relinearize.value:
        H = jacobian(p.model.h, p.model.h_jacobian, info.mean, inp.u, inp.dt)
        _, cov = update(inp, predicted, H, p.model.residual)
        info = info._replace(cov=cov)
    return ExtendedState(info.mean, cov), info


def _moments(p, state):
    return state.mean, state.cov


def _with_moments(p, state, mean, cov):
    return ExtendedState(mean, cov)


def _sqrt_init(p, inp):
    return SqrtExtendedState(init_mean(p.model, inp), chol(p.model.P0))


def _sqrt_predict(p, state, inp):
    L = state.chol
    mean, F, Q = _transition(p, inp, state.mean, L @ L.T)
    FL = F @ L
    L_new = tria(jnp.concatenate([FL, chol(Q)], axis=1))
    return SqrtExtendedState(mean, L_new), Prediction(mean, sym(L_new @ L_new.T), L @ FL.T)


def _sqrt_update(p, state, inp):
    mean, L = state
    predicted, H, R = _measurement(p, inp, mean, L @ L.T)
    L_R = chol(R)

    def update(inp, predicted, H, residual):
        return array_update(inp, mean, L, predicted, H @ L, R, L_R, residual)

    info, L_new = _iterate(p, inp, mean, predicted, H, update)
    return SqrtExtendedState(info.mean, L_new), info


def _sqrt_moments(p, state):
    return state.mean, sym(state.chol @ state.chol.T)


def _sqrt_with_moments(p, state, mean, cov):
    return SqrtExtendedState(mean, chol(cov))
