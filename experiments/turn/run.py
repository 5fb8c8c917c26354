"""Coordinated turns by IMM: mode filters EKF and UKF, biased and unbiased mixing of states of different size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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

TITLE = "Coordinated turn: IMM over states of different size"
MAIN = False

DT, T, R = 0.1, 200, 0.05
TRANSITION = ((0.9, 0.1), (0.1, 0.9))
START = (0.95, 0.05)
# MSE per coordinate in the manual of the toolbox that the thesis's example comes from.
MANUAL = {"KF (CV)": 0.0253, "IMM-EKF": 0.0179, "IMM-UKF": 0.0155}


def path() -> np.ndarray:
    """(T, 4) the deterministic path: straight, left turn, straight, right turn, straight at unit speed."""
    rate = np.zeros(T)
    rate[40:90], rate[110:160] = 1.0, -1.0
    x = np.array([0.0, 0.0, 1.0, 0.0])
    states = []
    for omega in rate:
        u = omega * DT
        s, c = (np.sin(u) / omega, (np.cos(u) - 1) / omega) if omega else (DT, 0.0)
        rotation = np.array([[1, 0, s, c], [0, 1, -c, s], [0, 0, np.cos(u), -np.sin(u)], [0, 0, np.sin(u), np.cos(u)]])
        x = rotation @ x
        states.append(x)
    return np.array(states)


def modes(r: Any) -> tuple[jf.Filter, jf.models.Nonlinear]:
    """The manual's straight mode as a filter, and its turning mode as a model; r: variance of a measurement."""
    m0, P0 = np.array([0.0, 0.0, 1.0, 0.0, 0.0]), np.diag([0.1, 0.1, 0.1, 0.1, 1.0])
    straight = jf.kalman(jf.models.constant_velocity(dt=DT, q=0.01, r=r, m0=m0[:4], P0=P0[:4, :4]))
    return straight, jf.models.coordinated_turn(dt=DT, q_omega=0.15, r=r, m0=m0, P0=P0)


def filters() -> dict[str, jf.Filter]:
    """The manual's filters with its `zero` mixing, and with `own`."""
    straight, turn = modes(R)
    single = jf.models.constant_velocity(
        dt=DT, q=0.05, r=R, m0=np.array([0.0, 0.0, 0.0, -1.0]), P0=np.diag([1.1, 1.1, 0.1, 0.1])
    )
    turning = {"EKF": jf.extended(turn), "UKF": jf.unscented(turn, alpha=0.5, beta=2.0, kappa=0.0)}
    bank = {
        f"IMM-{name}, {mixing}": jf.imm((straight, filt), TRANSITION, mu0=START, mixing=mixing)
        for name, filt in turning.items()
        for mixing in ("zero", "own")
    }
    return {"KF (CV)": jf.kalman(single), **bank}


def draw(states: Array, key: Array, r: Any = R) -> jf.Draw:
    """The same path with fresh measurement noise of variance r."""
    ys = states[:, :2] + jnp.sqrt(r) * jax.random.normal(key, (T, 2), states.dtype)
    return jf.Draw(states, ys)


def score(truth: Array, ys: Array, out: Any) -> dict[str, Array]:
    """MSE per coordinate, filtered and smoothed."""
    del ys
    position = truth[:, :2]
    return {
        "filtered": jnp.mean((out.mean[:, :2] - position) ** 2),
        "smoothed": jnp.mean((jf.rts(out).mean[:, :2] - position) ** 2),
    }


def simulate(runs: int, seed: int) -> jf.MonteCarloResult:
    """All filters on the same runs."""
    return jf.monte_carlo(
        jf.Scenario(Partial(draw, jnp.asarray(path()))), filters(), score, runs, jax.random.key(seed)
    )  # fmt: skip


def table(result: jf.MonteCarloResult) -> Table:
    """MSE beside the published values."""
    rows: list[list[Entry]] = []
    for name in filters():
        published = MANUAL.get(name.split(",")[0])
        shown = "-" if published is None or name.endswith("own") else f"{published:.4f}"
        cells = [result.mean(name, part) for part in ("filtered", "smoothed")]
        rows.append([name, shown, *map(Cell.of, cells)])
    header = ["filter", "manual", "ours", "ours, smoothed"]
    note = "MSE per coordinate [length²]. The published values are of one batch of 100 runs, which scatters by 0.0004."
    return Table("turn", "Coordinated turn without a gap", header, rows, note, result.runs)


def findings(result: jf.MonteCarloResult) -> list[str]:
    """What the table says."""

    def gain(name):
        ratio = result.ratio((f"{name}, own", "filtered"), (f"{name}, zero", "filtered"))
        return f"{100 * (1 - float(ratio.value)):.0f} %"

    return [
        "The toolbox mixes a turn rate that the straight model lacks as 0, which pulls it to 0 in every step; letting "
        f"each model keep its own lowers the MSE by {gain('IMM-EKF')} (EKF) and {gain('IMM-UKF')} (UKF).",
    ]


def figure(where: Path, seed: int) -> Path:
    """One run: the path, and the probability of the turn model."""
    states = path()
    run = draw(jnp.asarray(states), jax.random.key(seed))
    bank = filters()
    fig, axes = plt.subplots(1, 2, figsize=(11, 4.5), constrained_layout=True)
    axes[0].plot(*run.ys.T, ".", color="0.7", ms=3, label="measured")
    axes[0].plot(*states[:, :2].T, "k", lw=1.5, label="true")
    for color, name in (("tab:red", "KF (CV)"), ("tab:blue", "IMM-EKF, zero"), ("tab:green", "IMM-EKF, own")):
        out = jf.filter(bank[name], run.ys)
        axes[0].plot(*out.mean[:, :2].T, color=color, lw=1.2, label=name)
        if "mode_probabilities" in out.extra:
            axes[1].plot(DT * np.arange(T), out.extra["mode_probabilities"][:, 1], color=color, label=name)
    for first in (40, 110):
        axes[1].axvspan(DT * first, DT * (first + 49), color="0.9")
    axes[0].set(xlabel="x", ylabel="y", aspect="equal", title="one run")
    axes[1].set(xlabel="time [s]", ylabel="probability of the turn model", title="true turns shaded", ylim=(0, 1))
    axes[0].legend(fontsize=8)
    axes[1].legend(fontsize=8)
    fig.savefig(where, dpi=120)
    plt.close(fig)
    return where


def run(options: Options) -> Report:
    """The whole experiment."""
    result = simulate(options.count(1000, 200), options.seed)
    report = Report("turn", TITLE, [table(result)])
    report.findings = findings(result)
    report.figures = [figure(options.directory("turn") / "turn.png", options.seed)]
    return report
