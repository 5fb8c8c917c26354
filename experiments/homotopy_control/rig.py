"""Example 3: elevation of the CE150 two-rotor rig. State: angle [rad], its rate, the main rotor's state, its rate.

A constant torque ``d`` [N m] about the axis may be known beside the state: it enters the plant, the target and the
predictive model alike.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.homotopy_control.boundary import care, multiple_shooting, newton
from experiments.homotopy_control.loop import Course, Plan, check_horizon, receding
from experiments.homotopy_control.series import Quadratic, evaluate, quadratic_series

START = (1.0472, 0.0, 0.6093, 0.0)  # the printed x(0); no equilibrium
INPUT_RANGE = (0.0, 1.5)


class Rig(NamedTuple):
    """The plant's parameters."""

    lag: Any = 0.3  # T_1 [s]
    inertia: Any = 0.0054  # I
    square: Any = 0.1807  # a_1: torque = a_1 x_3^2 + b_1 x_3
    straight: Any = 0.0028  # b_1
    damping: Any = 0.0011  # B
    gravity: Any = 0.0755  # tau_g


NOMINAL = Rig()


class Cost(NamedTuple):
    """What the horizon weighs: q (x - target)^2 + r (u - input)^2, and lambda(T) = terminal (x(T) - target).

    The printed variant has the structure of the corrected one, so that both share their compiled loops.
    """

    q: Array  # (4,)
    r: Any
    terminal: Array  # (4, 4)
    about_input: Any  # 1.0: the input is weighed about the target's, 0.0: about 0, as printed
    printed: Any  # 1.0: the target is printed_target, 0.0: the equilibrium
    printed_target: Array  # (4,)


class Controller(NamedTuple):
    """The rig as the controller knows it, its cost and its horizon."""

    rig: Rig
    cost: Cost
    T: Any
    degree: jf.Static
    stages: jf.Static
    steps: jf.Static  # of Newton


def derivative(rig: Rig, x: Array, u: Array, d: Any = 0.0) -> Array:
    """x' for the state (4,) and the input ()."""
    torque = rig.square * x[2] ** 2 + rig.straight * x[2] + d - rig.gravity * jnp.sin(x[0]) - rig.damping * x[1]
    return jnp.stack([x[1], torque / rig.inertia, x[3], (u - x[2] - 2 * rig.lag * x[3]) / rig.lag**2])


def plant(rig: Rig, x: Array, u: Array, t: Any) -> Array:
    """The same for the loop."""
    del t
    return derivative(rig, x, u[0])


def equilibrium(rig: Rig, angle: Any, d: Any = 0.0) -> tuple[Array, Array, Array]:
    """Target (4,), input () and whether it exists; the rotor's torque is held above 0."""
    needed = rig.gravity * jnp.sin(angle) - d
    radicand = rig.straight**2 + 4 * rig.square * needed
    exists = (radicand >= 0) & (needed >= 0)
    floor = jnp.maximum(radicand, rig.straight**2)
    rotor = (-rig.straight + jnp.sqrt(floor)) / (2 * rig.square)
    zero = jnp.zeros_like(rotor)
    return jnp.stack([angle + zero, zero, rotor, zero]), rotor, exists


def linearised(rig: Rig, angle: Any) -> tuple[Array, Array]:
    """A (4, 4) and B (4, 1) at the equilibrium."""
    x, u, _ = equilibrium(rig, jnp.asarray(angle, float))
    return jax.jacfwd(derivative, 1)(rig, x, u), jax.jacfwd(derivative, 2)(rig, x, u)[:, None]


def corrected(
    angle: float,
    *,
    rig: Rig = NOMINAL,
    q: tuple[float, ...] = (10.0, 0.0, 1.0, 0.0),
    r: float = 1.0,
    T: float = 0.5,
    delta: float = 0.05,
    degree: int = 8,
    stages: int = 5,
    steps: int = 4,
    terminal: np.ndarray | None = None,
    about_input: bool = True,
) -> Controller:
    """The sound controller: right terminal rows, the input weighed about its equilibrium, Riccati terminal cost.

    Args:
        angle: set-point [rad], for which the terminal cost is designed (by SciPy, so it is data and not traced).
        rig: as the controller knows it.
        q: weights of the state.
        r: weight of the input.
        T: horizon [s].
        delta: step [s].
        degree: of the series in each stage.
        stages: of the horizon.
        steps: of Newton.
        terminal: (4, 4) of lambda(T) = terminal (x(T) - target), instead of twice the Riccati solution.
        about_input: whether the input is weighed about the equilibrium's.

    Raises:
        ValueError: wrong weights, an impossible horizon, no equilibrium or no stabilising Riccati solution.
    """
    check_horizon(delta=delta, T=T, terms=degree + 1, stages=stages)
    weights = np.asarray(q, float)
    if weights.shape != (4,) or not np.isfinite(weights).all() or (weights < 0).any():
        raise ValueError(f"q: expected four nonnegative weights, got {q}")
    if not (np.isfinite(r) and r > 0):
        raise ValueError(f"r: expected a positive weight, got {r}")
    if not (np.isfinite(angle) and bool(equilibrium(rig, jnp.asarray(angle, float))[2])):
        raise ValueError(f"angle: no equilibrium at {angle} rad")
    if terminal is None:
        terminal = 2 * care(*linearised(rig, angle), np.diag(weights), np.array([[r]]))
    terminal = np.asarray(terminal, float)
    if terminal.shape != (4, 4):
        raise ValueError(f"terminal: expected shape (4, 4), got {terminal.shape}")
    cost = Cost(jnp.asarray(weights), float(r), jnp.asarray(terminal), float(about_input), 0.0, jnp.zeros(4))
    return Controller(rig, cost, T, jf.Static(degree), jf.Static(stages), jf.Static(steps))


def printed(
    *,
    T: float,
    delta: float,
    q: float = 80.0,
    h: float = 8.0,
    r: float = 1.0,
    target: tuple[float, float] = (1.2217, 0.6189),
    rows: Literal["interchanged", "right"] = "interchanged",
    rig: Rig = NOMINAL,
) -> Controller:
    """The published controller: degree 2, one stage, the whole input weighed.

    With ``rows="interchanged"`` lambda_3(T) = 0 and lambda_4(T) = 2 H_3 (x_3 - r_3): only so do the printed series come
    out. An inference from numbers; the authors' code was not seen.

    Raises:
        ValueError: wrong weights or an impossible horizon.
    """
    check_horizon(delta=delta, T=T, terms=3)
    if not r > 0 or q < 0 or h < 0:
        raise ValueError(f"r, q, h: expected r > 0 and q, h >= 0, got {r}, {q}, {h}")
    terminal = np.zeros((4, 4))
    terminal[0, 0] = terminal[3 if rows == "interchanged" else 2, 2] = 2 * h
    fixed = jnp.array([target[0], 0.0, target[1], 0.0])
    cost = Cost(jnp.array([q, 0.0, q, 0.0]), float(r), jnp.asarray(terminal), 0.0, 1.0, fixed)
    # the residual is affine in alpha at degree 2, so the second step only polishes
    return Controller(rig, cost, T, jf.Static(2), jf.Static(1), jf.Static(2))


def aim(p: Controller, angle: Any, d: Any = 0.0) -> tuple[Array, Array, Array]:
    """Target (4,), the input that costs nothing () and whether the target exists."""
    target, u, exists = equilibrium(p.rig, angle, d)
    printed = jnp.asarray(p.cost.printed) > 0
    return jnp.where(printed, p.cost.printed_target, target), p.cost.about_input * u, exists | printed


# --- the Hamiltonian system -------------------------------------------------------------------------------------------


def field(p: Controller, angle: Any, d: Any = 0.0) -> Quadratic:
    """z' for z = [x, lambda, sin x_1, cos x_1], which is quadratic."""
    rig, cost = p.rig, p.cost
    target, u0, _ = aim(p, angle, d)
    pull = 2 * cost.q * target
    zero = jnp.zeros_like(u0)
    constant = jnp.stack(
        [zero, zero + d / rig.inertia, zero, u0 / rig.lag**2, pull[0], pull[1], pull[2], pull[3], zero, zero]
    )
    return Quadratic(constant, Partial(_linear, rig, cost), Partial(_bilinear, rig))


def _linear(rig, cost, z):
    x2, x3, x4, l1, l2, l3, l4, s = (z[i] for i in range(1, 9))
    u = -l4 / (2 * cost.r * rig.lag**2)
    weighed = -2 * cost.q * z[:4]
    zero = jnp.zeros_like(u)
    return jnp.stack([
        x2,
        (-rig.gravity * s - rig.damping * x2 + rig.straight * x3) / rig.inertia,
        x4,
        (u - x3 - 2 * rig.lag * x4) / rig.lag**2,
        weighed[0],
        weighed[1] - l1 + rig.damping / rig.inertia * l2,
        weighed[2] - rig.straight / rig.inertia * l2 + l4 / rig.lag**2,
        weighed[3] - l3 + 2 / rig.lag * l4,
        zero,
        zero,
    ])  # fmt: skip


def _bilinear(rig, a, b):
    zero = jnp.zeros_like(a[0])
    return jnp.stack([
        zero,
        rig.square / rig.inertia * a[2] * b[2],
        zero,
        zero,
        rig.gravity / rig.inertia * a[5] * b[9],
        zero,
        -2 * rig.square / rig.inertia * a[2] * b[5],
        zero,
        a[9] * b[1],
        -a[8] * b[1],
    ])  # fmt: skip


def lift(z: Array) -> Array:
    """z (8,) with the sine and cosine of the angle."""
    return jnp.concatenate([z, jnp.sin(z[:1]), jnp.cos(z[:1])])


def hamiltonian_field(p: Controller, angle: Any, z: Array, d: Any = 0.0) -> Array:
    """z' (8,) by differentiating the Hamiltonian; u is held, not differentiated. A check of :func:`field`."""
    target, u0, _ = aim(p, angle, d)
    x, costate = z[:4], z[4:]
    u = u0 - costate[3] / (2 * p.cost.r * p.rig.lag**2)

    def H(x):
        error = x - target
        running = jnp.sum(p.cost.q * error * error) + p.cost.r * (u - u0) ** 2
        return running + costate @ derivative(p.rig, x, u, d)

    return jnp.concatenate([derivative(p.rig, x, u, d), -jax.grad(H)(x)])


def shoot(p: Controller, angle: Any, d: Any, z0: Array) -> tuple[Array, Array]:
    """z(T) (8,) and the series (degree + 1, 8) of the first stage."""
    system = field(p, angle, d)
    stage = p.T / p.stages.value

    def advance(z, _):
        series = quadratic_series(system, lift(z), p.degree.value)[:, :8]
        return evaluate(series, stage), series

    z, series = jax.lax.scan(advance, z0, length=p.stages.value)
    return z, series[0]


def guess(p: Controller, angle: Any, d: Any, x: Array) -> Array:
    """alpha by the terminal cost, which is exact for the linearised rig and an infinite horizon."""
    target, _, _ = aim(p, angle, d)
    return p.cost.terminal @ (x - target)


def plan(p: Controller, angle: Any, x: Array, d: Any = 0.0) -> Plan:
    """One horizon by single shooting."""
    target, u0, exists = aim(p, angle, d)

    def residual(alpha):
        end, _ = shoot(p, angle, d, jnp.concatenate([x, alpha]))
        return end[4:] - p.cost.terminal @ (end[:4] - target)

    solved = newton(residual, guess(p, angle, d, x), p.steps.value)
    _, series = shoot(p, angle, d, jnp.concatenate([x, solved.value]))
    u = (-series[:, 7] / (2 * p.cost.r * p.rig.lag**2)).at[0].add(u0)
    # relative to the costates, and where these vanish to what the terminal weights make of a small error
    scale = jnp.abs(solved.value).max() + 1e-3 * jnp.abs(p.cost.terminal).max()
    ok = exists & (solved.residual <= 1e-6 * scale)  # false for NaN
    return Plan(series[:, :4], u[:, None], solved.value, solved.residual, ok)


def plan_by_nodes(p: Controller, angle: Any, x: Array, steps: int = 8) -> tuple[Array, Array]:
    """alpha (4,) and the residual by multiple shooting, for long horizons."""
    target, _, _ = aim(p, angle)
    K, zero = p.stages.value, jnp.zeros(())
    A, B = linearised(p.rig, angle)
    closed = A - B @ (B.T @ p.cost.terminal) / (2 * p.cost.r)
    times = jnp.linspace(0.0, p.T, K + 1)
    decay = jax.vmap(lambda t: jax.scipy.linalg.expm(closed * t) @ (x - target))(times)
    start = jnp.concatenate([target[None] + decay, decay @ p.cost.terminal.T], axis=1)
    one = p._replace(T=p.T / K, stages=jf.Static(1))
    found = multiple_shooting(
        lambda z: shoot(one, angle, zero, z)[0],
        lambda z: z[:4] - x,
        lambda z: z[4:] - p.cost.terminal @ (z[:4] - target),
        start,
        steps,
    )
    return found.value[0, 4:], found.residual


class Held(NamedTuple):
    """What is applied over one step, and what a later step may fall back on."""

    u: Array  # ()
    alpha: Array  # (4,)
    residual: Array  # ()
    ok: Array  # () bool


def control(p: Controller, angle: Any, x: Array, d: Any, last: Held) -> Held:
    """The input to hold for the estimate x; without a solution the last one, without an estimate the equilibrium's."""
    usable = jnp.isfinite(x).all() & jnp.isfinite(d)
    d = jnp.where(usable, d, 0.0)
    target, rest, _ = equilibrium(p.rig, angle, d)
    planned = plan(p, angle, jnp.where(usable, x, target), d)
    ok = planned.ok & usable
    u = jnp.where(ok, planned.inputs[0, 0], jnp.where(usable, last.u, rest))
    alpha = jnp.where(ok, planned.costate, last.alpha)
    return Held(jnp.clip(u, *INPUT_RANGE), alpha, planned.residual, ok)


# --- without a filter -------------------------------------------------------------------------------------------------


def course(
    p: Controller,
    angle: float,
    x0: Any = START,
    *,
    delta: float = 0.05,
    seconds: float = 20.0,
    apply="hold",
    state="plant",
    rig: Rig = NOMINAL,
) -> Course:
    """State feedback, the input not clipped."""  # fmt: skip
    angles = jnp.full(round(seconds / delta), angle)
    x = jnp.asarray(x0, float)
    return receding(Partial(plan, p), Partial(plant, rig), x, angles, delta, apply=apply, state=state)


@partial(jax.jit, static_argnames="steps")
def alpha_of(p: Controller, angle: Array, x: Array, steps: int = 0) -> tuple[Array, Array]:
    """alpha and the residual of one horizon; with ``steps`` by multiple shooting."""
    if steps:
        return plan_by_nodes(p, angle, x, steps)
    planned = plan(p, angle, x)
    return planned.costate, planned.residual


def boundary_reference(p: Controller, angle: float, x: Any) -> np.ndarray:
    """alpha (4,) of the same problem by SciPy's collocation."""
    import scipy.integrate

    target, terminal = np.asarray(aim(p, angle)[0]), np.asarray(p.cost.terminal)
    slope = jax.jit(jax.vmap(Partial(hamiltonian_field, p, angle), in_axes=1, out_axes=1))
    times = np.linspace(0.0, float(p.T), 200)
    A, B = (np.asarray(part) for part in linearised(p.rig, angle))
    closed = A - B @ (B.T @ terminal / 2) / float(p.cost.r)
    decay = np.stack([scipy.linalg.expm(closed * t) @ (np.asarray(x) - target) for t in times], axis=1)
    start = np.concatenate([target[:, None] + decay, terminal @ decay])
    solution = scipy.integrate.solve_bvp(
        lambda t, z: np.asarray(slope(jnp.asarray(z))),
        lambda a, b: np.concatenate([a[:4] - x, b[4:] - terminal @ (b[:4] - target)]),
        times, start, tol=1e-8, max_nodes=50_000,
    )  # fmt: skip
    if not solution.success:
        raise ValueError(f"solve_bvp: {solution.message}")
    return solution.y[4:, 0]
