"""A car's satellite position cut for 5, 10 and 20 s: motion models alone, with wheel speed, and with a gyroscope."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from jax.tree_util import Partial

import jaxfilt as jf
from experiments import planar
from experiments.bootstrap import Bootstrap
from experiments.car import drive as recorded
from experiments.car import filters
from experiments.car.drive import LENGTHS, SPLIT, Cuts, Drive
from experiments.car.filters import CAR, PLANAR, UKF, Params
from experiments.report import Cell, Entry, Options, Report, Table
from jaxfilt import tune

matplotlib.use("Agg")
import matplotlib.pyplot as plt

TITLE = "Car: a cut GNSS bridged by motion models, wheel speed and gyroscope"
MAIN = False

STEPS = 100
TUNED = (*PLANAR, *CAR)
QUICK = ("CV", "car, wheels", "car, wheels and gyro")
BASELINES = ("last fix held", "line through two fixes", "GNSS speed and course", "raw wheels along last course")
PUBLISHED = Path(__file__).parent / "published.json"
# How the parameters stand in their table: standard deviations, for the measurement noise.
COLUMNS = {
    "position [m]": ("r", None),
    "wheel speed [m/s]": ("r_wheel", None),
    "yaw rate [rad/s]": ("r_gyro", None),
    "q, speed [m²/s³]": ("q_speed", None),
    "q, yaw [rad²/s³]": ("q_turn", None),
    "q, CV [m²/s³]": ("cv_q", None),
    "q, CA [m²/s⁵]": ("ca_q", None),
    "q, CT [m²/s³]": ("ct_q", None),
    "q, turn [rad²/s³]": ("ct_q_omega", None),
    "stay, mode 1": ("stay", 0),
    "stay, mode 2": ("stay", 1),
}


class Scores(NamedTuple):
    """Per cut."""

    squared: np.ndarray  # (B, T) squared distance from the reference [m^2], 0 outside of the cut
    along: np.ndarray  # (B, T) its parts
    across: np.ndarray  # (B, T)
    nees: np.ndarray | None  # (B,) at the cut's end, over 2


class Outcome(NamedTuple):
    """All that the tables show."""

    drive: Drive
    cuts: Cuts
    params: dict[str, Params]
    learnt: dict[str, tune.TuneResult]
    scores: dict[str, Scores]
    groups: dict[int, Bootstrap]  # by length


def learn(name: str, drive: Drive, steps: int = STEPS) -> tune.TuneResult:
    """A filter's parameters, on the first half."""
    first = drive.t < SPLIT
    ys = jnp.asarray(drive.ys[first])
    data = filters.Given(ys, jnp.ones(ys.shape, bool), jnp.asarray(drive.dt[first]))
    objective = Partial(filters.loss, jf.Static(name))
    return tune.gradient(objective, filters.space(name), data, key=jax.random.key(0), steps=steps, block=steps)


def published_parameters() -> dict[str, Params]:
    """What ``published.json`` holds, by filter."""
    table = json.loads(PUBLISHED.read_text(encoding="utf-8"))["tables"]["noise"]
    found: dict[str, Params] = {}
    for cells in table["rows"]:
        row = dict(zip(table["header"], cells, strict=True))
        params = {k: np.array(v) for k, v in tune.initial(filters.space(row["filter"])).items()}
        for column, (key, index) in COLUMNS.items():
            if row[column] != "-":
                value = float(row[column]["value"])
                params[key][() if index is None else index] = value**2 if key.startswith("r") else value
        found[row["filter"]] = params
    return found


def estimate(name: str, params: Params, ys: np.ndarray, drive: Drive, cuts: Cuts) -> filters.Reported:
    """What a filter says, for each cut."""
    masks = np.ones((*cuts.hidden.shape, 4), bool)
    masks[cuts.hidden, :2] = False
    given = {k: jnp.asarray(v) for k, v in params.items()}
    return filters.run(name, given, jnp.asarray(ys), jnp.asarray(masks), jnp.asarray(drive.dt))


def baseline(name: str, drive: Drive, cuts: Cuts) -> np.ndarray:
    """(B, T, 2) positions in each cut from what was known before it, and the wheels."""
    found = []
    for hidden in cuts.hidden:
        k = np.flatnonzero(hidden)[0] - 1  # the last fix
        elapsed = drive.t - drive.t[k]
        fix, course = drive.ys[k, :2], drive.course[k]
        ahead = np.array([np.cos(course), np.sin(course)])
        if name == BASELINES[0]:
            moved = np.zeros((len(elapsed), 2))
        elif name == BASELINES[1]:
            moved = np.outer(elapsed / drive.dt[k], fix - drive.ys[k - 1, :2])
        elif name == BASELINES[2]:
            moved = np.outer(elapsed * drive.speed[k], ahead)
        else:
            way = np.cumsum(drive.ys[:, 2] * drive.dt)
            moved = np.outer(way - way[k], ahead)
        found.append(fix + moved)
    return np.stack(found)


def score(position: np.ndarray, cov: np.ndarray | None, drive: Drive, cuts: Cuts) -> Scores:
    """Against the reference, in the cuts."""
    error = np.where(cuts.hidden[..., None], np.asarray(position) - drive.truth, 0.0)
    u = drive.direction
    along = error[..., 0] * u[:, 0] + error[..., 1] * u[:, 1]
    across = error[..., 1] * u[:, 0] - error[..., 0] * u[:, 1]
    nees = None
    if cov is not None:
        rows = np.arange(len(cuts.last))
        there = np.asarray(position)[rows, cuts.last], np.asarray(cov)[rows, cuts.last]
        nees = np.asarray(jf.metrics.nees(*there, drive.truth[cuts.last])) / 2
    return Scores(np.sum(error**2, axis=-1), along, across, nees)


def evaluate(params: dict[str, Params], learnt: dict[str, tune.TuneResult], seed: int) -> Outcome:
    """Runs and scores all filters, and the baselines."""
    drive = recorded.load()
    cuts = recorded.cut(drive)
    with_gyro = "car, wheels and gyro"
    jobs = {**params, **({UKF: params[with_gyro]} if len(params) == len(TUNED) else {})}
    found = planar.in_parallel(lambda name: estimate(name, jobs[name], drive.ys, drive, cuts), list(jobs))
    scores = {
        name: score(np.asarray(out.position), np.asarray(out.cov), drive, cuts)
        for name, out in zip(jobs, found, strict=True)
    }
    scores |= {name: score(baseline(name, drive, cuts), None, drive, cuts) for name in BASELINES}
    rng = np.random.default_rng(seed)
    groups = {length: Bootstrap(cuts.length == length, rng) for length in LENGTHS}
    return Outcome(drive, cuts, params, learnt, scores, groups)


def _at_end(values: np.ndarray, cuts: Cuts) -> np.ndarray:
    return values[np.arange(len(cuts.last)), cuts.last]


def _errors(o: Outcome) -> Table:
    once, count = np.ones(len(o.cuts.last)), o.cuts.hidden.sum(axis=1)
    rows: list[list[Entry]] = []
    for name, s in o.scores.items():
        end = _at_end(s.squared, o.cuts)
        rows.append([name, *(group.cell(end, once) for group in o.groups.values()), o.groups[20].interval(end, once),
                     *(group.cell(s.squared.sum(axis=1), count) for group in o.groups.values())])  # fmt: skip
    header = ["filter", *(f"end, {x} s" for x in LENGTHS), "95 %, 20 s", *(f"over {x} s" for x in LENGTHS)]
    counts = " and ".join(f"{len(g.group)} cuts of {x} s" for x, g in o.groups.items())
    note = (
        f"RMSE [m] at the end of the cut, and over it. {counts}, from {SPLIT:g} s on. They overlap: standard errors "
        "from resampled cuts are too small, most of all at 20 s, where all cuts share their middle."
    )
    return Table("errors", "Horizontal error in the cut", header, rows, note)


def _parts(o: Outcome) -> Table:
    once = np.ones(len(o.cuts.last))
    inside = jf.metrics.chi2_quantile(0.95, 2) / 2
    rows: list[list[Entry]] = []
    for name, s in o.scores.items():
        row: list[Entry] = [name]
        for part in (s.along, s.across):
            row += [group.cell(_at_end(part, o.cuts) ** 2, once) for group in o.groups.values()]
        row += [group.cell(s.nees, once, root=False) for group in o.groups.values()]
        share = None if s.nees is None else 100.0 * (s.nees < inside)
        rows.append([*row, o.groups[20].cell(share, once, root=False)])
    parts = [f"{part}, {x} s" for part in ("along", "across", "NEES/2") for x in LENGTHS]
    note = "RMSE [m] along and across the track, at the end of the cut. NEES/2 there, 1 = honest; in 95 %: share [%]."
    title = "Along and across the track, and the uncertainty claimed"
    return Table("parts", title, ["filter", *parts, "in 95 %, 20 s"], rows, note)


def _noise(o: Outcome) -> Table:
    rows: list[list[Entry]] = []
    for name, params in o.params.items():
        row: list[Entry] = [name]
        for key, index in COLUMNS.values():
            if key not in params:
                row.append("-")
                continue
            value = float(np.asarray(params[key])[() if index is None else index])
            row.append(Cell(np.sqrt(value) if key.startswith("r") else value))
        rows.append([*row, Cell(o.learnt[name].loss, digits=4) if name in o.learnt else "-"])
    note = (
        f"On the first {SPLIT:g} s, {STEPS} steps of one start each. Noise as standard deviations. The loss counts "
        "all components that a filter is given, so it compares the filters of one kind only."
    )
    return Table(
        "noise", "Parameters tuned by innovation likelihood", ["filter", *COLUMNS, "loss [nats/epoch]"], rows, note
    )


def _findings(o: Outcome) -> list[str]:
    once = np.ones(len(o.cuts.last))

    def end(name, length=20, part="squared"):
        values = getattr(o.scores[name], part)
        squared = _at_end(values if part == "squared" else values**2, o.cuts)
        return o.groups[length].draw(squared, once)

    motion = [name for name in o.params if name in PLANAR]
    best = min(motion, key=lambda name: end(name)[0])
    wheels, gyro = "car, wheels", "car, wheels and gyro"
    straight = min(BASELINES[:3], key=lambda name: end(name)[0])
    early = o.drive.t < SPLIT
    scale = o.drive.ys[early, 2].sum() / o.drive.speed[early].sum()

    def nees(name):
        values = o.scores[name].nees
        assert values is not None
        return ", ".join(f"{group.draw(values, once, root=False)[0]:.2g}" for group in o.groups.values())

    cv = end("CV")
    relative = [f"{name} {_ratio(end(name) / cv)}" for name in motion[1:]]
    late = np.linalg.norm((o.drive.ys[~early, :2] - o.drive.truth[~early]).mean(axis=0))

    return [
        f"After 20 s without GNSS the best motion model ({best}) is {end(best)[0]:.3g} m off, with wheel speed "
        f"{end(wheels)[0]:.3g} m, with the gyroscope too {end(gyro)[0]:.3g} m; after 5 s {end(best, 5)[0]:.3g}, "
        f"{end(wheels, 5)[0]:.3g} and {end(gyro, 5)[0]:.3g} m.",
        f"Wheel speed takes the error along the track from {end(best, part='along')[0]:.3g} to "
        f"{end(wheels, part='along')[0]:.3g} m; the gyroscope that across it from "
        f"{end(wheels, part='across')[0]:.3g} to {end(gyro, part='across')[0]:.3g} m. On this nearly straight road "
        f"{best}, without any sensor, has {end(best, part='across')[0]:.3g} m across.",
        f"The wheels read {100 * (1 - scale):.2f} % less than the receiver's speed in the first half. Taken as they "
        f"are, along the last course, they give {end(BASELINES[3])[0]:.3g} m after 20 s; filters estimate the scale.",
        f"Motion models after 20 s, relative to CV: {'; '.join(relative) or '-'}. The best baseline without sensors "
        f"({straight}) is {end(straight)[0]:.3g} m off.",
        f"NEES/2 at the end of {', '.join(map(str, LENGTHS))} s (1 = honest): "
        f"{'; '.join(f'{name} {nees(name)}' for name in (best, wheels, gyro))}. Where it is far above "
        "1 the filter is too sure: errors of the fixes drift slowly, which innovations do not show.",
        f"In the second half the fixes lie {late:.2g} m from the reference moved by the first half's offset, "
        "on average: smaller errors mean nothing.",
    ]


def _ratio(draws: np.ndarray) -> str:
    return f"{draws[0]:.2f} ± {draws[1:].std(ddof=1):.2f}"


def _figure(o: Outcome, path: Path) -> Path:
    """RMS error against the time since the cut, over the cuts of 20 s."""
    fig, axes = plt.subplots(1, 2, figsize=(12, 5), sharey=True, constrained_layout=True)
    own = np.flatnonzero(o.cuts.length == 20)
    grid = np.arange(0.5, 20, 0.5)
    for ax, part in zip(axes, ("along", "across"), strict=True):
        for i, (name, s) in enumerate(o.scores.items()):
            values = getattr(s, part)
            curves = [np.interp(grid, (o.drive.t - o.cuts.start[b])[o.cuts.hidden[b]], values[b][o.cuts.hidden[b]] ** 2)
                      for b in own]  # fmt: skip
            style = ":" if name in BASELINES else "--" if name in PLANAR else "-"
            ax.plot(
                grid,
                np.sqrt(np.mean(curves, axis=0)),
                style,
                color=f"C{i % 10}" if i < 10 else f"{0.3 * (i - 9):.1f}",
                lw=1.6,
                label=name,
            )
        ax.set(
            xlabel="time since the cut [s]", title=f"{part} the track, {len(own)} cuts", yscale="log", ylim=(0.03, 500)
        )
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("RMS error [m]")
    fig.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    fig.savefig(path, dpi=120)
    plt.close(fig)
    return path


def run(options: Options) -> Report:
    """The whole experiment. There is as much as was recorded, so ``options.runs`` does not matter.

    The quick form has fewer filters, with the published parameters.
    """
    learnt: dict[str, tune.TuneResult] = {}
    if options.quick:
        known = published_parameters()
        params = {name: known[name] for name in QUICK}
    else:
        drive = recorded.load()
        learnt = dict(zip(TUNED, planar.in_parallel(lambda name: learn(name, drive), TUNED), strict=True))
        params = {name: result.params for name, result in learnt.items()}
    o = evaluate(params, learnt, options.seed)
    report = Report("car", TITLE, [_errors(o), _parts(o), _noise(o)])
    report.findings = _findings(o)
    report.figures = [_figure(o, options.directory("car") / "car.png")]
    return report
