"""AIS tracks by CV, CA, CT and IMM: tuned on some vessels, scored on others by position, velocity and through gaps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxfilt as jf
from experiments import planar
from experiments.bootstrap import Bootstrap
from experiments.planar import block_sums, contrast, exact, ratio
from experiments.report import Cell, Entry, Options, Report, Table
from experiments.vessels import figures
from experiments.vessels.tracks import (
    BEFORE,
    BLOCK,
    FAST,
    LENGTHS,
    MOVING,
    NAIVE,
    NO_COURSE,
    REAL,
    REPEAT,
    SCALE,
    SIZE,
    SLOT,
    START,
    STEP,
    TESTS,
    TRAINING,
    WARMUP,
    Estimate,
    Rows,
    Track,
    estimates,
    load,
    pieces,
    training_pieces,
    windows,
)
from jaxfilt import tune

TITLE = "Vessels by their AIS reports: velocity and gaps by CV, CA, CT and IMM"
MAIN = False

FILTERS = ("CV", "CA", "CT", "IMM (CV, CT)", "IMM (CV, CA, CT)")
QUICK = ("CV", "IMM (CV, CT)")
KINDS = ("fast craft", "ships")
T = 200  # rows of every window and piece: the longest real gap of 1311 s and what is seen before it
SHOWN = 60  # s, the gap of the figure
STEPS = 100

Params = Mapping[str, Mapping[str, Any]]
GapGroup = tuple[str, str]  # kind of vessel, gap


class Outcome(NamedTuple):
    """All that the tables show; keys are the filters and the baselines."""

    gaps: Rows
    whole: Rows
    found: dict[str, Estimate]  # about the gaps
    plain: dict[str, Estimate]  # about the pieces without hidden reports
    nees: dict[str, np.ndarray]  # per filter (B,) NEES/2 at the last hidden report
    groups: dict[GapGroup, Bootstrap]
    parts: dict[str, np.ndarray]  # (P, T) bool: the scored reports of the pieces
    blocks: dict[str, Bootstrap]


def compute(params: Params, seed: int, slot: float = SLOT) -> Outcome:
    """Estimates for given parameters; ``slot`` seconds of track per place of a gap."""
    rng = np.random.default_rng(seed)
    tracks = load(TESTS)
    gaps, whole = windows(tracks, rng, slot, T), pieces(tracks, T)
    found, plain = estimates(params, gaps, whole)
    nees = {name: _nees(out, gaps, float(params[name]["r"])) for name, out in found.items() if name in params}
    moving = (gaps.hidden & gaps.moving).any(axis=1)
    members: dict[GapGroup, np.ndarray] = {
        (kind, f"{x} s"): (gaps.length == x) & moving & (gaps.fast == (kind == KINDS[0]))
        for kind in KINDS for x in LENGTHS
    }  # fmt: skip
    real = gaps.length == 0
    members["all", f"real, {REAL[0]:g} to {REAL[1]:g} s"] = real & (gaps.horizon < REAL[1])
    members["all", f"real, above {REAL[1]:g} s"] = real & (gaps.horizon >= REAL[1])
    scored = whole.mask & (np.arange(T) >= WARMUP) & (_silence(whole) < REAL[0])
    fast = whole.fast[:, None]
    parts = {KINDS[0]: scored & whole.moving & fast, KINDS[1]: scored & whole.moving & ~fast,
             "at rest": scored & ~whole.moving}  # fmt: skip
    blocks = {name: Bootstrap(block_sums(whole.block, part) > 0, rng) for name, part in parts.items()}
    groups = {group: Bootstrap(which, rng) for group, which in members.items()}
    return Outcome(gaps, whole, found, plain, nees, groups, parts, blocks)


def _silence(whole: Rows) -> np.ndarray:
    """(P, T) s since the report before."""
    t = np.cumsum(whole.dt, axis=1)
    newest = np.maximum.accumulate(np.where(whole.mask, t, -np.inf), axis=1)
    return t - np.concatenate([t[:, :1], newest[:, :-1]], axis=1)


def _nees(out: Estimate, gaps: Rows, r: float) -> np.ndarray:
    """NEES/2 at the last hidden report, whose own noise counts."""
    rows = np.arange(len(gaps.ys))
    cov = out.cov[rows, gaps.last] + r * np.eye(2)
    return np.asarray(jf.metrics.nees(out.position[rows, gaps.last], cov, gaps.ys[rows, gaps.last])) / 2


def tuned(steps: int = STEPS, names: tuple[str, ...] = FILTERS) -> dict[str, tune.TuneResult]:
    """The noise of each filter, by the innovation likelihood of the training vessels with gaps."""
    data = training_pieces(load(TRAINING), np.random.default_rng(0))

    def job(name):
        return planar.learn(name, SCALE, START, data, warmup=WARMUP, steps=steps)

    order = sorted(names, key=lambda name: -len(planar.MODES[name]))  # the slowest to compile first
    found = dict(zip(order, planar.in_parallel(job, order), strict=True))
    return {name: found[name] for name in names}


def one_step_draws(o: Outcome, key: str, part: str, what: str) -> np.ndarray:
    """RMSE of one-step predictions [m], of velocity [m/s], or means per report of ``nis`` / 2 and ``log_lik``."""
    out = o.plain[key]
    if what == "error":
        value = np.sum(out.innovation**2, axis=-1)
    elif what == "velocity":
        value = np.sum((out.velocity - o.whole.velocity) ** 2, axis=-1)
    else:
        value = getattr(out, what) / (2 if what == "nis" else 1)
    fixes = o.parts[part]
    totals, counts = block_sums(o.whole.block, fixes, value), block_sums(o.whole.block, fixes)
    return o.blocks[part].draw(totals, counts, root=what in ("error", "velocity"))


def gap_draws(o: Outcome, key: str, group: GapGroup, what: str = "gap") -> np.ndarray:
    """RMSE over the hidden reports, or at the last of them, or NEES/2 there."""
    out, g = o.found[key], o.gaps
    squared = np.sum((out.position - g.ys) ** 2, axis=-1)
    rows, once = np.arange(len(g.ys)), np.ones(len(g.ys))
    if what == "gap":
        return o.groups[group].draw((squared * g.hidden).sum(axis=1), g.hidden.sum(axis=1))
    if what == "end":
        return o.groups[group].draw(squared[rows, g.last], once)
    return o.groups[group].draw(o.nees[key], once, root=False)


# ------------------------------------------------------------------------------------------------------------- tables


def data_table(tracks: list[Track]) -> Table:
    """The vessels, and what became of repeated positions."""
    rows: list[list[Entry]] = []
    for track in tracks:
        t = track.t[track.real]
        use = "tuning" if track.vessel in TRAINING else "scoring"
        speed = np.hypot(*track.velocity[track.real].T)
        row: list[Entry] = [str(track.vessel), KINDS[0] if track.vessel in FAST else KINDS[1], use, len(t),
                            exact(Cell(np.median(np.diff(t)))), exact(Cell(np.diff(t).max())),
                            exact(Cell(speed.max())), *track.repeats]  # fmt: skip
        rows.append(row)
    header = ["vessel", "kind", "used for", "reports", "median interval [s]", "longest [s]", "largest SOG [m/s]",
              "copies dropped", "of these moving", "repeats left, moving"]  # fmt: skip
    note = (
        f"A position that repeats within {REPEAT:g} s of its first report is dropped as a delayed copy, whether seen, "
        f"hidden or scored; only positions and times decide. Moving: SOG of {MOVING:g} m/s or more."
    )
    return Table("vessels_data", "Vessels", header, rows, note)


def one_step_table(o: Outcome) -> Table:
    """One-step predictions and the velocity, where nothing is hidden."""
    columns = [("error", p) for p in o.parts] + [("log_lik", p) for p in o.parts] + [("nis", p) for p in KINDS]
    shown = {"error": "RMSE [m]", "log_lik": "nats per report", "nis": "NIS/2"}
    return _plain_table(
        o, "vessels_one_step", "One-step predictions", columns, shown,
        f"Positions predicted from one report to the next, less than {REAL[0]:g} s apart. The first {WARMUP} rows of "
        f"{len(o.whole.ys)} pieces are not scored. At rest: SOG below {MOVING:g} m/s.",
    )  # fmt: skip


def velocity_table(o: Outcome) -> Table:
    """The velocity against SOG and COG."""
    return _plain_table(
        o, "vessels_velocity", "Velocity against speed and course over ground",
        [("velocity", p) for p in o.parts], {"velocity": "RMS error [m/s]"},
        "Length of the difference of the velocity vectors, after each report, with no report hidden. Below SOG = "
        f"{NO_COURSE:g} m/s the reference is 0, because the course means nothing. Baselines: standing still, and the "
        "difference of the last two positions.",
    )  # fmt: skip


def _plain_table(o, name, title, columns, shown, note) -> Table:
    rows: list[list[Entry]] = []
    for key, out in o.plain.items():
        row: list[Entry] = [key]
        for what, part in columns:
            defined = what in ("error", "velocity") or out.log_lik is not None
            row.append(contrast(one_step_draws(o, key, part, what))[0] if defined else "-")
        rows.append(row)
    counts = ", ".join(f"{part} {int(mask.sum())}" for part, mask in o.parts.items())
    header = ["filter", *(f"{shown[what]}, {part}" for what, part in columns)]
    note += f" Reports scored: {counts}. Standard errors over blocks of {BLOCK:g} s."
    return Table(name, title, header, rows, note)


def gap_table(o: Outcome, what: str) -> Table:
    """By kind of vessel and gap; every cell is fixed by the parameters."""
    rows: list[list[Entry]] = []
    for key in o.found:
        if what != "nees" or key in o.nees:
            rows.append([key, *(contrast(gap_draws(o, key, group, what))[0] for group in o.groups)])
    counts = ", ".join(str(len(group.group)) for group in o.groups.values())
    header = ["filter", *(f"{kind}, {gap}" if kind != "all" else gap for kind, gap in o.groups)]
    where = {"gap": "RMSE over the hidden reports [m]", "end": "RMSE at the last hidden report [m]",
             "nees": "NEES/2 at the last hidden report, 1 = honest"}[what]  # fmt: skip
    title = {"gap": "Position error in gaps", "end": "Position error at the gap's end",
             "nees": "The uncertainty claimed at the gap's end"}[what]  # fmt: skip
    note = f"{where}. Gaps: {counts}"
    if what == "gap":
        hidden = o.gaps.hidden.sum(axis=1)
        note += f"; hidden reports: {', '.join(str(int(hidden[group.group].sum())) for group in o.groups.values())}"
        note += ". Of a real gap the first report after it is scored, of those made by hand all where the vessel moves"
    return Table(f"vessels_{what}", title, header, rows, note + ".")


def ratio_table(o: Outcome, best: str) -> Table:
    """Against CV, paired."""
    others = [name for name in o.plain if name not in NAIVE and name != "CV"]
    rows: list[list[Entry]] = []
    for quantity, what in (("one-step prediction [m]", "error"), ("velocity [m/s]", "velocity")):
        for part in KINDS:
            draws = {name: one_step_draws(o, name, part, what) for name in o.plain}
            rows.append([quantity, part, "-", int(o.parts[part].sum()), *_ratios(draws, others, best)])
    for group, members in o.groups.items():
        draws = {name: gap_draws(o, name, group) for name in o.found}
        count = int(o.gaps.hidden.sum(axis=1)[members.group].sum())
        rows.append(["in the gap [m]", *group, count, *_ratios(draws, others, best)])
    header = ["error", "vessels", "gap", "reports", "CV", "CV, 95 %", *(f"{name} / CV" for name in others),
              f"{best} / CV, 95 %", f"{best} / {NAIVE[1]}", f"{best} / {NAIVE[1]}, 95 %"]  # fmt: skip
    note = f"RMSEs and their ratios, paired; bootstrap over blocks or gaps. {best} has the lowest loss in tuning."
    return Table("vessels_ratio", "Turn models and IMM against CV", header, rows, note)


def _ratios(draws: dict[str, np.ndarray], others: list[str], best: str) -> list[Entry]:
    cv, mine = draws["CV"], draws[best]
    row: list[Entry] = [*contrast(cv), *(ratio(draws[name], cv)[0] for name in others)]
    return [*row, ratio(mine, cv)[1], *ratio(mine, draws[NAIVE[1]])]


def score_tables(o: Outcome, best: str) -> list[Table]:
    """All that parameters give."""
    gaps = [gap_table(o, what) for what in ("gap", "end", "nees")]
    return [one_step_table(o), velocity_table(o), ratio_table(o, best), *gaps]


def findings(o: Outcome, best: str, learnt: Mapping[str, tune.TuneResult], tracks: list[Track]) -> list[str]:
    """What the tables say; the numbers are computed."""

    def show(a, b):
        cell, interval = ratio(a, b)
        return f"{float(cell.value):.2f} ({interval})"

    found = []
    for what, name in (("error", "one-step predictions"), ("velocity", "the velocity")):
        against = ", ".join(
            f"{part} {show(one_step_draws(o, best, part, what), one_step_draws(o, 'CV', part, what))} of CV and "
            f"{show(one_step_draws(o, best, part, what), one_step_draws(o, NAIVE[1], part, what))} of {NAIVE[1]}"
            for part in KINDS
        )
        found.append(f"RMSE of {name}, {best} (lowest loss of the IMMs in tuning; 95 % intervals): {against}.")
    sentences = []
    for name in o.plain:
        errors = [one_step_draws(o, name, part, "velocity")[0] for part in o.parts]
        sentences.append(f"{name} {', '.join(f'{error:.2f}' for error in errors)}")
    found.append(f"Error of the velocity [m/s] ({', '.join(o.parts)}): {'; '.join(sentences)}.")
    sentences = []
    for part in o.parts:
        mine, other = (one_step_draws(o, name, part, "log_lik") for name in (best, "CV"))
        cell, interval = contrast(mine - other)
        sentences.append(f"{part} {float(cell.value):.2f} ({interval})")
    found.append(f"Likelihood of the next report, {best} less CV, nats per report: {'; '.join(sentences)}.")
    gaps = "; ".join(
        f"{', '.join(group)} {show(gap_draws(o, best, group), gap_draws(o, 'CV', group))}" for group in o.groups
    )
    found.append(f"RMSE in gaps, {best} / CV: {gaps}.")
    lowest = []
    for group in o.groups:
        name = min(o.found, key=lambda key: float(gap_draws(o, key, group)[0]))
        lowest.append(f"{', '.join(group)}: {name}, {gap_draws(o, name, group)[0]:.3g} m")
    found.append(f"Lowest error in the gap, baselines included: {'; '.join(lowest)}.")
    sentences = []
    for name in dict.fromkeys(("CV", best)):
        nees = [gap_draws(o, name, group, "nees")[0] for group in o.groups]
        sentences.append(f"{name} {', '.join(f'{x:.2g}' for x in nees)}")
    found.append(f"NEES/2 at the end of the same gaps (1 = honest): {'; '.join(sentences)}.")
    if (three := "IMM (CV, CA, CT)") in learnt:
        found.append(
            f"Loss in tuning: {', '.join(f'{name} {result.loss:.2f}' for name, result in learnt.items())}. {three} can "
            "do all that IMM (CV, CT) can, up to the chance of its third mode; where its loss is higher, the search "
            "has not found it within the common budget, and its scores are those of the search as much as of the model."
        )
    bank = learnt["IMM (CV, CT)"].params
    found.append(
        f"What the IMM (CV, CT) is tuned to: its CT has q = {float(bank['ct_q']):.2g} m²/s³ and q_omega = "
        f"{float(bank['ct_q_omega']):.2g} rad²/s³ (the search ends at {1e-5 * SCALE.q:.0e} and "
        f"{1e-5 * SCALE.q_omega:.0e}), its CV q = {float(bank['cv_q']):.2g} m²/s³: the less noise, the less of a turn "
        "model and the more a mode for steady course."
    )
    dropped, moved, left = (sum(track.repeats[i] for track in tracks) for i in range(3))
    found.append(
        f"Of {sum(int(track.real.sum()) for track in tracks) + dropped} reports {dropped} repeat a position within "
        f"{REPEAT:g} s and are dropped; {moved} of these moved by their SOG, and {left} repeats of moving vessels stay."
    )
    return found


# ------------------------------------------------------------------------------------------------------------ the run


def draw(o: Outcome, path: Path) -> Path:
    """A gap of a fast craft whose error with the IMM is the median."""
    imm = "IMM (CV, CT)"
    members = o.groups[KINDS[0], f"{SHOWN} s"].group
    squared = np.sum((o.found[imm].position - o.gaps.ys) ** 2, axis=-1)
    error = (squared * o.gaps.hidden).sum(axis=1) / o.gaps.hidden.sum(axis=1)
    shown = int(members[np.argsort(error[members])[len(members) // 2]])
    chosen = {name: o.found[name] for name in ("CV", "CT", imm, NAIVE[1]) if name in o.found}
    return figures.draw_gap(path, o.gaps, shown, chosen)


def run(options: Options) -> Report:
    """The whole experiment. There are as many gaps as the tracks hold, so ``options.runs`` does not matter."""
    names = QUICK if options.quick else FILTERS
    learnt = tuned(10 if options.quick else STEPS, names)
    o = compute({k: v.params for k, v in learnt.items()}, options.seed, (3 if options.quick else 1) * SLOT)
    best = min((name for name in names if name.startswith("IMM")), key=lambda name: learnt[name].loss)
    tracks = load(sorted((*TRAINING, *TESTS)))
    note = (
        f"On vessels {', '.join(map(str, TRAINING))}, in pieces of {SIZE} rows or less with one gap each of "
        f"{', '.join(map(str, LENGTHS))} s in turn; loss per report that is seen, after {WARMUP} rows. Adam, "
        f"{planar.STARTS} starts of the same number of steps for every filter, the best point kept. r in m², q of CV "
        "and CT in m²/s³, of CA in m²/s⁵, of omega in rad²/s³; stay: probability that a mode lasts for one row, in the "
        "order of the filter's name. Times are those of two filters at once."
    )
    report = Report("vessels", TITLE)
    report.tables = [data_table(tracks), planar.tuning_table("vessels_tuning", learnt, note), *score_tables(o, best)]
    report.findings = findings(o, best, learnt, tracks)
    report.figures = [draw(o, options.directory("vessels") / "vessels_gap.png")]
    report.facts["rows"] = (
        f"intervals above {1.5 * STEP:g} s are stepped through in parts of {STEP:g} s or less; up to {BEFORE} rows are "
        "seen before a gap"
    )
    return report
