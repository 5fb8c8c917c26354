"""What the command line prints."""

from __future__ import annotations

import numpy as np

from jaxfilt import describe
from jaxfilt.cli import filters, run
from jaxfilt.cli.filters import Choice
from jaxfilt.cli.learn import Learnt
from jaxfilt.cli.read import Recording
from jaxfilt.cli.run import Run, Verdict
from jaxfilt.core import Status


def recording(rec: Recording) -> list[str]:
    """What was read, and what was assumed."""
    T, seen = len(rec.times), rec.present
    dt = rec.dt[1:]
    spread = "" if rec.regular else f" ({dt.min():.4g} to {dt.max():.4g} s)"
    missing = f"{T - seen.sum()} of them without a measurement" if not seen.all() else "all with a measurement"
    partly = int((seen & ~rec.mask.all(axis=1)).sum())
    if partly:
        missing += f", {partly} with a part of it"
    columns = ", ".join(f"{column.name} [{column.unit}]" for column in rec.columns)
    time = "rows are equally spaced" if rec.time is None else f"time {rec.time}"
    lines = [
        f"read     {rec.path}: {T} rows over {rec.times[-1]:.6g} s, {missing}",
        f"         median interval {rec.dt[0]:.4g} s{spread}",
        f"columns  {time}; {columns}",
    ]
    return lines + [f"         {note}" for note in rec.notes]


def parameters(choice: Choice, learnt: Learnt) -> list[str]:
    """The parameters, where they are from, and warnings."""
    if learnt.result is None:
        head = "as given"
    else:
        seconds = learnt.result.wall_time + learnt.result.compile_time
        what = "all" if len(learnt.free) == len(learnt.params) else ", ".join(learnt.free)
        head = f"{what} learnt by maximum likelihood from {learnt.rows} rows in {seconds:.1f} s"
    lines = [f"filter   {choice.text}, {head}"]
    for name, value, unit, meaning in parameter_rows(learnt):
        given = "" if name in learnt.free else "   (given)"
        lines.append(f"         {name:<14} {value:>10.4g} {unit:<9} {meaning}{given}")
    return lines + [f"warning  {text}" for text in learnt.warnings]


def parameter_rows(learnt: Learnt) -> list[tuple[str, float, str, str]]:
    """Name, value as shown, unit and meaning."""
    rows = []
    for name, value in sorted(learnt.params.items()):
        lives = name.startswith("life_")
        meaning = f"mean life of mode {name[5:]}" if lives else filters.PARAMETERS[name][1]
        rows.append((name, *filters.described(name, value), meaning))
    return rows


def judged(verdict: Verdict | None) -> list[str]:
    """Likelihood and consistency."""
    if verdict is None:
        return ["fit      the filter reports no likelihood"]
    return [
        f"fit      log-likelihood {verdict.log_lik:.4g} nats per fix, over {verdict.fixes} fixes after the start",
        f"         mean NIS {verdict.nis:.3g}, expected {verdict.dof:.3g}, 95 % region {verdict.low:.3g} to "
        f"{verdict.high:.3g}; {100 * verdict.share:.1f} % of the fixes within their own",
        *(f"         {clause}" for clause in verdict.sentence.split("; ")),
    ]


def statuses(done: Run) -> list[str]:
    """Status bits that occurred, and what to do."""
    counts = describe.status_counts(np.asarray(done.out.status), Status) or "nothing to report"
    return [f"status   {counts}"] + [f"warning  {text}" for text in run.advice(done.out)]


def with_error(value: float, error: float, digits: int = 2) -> str:
    """A value and its standard error, rounded to the error's leading digits."""
    if not np.isfinite(error) or error <= 0:
        return f"{value:.4g}"
    places = max(0, digits - 1 - int(np.floor(np.log10(error))))
    return f"{value:.{places}f} ± {error:.{places}f}"
