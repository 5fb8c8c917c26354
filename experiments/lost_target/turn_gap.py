"""Scenario G4: a turning target under IMM, lost for five or ten samples at several places of its path."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.lost_target import nonlinear_figures as figures
from experiments.planar import in_parallel
from experiments.report import Cell, Entry, Options, Table
from experiments.turn.run import START, TRANSITION, T, draw, modes, path

GAPS = {  # first and last lost sample; the turns are on the ways into samples 40 to 89 and 110 to 159
    "A straight": (25, 34),
    "B onset": (40, 49),
    "C onset + 5": (45, 49),
    "D turn": (60, 64),
    "E turn": (60, 69),
    "F exit": (90, 94),
    "G onset 2": (110, 114),
    "H turn 2": (135, 139),
    "onset + 10": (50, 54),
    "straight 2": (180, 189),
}
LETTERED = tuple(GAPS)[:8]  # those of the specification's table
NOISE = (0.0025, 0.05)  # variance per axis; the unit of length is what the target covers in one second
AFTER = 10  # samples scored after a gap
RUNS = 400

STRATEGIES = {
    "coast": lambda filt: filt,
    "hold": jf.hold_last,
    "mean 5": jf.mean_of_recent,
    "fit N10 p1": jf.polynomial_fit,
    "fit N5 p1": lambda filt: jf.polynomial_fit(filt, window=5),
    "fit N10 p2": lambda filt: jf.polynomial_fit(filt, degree=2),
    "fit_weighted N5 p1": lambda filt: jf.polynomial_fit(filt, window=5, weighted=True),
}
MIXINGS = {"zero": tuple(STRATEGIES), "own": ("coast", "hold", "fit N10 p1", "fit N5 p1", "fit_weighted N5 p1")}
FITS = tuple(name for name in STRATEGIES if name.startswith("fit"))
COASTS = ("coast, zero", "coast, own")
QUICK = (("A straight", "C onset + 5", "E turn"), ("coast, zero", "coast, own", "hold, zero", "fit N5 p1, zero"))

# What the specification's prototype found (400 runs): RMSE in the gap, and over ten samples after it. The thesis
# prints none. Its fits are around the IMM with `zero` mixing.
PROTOTYPE = {
    0.0025: {
        "A straight": (".075", ".091", ".52", ".70", ".080", ".169", ".32", ".139"),
        "B onset": (".256", ".260", ".51", ".68", ".257", ".301", ".39", ".283"),
        "C onset + 5": (".224", ".210", ".25", ".36", ".236", ".189", ".177", ".195"),
        "D turn": (".095", ".091", ".20", ".31", ".244", ".169", ".152", ".149"),
        "E turn": (".189", ".165", ".50", ".65", ".54", ".41", ".37", ".38"),
        "F exit": (".076", ".083", ".20", ".32", ".186", ".118", ".148", ".102"),
        "G onset 2": (".089", ".111", ".21", ".34", ".094", ".120", ".151", ".105"),
        "H turn 2": (".110", ".093", ".21", ".33", ".250", ".167", ".148", ".151"),
    },
    0.05: {
        "A straight": (".195", ".263", "-", "-", ".300", ".595", "-", "-"),
        "C onset + 5": ("-", "-", "-", "-", ".330", ".374", "-", "-"),
        "D turn": (".574", ".294", ".444", ".477", ".448", ".480", "-", "-"),
        "E turn": (".847", ".395", ".599", "-", ".657", ".793", "-", "-"),
        "onset + 10": ("-", "-", "-", "-", ".377", "-", "-", "-"),
        "straight 2": (".209", ".353", "-", "-", ".296", "-", "-", "-"),
    },
}
PROTOTYPE_AFTER = {
    "A straight": (".047", ".048", ".32", ".39", ".054", ".095", ".19", ".053"),
    "B onset": (".088", ".073", ".33", ".38", ".181", ".204", ".27", ".102"),
    "C onset + 5": (".076", ".062", ".16", ".22", ".138", ".115", ".112", ".085"),
    "D turn": (".047", ".044", ".12", ".19", ".127", ".093", ".093", ".058"),
    "E turn": (".052", ".048", ".32", ".37", ".31", ".25", ".25", ".093"),
    "F exit": (".043", ".045", ".13", ".19", ".083", ".062", ".087", ".046"),
    "G onset 2": (".069", ".065", ".15", ".22", ".086", ".097", ".112", ".075"),
    "H turn 2": (".048", ".045", ".13", ".19", ".129", ".094", ".091", ".059"),
}
COLUMNS = ("coast, zero", "coast, own", *(f"{name}, zero" for name in STRATEGIES if name != "coast"))

Key = tuple[float, str]  # variance, gap


def filters(r: Any) -> dict[str, jf.Filter]:
    """Every strategy around the IMM of both mixings: all modes get the same pseudo-measurement."""
    straight, turn = modes(r)
    found = {}
    for mixing, names in MIXINGS.items():
        imm = jf.imm((straight, jf.extended(turn)), TRANSITION, mu0=START, mixing=mixing)
        found |= {f"{name}, {mixing}": STRATEGIES[name](imm) for name in names}
    return found


class Reported(NamedTuple):
    """What a strategy says at each step."""

    position: Array  # (2,)
    cov: Array  # (2, 2)
    status: Array


def reported(state: Any, info: jf.Info) -> Reported:
    """``outputs`` of the filters."""
    del state
    assert info.cov is not None
    return Reported(info.mean[:2], info.cov[:2, :2], info.status)


class Where(NamedTuple):
    """What of a run is scored, as data."""

    gap: Array | np.ndarray  # (T,) weights of a mean
    after: Array | np.ndarray  # (T,)
    last: Array | np.ndarray  # (T,)


def score(where: Where, truth: Array, ys: Array, out: Reported) -> dict[str, Array]:
    """Mean squared distances over the gap and after it, NEES/2 of the position at the gap's end, and the course."""
    del ys
    error = out.position - truth[:, :2]
    squared = jnp.sum(error**2, axis=1)
    end, cov = jnp.dot(where.last, error), jnp.einsum("k,kab->ab", where.last, out.cov)
    return {
        "gap": jnp.dot(where.gap, squared),
        "after": jnp.dot(where.after, squared),
        "nees": end @ jnp.linalg.solve(cov, end) / 2.0,
        "course": squared,
    }


def simulate(
    r: float, gap: tuple[int, int], runs: int, seed: int, names: tuple[str, ...] | None = None
) -> jf.MonteCarloResult:
    """The strategies on the same runs, which are the same for every gap.

    The variance, the mask and what is scored are data, so that a compiled program serves all gaps.
    """
    first, last = gap
    k = np.arange(T)
    spans = (k >= first) & (k <= last), (k > last) & (k <= last + AFTER), k == last
    scorer = Partial(score, Where(*(span / span.sum() for span in spans)))
    scenario = jf.Scenario(Partial(draw, jnp.asarray(path()), r=jnp.asarray(r)), jf.simulate.gap_mask(T, gap))
    chosen = {name: filt for name, filt in filters(r).items() if names is None or name in names}

    chunk = -(-runs // -(-runs // RUNS))  # equal parts of at most RUNS: none is computed in vain

    def part(mixing: str) -> jf.MonteCarloResult:
        own = {name: filt for name, filt in chosen.items() if name.endswith(mixing)}
        return jf.monte_carlo(scenario, own, scorer, runs, jax.random.key(seed), chunk=chunk, outputs=reported)

    wanted = [mixing for mixing in MIXINGS if any(name.endswith(mixing) for name in chosen)]
    parts: list[Any] = in_parallel(part, wanted)
    return parts[0]._replace(
        scores={name: score for p in parts for name, score in p.scores.items()},
        status={name: words for p in parts for name, words in p.status.items()},
    )


def turn_gap(options: Options) -> tuple[list[Table], list[Path], list[str]]:
    """The tables, figures and findings of G4; the quick form has fewer gaps and strategies."""
    runs = options.count(RUNS, 100)
    gaps, names = QUICK if options.quick else (tuple(GAPS), None)
    results, courses = {}, {}
    for r in NOISE:
        for gap in gaps:
            result = simulate(r, GAPS[gap], runs, options.seed, names)
            courses[r, gap] = {name: scores.pop("course").mean(axis=0) for name, scores in result.scores.items()}
            results[r, gap] = result
    tables = [table(results, r, part) for r in NOISE for part in ("gap", "after")]
    tables += [own_table(results), nees_table(results)]
    where = options.directory("lost_target") / "turn_gap.png"
    sentences = quick_findings(results) if options.quick else findings(results)
    return tables, [figures.turn(path(), GAPS, results, courses, where)], sentences


def _label(gap: str) -> str:
    return f"{gap}, {GAPS[gap][0]} to {GAPS[gap][1]}"


def table(results: dict[Key, jf.MonteCarloResult], r: float, part: str) -> Table:
    """RMSE of the specification's strategies over the gaps or after them, with the prototype's below."""
    shown = {gap: result for (noise, gap), result in results.items() if noise == r}
    names = [name for name in COLUMNS if name in next(iter(shown.values())).scores]
    prototype = PROTOTYPE[r] if part == "gap" else PROTOTYPE_AFTER if r == NOISE[0] else {}
    rows: list[list[Entry]] = []
    for gap, result in shown.items():
        rows.append([_label(gap), "ours", *(Cell.of(result.root_mean(name, part)) for name in names)])
        if gap in prototype:
            published = dict(zip(COLUMNS, prototype[gap], strict=True))
            rows.append([_label(gap), "prototype", *(published[name] for name in names)])
    where = "over the gap" if part == "gap" else f"over the {AFTER} samples after the gap"
    note = (
        f"RMSE of the position in the plane {where}, with standard errors; variance {r:g} per axis. Strategies but "
        "coasting are around the IMM with `zero` mixing. Prototype: the specification's, 400 other runs."
    )
    title = f"G4, IMM-EKF, R = {r:g}: RMSE {where}"
    return Table(f"g4-{part}-{r:g}", title, ["gap (lost samples)", "figures", *names], rows, note, _runs(results))


def own_table(results: dict[Key, jf.MonteCarloResult]) -> Table:
    """The same strategies around the IMM with `own` mixing."""
    some = next(iter(results.values()))
    names = [name for name in some.scores if name.endswith("own")]
    rows: list[list[Entry]] = [
        [f"{r:g}", _label(gap), *(Cell.of(result.root_mean(name, "gap")) for name in names)]
        for (r, gap), result in results.items()
    ]
    note = "RMSE of the position in the plane over the gap, with standard errors. The prototype has no such figures."
    title = "G4, strategies around the IMM with `own` mixing: RMSE over the gap"
    return Table("g4-own", title, ["R", "gap (lost samples)", *names], rows, note, some.runs)


def nees_table(results: dict[Key, jf.MonteCarloResult]) -> Table:
    """Honesty at the gap's end."""
    some = next(iter(results.values()))
    wanted = (*COASTS, "fit N10 p1, zero", "fit N5 p1, zero", "fit_weighted N5 p1, zero", "fit N5 p1, own")
    names = [name for name in wanted if name in some.scores]
    rows: list[list[Entry]] = [
        [f"{r:g}", _label(gap), *(Cell.of(result.mean(name, "nees")) for name in names)]
        for (r, gap), result in results.items()
    ]
    note = "NEES/2 of the position at the gap's last sample: 1 is honest, more is overconfident."
    return Table(
        "g4-nees", "G4, consistency at the gap's end", ["R", "gap (lost samples)", *names], rows, note, some.runs
    )  # fmt: skip


def _runs(results):
    return next(iter(results.values())).runs


def better_coast(result: jf.MonteCarloResult) -> str:
    """The mixing whose coast has the smaller error in the gap."""
    return min(COASTS, key=lambda name: float(result.mean(name, "gap").value))


def best_fit(result: jf.MonteCarloResult, mixings: tuple[str, ...] = tuple(MIXINGS)) -> str:
    """The fit, weighted or not, with the smallest error in the gap."""
    names = [name for name in result.scores if name.startswith("fit") and name.endswith(mixings)]
    return min(names, key=lambda name: float(result.mean(name, "gap").value))


def ratio(result: jf.MonteCarloResult, a: str, b: str, part: str = "gap") -> Cell:
    """Of two RMSEs."""
    return Cell.of(result.ratio((a, part), (b, part), root=True))


def deviations(results: dict[Key, jf.MonteCarloResult]) -> list[float]:
    """By how many combined standard errors each of the prototype's figures is off; its rounding is allowed for."""
    found = []
    for (r, gap), result in results.items():
        parts = [("gap", PROTOTYPE[r])] + ([("after", PROTOTYPE_AFTER)] if r == NOISE[0] else [])
        for part, prototype in parts:
            for name, text in zip(COLUMNS, prototype.get(gap, ("-",) * len(COLUMNS)), strict=True):
                if text != "-":
                    value, se = result.root_mean(name, part)
                    rounding = 0.5 * 10.0 ** -(len(text) - 1)
                    off = max(abs(float(text) - float(value)) - rounding, 0.0)
                    found.append(off / (float(se) * np.sqrt(1 + result.runs / RUNS)))
    return found


def quick_findings(results: dict[Key, jf.MonteCarloResult]) -> list[str]:
    """What few gaps and strategies tell."""
    parts = [f"R = {r:g}, {gap}: {ratio(x, 'fit N5 p1, zero', better_coast(x))}"
             for (r, gap), x in results.items()]  # fmt: skip
    return [f"G4, RMSE in the gap of the fit N5 p1 over that of the better coast: {'; '.join(parts)}."]


def findings(results: dict[Key, jf.MonteCarloResult]) -> list[str]:
    """What the tables say; the first two stand in the project's README too."""
    low, high = NOISE
    quiet = {gap: results[low, gap] for gap in GAPS}
    noisy = {gap: results[high, gap] for gap in GAPS}
    zero, own = COASTS
    N10, N5 = "fit N10 p1, zero", "fit N5 p1, zero"
    C, D, E, later = quiet["C onset + 5"], noisy["D turn"], noisy["E turn"], noisy["onset + 10"]

    def short(gap):
        return gap.split()[0] if gap in LETTERED else gap

    def best(result, part="gap"):
        return result.ratio((best_fit(result), part), (better_coast(result), part), root=True)

    def against_coast(group):
        sides: dict[str, list[str]] = {"coast": [], "fit": [], "tie": []}
        for gap, result in group.items():
            value, se = best(result)
            side = "tie" if abs(value - 1) <= 2 * se else "coast" if value > 1 else "fit"
            sides[side].append(f"{short(gap)} {Cell.of(best(result))}")
        shown = {side: ", ".join(cells) or "no gap" for side, cells in sides.items()}
        return f"coasting is ahead in {shown['coast']}; the fit in {shown['fit']}; neither clearly in {shown['tie']}"

    def extent(values):
        return f"{Cell(min(values), digits=2)} to {Cell(max(values), digits=2)}"

    def over_fit(name):
        return extent([float(ratio(quiet[gap], name, _unweighted(quiet[gap])).value) for gap in LETTERED])

    def nees(group, names):
        return extent([float(group[gap].mean(names.get(gap, names[""]), "nees").value) for gap in LETTERED])

    def below(result, a, b):
        return f"{100 * (1 - float(ratio(result, a, b).value)):.0f} %"

    def windows(gap):
        found = [f"{float(group[gap].root_mean(N10, 'gap').value):.3f} → "
                 f"{float(group[gap].root_mean(N5, 'gap').value):.3f}" for group in (quiet, noisy)]  # fmt: skip
        return f"{short(gap)} {' and '.join(found)}"

    fed_back = {"": N5, "A straight": N10}
    after = [float(best(quiet[gap], "after").value) for gap in GAPS]
    off = deviations(results)
    return [
        f"G4, a turn under IMM at low noise (R = {low:g}): RMSE in the gap of the best of all fits over that of the "
        f"better coast (IMM mixing `zero` or `own`), both as found on these runs: {against_coast(quiet)}. Over the "
        f"{AFTER} samples after the gap it is {extent(after)}.",
        f"G4 at the literature's noise (R = {high:g}), likewise: {against_coast(noisy)}.",
        "G4 against the thesis's baselines: the RMSE in the gap of hold and mean is "
        f"{over_fit('hold, zero')} and {over_fit('mean 5, zero')} times that of the best unweighted fit at R = {low:g} "
        f"(gaps A to H); at R = {high:g} in mid-turn (D) hold / fit N10 p1 is {ratio(D, 'hold, zero', N10)}.",
        f"G4 just after an onset (C, R = {low:g}), before the IMM has switched, the fit N5 p1 is "
        f"{below(C, N5, zero)} below coasting with `zero` mixing and {below(C, N5, own)} below `own`; at R = {high:g} "
        f"five samples later the fit N10 p1 is {below(later, N10, zero)} and {below(later, N10, own)} below. Fed back "
        f"it leaves a NEES/2 at the gap's end of {nees(quiet, fed_back)} (R = {low:g}) and {nees(noisy, fed_back)} "
        f"(R = {high:g}) in A to H (N5; N10 in A); coasting with `own` has {nees(quiet, {'': own})} and "
        f"{nees(noisy, {'': own})}.",
        f"G4, “a shorter window in a maneuver”: RMSE with N10 → N5 at R = {low:g} and at R = {high:g}: "
        f"{'; '.join(windows(gap) for gap in ('C onset + 5', 'D turn', 'E turn', 'F exit', 'A straight'))}. "
        "It trades noise for bias and is no rule. A gap that begins with the turn has no sample that tells of it: the "
        f"best fit over the better coast is {Cell.of(best(quiet['B onset']))} in B and "
        f"{Cell.of(best(quiet['G onset 2']))} in G (R = {low:g}).",
        f"G4, biased mixing costs more than the gap: coasting at R = {high:g} in mid-turn, `own` / `zero` is "
        f"{ratio(D, own, zero)} (D) and {ratio(E, own, zero)} (E). The fit N10 p1 is ahead of `zero` coasting there "
        f"({ratio(D, N10, zero)}, {ratio(E, N10, zero)}), not of `own` coasting, not even around the `own` IMM itself "
        f"({ratio(D, 'fit N10 p1, own', own)}, {ratio(E, 'fit N10 p1, own', own)}). On straight legs `own` costs: own "
        f"/ zero is {ratio(noisy['A straight'], own, zero)} and {ratio(noisy['straight 2'], own, zero)} at "
        f"R = {high:g}; at R = {low:g} it loses to the fit N10 p1 too ({ratio(quiet['A straight'], own, N10)} in A).",
        f"G4, of {len(off)} figures of the specification's prototype ({RUNS} runs) {sum(x > 3 for x in off)} are more "
        f"than 3 combined standard errors off, the farthest {max(off):.1f}; the errors of one batch move together.",
    ]


def _unweighted(result):
    names = [f"{name}, zero" for name in FITS if "weighted" not in name]
    return min(names, key=lambda name: float(result.mean(name, "gap").value))
