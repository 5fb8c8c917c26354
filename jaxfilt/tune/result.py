"""What every tuner returns, so that they can be laid side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxfilt import describe
from jaxfilt.core import number

PyTree = Any


class History(NamedTuple):
    """The course of a run; one row per block of steps or per generation."""

    evaluations: np.ndarray  # (h,) int, evaluations of the loss up to here
    wall_time: np.ndarray  # (h,) seconds up to here, compilation excluded
    best_loss: np.ndarray  # (h,) lowest loss up to here

    def __repr__(self) -> str:
        """From the first to the last row."""
        return describe.history(self)


class Front(NamedTuple):
    """Mutually non-dominated solutions."""

    losses: np.ndarray  # (k, objectives)
    params: PyTree  # leaves with a leading k, in their own constraints

    def __repr__(self) -> str:
        """How many, the range of each loss, and the parameters by shape."""
        return describe.front(self)


@dataclass(frozen=True, eq=False)
class TuneResult:
    """The outcome of a tuner.

    Attributes:
        params: the best parameters seen, in their own constraints.
        loss: their loss; infinite if no finite one was met.
        history: the course of the run.
        evaluations: evaluations of the loss in all. For a gradient tuner one evaluation is one value and gradient.
        wall_time: seconds in all, compilation excluded.
        compile_time: seconds of tracing and compilation.
        method: which tuner it was.
        front: the non-dominated solutions of a tuner with several losses, else None.
    """

    params: PyTree
    loss: float
    history: History
    evaluations: int
    wall_time: float
    compile_time: float
    method: str
    front: Front | None = None

    def best_at(self, seconds: float) -> float:
        """The best loss known after this wall time; infinite before the first row of the history."""
        rows = int(np.searchsorted(self.history.wall_time, seconds, side="right"))
        return float(self.history.best_loss[rows - 1]) if rows else float("inf")

    def __repr__(self) -> str:
        """In short: method, loss, cost and parameters."""
        front = "" if self.front is None else f", front of {len(self.front.losses)}"
        return (
            f"TuneResult({self.method}: loss {self.loss:.6g} after {self.evaluations} evaluations in "
            f"{self.wall_time:.3g} s, compilation {self.compile_time:.3g} s{front}, "
            f"params={describe.brief(self.params)})"
        )


def make_result(
    params: PyTree,
    loss: float,
    rows: Sequence[tuple[int, float, float]],
    compile_time: float,
    method: str,
    front: Front | None = None,
) -> TuneResult:
    """A :class:`TuneResult` from rows ``(evaluations, wall_time, best_loss)``."""
    evaluations, wall_time, best_loss = zip(*rows, strict=True)
    history = History(np.asarray(evaluations, np.int64), np.asarray(wall_time), np.asarray(best_loss, np.float64))
    return TuneResult(params, float(loss), history, evaluations[-1], wall_time[-1], compile_time, method, front)


def check_time_limit(time_limit: Any) -> None:
    """Raises an error that names ``time_limit`` if it is neither None nor a number >= 0."""
    if time_limit is not None and not number("time_limit", time_limit) >= 0:
        raise ValueError(f"time_limit: expected seconds >= 0, got {time_limit}")
