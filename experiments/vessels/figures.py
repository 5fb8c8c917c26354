"""Figures of the vessels."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.lost_target.flight_figures import DPI
from experiments.vessels.tracks import NAIVE, Estimate, Rows

COLORS = {"CV": "tab:red", "CT": "tab:orange", "IMM (CV, CT)": "tab:blue", NAIVE[1]: "0.6"}


def draw_gap(path: Path, gaps: Rows, i: int, found: Mapping[str, Estimate]) -> Path:
    """One gap: the track from above, the distance from the hidden reports, and the speed against SOG."""
    seen, hidden = gaps.mask[i], gaps.hidden[i]
    used = seen | hidden
    t = np.cumsum(gaps.dt[i])
    lost = np.flatnonzero(hidden)[0] - 1
    t -= t[lost]
    figure = Figure(figsize=(12, 6.5), layout="constrained")
    axes = figure.subplot_mosaic([["track", "speed"], ["track", "error"]], width_ratios=[1.0, 1.1])
    track = axes["track"]
    track.plot(*gaps.ys[i, seen].T, "k.-", lw=0.5, ms=4, label="reports")
    track.plot(*gaps.ys[i, hidden].T, "o", color="0.4", mfc="none", ms=5, label="hidden reports")
    through = np.flatnonzero(used & (t >= 0))
    axes["speed"].plot(t[used], np.hypot(*gaps.velocity[i, used].T), "k.", ms=4, label="SOG, held out")
    for name, out in found.items():
        style = {"color": COLORS[name], "lw": 1.0 if name in NAIVE else 1.7, "label": name}
        track.plot(*out.position[i, through].T, **style)
        axes["speed"].plot(t[used], np.hypot(*out.velocity[i, used].T), zorder=1 if name in NAIVE else 2, **style)
        axes["error"].plot(t[through], np.hypot(*(out.position[i, through] - gaps.ys[i, through]).T), **style)
    shown = np.concatenate([gaps.ys[i, used], *(out.position[i, through] for out in found.values())])
    middle, reach = (shown.min(axis=0) + shown.max(axis=0)) / 2, 0.55 * np.ptp(shown, axis=0).max()
    title = f"vessel {gaps.vessel[i]}, a gap of {gaps.length[i]:g} s"
    track.set(aspect="equal", xlabel="east [m]", ylabel="north [m]", title=title)
    track.set(xlim=(middle[0] - reach, middle[0] + reach), ylim=(middle[1] - reach, middle[1] + reach))
    top = 1.4 * np.hypot(*gaps.velocity[i, used].T).max()
    axes["speed"].set(xlabel="time since the last report [s]", ylabel="speed [m/s]", ylim=(0, top))
    axes["error"].set(xlabel="time since the last report [s]", ylabel="distance from the report [m]")
    axes["speed"].axvspan(0.0, float(t[gaps.last[i]]), color="0.92", zorder=0)
    for ax in axes.values():
        ax.legend(fontsize=9)
    figure.savefig(path, dpi=DPI)
    return path
