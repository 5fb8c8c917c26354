"""Figures: class posterior over time, errors over time, one run's path."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np

from experiments.joint_tracking import system
from experiments.joint_tracking.runs import POSITION, VELOCITY, Outcome

matplotlib.use("Agg")
import matplotlib.pyplot as plt

SHOWN = {
    "single, floor 0.5": "tab:blue", "multi-filter, 2 x 5000": "tab:orange", "IMM bank": "tab:green",
    "printed recursion": "tab:red",
}  # fmt: skip
Outcomes = Mapping[str, Outcome]


def _times(out: Outcome) -> np.ndarray:
    return out.dt * np.arange(1, out.p.shape[1] + 1)


def _shade(axis, label: int) -> None:
    """Shades the manoeuvres."""
    at = 0.0
    for seconds, accel, omega in system.PATHS[label]:
        if accel or omega:
            axis.axvspan(at, at + seconds, color="0.92", zorder=0)
        at += seconds


def posterior(outcomes: tuple[Outcomes, Outcomes], where: Path) -> Path:
    """Probability of the true class: median, and what 80 % of the runs lie within."""
    fig, axes = plt.subplots(2, len(SHOWN), figsize=(13, 6), sharex=True, sharey=True, constrained_layout=True)
    for label in (0, 1):
        for axis, (name, color) in zip(axes[label], SHOWN.items(), strict=True):
            _shade(axis, label)
            out = outcomes[label].get(name)
            if out is None:
                axis.set_axis_off()
                continue
            low, middle, high = np.quantile(out.p, [0.1, 0.5, 0.9], axis=0)
            axis.fill_between(_times(out), low, high, color=color, alpha=0.3, lw=0, label="10 % to 90 % of runs")
            axis.plot(_times(out), middle, color=color, label="median")
            axis.plot(_times(out), out.p.mean(axis=0), "k:", lw=1, label="mean")
            axis.set(title=f"{name}\ntruth: class {label + 1}", ylim=(-0.02, 1.02))
    for axis in axes[1]:
        axis.set_xlabel("time [s]")
    for row in axes:
        row[0].set_ylabel("probability of the true class")
    axes[0, 0].legend(fontsize=8, loc="center right")
    return _save(fig, where)


def errors(outcomes: tuple[Outcomes, Outcomes], where: Path) -> Path:
    """RMSE over runs by time."""
    fig, axes = plt.subplots(2, 2, figsize=(11, 7), sharex=True, constrained_layout=True)
    shown = {**SHOWN, "single, floor 0.1": "tab:purple"}
    shown.pop("printed recursion")
    for label in (0, 1):
        for axis, part, unit in zip(axes[:, label], (POSITION, VELOCITY), ("m", "m/s"), strict=True):
            _shade(axis, label)
            for name, color in shown.items():
                if name in outcomes[label]:
                    out = outcomes[label][name]
                    rms = np.sqrt(out.square(part).mean(axis=0))
                    axis.plot(_times(out), rms, color=color, lw=1.2, label=name)
            axis.set(yscale="log", ylabel=f"{'position' if part is POSITION else 'velocity'} RMSE [{unit}]")
        axes[0, label].set_title(f"truth: class {label + 1}, {system.CLASSES[label]}; manoeuvres shaded")
        axes[1, label].set_xlabel("time [s]")
    axes[0, 0].legend(fontsize=8)
    return _save(fig, where)


def path(outcomes: tuple[Outcomes, Outcomes], data: tuple[system.Data, system.Data], where: Path) -> Path:
    """The first run of each class."""
    fig, axes = plt.subplots(1, 2, figsize=(12, 4.5), constrained_layout=True)
    for label, axis in enumerate(axes):
        z = np.asarray(data[label].ys[0])
        axis.plot(z[:, 0] * np.cos(z[:, 1]) / 1e3, z[:, 0] * np.sin(z[:, 1]) / 1e3, ".", color="0.7", ms=3,
                  label="measured")  # fmt: skip
        axis.plot(*np.asarray(data[label].truth)[:, :2].T / 1e3, "k", lw=1, label="true")
        for name, color in SHOWN.items():
            if name in outcomes[label]:
                axis.plot(*outcomes[label][name].mean[0, :, :2].T / 1e3, color=color, lw=1, label=name)
        axis.set(xlabel="x [km]", ylabel="y [km]", title=f"one run, class {label + 1}", aspect="equal")
    axes[0].legend(fontsize=8)
    return _save(fig, where)


def _save(fig, where: Path) -> Path:
    fig.savefig(where, dpi=110)
    plt.close(fig)
    return where
