"""Figures of the sine (G3) and of the turn (G4)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter

import jaxfilt as jf
from experiments.report import Cell

DPI = 120
SINE = {
    "EKF, no gap": ("0.6", "-"),
    "EKF coast": ("black", "-"),
    "EKF hold": ("tab:red", "--"),
    "EKF mean 5": ("tab:orange", "--"),
    "EKF fit N20 p2": ("tab:cyan", "--"),
    "EKF fit sinusoid N50": ("tab:blue", "-"),
    "EKF2 coast": ("tab:green", ":"),
    "UKF coast": ("tab:olive", "-"),
    "EKF coast_inflated x10": ("tab:pink", ":"),
    "EKF coast, Q = 0 in the gap": ("tab:brown", ":"),
}
TURN = {
    "coast, zero": ("0.5", "-", "s"),
    "coast, own": ("black", "-", "o"),
    "hold, zero": ("tab:red", "--", "v"),
    "mean 5, zero": ("tab:orange", "--", "^"),
    "fit N10 p1, zero": ("tab:blue", "-", "D"),
    "fit N5 p1, zero": ("tab:cyan", "-", "d"),
    "fit N10 p2, zero": ("tab:purple", ":", "P"),
    "fit_weighted N5 p1, zero": ("tab:pink", ":", "X"),
    "fit N10 p1, own": ("tab:green", "-.", "*"),
}
LABELS = {  # where each gap's name stands beside the path
    "A straight": (2.6, 0.3),
    "B onset": (4.5, -0.22),
    "C onset + 5": (5.0, 0.05),
    "D turn": (5.1, 1.75),
    "E turn": (4.9, 2.2),
    "F exit": (2.8, 0.5),
    "G onset 2": (3.9, -1.5),
    "H turn 2": (1.5, -2.2),
    "onset + 10": (5.3, 0.7),
    "straight 2": (5.1, -0.9),
}
SHOWN = ("C onset + 5", "E turn")  # the gaps whose course is drawn


def sine(
    dt: float,
    gap: tuple[int, int],
    courses: Mapping[float, Mapping[str, np.ndarray]],
    lost: Mapping[float, Mapping[str, Cell]],
    path: Path,
) -> Path:
    """RMSE of sin(theta) over time and the share of runs that lose lock.

    Args:
        dt: sampling interval [s].
        gap: first and last lost sample.
        courses: per variance and strategy the mean squared error (T,).
        lost: per variance and strategy, in per cent.
        path: where to write.
    """
    figure = Figure(figsize=(14, 5.2), layout="constrained")
    axes = figure.subplots(1, len(courses) + 1)
    for ax, (r, course) in zip(axes, courses.items(), strict=False):
        ax.axvspan(dt * gap[0], dt * gap[1], color="0.92", label="no measurements")
        for name, (color, line) in SINE.items():
            if name in course:
                ax.plot(dt * np.arange(len(course[name])), np.sqrt(course[name]), line, color=color, lw=1.5, label=name)
        ax.set(title=f"R = {r:g}", xlabel="time [s]")
        _log_scale(ax, "RMSE of sin(theta)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False, fontsize=9)
    names = [name for name in SINE if all(name in shares for shares in lost.values())]
    ax = axes[-1]
    for i, (r, shares) in enumerate(lost.items()):
        values = np.array([[float(shares[name].value), float(shares[name].se or 0)] for name in names])
        y = np.arange(len(names)) + 0.2 * (2 * i - 1)
        ax.barh(y, values[:, 0], 0.36, xerr=values[:, 1], color=("0.35", "tab:blue")[i % 2], label=f"R = {r:g}")
    ax.set_yticks(np.arange(len(names)), names, fontsize=8)
    ax.invert_yaxis()
    ax.set(xscale="log", xlim=(0.5, 130), xlabel="runs that lost lock [%]", title="lost lock, one standard error")
    ax.grid(axis="x", alpha=0.3)
    ax.legend(fontsize=8, loc="lower right")
    figure.savefig(path, dpi=DPI)
    return path


def turn(
    states: np.ndarray,
    gaps: Mapping[str, tuple[int, int]],
    results: Mapping[tuple[float, str], jf.MonteCarloResult],
    courses: Mapping[tuple[float, str], Mapping[str, np.ndarray]],
    path: Path,
) -> Path:
    """The path with its gaps, RMSE in each gap, and RMSE over time through two of them.

    Args:
        states: (T, 4) the true path.
        gaps: first and last lost sample by name.
        results: per variance and gap.
        courses: per variance and gap, by strategy the mean squared distance (T,).
        path: where to write.
    """
    noise = list(dict.fromkeys(r for r, _ in results))
    names = list(dict.fromkeys(gap for _, gap in results))
    figure = Figure(figsize=(15, 12), layout="constrained")
    grid = figure.add_gridspec(3, 2 * len(SHOWN), height_ratios=[1.3, 1.1, 1.0])
    _draw_path(figure.add_subplot(grid[0, :]), states, gaps)
    for i, r in enumerate(noise):
        ax = figure.add_subplot(grid[1, 2 * i : 2 * i + 2])
        _draw_errors(ax, r, names, results)
        for j, gap in enumerate(SHOWN):
            ax = figure.add_subplot(grid[2, 2 * i + j])
            _draw_course(ax, r, gap, gaps[gap], courses[r, gap])
    labels = {}
    for ax in figure.axes[1:]:
        labels.update(dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True)))
    figure.legend(labels.values(), labels.keys(), loc="outside lower center", ncols=5, frameon=False)
    figure.savefig(path, dpi=DPI)
    return path


def _draw_path(ax, states, gaps):
    x, y = states[:, :2].T
    ax.plot(x, y, color="0.6", lw=1.5)
    for i, (name, (first, last)) in enumerate(gaps.items()):
        lost, color = slice(first, last + 1), f"C{i % 10}"
        ax.plot(x[lost], y[lost], ".", ms=5 if last - first > 5 else 10, color=color)
        k, label = (first + last) // 2, LABELS[name]
        ha = "left" if label[0] > x[k] else "right"
        style = {"fontsize": 8, "color": color, "ha": ha, "va": "center", "arrowprops": {"arrowstyle": "-", "lw": 0.5}}
        ax.annotate(f"{name}, {first} to {last}", (x[k], y[k]), label, **style)
    ax.set(
        aspect="equal",
        xlabel="x (1 = what the target covers in 1 s)",
        ylabel="y",
        title="path and lost samples",
        ylim=(-2.8, 2.5),
    )


def _log_scale(ax, label):
    """A logarithmic axis with labels at 1, 2 and 5, which a range of less than a decade needs."""
    ax.set(yscale="log", ylabel=label)
    ax.yaxis.set_major_locator(FixedLocator([a * 10.0**n for n in range(-3, 2) for a in (1, 2, 5)]))
    ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.grid(axis="y", alpha=0.3)


def _draw_errors(ax, r, names, results):
    for i, (label, (color, _, marker)) in enumerate(TURN.items()):
        if all(label in results[r, gap].scores for gap in names):
            found = [results[r, gap].root_mean(label, "gap") for gap in names]
            x = np.arange(len(names)) + 0.07 * (i - len(TURN) / 2)
            value, se = (np.array([float(part) for part in parts]) for parts in zip(*found, strict=True))
            ax.errorbar(x, value, se, fmt=marker, color=color, ms=5, label=label)
    ax.set_xticks(np.arange(len(names)), names, rotation=20, ha="right", fontsize=8)
    ax.set(title=f"R = {r:g}")
    _log_scale(ax, "RMSE in the gap")


def _draw_course(ax, r, name, gap, course):
    k = np.arange(max(gap[0] - 10, 0), gap[1] + 21)
    ax.axvspan(*gap, color="0.92")
    for label, (color, line, _) in TURN.items():
        if label in course:
            ax.plot(k, np.sqrt(course[label][k]), line, color=color, lw=1.4)
    ax.set(xlabel="sample", title=f"{name}, R = {r:g}")
    _log_scale(ax, "RMSE")
