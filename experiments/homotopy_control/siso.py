"""Example 1: x' = a x + u, y = c x, steps of the reference seen ahead; and the LQG loop around it."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.homotopy_control.boundary import solve_affine
from experiments.homotopy_control.loop import Course, Plan, check_horizon, receding, steps_of
from experiments.homotopy_control.series import affine_series

A, C, Q, R = -0.1, 0.1, 10.0, 0.02  # H = Q
DELTA, X0, STEPS = 0.5, 2.0, 80  # s, start (read off the printed series), steps
TIMES, VALUES = (0.0, 10.0, 20.0, 30.0), (0.0, 0.5, 0.75, 0.25)


class Settings(NamedTuple):
    """The weights; the number of terms and the horizon in steps."""

    q: Any
    r: Any
    h: Any
    terms: jf.Static
    horizon: jf.Static


def settings(*, horizon: int = 2, terms: int = 2, q: float = Q, r: float = R, h: float = Q) -> Settings:
    """Checked settings.

    Raises:
        ValueError: R <= 0, negative Q or H, or an impossible horizon.
    """
    check_horizon(delta=DELTA, T=horizon * DELTA, terms=terms)
    for name, value, strict in (("r", r, True), ("q", q, False), ("h", h, False)):
        if not math.isfinite(value) or value < 0 or (strict and value == 0):
            raise ValueError(f"{name}: expected a {'positive' if strict else 'nonnegative'} weight, got {value}")
    return Settings(q, r, h, jf.Static(terms), jf.Static(horizon))


def hamiltonian(p: Settings) -> tuple[Array, Array]:
    """M (2, 2) and the column by which the reference enters, for z = [x, lambda]."""
    q, r = jnp.asarray(p.q, float), jnp.asarray(p.r, float)
    M = jnp.stack([jnp.stack([A, -1 / (2 * r)]), jnp.stack([-2 * q * C**2, -A])])
    return M, jnp.stack([0.0, 2 * C * q])


def end_of(p: Settings, window: Array, z0: Array) -> Array:
    """z(T): the iterated integrals of the piecewise constant reference are exact.

    Args:
        p: the settings.
        window: (HP + 1,) reference in each step of the horizon and at its end.
        z0: (2,).
    """
    M, d = hamiltonian(p)
    HP = p.horizon.value
    T = HP * DELTA
    left = T - DELTA * np.arange(HP + 1)
    z, power, forced = z0, z0, d
    for m in range(1, p.terms.value):
        power, forced = M @ power, (M @ forced if m > 1 else d)
        weights = (left[:-1] ** m - left[1:] ** m) / math.factorial(m)
        z = z + power * (T**m / math.factorial(m)) + forced * (jnp.asarray(weights) @ window[:-1])
    return z


def plan(p: Settings, window: Array, x: Array) -> Plan:
    """One horizon: a linear equation for alpha."""

    def residual(alpha):
        z = end_of(p, window, jnp.concatenate([x, alpha]))
        return z[1:] - 2 * p.h * C * (C * z[:1] - window[-1])

    alpha = solve_affine(residual, 1)
    M, d = hamiltonian(p)
    z = affine_series(M[None], (d * window[0])[None], jnp.concatenate([x, alpha]), p.terms.value).sum(axis=0)
    left = jnp.abs(residual(alpha)).max()
    return Plan(z[:, :1], -z[:, 1:] / (2 * p.r), alpha, left, jnp.isfinite(alpha).all())


def plant(pole: Any, x: Array, u: Array, t: Any) -> Array:
    """The truth, with a pole of its own."""
    del t
    return pole * x + u


def windows(horizon: int, *, preview: bool = True, steps: int = STEPS) -> np.ndarray:
    """(steps, HP + 1) the reference as each horizon sees it."""
    r = steps_of(TIMES, VALUES, DELTA, steps + horizon)
    ahead = r[np.arange(steps)[:, None] + np.arange(horizon + 1)]
    return ahead if preview else np.broadcast_to(ahead[:, :1], ahead.shape)


def course(p: Settings, *, apply="hold", state="plant", pole: float = A, preview: bool = True) -> Course:
    """40 s of tracking."""
    ahead = jnp.asarray(windows(p.horizon.value, preview=preview))
    return receding(
        Partial(plan, p), Partial(plant, pole), jnp.array([X0]), ahead, DELTA, apply=apply, state=state
    )  # fmt: skip


def discrete_course(horizon: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """The discrete baseline: its output and input, with the input's changes penalised and the reference seen ahead."""
    a, b, q, r = 0.9512, 0.4877, 0.5 * Q, 0.5 * R
    reference = steps_of(TIMES, VALUES, DELTA, STEPS + horizon + 1)
    powers = np.array([a**k for k in range(1, horizon + 1)])
    G = np.array([[b * a ** (i - j) if j <= i else 0.0 for j in range(horizon)] for i in range(horizon)])
    D = np.eye(horizon) - np.eye(horizon, k=-1)
    x, last, xs, us = X0, 0.0, [X0], []
    for k in range(STEPS):
        target = reference[k + 1 : k + 1 + horizon] - C * powers * x
        first = np.zeros(horizon)
        first[0] = last
        u = np.linalg.solve(q * C**2 * G.T @ G + r * D.T @ D, q * C * G.T @ target + r * D.T @ first)
        last = u[0]
        x = a * x + b * last
        xs.append(x)
        us.append(last)
    return C * np.array(xs), np.array(us)


def gain(p: Settings) -> float:
    """k in u = -k x for a reference of 0."""
    window = jnp.zeros(p.horizon.value + 1)
    return -float(_first(p, window, jnp.ones(1)))


@jax.jit
def _first(p, window, x):
    return plan(p, window, x).inputs[0, 0]


def exact_gain(T: float) -> float:
    """The limit of :func:`gain` for many terms, by the matrix exponential from SciPy."""
    import scipy.linalg

    end = scipy.linalg.expm(T * np.array([[A, -1 / (2 * R)], [-2 * Q * C**2, -A]]))
    row = end[1] - 2 * Q * C**2 * end[0]  # [x, lambda] -> what must vanish
    return float(-row[0] / row[1] / (2 * R))


def closed_form(T: float) -> float:
    """alpha / x_0 of two terms and no reference."""
    return (2 * Q * C**2 * T + 2 * Q * C**2 * (1 + A * T)) / (1 - A * T + Q * C**2 * T / R)


# --- the Kalman filter in the loop ------------------------------------------------------------------------------------

W, V = 0.05, 0.01  # standard deviations per step


class Lqg(NamedTuple):
    """The loop at work, (runs, steps)."""

    x: Array
    error: Array  # x less its filtered estimate


def lqg_model() -> jf.models.LinearGaussian:
    """The sampled plant with noise, started in its stationary spread."""
    a = math.exp(A * DELTA)
    b = (1 - a) / -A
    one = np.ones((1, 1))
    return jf.models.linear_gaussian(a * one, C * one, W**2 * one, V**2 * one, np.zeros(1), 0.006 * one, B=b * one)


@jax.jit
def lqg(filt: jf.Filter, model: jf.models.LinearGaussian, k: Array, keys: Array) -> Lqg:
    """u = -k times the estimate after each measurement; 250 steps, one run per key."""

    def one(key):
        noise = jax.random.normal(key, (251, 2))
        x0 = jnp.sqrt(model.P0[:, 0]) * noise[0, :1]
        first = jf.StepInput(jnp.zeros(1), u=jnp.zeros(1))

        def advance(carry, n):
            x, state, u = carry
            x = model.F @ x + model.B @ u + W * n[:1]
            state, info = jf.step(filt, state, jf.StepInput(model.H @ x + V * n[1:], u=u))
            return (x, state, -k * info.mean), (x[0], x[0] - info.mean[0])

        return Lqg(*jax.lax.scan(advance, (x0, filt.init(first), jnp.zeros(1)), noise[1:])[1])

    return jax.vmap(one)(keys)


def lqg_theory(k: float) -> tuple[float, float, float]:
    """Stationary var(x), var(x - estimate) and filter gain, by Riccati and Lyapunov equations from SciPy."""
    import scipy.linalg

    a = math.exp(A * DELTA)
    b = (1 - a) / -A
    one = np.ones((1, 1))
    P = scipy.linalg.solve_discrete_are(a * one, C * one, W**2 * one, V**2 * one)[0, 0]
    gain = P * C / (C**2 * P + V**2)
    # x+ = a x - b k (x - e) + w, and the error e+ = (1 - gain C)(a e + w) - gain v
    F = np.array([[a - b * k, b * k], [0.0, (1 - gain * C) * a]])
    G = np.array([[1.0, 0.0], [1 - gain * C, -gain]])
    cov = scipy.linalg.solve_discrete_lyapunov(F, G @ np.diag([W**2, V**2]) @ G.T)
    return float(cov[0, 0]), float(cov[1, 1]), float(gain)
