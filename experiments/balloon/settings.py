"""The published comparison in three settings: classical against fuzzy mixed filter, and the Kalman filter."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxfilt as jf
from experiments.balloon.scheduled import tabulated
from experiments.balloon.system import (
    METRES,
    PRINTED,
    SAMPLED,
    STEPS,
    UNIVERSE,
    Scenario,
    axis_model,
    axis_models,
    mismatch,
    score,
    side_by_side,
)

INPUTS = ("innovation", "difference")
KALMAN = "Kalman"
SHARES = (0.9, 0.99, 0.992, 0.995, 0.9965, 0.998)  # of theta_max; 0.995 is where the fuzzy filter is
HIGH = 0.995
Scores = dict[str, dict[str, np.ndarray]]  # [filter][score] -> (runs,)


class Setting(NamedTuple):
    """One way to read the paper."""

    name: str
    scenario: Scenario
    stationary: bool  # the Riccati equation solved in each step, or the recursion from P0
    mismatches: tuple[float, ...]  # w


A = Setting("A", PRINTED, True, (1.0, 2.0, 4.0))
B = Setting("B", SAMPLED, True, (1.0,))
C = Setting("C", SAMPLED, False, (1.0, 4.0))
SETTINGS = {setting.name: setting for setting in (A, B, C)}


def theta_max(setting: Setting) -> float:
    """The largest theta of the system [1/km]: that of the x axis."""
    return jf.theta_max(axis_model(setting.scenario, 0), steps=None if setting.stationary else STEPS)


def mixed_name(share: float) -> str:
    return f"mixed {share:g}"


def fuzzy_name(input: str, share: float = HIGH) -> str:
    return f"fuzzy {share:g}, {input}"


@partial(jax.jit, static_argnames=("setting", "input"))
def make(setting: Setting, thetas: Array, input: str | None) -> jf.Filter:
    """Mixed filters for several theta, stacked; with an input their fuzzy form as printed.

    The stationary ones by their gains, for which see :mod:`experiments.balloon.scheduled`.
    """
    system, models = jf.fuzzy.mamdani(UNIVERSE), axis_models(setting.scenario)

    def one(theta):
        if setting.stationary:
            return tabulated(models, theta, system, unit=METRES, input=input)
        filt = side_by_side([jf.mixed_hinf(model, theta) for model in models])
        return filt if input is None else jf.fuzzy_scaled(filt, system, input=input, unit=METRES)

    return jax.vmap(one)(thetas)


@partial(jax.jit, static_argnames="runs")
def batch(filters: jf.Filter, draw: Any, key: Array, runs: int) -> dict[str, Array]:
    """Scores (filters, runs) of stacked filters on the same runs."""

    def one(key):
        run = jf.Draw(*draw(key))
        options = {"u": run.u, "outputs": _kept, "first_update_only": True}
        return jax.vmap(lambda filt: score(run.truth, run.ys, jf.filter(filt, run.ys, **options)))(filters)

    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(runs))
    return jax.tree.map(jnp.transpose, jax.vmap(one)(keys))


def _kept(state: Any, info: jf.Info) -> Any:
    """What the score looks at."""
    del state
    assert info.prediction is not None
    return jf.Info(
        info.mean, None, info.innovation, None, None, None, info.status,
        prediction=jf.Prediction(info.prediction.mean), extra={k: v for k, v in info.extra.items() if k == "alpha"},
    )  # fmt: skip


def compute(
    setting: Setting,
    w: float,
    runs: int,
    seed: int,
    shares: tuple[float, ...] = SHARES,
    inputs: tuple[str, ...] = INPUTS[:1],
) -> Scores:
    """All filters of a setting on the same runs."""
    bound = theta_max(setting)
    draw, key = mismatch(setting.scenario, w).simulate, jax.random.key(seed)
    found: list[tuple[list[str], jf.Filter]] = [
        ([KALMAN, *map(mixed_name, shares)], make(setting, bound * np.array([0.0, *shares]), None))
    ]
    for input in inputs:
        # In the recursion the factor does something at theta = 0 too.
        own = (HIGH,) if setting.stationary else (HIGH, 0.0)
        found.append(([fuzzy_name(input, share) for share in own], make(setting, bound * np.array(own), input)))
    scores: Scores = {}
    for names, filters in found:
        result = jax.tree.map(np.asarray, batch(filters, draw, key, runs))
        for i, name in enumerate(names):
            scores[name] = {part: values[i] for part, values in result.items()}
    return scores
