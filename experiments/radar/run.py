"""Two boats in a ship's radar clutter: tracks from two scans, CV, CA, CT and IMM, tuned on other records."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

import jaxfilt as jf
from experiments import planar
from experiments.bootstrap import Bootstrap
from experiments.radar import confirm, figures, filters
from experiments.radar import scans as recorded
from experiments.radar import scores as scoring
from experiments.radar.filters import Params
from experiments.radar.scans import SCENARIOS, Tracks
from experiments.report import Cell, Entry, Options, Report, Table
from jaxfilt import tune

TITLE = "Radar: two boats in clutter seen from a moving ship, by CV, CA, CT and IMM"
MAIN = False

MODELS = ("CV", "CA", "CT", "IMM (CV, CT)", "IMM (CV, CA, CT)")
QUICK = ("CV", "IMM (CV, CT)")
SOURCES = ("radar", "radar and lidar")
UNTUNED = "CV, untuned"
STEPS = 50
PUBLISHED = Path(__file__).parent / "published.json"
# Each scenario is scored with what was tuned on the three others, for either source: that many sets of parameters.
SETS = len(SOURCES) * len(SCENARIOS)
# How the parameters stand in their table: standard deviations, for the noise.
COLUMNS = {
    "radar range [m]": ("noise", (0, 0)),
    "radar bearing [rad]": ("noise", (0, 1)),
    "lidar range [m]": ("noise", (1, 0)),
    "lidar bearing [rad]": ("noise", (1, 1)),
    "q, CV [m²/s³]": ("cv_q", ()),
    "q, CA [m²/s⁵]": ("ca_q", ()),
    "q, CT [m²/s³]": ("ct_q", ()),
    "q, turn [rad²/s³]": ("ct_q_omega", ()),
    **{f"stay, mode {i + 1}": ("stay", (i,)) for i in range(3)},
}

Key = tuple[str, str]  # source, filter


class Outcome(NamedTuple):
    """All that the tables show."""

    tracks: dict[str, Tracks]  # by source: the same starts
    found: dict[Key, Any]
    first: dict[str, np.ndarray]  # by filter: indices of the tracks confirmed from the first two scans
    runs: dict[str, scoring.Runs]  # by source, over the horizon
    whole: scoring.Runs  # radar, to the end


def tracks(source: str) -> Tracks:
    """All tracks of all scenarios."""
    sensors = recorded.SENSORS[: 1 + SOURCES.index(source)]
    return recorded.join([recorded.start(name, recorded.load(name, sensors)) for name in SCENARIOS])


def own_parameters(params: Params, source: str, t: Tracks) -> Params:
    """Each track's own set (B, ...): the one that its scenario has no part in."""
    index = SOURCES.index(source) * len(SCENARIOS) + t.scenario
    return {name: jnp.asarray(value)[index] for name, value in params.items()}


def initial(name: str) -> Params:
    """Where the search begins."""
    return tune.initial(filters.space(name, SETS))


# ------------------------------------------------------------------------------------------------------------- tuning


def training(each: dict[str, Tracks]) -> filters.Given:
    """(SETS, B, ...) tracks to tune on: every half minute those begun that are confirmed, under way and no duplicates.

    Which, an untuned filter decides by what the radar detects, not the truth; others than the two boats may be among
    them. Each is cut after the horizon.
    """
    radar = each["radar"]
    untuned = own_parameters(initial("CV"), "radar", radar)
    out = jax.tree.map(np.asarray, filters.run("CV", untuned, filters.given(radar)))
    good = confirm.confirmed(out.choice) & confirm.moving(radar, out.position) & (radar.scan % confirm.N == 0)
    index = np.flatnonzero(good)
    index = index[confirm.merged(recorded.select(radar, index), out.choice[index], out.log_lik[index])]
    others = [index[radar.scenario[index] != left_out] for left_out in range(len(SCENARIOS))]
    size = max(map(len, others))
    sets = []
    for source in SOURCES:
        for own in others:
            piece = recorded.select(each[source], np.resize(own, size))
            near = piece.t <= piece.t_second[:, None] + scoring.HORIZON
            used = (np.arange(size) < len(own))[:, None]  # the rest only fills the batch
            sets.append(filters.given(piece._replace(mask=piece.mask & near & used)))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *sets)


def learn(name: str, data: filters.Given, cost: float = filters.REFUSAL, steps: int = STEPS) -> tune.TuneResult:
    """All sets at once: each moves by its own gradient only."""
    objective = Partial(filters.loss, jf.Static(name))
    space = filters.space(name, SETS)
    return tune.gradient(objective, space, (data, jnp.asarray(cost)), key=jax.random.key(0), steps=steps, block=steps)


def published_parameters() -> dict[str, Params]:
    """The sets that ``published.json`` holds, by filter."""
    table = json.loads(PUBLISHED.read_text(encoding="utf-8"))["tables"]["parameters"]
    found = {}
    for name in MODELS:
        rows = [dict(zip(table["header"], row, strict=True)) for row in table["rows"] if row[0] == name]
        params = {k: np.array(v) for k, v in initial(name).items()}
        for i, row in enumerate(rows):
            for column, (key, index) in COLUMNS.items():
                if row[column] != "-":
                    value = float(row[column]["value"])
                    params[key][(i, *index)] = value**2 if key == "noise" else value
        found[name] = params
    return found


def _parameters(params: dict[str, Params]) -> Table:
    rows: list[list[Entry]] = []
    for name, values in params.items():
        for i in range(SETS):
            row: list[Entry] = [name, SOURCES[i // len(SCENARIOS)], SCENARIOS[i % len(SCENARIOS)]]
            for key, index in COLUMNS.values():
                there = key in values and (key != "stay" or index[0] < np.shape(values[key])[1])
                value = float(values[key][(i, *index)]) if there else 0.0
                row.append(Cell(np.sqrt(value) if key == "noise" else value) if there else "-")
            rows.append(row)
    return Table("parameters", "Parameters by the scenario left out", ["filter", "source", "scored", *COLUMNS], rows)


# ------------------------------------------------------------------------------------------------------------- tables


def evaluate(params: dict[str, Params], each: dict[str, Tracks]) -> Outcome:
    """Runs all filters over all tracks."""
    jobs = [(source, name, name) for name in params for source in SOURCES]
    jobs += [(source, UNTUNED, "CV") for source in SOURCES]

    def one(job):
        source, label, name = job
        own = own_parameters(initial(name) if label == UNTUNED else params[name], source, each[source])
        return jax.tree.map(np.asarray, filters.run(name, own, filters.given(each[source])))

    found: dict[Key, Any] = dict(zip([job[:2] for job in jobs], planar.in_parallel(one, jobs), strict=True))
    order = [*params, UNTUNED, *scoring.NAIVE]
    found |= {(source, name): scoring.naive(name, each[source]) for name in scoring.NAIVE for source in SOURCES}
    radar = each["radar"]
    first = {}
    for name in order:
        out = found["radar", name]
        index = np.flatnonzero((radar.scan == 0) & confirm.confirmed(out.choice))
        log_lik = getattr(out, "log_lik", np.zeros(out.choice.shape))
        first[name] = index[confirm.merged(recorded.select(radar, index), out.choice[index], log_lik[index])]
    whole = scoring.runs(radar)
    cut = {source: scoring.within(t, scoring.runs(t), scoring.HORIZON) for source, t in each.items()}
    return Outcome(each, found, first, cut, whole)


def _columns(s: scoring.Scores, which: np.ndarray, blocks: np.ndarray, seed: int) -> list[Entry]:
    """What both kinds of table say of some tracks."""
    names, block = np.unique(blocks[which], return_inverse=True)
    group = Bootstrap(np.ones(len(names), bool), np.random.default_rng(seed))

    def sums(values):
        return np.bincount(block, np.asarray(values, float)[which], len(names))

    count, tracks = sums(s.count), np.bincount(block).astype(float)
    share = [None if v is None else 100 * sums(v) for v in (s.updated, s.right, s.inside)]
    return [
        group.cell(sums(s.squared), count), group.interval(sums(s.squared), count),
        group.cell(None if s.predicted is None else sums(s.predicted), count),
        *(group.cell(v, count, root=False) for v in share),
        int(s.lost[which].sum()), group.cell(100 * sums(s.lost), tracks, root=False),
    ]  # fmt: skip


COMMON = ["RMSE [m]", "95 %", "predicted [m]", "updated [%]", "within 20 m [%]", "in ellipse [%]", "lost", "lost [%]"]


def _first(o: Outcome, seed: int) -> Table:
    rows: list[list[Entry]] = []
    t, r = o.tracks["radar"], o.whole
    for name, index in o.first.items():
        s = scoring.score(o.found["radar", name], t, r)
        which = index[r.boat[index] >= 0]
        rows.append([name, len({(t.scenario[i], r.boat[i]) for i in which}), len(index) - len(which),
                     int(s.count[which].sum()), *_columns(s, which, r.block, seed)])  # fmt: skip
    header = ["filter", "boats", "false", "scans", *COMMON]
    note = (
        f"Boats: how many of the {2 * len(SCENARIOS)} have a confirmed track (updated in {confirm.M} of its first "
        f"{confirm.N} scans); false: confirmed tracks of neither boat. Followed to the scenario's end. Each is a run: "
        "resampling them says little with so few."
    )
    return Table("first", "Tracks from the first two radar scans, radar alone", header, rows, note)


def _each(o: Outcome) -> Table:
    t, r = o.tracks["radar"], o.whole
    scores = {name: scoring.score(o.found["radar", name], t, r) for name in o.first}
    rows: list[list[Entry]] = []
    for i, scenario in enumerate(SCENARIOS):
        for boat in (0, 1):
            row: list[Entry] = [scenario, f"{boat + 1}"]
            for name, index in o.first.items():
                own = [k for k in index if t.scenario[k] == i and r.boat[k] == boat]
                s = scores[name]
                row.append("-" if not own else f"{Cell(np.sqrt(s.squared[own].sum() / s.count[own].sum()))}"
                           + (", lost" if s.lost[own].any() else ""))  # fmt: skip
            rows.append(row)
    note = "RMSE [m] to the scenario's end; - where the first two scans give no confirmed track."
    title = "Tracks from the first two radar scans, one by one"
    return Table("first_each", title, ["scenario", "boat", *o.first], rows, note)


def _every(o: Outcome, source: str, seed: int) -> Table:
    t, r = o.tracks[source], o.runs[source]
    rows: list[list[Entry]] = []
    which = np.flatnonzero(r.boat >= 0)
    kept = _kept(o, source)
    for name in o.first:
        s = scoring.score(o.found[source, name], t, r)
        safe = Cell(np.sqrt(s.squared[kept].sum() / s.count[kept].sum()))
        rows.append([name, safe, *_columns(s, which, r.block, seed)])
    note = (
        f"{len(which)} tracks, {int(r.scored[which].sum())} scored radar scans, {len(np.unique(r.block[which]))} "
        f"blocks of {scoring.BLOCK:g} s; the tracks overlap. 'Kept': RMSE [m] over the {len(kept)} tracks that no "
        "tuned filter loses."
    )
    title = f"Tracks from every two radar scans, followed {scoring.HORIZON:g} s, {source}"
    return Table("every" if source == "radar" else "lidar", title, ["filter", "kept", *COMMON], rows, note)


def _kept(o: Outcome, source: str) -> np.ndarray:
    t, r = o.tracks[source], o.runs[source]
    names = [name for name in o.first if name in MODELS]
    gone = np.any([scoring.score(o.found[source, name], t, r).lost for name in names], axis=0)
    return np.flatnonzero((r.boat >= 0) & ~gone)


def _recordings(o: Outcome) -> Table:
    """What the filters are up against; this reads the truth."""
    rows: list[list[Entry]] = []
    for name in SCENARIOS:
        for sensor in recorded.SENSORS:
            scans = recorded.load(name, (sensor,))
            true = recorded.truth(name, scans.t)
            offset = scans.position[:, :, None] - true[:, None]  # (T, ROOM, 2 boats, 2)
            apart = np.where(scans.valid[:, :, None], np.linalg.norm(offset, axis=-1), np.inf)
            best, nearest = apart.argmin(axis=1), apart.min(axis=1)
            row: list[Entry] = [name, sensor, len(scans.t), Cell(scans.valid.sum() / len(scans.t))]
            for boat in (0, 1):
                near = nearest[:, boat] < scoring.NEAR
                own = offset[near, best[near, boat], boat]
                row += [Cell(100 * near.mean()), _rms(own), _rms(np.diff(own, axis=0) / np.sqrt(2))]
            rows.append(row)
    boats = [f"boat {i}{what}" for i in (1, 2) for what in (" seen [%]", " off [m]", " scatter [m]")]
    header = ["scenario", "sensor", "scans", "detections per scan", *boats]
    note = (
        f"Seen: a detection within {scoring.NEAR:g} m of the boat's antenna; off: RMS distance of the nearest. "
        "Scatter: what it would be were the offsets of consecutive detections independent, by their differences. "
        "Detections lie on the hull, the truth at the antenna."
    )
    return Table("recordings", "Recordings", header, rows, note)


def _rms(vectors: np.ndarray) -> Cell:
    return Cell(np.sqrt(np.mean(np.sum(vectors**2, axis=-1))))


def _noise(params: dict[str, Params], learnt: dict[str, tune.TuneResult]) -> Table:
    rows: list[list[Entry]] = []
    for name, values in params.items():
        for i, source in enumerate(SOURCES):
            own = slice(i * len(SCENARIOS), (i + 1) * len(SCENARIOS))
            row: list[Entry] = [name, source]
            for key, index in list(COLUMNS.values())[:8]:
                unused = key not in values or (source == "radar" and key == "noise" and index[0] == 1)
                value = 0.0 if unused else np.median(np.asarray(values[key])[(own, *index)])
                row.append("-" if unused else Cell(np.sqrt(value) if key == "noise" else value))
            rows.append([*row, Cell(learnt[name].loss / SETS, digits=4)] if name in learnt else [*row, "-"])
    header = ["filter", "source", *list(COLUMNS)[:8], "loss [nats/scan]"]
    note = (
        f"Medians over the four scenarios left out; {STEPS} steps of one start each. Loss: mean over both sources. "
        f"A refused scan costs {filters.REFUSAL:g} nats."
    )
    return Table("noise", "What was tuned, by innovation likelihood through the association", header, rows, note)


def _findings(o: Outcome, refusing: tuple[float, float] | None, seed: int) -> list[str]:
    names = [name for name in o.first if name in MODELS]
    lost = {}
    parts = []
    for source in SOURCES:
        t, r = o.tracks[source], o.runs[source]
        s = {name: scoring.score(o.found[source, name], t, r) for name in o.first}
        kept = _kept(o, source)
        ratios = {name: _relative(s[name], s["CV"], r, kept, seed) for name in names[1:]}
        each = "; ".join(f"{name} {own} (before the scan's detection {ahead})" for name, (own, ahead) in ratios.items())
        which = np.flatnonzero(r.boat >= 0)
        parts.append(f"{source}, {len(kept)} of {len(which)} tracks: {each}")
        lost[source] = ", ".join(f"{name} {int(s[name].lost[which].sum())}" for name in s)
    t, r = o.tracks["radar"], o.runs["radar"]
    which = np.flatnonzero(r.boat >= 0)
    s = {name: scoring.score(o.found["radar", name], t, r) for name in ("CV", UNTUNED)}
    nearest = _nearest(t, r, which)
    floor = np.sqrt(np.nanmean(nearest**2))
    cv, untuned = (100 * x.inside[which].sum() / x.count[which].sum() for x in s.values() if x.inside is not None)
    both = np.intersect1d(_kept(o, "radar"), _kept(o, "radar and lidar"))
    fused = scoring.score(o.found["radar and lidar", "CV"], o.tracks["radar and lidar"], o.runs["radar and lidar"])
    gain, _ = _relative(fused, s["CV"], r, both, seed)
    found = [
        f"RMSE relative to CV's over the tracks that no tuned filter loses: {'. '.join(parts)}.",
        *(f"Tracks lost of {len(which)}, {source}: {names}." for source, names in lost.items()),
        f"The detection nearest to the boat, which no filter knows, is itself {floor:.3g} m off (RMS of those within "
        f"{scoring.NEAR:g} m): it lies on the hull, and the truth at the antenna. No motion model takes that away.",
        "So the tuned filters are far too sure: the innovation likelihood sees how detections scatter from scan to "
        "scan, not "
        f"the offset that they share. Of the scored scans {cv:.0f} % have the antenna inside CV's ellipse of 95 %; "
        f"with the noise that tuning starts from, {untuned:.0f} %.",
        f"Lidar, over the {len(both)} tracks kept with either: RMSE of CV {gain} of that by radar alone.",
    ]  # fmt: skip
    if refusing is not None:
        found.append(
            f"Were refused scans left out of the loss instead of costing {filters.REFUSAL:g} nats, tuning CV would "
            f"learn to refuse: of the radar scans of its training tracks it would use {100 * refusing[1]:.1f} % "
            f"instead of {100 * refusing[0]:.1f} %."
        )
    return found


def _relative(
    s: scoring.Scores, other: scoring.Scores, r: scoring.Runs, which: np.ndarray, seed: int
) -> tuple[str, str]:
    """Ratio of the RMSE over some tracks, and of the predictions', with standard errors from blocks of time."""
    blocks, block = np.unique(r.block[which], return_inverse=True)
    group = Bootstrap(np.ones(len(blocks), bool), np.random.default_rng(seed))
    shown = []
    for part in ("squared", "predicted"):
        a, b = (np.bincount(block, getattr(x, part)[which], len(blocks)) for x in (s, other))
        shown.append(_ratio(group.draw(a, b)))
    return shown[0], shown[1]


def _ratio(draws: np.ndarray) -> str:
    return f"{draws[0]:.2f} ± {draws[1:].std(ddof=1):.2f}"


def _nearest(t: Tracks, r: scoring.Runs, which: np.ndarray) -> np.ndarray:
    """Distances of the nearest detection, where within NEAR; NaN elsewhere."""
    d = t.detections[which]
    place = t.observer[which][:, :, None] + d[..., :1] * np.stack([np.cos(d[..., 1]), np.sin(d[..., 1])], axis=-1)
    apart = np.where(t.valid[which], np.linalg.norm(place - r.position[which][:, :, None], axis=-1), np.inf).min(
        axis=-1
    )
    return np.where(r.scored[which] & (apart < scoring.NEAR), apart, np.nan)


def _used(params: Params, data: filters.Given) -> float:
    """Share of the radar scans of the training tracks that update them; without lidar."""
    sets = len(SCENARIOS)
    own = jax.tree.map(lambda leaf: leaf[:sets].reshape(-1, *leaf.shape[2:]), data)
    repeated = {k: jnp.repeat(jnp.asarray(v)[:sets], data.span.shape[1], axis=0) for k, v in params.items()}
    choice = np.asarray(filters.run("CV", repeated, own).choice)
    mask = np.asarray(own.mask)
    return float((choice >= 0)[mask].mean())


def run(options: Options) -> Report:
    """The whole experiment. There is as much as was recorded, so ``options.runs`` does not matter.

    The quick form has two filters, with the published parameters.
    """
    each = {source: tracks(source) for source in SOURCES}
    learnt: dict[str, tune.TuneResult] = {}
    refusing = None
    if options.quick:
        known = published_parameters()
        params = {name: known[name] for name in QUICK}
    else:
        data = training(each)
        jobs = [*((name, filters.REFUSAL) for name in MODELS), ("CV", 0.0)]
        # the long ones first
        results = planar.in_parallel(lambda job: learn(job[0], data, job[1]), jobs[::-1])[::-1]
        learnt = dict(zip(MODELS, results, strict=False))
        params = {name: result.params for name, result in learnt.items()}
        refusing = _used(params["CV"], data), _used(results[-1].params, data)
    o = evaluate(params, each)
    seed = options.seed
    report = Report("radar", TITLE)
    every = [_every(o, source, seed) for source in SOURCES]
    report.tables = [_recordings(o), _noise(params, learnt), _first(o, seed), _each(o), *every, _parameters(params)]
    report.findings = _findings(o, refusing, seed)
    directory = options.directory("radar")
    report.figures = [figures.maps(o, directory / "radar.png")]
    return report
