"""The rig under an extended Kalman filter: measured angle, filter, controller, plant; with or without a torque bias."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.homotopy_control.loop import rk4
from experiments.homotopy_control.rig import NOMINAL, START, Controller, Held, Rig, control, derivative, equilibrium

DELTA = 0.05  # s
STEPS = 160
SENSOR = np.deg2rad(0.1)  # standard deviation of the measured angle [rad]
Q = (1e-8, 4e-4, 1e-6, 1e-4)  # process noise per second
Q_TORQUE = 1e-5  # (N m)^2 / s
P0, P0_TORQUE = (1e-3, 1e-2, 1e-3, 1e-3), 1e-4
OFFSET = (0.02, 0.0, 0.02, 0.0)  # of the first estimate


class Run(NamedTuple):
    """One closed loop, (runs, steps) in front."""

    x: Array  # (steps, 4) truth at the sample
    u: Array  # (steps,)
    estimate: Array  # (steps, 5)
    residual: Array  # (steps,)
    ok: Array  # (steps,) bool


def transition(rig: Rig, x: Array, u: Array, dt: Any) -> Array:
    """The rig over one step with its input held; the fifth state is the constant torque."""
    del dt
    moved = rk4(lambda y, u, _: derivative(rig, y, u, x[4]), x[:4], lambda _: u[0], 0.0, DELTA, 5)
    return jnp.concatenate([moved, x[4:]])


def angle_of(x: Array, u: Any, dt: Any) -> Array:
    """What is measured."""
    del u, dt
    return x[:1]


def model(
    x0: Any = START, *, torque: bool = False, rig: Rig = NOMINAL, q: Any = 1.0, q_torque: Any = 1.0
) -> jf.models.Nonlinear:
    """The filter's model for a start near x0; ``q`` and ``q_torque`` scale its process noise.

    Without ``torque`` the fifth state is known to be 0, which leaves the filter of the other four as it is.
    """
    scales = jnp.stack([jnp.asarray(q, float)] * 4 + [jnp.asarray(q_torque if torque else 0.0, float)])
    noise = DELTA * jnp.asarray([*Q, Q_TORQUE]) * scales
    spread = np.array([*P0, P0_TORQUE if torque else 0.0])
    mean = jnp.append(jnp.asarray(x0, float) + jnp.asarray(OFFSET), 0.0)
    measured = SENSOR**2 * np.eye(1)
    return jf.models.nonlinear(Partial(transition, rig), angle_of, jnp.diag(noise), measured, mean, np.diag(spread))


@partial(jax.jit, static_argnames="steps")
def simulate(
    p: Controller,
    filt: jf.Filter,
    truth: Rig,
    angle: Any,
    x0: Array,
    keys: Array,
    mask: Array | None = None,
    *,
    steps: int = STEPS,
) -> Run:
    """Closed loops, one per key: measure, filter, solve, hold.

    Args:
        p: the controller.
        filt: over :func:`model`.
        truth: the plant, which has no noise.
        angle: set-point [rad].
        x0: (4,) true start.
        keys: (runs,).
        mask: (steps,) bool, False where the sample is missing; None = all present.
        steps: of 0.05 s.
    """  # fmt: skip
    _, rest, _ = equilibrium(p.rig, angle)

    def one(key):
        noise = SENSOR * jax.random.normal(key, (steps, 1))
        seen = None if mask is None else jnp.broadcast_to(mask[:, None], (steps, 1))

        def advance(carry, sample):
            x, state, last = carry
            v, present = sample
            state, info = filt.update(state, jf.StepInput(x[:1] + v, present, u=last.u[None]))
            held = control(p, angle, info.mean[:4], info.mean[4], last)
            state, _ = filt.predict(state, jf.StepInput(v, u=held.u[None]))
            moved = rk4(lambda x, u, _: derivative(truth, x, u), x, lambda _: held.u, 0.0, DELTA, 10)
            return (moved, state, held), Run(x, held.u, info.mean, held.residual, held.ok)

        first = filt.init(jf.StepInput(noise[0], u=jnp.zeros(1)))
        start = Held(rest + jnp.zeros(()), jnp.zeros(4), jnp.zeros(()), jnp.ones((), bool))
        return jax.lax.scan(advance, (x0, first, start), (noise, seen))[1]

    return jax.vmap(one)(keys)


def rest_at(angle: float, rig: Rig = NOMINAL) -> Array:
    """The equilibrium (4,) at an angle [rad]."""
    return equilibrium(rig, jnp.asarray(angle, float))[0]


class Case(NamedTuple):
    """A loop of the table."""

    name: str
    target: float = 70.0  # deg
    torque: bool = False
    gravity: float = 1.0  # of the truth, relative to what filter and controller know
    start: float | None = None  # deg, at rest; None = the equilibrium at 60


CASES = (
    Case("EKF, 70°"),
    Case("EKF + torque, 70°", torque=True),
    Case("EKF, gravity +10 %", gravity=1.1),
    Case("EKF + torque, gravity +10 %", torque=True, gravity=1.1),
    Case("EKF, 80° to 90°", target=90.0, start=80.0),
)


def run_case(p: Controller, case: Case, keys: Array) -> Run:
    """All runs of a case; the start is at rest for the nominal rig."""
    x0 = rest_at(np.deg2rad(60.0 if case.start is None else case.start))
    filt = jf.extended(model(x0, torque=case.torque))
    truth = Rig(gravity=case.gravity * Rig().gravity)
    return simulate(p, filt, truth, jnp.asarray(np.deg2rad(case.target)), x0, keys)


class Errors(NamedTuple):
    """Scores per run over the last four seconds, and over the whole run."""

    mean: np.ndarray  # (runs,) deg
    square: np.ndarray  # (runs,) deg^2
    cost: np.ndarray  # (runs,) sum of 10 e^2 delta [rad^2 s]


def errors(run: Run, target: float) -> Errors:
    """Errors of the true angle."""
    e = np.asarray(run.x[..., 0]) - np.deg2rad(target)
    late = np.rad2deg(e[:, -80:])
    return Errors(late.mean(axis=1), (late**2).mean(axis=1), 10 * DELTA * (e**2).sum(axis=1))
