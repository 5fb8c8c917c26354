"""Maneuver detection and the adaptive answers, on a target whose acceleration steps from zero."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.report import Cell, Entry, Options, Report, Table

matplotlib.use("Agg")
import matplotlib.pyplot as plt

TITLE = "Maneuvers: detection delays, adaptive filters, variable dimension and IMM"
MAIN = False

ONSET, R = 60, 25.0  # sample, m^2
M0, P0 = (0.0, 10.0), (100.0, 25.0)
DETECTORS = {
    "NIS": {"statistic": "nis"},
    "fading memory 0.8": {"statistic": "fading", "forgetting": 0.8},
    "fading memory 0.9": {"statistic": "fading", "forgetting": 0.9},
    "NIS, window 5": {"statistic": "window", "window": 5},
    "whitened sum, 5": {"statistic": "sum", "window": 5},
    "whitened sum, 10": {"statistic": "sum", "window": 10},
}
ACCELERATIONS = (0.5, 1.0, 2.0)  # m/s^2, for the delays
PUSH = (1.0, 3.0)  # m/s^2, for the adaptive filters
LENGTH = 20  # s, of the maneuver that they answer


class Reported(NamedTuple):
    """What the scores look at, per step."""

    position: Array
    alarm: Array | None
    status: Array


def velocity_model(q: float) -> jf.models.LinearGaussian:
    """Constant velocity, T = 1 s; q [m^2/s^3]."""
    return jf.models.constant_velocity(dt=1.0, q=q, r=R, m0=list(M0), P0=np.diag(P0).tolist())


def acceleration_model(q: float) -> jf.models.LinearGaussian:
    """Constant acceleration; q [m^2/s^5]."""
    return jf.models.constant_acceleration(
        dt=1.0, q=q, r=R, m0=[*M0, 0.0], P0=np.diag([*P0, 1.0]).tolist()
    )  # fmt: skip


def scenario(q: float, T: int, acceleration: float, length: int) -> jf.Scenario:
    """Constant velocity with process noise q, and an acceleration over ``length`` samples from ONSET on."""
    elapsed = np.arange(T) - ONSET + 1.0
    moved = np.where(elapsed <= length, 0.5 * np.maximum(elapsed, 0) ** 2, length * (elapsed - 0.5 * length))
    shared = (velocity_model(q), jnp.asarray(acceleration * moved))
    return jf.Scenario(Partial(_draw, *shared), first_update_only=True)


def _draw(model: Any, moved: Array, key: Array) -> jf.Draw:
    states, ys = jf.simulate.simulate(model, moved.shape[0], key, first_update_only=True)
    return jf.Draw(states[:, 0] + moved, ys + moved[:, None])


def reported(state: Any, info: jf.Info) -> Reported:
    """``outputs`` of the filters."""
    del state
    return Reported(info.mean[0], info.extra.get("alarm"), info.status)


def alarm_score(truth: Array, ys: Array, out: Reported) -> dict[str, Array]:
    """False alarms before the onset (20 samples of start left out), and samples from the onset to the first alarm."""
    del truth, ys
    assert out.alarm is not None
    after = out.alarm[ONSET:]
    delay = jnp.where(after.any(), jnp.argmax(after) + 1, after.shape[0])
    return {"false": jnp.mean(out.alarm[20:ONSET].astype(float)), "delay": delay.astype(float)}


def error_score(truth: Array, ys: Array, out: Reported) -> dict[str, Array]:
    """Squared position errors before and during the maneuver, and at each sample."""
    del ys
    squared = (out.position - truth) ** 2
    return {
        "quiet": jnp.mean(squared[20:ONSET]),
        "maneuver": jnp.mean(squared[ONSET : ONSET + LENGTH]),
        "course": squared,
    }


def detectors() -> dict[str, jf.Filter]:
    """All statistics at a false-alarm probability of 0.01 per sample."""
    filt = jf.kalman(velocity_model(0.1))
    return {name: jf.detected(filt, p_false=0.01, **options) for name, options in DETECTORS.items()}


def answers() -> dict[str, jf.Filter]:
    """The adaptive filters, and the two constant ones."""
    quiet = velocity_model(0.05)
    alarmed = jf.detected(jf.kalman(quiet), p_false=1e-3)
    bank = (jf.kalman(quiet), jf.kalman(acceleration_model(0.2)))
    return {
        "CV alone": jf.kalman(quiet),
        "CA alone": jf.kalman(acceleration_model(0.01)),
        "gain floored": jf.gain_floor(alarmed, alpha=0.75, beta=0.5, dt=1.0),
        "Q x 200": jf.q_inflated(alarmed, 200.0),
        "P x 5": jf.p_inflated(alarmed, 5.0),
        "variable dimension": jf.variable_dimension(quiet, acceleration_model(0.01), p_false=1e-3),
        "IMM (CV, CA)": jf.imm(bank, ((0.97, 0.03), (0.1, 0.9))),
    }


def detect(runs: int, seed: int) -> dict[float, jf.MonteCarloResult]:
    """All detectors, for each acceleration; the noise is the same."""
    key = jax.random.key(seed)
    return {
        a: jf.monte_carlo(scenario(0.1, 110, a, 60), detectors(), alarm_score, runs, key, outputs=reported)
        for a in ACCELERATIONS
    }


def respond(runs: int, seed: int) -> dict[float, jf.MonteCarloResult]:
    """All adaptive filters, for each acceleration; the noise is the same."""
    key = jax.random.key(seed)
    return {
        a: jf.monte_carlo(scenario(0.05, 100, a, LENGTH), answers(), error_score, runs, key, outputs=reported)
        for a in PUSH
    }


def detection_table(results: dict[float, jf.MonteCarloResult]) -> Table:
    """Measured false alarms and delays."""
    first = results[ACCELERATIONS[0]]
    rows: list[list[Entry]] = [
        [name, Cell.of(first.mean(name, "false")), *(Cell.of(results[a].mean(name, "delay")) for a in ACCELERATIONS)]
        for name in DETECTORS
    ]
    header = ["statistic", "false alarms", *(f"delay at {a} m/s²" for a in ACCELERATIONS)]
    note = (
        "Nominal false-alarm probability 0.01 per sample; mean delay in samples, 1 = at the first accelerated sample."
    )
    return Table("detection", "Maneuver detection", header, rows, note, first.runs)


def answer_table(results: dict[float, jf.MonteCarloResult]) -> Table:
    """RMSE while quiet and during the maneuver."""
    first = results[PUSH[0]]
    rows: list[list[Entry]] = []
    for name in answers():
        peak = np.sqrt(results[PUSH[1]].scores[name]["course"].mean(axis=0)[ONSET:].max())
        cells = [first.root_mean(name, "quiet"), *(results[a].root_mean(name, "maneuver") for a in PUSH)]
        rows.append([name, *map(Cell.of, cells), Cell(peak)])
    header = ["filter", "quiet", *(f"{a:g} m/s²" for a in PUSH), f"peak at {PUSH[1]:g} m/s²"]
    note = f"Position RMSE [m] over samples 20 to {ONSET - 1}, and over the {LENGTH} samples of the maneuver."
    return Table("answers", "Adaptive answers to a maneuver", header, rows, note, first.runs)


def findings(results: dict[float, jf.MonteCarloResult]) -> list[str]:
    """What the tables say."""

    def ratio(a, name, part="maneuver"):
        return f"{float(results[a].ratio((name, part), ('CV alone', part), root=True).value):.2f}"

    strong = PUSH[1]
    return [
        f"At {strong:g} m/s² the RMSE of variable dimension and IMM is {ratio(strong, 'variable dimension')} and "
        f"{ratio(strong, 'IMM (CV, CA)')} of the constant-velocity filter's; raising gain, Q or P gives "
        f"{ratio(strong, 'gain floored')}, {ratio(strong, 'Q x 200')} and {ratio(strong, 'P x 5')}.",
        f"While quiet they cost {ratio(strong, 'variable dimension', 'quiet')} and "
        f"{ratio(strong, 'IMM (CV, CA)', 'quiet')} of it; a constant-acceleration filter alone costs "
        f"{ratio(strong, 'CA alone', 'quiet')}.",
    ]


def figure(results: dict[float, jf.MonteCarloResult], path: Path) -> Path:
    """RMSE through the stronger maneuver."""
    result = results[PUSH[1]]
    fig, ax = plt.subplots(figsize=(9, 4.8), constrained_layout=True)
    for name in answers():
        ax.plot(np.sqrt(result.scores[name]["course"].mean(axis=0)), label=name, lw=1.5)
    ax.axvspan(ONSET, ONSET + LENGTH - 1, color="0.9", zorder=0)
    ax.set(
        yscale="log", xlabel="time [s]", ylabel="position RMSE [m]", title=f"{PUSH[1]:g} m/s² (shaded)", xlim=(40, 99)
    )
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3, which="both")
    fig.savefig(path, dpi=120)
    plt.close(fig)
    return path


def run(options: Options) -> Report:
    """The whole experiment."""
    detection = detect(options.count(4000, 500), options.seed)
    responses = respond(options.count(1000, 200), options.seed)
    report = Report("manoeuvre", TITLE, [detection_table(detection), answer_table(responses)])
    report.findings = findings(responses)
    report.figures = [figure(responses, options.directory("manoeuvre") / "manoeuvre.png")]
    return report
