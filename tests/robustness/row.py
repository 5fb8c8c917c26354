"""What a row of the table is: figures that must not exceed their goals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

Figures = dict[str, float]


@dataclass(frozen=True)
class Goal:
    """The most that a figure may be, in float32 and float64; None where the row asks for nothing in that precision.

    ``proposed`` is what the specification asked for, where our goal is another; ``why`` says which operation loses the
    digits. ``slow``: measured in the full form only. ``bug``: what is wrong where the goal is known to be missed; the
    test fails once it is met.
    """

    f32: float | None
    f64: float | None
    proposed: str | None = None
    why: str = ""
    slow: bool = False
    bug: str = ""

    def of(self, dtype) -> float | None:
        return self.f32 if dtype == np.float32 else self.f64


@dataclass(frozen=True)
class Row:
    """One problem. ``measure(dtype, full)`` gives its figures; the small form runs by default, the full one in all."""

    number: int
    problem: str
    measure: Callable[[type, bool], Figures]
    goals: dict[str, Goal]
    peers: str = "–"
    also: list[str] = field(default_factory=list)  # tests elsewhere that ask more of the same
    slow: tuple[type, ...] = ()  # precisions that are left out of the default tests: for time, or as covered elsewhere
    group: str = ""  # rows that share what they compute: one process runs them

    @property
    def name(self) -> str:
        return f"R{self.number}"


F32, F64 = np.float32, np.float64


def count(limit: int = 0) -> Goal:
    """The goal of a number of failures."""
    return Goal(limit, limit)


def cast(tree, dtype):
    """Arrays in the dtype under test, as JAX sees them; booleans and integers stay."""
    return jax.tree.map(
        lambda x: jnp.asarray(x, dtype) if np.issubdtype(np.asarray(x).dtype, np.floating) else jnp.asarray(x), tree
    )


ROWS: dict[str, Row] = {}


def row(number: int, problem: str, goals: dict[str, Goal], **options):
    """Registers a measuring function as a row."""

    def register(measure):
        entry = Row(number, problem, measure, goals, **options)
        if entry.name in ROWS:
            raise ValueError(f"{entry.name}: given twice")
        ROWS[entry.name] = entry
        return measure

    return register
