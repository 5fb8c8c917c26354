"""Figure: the scenarios from above, with what the radar sees and the tracks from the first two scans."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from experiments.radar.scans import SCENARIOS, load, truth

matplotlib.use("Agg")
import matplotlib.pyplot as plt

STYLES = {"CV": ("tab:blue", "-"), "IMM (CV, CT)": ("tab:red", "--")}


def maps(o: Any, path: Path) -> Path:
    """``o`` is the experiment's Outcome."""
    fig, axes = plt.subplots(2, 2, figsize=(12, 10.5), constrained_layout=True)
    tracks = o.tracks["radar"]
    for i, (ax, name) in enumerate(zip(axes.flat, SCENARIOS, strict=True)):
        scans = load(name, ("radar",))
        true = truth(name, scans.t)
        ax.plot(*scans.position[scans.valid].T, ".", color="0.6", ms=3, label="radar detections")
        ax.plot(*scans.own.T, color="tab:green", lw=2, label="own ship")
        for boat in (0, 1):
            ax.plot(*true[:, boat].T, "k", lw=1, label="true" if boat == 0 else None)
            ax.annotate(f"{boat + 1}", true[np.isfinite(true[:, boat, 0]), boat][0], fontsize=11)
        for model, (color, style) in STYLES.items():
            label = f"{model}, from the first two scans"
            for k in o.first[model]:
                if tracks.scenario[k] == i:
                    route = np.asarray(o.found["radar", model].position)[k][tracks.mask[k]]
                    ax.plot(*route.T, style, color=color, lw=1.3, label=label)
                    label = None
        around = np.concatenate([true.reshape(-1, 2), scans.own])
        low, high = np.nanmin(around, axis=0) - 60, np.nanmax(around, axis=0) + 60
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", title=f"scenario {name}",
               xlabel="east [m]", ylabel="north [m]")  # fmt: skip
    handles = {label: handle for ax in axes.flat for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    fig.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=5, fontsize=9)
    fig.savefig(path, dpi=110)
    plt.close(fig)
    return path
