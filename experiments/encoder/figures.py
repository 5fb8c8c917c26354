"""The encoder's figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from experiments.encoder import recorded
from experiments.encoder.estimators import ARCTAN, ELLIPSE, OWN, Scores
from experiments.encoder.system import CYCLES, HOLDS, SETTLED, TURN

matplotlib.use("Agg")
import matplotlib.pyplot as plt

PUBLISHED = 0.09  # largest error of the device [deg]
COLORS = {ARCTAN: "0.55", ELLIPSE: "tab:orange", OWN: "tab:blue", "smoothness + radius": "tab:green"}


def errors(where: Path, angle: np.ndarray, estimates: dict[str, np.ndarray]) -> Path:
    """One device: errors over the moves and over the turn; angle (T,) [deg], estimates (T,) [rad, electrical]."""
    fig, axes = plt.subplots(1, 3, figsize=(13, 4), constrained_layout=True, width_ratios=[1, 1, 2])
    for name, theta in estimates.items():
        error = np.rad2deg(theta) / CYCLES - angle
        for axis, (move, points) in zip(axes, sorted(HOLDS.items()), strict=False):
            e = error[points] - error[points[0]]
            axis.plot(angle[points] - angle[points[0]], e, "o-", ms=3, color=COLORS[name], label=name)
            axis.set(xlabel="displacement [deg]", title=f"{move:g}° move, held points")
        e = error[SETTLED:TURN]
        axes[2].plot(angle[SETTLED:TURN], e - e.mean(), lw=0.8, color=COLORS[name], label=name)
    for axis in axes:
        axis.axhspan(-PUBLISHED, PUBLISHED, color="0.93", zorder=0)
        axis.set_ylim(-0.12, 0.12)
    axes[0].set_ylabel("error [deg, mechanical]")
    axes[2].set(xlabel="shaft angle [deg]", title=f"full turn (shaded: the published ±{PUBLISHED:g}°)")
    axes[2].legend(fontsize=8, loc="lower center", ncols=2)
    fig.savefig(where, dpi=120)
    plt.close(fig)
    return where


def distribution(where: Path, scores: Scores, parts: tuple[str, ...]) -> Path:
    """The largest error of each device, sorted, by estimator."""
    fig, axes = plt.subplots(1, len(parts), figsize=(4.3 * len(parts), 3.8), constrained_layout=True, sharey=True)
    for axis, part in zip(axes, parts, strict=True):
        for name in COLORS:
            if f"{part} max" in scores.get(name, {}):
                x = np.sort(scores[name][f"{part} max"])
                axis.step(x, (np.arange(len(x)) + 1) / len(x), where="post", color=COLORS[name], label=name)
        axis.axvline(PUBLISHED, color="k", lw=0.8, ls=":")
        axis.set(xlabel="largest error [deg, mechanical]", title=part, xlim=(0, 0.16), ylim=(0, 1.02))
    axes[0].set_ylabel("share of devices")
    axes[0].legend(fontsize=8, loc="lower right")
    fig.savefig(where, dpi=120)
    plt.close(fig)
    return where


def recording(where: Path, result: Any) -> Path:
    """Errors on the recorded pair against the angle, the delay of the signals taken out."""
    names = (recorded.CALIBRATION, *recorded.SCORED)
    shown = {
        recorded.ATAN2: "0.55", recorded.SUPERVISED: "tab:green", recorded.ELLIPSE: "tab:orange",
        recorded.OWN_WARM: "tab:blue",
    }  # fmt: skip
    fig, axes = plt.subplots(1, 3, figsize=(13, 4), constrained_layout=True, sharey=True)
    for axis, name in zip(axes, names, strict=True):
        angle = np.rad2deg(recorded.load(name).angle)
        for key, color in shown.items():
            axis.plot(angle, result.errors[name][key], lw=0.9, color=color, label=key)
        what = "calibration" if name == recorded.CALIBRATION else "scored"
        axis.set(xlabel="reference angle [deg]", title=f"{name} ({what}), delay removed", ylim=(-13, 13))
    axes[0].set_ylabel("error [deg]")
    axes[0].legend(fontsize=8)
    fig.savefig(where, dpi=120)
    plt.close(fig)
    return where
