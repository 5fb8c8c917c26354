"""Bursts of measurement noise: a tunable Takagi-Sugeno filter beside other ways to learn the noise while filtering."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.balloon.system import METRES, SAMPLED, STEPS, UNIVERSE, axis_models, joint_model, side_by_side
from experiments.lost_target.tuning import Outcome, Study, look
from experiments.lost_target.tuning_figures import LABELS
from experiments.report import Cell, Entry, Table
from jaxfilt import tune
from jaxfilt.metrics import mean, ratio

BURST = 25.0  # times R
WINDOW = (30, 69)  # samples, quiet and noisy in turn
TRAINING = (64, 200)  # runs, samples
UNIT = 1e-4  # km^2, of the mean squared errors shown
LEVELS = 4

Params = dict[str, Any]
Data = dict[str, Array]


def scaled_noise(R: Array, u: Array, dt: Any) -> Array:
    """R times what the run's time table says."""
    del dt
    return u * R


def bursts(steps: int, key: Array) -> Array:
    """(steps,) factors on R: windows of random length, quiet (1) and noisy in turn, the first one quiet."""
    count = steps // WINDOW[0] + 1
    ends = jnp.cumsum(jax.random.randint(key, (count,), WINDOW[0], WINDOW[1] + 1))
    window = jnp.sum((np.arange(steps)[:, None] >= ends[None, :]).astype(np.int32), axis=1)
    return jnp.where(window % 2 == 1, BURST, 1.0)


def draw(model: jf.models.LinearGaussian, static: jf.Static, key: Array) -> jf.Draw:
    """One run; its ``u`` (T,) are the factors on R, which only the filter that is told them reads."""
    burst_key, run_key = jax.random.split(key)
    u = bursts(static.value, burst_key)
    noisy = model._replace(R=Partial(scaled_noise, model.R))
    return jf.Draw(*jf.simulate.simulate(noisy, static.value, run_key, u=u, first_update_only=True), u=u)


def scenario(steps: int = STEPS) -> Partial:
    """key -> one run."""
    return Partial(draw, joint_model(SAMPLED), jf.Static(steps))


def kalman(r: Any = 1.0, q: Any = (1.0, 1.0, 1.0)) -> jf.Filter:
    """The Kalman filter with R times r, and Q times q for positions, velocities and accelerations."""
    q = jnp.diag(jnp.asarray(q, float))
    return side_by_side([jf.kalman(m._replace(R=r * m.R, Q=q @ m.Q)) for m in axis_models(SAMPLED)])


def told() -> jf.Filter:
    """The Kalman filter that is told the true R of each sample."""
    return side_by_side([jf.kalman(m._replace(R=Partial(scaled_noise, m.R))) for m in axis_models(SAMPLED)])


def printed_law() -> jf.Filter:
    """Q and R divided by the printed fuzzy system's output, in the Kalman filter."""
    return jf.fuzzy_scaled(kalman(), jf.fuzzy.mamdani(UNIVERSE), unit=METRES)


def takagi_sugeno(params: Mapping[str, Any]) -> jf.Filter:
    """The smooth fuzzy filter for the fields of :class:`jaxfilt.FuzzyNoise`."""
    return jf.fuzzy_noise(kalman(), jf.FuzzyNoise(**params), unit=METRES)


def start() -> Params:
    """Its parameters near the printed law."""
    return jf.fuzzy_noise_parameters(UNIVERSE)._asdict()


def space() -> Params:
    """What the tuners search: 27 numbers, the same box for all."""
    p = start()
    return {
        "forgetting": tune.unit(p["forgetting"]),
        "gaps": tune.positive(p["gaps"], p["gaps"] / 20, 20 * p["gaps"]),
        "widths": tune.positive(p["widths"], p["widths"] / 20, 20 * p["widths"]),
        "log_alpha_r": tune.real(p["log_alpha_r"], -4.6, 4.6),
        "log_alpha_q": tune.real(p["log_alpha_q"], -4.6, 4.6),
    }


def _mean(state: Any, info: jf.Info) -> Array:
    del state
    return info.mean


def run_mse(filt: jf.Filter, data: Data) -> Array:
    """(runs,) mean squared error of all states over time [1e-4 km^2, and km^2/s^2, km^2/s^4 alike]."""

    def one(y, truth, u):
        mean = jf.filter(filt, y, u=u, outputs=_mean, first_update_only=True)
        return jnp.mean(jnp.sum((mean - truth) ** 2, axis=1)) / UNIT

    return jax.vmap(one)(data["ys"], data["truth"], data["u"])


def draw_set(static: jf.Static, key: Array) -> Data:
    """A set of ``(runs, samples)``, one key per run."""
    runs, steps = static.value
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(runs))
    run = jax.vmap(scenario(steps))(keys)
    return {"ys": run.ys, "truth": run.truth, "u": run.u}


def loss(params: Params, data: Data) -> Array:
    """Mean over the runs."""
    return jnp.mean(run_mse(takagi_sugeno(params), data))


def losses(params: Params, data: Data) -> Array:
    """Mean and 95th percentile over the runs."""
    return summary(run_mse(takagi_sugeno(params), data))


def summary(mse: Array) -> Array:
    """(2,) mean and 95th percentile of the runs' errors."""
    return jnp.stack([jnp.mean(mse), jnp.quantile(mse, 0.95)])


def constant_space() -> Params:
    """Constant Q and R: the scales of R and of the three groups of states in Q."""
    return {"r": tune.positive(1.0, 1e-2, 1e3), "q": tune.positive(np.ones(3), 1e-3, 1e3)}


def constant_loss(params: Params, data: Data) -> Array:
    """The same loss for constant Q and R."""
    return jnp.mean(run_mse(kalman(params["r"], params["q"]), data))


# ------------------------------------------------------------------------------------------------ tuning and testing


class Effort(NamedTuple):
    """What a tuner may spend, in starts x steps (value and gradient) or population x generations."""

    starts: int
    steps: int
    population: int
    generations: int
    sets: int  # fresh sets of runs, each as large as the training set
    training: tuple[int, int] = TRAINING

    def __str__(self) -> str:
        return (
            f"Gradient: Adam, rate 0.1 with cosine decay, {self.starts} starts of {self.steps} steps, the first from "
            f"the printed law, the others up to {SPREAD:g} of the way to a random point of the box; one evaluation is "
            f"a value and a gradient. GA, NSGA-II: population {self.population}, {self.generations} generations, "
            "the printed law and uniform draws from the box at first. About the same wall time for each."
        )


SPREAD = 0.3
FULL = Effort(starts=4, steps=150, population=40, generations=60, sets=10)


def study(effort: Effort) -> Study:
    """One vector, one box and one set of training runs for all three tuners."""
    runs, steps = effort.training
    return Study(
        name="balloon_tuning",
        title="Setting D: tuning the Takagi-Sugeno filter",
        loss=loss,
        losses=losses,
        weights=(1.0, 0.0),
        detail=losses,
        pair=np.eye(2),
        space=space(),
        draw=Partial(draw_set, jf.Static(effort.training)),
        shown=factors,
        reference={"printed law (start)": start()},
        note=f"{tune.size(space())} numbers: the memberships' crossing points and widths on each axis, levels of R and "
        f"of Q, and the forgetting. Loss: mean all-state MSE over {runs} runs of {steps} samples [1e-4 km²]. NSGA-II "
        "weighs it against the 95th percentile over the runs; its row is the point of its front with the lowest mean. "
        "Last columns: forgetting, and the factor on R at the four levels.",
    )


def factors(params: Params) -> dict[str, Array]:
    """What is shown of the parameters."""
    shown = {"forgetting": params["forgetting"]}
    return shown | {f"R, level {i + 1}": jnp.exp(-params["log_alpha_r"][i]) for i in range(LEVELS)}


def lay_side_by_side(effort: Effort, key: Array) -> Outcome:
    """Runs the three tuners, and scores what they found on runs that they have not seen."""
    what = study(effort)
    data_key, search_key = jax.random.split(key)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(data_key, jnp.arange(1 + effort.sets))
    sets = jax.jit(jax.vmap(what.draw))(keys)
    data = jax.tree.map(lambda x: x[0], sets)
    by_generation = {"population": effort.population, "generations": effort.generations, "key": search_key}
    optimizer = optax.adam(optax.cosine_decay_schedule(0.1, effort.steps))
    results = {
        "gradient": tune.gradient(
            loss, what.space, data, key=search_key, optimizer=optimizer, steps=effort.steps, starts=effort.starts,
            spread=SPREAD,
        ),
        "genetic": tune.genetic(loss, what.space, data, **by_generation),
        "nsga2": tune.nsga2(losses, what.space, data, weights=what.weights, **by_generation),
    }  # fmt: skip
    params = {**what.reference, **{name: result.params for name, result in results.items()}}
    return Outcome(what, results, params, {name: look(what, p, sets) for name, p in params.items()}, sets)


def rivals(data: Data, steps: int, key: Array) -> dict[str, jf.Filter]:
    """What the tuned filter is compared with; the parameters of two of them are tuned on the same runs by Adam."""
    optimizer = optax.adam(optax.cosine_decay_schedule(0.1, steps))
    constant = constant_tuned(data, steps, key)
    sage = tune.gradient(sage_loss, {"forgetting": tune.unit(0.9), "prior": tune.positive(10.0, 0.1, 1e3)}, data,
                         key=key, optimizer=optimizer, steps=steps).params  # fmt: skip
    return {
        NOMINAL: kalman(),
        "printed law, Mamdani": printed_law(),
        "Sage-Husa": jf.sage_husa(kalman()),
        "Sage-Husa, tuned": jf.sage_husa(kalman(), **sage),
        "covariance matching, window 30": jf.covariance_matching(kalman()),
        "covariance matching, window 10": jf.covariance_matching(kalman(), window=10),
        CONSTANT: kalman(constant["r"], constant["q"]),
        TOLD: told(),
    }


NOMINAL, CONSTANT, TOLD = "Kalman, nominal", "Kalman, constant Q and R tuned", "Kalman, told the true R"
START = "TS, printed law (start)"
TUNED = {"gradient": "TS, tuned by Adam", "genetic": "TS, tuned by GA", "nsga2": "TS, tuned by NSGA-II"}


def sage_loss(params: Params, data: Data) -> Array:
    """The same loss for the estimator of Sage and Husa."""
    return jnp.mean(run_mse(jf.sage_husa(kalman(), **params), data))


_run_mse = jax.jit(run_mse)
_draw_set = jax.jit(draw_set)


def trial(filters: Mapping[str, jf.Filter], runs: int, key: Array, steps: int = STEPS) -> dict[str, np.ndarray]:
    """(runs,) all-state MSE [1e-4 km²] of each filter on fresh runs."""
    data = _draw_set(jf.Static((runs, steps)), key)
    return {name: np.asarray(_run_mse(filt, data)) for name, filt in filters.items()}


def trial_table(mse: Mapping[str, np.ndarray], runs: int, steps: int = STEPS) -> Table:
    """Setting D on fresh runs."""
    rng = np.random.default_rng(0)
    drawn = rng.integers(0, runs, (200, runs))
    rows: list[list[Entry]] = []
    for name, x in mse.items():
        m, over = mean(x), ratio(x, mse[NOMINAL])
        tail = Cell(np.quantile(x, 0.95), np.quantile(x[drawn], 0.95, axis=1).std(ddof=1))
        rows.append([name, Cell(m.value, m.standard_error), tail, Cell(over.value, over.standard_error)])
    note = (
        f"All-state MSE per run of {steps} samples, in 1e-4 km² (velocities and accelerations count in km/s and "
        f"km/s²); measurement noise alternates between R and {BURST:g} R in windows of {WINDOW[0]} to {WINDOW[1]} "
        "samples."
    )
    header = ["filter", "MSE", "95th percentile", f"MSE / {NOMINAL}"]
    return Table("balloon_bursts", "Setting D: bursts of measurement noise", header, rows, note, runs)


def constant_tuned(data: Data, steps: int, key: Array) -> Params:
    """Constant Q and R for the same runs, by Adam."""
    optimizer = optax.adam(optax.cosine_decay_schedule(0.1, steps))
    space = constant_space()
    return tune.gradient(constant_loss, space, data, key=key, optimizer=optimizer, steps=steps).params


def repeats(outcomes: Mapping[int, Outcome], steps: int) -> tuple[Table, str]:
    """The same tuning on other training runs: the loss on fresh runs, over that of constant Q and R tuned likewise."""
    rows: list[list[Entry]] = []
    over: dict[str, list[float]] = {name: [] for name in LABELS}
    for seed, outcome in outcomes.items():
        constant = constant_tuned(jax.tree.map(lambda x: x[0], outcome.sets), steps, jax.random.key(seed))
        alone = np.asarray(_constant_losses(constant, jax.tree.map(lambda x: x[1:], outcome.sets)))
        row: list[Entry] = [f"seed {seed}", Cell(alone.mean(), alone.std(ddof=1) / np.sqrt(len(alone)))]
        for name in LABELS:
            r = ratio(outcome.loss(name)[1:], alone)
            over[name].append(float(r.value))
            row += [outcome.results[name].loss, Cell(r.value, r.standard_error)]
        rows.append(row)
    header = ["runs", "constant Q and R"]
    for label in LABELS.values():
        header += [f"{label}, training", f"{label} / constant"]
    note = (
        "Other training runs and another search for each seed. Constant Q and R: its loss on fresh runs; the ratios "
        "are of losses on fresh runs, the losses beside them those in training [1e-4 km²]."
    )
    parts = ", ".join(f"{LABELS[name]} {min(x):.3f} to {max(x):.3f}" for name, x in over.items())
    return Table("balloon_repeats", "Setting D: the tuning repeated", header, rows, note), (
        f"One tuning says little about a tuner: over {len(rows)} sets of training runs, the loss on fresh runs over "
        f"that of tuned constant Q and R is {parts}."
    )


@jax.jit
def _constant_losses(params: Params, sets: Data) -> Array:
    return jax.vmap(constant_loss, (None, 0))(params, sets)


def finding(outcome: Outcome, mse: Mapping[str, np.ndarray]) -> list[str]:
    """What the two tables say."""

    def over(a, b):
        r = ratio(mse[a], mse[b])
        return f"{Cell(r.value, r.standard_error)}"

    best = min(TUNED, key=lambda name: outcome.results[name].loss)
    name = TUNED[best]
    levels = ", ".join(f"{float(x):.3g}" for x in factors(outcome.params[best]).values())
    front = outcome.results["nsga2"].front
    assert front is not None
    losses = ", ".join(
        f"{LABELS[n]} {r.loss:.3f} after {r.evaluations} evaluations in {r.wall_time:.0f} s "
        f"(compilation {r.compile_time:.0f} s)"
        for n, r in outcome.results.items()
    )
    return [
        f"Bursts of measurement noise (setting D), MSE over that of the nominal Kalman filter: printed law "
        f"{over('printed law, Mamdani', NOMINAL)}, {name} {over(name, NOMINAL)}, Sage-Husa as it comes "
        f"{over('Sage-Husa', NOMINAL)} and tuned {over('Sage-Husa, tuned', NOMINAL)}, covariance matching "
        f"{over('covariance matching, window 30', NOMINAL)} (window 30) and "
        f"{over('covariance matching, window 10', NOMINAL)} (10), constant Q and R tuned {over(CONSTANT, NOMINAL)}, "
        f"told the true R {over(TOLD, NOMINAL)}. {name} is {over(name, CONSTANT)} of the tuned constants and "
        f"{over(name, TOLD)} of the filter that is told R.",
        f"Same vector, box and runs: training loss {losses}. The lowest is {LABELS[best]}'s; forgetting and factors on "
        f"R at its four levels: {levels}. NSGA-II's front goes from mean {front.losses[:, 0].min():.3f} to 95th "
        f"percentile {front.losses[:, 1].min():.3f} (at mean {front.losses[front.losses[:, 1].argmin(), 0]:.3f}), "
        f"{len(front.losses)} points.",
    ]
