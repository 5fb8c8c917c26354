"""Filters on simulated runs, and their scores."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.joint_tracking import system
from experiments.joint_tracking.system import Config, Data
from experiments.report import Cell

CHUNK = 10  # runs at once: more do not fit the cache
SETTLED = 2.0  # s before errors are scored
SURE = 0.95


class Outcome(NamedTuple):
    """What a filter said on runs of one path."""

    mean: np.ndarray  # (runs, T, 4)
    log_p: np.ndarray  # (runs, T, 2)
    status: np.ndarray  # (runs, T)
    truth: np.ndarray  # (T, 4)
    label: int  # the true class
    dt: float

    @property
    def p(self) -> np.ndarray:
        """Probability of the true class (runs, T)."""
        return np.exp(self.log_p[:, :, self.label])

    def square(self, part: slice) -> np.ndarray:
        """Squared error (runs, T) of the position or the velocity."""
        return np.sum((self.mean - self.truth)[:, :, part] ** 2, axis=2)

    def rmse(self, part: slice) -> np.ndarray:
        """Of each run from 2 s on (runs,)."""
        return np.sqrt(self.square(part)[:, round(SETTLED / self.dt) :].mean(axis=1))

    @property
    def right(self) -> np.ndarray:
        """(runs,) whether the true class is sure at the end."""
        return self.p[:, -1] > SURE

    @property
    def settled(self) -> np.ndarray:
        """(runs,) s from which on the true class stays sure; the end of the run where it never does."""
        unsure = self.p <= SURE
        T = unsure.shape[1]
        return self.dt * np.where(unsure.any(axis=1), T - np.argmax(unsure[:, ::-1], axis=1), 0)


POSITION, VELOCITY = slice(0, 2), slice(2, 4)


def _reported(state, info):
    del state
    return info.mean, info.extra["log_probabilities"], info.status


@partial(jax.jit, static_argnames="chunk")
def filtered(make: Partial, config: Config, data: Data, chunk: int = CHUNK) -> Any:
    """Mean (runs, T, 4), class log-probabilities and status of ``make(config, first)`` on each run."""

    def one(run):
        first, ys, key = run
        return jf.filter(make(config, first), ys, key=key, outputs=_reported)

    return jax.lax.map(one, (data.first, data.ys, data.keys), batch_size=chunk)


def evaluate(make: Partial, config: Config, label: int, runs: int, key: Array) -> Outcome:
    """A filter on runs of a class's path; the same runs for the same key."""
    if label not in range(len(system.CLASSES)):
        raise ValueError(f"label: expected a class in 0 to {len(system.CLASSES) - 1}, got {label}")
    data = system.simulate(config, label, runs, key)
    mean, log_p, status = filtered(make, config, data, min(CHUNK, runs))
    mean, log_p, status = (np.asarray(x) for x in (mean, log_p, status))
    return Outcome(mean, log_p, status, np.asarray(data.truth), label, float(config.dt))


def root_mean(x: np.ndarray) -> Cell:
    """Root of the mean square over runs, with its standard error."""
    mean = float(np.mean(x**2))
    se = float(np.std(x**2, ddof=1) / np.sqrt(len(x))) if len(x) > 1 else np.nan
    return Cell(np.sqrt(mean), se / (2 * np.sqrt(mean)))


def median(x: np.ndarray) -> Cell:
    """The median over runs; standard error by resampling runs."""
    draws = np.random.default_rng(0).integers(len(x), size=(400, len(x)))
    return Cell(float(np.median(x)), float(np.std(np.median(x[draws], axis=1), ddof=1)))


def share(x: np.ndarray) -> Cell:
    """A share of runs; standard error with one success and one failure added, so that it is not 0 at the ends."""
    n = len(x)
    q = (np.sum(x) + 1) / (n + 2)
    return Cell(float(np.mean(x)), float(np.sqrt(q * (1 - q) / n)))
