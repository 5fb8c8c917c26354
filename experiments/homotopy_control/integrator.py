"""Figure 6: the printed controller with the integral of the error as a fifth state, for all readings that we tried."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from experiments.homotopy_control import rig as rigs
from experiments.homotopy_control.boundary import newton
from experiments.homotopy_control.loop import Plan, receding
from experiments.homotopy_control.series import Quadratic, evaluate, quadratic_series

WEIGHTS = ((80.0, 8.0), (800.0, 80.0), (800.0, 800.0), (8000.0, 800.0), (8000.0, 8000.0))  # of the integral, and at T
MODES = (("poly", "model"), ("poly", "plant"), ("hold", "plant"))
DELTA, ANGLE, SECONDS = 0.1, 1.2217, 20.0


class Integrating(NamedTuple):
    """The printed controller, and the integral's weights."""

    base: rigs.Controller
    q: Any
    h: Any


def _linear(p, z):
    # z = [x, integral, lambda, its costate, sin, cos]
    rest = rigs._linear(p.base.rig, p.base.cost, _without(z))
    rest = rest.at[4].add(-z[9])
    return _with(rest, z[0], -2 * p.q * z[4])


def _bilinear(p, a, b):
    rest = rigs._bilinear(p.base.rig, _without(a), _without(b))
    return _with(rest, jnp.zeros_like(a[0]), jnp.zeros_like(a[0]))


def _without(z):
    return jnp.concatenate([z[:4], z[5:9], z[10:]])


def _with(z, integral, costate):
    return jnp.concatenate([z[:4], integral[None], z[4:8], costate[None], z[8:]])


def plan(p: Integrating, angle: Array, x: Array) -> Plan:
    """One horizon for x = [state, integral]; affine in alpha, as without the integral."""
    base, cost = p.base, p.base.cost
    target, _, _ = rigs.aim(base, angle)
    constant = _with(rigs.field(base, angle).constant, -target[0], jnp.zeros_like(angle))
    system = Quadratic(constant, Partial(_linear, p), Partial(_bilinear, p))

    def series(alpha):
        z0 = jnp.concatenate([x, alpha, jnp.sin(x[:1]), jnp.cos(x[:1])])
        return quadratic_series(system, z0, base.degree.value)[:, :10]

    def residual(alpha):
        z = evaluate(series(alpha), base.T)
        return z[5:] - jnp.append(cost.terminal @ (z[:4] - target), 2 * p.h * z[4])

    solved = newton(residual, jnp.zeros(5), 2)
    z = series(solved.value)
    u = -z[:, 8:9] / (2 * cost.r * base.rig.lag**2)
    return Plan(z[:, :5], u, solved.value, solved.residual, jnp.isfinite(solved.value).all())


def _plant(target, x, u, t):
    return jnp.append(rigs.plant(rigs.Rig(), x[:4], u, t), x[0] - target)


def final_errors(seconds: float = SECONDS) -> dict[tuple[str, str, str], np.ndarray]:
    """By rows, apply and state: for each weight the mean and half the range of the error over the last 5 s [deg]."""
    weights = jnp.asarray(WEIGHTS)
    angles = jnp.full(round(seconds / DELTA), ANGLE)
    start = jnp.append(jnp.asarray(rigs.START), 0.0)
    found = {}
    for apply, state in MODES:
        for rows in ("interchanged", "right"):
            base = rigs.printed(T=2 * DELTA, delta=DELTA, rows=rows)
            x = _courses(base, weights, start, angles, apply, state)
            late = np.rad2deg(np.asarray(x[:, -round(5 / DELTA) :, 0]) - ANGLE)
            with np.errstate(over="ignore", invalid="ignore"):
                found[rows, apply, state] = np.stack([late.mean(axis=1), 0.5 * np.ptp(late, axis=1)], axis=1)
    return found


def _courses(base, weights, start, angles, apply, state):
    def one(weight):
        p = Integrating(base, weight[0], weight[1])
        return receding(
            Partial(plan, p), Partial(_plant, jnp.asarray(ANGLE)), start, angles, DELTA, apply=apply, state=state
        ).x  # fmt: skip

    return jax.vmap(one)(weights)


def removed(found: dict, limit: float = 1.0) -> int:
    """How many settings end within ``limit`` degrees, in mean and in oscillation."""
    return int(sum((np.abs(value) < limit).all(axis=1).sum() for value in found.values()))
