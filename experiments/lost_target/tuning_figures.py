"""How the tuners' results are shown: the table of a study, findings, loss against cost, and the fronts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from experiments.report import Cell, Entry, Table
from jaxfilt import tune
from jaxfilt.metrics import mean, ratio

if TYPE_CHECKING:
    from experiments.lost_target.tuning import Effort, Outcome

LABELS = {"gradient": "gradient (Adam)", "genetic": "GA", "nsga2": "NSGA-II"}
_COLORS = {"gradient": "tab:blue", "genetic": "tab:orange", "nsga2": "tab:green"}
_MARKERS = {"gradient": "o", "genetic": "s", "nsga2": "^"}
_REFERENCES = {"Kalata, closed form": "*", "truth": "*", "likelihood": "D"}  # shown in the figures
_LINES = {"Kalata, closed form": "--", "truth": "--", "likelihood": ":"}
_HONEST = 1e-3  # the lowest |log NEES| shown: less is chance
_UNITS = {"tuning_gains": " [m²]", "tuning_noise": "", "tuning_strategies": " [nats]"}
_AXES = {
    "tuning_gains": ("measurement noise: part of the MSE [m²]", "lag: the rest of the MSE [m²]"),
    "tuning_noise": ("RMSE in the gap [m]", f"|log NEES| in the gap (below {_HONEST:g}: at {_HONEST:g})"),
    "tuning_strategies": ("masked NLL [nats]", "RMSE in the gap of G1 [m]"),
}
_SHORT = {
    "tuning_gains": "alpha-beta gains",
    "tuning_noise": "q and R by errors in the gap",
    "tuning_strategies": "strategies by masked likelihood",
}


def table(outcome: Outcome, effort: Effort) -> Table:
    """One row per reference and tuner."""
    study = outcome.study
    names = list(study.shown(outcome.params["gradient"]))
    header = ["method", "loss, training", "loss, fresh runs", "evaluations", "wall time [s]", "compilation [s]",
              "loss after 1 s", "10 s", "60 s", "to 0.1 % [s]", *names]  # fmt: skip
    rows: list[list[Entry]] = []
    for name, params in outcome.params.items():
        losses = outcome.loss(name)
        fresh = mean(losses[1:])
        row: list[Entry] = [LABELS.get(name, name), Cell(losses[0], digits=5)]
        row.append(Cell(fresh.value, fresh.standard_error, digits=4))
        result = outcome.results.get(name)
        if result is None:
            row += ["", "", "", "", "", "", ""]
        else:
            row += [result.evaluations, result.wall_time, result.compile_time]
            row += [Cell(result.best_at(seconds), digits=5) for seconds in (1.0, 10.0, 60.0)]
            near = time_to(result, outcome.lowest())
            row.append("never" if near is None else near)
        rows.append([*row, *(float(value) for value in study.shown(params).values())])
    slowest = max(result.wall_time for result in outcome.results.values())
    note = (
        f"{study.note} {effort} Wall time is without compilation. All ended before {slowest:.1f} s: later columns show "
        "the final loss. To 0.1 %: time until the loss is within 0.1 % of the lowest that any tuner found. Fresh: mean "
        f"over {effort.sets} sets as large as the training set, with its standard error."
    )
    return Table(study.name, study.title, header, rows, note)


def time_to(result: tune.TuneResult, lowest: float, share: float = 1e-3) -> float | None:
    """Wall time [s] until the loss is within a share of the lowest; None if it never is."""
    close = result.history.best_loss <= lowest + share * abs(lowest)
    return float(result.history.wall_time[close.argmax()]) if close.any() else None


def cost_finding(outcomes: list[Outcome]) -> str:
    """Who came close to the lowest loss, when."""
    parts = []
    for outcome in outcomes:
        times = {name: time_to(result, outcome.lowest()) for name, result in outcome.results.items()}
        shown = ", ".join(f"{LABELS[n]} {'never' if t is None else f'{t:.2f} s'}" for n, t in times.items())
        parts.append(f"{outcome.study.title[0].lower()}{outcome.study.title[1:]}: {shown}")
    compilation = {n: sum(outcome.results[n].compile_time for outcome in outcomes) for n in LABELS}
    shown = ", ".join(f"{LABELS[name]} {seconds:.0f} s" for name, seconds in compilation.items())
    return (
        f"Time to within 0.1 % of the lowest training loss that any tuner found: {'; '.join(parts)}. Compilation in "
        f"all three studies together: {shown}."
    )


def gains_finding(outcome: Outcome) -> str:
    parts = []
    for name in ("start (Cohen)", *LABELS):
        excess = ratio(outcome.loss(name)[1:], outcome.loss("Kalata, closed form")[1:])
        alpha, beta = (float(x) for x in outcome.study.shown(outcome.params[name]).values())
        percent = f"{100 * (excess.value - 1):+.3f} ± {100 * excess.standard_error:.3f} %"
        parts.append(f"{LABELS.get(name, name)} {percent} ({alpha:.3f}, {beta:.3f})")
    alpha, beta = (float(x) for x in outcome.study.shown(outcome.params["Kalata, closed form"]).values())
    return (
        f"Alpha-beta gains: loss on fresh runs against that of Kalata's closed form "
        f"({alpha:.3f}, {beta:.3f}): {', '.join(parts)}. The optimum is flat: "
        "the losses agree far better than the gains."
    )


def noise_finding(outcome: Outcome) -> str:
    """Whether the two objectives compete, and how the tuners' q and R fare on fresh runs."""
    front = outcome.results["nsga2"].front
    assert front is not None
    error, inconsistency = front.losses.T
    honest = error[inconsistency < 0.05].min(initial=np.inf)  # infinite if none is
    compete = "hardly compete" if honest < 1.02 * error.min() else "compete"
    against = []
    for name in ("likelihood", *LABELS):
        r, p = ratio(outcome.loss(name)[1:], outcome.loss("truth")[1:]), outcome.params[name]
        percent = f"{100 * (r.value - 1):+.1f} ± {100 * r.standard_error:.1f} %"
        against.append(f"{LABELS.get(name, name)} {percent} (q/R {float(p['q']) / float(p['r']):.4f})")
    return (
        f"q and R by the errors in the gap: RMSE and consistency {compete}: NSGA-II's front has RMSE from "
        f"{error.min():.2f} m, and from {honest:.2f} m where |log NEES| is below 0.05; the RMSE depends on q/R (true "
        "value 0.0040), the common factor sets the NEES. Loss on fresh runs against that of the true q and R: "
        f"{', '.join(against)}."
    )


def strategies_finding(outcome: Outcome) -> str:
    """Which parameters matter: the training loss with one of them moved halfway to an end of its box."""
    name = min(LABELS, key=lambda n: outcome.results[n].loss)
    space, best = outcome.study.space, outcome.params[name]
    lowest = outcome.loss(name)[0]
    z = tune.unconstrain(space, best)
    ends = [tune.constrain(space, end) for end in tune.bounds(space)]
    parts = []
    for parameter, value in best.items():
        costs, shares = [], []
        for end in ends:
            target = tune.unconstrain(space, {**best, parameter: end[parameter]})
            costs.append(float(outcome.training_loss(tune.constrain(space, 0.5 * (z + target)))) - lowest)
            shares.append(float(jnp.abs(target - z).sum()))
        text = f"{parameter} {float(value):.3g} (halfway to its lower end {costs[0]:+.3f} nats, upper {costs[1]:+.3f})"
        if max(costs) < 0.01:
            text += ", practically without effect"
        elif min(shares) < 0.05 * sum(shares):
            text += ", at the end of its box: no optimum inside"
        parts.append(text)
    return "Parameters of the strategies by masked likelihood: " + "; ".join(parts) + "."


def convergence(outcomes: list[Outcome], directory: Path) -> Path:
    """Excess of the training loss over the lowest found, against wall time and evaluations."""
    figure, axes = plt.subplots(2, len(outcomes), figsize=(13, 7), layout="constrained", sharey="col")
    for column, outcome in zip(axes.T, outcomes, strict=True):
        lowest = outcome.lowest()
        # The winner's own excess ends at 0, which a log axis cannot show: it ends at the floor.
        floor = 1e-6 * abs(lowest)
        for name, result in outcome.results.items():
            excess = np.maximum(result.history.best_loss - lowest, floor)
            for ax, cost in zip(column, (result.history.wall_time, result.history.evaluations), strict=True):
                ax.step(cost, excess, where="post", color=_COLORS[name], marker=".", markersize=4, label=LABELS[name])
        for name in outcome.study.reference:
            excess = float(outcome.loss(name)[0]) - lowest
            if name in _REFERENCES and excess > floor:
                for ax in column:
                    ax.axhline(excess, color="black", linestyle=_LINES[name], linewidth=1.5, label=name)
        column[0].set_title(_SHORT[outcome.study.name])
        column[0].set_xlabel("wall time without compilation [s]")
        column[1].set_xlabel("evaluations of the loss")
        for ax in column:
            ax.set(xscale="log", yscale="log")
            ax.grid(True, which="major", alpha=0.3)
            ax.legend(fontsize=8)
            ax.set_ylabel(f"training loss above the lowest{_UNITS[outcome.study.name]}")
    figure.supxlabel("Where the excess is below 1e-6 of the lowest loss it is shown at that.", fontsize=8)
    return _save(figure, directory / "tuning_convergence.png")


def fronts(outcomes: list[Outcome], directory: Path) -> Path:
    """What NSGA-II found between its two objectives on the training runs, with the others' points."""
    figure, axes = plt.subplots(1, len(outcomes), figsize=(13, 4.6), layout="constrained")
    for ax, outcome in zip(axes, outcomes, strict=True):
        front = outcome.results["nsga2"].front
        assert front is not None
        lowest = _HONEST if outcome.study.name == "tuning_noise" else -np.inf
        x, y = front.losses.T
        ax.plot(x, np.maximum(y, lowest), ".", color=_COLORS["nsga2"], markersize=5, label="NSGA-II, front")
        for name in outcome.params:
            if name in LABELS or name in _REFERENCES:
                x, y = outcome.objectives(name)[0]
                color, marker = _COLORS.get(name, "black"), _MARKERS.get(name) or _REFERENCES[name]
                label = "NSGA-II, lowest sum" if name == "nsga2" else LABELS.get(name, name)
                ax.plot(x, max(y, lowest), marker, color=color, markersize=9, markerfacecolor="none", label=label)
        ax.set(title=_SHORT[outcome.study.name])
        ax.set_xlabel(_AXES[outcome.study.name][0])
        ax.set_ylabel(_AXES[outcome.study.name][1])
        ax.grid(True, alpha=0.3)
        ax.legend(fontsize=8)
    axes[0].set(xscale="log", yscale="log")
    axes[0].xaxis.set_minor_formatter(NullFormatter())  # its labels would overlap
    axes[1].set(yscale="log")
    return _save(figure, directory / "tuning_fronts.png")


def _save(figure: Figure, path: Path) -> Path:
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path
