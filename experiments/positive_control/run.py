"""The printed design checked and bettered, its robustness drawn, and guaranteed bounds beside a Kalman filter."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.positive_control import descent, figures
from experiments.positive_control.design import check, observer, output_feedback, slacks
from experiments.positive_control.estimates import (
    Scores,
    kalman,
    score,
    simulate,
    width_in_closed_form,
)
from experiments.positive_control.estimates import observer as interval
from experiments.positive_control.system import (
    A_HIGH,
    A_LOW,
    PRINTED,
    PRINTED_WEIGHTS,
    PRINTED_Z,
    B,
    C,
    robustness,
    worst_cost,
)
from experiments.report import Cell, Entry, Options, Report, Table
from jaxfilt.metrics import mean, ratio, root_mean

TITLE = "Output feedback for uncertain positive systems, interval observer against Kalman filter"
MAIN = False

SOURCES = {"y": "y", "filter": "Kalman filter", "middle": "interval's middle"}


def _exact(value: Any, digits: int = 4) -> Cell:
    return Cell(float(value), digits=digits, exact=True)


def designs_table(key: Any) -> tuple[Table, dict[str, np.ndarray]]:
    """Gains and what they are worth."""
    gains = {"printed": PRINTED}
    effort = {"printed": "-"}
    for objective in ("margin", "decay"):
        found = output_feedback(A_LOW, A_HIGH, B, C, nonneg_u=True, objective=objective)
        assert found.gain is not None
        gains[f"linear program, {objective}"] = found.gain
        effort[f"linear program, {objective}"] = f"optimum {found.margin:.6f}"
    for name, found in (("gradient, barrier", descent.by_gradient()), ("GA, penalty", descent.by_genetic(key))):
        gains[name] = found.K
        effort[name] = f"{found.evaluations} evaluations, {found.seconds:.2f} s"
    rows: list[list[Entry]] = []
    for name, K in gains.items():
        checked = check(A_LOW, A_HIGH, B, C, K)
        row: list[Entry] = [name, *(Cell(round(k, 9) + 0.0, digits=5) for k in K[:, 0].tolist())]
        row += [Cell(checked.low.min(), digits=2), Cell(checked.radius, digits=5), Cell(worst_cost(K), digits=6)]
        rows.append([*row, effort[name]])
    header = ["design", "K1", "K2", "least entry of A⁻+BKC", "worst spectral radius", "worst-case cost", "effort"]
    note = (
        "Cost: sum of all states over time from (1, 2) under A⁺, which no A in the box exceeds. A program's solver "
        "keeps "
        "inequalities to 1e-7."
    )
    return Table("designs", "Designs with u ≥ 0", header, rows, note), gains


def printed_table() -> tuple[Table, dict[str, float]]:
    """The conditions of theorem 5 for the printed solution, and for the same scaled to C lambda = 1."""
    c = float(C[0] @ PRINTED_WEIGHTS)
    as_printed = slacks(A_LOW, A_HIGH, B, C, PRINTED_WEIGHTS, PRINTED_Z)
    scaled = slacks(A_LOW, A_HIGH, B, C, PRINTED_WEIGHTS / c, PRINTED_Z / c)
    # C lambda - 1 = 0 up to rounding
    rows: list[list[Entry]] = [
        [f"condition {name}", _exact(value), _exact(round(scaled[name], 12))] for name, value in as_printed.items()
    ]
    header = ["smallest slack", "as printed", "scaled to Cλ = 1"]
    return Table("printed", "The printed solution", header, rows, "Negative: violated."), as_printed


def draws_table(runs: int, seed: int, gains: dict[str, np.ndarray]) -> Table:
    """Positivity, dominance and contraction over random A."""
    keys = jax.random.split(jax.random.key(seed), runs)
    rows: list[list[Entry]] = []
    for name, K in gains.items():
        for varying in (False, True):
            found = robustness(keys, K, varying=varying)
            violated = "none" if max(found.above_worst, found.above_bound) <= 1e-12 else "some"
            rows.append([name, "varying" if varying else "constant", *(f"{x:.1e}" for x in found[:3]), violated])
    header = ["gain", "A", "least x", "least u", "largest x after 60 steps", "bounds exceeded"]
    note = "Bounds: the course under A⁺, and cγ^kλ. Extremes over all draws, so without a standard error."
    return Table("draws", "Random A in the box", header, rows, note, runs)


def scores_of(runs: int, seed: int, gains: dict[str, np.ndarray]) -> dict[tuple[str, float, str], Scores]:
    """All closed loops, on the same keys."""
    keys = jax.random.split(jax.random.key(seed), runs)
    found = {}
    for name, K in gains.items():
        for v in (0.02, 0.05):
            for source in SOURCES:
                run = simulate(keys, jnp.asarray(K), interval(v), kalman(v), jnp.asarray(v), source=source)
                found[name, v, source] = score(run)
    return found


def about_mean(s: Scores) -> np.ndarray:
    """(runs, 2) mean square of x about its mean over all runs."""
    m = s.mean.mean(axis=0)
    return s.square - 2 * m * s.mean + m**2


def interval_table(scores: dict[tuple[str, float, str], Scores], runs: int) -> Table:
    """Guaranteed bounds against 3 sigma, u = K y."""
    rows: list[list[Entry]] = []
    for (name, v, source), s in scores.items():
        if source != "y" or v != 0.02:
            continue
        width, predicted = mean(s.width), width_in_closed_form(s.mean.mean(axis=0), v)
        covered, sigmas = mean(100 * s.covered), s.sigmas.mean(axis=0)
        errors, middle = root_mean(s.prior), root_mean(s.middle)
        for i in range(2):
            rows.append([
                name, f"x{i + 1}", str(s.outside),
                Cell(float(width.value[i]), float(width.standard_error[i])), float(predicted[i]), float(sigmas[i]),
                Cell(float(covered.value[i]), float(covered.standard_error[i]), digits=4),
                Cell(float(errors.value[i]), float(errors.standard_error[i])),
                Cell(float(middle.value[i]), float(middle.standard_error[i])),
            ])  # fmt: skip
    header = ["gain", "state", "outside the interval", "width", "width, closed form", "6 sigma"]
    header += ["KF 3 sigma coverage [%]", "KF rmse", "rmse of the middle"]
    note = (
        "u = max(K y, 0), noise of y within ±0.02, A drawn at every step; one-step predictions, steps 50 to 200. "
        "Outside: "
        "violations in all runs, steps and both states."
    )
    return Table("interval", "Interval observer and Kalman filter", header, rows, note, runs)


def loop_table(scores: dict[tuple[str, float, str], Scores], runs: int) -> Table:
    """What the controller is given."""
    rows: list[list[Entry]] = []
    for (name, v, source), s in scores.items():
        cells = []
        for i in range(2):
            spread = root_mean(about_mean(s)[:, i])
            cells.append(Cell(float(spread.value), float(spread.standard_error)))
        average = mean(s.mean[:, 0])
        cells.append(Cell(float(average.value), float(average.standard_error)))
        clipped = mean(100 * s.clipped)
        rows.append([name, f"±{v}", SOURCES[source], *cells, f"{s.least:.3f}", Cell.of(clipped), str(s.outside)])
    header = ["gain", "noise of y", "controller is given", "std of x1", "std of x2", "mean x1", "least x"]
    header += ["clipped [%]", "outside the interval"]
    return Table("loop", "Filter in the loop", header, rows, "Steps 50 to 200; u = max(K ỹ, 0).", runs)


def findings(
    slack: dict[str, float], gains: dict[str, np.ndarray], scores: dict[tuple[str, float, str], Scores]
) -> list[str]:
    """What the tables say."""
    star = "linear program, margin"
    violated = [name for name, value in slack.items() if value < 0]
    dual = observer(A_LOW, A_HIGH, C)
    assert dual.gain is not None
    raw, filtered = (scores["printed", 0.02, source] for source in ("y", "filter"))
    spread = ratio(*(about_mean(s)[:, 0] for s in (filtered, raw)), root=True)
    covered = {name: 100 * scores[name, 0.02, "y"].covered.mean(axis=0) for name in ("printed", star)}
    outside = sum(s.outside for s in scores.values())
    steps = sum(s.covered.shape[0] for s in scores.values()) * 200
    K = gains[star]
    errors = {name: scores[name, 0.02, "y"] for name in ("printed", star)}
    moves = {name: s.wiggle.mean(axis=0).max() for name, s in errors.items()}
    better = all((s.prior.mean(axis=0) < s.middle.mean(axis=0)).all() for s in errors.values())
    return [
        f"The printed solution violates condition {', '.join(violated)} by {-min(slack.values()):.3f}; its gain is "
        f"valid "
        f"all the same, since scaled to Cλ = 1 it meets all. But it makes the plant slower: spectral radius up to "
        f"{check(A_LOW, A_HIGH, B, C, PRINTED).radius:.3f}, "
        f"{check(A_LOW, A_HIGH, B, C, np.zeros((2, 1))).radius:.3f} without feedback (which is not positive). With "
        f"the margin "
        f"maximised K = ({K[0, 0]:.4g}, {abs(K[1, 0]):.4g}), spectral radius "
        f"{check(A_LOW, A_HIGH, B, C, K).radius:.4f}, worst-case cost {worst_cost(K):.3f} instead of "
        f"{worst_cost(PRINTED):.3f}.",
        "Without a program, from the printed gain: gradients with a barrier end at a worst-case cost of "
        f"{worst_cost(gains['gradient, barrier']):.3f}, a genetic algorithm at "
        f"{worst_cost(gains['GA, penalty']):.3f}; the "
        "optimum is a corner, which the program hits.",
        f"The observer's program gives L = ({dual.gain[0, 0]:.4g}, {dual.gain[1, 0]:.4g}), which is -B K of that gain.",
        f"The interval observer was never wrong: {outside} violations in {steps} steps of two states. The Kalman "
        f"filter's 3 "
        f"sigma hold {covered['printed'][0]:.1f} % and {covered['printed'][1]:.1f} % of the predictions with the "
        f"printed "
        f"gain and {covered[star][0]:.1f} % and {covered[star][1]:.1f} % with the other: its covariance knows "
        f"nothing of "
        "the uncertain A, which matters where x is large."
        + (" It is the better point estimate in all four cases." if better else ""),
        f"Where the gains of observer and controller are each other's dual, L y + B u vanishes and no sample moves the "
        f"bounds: their standard deviation over time is {moves[star]:.1e} with the program's gain, "
        f"{moves['printed']:.3f} with "
        "the printed one. The interval is then what the design guarantees for any course, and no estimate of this one.",
        f"Given the filter's estimate instead of y, the printed (high) gain has {float(spread.value):.3f} ± "
        f"{float(spread.standard_error):.3f} of the spread of x1.",
        f"The interval's middle is a biased input for the controller: mean x1 "
        f"{scores['printed', 0.02, 'middle'].mean[:, 0].mean():.2f} "
        f"instead of {raw.mean[:, 0].mean():.2f} with the printed gain.",
    ]  # fmt: skip


def run(options: Options) -> Report:
    """The whole experiment."""
    directory = options.directory("positive_control")
    one, gains = designs_table(jax.random.key(options.seed))
    two, slack = printed_table()
    shown = {name: gains[name] for name in ("printed", "linear program, margin")}
    three = draws_table(options.count(10_000, 1000), options.seed, shown)
    runs = options.count(2000, 200)
    scores = scores_of(runs, options.seed, shown)
    report = Report(
        "positive_control", TITLE, [two, one, three, interval_table(scores, runs), loop_table(scores, runs)]
    )
    report.findings = findings(slack, gains, scores)
    report.headline = [report.findings[2]]
    keys = jax.random.split(jax.random.key(options.seed), 200)
    report.figures = [
        figures.courses(keys, shown, directory / "courses.png"),
        figures.bands(options.seed, shown, directory / "bands.png"),
    ]
    return report
