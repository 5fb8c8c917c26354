"""Real input: glider flights. Noise learnt on one, hidden fixes of the others predicted, a real dropout bridged."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

import jaxfilt as jf
from experiments.bootstrap import Bootstrap
from experiments.lost_target import flight_figures as figures
from experiments.lost_target.flight_gaps import (
    AFTER,
    BEFORE,
    CIRCLING,
    DROPOUT,
    LENGTHS,
    NAIVE,
    ORDERS,
    SLOT,
    SMOOTHER,
    SPLIT,
    TESTS,
    TRAINING,
    Flight,
    Key,
    Noise,
    Reported,
    Scores,
    Windows,
    cut,
    estimates,
    learn,
    load,
    score,
    training_pieces,
)
from experiments.planar import in_parallel
from experiments.report import Cell, Entry, Options, Table
from jaxfilt import tune


class Outcome(NamedTuple):
    """All that the tables show."""

    recordings: dict[str, Flight]
    noise: Noise
    windows: Windows
    found: dict[Key, Reported]
    scores: dict[Key, Scores]
    groups: dict[int, Bootstrap]  # by the gap's length
    splits: dict[tuple[int, str], Bootstrap]  # by length and flight, or part of the flight


def flights(options: Options) -> tuple[list[Table], list[Path], list[str]]:
    """The tables, figures and findings of the recorded flights.

    There are as many gaps as the flights hold, so ``options.runs`` does not matter; the quick form has fewer gaps, one
    motion model and fewer strategies.
    """
    rng = np.random.default_rng(options.seed)
    recordings = {name: load(name) for name in (TRAINING, *TESTS)}
    data = training_pieces(recordings[TRAINING], rng)
    models = ["CV"] if options.quick else list(ORDERS)
    learnt = in_parallel(lambda model: learn(ORDERS[model], data), models)
    noise = {model: {k: float(v) for k, v in found.params.items()} for model, found in zip(models, learnt, strict=True)}
    windows = cut([recordings[name] for name in TESTS], rng, LENGTHS, (3 if options.quick else 1) * SLOT)
    found = estimates(noise, windows, quick=options.quick)
    scores = {key: score(out, windows, noise.get(key[1], {}).get("r", 0.0)) for key, out in found.items()}
    groups = {length: Bootstrap(windows.length == length, rng) for length in LENGTHS}
    parts = {name: windows.flight == index for index, name in enumerate(TESTS)}
    parts |= {"straight": ~windows.circling, "circling": windows.circling}
    splits = {(length, name): Bootstrap((windows.length == length) & part, rng)
              for length in SPLIT for name, part in parts.items()}  # fmt: skip
    o = Outcome(recordings, noise, windows, found, scores, groups, splits)
    tables = [_data(o), _noise(o, dict(zip(models, learnt, strict=True))), _errors(o, "gap"), _errors(o, "end"),
              _consistency(o), _split(o), _dropout_table(o)]  # fmt: skip
    directory = options.directory("lost_target")
    paths = [_draw_dropout(o, directory / "flight_dropout.png"), _draw_errors(o, directory / "flight_errors.png")]
    return tables, paths, _findings(o)


def _data(o: Outcome) -> Table:
    rows: list[list[Entry]] = []
    for name, flight in o.recordings.items():
        steps = np.diff(flight.t)
        speed = np.hypot(*np.diff(flight.position, axis=0).T) / steps
        row: list[Entry] = [name, "learning" if name == TRAINING else "scoring", Cell(flight.interval, digits=1),
                            len(flight.t), Cell(np.median(speed))]  # fmt: skip
        if name == TRAINING:
            row += ["-", "-", "-"]
        else:
            w = o.windows
            own = (w.flight == TESTS.index(name)) & (w.length != DROPOUT)
            row += [int(own.sum()), int(w.hidden[own].sum()), Cell(100 * w.circling[own].mean(), digits=2)]
        rows.append(row)
    header = [
        "flight",
        "used for",
        "interval [s]",
        "fixes",
        "median speed [m/s]",
        "gaps",
        "hidden fixes",
        "circling [%]",
    ]
    lengths = ", ".join(map(str, LENGTHS))
    note = (
        f"A quarter of the gaps each lasts {lengths} s. Circling: share of the gaps with a mean turn rate above "
        f"{CIRCLING:g} deg/s. {BEFORE} fixes are seen before a gap, {AFTER} s after it."
    )
    return Table("flights", "Recorded flights", header, rows, note)


def _noise(o: Outcome, learnt: dict[str, tune.TuneResult]) -> Table:
    rows: list[list[Entry]] = []
    before = np.arange(o.windows.mask.shape[1])[None, :] >= 10
    seen = o.windows.mask & before & (np.arange(before.shape[1])[None, :] < BEFORE)
    one = o.windows.length == LENGTHS[0]  # the windows of one place overlap: once is enough
    for model, result in learnt.items():
        nis = np.asarray(o.found["coast", model].nis) / 2
        each = [Cell(nis[one & (o.windows.flight == i)][seen[one & (o.windows.flight == i)]].mean()) for i in (0, 1)]
        r = o.noise[model]["r"]
        rows.append([model, Cell(o.noise[model]["q"]), Cell(np.sqrt(r)), Cell(result.loss, digits=4), *each,
                     result.evaluations, Cell(result.wall_time, digits=2)])  # fmt: skip
    header = ["model", "q", "sqrt(r) [m]", "loss [nats/fix]", *(f"NIS/2, {name}" for name in TESTS), "evaluations",
              "time [s]"]  # fmt: skip
    note = (
        f"On {TRAINING}, in pieces of 300 s of which 90 s are hidden. q in m^2/s^3 (CV), m^2/s^5 (CA). NIS/2 of "
        "one-step predictions on the other flights; 1 = the noise learnt holds there. Time without compilation."
    )
    return Table("flight_noise", "Noise learnt by innovation likelihood on one flight", header, rows, note)


def _errors(o: Outcome, what: str) -> Table:
    once = np.ones(len(o.windows.length))
    count = o.windows.hidden.sum(axis=1) if what == "gap" else once
    rows: list[list[Entry]] = [
        [*key, *(group.cell(getattr(s, what), count) for group in o.groups.values())] for key, s in o.scores.items()
    ]
    where = "over the hidden fixes" if what == "gap" else "at the last hidden fix"
    gaps = len(o.groups[LENGTHS[0]].group)
    note = f"RMSE {where} [m], east and north together; {gaps} gaps of each length on {' and '.join(TESTS)}."
    title = f"Horizontal error {where}, by the gap's length"
    return Table(f"flight_{what}", title, ["strategy", "model", *(f"{x} s" for x in LENGTHS)], rows, note)


def _consistency(o: Outcome) -> Table:
    w = o.windows
    once, after = np.ones(len(w.length)), w.after.sum(axis=1)
    inside = jf.metrics.chi2_quantile(0.95, 2) / 2
    rows: list[list[Entry]] = []
    for key, s in o.scores.items():
        row: list[Entry] = [*key, *(o.groups[x].cell(s.after, after) for x in SPLIT)]
        row += [group.cell(s.nees, once, root=False) for group in o.groups.values()]
        share = None if s.nees is None else 100.0 * (s.nees < inside)
        rows.append([*row, *(o.groups[x].cell(share, once, root=False) for x in SPLIT)])
    header = ["strategy", "model", *(f"after {x} s [m]" for x in SPLIT), *(f"NEES/2, {x} s" for x in LENGTHS),
              *(f"in 95 %, {x} s" for x in SPLIT)]  # fmt: skip
    note = (
        f"After: RMSE of one-step predictions in the {AFTER} s after the gap, without its first fix. NEES/2 at the "
        "last hidden fix, 1 = honest; 'in 95 %': share [%] of the last hidden fixes inside the ellipse of 95 %."
    )
    return Table("flight_consistency", "After the gap, and the uncertainty claimed at its end", header, rows, note)


def _split(o: Outcome) -> Table:
    count = o.windows.hidden.sum(axis=1)
    rows: list[list[Entry]] = [
        [*key, *(part.cell(s.gap, count) for part in o.splits.values())] for key, s in o.scores.items()
    ]
    header = ["strategy", "model", *(f"{name}, {length} s" for length, name in o.splits)]
    counts = ", ".join(str(len(part.group)) for part in o.splits.values())
    note = f"RMSE over the hidden fixes [m]. Gaps: {counts}. Straight and circling by the turn rate in the gap itself."
    return Table("flight_split", "Horizontal error by flight, and by straight and circling flight", header, rows, note)


def _dropout_table(o: Outcome) -> Table:
    rows: list[list[Entry]] = []
    for key, s in o.scores.items():
        cov = o.found[key].cov
        row: list[Entry] = [*key, Cell(np.sqrt(s.end[-1]))]
        if cov is None or s.nees is None:
            row += ["-", "-", "-"]
        else:
            spread = _spread(np.asarray(cov)[-1])
            row += [
                Cell(np.sqrt(2 * s.nees[-1])),
                Cell(spread[o.windows.last[-1]]),
                Cell(spread[~o.windows.mask[-1]].max()),
            ]
        rows.append(row)
    header = ["strategy", "model", "miss [m]", "miss [sigmas]", "sigma there [m]", "largest sigma [m]"]
    flight = o.recordings[TESTS[int(o.windows.flight[-1])]]
    steps = np.diff(flight.t)
    k = int(np.argmax(steps))
    note = (
        f"{flight.name} has no fix for {steps[k]:.0f} s from t = {flight.t[k]:.0f} s. Miss: of the first fix after "
        "that, which the smoother is not shown either, only the later ones. In sigmas: the root of its squared "
        "Mahalanobis distance (two axes: 2.4 holds 95 %). Sigma: per axis, the root of the mean variance."
    )
    return Table("flight_dropout", "The real dropout: prediction of the first fix after it", header, rows, note)


def _spread(cov: np.ndarray) -> np.ndarray:
    return np.sqrt(np.trace(cov, axis1=-2, axis2=-1) / 2)


# -------------------------------------------------------------------------------------------- the figures and findings


def _draw_dropout(o: Outcome, path: Path) -> Path:
    flight = o.recordings[TESTS[int(o.windows.flight[-1])]]
    k = int(np.argmax(np.diff(flight.t))) + 1  # the first fix after the dropout
    gap = float(flight.t[k - 1]), float(flight.t[k])
    shown = slice(k - 2 * BEFORE, k + 3 * AFTER)
    # the window's padding says nothing
    used = slice(10, int(o.windows.last[-1]) + round(AFTER / flight.interval))
    t = flight.t[k - BEFORE] + np.cumsum(o.windows.dt[-1])[used] - flight.interval
    origin = flight.position[k - BEFORE]
    paths = {}
    for name in ("coast", "blend", SMOOTHER):
        out = o.found[name, "CV"]
        cov = np.asarray(out.cov)[-1, used]
        paths[f"{name} (CV)"] = figures.Path2D(t, np.asarray(out.position)[-1, used] + origin, cov)
    ellipses = {"coast (CV)": [gap[0] + x for x in (10, 20, 40)],
                f"{SMOOTHER} (CV)": np.linspace(*gap, 5)[1:-1].tolist()}  # fmt: skip
    return figures.draw_dropout(path, flight.t[shown], flight.position[shown], gap, paths, ellipses)


def _draw_errors(o: Outcome, path: Path) -> Path:
    count = o.windows.hidden.sum(axis=1)
    panels: dict[str, dict[str, figures.Curve]] = {model: {} for model in o.noise}
    naive_first = sorted(o.scores, key=lambda key: key[0] not in NAIVE)
    for name, model in naive_first:
        s = o.scores[name, model]
        draws = np.stack([group.draw(s.gap, count) for group in o.groups.values()])
        curve = figures.Curve(draws[:, 0], draws[:, 1:].std(axis=1, ddof=1))
        for panel in panels if model == "none" else [model]:
            panels[panel][name] = curve
    return figures.draw_errors(path, LENGTHS, panels)


def _findings(o: Outcome) -> list[str]:
    count = o.windows.hidden.sum(axis=1)
    online = [key for key in o.scores if key[0] != SMOOTHER]
    coast = o.scores["coast", "CV"]
    found = []

    once = np.ones(len(count))
    sentences = []
    for name in TESTS:
        flight = o.recordings[name]
        speed = np.median(np.hypot(*np.diff(flight.position, axis=0).T) / np.diff(flight.t))
        assert coast.nees is not None
        values = [o.splits[x, name].draw(coast.nees, once, root=False)[0] for x in SPLIT]
        sentences.append(f"{name} ({speed:.1f} m/s) {' and '.join(f'{value:.2g}' for value in values)}")
    found.append(
        f"Does the noise learnt on {TRAINING} hold on other flights? NEES/2 of coasting (CV) at the end of gaps of "
        f"{' and '.join(map(str, SPLIT))} s (1 = it does): {'; '.join(sentences)}."
    )

    sentences = []
    for length, group in o.groups.items():
        best, draws = _best(o, group, online)
        ratio = draws / group.draw(coast.gap, count)
        moved = draws[0] / group.draw(o.scores["last fix", "none"].gap, count)[0]
        offline = group.draw(o.scores[SMOOTHER, "CV"].gap, count)[0]
        sentences.append(
            f"{length} s: {_name(best)}, {draws[0]:.3g} m (offline smoother, CV: {offline:.3g} m), "
            f"{ratio[0]:.2f} ± {ratio[1:].std():.2f} of coasting (CV) and "
            f"{100 * moved:.0f} % of how far the flight has moved from its last fix"
        )
    found.append("Best online strategy by the gap's length: " + "; ".join(sentences) + ".")

    sentences = []
    for (length, part), group in o.splits.items():
        if part in ("straight", "circling"):
            best, draws = _best(o, group, online)
            other = group.draw(coast.gap, count)[0]
            sentences.append(f"{part}, {length} s: {_name(best)}, {draws[0]:.3g} m (coasting, CV: {other:.3g} m)")
    found.append("Best by the kind of flight: " + "; ".join(sentences) + ".")

    sentences = []
    for length, group in o.groups.items():
        fit = group.draw(o.scores["fit N10 p1", "CV"].gap, count)
        against = [fit / group.draw(o.scores[name, "CV"].gap, count) for name in ("hold", "coast")]
        hold, plain = (f"{ratio[0]:.2f} ± {ratio[1:].std():.2f}" for ratio in against)
        sentences.append(f"{length} s: {hold} of holding, {plain} of coasting")
    found.append("Error of the thesis's method (fit N10 p1, fed back, CV) in the gap: " + "; ".join(sentences) + ".")

    for model in o.noise:
        sentences = []
        for name in ("coast", "coast_inflated x10", "blend", "fit N10 p1"):
            nees = o.scores[name, model].nees
            assert nees is not None
            values = [group.draw(nees, once, root=False)[0] for group in o.groups.values()]
            sentences.append(f"{name} {', '.join(f'{value:.2g}' for value in values)}")
        found.append(
            f"Honesty at the gap's end, NEES/2 after {', '.join(map(str, LENGTHS))} s ({model}; 1 = honest): "
            f"{'; '.join(sentences)}."
        )

    sentences = []
    for key in [key for key in o.scores if key[0] in ("coast", "blend", SMOOTHER)]:
        s = o.scores[key]
        assert s.nees is not None
        sentences.append(f"{_name(key)} {np.sqrt(s.end[-1]):.3g} m ({np.sqrt(2 * s.nees[-1]):.2g} sigmas)")
    best = min(online, key=lambda key: o.scores[key].end[-1])
    found.append(
        "The first fix after the real dropout is missed by: " + "; ".join(sentences) + f". Nearest without the fixes "
        f"that follow: {_name(best)}; a single gap decides nothing between strategies."
    )
    return found


def _best(o: Outcome, group: Bootstrap, keys: list[Key]) -> tuple[Key, np.ndarray]:
    """The strategy with the lowest RMSE over the hidden fixes of a group, and this as :meth:`Bootstrap.draw` has it."""
    count = o.windows.hidden.sum(axis=1)
    draws = {key: group.draw(o.scores[key].gap, count) for key in keys}
    best = min(keys, key=lambda key: draws[key][0])
    return best, draws[best]


def _name(key: Key) -> str:
    return key[0] if key[1] == "none" else f"{key[0]} ({key[1]})"
