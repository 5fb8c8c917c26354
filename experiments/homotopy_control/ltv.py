"""Example 2: two time-varying states, one of them unstable; the sine expanded about each step's start."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.homotopy_control.boundary import solve_affine
from experiments.homotopy_control.loop import Course, Plan, check_horizon, receding
from experiments.homotopy_control.series import affine_series, evaluate, product

DELTA, STEPS = 0.1, 100
X0, Y_REF = (0.0, 3.0), (1.0, 1.0)
WEIGHTS = {  # diagonals of R, Q, H
    "I": ((0.1, 0.1), (10.0, 2.0), (10.0, 1.0)),
    "II": ((1.0, 1.0), (10.0, 2.0), (10.0, 1.0)),
    "III": ((1.0, 1.0), (20.0, 5.0), (20.0, 2.0)),
}


class Settings(NamedTuple):
    """Weights (2,), the horizon, the number of terms and that of the sine's expansion."""

    r: Array
    q: Array
    h: Array
    T: Any
    terms: jf.Static
    order: jf.Static


def settings(weights: tuple = WEIGHTS["I"], *, T: float = 0.2, terms: int = 3, order: int = 3) -> Settings:
    """Checked settings; the sine is expanded to degree ``order - 1``.

    Raises:
        ValueError: a weight of the wrong sign, or an impossible horizon.
    """
    check_horizon(delta=DELTA, T=T, terms=terms)
    r, q, h = (np.asarray(w, float) for w in weights)
    for name, w in (("R", r), ("Q", q), ("H", h)):
        if w.shape != (2,) or not np.isfinite(w).all() or (w < 0).any() or (name == "R" and (w == 0).any()):
            raise ValueError(f"{name}: expected two {'positive' if name == 'R' else 'nonnegative'} weights, got {w}")
    return Settings(jnp.asarray(r), jnp.asarray(q), jnp.asarray(h), T, jf.Static(terms), jf.Static(order))


def sine(omega: float, t: Array, order: int) -> Array:
    """(order,) Taylor coefficients of sin(omega (t + tau)) in tau."""
    s, c = jnp.sin(omega * t), jnp.cos(omega * t)
    cycle = (s, c, -s, -c)
    return jnp.stack([cycle[k % 4] * omega**k / math.factorial(k) for k in range(order)])


def hamiltonian(p: Settings, t: Array) -> tuple[Array, Array, Array]:
    """M (r, 4, 4), b (r, 4) of z = [x, lambda] in local time, and 2 + sin as a polynomial."""
    order = p.order.value
    size = 2 * order - 1
    one = jnp.zeros(size).at[0].set(1.0)
    pad = lambda c: jnp.pad(c, (0, size - order))  # noqa: E731
    a1 = pad(0.25 * sine(1.0, t, order)) + 0.5 * one
    a2 = -pad(0.25 * sine(2.0, t, order)) - 0.5 * one
    b2 = sine(1.0, t, order).at[0].add(2.0)
    zero = jnp.zeros(size)
    r, q = p.r, p.q
    rows = [
        [a1, zero, -0.125 / r[0] * one, zero],
        [zero, a2, zero, -product(b2, b2) / (2 * r[1])],  # in full, not cut again
        [-2 * (q[0] + q[1]) * one, -2 * q[1] * one, -a1, zero],
        [-2 * q[1] * one, -2 * q[1] * one, zero, -a2],
    ]
    M = jnp.moveaxis(jnp.stack([jnp.stack(row) for row in rows]), -1, 0)
    y1, y2 = Y_REF
    b = jnp.outer(one, jnp.stack([0.0, 0.0, 2 * q[0] * y1 - 2 * q[1] * y2, -2 * q[1] * y2]))
    return M, b, b2


def plan(p: Settings, t: Array, x: Array) -> Plan:
    """One horizon: a linear equation for alpha."""
    M, b, b2 = hamiltonian(p, t)
    y1, y2 = Y_REF

    def series(alpha):
        return affine_series(M, b, jnp.concatenate([x, alpha]), p.terms.value).sum(axis=0)

    def residual(alpha):
        z = evaluate(series(alpha), p.T)
        e1, e2 = z[0] - y1, -z[0] - z[1] - y2
        return z[2:] - jnp.stack([2 * p.h[0] * e1 - 2 * p.h[1] * e2, -2 * p.h[1] * e2])

    alpha = solve_affine(residual, 2)
    z = series(alpha)
    u2 = product(b2[:, None], -z[:, 3:] / (2 * p.r[1]))
    u1 = jnp.pad(-0.25 * z[:, 2:3] / p.r[0], [(0, u2.shape[0] - z.shape[0]), (0, 0)])
    left = jnp.abs(residual(alpha)).max()
    return Plan(z[:, :2], jnp.concatenate([u1, u2], axis=1), alpha, left, jnp.isfinite(alpha).all())


def field(p: Settings, z: Array, t: Any) -> Array:
    """z' of the Hamiltonian system itself, nothing expanded."""
    x, costate = z[:2], z[2:]
    y1, y2 = Y_REF
    b2 = 2 + jnp.sin(t)
    u = -jnp.stack([0.5 * costate[0], b2 * costate[1]]) / (2 * p.r)
    e1, e2 = x[0] - y1, -x[0] - x[1] - y2
    a1, a2 = 0.25 * jnp.sin(t) + 0.5, -0.25 * jnp.sin(2 * t) - 0.5
    down = [-2 * p.q[0] * e1 + 2 * p.q[1] * e2 - a1 * costate[0], 2 * p.q[1] * e2 - a2 * costate[1]]
    return jnp.concatenate([plant(x, u, t), jnp.stack(down)])


def plant(x: Array, u: Array, t: Any) -> Array:
    """The truth."""
    a = jnp.stack([0.25 * jnp.sin(t) + 0.5, -0.25 * jnp.sin(2 * t) - 0.5])
    return a * x + jnp.stack([0.5 * u[0], (2 + jnp.sin(t)) * u[1]])


def output(x: np.ndarray) -> np.ndarray:
    """y (..., 2)."""
    return np.stack([x[..., 0], -x[..., 0] - x[..., 1]], axis=-1)


def course(p: Settings, *, apply="poly", state="plant", steps: int = STEPS) -> Course:
    """10 s towards y = (1, 1)."""
    t = DELTA * jnp.arange(steps).astype(float)
    return receding(Partial(plan, p), Partial(plant), jnp.array(X0), t, DELTA, apply=apply, state=state)
