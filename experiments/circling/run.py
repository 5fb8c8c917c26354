"""Glider flights by CV, CA, CT and IMM: tuned on one flight, scored in gaps made by hand in two others."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxfilt as jf
from experiments import planar
from experiments.bootstrap import Bootstrap
from experiments.circling import figures
from experiments.circling.tracks import SCALE, SMOOTHED, START, WARMUP, Estimate, Pieces, estimates, pieces
from experiments.lost_target.flight_gaps import (
    AFTER,
    BEFORE,
    CIRCLING,
    DROPOUT,
    LENGTHS,
    NAIVE,
    SLOT,
    TESTS,
    TRAINING,
    Reported,
    Scores,
    Windows,
    cut,
    load,
    score,
    training_pieces,
)
from experiments.planar import block_sums, contrast, exact, ratio
from experiments.report import Cell, Entry, Options, Report, Table
from jaxfilt import tune

TITLE = "Circling gliders: turn models and IMM through gaps"
MAIN = False

QUICK = ("CV", "IMM (CV, CT)")
KINDS = ("straight", "circling")
WIND = "IMM (CV, CT in wind)", "IMM (CV, CT)"  # with and without it
SHOWN = 24  # s, the gap of the figure

Params = Mapping[str, Mapping[str, Any]]


class Outcome(NamedTuple):
    """All that the tables show; keys are the filters, the smoothers and the baselines."""

    windows: Windows
    whole: Pieces
    found: dict[str, Estimate]  # about the windows
    plain: dict[str, Estimate]  # about the pieces without a gap
    scores: dict[str, Scores]
    groups: dict[tuple[str, int], Bootstrap]  # gaps by kind of flight ("all" too) and length
    blocks: dict[str, Bootstrap]  # blocks of the pieces, by kind of flight and by flight


def compute(params: Params, seed: int, slot: float = SLOT) -> Outcome:
    """Estimates and scores for given parameters; ``slot`` seconds of flight per place of a gap."""
    rng = np.random.default_rng(seed)
    flights = [load(name) for name in TESTS]
    windows = cut(flights, rng, LENGTHS, slot)
    whole = pieces(flights, windows.ys.shape[1])
    found, plain = estimates(params, windows, whole)
    scores = {}
    for name, out in found.items():
        r = float(params[name]["r"]) if name in params else 0.0
        scores[name] = score(Reported(out.position, out.cov, None, None), windows, r)
        if out.smoothed is not None:
            scores[name + SMOOTHED] = score(Reported(out.smoothed, out.smoothed_cov, None, None), windows, r)
    parts = {"all": np.ones(len(windows.ys), bool), "straight": ~windows.circling, "circling": windows.circling}
    groups = {
        (kind, x): Bootstrap((windows.length == x) & part, rng) for kind, part in parts.items() for x in LENGTHS
    }  # fmt: skip
    blocks = {name: Bootstrap(block_sums(whole.block, part) > 0, rng) for name, part in _fix_parts(whole).items()}
    return Outcome(windows, whole, found, plain, scores, groups, blocks)


def _fix_parts(whole: Pieces) -> dict[str, np.ndarray]:
    """(P, T) bool: the scored fixes of each kind of flight and of each flight."""
    parts = {"all": whole.scored, "straight": whole.scored & ~whole.circling, "circling": whole.scored & whole.circling}
    return parts | {name: whole.scored & (whole.flight == i)[:, None] for i, name in enumerate(TESTS)}


def _counts(o: Outcome) -> np.ndarray:
    return o.windows.hidden.sum(axis=1)


def _draws(o: Outcome, key: str, group: tuple[str, int], what: str = "gap") -> np.ndarray:
    """RMSE over the hidden fixes, or at the last of them, as :meth:`Bootstrap.draw` has it."""
    count = _counts(o) if what == "gap" else np.ones(len(o.windows.ys))
    return o.groups[group].draw(getattr(o.scores[key], what), count)


def one_step_draws(o: Outcome, key: str, part: str, what: str) -> np.ndarray:
    """RMSE of one-step predictions [m], or means per fix of ``nis`` / 2 and ``log_lik``."""
    out, fixes = o.plain[key], _fix_parts(o.whole)[part]
    value = np.sum(out.innovation**2, axis=-1) if what == "error" else getattr(out, what) / (2 if what == "nis" else 1)
    totals, counts = block_sums(o.whole.block, fixes, value), block_sums(o.whole.block, fixes)
    return o.blocks[part].draw(totals, counts, root=what == "error")


def tuned(steps: int = planar.STEPS, names: tuple[str, ...] = tuple(planar.MODES)) -> dict[str, tune.TuneResult]:
    """The noise of each filter, by the innovation likelihood of the training flight with gaps."""
    data = planar.Data(*training_pieces(load(TRAINING), np.random.default_rng(0)))

    def job(name):
        return planar.learn(name, SCALE, START, data, warmup=WARMUP, steps=steps)

    # The slowest to compile first, so that no thread is left alone with it.
    order = sorted(names, key=lambda name: -len(planar.MODES[name]))
    found = dict(zip(order, planar.in_parallel(job, order), strict=True))
    return {name: found[name] for name in names}


# ------------------------------------------------------------------------------------------------------------- tables


def one_step_table(o: Outcome) -> Table:
    """One-step predictions where nothing is hidden."""
    parts = _fix_parts(o.whole)
    columns = [("error", part) for part in KINDS] + [("log_lik", part) for part in ("all", *KINDS, *TESTS)]
    columns += [("nis", part) for part in KINDS]
    rows: list[list[Entry]] = []
    for key, out in o.plain.items():
        row: list[Entry] = [key]
        for what, part in columns:
            defined = what == "error" or out.log_lik is not None
            row.append(contrast(one_step_draws(o, key, part, what))[0] if defined else "-")
        rows.append(row)
    shown = {"error": "RMSE [m]", "log_lik": "nats per fix", "nis": "NIS/2"}
    header = ["filter", *(f"{shown[what]}, {part}" for what, part in columns)]
    fixes = ", ".join(f"{name} {int(part.sum())}" for name, part in parts.items())
    note = (
        f"One-step predictions without gaps. Fixes scored: {fixes}; the first {WARMUP} of {len(o.whole.ys)} pieces are "
        f"not. Circling: turn rate above {CIRCLING:g} deg/s. NIS/2: 1 = the noise learnt holds. Standard errors over "
        "blocks of 60 s."
    )
    return Table("circling_one_step", "One-step predictions on the scoring flights", header, rows, note)


def gap_table(o: Outcome, what: str) -> Table:
    """RMSE by kind of flight and the gap's length; every cell is fixed by the parameters."""
    columns = [(kind, x) for kind in KINDS for x in LENGTHS]
    rows: list[list[Entry]] = [
        [key, *(contrast(_draws(o, key, group, what))[0] for group in columns)] for key in o.scores
    ]
    counts = ", ".join(str(len(o.groups[group].group)) for group in columns)
    where = "over the hidden fixes" if what == "gap" else "at the last hidden fix"
    note = f"RMSE {where} [m]. Gaps: {counts}"
    if what == "gap":
        note += f"; hidden fixes: {', '.join(str(int(_counts(o)[o.groups[group].group].sum())) for group in columns)}"
    header = ["filter", *(f"{kind}, {x} s" for kind, x in columns)]
    return Table(f"circling_{what}", f"Horizontal error {where}", header, rows, note + ".")


def ratio_table(o: Outcome, best: str) -> Table:
    """Against CV, paired by gap."""
    others = [name for name in o.plain if name not in NAIVE and name != "CV"]
    rows: list[list[Entry]] = []
    for group in o.groups:
        draws = {name: _draws(o, name, group) for name in ("CV", *others, NAIVE[0])}
        rmse, interval = contrast(draws["CV"])
        row: list[Entry] = [group[0], f"{group[1]} s", len(o.groups[group].group), rmse, interval]
        row += [ratio(draws[name], draws["CV"])[0] for name in others]
        row += [ratio(draws[best], draws["CV"])[1], *ratio(draws[best], draws[NAIVE[0]])]
        rows.append(row)
    header = ["flight", "gap", "gaps", "CV [m]", "CV, 95 %", *(f"{name} / CV" for name in others),
              f"{best} / CV, 95 %", f"{best} / last fix", f"{best} / last fix, 95 %"]  # fmt: skip
    note = (
        f"Ratios of RMSEs over the hidden fixes, paired by gap; bootstrap over gaps. {best} has the lowest loss on the "
        "training flight of the IMMs."
    )
    return Table("circling_ratio", "Turn models and IMM against CV", header, rows, note)


def honesty_table(o: Outcome) -> Table:
    """What the filters claim at the gap's end."""
    once = np.ones(len(o.windows.ys))
    inside = jf.metrics.chi2_quantile(0.95, 2) / 2
    rows: list[list[Entry]] = []
    for key, s in o.scores.items():
        if s.nees is None:
            continue
        row: list[Entry] = [key]
        row += [exact(o.groups[k, x].cell(s.nees, once, root=False)) for k in KINDS for x in LENGTHS]
        share = 100.0 * (s.nees < inside)
        row += [exact(o.groups["all", x].cell(share, once, root=False)) for x in LENGTHS]
        rows.append(row)
    header = ["filter", *(f"NEES/2, {k}, {x} s" for k in KINDS for x in LENGTHS),
              *(f"in 95 %, {x} s" for x in LENGTHS)]  # fmt: skip
    note = (
        "NEES/2 at the last hidden fix, 1 = honest (the noise of the fix counts); share [%] of these fixes inside the "
        "ellipse of 95 %, straight and circling together."
    )
    return Table("circling_honesty", "The uncertainty claimed at the gap's end", header, rows, note)


def dropout_table(o: Outcome) -> Table:
    """The real dropout, last of the windows."""
    last = int(o.windows.last[-1])
    rows: list[list[Entry]] = []
    for key, s in o.scores.items():
        name = key.removesuffix(SMOOTHED)
        cov = o.found[name].cov if key == name else o.found[name].smoothed_cov
        cells: list[Entry] = [Cell(np.sqrt(s.end[-1]))]
        if s.nees is None or cov is None:
            cells += ["-", "-"]
        else:
            cells += [Cell(np.sqrt(2 * s.nees[-1])), Cell(np.sqrt(np.trace(cov[-1, last]) / 2))]
        # Smoothed back over kilometres of uncertainty, the last digits are those of the machine.
        row: list[Entry] = [key, *(map(exact, cells) if key == name else cells)]
        rows.append(row)
    header = ["filter", "miss [m]", "miss [sigmas]", "sigma there [m]"]
    note = (
        f"{TESTS[0]} has no fix for 143 s; the filters step through it at the usual interval. Miss: of the first fix "
        "after it, which the smoothers are not shown either. One gap decides nothing."
    )
    return Table("circling_dropout", "The real dropout of 143 s: the first fix after it", header, rows, note)


def score_tables(o: Outcome, best: str) -> list[Table]:
    """All that parameters give."""
    return [one_step_table(o), ratio_table(o, best), gap_table(o, "gap"), gap_table(o, "end"), honesty_table(o),
            dropout_table(o)]  # fmt: skip


def findings(o: Outcome, best: str) -> list[str]:
    """What the tables say; the numbers are computed."""

    def versus(kind, a=best, b="CV", lengths=LENGTHS):
        found = []
        for x in lengths:
            cell, interval = ratio(_draws(o, a, (kind, x)), _draws(o, b, (kind, x)))
            found.append(f"{float(cell.value):.2f} ({interval}) at {x} s")
        return ", ".join(found)

    long, longest = LENGTHS[-2:]
    once = np.ones(len(o.windows.ys))
    found = [
        f"RMSE of {best}, the IMM with the lowest loss in training, over that of CV in circling gaps (95 % "
        f"intervals): {versus('circling')}.",
        f"The same in straight flight: {versus('straight')}.",
        f"Is the gap repaired? While circling, {best} over holding the last fix: {versus('circling', b=NAIVE[0])}; its "
        f"RMSE is {_draws(o, best, ('circling', long))[0]:.3g} m at {long} s and "
        f"{_draws(o, best, ('circling', longest))[0]:.3g} m at {longest} s.",
    ]
    gain, interval = contrast(one_step_draws(o, best, "all", "log_lik") - one_step_draws(o, "CV", "all", "log_lik"))
    values = {name: float(one_step_draws(o, name, "all", "log_lik")[0]) for name in o.plain if name not in NAIVE}
    ranked = sorted(values, key=lambda filt: -values[filt])
    found.append(
        f"One-step predictions on flights not tuned on: {best} gains {float(gain.value):.2f} ({interval}) nats per fix "
        f"over CV; the order is {', '.join(f'{name} {values[name]:.2f}' for name in ranked)}."
    )
    if "CT" in o.plain:
        found.append(
            f"What a turn model alone costs in straight flight: CT / CV {versus('straight', 'CT')}; IMM (CV, CT) / CT "
            f"there {versus('straight', 'IMM (CV, CT)', 'CT')}, in circles "
            f"{versus('circling', 'IMM (CV, CT)', 'CT')}."
        )
    if all(name in o.plain for name in WIND):
        found.append(
            f"Letting the circles drift with the wind: {WIND[0]} / {WIND[1]} is {versus('circling', *WIND)} in "
            f"circles, {versus('straight', *WIND)} straight."
        )
    sentences = []
    for name in dict.fromkeys(("CV", best)):
        nees = o.scores[name].nees
        assert nees is not None
        by_kind = (
            f"{kind} {', '.join(f'{o.groups[kind, x].draw(nees, once, root=False)[0]:.2g}' for x in LENGTHS)}"
            for kind in KINDS
        )
        sentences.append(f"{name} {'; '.join(by_kind)}")
    found.append(f"NEES/2 at the end of gaps of {', '.join(map(str, LENGTHS))} s (1 = honest): {'. '.join(sentences)}.")
    bounds = []
    for name in dict.fromkeys(("CV", best)):
        errors = [_draws(o, name + SMOOTHED, ("circling", x))[0] for x in LENGTHS]
        bounds.append(f"{name} {', '.join(f'{error:.3g}' for error in errors)} m")
    found.append(f"Smoothed offline, with the fixes after the gap, the RMSE in circles is {'; '.join(bounds)}.")
    return found


# ---------------------------------------------------------------------------------------------------- figures and run


def draw(o: Outcome, directory: Path) -> list[Path]:
    """The errors by length, and one gap: of those before which the IMM was sure of the turn, its median error's."""
    panels = {}
    for kind in KINDS:
        panels[kind] = {}
        for key in (*NAIVE, *(name for name in o.plain if name not in NAIVE)):
            draws = np.stack([_draws(o, key, (kind, x)) for x in LENGTHS])
            panels[kind][key] = figures.Curve(draws[:, 0], draws[:, 1:].std(axis=1, ddof=1))
    paths = [figures.draw_errors(directory / "circling_errors.png", LENGTHS, panels)]
    imm = "IMM (CV, CT)"
    members = o.groups["circling", SHOWN].group
    sure = o.found[imm].probabilities[members, BEFORE - 10 : BEFORE, 1].mean(axis=1) > 0.9
    members = members[sure] if sure.any() else members
    order = members[np.argsort(o.scores[imm].gap[members])]
    shown = int(order[len(order) // 2])
    chosen = {name: o.found[name] for name in ("CV", "CT", imm) if name in o.found}
    return [*paths, figures.draw_gap(directory / "circling_gap.png", o.windows, shown, chosen, imm)]


def run(options: Options) -> Report:
    """The whole experiment. There are as many gaps as the flights hold, so ``options.runs`` does not matter."""
    names = QUICK if options.quick else tuple(planar.MODES)
    learnt = tuned(12 if options.quick else planar.STEPS, names)
    o = compute({k: v.params for k, v in learnt.items()}, options.seed, (3 if options.quick else 1) * SLOT)
    best = min((name for name in names if name.startswith("IMM")), key=lambda name: learnt[name].loss)
    note = (
        f"On {TRAINING}, in 10 pieces of 300 s of which 90 s are hidden (gaps of {', '.join(map(str, LENGTHS))} s); "
        f"loss per fix that is seen, after {WARMUP} fixes. Adam, {planar.STARTS} starts of the same number of steps "
        "for every filter, the best point kept. q of CV, CT and the wind in m²/s³, "
        "of CA in m²/s⁵, of omega in rad²/s³; stay: probability that a mode lasts for one fix, in the order of the "
        "filter's name. Times are those of two filters at once."
    )
    report = Report("circling", TITLE)
    report.tables = [planar.tuning_table("circling_tuning", learnt, note), *score_tables(o, best)]
    report.findings = findings(o, best)
    report.figures = draw(o, options.directory("circling"))
    report.facts["gaps"] = (
        f"{int(np.sum(o.windows.length != DROPOUT))} made by hand on {' and '.join(TESTS)}, {BEFORE} fixes seen before "
        f"each and {AFTER} s after it"
    )
    return report
