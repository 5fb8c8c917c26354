"""Figures of the recorded flights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import NullLocator

DPI = 120
COLORS = ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple", "tab:brown", "tab:pink", "tab:olive", "0.4")
MARKERS = "osD^vP*Xd"
STYLES = ("-", (0, (6, 2)), "-.")  # seen where paths coincide


class Path2D(NamedTuple):
    """What a strategy says about a stretch of time."""

    t: np.ndarray  # (T,) s
    position: np.ndarray  # (T, 2) east, north [m]
    cov: np.ndarray  # (T, 2, 2)


class Curve(NamedTuple):
    """An error against the gap's length."""

    value: np.ndarray  # (lengths,)
    error: np.ndarray  # (lengths,)


def draw_dropout(
    path: Path,
    t: np.ndarray,
    fixes: np.ndarray,
    gap: tuple[float, float],
    paths: Mapping[str, Path2D],
    ellipses: Mapping[str, Sequence[float]],
) -> Path:
    """The track about a dropout from above, and east and north against time with bands of two sigmas.

    Args:
        path: where to write.
        t: (N,) time stamps [s] of the fixes about the dropout.
        fixes: (N, 2) east, north [m].
        gap: times of the last fix before it and of the first after it.
        paths: per label, the estimates.
        ellipses: per label, the times at which the track shows two sigmas.
    """
    figure = Figure(figsize=(12, 6), layout="constrained")
    axes = figure.subplot_mosaic([["track", "0"], ["track", "1"]], width_ratios=[1.0, 1.2])
    track = axes["track"]
    inside = {label: (p.t >= gap[0]) & (p.t <= gap[1]) for label, p in paths.items()}
    # The widest bands would leave nothing to see of the flight: they run out of the picture.
    center, reach = 0.5 * (fixes.min(axis=0) + fixes.max(axis=0)), 0.5 * np.ptp(fixes, axis=0).max() + 500.0

    before, after = t <= gap[0], t >= gap[1]
    marks = "\n".join(f"{x} after {', '.join(f'{t - gap[0]:.0f}' for t in times)} s" for x, times in ellipses.items())
    for part in (before, after):
        track.plot(*fixes[part].T, "k.", ms=2.5, label="fixes" if part is before else None)
    track.plot(*fixes[before][-1], "kx", ms=9, mew=2, label="lost")
    track.plot(*fixes[after][0], "k+", ms=11, mew=2, label="found again")
    for color, style, (label, p) in zip(COLORS, STYLES, paths.items(), strict=False):
        track.plot(*p.position[inside[label]].T, color=color, ls=style, lw=1.5, label=label)
        for when in ellipses.get(label, ()):
            k = int(np.argmin(np.abs(p.t - when)))
            track.add_patch(_ellipse(p.position[k], p.cov[k], color))
    track.set(aspect="equal", xlabel="east [m]", ylabel="north [m]")
    track.set_title(f"track, and circles of 2 sigmas\n{marks}", fontsize=10)
    track.set(xlim=(center[0] - reach, center[0] + reach), ylim=(center[1] - reach, center[1] + reach))
    track.legend(loc="best", fontsize=9)

    for axis, name in enumerate(("east", "north")):
        ax = axes[str(axis)]
        ax.axvspan(*gap, color="0.92", zorder=0, label="no fix")
        for color, style, (label, p) in zip(COLORS, STYLES, paths.items(), strict=False):
            sigma = np.sqrt(p.cov[:, axis, axis])
            ax.plot(p.t, p.position[:, axis], color=color, ls=style, lw=1.2, label=label)
            if label in ellipses:
                low, high = p.position[:, axis] - 2 * sigma, p.position[:, axis] + 2 * sigma
                ax.fill_between(p.t, low, high, color=color, alpha=0.2, lw=0)
        ax.plot(t, fixes[:, axis], "k.", ms=2.5)
        ax.set(ylabel=f"{name} [m]", ylim=(center[axis] - 1.2 * reach, center[axis] + 1.2 * reach), xlim=(t[0], t[-1]))
    axes["0"].set(title="against time, with 2-sigma bands")
    axes["0"].tick_params(labelbottom=False)
    axes["1"].set(xlabel="time [s]")
    figure.savefig(path, dpi=DPI)
    return path


def draw_errors(path: Path, lengths: Sequence[int], panels: Mapping[str, Mapping[str, Curve]]) -> Path:
    """Errors in the gap against its length, with bars of one standard error; curves that coincide are drawn as one."""
    figure = Figure(figsize=(6.2 * len(panels), 6.6), layout="constrained")
    labels = list(dict.fromkeys(label.split(" = ")[0] for curves in panels.values() for label in _merge(curves)))
    for ax, (title, curves) in zip(np.ravel(figure.subplots(1, len(panels), sharey=True)), panels.items(), strict=True):
        merged = _merge(curves)
        for i, (label, curve) in enumerate(merged.items()):
            look = labels.index(label.split(" = ")[0])
            # side by side, so that the bars do not cover each other
            x = np.asarray(lengths) * 1.02 ** (i - len(merged) / 2)
            style = {"color": COLORS[look % len(COLORS)], "marker": MARKERS[look % len(MARKERS)], "ms": 5, "lw": 1.2}
            ax.errorbar(x, curve.value, curve.error, capsize=2, label=label, **style)
        ax.set(xscale="log", yscale="log", xlabel="length of the gap [s]", title=title)
        ax.set_xticks(lengths, [str(length) for length in lengths])
        ax.xaxis.set_minor_locator(NullLocator())
        ax.grid(which="both", alpha=0.25)
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.11), fontsize=8, ncols=2)
    figure.axes[0].set_ylabel("horizontal RMSE of the hidden fixes [m]")
    figure.savefig(path, dpi=DPI)
    return path


def _merge(curves: Mapping[str, Curve]) -> dict[str, Curve]:
    groups: list[tuple[list[str], Curve]] = []
    for label, curve in curves.items():
        for labels, first in groups:
            if np.allclose(curve.value, first.value, rtol=0.01):
                labels.append(label)
                break
        else:
            groups.append(([label], curve))
    return {" = ".join(labels): curve for labels, curve in groups}


def _ellipse(center: np.ndarray, cov: np.ndarray, color: str) -> Ellipse:
    variances, directions = np.linalg.eigh(cov)
    angle = float(np.degrees(np.arctan2(directions[1, 1], directions[0, 1])))
    width, height = 4 * np.sqrt(variances[::-1])
    return Ellipse((center[0], center[1]), width, height, angle=angle, fill=False, color=color, lw=1, ls="--")
