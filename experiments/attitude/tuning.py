"""kappa and the variances by gradient, genetic algorithm and NSGA-II: same loss, runs and number of evaluations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax import Array
from jax.tree_util import Partial
from matplotlib.ticker import NullFormatter

import jaxfilt as jf
from experiments.attitude import scenarios, synthetic
from experiments.attitude.scenarios import DT
from experiments.lost_target.tuning import Effort, Outcome, Study, lay_side_by_side
from experiments.lost_target.tuning_figures import LABELS
from experiments.lost_target.tuning_figures import table as side_by_side
from experiments.report import Cell, Entry, Table
from jaxfilt import tune
from jaxfilt.metrics import mean

SAMPLES = 5000  # of each run: both tests' first 50 s
FULL = Effort(starts=2, steps=40, population=10, generations=8, sets=5)

Params = dict[str, Any]
Data = dict[str, Array]


def space() -> Params:
    """The paper's filter; kappa stays below 0.9, where the errors explode."""
    return {
        "kappa": tune.interval(0.1, 0.0, 0.9),
        "c": tune.positive(1 / 3),
        "acc_var": tune.positive(1e-4),
        "bias_q": tune.positive(1e-12, 1e-14, 1e-8),
    }


def paper(p: Params) -> jf.Filter:
    return jf.attitude(dt=DT, kappa=p["kappa"], c=p["c"], acc_var=p["acc_var"], bias_q=p["bias_q"])


def velocity_space() -> Params:
    return {
        "gyro_var": tune.positive(1e-6),
        "velocity_var": tune.positive(0.1),
        "bias_q": tune.positive(1e-8, 1e-14, 1e-6),
    }


def velocity(p: Params) -> jf.Filter:
    return jf.attitude_velocity(
        dt=DT, gyro_var=p["gyro_var"], velocity_var=p["velocity_var"], bias_q=p["bias_q"]
    )  # fmt: skip


VARIANTS = {"velocity (V)": (velocity, velocity_space)}


def draw(static: jf.Static, key: Array) -> Data:
    """One run of each test per pair, (2 pairs, SAMPLES, 3)."""
    parts = [
        scenarios.draw_runs(jax.random.fold_in(key, i), test, static.value)[0] for i, test in enumerate(synthetic.TESTS)
    ]
    names = ("gyr", "acc", "axis")
    return {name: jnp.concatenate([getattr(part, name)[:, :SAMPLES] for part in parts]) for name in names}


def squares(make: Partial, params: Params, data: Data) -> Array:
    """(2,) mean squared error of the axis [deg^2] in A and in B, without the first second."""

    def one(gyr, acc, axis):
        found = jf.filter(make(params), acc, u=gyr, outputs=_axis, first_update_only=True)
        return jnp.mean(jnp.sum((found - axis)[round(1 / DT) :] ** 2, axis=-1))

    runs = jax.vmap(one)(data["gyr"], data["acc"], data["axis"])
    return np.rad2deg(1.0) ** 2 * jnp.mean(runs.reshape(2, -1), axis=1)


def _axis(state: Any, info: jf.Info) -> Array:
    del state
    return info.mean[:3]


def loss(make: Partial, params: Params, data: Data) -> Array:
    """The mean of both tests' squares; its root is what is reported."""
    return jnp.mean(squares(make, params, data))


PAPER = Partial(paper)


def study(pairs: int) -> Study:
    objectives = Partial(squares, PAPER)
    return Study(
        name="attitude_tuning",
        title="Tuning kappa and the variances of the paper's filter",
        loss=Partial(loss, PAPER),
        losses=objectives,
        weights=(0.5, 0.5),
        detail=objectives,
        pair=np.eye(2),
        space=space(),
        draw=Partial(draw, jf.Static(pairs)),
        shown=dict,
        reference={"start (paper)": tune.initial(space())},
        note=f"Loss: mean squared error of the vertical axis [deg²] on {pairs} of each of the tests A and B, the first "
        f"{SAMPLES * DT:g} s without the first second. NSGA-II's objectives are the two tests; its row is the point of "
        "its front with the lowest sum.",
    )


def tables(outcome: Outcome, effort: Effort, key: Array) -> tuple[list[Table], list[str]]:
    """The tuners side by side; variant V tuned by gradient alone."""
    start = "start (paper)"
    data = jax.tree.map(lambda x: x[0], outcome.sets)
    found: dict[str, tuple[np.ndarray, np.ndarray]] = {
        "paper": (outcome.objectives(start), outcome.objectives("gradient"))
    }
    results = {"paper": outcome.results["gradient"]}
    for name, (make, its_space) in VARIANTS.items():
        bound = Partial(make)
        results[name] = tune.gradient(
            Partial(loss, bound), its_space(), data, key=key, steps=effort.steps, starts=effort.starts
        )
        both = (tune.initial(its_space()), results[name].params)
        found[name] = tuple(_on_sets(bound, _floats(p), outcome.sets) for p in both)  # pyright: ignore[reportArgumentType]
    rows: list[list[Entry]] = []
    for name, (before, after) in found.items():
        row: list[Entry] = [name]
        for objectives in (before, after):
            row.append(Cell(np.sqrt(objectives[0].mean())))
            fresh = objectives[1:]
            for part in (fresh[:, 0], fresh[:, 1], fresh.mean(axis=1)):
                estimate = jf.metrics.root_mean(part)
                row.append(Cell.of(estimate))
        row.append(", ".join(f"{key} {float(value):.2g}" for key, value in results[name].params.items()))
        rows.append(row)
    parts = ("training", "A, fresh", "B, fresh", "both, fresh")
    header = [
        "filter",
        *(f"{when}: {part} [deg]" for when in ("before", "after") for part in parts),
        "parameters after",
    ]
    note = (
        f"Root of the loss. Gradient as above, the same runs; fresh: {effort.sets} sets as large as the training set. "
        "Before: the paper's parameters; V as in the table of all filters."
    )
    table = Table("attitude_tuned", "The paper's filter and variant V, tuned by gradient", header, rows, note)
    return [side_by_side(outcome, effort), table], [finding(outcome), *compared(found, outcome)]


def compared(found: dict[str, tuple[np.ndarray, np.ndarray]], outcome: Outcome) -> list[str]:
    def root(objectives: np.ndarray) -> float:
        return float(np.sqrt(objectives[1:].mean()))

    before, after = ({name: root(pair[i]) for name, pair in found.items()} for i in range(2))
    fresh = {name: root(outcome.objectives(name)) for name in outcome.results}
    best = min(fresh, key=fresh.__getitem__)
    lead = before["paper"] / before["velocity (V)"], fresh[best] / after["velocity (V)"]
    ga, nsga = (outcome.loss(name) for name in ("genetic", "nsga2"))
    return [
        f"On the same fresh runs V is at {before['velocity (V)']:.2f}° before and {after['velocity (V)']:.2f}° after "
        f"tuning: the paper's filter is {lead[0]:.1f} times worse untuned and {lead[1]:.1f} times after its best tuner "
        f"on these runs ({LABELS[best]}). One pair of runs is little to learn from: GA and NSGA-II end at training "
        f"losses of {ga[0]:.4f} and {nsga[0]:.4f} deg², but have {ga[1:].mean():.2f} and {nsga[1:].mean():.2f} deg² on "
        "fresh runs."
    ]


def finding(outcome: Outcome) -> str:
    front = outcome.results["nsga2"].front
    assert front is not None
    low = np.sqrt(front.losses.min(axis=0))
    at = [np.sqrt(front.losses[int(front.losses[:, i].argmin())]) for i in range(2)]
    kappas = [float(front.params["kappa"][int(front.losses[:, i].argmin())]) for i in range(2)]
    before = float(np.sqrt(mean(outcome.loss("start (paper)")[1:]).value))
    after = ", ".join(f"{LABELS[n]} {np.sqrt(mean(outcome.loss(n)[1:]).value):.2f}°" for n in outcome.results)
    return (
        f"Tuned on simulated runs, the paper's filter goes from {before:.2f}° to {after} on fresh ones. The tests "
        f"conflict: along NSGA-II's front A is {low[0]:.2f}° (kappa {kappas[0]:.2g}) where B is {at[0][1]:.2f}°, and B "
        f"{low[1]:.2f}° (kappa {kappas[1]:.2g}) where A is {at[1][0]:.2f}°."
    )


@jax.jit
def _sets(make: Partial, params: Params, sets: Data) -> Array:
    return jax.lax.map(lambda data: squares(make, params, data), sets)


def _on_sets(make: Partial, params: Params, sets: Data) -> np.ndarray:
    return np.asarray(_sets(make, params, sets))


def _floats(params: Params) -> Params:
    return {key: jnp.asarray(value, float) for key, value in params.items()}


def run(seed: int, pairs: int = 1, effort: Effort = FULL) -> Outcome:
    return lay_side_by_side(study(pairs), effort, jax.random.key(seed))


def figure(outcome: Outcome, where: Path) -> Path:
    """NSGA-II's front with the other tuners' points and the paper's grid of kappa, and what each cost."""
    fig, axes = plt.subplots(1, 2, figsize=(11, 4.4), layout="constrained")
    front = outcome.results["nsga2"].front
    assert front is not None
    axes[0].plot(*np.sqrt(front.losses).T, ".-", color="tab:green", label="NSGA-II, front")
    data = jax.tree.map(lambda x: x[:1], outcome.sets)
    start = _floats(tune.initial(space()))
    grid = [_on_sets(PAPER, {**start, "kappa": jnp.asarray(k)}, data)[0] for k in (0.5, 0.3, 0.1, 0.01, 0.001)]
    axes[0].plot(*np.sqrt(grid).T, "x--", color="black", label="printed variances, kappa 0.5 to 0.001")
    for name, color in (("gradient", "tab:blue"), ("genetic", "tab:orange")):
        axes[0].plot(*np.sqrt(outcome.objectives(name)[0]), "o", color=color, label=LABELS[name])
    axes[0].set(xscale="log", yscale="log", xlabel="test A: tilt RMSE [deg]", ylabel="test B: tilt RMSE [deg]")
    for name, color in (("gradient", "tab:blue"), ("genetic", "tab:orange"), ("nsga2", "tab:green")):
        history = outcome.results[name].history
        axes[1].step(history.wall_time, np.sqrt(history.best_loss), where="post", color=color, label=LABELS[name])
    axes[1].set(xscale="log", xlabel="wall time without compilation [s]", ylabel="training: root of the loss [deg]")
    for ax in axes:
        ax.grid(True, which="both", alpha=0.3)
        ax.xaxis.set_minor_formatter(NullFormatter())  # its labels would overlap
        ax.legend(fontsize=8)
    path = where / "attitude_tuning.png"
    fig.savefig(path, dpi=120)
    plt.close(fig)
    return path
