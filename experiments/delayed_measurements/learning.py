"""Learning the channel's probabilities from what was received: gradient, GA and NSGA-II on the same likelihood."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.delayed_measurements import plant
from experiments.delayed_measurements.scenarios import ALPHAS, draw, table3
from experiments.report import Cell, Entry, Table
from jaxfilt import tune

LABELS = {"gradient": "gradient (Adam)", "genetic": "GA", "nsga2": "NSGA-II"}
NEAR = 1e-4  # nats per sample from the lowest loss that any tuner found


class Effort(NamedTuple):
    """What a tuner may spend."""

    seconds: float  # wall time, compilation excluded
    seeds: int
    steps: int = 4000  # at most, or generations
    runs: int = 100  # of a training set
    tests: int = 1000  # fresh runs


FULL = Effort(seconds=1.0, seeds=5)


class Found(NamedTuple):
    """One direction: results by tuner, a list over seeds, and the scores of what they found."""

    results: dict[str, list[tune.TuneResult]]
    single: tune.TuneResult | None  # from one record
    test: dict[str, np.ndarray]  # MSE of h per fresh run, (seeds, runs); references (1, runs)


def space(alpha: tuple[float, ...]) -> dict[str, tune.Spec]:
    """The three probabilities on a logit scale, begun at what is assumed."""
    return {"alpha": tune.interval(np.array(alpha), 0.0, 1.0)}


def filter_with(alpha: Array) -> jf.Filter:
    """The nominal filter."""
    return jf.delayed_kalman(plant.model(), jf.models.delay_probabilities(alpha))


def loss(params: dict[str, Array], data: dict[str, Any]) -> Array:
    """Gaussian innovation pseudo-likelihood [nats per sample]; empty samples are the model's zeros, so no mask."""
    return tune.innovation_nll(filter_with(params["alpha"]), data["ys"], u=data["u"], first_update_only=True)


def losses(params: dict[str, Array], data: dict[str, Any]) -> Array:
    """The same in two parts, whose sum it is: the spread that the filter expects, and the innovations in its unit."""

    def one(y):
        return jf.filter(
            filter_with(params["alpha"]), y, u=data["u"], first_update_only=True, outputs=_likelihood
        )  # fmt: skip

    log_lik, nis = jax.vmap(one)(data["ys"])
    return jnp.stack([jnp.mean(-log_lik - 0.5 * nis), jnp.mean(0.5 * nis)])


def _likelihood(state: Any, info: jf.Info) -> tuple[Any, Any]:
    del state
    return info.log_lik, info.nis


@jax.jit
def _draw(model: Any, u: Any, probabilities: Array, keys: Array) -> tuple[Array, Array]:
    """What was received (B, T, 1), and the true h (B, T)."""
    runs = jax.vmap(Partial(draw, model, u, probabilities, jf.Static("nothing")))(keys)
    return runs.ys, runs.truth.states[..., 0]


def received(direction: str, runs: int, key: Array) -> tuple[Array, Array]:
    """Runs of scenario ``los_table3`` with the true probabilities."""
    setup = table3(direction)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(runs))
    return _draw(setup.model(), plant.inputs(), jf.models.delay_probabilities(np.array(setup.alpha)), keys)


@jax.jit
def mse(alphas: Array, u: Any, ys: Array, h: Array) -> Array:
    """(A, B) mean squared error of h over each run, for each of the probabilities (A, d+1)."""

    def one(alpha, y, truth):
        mean = jf.filter(filter_with(alpha), y, u=u, first_update_only=True, outputs=_h)
        return jnp.mean((mean - truth) ** 2)

    return jax.lax.map(lambda alpha: jax.vmap(one, (None, 0, 0))(alpha, ys, h), alphas)


def _h(state: Any, info: jf.Info) -> Array:
    del state
    return info.mean[0]


@functools.cache
def _adam() -> optax.GradientTransformation:
    """Made once, since an optimizer is compared by identity."""
    return optax.adam(0.3)


def learn(direction: str, effort: Effort, seed: int, *, tuners: tuple[str, ...] = tuple(LABELS), single: bool) -> Found:
    """All tuners from the assumed probabilities, each seed with its own runs and its own random numbers."""
    true, assumed = ALPHAS[direction]
    u = jax.tree.map(jnp.asarray, plant.inputs())
    test_key, single_key, *keys = jax.random.split(jax.random.key(seed), 2 + effort.seeds)
    results: dict[str, list[tune.TuneResult]] = {name: [] for name in tuners}
    search: dict[str, Any] = {"time_limit": effort.seconds}
    for key in keys:
        data_key, search_key = jax.random.split(key)
        data = {"ys": received(direction, effort.runs, data_key)[0], "u": u}
        given: dict[str, Any] = {"space": space(assumed), "data": data, "key": search_key, **search}
        run = {
            "gradient": lambda given: tune.gradient(loss, **given, optimizer=_adam(), steps=effort.steps),
            "genetic": lambda given: tune.genetic(loss, **given, population=16, generations=effort.steps),
            "nsga2": lambda given: tune.nsga2(losses, **given, population=16, generations=effort.steps),
        }
        for name in tuners:
            results[name].append(run[name](given))
    alone = None
    if single:
        data = {"ys": received(direction, 1, single_key)[0], "u": u}
        alone = tune.gradient(loss, space(assumed), data, key=single_key, optimizer=_adam(), steps=300)
    ys, h = received(direction, effort.tests, test_key)
    sets = {"assumed": [assumed], "true": [true]}
    sets |= {name: [result.params["alpha"] for result in found] for name, found in results.items()}
    sets |= {} if alone is None else {"one record": [alone.params["alpha"]]}
    scored = np.asarray(mse(jnp.asarray(np.concatenate([np.stack(s) for s in sets.values()])), u, ys, h))
    cuts = np.cumsum([len(s) for s in sets.values()])[:-1]
    return Found(results, alone, dict(zip(sets, np.split(scored, cuts), strict=True)))


def near(results: dict[str, list[tune.TuneResult]], name: str) -> float:
    """Median over the seeds of the seconds until the loss is near the lowest that any tuner found; may be infinite."""
    seconds = []
    for index, result in enumerate(results[name]):
        lowest = min(others[index].loss for others in results.values())
        close = result.history.best_loss <= lowest + NEAR
        seconds.append(float(result.history.wall_time[close.argmax()]) if close.any() else np.inf)
    return float(np.median(seconds))


def table(found: dict[str, Found], effort: Effort) -> Table:
    """What the tuners found, against the filter that knows the probabilities."""
    rows: list[list[Entry]] = []
    # each program is compiled once, by the first seed of the first direction
    compiled = {n: max(r.compile_time for own in found.values() for r in own.results[n]) for n in LABELS}
    for direction, own in found.items():
        true, assumed = ALPHAS[direction]
        alphas = {"assumed": [assumed], "true": [true]}
        alphas |= {name: [result.params["alpha"] for result in r] for name, r in own.results.items()}
        alphas |= {} if own.single is None else {"one record": [own.single.params["alpha"]]}
        for name in own.test:
            ratios = [jf.metrics.ratio(squares, own.test["true"][0]) for squares in own.test[name]]
            values = np.array([float(r.value) for r in ratios])
            # several seeds: their scatter over the training sets; one value: over the fresh runs
            se = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float(ratios[0].standard_error)
            row: list[Entry] = [direction, LABELS.get(name, name), _alpha(np.mean(np.stack(alphas[name]), axis=0))]
            row.append("1" if name == "true" else Cell(values.mean(), se, digits=4))
            if name in own.results:
                results = own.results[name]
                excess = [r.loss - min(o[i].loss for o in own.results.values()) for i, r in enumerate(results)]
                row += [
                    int(np.median([r.evaluations for r in results])),
                    Cell(max(excess), digits=2),
                    _seconds(near(own.results, name)),
                    _seconds(near(own.results, name) + compiled[name]),
                ]
            else:
                row += [""] * 4
            rows.append(row)
    header = ["direction", "probabilities", "alpha", "test MSE / true", "evaluations", "excess loss [nats]",
              "near after [s]", "with compilation [s]"]  # fmt: skip
    note = (
        f"{effort.runs} training runs and {effort.seeds} seeds for each tuner, which change the runs and the search; "
        f"{effort.seconds:g} s of wall time for each, compilation excluded; population 16; 'one record': 35 samples, "
        "by gradient. alpha: mean over the seeds. Test: MSE of h on "
        f"{effort.tests} fresh runs over that of the true probabilities, mean and its standard error over the seeds. "
        "Excess: the largest over the seeds of the training loss above the lowest that any tuner found with that "
        f"seed. Near: median time until that is below {NEAR:g} nats per sample; compilation took "
        f"{', '.join(f'{LABELS[n]} {seconds:.1f} s' for n, seconds in compiled.items())}."
    )
    return Table("learning", "Learning the probabilities by innovation likelihood", header, rows, note)


def _alpha(values: Any) -> str:
    return "(" + ", ".join(f"{float(x):.3f}" for x in values) + ")"


def _seconds(value: float) -> Entry:
    return Cell(value, digits=2) if np.isfinite(value) else "never"


def findings(found: dict[str, Found]) -> list[str]:
    """What the table says."""
    sentences, times, quick = [], [], True
    for direction, own in found.items():
        seconds = {name: near(own.results, name) for name in own.results}
        quick = quick and seconds["genetic"] <= seconds["gradient"]
        times.append(f"{direction} {', '.join(f'{LABELS[n]} {_seconds(value)}' for n, value in seconds.items())}")
        of = {name: float(squares.mean()) / float(own.test["true"].mean()) for name, squares in own.test.items()}
        shown = ", ".join(f"{LABELS[name]} {of[name]:.3f}" for name in own.results)
        text = f"{direction}: with the assumed ones {of['assumed']:.3f}, learned {shown}"
        sentences.append(
            text + (f", from one record of {plant.T} samples {of['one record']:.3f}" if own.single else "")
        )
    return [
        "Learning the probabilities from what was received, without any truth, removes nearly all of what wrong ones "
        f"cost. Test MSE of h relative to knowing them: {'; '.join(sentences)}.",
        f"Seconds until the training loss is within {NEAR:g} nats of the lowest found, compilation apart (median over "
        f"seeds): {'; '.join(times)}. With three parameters evolution is no slower than the gradient."
        if quick
        else f"Seconds until the training loss is within {NEAR:g} nats of the lowest found, compilation apart (median "
        f"over seeds): {'; '.join(times)}.",
    ]
