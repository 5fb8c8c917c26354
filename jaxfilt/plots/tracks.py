"""Paths in the plane."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxfilt.chi2 import chi2_quantile
from jaxfilt.core import check_count
from jaxfilt.metrics.errors import check_components
from jaxfilt.plots import common


def track(
    out: Any,
    *,
    truth: Any = None,
    measurements: Any = None,
    mask: Any = None,
    components: Sequence[int] = (0, 1),
    probability: float = 0.95,
    ellipses: int = 20,
    label: str | None = None,
    unit: str | None = "m",
    ax: Any = None,
) -> Any:
    """An estimated path in the plane with its covariance ellipses; lost samples are marked along it.

    Args:
        out: what :func:`jaxfilt.filter` or :func:`jaxfilt.smooth` returns, of one run.
        truth: (T, n) states as in the estimate, or (T, 2) positions; NaN where it is not known.
        measurements: (T, 2) positions, drawn where the sample is complete; NaN where there is none.
        mask: (T,) or (T, m) bool, True = present; None = what ``out.status`` reports as missed.
        components: where the position stands in the state.
        probability: that a consistent filter's true position lies within its ellipse.
        ellipses: about so many of them, evenly over the samples; 0 = none. An ``out`` without covariance has none.
        label: of the estimate in the legend.
        unit: of the positions; None = not shown.
        ax: the Axes to draw into; None = a new figure.

    Returns:
        The Axes, with equal scales.

    Raises:
        ValueError: shapes that do not fit, a batch, values out of range; the message names the argument.
        ImportError: without matplotlib.
    """
    mean, cov = common.moments(out)
    T, n = mean.shape
    picked = check_components(components, n)
    if len(picked) != 2:
        raise ValueError(f"components: expected two, got {len(picked)}")
    check_count("ellipses", ellipses, 0)
    radius = np.sqrt(chi2_quantile(probability, 2))
    complete, lost = common.presence(mask, out, T)
    truth = None if truth is None else _positions(truth, picked, T, n)
    measured = None if measurements is None else common.array("measurements", measurements, (T, 2), nan=True)
    labels = [common.with_unit(name, unit) for name in ("x", "y")]
    label = common.output_label(out, label)
    position = mean[:, picked]

    ax = common.axes_of(ax, figsize=(7.5, 5.5))
    color = common.next_color(ax, "estimate")
    if lost.any():
        at = np.where(lost[:, None], position, np.nan)
        ax.plot(*at.T, "o-", color=common.LOST, linewidth=5, markersize=5, zorder=1.5, gid="lost", label="lost samples")
    if measured is not None:
        ax.plot(
            *measured[complete].T, ".", color=common.MEASURED, markersize=4, zorder=1.8, gid="measurements",
            label="measurements",
        )  # fmt: skip
    if truth is not None:
        ax.plot(*truth.T, "--", color=common.TRUTH, linewidth=1.2, zorder=2.1, gid="truth", label="truth")
    ax.plot(*position.T, color=color, linewidth=1.6, zorder=2.2, gid="estimate", label=label)
    ax.plot(*position[0], "o", color=color, markersize=6, zorder=2.3, gid="start", label="start")
    if cov is not None and ellipses:
        _draw_ellipses(ax, position, cov[:, picked][..., picked], radius, ellipses, color, probability)
    ax.set(xlabel=labels[0], ylabel=labels[1])
    ax.set_aspect("equal", adjustable="datalim")
    common.legend(ax, beside=True)
    return ax


def _positions(truth, picked, T, n):
    columns = np.shape(truth)[1] if np.ndim(truth) == 2 else n
    a = common.array("truth", truth, (T, columns), nan=True)
    if columns not in (2, n):
        raise ValueError(f"truth: expected shape ({T}, {n}) or ({T}, 2), got {a.shape}")
    return a[:, picked] if columns == n else a


def _draw_ellipses(ax, position, cov, radius, count, color, probability):
    from matplotlib.patches import Ellipse

    label = f"{common.percent(probability)} ellipse"
    style = {"facecolor": color, "edgecolor": color, "alpha": 0.2, "zorder": 1.7, "gid": "ellipse", "label": label}
    for k in np.unique(np.linspace(0, len(position) - 1, count).round().astype(int)):
        if not (np.isfinite(position[k]).all() and np.isfinite(cov[k]).all()):
            continue
        variances, directions = np.linalg.eigh(cov[k])  # ascending
        height, width = 2 * radius * np.sqrt(np.maximum(variances, 0.0))
        angle = np.degrees(np.arctan2(directions[1, 1], directions[0, 1]))
        ax.add_patch(Ellipse(tuple(position[k]), width, height, angle=angle, **style))
