"""The mixed Kalman/H-infinity filter, which is the H-infinity filter under another name of its parameter."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import (
    Filter,
    Info,
    Prediction,
    Static,
    Status,
    bind,
    check_count,
    check_flag,
    flag,
    is_concrete,
    numbers,
)
from jaxfilt.filters.kalman import init_mean, measurement, propagate
from jaxfilt.filters.kalman import input_term as _input
from jaxfilt.filters.update import array_update, joseph_update
from jaxfilt.linalg import chol, scale_cov, scale_factor, solve_chol, solve_lower, sym, tria
from jaxfilt.models.linear import (
    LinearGaussian,
    check_covariance,
    check_finite,
    check_linear,
    check_positive,
    check_shape,
    common_dtype,
    value,
)

_CAP = 0.99  # of the bound, where theta had to be lowered to stay below it
_DOUBLINGS = 16


class HinfState(NamedTuple):
    """Estimate, and covariance or lower factor (square-root form), after inflation and update."""

    mean: Array  # (n,)
    cov: Array  # (n, n)


class _Options(NamedTuple):
    output: str
    infeasible: str
    square_root: bool


class _Params(NamedTuple):
    model: LinearGaussian
    theta2: Any  # () theta^2
    weight: Array  # (n, n)
    fixed: Array | None  # (n, n) solution of the Riccati equation; None = recursive
    options: Static


def mixed_hinf(
    model: LinearGaussian,
    theta: Any,
    *,
    weight: Any = None,
    stationary: bool = False,
    output: str = "corrected",
    on_infeasible: str = "cap",
) -> Filter:
    """The mixed Kalman/H-infinity filter: least mean square error among filters with a bounded worst-case gain.

    For all initial errors and noise sequences, Gaussian or not, the sum of squared errors ``|x - x^|^2_S`` of the
    one-step predictor stays below ``1 / theta^2`` times ``|x_0 - m0|^2_{P0^-1} + sum |w|^2_{Q^-1} + |v|^2_{R^-1}``,
    as long as the filter is feasible: ``I - theta^2 S P`` positive at every step. It is a Kalman filter whose
    covariance is inflated before each update, ``P~ = (P^-1 - theta^2 S)^-1``: the larger theta, the more the newest
    measurement counts. ``theta = 0`` is the Kalman filter. What it buys in the worst case it pays on average: with the
    right Q and R no filter has a smaller mean square error than the Kalman filter.

    Estimates: ``"corrected"``, the inflated update (F times it is the next prediction); ``"posterior"``, the update
    with P itself (Hassibi, Sayed and Kailath's a-posteriori filter), which exists for somewhat larger theta and whose
    covariance is the Kalman update of P; ``"pred"``, the prediction x_{k|k-1} and its P, to which the guarantee refers.

    Covariances are bounds, not moments, for theta > 0. ``innovation_cov``, ``nis`` and ``log_lik`` are those of a
    Gaussian with covariance H P~ H' + R: a pseudo-likelihood, good for an IMM, and for tuning at theta = 0 only. No
    cross-covariance is reported. ``extra["margin"]`` () is 1 - theta^2 times the largest eigenvalue of S P: positive
    where feasible. A missed sample is a step with theta = 0, since inflation without measurements knows no limit.

    Status: BOUND where the filter is infeasible, and theta was lowered for the step (the guarantee is gone); MISSED,
    NONFINITE, SINGULAR as in :func:`jaxfilt.kalman`.

    Args:
        model: a linear-Gaussian model without S (correlated noise).
        theta: bound [1/unit of the error], >= 0; see :func:`theta_max`. Tunable by gradient, which grows without bound
            as theta approaches its largest value.
        weight: (n, n) S, which errors count; None = all states alike, in their own units.
        stationary: uses the solution of the Riccati equation in place of the recursion from P0, solved anew in each
            step that has a ``q_scale`` or ``r_scale``. F, H, Q and R must be matrices. In gaps P grows as usual.
        output: ``"corrected"``, ``"posterior"`` or ``"pred"``.
        on_infeasible: ``"cap"`` lowers theta for the step to 0.99 of what is feasible; ``"nan"`` makes it NaN.

    Raises:
        ValueError: a negative or infinite theta, one beyond the bound (concrete values; the message names it), wrong
            shapes, an indefinite weight, a singular R, a model with S, matrices that are functions with ``stationary``.

    Source: Simon 2006, sections 11.3 and 12.1; Bernstein and Haddad 1989.
    """
    check_theta("theta", theta)
    return _make(model, theta * theta, weight, stationary, output, on_infeasible, False)


def sqrt_mixed_hinf(
    model: LinearGaussian,
    theta: Any,
    *,
    weight: Any = None,
    output: str = "corrected",
    on_infeasible: str = "cap",
) -> Filter:
    """:func:`mixed_hinf` in square-root form: ``L~ = L chol(I - theta^2 L' S L)^-T``, then the usual array step."""
    check_theta("theta", theta)
    return _make(model, theta * theta, weight, False, output, on_infeasible, True)


def hinf(
    model: LinearGaussian,
    theta: Any,
    *,
    weight: Any = None,
    stationary: bool = False,
    output: str = "corrected",
    on_infeasible: str = "cap",
) -> Filter:
    """The H-infinity filter: :func:`mixed_hinf` with ``theta`` in place of its square.

    ``P' = F P (I - theta S P + H' R^-1 H P)^-1 F' + Q``; the worst-case gain stays below ``1 / theta``. Q, R and P0 are
    design weights here. Arguments, status and errors as :func:`mixed_hinf`.

    Source: Simon 2006, section 11.3.
    """
    check_theta("theta", theta)
    return _make(model, theta, weight, stationary, output, on_infeasible, False)


def theta_max(model: LinearGaussian, *, weight: Any = None, steps: int | None = None) -> float:
    """The largest theta of :func:`mixed_hinf` that is feasible, by bisection on the host in float64.

    Args:
        model: with matrices F, H, Q, R.
        weight: as in :func:`mixed_hinf`.
        steps: of the recursion from P0; None = of the stationary filter, which also must be stable.

    Raises:
        ValueError: matrices that are functions or traced, a singular R.
    """
    F, H, Q, R, P0 = (np.asarray(x, np.float64) for x in _matrices(model))
    S = np.asarray(_weight(weight, len(F), model.F.dtype), np.float64)
    if steps is not None:
        check_count("steps", steps, 1)
    G = H.T @ np.linalg.solve(R, H)
    root = _root(S)

    def feasible(theta):
        if steps is None:
            # The recursion from 0 grows all the way. Beyond the bound doubling may still end in a covariance, but not
            # through covariances that grow and can be inflated.
            x = _start(F, G - theta**2 * S, Q)
            P = x[2]
            for _ in range(40):
                if not theta**2 * _largest(root, P) < 1:
                    return False
                x = _double(np, x)
                before, P = P, x[2]
                if not np.isfinite(P).all() or np.linalg.eigvalsh(P - before)[0] < -1e-9 * np.abs(P).max():
                    return False
            if not theta**2 * _largest(root, P) < 1:
                return False
            inflated = P @ np.linalg.inv(np.eye(len(P)) - theta**2 * S @ P)
            gain = F @ inflated @ H.T @ np.linalg.inv(R + H @ inflated @ H.T)
            stable = np.abs(np.linalg.eigvals(F - gain @ H)).max() < 1
            return bool(stable)
        P = P0
        for _ in range(steps):
            if not theta**2 * _largest(root, P) < 1:
                return False
            P = F @ P @ np.linalg.inv(np.eye(len(P)) - theta**2 * S @ P + G @ P) @ F.T + Q
            P = 0.5 * (P + P.T)
        return True

    high = 1.0
    while feasible(high):
        high *= 2.0
        if high > 1e30:
            return float("inf")
    low = 0.0
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if feasible(middle) else (low, middle)
        if high - low <= 1e-14 * high:
            break
    return low


def riccati(model: LinearGaussian, theta: Any = 0.0, *, weight: Any = None, doublings: int = _DOUBLINGS) -> Array:
    """The stationary P (n, n) of :func:`mixed_hinf` by the structure-preserving doubling algorithm; differentiable.

    ``P = F (P^-1 - theta^2 S + H' R^-1 H)^-1 F' + Q``. Each doubling stands for as many steps as all before it. Beyond
    the largest feasible theta the result is no solution: check it, or ask :func:`theta_max`.

    Source: Chu, Fan, Lin and Wang 2004.
    """
    F, H, Q, R, _ = _matrices(model)
    check_theta("theta", theta)
    check_shape("theta", theta, ())
    common_dtype({"theta": theta, "m0": model.m0})
    check_count("doublings", doublings, 0)
    S = _weight(weight, F.shape[0], F.dtype)
    return _solve(F, H, Q, R, theta * theta, S, doublings)


def check_theta(name: str, theta: Any) -> None:
    """Raises a ValueError that names ``theta`` if it is concrete and negative or not finite."""
    check_positive(name, theta, zero=True, scalar=True)


def _make(model, theta2, weight, stationary, output, infeasible, square_root):
    if output not in ("corrected", "posterior", "pred"):
        raise ValueError(f'output: expected "corrected", "posterior" or "pred", got {output!r}')
    if infeasible not in ("cap", "nan"):
        raise ValueError(f'on_infeasible: expected "cap" or "nan", got {infeasible!r}')
    check_flag("stationary", stationary)
    check_linear(model)
    if model.S is not None:
        raise ValueError("model: noise correlated between process and measurement (S) is not covered")
    n, dtype = model.m0.shape[0], model.m0.dtype
    weight = _weight(weight, n, dtype)
    fixed = None
    if stationary:
        F, H, Q, R, _ = _matrices(model)
        fixed = _solve(F, H, Q, R, theta2, weight, _DOUBLINGS)
    _check_bound(model, theta2, weight, stationary)
    cov = chol(model.P0) if square_root else model.P0
    return bind(
        _Params(model._replace(P0=cov), theta2, weight, fixed, Static(_Options(output, infeasible, square_root))),
        _init, _predict, _update, _moments, _with_moments,
    )  # fmt: skip


def _check_bound(model, theta2, weight, stationary):
    if not is_concrete((model, theta2, weight)) or np.ndim(theta2) != 0:
        return
    theta = float(np.sqrt(theta2))
    if stationary:
        largest = theta_max(model, weight=weight) if theta > 0 else np.inf
        where = "the stationary filter"
    else:
        size = _largest(_root(np.asarray(weight, np.float64)), np.asarray(model.P0, np.float64))
        largest = 1 / np.sqrt(size) if size > 0 else np.inf
        where = "P0"
    if not theta < largest:
        raise ValueError(f"theta: expected a value (as mixed_hinf has it) below {largest:.9g} for {where}, got {theta}")


def _matrices(model):
    check_linear(model)
    for name in ("F", "H", "Q", "R"):
        if callable(getattr(model, name)):
            raise ValueError(f"model: {name} must be a matrix for a stationary filter")
    check_finite("R", model.R)
    if is_concrete(model.R) and np.linalg.eigvalsh(np.asarray(model.R, np.float64))[0] <= 0:
        raise ValueError("R: expected a positive definite matrix for the Riccati equation")
    return model.F, model.H, model.Q, model.R, model.P0


def _weight(weight, n, dtype):
    if weight is None:
        return jnp.eye(n, dtype=dtype)
    if is_concrete(weight):
        numbers("weight", weight)
    weight = jnp.asarray(weight, dtype)
    check_shape("weight", weight, (n, n))
    check_covariance("weight", weight)
    return weight


def _root(S):
    values, vectors = np.linalg.eigh(S)
    return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T


def _largest(root, P):
    return float(np.linalg.eigvalsh(root @ P @ root.T)[-1])


def _solve(F, H, Q, R, theta2, S, doublings):
    G = H.T @ solve_chol(chol(R), H) - theta2 * S
    return jax.lax.fori_loop(0, doublings, lambda _, x: _double(jnp, x), _start(F, G, Q))[2]


def _start(F, G, Q):
    """What :func:`_double` is begun with, for ``P = F P (I + G P)^-1 F' + Q``; P stands for one step from 0."""
    return F.T, 0.5 * (G + G.T), Q


def _double(xp, x):
    """Twice as many steps."""
    A, G, P = x
    n = A.shape[0]
    solved = xp.linalg.solve(xp.eye(n, dtype=A.dtype) + G @ P, xp.concatenate([A, G], axis=1))
    WA, WG = solved[:, :n], solved[:, n:]
    G, P = G + A @ WG @ A.T, P + A.T @ P @ WA
    return A @ WA, 0.5 * (G + G.T), 0.5 * (P + P.T)


class _Inflation(NamedTuple):
    cov: Array  # (n, n) P~ or its lower factor
    margin: Array  # ()
    feasible: Array  # () bool


def _inflate(p, cov, missed):
    """P~ of P, or L~ of L: ``L (I - theta^2 L' S L)^-1 L'``, no inverse of P needed."""
    options = p.options.value
    L = cov if options.square_root else chol(cov)
    weighed = sym(L.T @ p.weight @ L)
    size = jnp.linalg.eigvalsh(weighed)[-1]
    theta2 = jnp.asarray(p.theta2, L.dtype)
    margin = 1 - theta2 * size
    n = L.shape[0]
    feasible = margin > 8 * n * float(jnp.finfo(L.dtype).eps)
    used = jnp.where(feasible, theta2, _CAP / jnp.where(feasible, jnp.ones_like(size), size))
    used = used if missed is None else jnp.where(missed, jnp.zeros_like(used), used)
    C = chol(jnp.eye(n, dtype=L.dtype) - used * weighed)
    inflated = solve_lower(C, L.T).T
    if options.infeasible == "nan":
        inflated = jnp.where(feasible if missed is None else feasible | missed, inflated, jnp.asarray(np.nan, L.dtype))
    if options.square_root:
        return _Inflation(tria(inflated), margin, feasible)
    return _Inflation(sym(inflated @ inflated.T), margin, feasible)


def _init(p, inp):
    if p.fixed is not None and inp.dt is not None:
        raise ValueError("dt: given, but the stationary filter has one fixed interval")
    return HinfState(init_mean(p.model, inp), p.model.P0)


def _predict(p, state, inp):
    F = value(p.model.F, inp.u, inp.dt)
    Q = value(p.model.Q, inp.u, inp.dt)
    mean = propagate(F, state.mean, _input(p.model.B, inp), None)
    if p.options.value.square_root:
        L = tria(jnp.concatenate([F @ state.cov, scale_factor(chol(Q), inp.q_scale)], axis=1))
        return HinfState(mean, L), Prediction(mean, sym(L @ L.T))
    cov = sym(F @ state.cov @ F.T + scale_cov(Q, inp.q_scale))
    return HinfState(mean, cov), Prediction(mean, cov)


def _update(p, state, inp):
    options = p.options.value
    H, R, predicted = measurement(p.model, inp, state.mean)
    missed = None if inp.mask is None else ~inp.mask.any()
    cov, solvable = _prior(p, state.cov, inp, H, R, missed)
    if options.output == "posterior":
        info, updated = _correct(options, inp, state.mean, cov, predicted, H, R)
        inflation = _inflate(p, updated, missed)
        state = HinfState(info.mean, inflation.cov)
    else:
        inflation = _inflate(p, cov, missed)
        info, updated = _correct(options, inp, state.mean, inflation.cov, predicted, H, R)
        before, state = state.mean, HinfState(info.mean, updated)
        if options.output == "pred":
            info = info._replace(mean=before, cov=sym(cov @ cov.T) if options.square_root else cov)
    infeasible = ~inflation.feasible if missed is None else ~inflation.feasible & ~missed
    infeasible = infeasible if solvable is None else infeasible | ~solvable
    status = info.status | flag(infeasible, Status.BOUND)
    return state, info._replace(status=status, extra={"margin": inflation.margin})


def _prior(p, cov, inp, H, R, missed):
    """P before the update: the stationary one if asked for, solvable and measured; else that of the recursion."""
    if p.fixed is None:
        return cov, None
    fixed = p.fixed
    if inp.q_scale is not None or inp.r_scale is not None:
        fixed = _solve(p.model.F, H, scale_cov(p.model.Q, inp.q_scale), R, p.theta2, p.weight, _DOUBLINGS)
    solvable = jnp.isfinite(fixed).all()
    safe = jnp.where(solvable, fixed, cov)
    # Beyond the bound doubling returns a matrix that is no covariance, or one that cannot be inflated.
    smallest = jnp.linalg.eigvalsh(safe)[0]
    L = chol(safe)
    size = jnp.linalg.eigvalsh(sym(L.T @ p.weight @ L))[-1]
    solvable = solvable & (smallest > -1e-6 * jnp.trace(safe)) & (p.theta2 * size < 1)
    used = solvable if missed is None else solvable & ~missed
    return jnp.where(used, safe, cov), solvable


def _correct(options, inp, mean, cov, predicted, H, R) -> tuple[Info, Array]:
    if options.square_root:
        return array_update(inp, mean, cov, predicted, H @ cov, R)
    return joseph_update(inp, mean, cov, predicted, H, R)


def _moments(p, state):
    if p.options.value.square_root:
        return state.mean, sym(state.cov @ state.cov.T)
    return state.mean, state.cov


def _with_moments(p, state, mean, cov):
    del state
    return HinfState(mean, chol(cov) if p.options.value.square_root else cov)
