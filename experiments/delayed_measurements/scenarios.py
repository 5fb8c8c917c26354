"""Runs of the loop over the channel, every estimator on the same runs, and how they are scored."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.delayed_measurements import plant

ALPHAS = {"printed": ((0.9, 0.5, 0.5), (0.5, 0.9, 0.5)), "swapped": ((0.5, 0.9, 0.5), (0.9, 0.5, 0.5))}  # true, assumed
MODES = ("zero_mean", "exact")
WINDOWS = (1, 3, 5, 10, 35)
LAST = 10  # samples at the end of a run, scored by themselves


class Truth(NamedTuple):
    """What the scores compare with; no filter sees it."""

    states: Array  # (T, 4)
    held: Array  # (T,) the last value received, 0 before the first


class Reported(NamedTuple):
    """What the scores look at, per step."""

    mean: Array  # (2,) h and h'
    variance: Array  # (2,)
    scale: Array | None
    status: Array


class Setup(NamedTuple):
    """One case: what is true, and what the filters believe."""

    alpha: tuple[float, ...]  # true
    assumed: tuple[float, ...]
    m0: tuple[float, ...] = plant.M0
    P0: tuple[float, ...] = plant.P0
    known: Any = 0.0  # input [m/s^4] that the filters know
    fault: Any = 0.0  # and what they do not know, on top
    offset: float = 0.0  # m, of the true mean of h(0) from that which the filters believe

    def model(self) -> jf.models.LinearGaussian:
        """The filters' model."""
        return plant.model(self.m0, self.P0)


def table3(direction: str) -> Setup:
    """Scenario ``los_table3`` with the probabilities as printed in the paper, or swapped."""
    return Setup(*ALPHAS[direction])


def with_input(direction: str) -> Setup:
    """Scenario ``los_input``: starts at rest on the line of sight, and a known input drives it away."""
    return Setup(*ALPHAS[direction], (0.0,) * 4, (0.01, 1.0, 100.0, 1000.0), 12_000.0)


def limits() -> dict[str, Setup]:
    """The right probabilities, and something else wrong."""
    alpha = ALPHAS["printed"][0]
    step = np.where(np.arange(plant.T) >= 15, 3000.0, 0.0)
    return {
        "no fault": Setup(alpha, alpha),
        "h(0) 15 m below its prior mean": Setup(alpha, alpha, offset=-15.0),
        "unmodeled step of 3000 m/s⁴": Setup(alpha, alpha, fault=step),
    }


# --- simulation: the same runs, handed over with as much as an estimator may know -------------------------------------


def draw(model: Any, u: Any, probabilities: Array, told: jf.Static, key: Array) -> jf.Draw:
    """One run. ``told`` what? nothing but y; whether something has arrived; or when it was sent."""
    states, zs = jf.simulate.simulate(model, plant.T, jax.random.fold_in(key, 0), u=u, first_update_only=True)
    delays = jf.simulate.draw_delays(probabilities, (plant.T,), jax.random.fold_in(key, 1))
    received = jf.simulate.deliver(zs, delays, plant.D)
    truth = Truth(states, held(received.ys[:, 0], received.mask[:, 0]))
    if told.value == "stamps":
        return jf.Draw(truth, **jf.lag_inputs(received.ys, received.lag[:, 0], plant.D))
    return jf.Draw(truth, received.ys, received.mask if told.value == "arrivals" else None)


def held(y: Array, arrived: Array) -> Array:
    """(T,) the last value received, 0 before the first."""
    newest = jax.lax.cummax(jnp.where(arrived, jnp.arange(len(y)), -1))
    return jnp.where(newest >= 0, y[jnp.maximum(newest, 0)], jnp.zeros((), y.dtype))


def adaptive_name(window: int, mode: str) -> str:
    return f"adaptive {window}, {mode}"


def blind(setup: Setup, windows: tuple[int, ...] = WINDOWS) -> dict[str, jf.Filter]:
    """The filters that are told nothing but y."""
    model = setup.model()
    true, assumed = (jf.models.delay_probabilities(np.array(alpha)) for alpha in (setup.alpha, setup.assumed))
    filters = {"kf_y0": jf.kalman(model)}
    for mode in MODES:
        filters[f"nominal, {mode}"] = jf.delayed_kalman(model, assumed, second_moment=mode)
        filters[f"oracle, {mode}"] = jf.delayed_kalman(model, true, second_moment=mode)
        for window in windows:
            name = adaptive_name(window, mode)
            filters[name] = jf.adaptive_delayed_kalman(model, assumed, window=window, second_moment=mode)
    return filters


def reported(state: Any, info: jf.Info) -> Reported:
    """``outputs`` of the filters."""
    del state
    assert info.cov is not None
    return Reported(info.mean[:2], jnp.diagonal(info.cov)[:2], info.extra.get("scale"), info.status)


def score(weights: Array, truth: Truth, ys: Array, out: Reported) -> dict[str, Array]:
    """Mean squares over the run: errors of h, h' and the command; and at each sample."""
    del ys
    error = out.mean - truth.states[:, :2]
    proportional = jnp.sum(weights[:, :2] * error, axis=1)
    increments = weights[:, 2] * error[:, 0]
    late = increments.at[: plant.INTEGRAL_FROM].set(0.0)
    squared = error**2
    scores = {
        "h": jnp.mean(squared[:, 0]),
        "hdot": jnp.mean(squared[:, 1]),
        "last": jnp.mean(squared[-LAST:, 0]),
        "command": jnp.mean((proportional + jnp.cumsum(increments)) ** 2),
        "command_late": jnp.mean((proportional + jnp.cumsum(late)) ** 2),  # its integral starts late, as in the paper
        "course": squared,
        "variance": out.variance,
        "hold": jnp.mean((truth.held - truth.states[:, 0]) ** 2),
    }
    return scores if out.scale is None else scores | {"scale": out.scale}


def simulate(
    setup: Setup,
    runs: int,
    seed: int,
    *,
    filters: dict[str, jf.Filter] | None = None,
    told: tuple[str, ...] = ("nothing", "open", "arrivals", "stamps"),
) -> jf.MonteCarloResult:
    """All estimators on the same runs: ``filters`` (default: all) that are told nothing but y, and the baselines.

    Each kind of ``told`` is a batch of its own, drawn with the same key. The filters that need no more than y share
    their gains over all runs; those that are told when something arrives cannot.
    """
    u = plant.inputs(setup.known)
    kalman = jf.kalman(setup.model())
    of_kind = {
        "nothing": blind(setup) if filters is None else filters,
        "open": {"open": kalman},
        "arrivals": {"kf_flag": kalman, "kf_hold": jf.hold_last(kalman)},
        "stamps": {"kf_ts": jf.kalman(jf.models.with_lags(setup.model(), plant.D))},
    }
    true = setup.model()
    true = true._replace(m0=true.m0.at[0].add(setup.offset))
    probabilities = jf.models.delay_probabilities(np.array(setup.alpha))
    true_u = plant.inputs(setup.known + setup.fault)
    weights = Partial(score, jnp.asarray(plant.command_weights()))
    parts = []
    for kind in told:
        simulator = Partial(draw, true, true_u, probabilities, jf.Static("nothing" if kind == "open" else kind))
        mask = np.zeros(plant.T, bool) if kind == "open" else None
        scenario = jf.Scenario(simulator, mask, u=u, first_update_only=True)
        key = jax.random.key(seed)
        parts.append(jf.monte_carlo(scenario, of_kind[kind], weights, runs, key, outputs=reported))
    return jf.MonteCarloResult(
        {name: scores for part in parts for name, scores in part.scores.items()},
        {name: status for part in parts for name, status in part.status.items()},
        runs,
        parts[0].chunk,
        sum(part.compile_seconds for part in parts),
        sum(part.wall_seconds for part in parts),
    )
