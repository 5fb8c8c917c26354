"""Lost targets: the strategies' tables and figure, the batch of 100 000 runs, tuning side by side, recorded flights."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import jaxfilt as jf
from experiments.lost_target import figures, scenarios
from experiments.lost_target.flights import flights
from experiments.lost_target.scenarios import G1, G2, Gap
from experiments.lost_target.sine_gap import sine_gap
from experiments.lost_target.tuning import tuning
from experiments.lost_target.turn_gap import turn_gap
from experiments.report import Cell, Entry, Options, Report, Table, peak_memory

TITLE = "A target lost for a part of its path: G1 to G4, tuning side by side, glider flights"
MAIN = True

ACCELERATION = 0.5  # m/s^2, of the target that the constant-velocity filter does not model
CA_FILTER = "coast, CA filter"  # the right model, for the accelerating target
BIG = ("coast", "blend", "fit N10 p1")  # the strategies of the batch of 100 000 runs


class Regime(NamedTuple):
    """One table: what is true and what the filter believes."""

    name: str
    title: str
    gap: Gap
    scenario: jf.Scenario
    model: jf.models.LinearGaussian


def regimes() -> list[Regime]:
    """The matched and mismatched cases of both scenarios."""
    g1, g2 = scenarios.g1_model(), scenarios.g2_model()
    g1_truth, g2_truth = scenarios.matched(G1, g1), scenarios.matched(G2, g2)
    g1_accelerates = scenarios.accelerating(G1, scenarios.g1_model(0.0), ACCELERATION)
    return [
        Regime("g1-matched", "G1, matched: CV filter, q = 0.1", G1, g1_truth, g1),
        Regime("g1-accelerating", "G1, truth accelerates 0.5 m/s², CV filter, q = 0.1", G1, g1_accelerates, g1),
        Regime("g1-q-small", "G1, filter's q 100 times too small", G1, g1_truth, scenarios.g1_model(0.001)),
        Regime("g1-q-large", "G1, filter's q 100 times too large", G1, g1_truth, scenarios.g1_model(10.0)),
        Regime("g2-matched", "G2, matched: CA filter, q = 0.05", G2, g2_truth, g2),
        Regime("g2-velocity", "G2, CV filter (q = 1) on the same truth", G2, g2_truth, scenarios.g2_velocity_model()),
    ]


def simulate(
    regime: Regime, runs: int, seed: int, strategies: tuple[str, ...] | None = None, *, course: bool = False
) -> jf.MonteCarloResult:
    """The strategies of a regime (or some of them) on the same runs; G1's accelerating truth also with a CA filter."""
    chosen = regime.gap.strategies if strategies is None else {name: regime.gap.strategies[name] for name in strategies}
    filters = {name: strategy(jf.kalman(regime.model)) for name, strategy in chosen.items()}
    if regime.name == "g1-accelerating" and strategies is None:
        filters[CA_FILTER] = jf.kalman(scenarios.g1_acceleration_model())
    return jf.monte_carlo(
        regime.scenario,
        filters,
        scenarios.scorer(regime.gap, course=course),
        runs,
        jax.random.key(seed),
        outputs=scenarios.reported,
    )


def table(regime: Regime, result: jf.MonteCarloResult) -> Table:
    """RMSE over the gap, at its end and after it, and NEES, with standard errors."""
    rows = []
    order = [name for name in [*regime.gap.strategies, CA_FILTER] if name in result.scores]
    for name in order:
        cells = [Cell.of(result.root_mean(name, part)) for part in ("gap", "end", "after")]
        rows.append([name, *cells, Cell.of(result.mean(name, "nees"))])
    gap = regime.gap
    note = (
        f"Position RMSE [m] over samples {gap.first} to {gap.last}, at sample {gap.last}, and over the {gap.after} "
        "samples after it; "
        f"NEES of the filter's own position at sample {gap.last} (1 is honest). Standard errors over runs."
    )
    header = ["strategy", "gap", "end", "after", "NEES"]
    return Table(regime.name, regime.title, header, rows, note, result.runs)


def big_batch(options: Options) -> tuple[Table, dict[str, object]]:
    """G1, matched, in a batch of 100 000 runs."""
    runs = options.count(100_000, 20_000) if not options.quick else 20_000
    regime = regimes()[0]
    result = simulate(regime, runs, options.seed, BIG)
    made = table(regime._replace(name="g1-100000", title=f"G1, matched, in one batch of {runs:,} runs"), result)
    facts: dict[str, object] = {
        "large batch": (
            f"{runs:,} runs of {len(BIG)} strategies over {G1.T} samples in {result.wall_seconds:.2f} s "
            f"(compilation {result.compile_seconds:.1f} s apart): {result.runs_per_second:,.0f} runs per second, "
            f"{result.runs_per_second * G1.T * len(BIG):,.0f} filter steps per second, chunks of {result.chunk}"
        ),
        "peak memory after the large batch": f"{peak_memory() / 2**20:.0f} MiB, everything before it included",
    }
    return made, facts


def wiener_table(options: Options) -> Table:
    """The two-dimensional Wiener-acceleration target of the thesis (its figures 2-7 to 2-9 give no numbers)."""
    runs = options.count(1000, 200)
    result = jf.monte_carlo(
        scenarios.wiener_scenario(),
        {"KF": jf.kalman(scenarios.wiener_model())},
        scenarios.wiener_score,
        runs,
        jax.random.key(options.seed),
    )
    rows = [
        ["measurement alone", "10.0", Cell.of(result.mean("KF", "raw"))],
        ["Kalman filter", "4.09", Cell.of(result.mean("KF", "filtered"))],
        ["RTS smoother", "1.03", Cell.of(result.mean("KF", "smoothed"))],
    ]
    header = ["estimate", "theory, prior-drawn start", "ours"]
    note = "Position MSE per axis [m²] over 50 samples. Started at x0 = m0, so below the theory for a drawn start."
    return Table("wiener", "Two-dimensional Wiener acceleration, no gap", header, rows, note, runs)


def claims(results: dict[str, jf.MonteCarloResult]) -> Table:
    """What the thesis's figures claim, beside the measured ratio of RMSEs in the gap."""
    g1, g2 = results["g1-matched"], results["g2-matched"]
    wrong = results["g2-velocity"]

    never = "never plotted: coasting"
    claimed = [
        ("Fig. 4-4: the mean of recent samples fails (G1)", g1, "mean 5", "coast", "gap"),
        ("Fig. 4-8: a fitted function tracks a CV target (G1)", g1, "mean 5", "fit N10 p1", "gap"),
        ("the same against holding the last sample (G1)", g1, "hold", "fit N10 p1", "gap"),
        ("Figs. 4-6, 4-7: mean drifts, fit is a “considerable improvement” (G2)", g2, "mean 5", "fit N20 p2", "gap"),
        (f"{never}, in the gap (G1)", g1, "fit N10 p1", "coast", "gap"),
        (f"{never}, after the gap (G1)", g1, "fit N10 p1", "coast", "after"),
        (f"{never}, in the gap (G2)", g2, "fit N20 p2", "coast", "gap"),
        (f"{never}, after the gap (G2)", g2, "fit N20 p2", "coast", "after"),
        (f"{never}, with a structurally wrong filter (G2, CV), in the gap", wrong, "fit N20 p2", "coast", "gap"),
    ]
    rows: list[list[Entry]] = [
        [claim, "none", f"{a} / {b}", Cell.of(result.ratio((a, part), (b, part), root=True))]
        for claim, result, a, b, part in claimed
    ]
    header = ["the thesis", "its number", "ratio of RMSEs", "ours"]
    note = "The thesis shows single runs as figures and prints no numbers for this part. Paired standard errors."
    return Table("claims", "The thesis's claims, measured", header, rows, note, g1.runs)


def findings(results: dict[str, jf.MonteCarloResult]) -> list[str]:
    """What the tables say, in sentences whose numbers are computed."""

    def r(regime, a, b, part="gap"):
        estimate = results[regime].ratio((a, part), (b, part), root=True)
        return f"{float(estimate.value):.2f}"

    def nees(regime, name):
        return f"{float(results[regime].mean(name, 'nees').value):.2g}"

    g1, g2, moving, wrong = "g1-matched", "g2-matched", "g1-accelerating", "g2-velocity"
    fit1, fit2 = "fit N10 p1", "fit N20 p2"
    return [
        "Against its own baselines the thesis's fit wins by a wide margin: the RMSE in the gap of hold and mean is "
        f"{r(g1, 'hold', fit1)} and {r(g1, 'mean 5', fit1)} times the fit's in G1, "
        f"{r(g2, 'hold', fit2)} and {r(g2, 'mean 5', fit2)} times in G2.",
        "Plain coasting, which the thesis never plots, is as good or better wherever the filter's model is right: "
        f"fit / coast is {r(g1, fit1, 'coast')} in the gap and {r(g1, fit1, 'coast', 'after')} after it in G1, "
        f"{r(g2, fit2, 'coast')} and {r(g2, fit2, 'coast', 'after')} in G2.",
        "The fit wins in the gap where the filter's structure or q is wrong: fit / coast is "
        f"{r(moving, fit2, 'coast')} for a CV filter on an accelerating target (G1), {r(wrong, fit2, 'coast')} in G2, "
        f"{r('g1-q-small', fit1, 'coast')} with q too small, {r('g1-q-large', fit1, 'coast')} with q too large.",
        "Fed back, the fit makes the filter overconfident even so: NEES at the end of the gap is "
        f"{nees(g1, fit1)} (G1, matched), {nees(moving, fit1)} (accelerating) and {nees(g2, fit2)} (G2); of coasting "
        f"{nees(g1, 'coast')}, {nees(moving, 'coast')} and {nees(g2, 'coast')}.",
        "The right model beats every fit: a CA filter that simply coasts on the accelerating target has "
        f"{r(moving, CA_FILTER, fit2)} of the best fit's RMSE in the gap.",
        f"The blend, which feeds nothing back, costs a factor {r(g1, 'blend', 'coast')} (G1) and "
        f"{r(g2, 'blend', 'coast')} (G2) in a matched gap and gains {r(moving, 'coast', 'blend')} and "
        f"{r(wrong, 'coast', 'blend')} times where the model is wrong.",
    ]


def run(options: Options) -> Report:
    """The whole experiment."""
    report = Report("lost_target", TITLE)
    big, facts = big_batch(options)  # first, so that its peak memory is its own
    runs = options.count(2000, 400)
    results = {}
    tables = []
    for regime in regimes():
        results[regime.name] = simulate(regime, runs, options.seed, course=True)
        tables.append(table(regime, results[regime.name]))
    report.tables = [claims(results), *tables, big, wiener_table(options)]
    report.facts = facts
    report.headline = findings(results)
    report.findings = list(report.headline)
    directory = options.directory(report.name)
    report.figures = [figures.course(regimes(), results, directory / "gap_errors.png")]
    # The first sentence of each of G3 and G4 belongs into the project's README.
    for part, foremost in ((sine_gap, 1), (turn_gap, 1), (tuning, 0), (flights, 0)):
        more, paths, sentences = part(options)
        report.tables += more
        report.figures += [Path(path) for path in paths]
        report.findings += sentences
        report.headline += sentences[:foremost]
    bits = {name: result.status for name, result in results.items()}
    bad = sum(int(((words & ~_EXPECTED) != 0).sum()) for status in bits.values() for words in status.values())
    report.facts["runs with a status bit other than MISSED and PSEUDO"] = bad
    return report


_EXPECTED = np.int32(int(jf.Status.MISSED | jf.Status.PSEUDO))
