"""``python -m jaxfilt compare``: several filters on one file, scored on what they have not learnt from."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxfilt.cli import filters, output, run, text
from jaxfilt.cli.filters import Choice, Scale
from jaxfilt.cli.learn import Learnt, learn, scored_rows
from jaxfilt.cli.read import Recording, read
from jaxfilt.cli.track import say
from jaxfilt.cli.units import BadInput

_DRAWS = 1000
_SHIFTS = 4  # runs in which different rows are hidden


class Score(NamedTuple):
    """A filter on the held-out rows. ``*_draws`` (1 + draws,): first the value, then those of resampled blocks."""

    choice: Choice
    learnt: Learnt
    verdict: run.Verdict | None
    log_lik: np.ndarray  # (T,) of each row, NaN where not scored
    hidden: np.ndarray  # (T,) squared error [m^2] of predictions of hidden fixes, NaN elsewhere
    seconds: float  # of one run over the file, compiled, the best of three


def compare(args: Any, options: Any) -> None:
    """Learns every filter from the first rows and scores it on the others."""
    output.check_paths(args.out, args.file)
    names = [name.strip() for name in args.filters.split(",") if name.strip()]
    if not 0.2 <= args.train_share <= 0.9:
        raise BadInput(f"--train-share: expected a share between 0.2 and 0.9, got {args.train_share}")
    if args.hide < 1:
        raise BadInput(f"--hide: expected 1 or more rows, got {args.hide}")
    if len(set(names)) < len(names) or not names:
        raise BadInput(f"--filters: expected different MODEL:FILTER with commas between, got {args.filters!r}")
    rec = read(args.file, options, planar="ct" in args.filters)
    say(text.recording(rec))
    choices = [filters.parse(name, rec) for name in names]
    last = round(args.train_share * len(rec.times))
    held = np.arange(len(rec.times)) >= last
    whole = np.asarray(rec.mask.all(axis=1))
    first, fixes = int((whole & ~held).sum()), int((whole & held).sum())
    if first < 10 or fixes < 20:
        raise BadInput(
            f"--train-share: {args.train_share} leaves {first} fixes to learn from and {fixes} to score; "
            "10 and 20 or more are needed"
        )
    s, given = filters.scale(rec, last), filters.parse_given(args.set)
    spaces = [filters.space(choice, s, given) for choice in choices]
    filters.check_given(given, spaces)
    masks = hiding(rec, last, args.hide)
    say([f"split    learnt from rows 1 to {last}, scored on the {fixes} fixes of the other {held.sum()} rows"])
    scores = []
    for choice, space in zip(choices, spaces, strict=True):
        learnt = learn(choice, rec, s, space, last=last, most=args.learn_rows, steps=args.steps)
        say(text.parameters(choice, learnt))
        scores.append(score(rec, choice, learnt, s, held, masks))
    shown = table(scores, block_of(rec, held, args.hide))
    say(["", shown.to_string(index=False), "", *notes(rec, args.hide)])
    for path in args.out:
        write(path, rec, shown, scores, args.hide)
        say([f"written  {path}"])


def hiding(rec: Recording, last: int, hide: int) -> np.ndarray:
    """Masks (runs, T, m), in each of which every fourth stretch of ``hide`` rows from ``last`` on is hidden.

    Each row is hidden once, and between two gaps the filter sees three times as many rows.
    """
    k = np.arange(len(rec.times)) - last
    stretch = np.where(k >= 0, k // hide, -1)
    hidden = (stretch[None, :] % _SHIFTS == np.arange(_SHIFTS)[:, None]) & (k >= 0)[None, :]
    return rec.mask[None] & ~hidden[:, :, None]


def score(rec: Recording, choice: Choice, learnt: Learnt, s: Scale, held: np.ndarray, masks: np.ndarray) -> Score:
    """Runs over all rows, once with all that was measured and once with each mask."""
    done = run.run(rec, choice, learnt.params, s)
    filt = filters.make(choice, learnt.params, filters.start(rec, slice(None), s))
    seconds = np.inf
    for _ in range(3):
        begun = time.perf_counter()
        jax.block_until_ready(run.filtered(rec, filt, rec.mask).mean)
        seconds = min(seconds, time.perf_counter() - begun)
    present = np.asarray(rec.mask.all(axis=1))
    hidden = np.full(len(rec.times), np.nan)
    for mask in masks:  # of one shape: compiled once, already
        out = run.filtered(rec, filt, mask)
        here = present & ~mask.any(axis=1)
        position = np.asarray(out.mean)[:, : rec.fixes.shape[1]]
        hidden[here] = np.sum((position - np.where(present[:, None], rec.fixes, 0.0))[here] ** 2, axis=1)
    counted = held & scored_rows(rec.present, choice)
    log_lik = np.full(len(rec.times), np.nan)
    if done.out.log_lik is not None:
        log_lik = np.where(counted, np.asarray(done.out.log_lik), np.nan)
    return Score(choice, learnt, run.verdict(rec, done, held), log_lik, hidden, seconds)


def block_of(rec: Recording, held: np.ndarray, hide: int) -> np.ndarray:
    """(T,) the block of consecutive held-out rows, -1 before: what is resampled, as errors of neighbors go together.

    A block is 20 rows or a gap of its own with what is seen around it, whichever is longer, but not longer than leaves
    ten blocks.
    """
    count = int(held.sum())
    size = min(max(20, _SHIFTS * hide), max(count // 10, 1))
    return np.where(held, (np.cumsum(held) - 1) // size, -1)


def draws(x: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Mean of x (T,) where it is finite: first as met, then with the blocks resampled (1 + draws,)."""
    blocks = int(block.max()) + 1
    here = (block >= 0) & np.isfinite(x)
    total = np.bincount(block[here], x[here], blocks)
    count = np.bincount(block[here], minlength=blocks).astype(float)
    weights = np.random.default_rng(0).multinomial(blocks, np.full(blocks, 1 / blocks), size=_DRAWS)
    sums, counts = np.append(total.sum(), weights @ total), np.append(count.sum(), weights @ count)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def table(scores: list[Score], block: np.ndarray) -> Any:
    """A row per filter, the best log-likelihood first; errors are standard errors of resampled blocks.

    The log-likelihood is given relative to the best: of a difference on the same fixes the error is far smaller.
    """
    import pandas as pd

    likelihoods = [draws(one.log_lik, block) for one in scores]
    order = np.argsort([-value[0] if np.isfinite(value[0]) else np.inf for value in likelihoods], kind="stable")
    best = scores[order[0]]
    rows = []
    for i in order:
        one, rmse = scores[i], np.sqrt(draws(scores[i].hidden, block))
        less = draws(one.log_lik - best.log_lik, block)
        v = one.verdict
        learning = 0.0 if one.learnt.result is None else one.learnt.result.wall_time + one.learnt.result.compile_time
        rows.append(
            {
                "filter": one.choice.text,
                "log-lik [nats/fix]": text.with_error(likelihoods[i][0], _error(likelihoods[i])),
                "less the best's": "-" if one is best else text.with_error(less[0], _error(less)),
                "RMSE in gaps [m]": text.with_error(rmse[0], _error(rmse)),
                "NIS/m": "-" if v is None else f"{v.nis / v.dof:.2f}",
                "NIS in 95 % [%]": "-" if v is None else f"{100 * v.share:.1f}",
                "learning [s]": f"{learning:.1f}",
                "run [ms]": f"{1000 * one.seconds:.1f}",
            }
        )
    return pd.DataFrame(rows)


def _error(values: np.ndarray) -> float:
    resampled = values[1:][np.isfinite(values[1:])]
    return float(np.std(resampled, ddof=1)) if len(resampled) > 1 else float("nan")


def notes(rec: Recording, hide: int) -> list[str]:
    """What the columns mean."""
    return [
        "log-lik  one-step predictive log-likelihood of the held-out fixes, larger is better",
        f"RMSE     of predicted positions against held-out fixes, hidden in gaps of {hide} rows "
        f"({hide * rec.dt[0]:.4g} s); the fixes' own noise is in it",
        "NIS/m    1 = the covariance fits; above: too sure, below: too cautious",
        "±        standard error, from blocks of rows resampled",
    ]


def write(path: str, rec: Recording, shown: Any, scores: list[Score], hide: int) -> None:
    """The table as CSV, two panels as PNG, or both as HTML."""
    suffix = Path(path).suffix.lower()
    if suffix == ".csv":
        shown.to_csv(path, index=False)
        return
    names, panels = _panels(shown, hide)
    if suffix == ".png":
        fig = output.figure(figsize=(11, 1.6 + 0.45 * len(names)), layout="constrained")
        for ax, (title, values, errors) in zip(fig.subplots(1, 2, sharey=True), panels, strict=True):
            ax.errorbar(values, range(len(names)), xerr=errors, fmt="o", capsize=3)
            ax.set(xlabel=title, yticks=range(len(names)), yticklabels=names)
            ax.margins(y=0.15)
            ax.grid(alpha=0.3)
        fig.axes[0].invert_yaxis()
        fig.suptitle(f"{Path(rec.path).name}, held-out rows; bars are standard errors")
        fig.savefig(path, dpi=130)
        return
    go = output.plotly()
    figures = []
    for title, values, errors in panels:
        bars = {"type": "data", "array": errors}
        fig = go.Figure(go.Scatter(x=values, y=names, mode="markers", error_x=bars, marker={"size": 10}))
        fig.update_layout(height=160 + 40 * len(names), template="plotly_white", margin={"l": 160, "t": 30})
        fig.update_xaxes(title=title)
        fig.update_yaxes(autorange="reversed")
        figures.append(fig)
    parts = [shown.to_html(index=False, border=0), "<pre>" + "\n".join(notes(rec, hide)) + "</pre>"]
    page = output.document(f"{Path(rec.path).name}: filters compared", parts, figures)
    Path(path).write_text(page, encoding="utf-8")


def _panels(shown: Any, hide: int) -> tuple[list[str], list[tuple[str, list[float], list[float]]]]:
    """Two columns of the table as numbers with their errors."""
    panels = []
    for column, title in (
        ("less the best's", "log-likelihood less the best's [nats per fix]"),
        ("RMSE in gaps [m]", f"RMSE in gaps of {hide} rows [m]"),
    ):
        pairs = [("0" if cell == "-" else cell).split(" ± ") for cell in shown[column]]
        panels.append((title, [float(p[0]) for p in pairs], [float(p[1]) if len(p) > 1 else 0.0 for p in pairs]))
    return list(shown["filter"]), panels
