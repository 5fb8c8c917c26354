"""Figures of the experiment."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COLORS = {
    "nominal, zero_mean": "tab:red",
    "adaptive 5, zero_mean": "tab:blue",
    "nominal, exact": "tab:orange",
    "adaptive 5, exact": "tab:cyan",
    "nominal, posterior": "tab:pink",
    "adaptive 5, posterior": "tab:purple",
    "open": "0.5",
    "hold": "tab:olive",
    "kf_flag": "tab:brown",
    "kf_ts": "tab:green",
}


def one_run(
    path: Path, t: np.ndarray, truth: np.ndarray, y: np.ndarray, arrived: np.ndarray, paths: Mapping[str, np.ndarray]
) -> Path:
    """h, h' and the command's error of one run, as the paper's figures 5 to 7; ``paths`` (T, 3)."""
    fig, axes = plt.subplots(1, 3, figsize=(15, 4.6), constrained_layout=True)
    axes[0].plot(t, truth[:, 0], "k", lw=2, label="true")
    axes[1].plot(t, truth[:, 1], "k", lw=2, label="true")
    axes[0].plot(t[arrived], y[arrived], ".", color="0.4", ms=6, label="received (maybe late)")
    axes[0].plot(t[~arrived], y[~arrived], "x", color="0.4", ms=6, label="nothing arrived (0)")
    for name, values in paths.items():
        for ax, column in zip(axes, values.T, strict=True):
            ax.plot(t, column, color=COLORS[name], lw=1.4, label=name)
    titles = ("estimate of h (figure 5)", "estimate of h' (figure 6)", "error of the command from it (figure 7)")
    for ax, label, title in zip(axes, ("h [m]", "h' [m/s]", "command error [m/s²]"), titles, strict=True):
        ax.set(xlabel="time [s]", ylabel=label, title=title)
        ax.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    return _save(fig, path)


def over_time(path: Path, t: np.ndarray, courses: Mapping[str, Mapping[str, np.ndarray]]) -> Path:
    """MSE of h at each sample, a panel for each direction."""
    fig, axes = plt.subplots(1, len(courses), figsize=(12, 4.6), sharey=True, constrained_layout=True, squeeze=False)
    for ax, (direction, own) in zip(axes[0], courses.items(), strict=True):
        for name, values in own.items():
            ax.semilogy(t, values, color=COLORS[name], lw=1.5, label=name)
        ax.set(xlabel="time [s]", title=f"{direction} probabilities")
        ax.grid(alpha=0.3, which="both")
    axes[0, 0].set_ylabel("mean squared error of h [m²]")
    axes[0, 0].legend(fontsize=8)
    return _save(fig, path)


def loops(path: Path, t: np.ndarray, runs: Mapping[str, Any], true: str) -> Path:
    """h and the command of one run of each loop; a symmetric logarithmic axis, since they differ by decades."""
    fig, axes = plt.subplots(1, 2, figsize=(13, 4.8), constrained_layout=True)
    for name, loop in runs.items():
        color, width = ("k", 2.5) if name == true else (COLORS.get(name, "0.7"), 1.3)
        axes[0].plot(t, loop.h, color=color, lw=width, label=name)
        axes[1].plot(t, loop.command, color=color, lw=width)
    axes[0].set(xlabel="time [s]", ylabel="h [m]", title="distance from the line of sight")
    axes[0].set_yscale("symlog", linthresh=1.0)
    axes[1].set(xlabel="time [s]", ylabel="command [m/s²]", title="command")
    axes[1].set_yscale("symlog", linthresh=100.0)
    for ax in axes:
        ax.grid(alpha=0.3)
    fig.legend(fontsize=8, ncols=8, loc="outside upper center")
    return _save(fig, path)


def burst_histogram(path: Path, lengths: np.ndarray, learnt: float, packets: int) -> Path:
    """Runs of late or lost packets, beside those of independent ones: with the learnt share, and with the recorded."""
    edges = np.array([1, 2, 3, 4, 5, 9, 17, 33, 65, 129, 257])
    counts, _ = np.histogram(lengths, edges)
    shares = {"independent, learnt share (expected)": learnt, "independent, recorded share": lengths.sum() / packets}
    labels = [f"{a}" if b == a + 1 else f"{a}-{b - 1}" for a, b in itertools.pairwise(edges)]
    fig, ax = plt.subplots(figsize=(8.5, 4.4), constrained_layout=True)
    x = np.arange(len(counts))
    ax.bar(x - 0.27, counts, 0.27, color="tab:blue", label="recorded")
    for place, (name, b), color in zip((0.0, 0.27), shares.items(), ("tab:orange", "0.6"), strict=True):
        # packets (1-b)^2 b^l runs of length l, summed over each bin
        expected = packets * (1 - b) * (b ** edges[:-1] - b ** edges[1:])
        ax.bar(x + place, expected, 0.27, color=color, label=f"{name}: {100 * b:.0f} %")
    ax.set(yscale="log", ylim=(0.3, packets / 2), xticks=x, xlabel="packets in a row late or lost")
    ax.set_ylabel("number of runs")
    ax.set_xticklabels(labels)
    ax.grid(alpha=0.3, axis="y")
    ax.legend(fontsize=9)
    return _save(fig, path)


def network_course(
    path: Path, t: np.ndarray, errors: Mapping[str, np.ndarray], connected: np.ndarray, scored: np.ndarray
) -> Path:
    """Position errors over the scored part of the recording that was learnt on; stalls shaded."""
    fig, ax = plt.subplots(figsize=(11, 5.2), constrained_layout=True)
    t, connected = t[scored], connected[scored]
    ax.fill_between(t, 0, 1, where=~connected, color="0.88", transform=ax.get_xaxis_transform(), label="stalled")
    for name in [name for name in errors if name in COLORS]:
        ax.semilogy(t, np.maximum(errors[name][scored], 1e-2), color=COLORS[name], lw=1.2, label=name)
    ax.set(xlabel="time [s]", ylabel="position error [m]", xlim=(t[0], t[-1]))
    ax.grid(alpha=0.3, which="both")
    fig.legend(fontsize=8, ncols=5, loc="outside upper center")
    return _save(fig, path)


def _save(fig: Any, path: Path) -> Path:
    fig.savefig(path, dpi=110)
    plt.close(fig)
    return path
