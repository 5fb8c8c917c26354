"""Figures of circling flight."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.circling.tracks import Estimate
from experiments.lost_target.flight_figures import DPI
from experiments.lost_target.flight_figures import Curve as Curve
from experiments.lost_target.flight_figures import draw_errors as draw_errors
from experiments.lost_target.flight_gaps import Windows

SHOWN_BEFORE = 50.0  # s
COLORS = {"CV": "tab:red", "CT": "tab:orange", "IMM (CV, CT)": "tab:blue"}


def draw_gap(path: Path, windows: Windows, i: int, found: Mapping[str, Estimate], imm: str) -> Path:
    """One window: the track from above, the distance from the fixes, and the probabilities of the IMM's modes."""
    seen, hidden = windows.mask[i], windows.hidden[i]
    used = seen | hidden
    t = np.cumsum(windows.dt[i])
    t -= t[np.flatnonzero(hidden)[0] - 1]  # from the last fix that is seen
    gap = 0.0, float(t[windows.last[i]])
    near = used & (t >= -SHOWN_BEFORE)
    figure = Figure(figsize=(12, 6), layout="constrained")
    axes = figure.subplot_mosaic([["track", "error"], ["track", "modes"]], width_ratios=[1.1, 1.0])
    track = axes["track"]
    before = near & seen & (t <= 0)
    track.plot(*windows.ys[i, before].T, "k.-", lw=0.5, ms=4, label="fixes seen before")
    track.plot(*windows.ys[i, hidden].T, "o", color="0.5", mfc="none", ms=5, label="hidden fixes")
    after = near & seen & (t > 0)
    track.plot(*windows.ys[i, after].T, "kx", ms=4, label="fixes seen after")
    through = np.flatnonzero(used & (t >= 0) & (t <= gap[1]))
    for name, out in found.items():
        track.plot(*out.position[i, through].T, color=COLORS[name], lw=1.8, label=name)
        error = np.hypot(*(out.position[i] - windows.ys[i]).T)
        axes["error"].plot(t[near], error[near], color=COLORS[name], lw=1.5, label=name)
    track.set(aspect="equal", xlabel="east [m]", ylabel="north [m]", title="a gap in circling flight")
    track.legend(fontsize=9)
    axes["error"].set(ylabel="distance from the fix [m]")
    axes["error"].tick_params(labelbottom=False)
    for j, mode in enumerate(("CV", "CT")):
        axes["modes"].plot(t[near], found[imm].probabilities[i, near, j], color=COLORS[mode], label=mode)
    axes["modes"].set(xlabel="time since the last fix [s]", ylabel=f"probability in {imm}", ylim=(-0.02, 1.02))
    for name in ("error", "modes"):
        axes[name].axvspan(*gap, color="0.92", zorder=0)
        axes[name].legend(fontsize=9)
        axes[name].set(xlim=(-SHOWN_BEFORE, t[used].max()))
    figure.savefig(path, dpi=DPI)
    return path
