"""The figures of the linear examples, of the rig, and of the tuning."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from experiments.homotopy_control import filtered, ltv, siso
from experiments.homotopy_control.loop import Course, steps_of
from experiments.homotopy_control.tuning import LABELS, Outcome

DPI = 120
COLORS = ("tab:blue", "tab:orange", "tab:green", "tab:red")


def linear(
    courses: Mapping[str, Course],
    gains: Mapping[float, tuple[list[int], list[float], float]],
    weights: Mapping[str, Course],
    path: Path,
) -> Path:
    """Example 1 with its reference, its gain against the number of terms, and Example 2."""  # fmt: skip
    fig, axes = plt.subplots(2, 2, figsize=(11, 7), constrained_layout=True)
    t = siso.DELTA * np.arange(siso.STEPS + 1)
    reference = steps_of(siso.TIMES, siso.VALUES, siso.DELTA, siso.STEPS)
    axes[0, 0].step(t[:-1], reference, "k--", where="post", lw=1, label="reference")
    for color, (name, course) in zip(COLORS, courses.items(), strict=False):
        axes[0, 0].plot(t, siso.C * np.asarray(course.x[:, 0]), color=color, lw=1.3, label=name)
    y, _ = siso.discrete_course()
    axes[0, 0].plot(t, y, color="0.5", ls=":", label="discrete, Δu weighed")
    axes[0, 0].set(xlabel="time [s]", ylabel="y", title="Example 1 (series' own state): output")
    for color, (T, (terms, values, exact)) in zip(COLORS, gains.items(), strict=False):
        axes[0, 1].plot(terms, values, "o-", color=color, label=f"T = {T:g} s")
        axes[0, 1].axhline(exact, color=color, ls=":", lw=1)
    axes[0, 1].set(xlabel="terms of the series", ylabel="u(0)", title="Example 1: first input for x(0) = 2")
    t = ltv.DELTA * np.arange(ltv.STEPS + 1)
    for i, axis in enumerate(axes[1]):
        axis.axhline(ltv.Y_REF[i], color="k", ls="--", lw=1)
        for color, (name, course) in zip(COLORS, weights.items(), strict=False):
            axis.plot(t, ltv.output(np.asarray(course.x))[:, i], color=color, label=f"weights {name}")
        axis.set(xlabel="time [s]", ylabel=f"y{i + 1}", title=f"Example 2: output {i + 1}")
    for axis in axes.flat:
        axis.legend(fontsize=8)
        axis.grid(alpha=0.3)
    return _save(fig, path)


def rig(
    fig5: Mapping[str, Course], fig7: Mapping[float, Course], loops: Mapping[str, filtered.Run], path: Path
) -> Path:
    """Example 3: as published, corrected, and with the filter in the loop under a wrong gravity."""
    fig, axes = plt.subplots(1, 3, figsize=(13, 4), constrained_layout=True)
    for color, (name, course) in zip(COLORS, fig5.items(), strict=False):
        x = np.rad2deg(np.asarray(course.x[:, 0]))
        axes[0].plot(0.05 * np.arange(len(x)), x, color=color, label=name)
    axes[0].axhline(70.0, color="k", ls="--", lw=1)
    axes[0].set(title="60° to 70°, no filter", ylim=(45, 75))
    for color, (h, course) in zip(COLORS, fig7.items(), strict=False):
        x = np.rad2deg(np.asarray(course.x[:, 0]))
        axes[1].plot(0.1 * np.arange(len(x)), x, color=color, label=f"H = {h:g}")
    axes[1].axhline(90.0, color="k", ls="--", lw=1)
    axes[1].set(title="printed controller, 80° to 90°")
    t = filtered.DELTA * np.arange(filtered.STEPS)
    for color, (name, run) in zip(COLORS, loops.items(), strict=False):
        x = np.rad2deg(np.asarray(run.x[..., 0]))
        axes[2].plot(t, x[:20].T, color=color, lw=0.6, alpha=0.5)
        axes[2].plot(t, x.mean(axis=0), color=color, lw=1.5, label=name)
    axes[2].axhline(70.0, color="k", ls="--", lw=1)
    axes[2].set(title="filter in the loop, true gravity 10 % higher")
    for axis, place in zip(axes, ("lower right", "center right", "lower right"), strict=True):
        axis.set(xlabel="time [s]", ylabel="elevation [deg]")
        axis.legend(fontsize=8, loc=place)
        axis.grid(alpha=0.3)
    return _save(fig, path)


def front(outcome: Outcome, path: Path) -> Path:
    """Tracking error against effort on the training set."""
    fig, axis = plt.subplots(figsize=(6, 4.2), constrained_layout=True)
    found = outcome.results["nsga2"].front
    assert found is not None
    losses = found.losses[np.argsort(found.losses[:, 0])]
    axis.plot(losses[:, 0], losses[:, 1], "^-", color="tab:green", label="NSGA-II, front")
    for name, color, marker in (("hand", "k", "x"), ("gradient", "tab:blue", "o"), ("genetic", "tab:orange", "s")):
        error, effort = outcome.scores[name][0]
        axis.plot(error, effort, marker, color=color, ms=7, label=LABELS.get(name, "by hand"))
    axis.set(xlabel="error: 10 ∫e² dt [rad² s]", ylabel="effort: 0.1 ∫(u - û)² dt [s]", title="training set")
    axis.legend(fontsize=8)
    axis.grid(alpha=0.3)
    return _save(fig, path)


def _save(fig, path):
    fig.savefig(path, dpi=DPI)
    plt.close(fig)
    return path
