"""Means over independent runs with their standard errors."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxfilt.core import check_flag, numbers


class Estimate(NamedTuple):
    """An average over runs and its standard error (infinite for a single run: nothing is known about the spread)."""

    value: np.ndarray
    standard_error: np.ndarray


def mean(values: Any) -> Estimate:
    """The mean over runs.

    Args:
        values: (runs, ...), one row per independent run. A NaN in it spreads: a mean of part of the runs is another
            quantity.

    Returns:
        ``Estimate(value (...), standard_error (...))``, computed in float64.
    """
    values = _rows("values", values)
    with np.errstate(invalid="ignore"):  # of infinite values: undefined, as it is
        return Estimate(values.mean(axis=0), _standard_error(values))


def root_mean(squares: Any) -> Estimate:
    """The root of the mean over runs, as an RMSE of per-run mean squares; standard error by the delta method.

    ``se(sqrt(m)) = se(m) / (2 sqrt(m))``; 0 where all squares are 0.

    Args:
        squares: (runs, ...) nonnegative, such as :func:`jaxfilt.metrics.mse` of each run.
    """
    squares = _rows("squares", squares)
    if (squares < 0).any():
        raise ValueError(f"squares: expected values >= 0, got {squares.min()}")
    return _root(mean(squares))


def ratio(numerator: Any, denominator: Any, *, root: bool = False) -> Estimate:
    """The ratio of two means over the *same* runs, as one strategy's error against another's on common data.

    The pairing enters the standard error, by the delta method: with ``r = mean(a) / mean(b)``,
    ``se(r) = se(mean(a - r b)) / |mean(b)|``, which is far smaller than for unpaired runs when a and b move together.

    Args:
        numerator: (runs, ...).
        denominator: (runs, ...), the same shape.
        root: takes the root of the ratio, which makes it a ratio of RMSEs when both are mean squares.

    Raises:
        ValueError: different shapes.
    """
    check_flag("root", root)
    a, b = _rows("numerator", numerator), _rows("denominator", denominator)
    if a.shape != b.shape:
        raise ValueError(f"denominator: expected the shape of numerator {a.shape}, got {b.shape}")
    below = b.mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):  # a mean of 0 below: infinite or undefined, as it is
        r = a.mean(axis=0) / below
        estimate = Estimate(r, _standard_error(a - r * b) / np.abs(below))
    return _root(estimate) if root else estimate


def _rows(name, values):
    values = numbers(name, values).astype(np.float64)
    if values.ndim == 0 or values.shape[0] == 0:
        raise ValueError(f"{name}: expected shape (runs, ...) with at least one run, got {values.shape}")
    return values


def _standard_error(values):
    runs = values.shape[0]
    if runs == 1:
        return np.full(values.shape[1:], np.inf)
    return values.std(axis=0, ddof=1) / np.sqrt(runs)


def _root(estimate):
    root = np.sqrt(estimate.value)
    positive = root > 0
    return Estimate(root, np.where(positive, estimate.standard_error / np.where(positive, 2 * root, 1.0), 0.0))
