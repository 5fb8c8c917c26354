"""Tuning laid side by side: gradient, genetic algorithm and NSGA-II on the same loss, box, runs and random numbers."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.lost_target.scenarios import G1, accelerating, g1_model, matched, reported, scorer
from experiments.lost_target.tuning_figures import (
    LABELS,
    convergence,
    cost_finding,
    fronts,
    gains_finding,
    noise_finding,
    strategies_finding,
    table,
)
from experiments.report import Cell, Entry, Options, Table
from jaxfilt import tune
from jaxfilt.filters import gains
from jaxfilt.filters.alpha_beta import alpha_beta
from jaxfilt.metrics import mean, root_mean

Params = dict[str, Any]
Data = dict[str, Array]

INDEX = 0.3  # tracking index of the maneuvering target
SETTLED = 20  # samples before an alpha-beta filter's errors are scored
SIGMA = 5.0  # m, the sensor of G1: the unit of an RMSE in a weighted sum
ACCELERATION = 0.5  # m/s^2 that the filter of G1 does not know of
LENGTH = (3, 9)  # samples, artificial gaps
NOISE_RUNS = (1024, 128)  # runs of G1 in a set; the second in the quick form
WARMUP = 16  # samples before them: the blend's backtests need 12


class Effort(NamedTuple):
    """What a tuner may spend: the same number of evaluations for each."""

    starts: int
    steps: int
    population: int
    generations: int
    sets: int  # fresh sets of runs, each as large as the training set

    def __str__(self) -> str:
        return (
            f"Gradient: Adam, rate 0.1 with cosine decay, {self.starts} starts of {self.steps} steps; one evaluation "
            f"is a value and a gradient. GA, NSGA-II: population {self.population}, {self.generations} generations."
        )


FULL = Effort(starts=4, steps=300, population=30, generations=40, sets=20)
QUICK = Effort(starts=2, steps=100, population=20, generations=10, sets=10)


class Study(NamedTuple):
    """One thing to tune."""

    name: str
    title: str
    loss: Callable[[Params, Data], Array]
    losses: Callable[[Params, Data], Array]  # (2,) for NSGA-II
    weights: tuple[float, float]  # their weighted sum is the loss
    detail: Callable[[Params, Data], Array]  # (k,) what is looked at afterwards
    pair: np.ndarray  # (k, 2), detail @ pair = losses
    space: Params
    draw: Callable[[Array], Data]  # key -> a set of runs
    shown: Callable[[Params], dict[str, Array]]  # parameters as they are printed
    reference: dict[str, Params]  # not searched for; the first is where the search begins
    note: str


class Outcome(NamedTuple):
    """What came out of a study; references and tuners by name."""

    study: Study
    results: dict[str, tune.TuneResult]
    params: dict[str, Params]
    detail: dict[str, np.ndarray]  # (1 + sets, k) on the training set and on each fresh one
    sets: Data  # these sets

    def objectives(self, name: str) -> np.ndarray:
        """What NSGA-II weighs (1 + sets, 2), on the training set and on each fresh one."""
        return self.detail[name] @ self.study.pair

    def loss(self, name: str) -> np.ndarray:
        """The loss (1 + sets,), likewise."""
        return self.objectives(name) @ np.asarray(self.study.weights)

    def training_loss(self, params: Params) -> float:
        """The loss of any parameters on the training set."""
        return float(look(self.study, params, self.sets)[0] @ self.study.pair @ np.asarray(self.study.weights))

    def lowest(self) -> float:
        """The lowest training loss that any tuner found."""
        return min(result.loss for result in self.results.values())


def tuning(options: Options) -> tuple[list[Table], list[Path], list[str]]:
    """The three studies: alpha-beta gains, q and R, and the parameters of the strategies for lost measurements.

    The sizes of the training sets are part of the comparison and do not follow ``options.runs``.

    Returns:
        Tables, the figures' paths, and findings as sentences.
    """
    effort = QUICK if options.quick else FULL
    keys = jax.random.split(jax.random.key(options.seed), 4)
    likely, likelihood_table, likelihood_finding = likelihood(options.quick, keys[3])
    studies = (gains_study(options.quick), noise_study(options.quick, likely), strategies_study(options.quick))
    outcomes = [lay_side_by_side(study, effort, key) for study, key in zip(studies, keys[:3], strict=True)]
    side = [table(outcome, effort) for outcome in outcomes]
    tables = [side[0], side[1], likelihood_table, side[2], strategies_table(outcomes[2])]
    findings = [gains_finding(outcomes[0]), noise_finding(outcomes[1]), likelihood_finding]
    findings += [strategies_finding(outcomes[2]), cost_finding(outcomes)]
    directory = options.directory("lost_target")
    return tables, [convergence(outcomes, directory), fronts(outcomes, directory)], findings


def lay_side_by_side(study: Study, effort: Effort, key: Array) -> Outcome:
    """Runs the three tuners, and scores what they found on runs that they have not seen."""
    data_key, search_key = jax.random.split(key)
    sets = _draw_sets(study.draw, _keys(data_key, 1 + effort.sets))
    data = jax.tree.map(lambda x: x[0], sets)
    by_generation = {"population": effort.population, "generations": effort.generations, "key": search_key}
    results = {
        "gradient": tune.gradient(
            study.loss, study.space, data, key=search_key, optimizer=_adam(effort.steps),
            steps=effort.steps, starts=effort.starts,
        ),
        "genetic": tune.genetic(study.loss, study.space, data, **by_generation),
        "nsga2": tune.nsga2(study.losses, study.space, data, weights=study.weights, **by_generation),
    }  # fmt: skip
    params = {**study.reference, **{name: result.params for name, result in results.items()}}
    detail = {name: look(study, p, sets) for name, p in params.items()}
    return Outcome(study, results, params, detail, sets)


def look(study: Study, params: Params, sets: Data) -> np.ndarray:
    """The study's detail (sets, k)."""
    arrays = {name: jnp.asarray(value, float) for name, value in params.items()}
    return np.asarray(_on_sets(jf.aspartial(study.detail), arrays, sets))


@functools.cache
def _adam(steps: int) -> optax.GradientTransformation:
    """Made once, since an optimizer is compared by identity. The decay settles it where a loss has a kink."""
    return optax.adam(optax.cosine_decay_schedule(0.1, steps))


@jax.jit
def _draw_sets(draw: Partial, keys: Array) -> Data:
    return jax.lax.map(draw, keys)


@jax.jit
def _on_sets(detail: Partial, params: Params, sets: Data) -> Array:
    """One set at a time, for the sake of memory."""
    return jax.lax.map(lambda data: detail(params, data), sets)


def _keys(key: Array, n: int) -> Array:
    return jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(n))


# --- (a) gains of an alpha-beta filter --------------------------------------------------------------------------------


def gains_study(quick: bool) -> Study:
    """The gains for a target of tracking index 0.3, from Cohen's gains; Kalata's closed form is the optimum."""
    runs = 32 if quick else 256
    start = dict(zip("ab", map(float, gains.to_unconstrained(*gains.cohen())), strict=True))
    # Stable by construction; the box keeps out gains near the edge, of which NSGA-II would make most of its front.
    space = {name: tune.real(value, -4.0, 2.0) for name, value in start.items()}
    kalata = dict(zip("ab", gains.to_unconstrained(*gains.kalata(INDEX)), strict=True))
    return Study(
        name="tuning_gains",
        title="Tuning the gains of an alpha-beta filter",
        loss=prediction_error,
        losses=noise_and_lag,
        weights=(1.0, 1.0),
        detail=noise_and_lag,
        pair=np.eye(2),
        space=space,
        draw=Partial(_draw_maneuvering, jf.Static((runs, 100))),
        shown=gains_of,
        reference={"start (Cohen)": start, "Kalata, closed form": kalata},
        note=f"Loss: mean squared one-step prediction error in m², {runs} runs of 100 samples, the "
        f"first {SETTLED} not counted; target with piecewise constant white acceleration, tracking index {INDEX}, "
        "sensor variance 1 m². NSGA-II weighs what the measurement noise alone causes against the rest, the lag; their "
        "sum is the loss.",
    )


def _draw_maneuvering(static: jf.Static, key: Array) -> Data:
    runs, T = static.value
    P0 = [[1.0, 0.0], [0.0, 1.0]]
    model = jf.models.constant_velocity(dt=1.0, q=INDEX**2, r=1.0, m0=[0.0, 0.0], P0=P0, noise="piecewise")
    states, ys = jax.vmap(lambda k: jf.simulate.simulate(model, T, k))(_keys(key, runs))
    return {"ys": ys, "noise": ys - states[..., :1]}


def gains_of(params: Params) -> dict[str, Array]:
    """alpha and beta of the coordinates."""
    return dict(zip(("alpha", "beta"), gains.from_unconstrained(params["a"], params["b"]), strict=True))


def prediction_error(params: Params, data: Data) -> Array:
    """The loss of the gains [m²]."""
    return tune.prediction_mse(alpha_beta(*gains_of(params).values(), dt=1.0), data["ys"], warmup=SETTLED)


def noise_and_lag(params: Params, data: Data) -> Array:
    """The loss in two parts: the filter is linear, so what noise alone does can be had by filtering noise alone."""
    noise = tune.prediction_mse(alpha_beta(*gains_of(params).values(), dt=1.0), data["noise"], warmup=SETTLED)
    return jnp.stack([noise, prediction_error(params, data) - noise])


# --- (b) q and R of a Kalman filter -----------------------------------------------------------------------------------


def noise_study(quick: bool, likely: Params) -> Study:
    """q and R of the filter of G1 by what it does in the gap; ``likely`` is shown beside what is found."""
    return Study(
        name="tuning_noise",
        title="Tuning q and R by the errors in the gap",
        loss=gap_score,
        losses=gap_scores,
        weights=(1.0 / SIGMA, 1.0),
        detail=gap_scores,
        pair=np.eye(2),
        space=noise_space(),
        draw=noise_draw(quick),
        shown=_noise_shown,
        reference={"start": tune.initial(noise_space()), "truth": {"q": 0.1, "r": 25.0}, "likelihood": likely},
        note=f"G1, {NOISE_RUNS[quick]} runs. Loss: position RMSE over the gap in units of the sensor's {SIGMA:g} m, "
        "plus |log NEES| of the position over the gap; NSGA-II takes the two apart. Likelihood: q and R from the "
        "larger training set of the table of likelihoods.",
    )


def noise_draw(quick: bool) -> Partial:
    """Draws runs of G1 up to the gap's end."""
    return Partial(_draw_g1, jf.Static((NOISE_RUNS[quick], G1.last + 1)))


def noise_space() -> Params:
    """q from a hundredth of the truth, R from a tenth."""
    return {"q": tune.positive(0.001, 1e-4, 10.0), "r": tune.positive(2.5, 0.25, 2500.0)}


def _noise_shown(params: Params) -> dict[str, Array]:
    return {"q [m²/s³]": params["q"], "R [m²]": params["r"]}


def _draw_g1(static: jf.Static, key: Array) -> Data:
    runs, T = static.value
    states, ys = jax.vmap(matched(G1, g1_model()).simulate)(_keys(key, runs))
    return {"ys": ys[:, :T], "truth": states[:, :T]}


def noise_filter(params: Params) -> jf.Filter:
    """The filter of G1 with other noise."""
    m0, P0 = [0.0, 10.0], [[100.0, 0.0], [0.0, 25.0]]
    return jf.kalman(jf.models.constant_velocity(dt=1.0, q=params["q"], r=params["r"], m0=m0, P0=P0))


def gap_scores(params: Params, data: Data) -> Array:
    """Position RMSE over the gap [m], and |log NEES| there."""
    run = noise_filter(params), data["ys"], data["truth"]
    options = {"components": (0,), "window": slice(G1.first, G1.last + 1), "mask": G1.mask[: G1.last + 1]}
    scores = (score(*run, **options, first_update_only=True) for score in (tune.rmse, tune.consistency))
    return jnp.stack(list(scores))


def gap_score(params: Params, data: Data) -> Array:
    """The two as one number."""
    error, inconsistency = gap_scores(params, data)
    return error / SIGMA + inconsistency


def innovation_loss(params: Params, data: Data) -> Array:
    """Negative log-likelihood per sample [nats]."""
    return tune.innovation_nll(noise_filter(params), data["ys"], first_update_only=True)


def likelihood(quick: bool, key: Array) -> tuple[Params, Table, str]:
    """q and R by innovation likelihood on the samples before the gap: a small training set and a large one.

    Returns:
        The parameters from the larger one, the table and its finding.
    """
    rows: list[list[Entry]] = []
    draw_key, search_key = jax.random.split(key)
    # Drawn like the sets of the study, which saves a compilation.
    effort, draw = (QUICK if quick else FULL), noise_draw(quick)
    ys = _draw_sets(draw, _keys(draw_key, 1 + effort.sets))["ys"].reshape(-1, G1.last + 1, 1)
    found = [_most_likely(runs, ys, search_key) for runs in ((1408,) if quick else (64, 12_800))]
    for runs, result, errors in found:
        q, r = float(result.params["q"]), float(result.params["r"])
        row: list[Entry] = [f"{runs} runs", Cell(result.loss, digits=5), Cell(q, q * errors[0]), Cell(r, r * errors[1])]
        rows.append([*row, 100 * (q / 0.1 - 1), 100 * (r / 25.0 - 1), result.evaluations, result.wall_time])
    header = [
        "training set",
        "NLL [nats]",
        "q [m²/s³]",
        "R [m²]",
        "q off [%]",
        "R off [%]",
        "evaluations",
        "wall time [s]",
    ]
    note = (
        f"The {G1.first} samples before the gap of G1; Adam, rate 0.1, 300 steps from q = 0.001, R = 2.5; truth 0.1 "
        "and 25. Standard errors from the curvature of the likelihood."
    )
    parts = [
        f"{100 * abs(float(result.params['q']) / 0.1 - 1):.1f} % from the true q with {runs} runs, whose samples "
        f"determine it to {100 * errors[0]:.1f} % (one standard error)"
        for runs, result, errors in found
    ]
    finding = f"Innovation likelihood from q = 0.001: {'; '.join(parts)}."
    return (
        found[-1][1].params,
        Table("tuning_likelihood", "q and R by innovation likelihood", header, rows, note),
        finding,
    )


def _most_likely(runs: int, ys: Array, key: Array) -> tuple[int, tune.TuneResult, np.ndarray]:
    data = {"ys": ys[:runs, : G1.first]}
    result = tune.gradient(innovation_loss, noise_space(), data, key=key, steps=300)
    return runs, result, _standard_errors(result.params, data)


def _standard_errors(params: Params, data: Data) -> np.ndarray:
    """Of log q and log R: from the curvature of the total likelihood, by differences (a Hessian compiles for long)."""
    step, offsets = 0.05, np.array([[i, j] for i in (-1, 0, 1) for j in (-1, 0, 1)], float)
    z = np.log([float(params["q"]), float(params["r"])]) + step * offsets
    losses = np.asarray(_on_grid({"q": jnp.asarray(np.exp(z[:, 0])), "r": jnp.asarray(np.exp(z[:, 1]))}, data))
    (a, b, c), (d, e, f), (g, h, i) = losses.reshape(3, 3)
    mixed = (a - c - g + i) / 4
    curvature = np.array([[b - 2 * e + h, mixed], [mixed, d - 2 * e + f]]) / step**2
    return np.sqrt(np.diagonal(np.linalg.inv(curvature * data["ys"].size)))


@jax.jit
def _on_grid(params: Params, data: Data) -> Array:
    return jax.vmap(innovation_loss, (0, None))(params, data)


# --- (c) parameters of the strategies for lost measurements -----------------------------------------------------------


def strategies_study(quick: bool) -> Study:
    """Inflation, forgetting and blend, for a filter that does not know of the target's acceleration."""
    runs = 32 if quick else 64
    space = {"phi": tune.positive(1.0, 0.1, 1e5), "forgetting": tune.unit(0.9)}
    if not quick:
        space |= {"exponent": tune.positive(2.0, 0.02, 200.0), "floor": tune.positive(0.25, 2.5e-3, 25.0)}
    count = len(strategies(tune.initial(space)))
    return Study(
        name="tuning_strategies",
        title="Tuning the strategies for lost measurements",
        loss=bridging,
        losses=bridging_and_error,
        weights=(1.0, 0.0),
        detail=bridging_detail,
        pair=np.concatenate([np.tile([1 / count, 0.0], (count, 1)), [[0.0, 1.0]], np.zeros((4 * count, 2))]),
        space=space,
        draw=Partial(_draw_accelerating, jf.Static(runs)),
        shown=dict,
        reference={"start": tune.initial(space)},
        note=f"G1's constant-velocity filter (q = 0.1) on a target that accelerates by {ACCELERATION} m/s², {runs} "
        f"runs. Loss: predictive negative log-likelihood in nats per sample hidden in an artificial gap of {LENGTH[0]} "
        f"to {LENGTH[1]} samples, one per run at random; mean over {count} strategies that share no parameter: "
        "coasting with Q times phi; fit N20 p2 with forgetting; blend with exponent and floor (not in the quick "
        "form). NSGA-II's second objective is the RMSE of fit and blend in the gap of G1.",
    )


def _draw_accelerating(static: jf.Static, key: Array) -> Data:
    states, ys = jax.vmap(accelerating(G1, g1_model(0.0), ACCELERATION).simulate)(_keys(key, static.value))
    return {"ys": ys, "truth": states, "key": jax.random.fold_in(key, 2**31)}


def strategies(params: Params) -> dict[str, jf.Filter]:
    """The strategies whose parameters are given."""
    filt = jf.kalman(g1_model())
    chosen = {
        "coast_inflated": jf.coast_inflated(filt, params["phi"]),
        "fit N20 p2": jf.polynomial_fit(filt, window=20, degree=2, forgetting=params["forgetting"]),
    }
    if "exponent" in params:
        chosen["blend"] = jf.blend(filt, exponent=params["exponent"], floor=params["floor"])
    return chosen


SCORES = ("gap", "end", "after", "nees")
PARAMETERS = {"coast_inflated": ("phi",), "fit N20 p2": ("forgetting",), "blend": ("exponent", "floor")}


def bridging_parts(params: Params, data: Data) -> Array:
    """Predictive negative log-likelihood of hidden samples [nats], by strategy."""
    how = {"length": LENGTH, "warmup": WARMUP, "first_update_only": True}
    parts = [
        _reported_nll(filt, data["ys"], data["key"])
        if name == "blend"
        else tune.masked_nll(filt, data["ys"], data["key"], **how)
        for name, filt in strategies(params).items()
    ]
    return jnp.stack(parts)


def bridging(params: Params, data: Data) -> Array:
    """The loss of the strategies: the mean of the parts."""
    return jnp.mean(bridging_parts(params, data))


def bridging_and_error(params: Params, data: Data) -> Array:
    """The loss, and the RMSE [m] in the gap of G1 of what is reported; inflation cannot change its own."""
    return jnp.stack([bridging(params, data), _reported_error(gap_of_g1(params, data))])


def bridging_detail(params: Params, data: Data) -> Array:
    """The parts of the loss, the RMSE of what is reported, and each strategy's scores (4,) in the gap of G1."""
    scores = gap_of_g1(params, data)
    # By name: what vmap returns has its keys sorted.
    listed = [scores[strategy][score] for strategy in strategies(params) for score in SCORES]
    return jnp.concatenate([bridging_parts(params, data), jnp.stack([_reported_error(scores), *listed])])


def _reported_error(scores: dict[str, dict[str, Array]]) -> Array:
    return jnp.sqrt(jnp.mean(jnp.stack([score["gap"] for name, score in scores.items() if name != "coast_inflated"])))


def _reported_nll(filt: jf.Filter, ys: Array, key: Array) -> Array:
    """As ``tune.masked_nll``, for what the blend reports: its parameters never enter the filter's own likelihood."""

    def one(y, key):
        gap = tune.random_gap(key, y.shape[0], length=LENGTH, warmup=WARMUP)
        position, variance = jf.filter(filt, y, mask=~gap, outputs=_report_and_variance, first_update_only=True)
        error = y[:, 0] - position
        nll = 0.5 * (error * error / variance + jnp.log(2.0 * np.pi * variance))
        return jnp.where(gap, nll, 0.0).sum(), gap.sum()

    total, count = jax.vmap(one)(ys, _keys(key, ys.shape[0]))
    return total.sum() / count.sum().astype(ys.dtype)


def _report_and_variance(state: Any, info: jf.Info) -> tuple[Array, Array]:
    del state
    assert info.innovation_cov is not None
    return info.extra["reported"][0], info.innovation_cov[0, 0]


def gap_of_g1(params: Params, data: Data) -> dict[str, dict[str, Array]]:
    """Mean squared errors of each strategy in the gap of G1, at its end and after; NEES at its end."""

    def one(y, truth):
        options = {"mask": G1.mask, "outputs": reported, "first_update_only": True}
        return {name: scorer(G1)(truth, y, jf.filter(filt, y, **options)) for name, filt in strategies(params).items()}

    scores = jax.vmap(one)(data["ys"], data["truth"])
    return jax.tree.map(jnp.mean, scores)


def strategies_table(outcome: Outcome) -> Table:
    """Each strategy before and after tuning, on fresh runs: masked segments, and the gap of G1."""
    tuned = min(LABELS, key=lambda name: outcome.results[name].loss)
    names = list(strategies(outcome.params["start"]))
    rows: list[list[Entry]] = []
    for i, strategy in enumerate(names):
        for name, when in (("start", "before"), (tuned, "after")):
            fresh = outcome.detail[name][1:]
            scores = fresh[:, len(names) + 1 :].reshape(len(fresh), len(names), len(SCORES))[:, i]
            row: list[Entry] = [strategy, when]
            row.append(", ".join(f"{p} {float(outcome.params[name][p]):.3g}" for p in PARAMETERS[strategy]))
            # The first three scores are mean squares, the last is the NEES.
            estimates = [mean(fresh[:, i]), *(root_mean(scores[:, k]) for k in range(3)), mean(scores[:, 3])]
            rows.append([*row, *(Cell(float(e.value), float(e.standard_error)) for e in estimates)])
    header = ["strategy", "tuning", "parameters", "NLL, masked", "RMSE gap [m]", "end [m]", "after [m]", "NEES at end"]
    note = (
        f"Fresh runs of the table above, gap of G1; parameters of the lowest training loss ({LABELS[tuned]}). NLL in "
        "nats per sample. Blend: errors of its report; NEES with the filter's variance."
    )
    runs = int(np.prod(outcome.sets["ys"].shape[:2])) - outcome.sets["ys"].shape[1]
    return Table("tuning_strategies_gap", "The strategies before and after tuning", header, rows, note, runs)
