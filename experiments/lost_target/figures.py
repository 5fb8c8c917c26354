"""Errors over time through the gap."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import NullFormatter

import jaxfilt as jf

if TYPE_CHECKING:
    from experiments.lost_target.run import Regime

STYLES = {
    "coast": ("black", "-"),
    "hold": ("tab:red", "--"),
    "mean 5": ("tab:orange", "--"),
    "fit N10 p1": ("tab:blue", "-"),
    "fit N20 p2": ("tab:cyan", "-"),
    "fit_weighted N10 p1": ("tab:purple", ":"),
    "fit_weighted N20 p2": ("tab:pink", ":"),
    "blend": ("tab:green", "-"),
    "coast, CA filter": ("gray", "-."),
}
SHOWN = ("g1-matched", "g1-accelerating", "g2-matched", "g2-velocity")


def course(regimes: list[Regime], results: dict[str, jf.MonteCarloResult], path: Path) -> Path:
    """Draws the RMSE of each strategy against time and saves it."""
    shown = [regime for regime in regimes if regime.name in SHOWN]
    fig, axes = plt.subplots(2, 2, figsize=(11, 7.5), constrained_layout=True)
    labels = {}
    for ax, regime in zip(axes.flat, shown, strict=True):
        gap, result = regime.gap, results[regime.name]
        t = gap.dt * np.arange(gap.T)
        ax.axvspan(t[gap.first], t[gap.last], color="0.9", label="no measurements")
        for name, (color, line) in STYLES.items():
            if name in result.scores:
                rmse = np.sqrt(result.scores[name]["course"].mean(axis=0))
                ax.plot(t, rmse, line, color=color, lw=1.6, label=name)
        ax.set(yscale="log", title=regime.title, xlabel="time [s]", ylabel="position RMSE [m]")
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.grid(alpha=0.3, which="both")
        labels.update(dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True)))
    fig.legend(labels.values(), labels.keys(), loc="outside lower center", ncols=5, frameon=False)
    fig.savefig(path, dpi=120)
    plt.close(fig)
    return path
