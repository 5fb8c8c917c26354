"""The weights of controller and filter by gradient, GA and NSGA-II: tracking error against control effort.

The plants differ from the model: each run has its own gravity within 10 %. The Riccati equation is solved inside the
loss, by the matrix sign, so that the terminal cost follows the weights.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

import jaxfilt as jf
from experiments.homotopy_control.boundary import care_by_sign
from experiments.homotopy_control.filtered import DELTA, model, rest_at, simulate
from experiments.homotopy_control.rig import Controller, Cost, Rig, equilibrium, linearised
from experiments.report import Cell, Entry, Table
from jaxfilt import tune
from jaxfilt.metrics import mean, ratio

ANGLE = float(np.deg2rad(70.0))
STEPS = 80
LABELS = {"gradient": "gradient (Adam)", "genetic": "GA", "nsga2": "NSGA-II"}

Params = dict[str, Any]


class Effort(NamedTuple):
    """The same number of evaluations for each tuner."""

    runs: int  # in the training set, and in each fresh one
    starts: int
    steps: int
    population: int
    generations: int
    sets: int


FULL = Effort(runs=16, starts=3, steps=120, population=20, generations=18, sets=20)


class Data(NamedTuple):
    """Runs: a noise key and the true gravity of each."""

    keys: Array
    gravity: Array


def space() -> Params:
    """The hand-chosen weights, and what the tuners may make of them."""
    return {
        "angle": tune.positive(10.0, 0.1, 1000.0),
        "rotor": tune.positive(1.0, 0.01, 100.0),
        "process": tune.positive(1.0, 0.01, 100.0),
        "torque": tune.positive(1.0, 0.01, 100.0),
    }


def draw(key: Array, runs: int) -> Data:
    """A set of runs."""
    spread = jax.random.uniform(jax.random.fold_in(key, 0), (runs,), float, 0.9, 1.1)
    return Data(jax.random.split(jax.random.fold_in(key, 1), runs), spread * Rig().gravity)


def controller(params: Params) -> Controller:
    """The short controller (0.1 s, degree 2) with traced weights."""
    A, B = linearised(Rig(), ANGLE)
    zero = jnp.zeros_like(params["angle"])
    q = jnp.stack([params["angle"], zero, params["rotor"], zero])
    terminal = 2 * care_by_sign(A, B, jnp.diag(q), jnp.eye(1))
    return Controller(
        Rig(), Cost(q, 1.0, terminal, 1.0, 0.0, jnp.zeros(4)), 0.1, jf.Static(2), jf.Static(1), jf.Static(2)
    )


def objectives(params: Params, data: Data) -> Array:
    """(2,) tracking error 10 int e^2 dt, and effort 0.1 int (u - u_rest)^2 dt with the true resting input; means."""
    x0 = rest_at(float(np.deg2rad(60.0)))
    filt = jf.extended(model(x0, torque=True, q=params["process"], q_torque=params["torque"]))
    p = controller(params)

    def one(key, gravity):
        truth = Rig(gravity=gravity)
        run = simulate(p, filt, truth, jnp.asarray(ANGLE), x0, key[None], steps=STEPS)
        rest = equilibrium(truth, jnp.asarray(ANGLE))[1]
        error, effort = run.x[0, :, 0] - ANGLE, run.u[0] - rest
        return DELTA * jnp.stack([10 * jnp.sum(error * error), 0.1 * jnp.sum(effort * effort)])

    return jax.vmap(one)(data.keys, data.gravity).mean(axis=0)


def loss(params: Params, data: Data) -> Array:
    """Their sum."""
    return objectives(params, data).sum()


class Outcome(NamedTuple):
    """What the tuners found."""

    results: dict[str, tune.TuneResult]
    params: dict[str, Params]
    scores: dict[str, np.ndarray]  # (1 + sets, 2) objectives on the training set and on fresh ones
    sets: int


def tuned(effort: Effort, key: Array) -> Outcome:
    """All three, on the same runs."""
    train, fresh, search = jax.random.split(key, 3)
    data = draw(train, effort.runs)
    keys = jax.random.split(search, 3)
    evolution: dict[str, Any] = {"population": effort.population, "generations": effort.generations}
    results = {
        "gradient": tune.gradient(
            loss, space(), data, key=keys[0], starts=effort.starts, steps=effort.steps, spread=0.5,
            optimizer=optax.adam(optax.cosine_decay_schedule(0.2, effort.steps)),
        ),
        "genetic": tune.genetic(loss, space(), data, key=keys[1], **evolution),
        "nsga2": tune.nsga2(objectives, space(), data, key=keys[2], weights=[1.0, 1.0], **evolution),
    }  # fmt: skip
    params = {"hand": tune.initial(space()), **{name: result.params for name, result in results.items()}}
    others = [draw(k, effort.runs) for k in jax.random.split(fresh, effort.sets)]
    sets = jax.tree.map(lambda *x: jnp.stack(x), data, *others)
    scores = {name: np.asarray(_scores(_floats(p), sets)) for name, p in params.items()}
    return Outcome(results, params, scores, effort.sets)


def _floats(params: Params) -> Params:
    return {name: jnp.asarray(value, float) for name, value in params.items()}


@jax.jit
def _scores(params: Params, sets: Data) -> Array:
    return jax.lax.map(lambda data: objectives(params, data), sets)


def table(outcome: Outcome, effort: Effort) -> Table:
    """One row per way to choose the weights."""
    rows: list[list[Entry]] = []
    for name, params in outcome.params.items():
        scores = outcome.scores[name]
        fresh = mean(scores[1:])
        row: list[Entry] = [LABELS.get(name, "by hand"), Cell(scores[0].sum(), digits=4)]
        total = mean(scores[1:].sum(axis=1))
        row += [Cell(float(total.value), float(total.standard_error))]
        row += [Cell(float(fresh.value[i]), float(fresh.standard_error[i])) for i in range(2)]
        result = outcome.results.get(name)
        row += ["", "", ""] if result is None else [result.evaluations, result.wall_time, result.compile_time]
        rows.append([*row, *(float(params[key]) for key in space())])
    header = ["method", "loss, training", "loss, fresh runs", "error, fresh", "effort, fresh", "evaluations"]
    header += ["wall time [s]", "compilation [s]", "q angle", "q rotor", "x process noise", "x torque noise"]
    note = (
        f"Loss = error + effort: means over {effort.runs} runs of {STEPS * DELTA:g} s of 10 ∫e² dt and 0.1 ∫(u - û)² "
        "dt, with û the true resting input; 60° to 70°, EKF with torque, gravity off by up to 10 %. Fresh: "
        f"{outcome.sets} sets as large as the training set. NSGA-II: the point of its front with the lowest sum. The "
        "last two columns scale the filter's process noise."
    )
    return Table("tuning", "Weights of controller and filter", header, rows, note)


def finding(outcome: Outcome) -> str:
    """By how much the loss on fresh runs falls."""
    base = outcome.scores["hand"][1:].sum(axis=1)
    parts = []
    for name, label in LABELS.items():
        r = ratio(outcome.scores[name][1:].sum(axis=1), base)
        parts.append(f"{label} {100 * (float(r.value) - 1):+.1f} ± {100 * float(r.standard_error):.1f} %")
    front = outcome.results["nsga2"].front
    assert front is not None
    error, effort = front.losses.T
    at_end = [name for name in ("gradient", "genetic") if float(outcome.params[name]["torque"]) < 0.02]
    note = ""
    if at_end:
        note = (
            f" The noise of the torque went to the lower end of its box ({' and '.join(LABELS[n] for n in at_end)}): "
            f"over "
            "4 s the torque is constant, and the prior's spread suffices to find it."
        )
    return (
        f"Tuning against the hand-chosen weights, loss on fresh runs: {', '.join(parts)}. NSGA-II's front goes from "
        f"error {error.min():.4f} at effort {effort[error.argmin()]:.4f} to error {error.max():.4f} at "
        f"{effort[error.argmax()]:.4f}.{note}"
    )
