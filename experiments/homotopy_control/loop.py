"""The receding horizon: solve, apply for one step, move on. One scan for all examples."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from experiments.homotopy_control.series import evaluate


class Plan(NamedTuple):
    """The solution of one horizon, as polynomials in the time since its start."""

    states: Array  # (D, n)
    inputs: Array  # (D, m)
    costate: Array  # (n,) alpha
    residual: Array  # () of the terminal condition
    ok: Array  # () bool


class Course(NamedTuple):
    """What happened, one row per step."""

    x: Array  # (K + 1, n)
    u: Array  # (K, m) at the start of each step
    plans: Plan  # leaves with leading K


def check_horizon(*, delta: float, T: float, terms: int = 2, stages: int = 1) -> None:
    """Raises a ValueError unless 0 < delta <= T, terms >= 2 and stages >= 1."""
    if not (np.isfinite(delta) and delta > 0):
        raise ValueError(f"delta: expected a positive step, got {delta}")
    if not (np.isfinite(T) and delta <= T * (1 + 1e-12)):
        raise ValueError(f"T: expected a horizon of at least the step {delta}, got {T}")
    if terms < 2:
        raise ValueError(f"terms: expected at least 2, got {terms}")
    if stages < 1:
        raise ValueError(f"stages: expected at least 1, got {stages}")


def steps_of(times: Any, values: Any, delta: float, steps: int) -> np.ndarray:
    """A piecewise constant reference (steps,) from its changes.

    Raises:
        ValueError: a change falls inside an applied step.
    """
    times = np.asarray(times, float)
    at = times / delta
    inside = np.abs(at - np.round(at)) > 1e-9
    if inside.any():
        raise ValueError(f"reference: changes at {times[inside].tolist()}, which is inside a step of {delta}")
    index = np.searchsorted(np.round(at), np.arange(steps), side="right") - 1
    return np.asarray(values, float)[index]


def rk4(f: Callable, x: Array, u: Callable, t: Array | float, dt: Array | float, substeps: int) -> Array:
    """x after dt of x' = f(x, u(tau), t + tau)."""
    h = dt / substeps

    def advance(x, tau):
        a = f(x, u(tau), t + tau)
        b = f(x + 0.5 * h * a, u(tau + 0.5 * h), t + tau + 0.5 * h)
        c = f(x + 0.5 * h * b, u(tau + 0.5 * h), t + tau + 0.5 * h)
        d = f(x + h * c, u(tau + h), t + tau + h)
        return x + h * (a + 2 * b + 2 * c + d) / 6, None

    return jax.lax.scan(advance, x, h * jnp.arange(substeps).astype(x.dtype))[0]


@partial(jax.jit, static_argnames=("apply", "state", "substeps"))
def receding(
    plan: Callable[[Any, Array], Plan],
    plant: Callable[[Array, Array, Array], Array],
    x0: Array,
    references: Any,
    delta: Array | float,
    *,
    apply: Literal["poly", "hold"],
    state: Literal["model", "plant"],
    substeps: int = 10,
) -> Course:
    """Plans and applies, step by step.

    Args:
        plan: ``(reference, x) -> Plan``.
        plant: ``(x, u, t) -> x'`` the truth.
        x0: (n,).
        references: a pytree with leading K, one entry per step.
        delta: s per step.
        apply: the polynomial input, or its first value held.
        state: the next state from the series itself (no measurement is ever used: open loop) or from the plant.
        substeps: of the plant's integration.
    """
    if apply not in ("poly", "hold") or state not in ("model", "plant"):
        raise ValueError(f"apply, state: got {apply!r}, {state!r}")

    def advance(x, step):
        k, reference = step
        planned = plan(reference, x)
        if state == "model":
            x_next = evaluate(planned.states, delta)
        else:
            u = (lambda tau: evaluate(planned.inputs, tau)) if apply == "poly" else (lambda tau: planned.inputs[0])
            x_next = rk4(plant, x, u, k * delta, delta, substeps)
        return x_next, (x_next, planned.inputs[0], planned)

    count = jax.tree.leaves(references)[0].shape[0]
    k = jnp.arange(count).astype(x0.dtype)
    _, (x, u, plans) = jax.lax.scan(advance, x0, (k, references))
    return Course(jnp.concatenate([x0[None], x]), u, plans)
