"""Pareto fronts of the mixed filter: a sweep of theta, gradients with swept weights, and NSGA-II, side by side.

Problem A weighs the mean square error of a constant gain against its worst case, both analytic; problem B the mean
against the 95th percentile over runs whose noise is not what the filter thinks.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.balloon.scheduled import gain
from experiments.balloon.settings import B as STATIONARY
from experiments.balloon.settings import theta_max as bound_of
from experiments.balloon.system import AXES, SAMPLED, axis_model, axis_models, mismatch
from jaxfilt import tune

WEIGHTS = 11  # of the two objectives, swept by the gradient
SCALAR, X_AXIS, ROBUST = "F = H = Q = R = 1", "x axis, T = 0.8 s", "mismatched noise"
FREQUENCIES = 300  # in the search; what is shown is computed with 1500
MISMATCH = 4.0
RUNS = (100, 200)  # runs and samples of problem B
FRESH = (500, 400)
SHARES = np.concatenate([np.linspace(0.0, 0.9, 10), [0.93, 0.95, 0.97, 0.98, 0.985, 0.99]])  # of theta_max

Params = dict[str, Any]


class Found(NamedTuple):
    """What a method found, and at which price."""

    points: np.ndarray  # (k, 2) objectives
    params: Any  # leaves with leading k
    evaluations: int
    wall: float  # s, compilation excluded
    compilation: float  # s


class Effort(NamedTuple):
    steps: int
    population: int
    generations: int


FULL = Effort(steps=150, population=80, generations=50)
QUICK = Effort(steps=60, population=24, generations=25)


def scalar_model() -> jf.models.LinearGaussian:
    """F = H = Q = R = 1, whose front is known in closed form."""
    one = np.ones((1, 1))
    return jf.models.linear_gaussian(one, one, one, one, np.zeros(1), one)


def closed_form(K: Any) -> np.ndarray:
    """J2 and J_inf of the scalar problem for a gain K in (0, 2)."""
    K = np.asarray(K, float)
    return np.stack([(1 + K**2) / (K * (2 - K)), (1 + K**2) / np.where(K <= 1, K, 2 - K) ** 2], axis=-1)


# --- problem A --------------------------------------------------------------------------------------------------------


def objectives(frequencies: jf.Static, params: Params, model: jf.models.LinearGaussian) -> Array:
    """(2,) J2 and J_inf of a constant gain of the predictor."""
    found = jf.metrics.predictor_gains(
        model.F, model.H, model.Q, model.R, params["gain"][:, None], frequencies=frequencies.value
    )  # fmt: skip
    return jnp.stack([found.mean_square, found.worst_case])


def weighted(evaluate: Partial, params: Params, data: Any) -> Array:
    """The sum over all weights of the weighted objectives, each in units of its own best.

    The candidates, leading W, share no coordinate, so Adam moves each as if it were alone.
    """
    values = jax.vmap(evaluate, (0, None))(params, data["problem"])
    return jnp.sum(data["weights"] * values / data["unit"][None, :])


def sweep_a(model: jf.models.LinearGaussian) -> Found:
    """The mixed filter itself for theta up to 0.99 of the largest."""
    thetas = jnp.asarray(SHARES * jf.theta_max(model))
    return _timed(Partial(_sweep_a, jf.Static(1500)), thetas, model)


def _sweep_a(frequencies, thetas, model):
    gains = jax.vmap(lambda theta: model.F @ gain(model, theta**2))(thetas)
    params = {"gain": gains}
    return jax.vmap(Partial(objectives, frequencies), (0, None))(params, model), params


def _timed(function: Any, candidates: Array, data: Any) -> Found:
    begun = time.perf_counter()
    compiled = jax.jit(function).lower(candidates, data).compile()
    compilation = time.perf_counter() - begun
    begun = time.perf_counter()
    points, params = jax.block_until_ready(compiled(candidates, data))
    return Found(np.asarray(points), params, len(points), time.perf_counter() - begun, compilation)


def gain_space(model: jf.models.LinearGaussian, factor: float) -> Params:
    """From the Kalman gain, up to a factor either way."""
    kalman = np.asarray(model.F) @ np.asarray(gain(model, jnp.zeros(())))
    return {"gain": tune.positive(kalman, kalman / factor, kalman * factor)}


def search(
    evaluate: Any, rescore: Any, space: Params, problem: Any, unit: np.ndarray, effort: Effort, key: Array
) -> dict[str, Found]:
    """Gradient with swept weights, and NSGA-II; ``rescore`` gives the points shown."""
    keys = jax.random.split(key)
    share = np.linspace(0.0, 1.0, WEIGHTS)
    data = {"problem": problem, "weights": jnp.asarray(np.stack([1 - share, share], axis=1)), "unit": jnp.asarray(unit)}
    stacked = {name: _repeat(spec) for name, spec in space.items()}
    result = tune.gradient(
        Partial(weighted, Partial(evaluate)), stacked, data, key=keys[0], optimizer=optax.adam(
            optax.cosine_decay_schedule(0.1, effort.steps)
        ), steps=effort.steps,
    )  # fmt: skip
    found = {"gradient, swept weights": _found(rescore, result, result.params, problem, result.evaluations * WEIGHTS)}
    result = tune.nsga2(
        evaluate, space, problem, key=keys[1], population=effort.population, generations=effort.generations,
        weights=list(1 / unit),
    )  # fmt: skip
    assert result.front is not None
    found["NSGA-II"] = _found(rescore, result, result.front.params, problem, result.evaluations)
    return found


def _repeat(spec: tune.Spec) -> tune.Spec:
    """The spec of W candidates at once."""
    size = np.size(spec.low)
    shape = np.shape(spec.init)
    repeat = lambda x: np.tile(np.reshape(x, size), WEIGHTS)  # noqa: E731
    init = np.broadcast_to(spec.init, (WEIGHTS, *shape))
    args = tuple(np.broadcast_to(arg, (WEIGHTS, *shape)) for arg in spec.args)
    return replace(spec, init=init, low=repeat(spec.low), high=repeat(spec.high), args=args)


def _found(rescore, result, params, problem, evaluations):
    points = np.asarray(jax.jit(jax.vmap(rescore, (0, None)))(params, problem))
    return Found(points, params, evaluations, result.wall_time, result.compile_time)


def problem_a(model: jf.models.LinearGaussian, factor: float, effort: Effort, key: Array) -> dict[str, Found]:
    """All three methods over the constant gain."""
    sweep = sweep_a(model)
    fine, coarse = (Partial(objectives, jf.Static(n)) for n in (1500, FREQUENCIES))
    unit = sweep.points.min(axis=0)
    return {"theta sweep": sweep, **search(coarse, fine, gain_space(model, factor), model, unit, effort, key)}


def shortfall(points: np.ndarray, reference: np.ndarray) -> float:
    """By how much the points miss weakly dominating the reference: 0.01 if each reference point is within 1 %.

    For each reference point the nearest of the points, by the larger of its two ratios.
    """
    ratios = (points[None, :, :] / reference[:, None, :]).max(axis=2)
    return float(ratios.min(axis=1).max() - 1)


def excess_over_closed_form(points: np.ndarray) -> float:
    """The largest excess of J2 over the scalar front at the same J_inf."""
    K = 1 / np.sqrt(np.maximum(points[:, 1] - 1, 1e-12))
    best = closed_form(np.clip(K, (np.sqrt(5) - 1) / 2, 1.0))
    return float((points / best).max(axis=1).max() - 1)


# --- problem B --------------------------------------------------------------------------------------------------------


def corrected_mse(gains: Array, data: dict[str, Array]) -> Array:
    """(runs,) all-state MSE [km^2 ...] of the corrected estimate with constant gains (axes, n)."""

    def one(y, truth):
        def body(mean, y):
            mean = mean + gains * (y - mean[:, 0])[:, None]
            return mean @ data["F"].T, mean

        _, means = jax.lax.scan(body, data["m0"], y)
        return jnp.mean(jnp.sum((means.reshape(truth.shape) - truth) ** 2, axis=1))

    return jax.vmap(one)(data["ys"], data["truth"])


def designed_gains(params: Params, data: dict[str, Array]) -> tuple[Array, Array]:
    """Gains (axes, n) of the mixed filter for scaled Q and R, and whether it exists."""
    scale = jnp.diag(10.0 ** params["q"])

    def axis(Q, F, theta):
        model = jf.models.LinearGaussian(F, data["H"], scale @ Q, 10.0 ** params["r"] * data["R"], data["m0"][0], Q)
        P = jf.riccati(model, theta)
        values = jnp.linalg.eigvalsh(jax.lax.stop_gradient(P))
        exists = jnp.isfinite(values).all() & (values[0] > 0) & (jax.lax.stop_gradient(theta) ** 2 * values[-1] < 1)
        return gain(model, theta**2), exists

    gains, exist = jax.vmap(axis, (0, None, None))(data["Q"], data["F"], params["theta"] * data["theta_max"])
    return gains, exist.all()


def robustness(params: Params, data: dict[str, Array]) -> Array:
    """(2,) mean and 95th percentile over the runs; infinite where the filter does not exist."""
    gains, exists = designed_gains(params, data)
    mse = corrected_mse(gains, data)
    values = jnp.stack([jnp.mean(mse), jnp.quantile(mse, 0.95)])
    return jnp.where(exists & jnp.isfinite(values).all(), values, jnp.inf)


def robust_space() -> Params:
    """log10 of the scales of R and of the three groups of states in Q, and theta by the nominal theta_max."""
    return {
        "r": tune.real(0.0, -2.0, 2.0),
        "q": tune.real(np.zeros(3), -2.0, 2.0),
        "theta": tune.interval(0.3, 0.0, 3.0),
    }


def robust_data(size: tuple[int, int], key: Array) -> dict[str, Array]:
    """Runs with mismatched noise, and what the design needs."""
    runs, steps = size
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(runs))
    truth, ys = jax.jit(jax.vmap(mismatch(SAMPLED, MISMATCH, steps).simulate))(keys)
    models = axis_models(SAMPLED)
    data = {name: jnp.stack([getattr(model, name) for model in models]) for name in ("Q", "m0")}
    data |= {name: jnp.asarray(getattr(models[0], name)) for name in ("F", "H", "R")}
    return {**data, "truth": truth, "ys": ys, "theta_max": jnp.asarray(bound_of(STATIONARY))}


def sweep_b(data: dict[str, Array]) -> Found:
    """Nominal Q and R, theta up to 0.99 of the largest."""
    return _timed(_sweep_b, jnp.asarray(SHARES), data)


def _sweep_b(shares, data):
    zeros = jnp.zeros_like(shares)
    params = {"r": zeros, "q": jnp.stack([zeros] * AXES, axis=1), "theta": shares}
    return jax.vmap(robustness, (0, None))(params, data), params


def problem_b(effort: Effort, size: tuple[int, int], key: Array) -> dict[str, Found]:
    """All three methods on the same runs."""
    data_key, search_key = jax.random.split(key)
    data = robust_data(size, data_key)
    sweep = sweep_b(data)
    found = search(robustness, robustness, robust_space(), data, sweep.points.min(axis=0), effort, search_key)
    return {"theta sweep": sweep, **found}


def x_axis() -> jf.models.LinearGaussian:
    """The x axis of the scenario with T = 0.8 s."""
    return axis_model(SAMPLED, 0)
