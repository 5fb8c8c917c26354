"""Consistency, mode probabilities, and means over Monte-Carlo runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Any

import numpy as np

from jaxfilt import metrics
from jaxfilt.core import check_flag, number
from jaxfilt.plots import common


def consistency(
    values: Any, dof: float, *, probability: float = 0.95, times: Any = None, label: str = "NEES", ax: Any = None
) -> Any:
    """NEES or NIS over time, averaged over runs, with its chi-square region (:func:`jaxfilt.metrics.chi2_region`).

    The title has the share of samples inside. Of the samples of one run that share scatters widely for NEES, whose
    values depend on each other from sample to sample; NIS of a consistent filter are independent.

    Args:
        values: (T,) of one run, or (runs, T); NaN where there is none, as for the NIS of a lost sample.
        dof: degrees of freedom of one value: the components looked at for NEES, the measurement's for NIS.
        probability: that a consistent filter's average falls inside.
        times: (T,) seconds; None = the sample number.
        label: what the values are.
        ax: the Axes to draw into; None = a new figure.

    Returns:
        The Axes. Values far above the region make the scale logarithmic.

    Raises:
        ValueError: shapes that do not fit, values out of range; the message names the argument.
        ImportError: without matplotlib.
    """
    runs = np.shape(values)[0] if np.ndim(values) == 2 else None
    values = common.array("values", values, (None,) if runs is None else (None, None), nan=True)
    if (values < 0).any():
        raise ValueError(f"values: expected values >= 0, got {np.nanmin(values)}")
    values = np.atleast_2d(values)
    t = common.abscissa(times, values.shape[1], "values")
    label = common.text("label", label)
    counts = (~np.isnan(values)).sum(axis=0)
    regions = {int(c): metrics.chi2_region(dof, int(c), probability) for c in np.unique(counts) if c}
    if not regions:
        raise ValueError("values: are NaN throughout")
    low, high = np.array([regions.get(int(c), (np.nan, np.nan)) for c in counts]).T
    mean = np.where(counts > 0, np.nansum(values, axis=0) / np.maximum(counts, 1), np.nan)
    known = counts > 0
    share = np.mean((low <= mean)[known] & (mean <= high)[known])

    ax = common.axes_of(ax, figsize=(8, 4))
    color = common.next_color(ax, "mean")
    region = f"{common.percent(probability)} region"
    ax.fill_between(t, low, high, color=common.REGION, linewidth=0, zorder=0.5, gid="region", label=region)
    for bound in (low, high):
        ax.plot(t, bound, color="0.6", linewidth=0.8, gid="bound")
    ax.axhline(number("dof", dof), color=common.TRUTH, linestyle="--", linewidth=1.0, gid="expected", label="expected")
    ax.plot(
        t,
        mean,
        ".-",
        color=color,
        linewidth=1.4,
        markersize=3,
        gid="mean",
        label=label if runs is None else f"{label}, mean",
    )
    if np.nanmax(mean) > 20 * np.nanmax(high):
        ax.set_yscale("log")
    of = f"{int(known.sum())} samples" if runs is None else f"{int(known.sum())} means over {runs} runs"
    inside = f"{common.percent(share, 3)} of {of} inside (if consistent: {common.percent(probability)})"
    ax.set_title(f"{label}: {inside}", fontsize="medium", loc="left")
    ax.set_ylabel(label)
    common.label_times(ax, times)
    common.legend(ax, beside=True)
    return ax


def mode_probabilities(
    probabilities: Any, *, names: Sequence[str] | None = None, truth: Any = None, times: Any = None, ax: Any = None
) -> Any:
    """How probable each mode is over time, with the true modes as a strip above.

    Args:
        probabilities: (T, modes), as ``out.extra["mode_probabilities"]`` of :func:`jaxfilt.imm`.
        names: of the modes.
        truth: (T,) the true mode's number, from 0.
        times: (T,) seconds; None = the sample number.
        ax: the Axes to draw into; None = a new figure.

    Returns:
        The Axes.

    Raises:
        ValueError: shapes that do not fit, values out of range; the message names the argument.
        ImportError: without matplotlib.
    """
    p = common.array("probabilities", probabilities, (None, None))
    if not ((p >= -1e-6) & (p <= 1 + 1e-6)).all():
        raise ValueError(f"probabilities: expected values in [0, 1], got {p.min()} to {p.max()}; logarithms?")
    T, modes = p.shape
    names = common.texts("names", names, (f"mode {i}" for i in range(modes)))
    t = common.abscissa(times, T, "probabilities")
    if truth is not None:
        mode = common.array("truth", truth, (T,), of="probabilities")
        if not np.isin(mode, np.arange(modes)).all():
            raise ValueError(f"truth: expected mode numbers 0 to {modes - 1}, got {np.unique(mode).tolist()}")

    ax = common.axes_of(ax, figsize=(8, 4))
    for i, name in enumerate(names):
        ax.plot(t, p[:, i], color=common.color_at(i), linewidth=1.6, gid="probability", label=name)
    if truth is not None:
        _strip(ax, t, mode.astype(int))
    ax.set_ylim(-0.03, 1.03 if truth is None else 1.12)
    ax.set_ylabel("probability")
    common.label_times(ax, times)
    common.legend(ax, beside=True)
    return ax


def _strip(ax, t, mode):
    """The true mode as a colored strip above the probabilities."""
    for i in np.unique(mode):
        spans = [(first, last - first) for first, last in common.spans(t, mode == i)]
        ax.broken_barh(spans, (1.05, 0.05), facecolors=common.color_at(i), gid="true mode")
    ticks = np.linspace(0.0, 1.0, 6)
    ax.set_yticks([*ticks, 1.075], labels=[*(f"{tick:.1f}" for tick in ticks), "truth"])


def monte_carlo(
    curves: Mapping[str, Any],
    *,
    times: Any = None,
    root: bool = False,
    probability: float = 0.95,
    unit: str | None = None,
    ax: Any = None,
) -> Any:
    """Means over Monte-Carlo runs with their confidence bands, a curve for each name.

    Args:
        curves: ``{name: (runs, T)}``, errors or squared errors of each run, such as
            ``result.scores["kalman"]["squared_error"]`` of :func:`jaxfilt.monte_carlo`.
        times: (T,) seconds; None = the sample number.
        root: takes the root of the mean: an RMSE if the curves are squared errors
            (:func:`jaxfilt.metrics.root_mean`).
        probability: that the band holds the mean over infinitely many runs, at one time; from the standard error and
            the normal distribution. A single run has no band.
        unit: of what is drawn, after the root.
        ax: the Axes to draw into; None = a new figure.

    Returns:
        The Axes.

    Raises:
        ValueError: shapes that do not fit, values that are not finite or, with ``root``, negative; the message names
            the argument.
        ImportError: without matplotlib.
    """
    if not isinstance(curves, Mapping) or not curves:
        raise TypeError(f"curves: expected a dict of (runs, T) arrays, got {type(curves).__name__}")
    given = {str(name): common.array(f"curves[{name!r}]", x, (None, None)) for name, x in curves.items()}
    lengths = {x.shape[1] for x in given.values()}
    if len(lengths) > 1:
        raise ValueError(f"curves: expected one length T, got {sorted(lengths)}")
    t = common.abscissa(times, lengths.pop(), "curves")
    check_flag("root", root)
    probability = number("probability", probability)
    if not 0 < probability < 1:
        raise ValueError(f"probability: expected a value in (0, 1), got {probability}")
    quantile = NormalDist().inv_cdf(0.5 * (1 + probability))
    for name, x in given.items():
        if root and (x < 0).any():
            raise ValueError(f"curves[{name!r}]: expected squares >= 0 for root=True, got {x.min()}")
    ylabel = common.with_unit("RMSE" if root else "mean", unit)

    ax = common.axes_of(ax, figsize=(8, 4.5))
    for name, x in given.items():
        found = (metrics.root_mean if root else metrics.mean)(x)
        color = common.next_color(ax, "mean")
        if len(x) > 1:
            half = quantile * found.standard_error
            ax.fill_between(t, found.value - half, found.value + half, color=color, alpha=0.25, linewidth=0, gid="band")
        ax.plot(t, found.value, color=color, linewidth=1.6, gid="mean", label=f"{name} ({len(x)} runs)")
    if any(len(x) > 1 for x in given.values()):
        ax.set_title(
            f"means over runs with {common.percent(probability)} confidence bands", fontsize="medium", loc="left"
        )
    ax.set_ylabel(ylabel)
    common.label_times(ax, times)
    common.legend(ax, beside=True)
    return ax
