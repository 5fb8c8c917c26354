"""Figures of the attitude experiment."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

import jaxfilt as jf
from experiments.attitude import recorded, synthetic
from experiments.attitude.scenarios import DT
from experiments.attitude.synthetic import TABLE_1, TESTS, Scores

COLORS = {"kappa = 0": "tab:red", "paper": "tab:orange", "velocity (V)": "tab:blue", "VQF": "tab:green"}


def kappas(swept: Mapping[float, Scores], where: Path) -> Path:
    """Tilt by kappa, with the paper's values."""
    fig, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    shown = [k for k in swept if k > 0]
    for i, (ax, test) in enumerate(zip(axes, TESTS, strict=True)):
        for j, (part, color) in enumerate((("pitch", "tab:blue"), ("roll", "tab:orange"))):
            ours = [jf.metrics.root_mean(getattr(swept[k].of(test), part)) for k in shown]
            value, error = (np.array([float(getattr(e, f)) for e in ours]) for f in ("value", "standard_error"))
            ax.errorbar(shown, value, error, color=color, marker="o", capsize=3, label=f"{part}, ours")
            ax.plot(shown, [TABLE_1[k][3 * i + j] for k in shown], "x--", color=color, label=f"{part}, paper")
        ax.set(xscale="log", yscale="log", xlabel="kappa", ylabel="RMSE [deg]", title=f"test {test}")
        ax.grid(True, which="both", alpha=0.3)
        ax.legend(fontsize=8)
    return _save(fig, where / "attitude_kappa.png")


def one_run(runs: synthetic.Runs, where: Path) -> Path:
    """A part of one run of test B: external acceleration, and the tilt errors."""
    k = slice(round(48 / DT), round(76 / DT))
    i = len(runs.gyr) // 2
    gyr, acc, axis = (x[i : i + 1] for x in (runs.gyr, runs.acc, runs.axis))
    chosen = {
        "kappa = 0": jf.attitude(dt=DT, kappa=0.0, prop="euler"),
        "paper": jf.attitude(dt=DT, kappa=0.1, prop="euler"),
        "velocity (V)": jf.attitude_velocity(dt=DT, velocity_var=0.1, bias_q=1e-8),
    }
    axes_of = {name: synthetic.estimate(filt, gyr, acc)[0] for name, filt in chosen.items()}
    axes_of["VQF"] = jnp.asarray(synthetic.vqf(gyr, acc, DT))
    t = DT * np.arange(acc.shape[1])[k]
    fig, (top, bottom) = plt.subplots(2, 1, figsize=(11, 6), layout="constrained", sharex=True)
    a = np.asarray(acc - synthetic.G * axis)[0, k]
    for j, name in enumerate("xyz"):
        top.plot(t, a[:, j], lw=0.8, label=name)
    top.set(ylabel="external acceleration [m/s²]", title="test B, one run: two linear bursts and a zigzag")
    for name, Z in axes_of.items():
        error = np.rad2deg(np.asarray(jf.metrics.tilt_error(Z, axis)))[0, k]
        bottom.plot(t, error, lw=1, color=COLORS[name], label=name)
    bottom.set(xlabel="time [s]", ylabel="tilt error [deg]", yscale="log", ylim=(0.01, 20))
    for ax in (top, bottom):
        ax.grid(True, alpha=0.3)
        ax.legend(fontsize=8, ncols=4)
    return _save(fig, where / "attitude_run.png")


def trials(found: Mapping[str, np.ndarray], draws: Mapping[str, np.ndarray], where: Path) -> Path:
    """RMSEs of the recorded trials, and the course of the error in one of them."""
    fig, (left, right) = plt.subplots(1, 2, figsize=(12, 4.6), layout="constrained", width_ratios=(3, 2))
    t = recorded.DT * np.arange(found["VQF"].shape[1])
    names = {"EKF, kappa = 0": "kappa = 0", "paper": "paper", "velocity (V)": "velocity (V)", "VQF": "VQF"}
    for name, short in names.items():
        if name in found:
            error = found[name][0]
            left.plot(t, np.where(error > 0, error, np.nan), lw=0.7, color=COLORS[short], label=name)
    left.set(xlabel="time [s]", ylabel="tilt error [deg]", yscale="log", title=next(iter(recorded.TRIALS)))
    left.grid(True, alpha=0.3)
    left.legend(fontsize=8)
    shown = [name for name in draws if name != "static tilt"]
    for i, name in enumerate(shown):
        right.plot(draws[name][:, 0], np.full(len(recorded.TRIALS), -i), ".", color="0.5", ms=8)
        mean = draws[name].mean(axis=0)
        right.errorbar(mean[0], -i, xerr=mean[1:].std(), fmt="|", color="black", ms=12, capsize=3)
    labels = [name.replace(", parameters", ",\nparameters") for name in shown]
    right.set_yticks([-i for i in range(len(shown))], labels, fontsize=8)
    right.set(xscale="log", xlabel="RMSE of the tilt [deg]: trials (dots), mean (bar)")
    right.grid(True, which="both", axis="x", alpha=0.3)
    return _save(fig, where / "attitude_trials.png")


def _save(fig, path: Path) -> Path:
    fig.savefig(path, dpi=120)
    plt.close(fig)
    return path
