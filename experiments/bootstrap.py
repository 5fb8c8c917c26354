"""Standard errors and intervals for errors on recorded data, where the errors within a group belong together."""

from __future__ import annotations

import numpy as np

from experiments.report import Cell, Entry


class Bootstrap:
    """Errors over a group of pieces (gaps, segments), with standard errors from resampled pieces.

    The errors within one piece depend on each other, so pieces are drawn, not samples.
    """

    def __init__(self, group: np.ndarray, rng: np.random.Generator, draws: int = 1000) -> None:
        """``group`` (B,) bool: the pieces that count."""
        self.group = np.flatnonzero(group)
        count = len(self.group)
        self.weights = rng.multinomial(count, np.full(count, 1 / count), size=draws)  # (draws, count)

    def draw(self, total: np.ndarray, count: np.ndarray, *, root: bool = True) -> np.ndarray:
        """``sum(total) / sum(count)`` over the group, or its root: first as met, then of each resampled group."""
        total, count = total[self.group].astype(float), count[self.group].astype(float)
        values = np.append(total.sum() / count.sum(), (self.weights @ total) / (self.weights @ count))
        return np.sqrt(values) if root else values

    def cell(self, total: np.ndarray | None, count: np.ndarray, *, root: bool = True) -> Entry:
        """A table's entry; nothing where the quantity is not defined."""
        if total is None:
            return "-"
        value, *draws = self.draw(total, count, root=root)
        return Cell(value, np.std(draws, ddof=1))

    def interval(self, total: np.ndarray, count: np.ndarray, level: float = 0.95) -> str:
        """The percentile interval of the root mean square, as text for a table."""
        tails = np.quantile(self.draw(total, count)[1:], [(1 - level) / 2, (1 + level) / 2])
        return f"{Cell(tails[0])} to {Cell(tails[1])}"
