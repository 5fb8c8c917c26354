"""Figures: tracks, errors against the bound, starts, and the camera's tracks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import matplotlib
import numpy as np

import jaxfilt as jf
from experiments.bearing_frequency.filters import MAKERS
from experiments.bearing_frequency.scenarios import SCENARIOS, STEPS, model
from experiments.radar.scans import truth

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COLORS = ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple")


def _mean(state: Any, info: jf.Info) -> Any:
    del state
    return info.mean


def tracks(where: Path, paths: Any, runs: Any, names: tuple[str, ...]) -> Path:
    """The first run of each scenario: target, observer and estimates."""
    fig, axes = plt.subplots(1, 3, figsize=(14, 5), constrained_layout=True)
    for i, ax in enumerate(axes):
        own, target = np.asarray(paths.observer[i]) / 1e3, np.asarray(paths.target[i]) / 1e3
        ax.plot(*own[:, :2].T, "0.5", lw=2, label="observer")
        ax.plot(*target[:, :2].T, "k", lw=2, label="target")
        ax.plot(*own[0, :2], "o", color="0.5")
        ax.plot(*target[0, :2], "ko")
        run = jax.tree.map(lambda x: x[i, 0], runs)  # noqa: B023
        for color, name in zip(COLORS, names, strict=False):
            filt = MAKERS[name](model(run.m0, run.P0))
            mean = np.asarray(jf.filter(filt, run.ys, u=paths.observer[i, 1:], outputs=_mean)) / 1e3
            ax.plot(*mean[:, :2].T, color=color, lw=1, label=name)
        ax.set(xlabel="east [km]", ylabel="north [km]", title=f"{i + 1}: {SCENARIOS[i]}", aspect="equal")
    axes[0].legend(fontsize=8)
    fig.savefig(where, dpi=110)
    plt.close(fig)
    return where


def errors(where: Path, variance: dict[str, np.ndarray], outs: dict[str, Any]) -> Path:
    """RMSE over time against the bound."""
    shown = {"position": "m", "course": "deg", "base frequency": "Hz"}
    fig, axes = plt.subplots(3, 3, figsize=(13, 9), sharex=True, constrained_layout=True)
    t = np.arange(1, STEPS + 1)
    for row, (name, unit) in zip(axes, shown.items(), strict=True):
        for i, ax in enumerate(row):
            for color, (label, out) in zip(COLORS, outs.items(), strict=False):
                ax.semilogy(t, np.sqrt(out.curves[name][i]), color=color, lw=1, label=label)
            ax.semilogy(t, np.sqrt(variance[name][i]), "k--", lw=1.5, label="bound")
            ax.axvline(1000, color="0.8", lw=1, zorder=0)
            ax.grid(alpha=0.3)
            ax.set_ylabel(f"{name} [{unit}]")
    for i, ax in enumerate(axes[0]):
        ax.set_title(f"{i + 1}: {SCENARIOS[i]}")
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    axes[0, 0].legend(fontsize=8)
    fig.savefig(where, dpi=110)
    plt.close(fig)
    return where


def starts(where: Path, studies: list[Any], ga: dict[str, np.ndarray]) -> Path:
    """Batch ML against its bound, and the GA's errors by search box."""
    fig, axes = plt.subplots(1, 2, figsize=(11, 4.2), constrained_layout=True)
    lengths = [s.length for s in studies]
    for i, name in enumerate(SCENARIOS):
        rms = [np.sqrt((s.errors[i] ** 2).mean()) for s in studies]
        axes[0].semilogy(lengths, rms, "o-", color=COLORS[i], label=f"{name}: ML")
        axes[0].semilogy(lengths, [s.bound[i] for s in studies], "x--", color=COLORS[i], label=f"{name}: bound")
    axes[0].axhline(1000, color="0.7", lw=1)
    axes[0].set(xlabel="data used [s]", ylabel="rms error of the start [m]", title="maximum likelihood")
    axes[0].legend(fontsize=8)
    for color, (name, e) in zip(COLORS, ga.items(), strict=False):
        sorted_ = np.sort(e.ravel())
        axes[1].step(sorted_ / 1e3, np.arange(1, e.size + 1) / e.size, color=color, label=f"box {name}")
    axes[1].axvline(1, color="0.7", lw=1)
    axes[1].set(xlabel="error of the start [km]", ylabel="share of the draws", title="GA on the first residual")
    axes[1].legend(fontsize=8)
    fig.savefig(where, dpi=110)
    plt.close(fig)
    return where


def camera(where: Path, study: Any) -> Path:
    """Bearings with the boats' true ones, and one track on the map."""
    scans = study.scans
    fig, axes = plt.subplots(1, 2, figsize=(13, 5), constrained_layout=True)
    t = np.repeat(scans.t[:, None], scans.bearing.shape[1], axis=1)[scans.valid]
    axes[0].plot(t, np.degrees(scans.bearing[scans.valid]), ".", color="0.7", ms=2, label="detections")
    boats = truth("04", scans.t)
    begin = study.example_begin
    for number, color in enumerate(("tab:blue", "tab:orange")):
        away = boats[:, number] - scans.own
        axes[0].plot(scans.t, np.degrees(np.arctan2(away[:, 1], away[:, 0])), color=color, label=f"boat {number + 1}")
        axes[1].plot(*boats[begin:, number].T, color=color, lw=2, label=f"boat {number + 1}")
    axes[1].plot(*scans.own[begin:].T, "0.5", lw=2, label="ferry")
    length = len(scans.t) - 1 - begin
    for style, (name, mean) in zip(("-", "--", ":"), study.example.items(), strict=False):
        axes[1].plot(*mean[:length, :2].T, "k" + style, lw=1, label=f"{name}, from the ray")
    axes[0].set(xlabel="time [s]", ylabel="bearing from east [deg]", title="camera detections and true bearings")
    axes[1].set(xlabel="east [m]", ylabel="north [m]", title="one track", aspect="equal")
    for ax in axes:
        ax.legend(fontsize=8)
    fig.savefig(where, dpi=110)
    plt.close(fig)
    return where
