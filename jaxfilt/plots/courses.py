"""Estimates and their errors over time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxfilt.core import number
from jaxfilt.metrics.errors import check_components
from jaxfilt.plots import common


def estimate(
    out: Any,
    *,
    component: int = 0,
    truth: Any = None,
    measurements: Any = None,
    mask: Any = None,
    times: Any = None,
    sigmas: float = 2.0,
    label: str | None = None,
    unit: str | None = None,
    ax: Any = None,
) -> Any:
    """One component of the state over time with its band; gaps in the measurements are shaded.

    Args:
        out: what :func:`jaxfilt.filter` or :func:`jaxfilt.smooth` returns, of one run.
        component: index in the state.
        truth: (T,) values of the component, or (T, n) states; NaN where it is not known.
        measurements: (T,) values of the component, drawn where the sample is complete; NaN where there is none.
        mask: (T,) or (T, m) bool, True = present; None = what ``out.status`` reports as missed.
        times: (T,) seconds; None = the sample number.
        sigmas: half the band's width in standard deviations; an ``out`` without covariance has no band.
        label: of the estimate in the legend.
        unit: of the component.
        ax: the Axes to draw into; None = a new figure.

    Returns:
        The Axes.

    Raises:
        ValueError: shapes that do not fit, a batch, values out of range; the message names the argument.
        ImportError: without matplotlib.
    """
    mean, cov = common.moments(out)
    T, n = mean.shape
    i = _component(component, n)
    sigmas = _positive_sigmas(sigmas)
    t = common.abscissa(times, T)
    complete, lost = common.presence(mask, out, T)
    if truth is not None:
        many = np.ndim(truth) == 2
        truth = common.array("truth", truth, (T, n) if many else (T,), nan=True)
        truth = truth[:, i] if many else truth
    if measurements is not None and np.ndim(measurements) == 2:
        raise ValueError("measurements: expected (T,) values of this component; give its column, such as ys[:, 0]")
    measured = None if measurements is None else common.array("measurements", measurements, (T,), nan=True)
    ylabel = common.with_unit(f"state {i}", unit)
    label = common.output_label(out, label)

    ax = common.axes_of(ax, figsize=(8, 4))
    color = common.next_color(ax, "estimate")
    _shade(ax, t, lost)
    if cov is not None:
        half = sigmas * np.sqrt(np.maximum(cov[:, i, i], 0.0))
        ax.fill_between(
            t, mean[:, i] - half, mean[:, i] + half, color=color, alpha=0.2, linewidth=0, gid="band",
            label=f"±{sigmas:g}σ",
        )  # fmt: skip
    if measured is not None:
        ax.plot(
            t[complete], measured[complete], ".", color=common.MEASURED, markersize=4, gid="measurements",
            label="measurements",
        )  # fmt: skip
    if truth is not None:
        ax.plot(t, truth, "--", color=common.TRUTH, linewidth=1.2, gid="truth", label="truth")
    ax.plot(t, mean[:, i], color=color, linewidth=1.6, gid="estimate", label=label)
    ax.set_ylabel(ylabel)
    common.label_times(ax, times)
    common.legend(ax, beside=True)
    return ax


def errors(
    out: Any,
    truth: Any,
    *,
    components: Sequence[int] | None = None,
    times: Any = None,
    sigmas: float = 2.0,
    names: Sequence[str] | None = None,
    axes: Any = None,
) -> np.ndarray:
    """Estimate minus truth with its band, one panel for each component; the title has the share of samples inside.

    Args:
        out: what :func:`jaxfilt.filter` or :func:`jaxfilt.smooth` returns, of one run.
        truth: (T, n) states; NaN where it is not known.
        components: indices in the state; None = all.
        times: (T,) seconds; None = the sample number.
        sigmas: half the band's width in standard deviations; an ``out`` without covariance has no band.
        names: of the components, with their units.
        axes: as many Axes as components; None = a new figure.

    Returns:
        An array of the Axes, (components,).

    Raises:
        ValueError: shapes that do not fit, a batch, values out of range; the message names the argument.
        ImportError: without matplotlib.
    """
    mean, cov = common.moments(out)
    T, n = mean.shape
    picked = check_components(np.arange(n) if components is None else components, n)
    error = mean - common.array("truth", truth, (T, n), nan=True)
    sigmas = _positive_sigmas(sigmas)
    t = common.abscissa(times, T)
    titles = common.texts("names", names, (f"state {i}" for i in picked))
    expected = math.erf(sigmas / math.sqrt(2))

    axes, bottom = _panels(axes, len(picked))
    for ax, i, title in zip(axes, picked, titles, strict=True):
        color = common.next_color(ax, "error")
        ax.axhline(0.0, color="0.6", linewidth=0.8, gid="zero")
        if cov is not None:
            half = sigmas * np.sqrt(np.maximum(cov[:, i, i], 0.0))
            ax.fill_between(t, -half, half, color=color, alpha=0.2, linewidth=0, gid="band")
            known = np.isfinite(error[:, i])
            share = float(np.mean(np.abs(error[known, i]) <= half[known])) if known.any() else math.nan
            title += f": {common.percent(share, 3)} inside ±{sigmas:g}σ (if consistent: {common.percent(expected, 3)})"
        ax.plot(t, error[:, i], color=color, linewidth=1.2, gid="error")
        ax.set_title(title, fontsize="medium", loc="left")
        ax.set_ylabel("error")
    for ax in bottom:
        common.label_times(ax, times)
    return axes


def _panels(axes, count):
    """Axes (count,) row by row, in two columns if there are many, and those at the bottom."""
    if axes is not None:
        flat = np.ravel(np.asarray(axes, dtype=object))
        if flat.shape != (count,) or not all(hasattr(ax, "add_patch") for ax in flat):
            raise ValueError(f"axes: expected {count} matplotlib Axes for these components, got {axes!r}")
        return np.array([common.axes_of(ax) for ax in flat], dtype=object), flat
    columns = 1 if count <= 3 else 2
    rows = -(-count // columns)
    _, grid = common.plotting().subplots(
        rows, columns, figsize=(7.5 if columns == 1 else 12, 1.2 + 2.0 * rows), sharex=True, squeeze=False,
        layout="constrained",
    )  # fmt: skip
    flat = grid.ravel()
    for ax in flat[count:]:
        ax.remove()
    flat = flat[:count]
    bottom = flat[-columns:]
    for ax in bottom:
        ax.xaxis.set_tick_params(labelbottom=True)
    if count % columns:
        bottom[0].xaxis.set_in_layout(False)  # its labels have the empty panel below: rows stay as high as the others
    return np.array([common.axes_of(ax) for ax in flat], dtype=object), bottom


def _component(component, n):
    whole = isinstance(component, int | np.integer) and not isinstance(component, bool)
    if not (whole and -n <= component < n):
        raise ValueError(f"component: expected the index of one of {n} components, got {component!r}")
    return int(component) % n


def _positive_sigmas(sigmas):
    sigmas = number("sigmas", sigmas)
    if not (sigmas > 0 and math.isfinite(sigmas)):
        raise ValueError(f"sigmas: expected a finite value > 0, got {sigmas}")
    return sigmas


def _shade(ax, t, lost):
    """Shades every gap half-way to the samples beside it, once however many estimates are drawn."""
    if any(patch.get_gid() == "gap" for patch in ax.patches):
        return
    for first, last in common.spans(t, lost):
        ax.axvspan(first, last, color=common.LOST, alpha=0.4, linewidth=0, zorder=0.5, gid="gap", label="lost samples")
