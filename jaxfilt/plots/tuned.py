"""What tuners return: fronts, histories, membership functions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxfilt.core import number
from jaxfilt.plots import common
from jaxfilt.tune import Front, TuneResult

_COSTS = {
    "evaluations": "evaluations of the loss",
    "wall_time": "wall time, compilation excluded [s]",
}


def pareto(
    *results: Any, labels: Sequence[str] | None = None, names: Sequence[str] | None = None, ax: Any = None
) -> Any:
    """Pareto fronts of two losses: the solutions, and the edge of what they dominate.

    Args:
        results: what :func:`jaxfilt.tune.nsga2` returns, its ``front``, or losses (k, 2); of these, solutions that
            another one dominates are drawn, too, beyond the edge.
        labels: of the results in the legend.
        names: of the two losses.
        ax: the Axes to draw into; None = a new figure.

    Returns:
        The Axes. Less is better on both.

    Raises:
        ValueError: no results, one without a front, or not two losses; the message names the argument.
        ImportError: without matplotlib.
    """
    if not results:
        raise ValueError("results: expected at least one")
    losses = [_losses(result) for result in results]
    labels = common.texts("labels", labels, (_name(result, i) for i, result in enumerate(results)))
    names = common.texts("names", names, ("first loss", "second loss"))

    ax = common.axes_of(ax, figsize=(6.5, 5))
    for points, label in zip(losses, labels, strict=True):
        color = common.next_color(ax, "front")
        edge = _front(points)
        ax.plot(*edge.T, drawstyle="steps-post", color=color, linewidth=1.0, alpha=0.6, gid="front")
        ax.plot(*points.T, "o", color=color, markersize=4, gid="solutions", label=label)
    ax.set(xlabel=names[0], ylabel=names[1])
    common.legend(ax)
    return ax


def tuning(*results: Any, against: str = "evaluations", labels: Sequence[str] | None = None, ax: Any = None) -> Any:
    """The best loss so far against what it cost, a line for each tuner.

    Args:
        results: :class:`jaxfilt.tune.TuneResult` of the same loss.
        against: ``"evaluations"`` (one of a gradient tuner is a value with its gradient) or ``"wall_time"``.
        labels: of the results in the legend; None = their methods.
        ax: the Axes to draw into; None = a new figure.

    Returns:
        The Axes.

    Raises:
        ValueError: no results, or another cost; the message names the argument.
        TypeError: what is no TuneResult.
        ImportError: without matplotlib.
    """
    if not results:
        raise ValueError("results: expected at least one TuneResult")
    for result in results:
        if not isinstance(result, TuneResult):
            raise TypeError(f"results: expected a TuneResult, got {type(result).__name__}")
    if against not in _COSTS:
        raise ValueError(f"against: expected one of {sorted(_COSTS)}, got {against!r}")
    labels = common.texts("labels", labels, (_name(result, i) for i, result in enumerate(results)))

    ax = common.axes_of(ax, figsize=(7.5, 4.5))
    for result, label in zip(results, labels, strict=True):
        color = common.next_color(ax, "best loss")
        cost = np.asarray(getattr(result.history, against), np.float64)
        best = np.where(np.isfinite(result.history.best_loss), result.history.best_loss, np.nan)
        ax.plot(cost, best, drawstyle="steps-post", color=color, linewidth=1.6, gid="best loss",
                label=f"{label}: {result.loss:.5g}")  # fmt: skip
        ax.plot(cost[-1:], best[-1:], "o", color=color, markersize=5, gid="end")
    ax.set(xlabel=_COSTS[against], ylabel="best loss so far")
    common.legend(ax)
    return ax


def memberships(
    before: Any,
    after: Any = None,
    *,
    universe: float | None = None,
    names: Sequence[str] | None = None,
    unit: str | None = None,
    ax: Any = None,
) -> Any:
    """Fuzzy sets over their universe; with ``after`` the sets before tuning are dashed.

    Args:
        before: corners (sets, 4) of trapezoids, as of :func:`jaxfilt.fuzzy.partition`, or (sets, 3) of triangles.
        after: the same after tuning.
        universe: upper end of the universe, which begins at 0; None = from the first corner to the last.
        names: of the sets.
        unit: of the input.
        ax: the Axes to draw into; None = a new figure.

    Returns:
        The Axes.

    Raises:
        ValueError: shapes that do not fit, corners that are not ordered; the message names the argument.
        ImportError: without matplotlib.
    """
    first = _corners("before", before)
    sets = len(first)
    second = None if after is None else _corners("after", after)
    if second is not None and len(second) != sets:
        raise ValueError(f"after: expected {sets} sets as before, got {len(second)}")
    names = common.texts("names", names, (f"set {i}" for i in range(sets)))
    every = first if second is None else np.concatenate([first, second])
    low, high = (every.min(), every.max()) if universe is None else (0.0, number("universe", universe))
    if not low < high < np.inf:
        raise ValueError(f"universe: expected a finite upper end > {low:g}, got {high}")
    xlabel = common.with_unit("input", unit)

    ax = common.axes_of(ax, figsize=(7.5, 3.5))
    for i, name in enumerate(names):
        color = common.color_at(i)
        if second is None:
            ax.plot(*_outline(first[i], low, high), color=color, linewidth=1.8, gid="before", label=name)
        else:
            ax.plot(*_outline(first[i], low, high), "--", color=color, linewidth=1.2, gid="before")
            ax.plot(*_outline(second[i], low, high), color=color, linewidth=1.8, gid="after", label=name)
    ax.set(xlabel=xlabel, ylabel="membership", xlim=(low, high), ylim=(-0.02, 1.05))
    if second is not None:
        ax.set_title("dashed: before tuning; solid: after", fontsize="medium", loc="left")
    common.legend(ax, beside=True)
    return ax


def _losses(result):
    if isinstance(result, TuneResult):
        if result.front is None:
            raise ValueError(f"results: {result.method} has one loss and no front")
        result = result.front
    losses = result.losses if isinstance(result, Front) else result
    return common.array("results", losses, (None, 2))


def _front(points):
    """The points that none dominates, by the first loss."""
    ordered = points[np.lexsort(points.T[::-1])]
    best = np.minimum.accumulate(ordered[:, 1])
    return ordered[np.concatenate([[True], best[1:] < best[:-1]])]


def _name(result, i):
    return result.method if isinstance(result, TuneResult) else f"result {i}"


def _corners(name, corners):
    columns = np.shape(corners)[-1] if np.ndim(corners) == 2 else 4
    corners = common.array(name, corners, (None, 3 if columns == 3 else 4))
    if (np.diff(corners, axis=1) < 0).any():
        raise ValueError(f"{name}: expected corners in order in every set")
    return corners[:, [0, 1, 1, 2]] if columns == 3 else corners


def _outline(corners, low, high):
    """Corners of a set's outline; a shoulder at an end of the universe goes on there, without an edge."""
    a, b, c, d = corners
    x, y = [a, b, c, d], [0.0, 1.0, 1.0, 0.0]
    if a == b <= low:
        x, y = x[1:], y[1:]
    if c == d >= high:
        x, y = x[:-1], y[:-1]
    return x, y
