"""The tables: what is published, the bound, and ours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from experiments.bearing_frequency.camera import CameraStudy
from experiments.bearing_frequency.filters import QUANTITIES, Outcome, lost
from experiments.bearing_frequency.scenarios import CONVERGED, SCENARIOS
from experiments.bearing_frequency.starts import ADAM_RUNS, ADAM_STEPS, MLStudy
from experiments.report import Cell, Entry, Table
from jaxfilt import metrics

# Tables 1 to 3: EKF, UKF, the proposed filter, the adaptive filter of the paper's reference 16
PUBLISHED = {
    "approaching": {
        "position": (36.27, 35.7, 21.03, 29.15), "speed": (0.08, 0.06, 0.03, 0.05),
        "course": (0.14, 0.15, 0.15, 0.12), "base frequency": (0.01, 0.012, 0.01, 0.011),
    },
    "receding": {
        "position": (87.36, 76.78, 41.3, 50.07), "speed": (0.1, 0.1, 0.06, 0.06),
        "course": (0.23, 0.21, 0.25, 0.2), "base frequency": (0.011, 0.01, 0.009, 0.01),
    },
    "manoeuvring": {
        "position": (39.35, 28.09, 26.14, 36.06), "speed": (0.06, 0.06, 0.05, 0.05),
        "course": (0.11, 0.11, 0.1, 0.1), "base frequency": (0.01, 0.01, 0.01, 0.01),
    },
}  # fmt: skip

PUBLISHED_BEARING = {"approaching": (0.001,) * 4, "receding": (0.011, 0.01, 0.009, 0.01), "manoeuvring": (0.001,) * 4}

PUBLISHED_TIME = {"UKF": "0.264 / 1.357", "printed R and Q, guarded": "0.311 / 0.5"}

UNITS = {
    "position": "m", "speed": "m/s", "course": "deg", "base frequency": "Hz", "bearing": "deg",
    "received frequency": "Hz",
}  # fmt: skip

Outcomes = dict[str, Outcome]  # by filter


class Bounds(NamedTuple):
    """The bound of all scenarios."""

    variance: dict[str, np.ndarray]  # (3, T)
    condition: np.ndarray  # (3, T)

    def window(self, quantity: str, first: int = CONVERGED) -> np.ndarray:
        """(3,) rms from ``first`` s on."""
        return np.sqrt(self.variance[quantity][:, first - 1 :].mean(axis=1))


def runs_of(outs: Outcomes) -> int:
    """Runs behind a row."""
    return next(iter(outs.values())).scores.nis.shape[1]


def cell(outcome: Outcome, scenario: int, quantity: str = "position", *, late: bool = False) -> Cell:
    """The RMSE of a scenario's runs."""
    scores = outcome.scores.late if late else outcome.scores.mse
    return Cell.of(metrics.root_mean(scores[quantity][scenario]))


def least_ratio(outcome: Outcome, bound: Bounds) -> np.ndarray:
    """(3,) the smallest RMSE in units of the bound at any time after convergence."""
    ratio = np.sqrt(outcome.curves["position"] / bound.variance["position"])
    return ratio[:, CONVERGED - 1 :].min(axis=1)


def bound_table(bound: Bounds) -> Table:
    """What no filter can be better than."""
    rows: list[list[Entry]] = []
    for name in QUANTITIES:
        for first in (1000, 1200):
            values = bound.window(name, first)
            rows.append([f"{name} [{UNITS[name]}]", f"rms {first} to 2000 s", *(Cell(v, exact=True) for v in values)])
    position = np.sqrt(bound.variance["position"])
    rows.append(["position [m]", "least at any time", *(Cell(v, exact=True) for v in position.min(axis=1))])
    rows.append(["", "at [s]", *(Cell(int(v) + 1, digits=4, exact=True) for v in position.argmin(axis=1))])
    for t in (200, 500, 800, 1000, 2000):
        rows.append(["position [m]", f"at {t} s", *(Cell(v, exact=True) for v in position[:, t - 1])])
    note = (
        "Posterior Cramér-Rao bound of motion without process noise, with the start error that is drawn, 500 m an axis."
    )
    return Table("bound", "The bound", ["quantity", "", *SCENARIOS], rows, note)


def published_table(scenario: int, bound: Bounds, small: Outcomes, large: Outcomes) -> Table:
    """Tables 1 to 3, with the bound in a column of its own."""
    name = SCENARIOS[scenario]
    least = np.sqrt(bound.variance["position"][scenario].min())
    ours = [n for n in ("EKF", "UKF", "printed R and Q, guarded", "SOEKF (trace)") if n in small]
    big = [n for n in ("EKF", "UKF", "SOEKF (trace)") if n in large]
    runs = small[ours[0]].scores.nis.shape[1], large[big[0]].scores.nis.shape[1]
    rows: list[list[Entry]] = []
    for quantity in QUANTITIES[:-1]:
        limit = bound.window(quantity)[scenario]
        if quantity == "bearing":
            published = [f"{x} (as printed)" for x in PUBLISHED_BEARING[name]]
        else:
            published = []
            for x in PUBLISHED[name][quantity]:
                mark = ""
                if quantity == "position" and x < limit:
                    mark = " (impossible)" if x < least else " (below)"
                published.append(f"{x}{mark}")
        rows.append([
            f"{quantity} [{UNITS[quantity]}]", Cell(limit, exact=True), *published,
            *(cell(small[n], scenario, quantity) for n in ours), *(cell(large[n], scenario, quantity) for n in big),
        ])  # fmt: skip
    header = ["RMSE, 1000 to 2000 s", "bound", "paper: EKF", "paper: UKF", "paper: proposed", "paper: adaptive [16]"]
    header += [f"{n}, {runs[0]}" for n in ours] + [f"{n}, {runs[1]} runs" for n in big]
    note = (
        "Behind our filters' names the number of runs. (below): below the bound's window rms; (impossible): below the "
        "bound at every time. The paper prints its bearing errors as degrees; only as radians are they possible at all."
    )
    return Table(f"table_{scenario + 1}", f"Table {scenario + 1}: {name}", header, rows, note)


def filters_table(small: Outcomes, bound: Bounds) -> Table:
    """All filters with the right R."""
    rows: list[list[Entry]] = [
        ["bound", *(Cell(v, exact=True) for v in bound.window("position")), "-", *["-"] * 3, "-"]
    ]
    for name, out in small.items():
        ratios = np.sqrt(out.scores.mse["position"].mean(axis=1)) / bound.window("position")
        nis = Cell.of(metrics.mean(out.scores.nis.mean(axis=0)))
        rows.append([
            name, *(cell(out, i) for i in range(3)), " / ".join(f"{r:.2f}" for r in ratios),
            *(cell(out, i, "course") for i in range(3)), nis,
        ])  # fmt: skip
    header = ["filter", *(f"{s} [m]" for s in SCENARIOS), "of the bound", *(f"course {i + 1} [deg]" for i in range(3)),
              "mean NIS"]  # fmt: skip
    note = "The same measurements for all. NIS of two components, expected 2. σ_a = 1e-4 m/s²; right R."
    return Table("filters", "All filters, right R", header, rows, note, runs_of(small))


def efficiency_table(outs: Outcomes, bound: Bounds) -> Table:
    """RMSE over the bound: of the window, and the least at any time in it."""
    rows: list[list[Entry]] = []
    for name, out in outs.items():
        window = [metrics.root_mean(out.scores.mse["position"][i] / bound.window("position")[i] ** 2) for i in range(3)]
        rows.append([name, *(Cell.of(e) for e in window), *(Cell(v) for v in least_ratio(out, bound))])
    header = ["filter", *SCENARIOS, *(f"least, {i + 1}" for i in range(3))]
    note = "Position RMSE in units of the bound: over 1000 to 2000 s, and the least at any second of it."
    return Table("efficiency", "How near to the bound", header, rows, note, runs_of(outs))


def unguarded_table(outs: Outcomes) -> Table:
    """What the printed rules do when they act from the first second."""
    rows: list[list[Entry]] = []
    for name, out in outs.items():
        finite, flagged = out.scores.finite, out.scores.flagged
        gone = lost(out)
        caught = (~finite & flagged).sum()
        rows.append([name, f"{finite.mean():.0%}", f"{caught} of {(~finite).sum()}", f"{gone.mean():.0%}"])
    header = ["rule", "runs that stay finite", "non-finite runs that are flagged", "runs lost"]
    return Table("unguarded", "The printed rules from the first second", header, rows,
                 "All scenarios. Lost: position RMSE after 1000 s above 500 m, or no number.",
                 runs_of(outs))  # fmt: skip


def wrong_r_table(outs: Outcomes) -> Table:
    """Their errors, and where their R ended."""
    rows: list[list[Entry]] = []
    for name, out in outs.items():
        s = out.scores
        noise = np.sqrt((s.noise**2).mean(axis=(0, 1)))
        rows.append([
            name, *(cell(out, i) for i in range(3)), " / ".join(f"{x:.0%}" for x in lost(out).mean(axis=1)),
            Cell(np.degrees(noise[0])), Cell(noise[1]), Cell.of(metrics.mean(s.nis.mean(axis=0))),
        ])  # fmt: skip
    header = ["filter", *(f"{s} [m]" for s in SCENARIOS), "lost", "√R at the end [deg]", "[Hz]", "mean NIS"]
    note = "Told 0.5 deg and 1 Hz; true are 2 deg and 0.3 Hz. √R: root mean square over the runs of all scenarios."
    return Table("wrong_r", "Filters told a wrong R", header, rows, note, runs_of(outs))


def ml_table(studies: list[MLStudy], descents: dict[int, tuple[np.ndarray, np.ndarray]]) -> Table:
    """Batch ML by Levenberg-Marquardt beside the bound, and what Adam reaches."""
    rows: list[list[Entry]] = []
    for s in studies:
        for i, name in enumerate(SCENARIOS):
            adam = descents.get(s.length)
            rows.append([
                f"{s.length} s", name, Cell(s.bound[i], exact=True), Cell.of(metrics.root_mean(s.errors[i] ** 2)),
                Cell.of(metrics.mean(s.per_number[i])), f"{s.agree[i].mean():.0%}",
                Cell(s.true_condition[i], exact=True),
                "-" if adam is None else Cell(np.sqrt((adam[0][i] ** 2).mean())),
                "-" if adam is None else Cell(adam[1][i].mean()),
            ])  # fmt: skip
    header = ["data", "scenario", "bound [m]", "ML [m]", "cost per number", "starts that agree", "condition",
              "Adam [m]", "Adam's cost per number"]  # fmt: skip
    note = (
        "Rms error of the position at 0 s, with nothing known beforehand. Condition number of the information, scaled "
        f"to a unit diagonal. Adam: {ADAM_STEPS} steps at 0.1 with cosine decay on scaled unknowns, on "
        f"{ADAM_RUNS} of the runs."
    )
    return Table("starts_ml", "Starts by maximum likelihood", header, rows, note, studies[0].errors.shape[1])


def ga_table(errors: dict[str, np.ndarray]) -> Table:
    """The GA's errors restate its box."""
    rows: list[list[Entry]] = []
    for name, e in errors.items():
        draws = np.random.default_rng(0).integers(0, e.shape[1], (1000, e.shape[1]))
        rows.append([
            name, *(Cell(np.median(x), np.median(x[draws], axis=1).std()) for x in e),
            " / ".join(f"{f:.2f}" for f in (e < 1000).mean(axis=1)),
        ])  # fmt: skip
    header = ["search box", *(f"median, {s} [m]" for s in SCENARIOS), "share below 1 km"]
    note = "The paper's figure 17 claims less than 1000 m in all scenarios. Standard errors by bootstrap."
    return Table("starts_ga", "Starts by GA on the first residual", header, rows, note, e.shape[1])


def effect_table(near: Outcomes, far: Outcomes) -> Table:
    """Whether the start matters after convergence."""
    rows: list[list[Entry]] = []
    for label, outs in (("500 m per axis", near), ("ray, 10 ± 3 km", far)):
        for name, out in outs.items():
            rows.append([
                name, label, *(cell(out, i) for i in range(3)),
                *(Cell.of(metrics.root_mean(out.scores.at_500[i])) for i in range(3)),
                " / ".join(f"{x:.0%}" for x in lost(out).mean(axis=1)),
            ])  # fmt: skip
    header = [
        "filter",
        "start",
        *(f"{s} [m]" for s in SCENARIOS),
        *(f"at 500 s, {i + 1} [m]" for i in range(3)),
        "lost",
    ]
    return Table("starts_effect", "Does the start matter?", header, rows, "", runs_of(far))


def turn_table(outs: Outcomes) -> Table:
    rows: list[list[Entry]] = [[label, cell(out, 0, late=True)] for label, out in outs.items()]
    note = "Scenario 1 with the target turning by -0.5 deg/s from 1200 to 1380 s; position RMSE over 1400 to 2000 s."
    return Table("turn", "A target that turns", ["filter", "position [m]"], rows, note,
                 runs_of(outs))  # fmt: skip


def camera_table(study: CameraStudy) -> Table:
    """Scans updated, tracks lost, and errors."""
    rows: list[list[Entry]] = []
    for r in study.rows:
        s, k = r.scores, r.scores.scored
        rows.append([
            r.filt, r.start, f"{r.used} of {study.tracks}", f"{s.updated[k].mean():.1%}",
            f"{int(s.lost[k].sum())} of {int(k.sum())}", f"{int((s.other & s.lost)[k].sum())}",
            Cell(np.median(np.sqrt(s.squared[k]))), Cell(np.degrees(np.median(np.sqrt(s.bearing[k])))),
            f"{np.median(np.sqrt(s.relative[k])):.0%}", Cell(r.nis),
        ])  # fmt: skip
    header = ["filter", "start", "tracks it serves", "scans updated", "lost", "of these on the other boat",
              "position [m]", "bearing [deg]", "range", "mean NIS"]  # fmt: skip
    note = (
        "Tracks from every detection of each fifth scan of the first 40 s that lies within 3 deg of a boat; scored "
        "from 10 s after the start to the end of the record; medians over the tracks of their rms errors. They "
        "overlap, so there are no standard errors. Lost: off the boat's bearing by more than 10 deg in the "
        "last 5 s. A start by ML serves where it is surer of the place than the guess along the ray (75 m); elsewhere "
        "the filter goes on."
    )
    return Table("camera", "Camera bearings of two boats", header, rows, note)
