"""``python -m jaxfilt track``: one filter over one file."""

from __future__ import annotations

from typing import Any

from jaxfilt.cli import filters, output, run, text
from jaxfilt.cli.learn import learn
from jaxfilt.cli.read import Options, read
from jaxfilt.cli.units import BadInput


def track(args: Any, options: Options) -> None:
    """Reads, learns what is not given, filters, prints and writes."""
    output.check_paths(args.out, args.file)
    rec = read(args.file, options, planar="ct" in args.model)
    say(text.recording(rec))
    choice = filters.parse(args.model, rec, args.filter)
    s = filters.scale(rec)
    given = filters.parse_given(args.set)
    space = filters.space(choice, s, given)
    filters.check_given(given, [space])
    learnt = learn(choice, rec, s, space, most=args.learn_rows, steps=args.steps)
    say(text.parameters(choice, learnt))
    lines = text.recording(rec) + [f"warning  {warning}" for warning in learnt.warnings]
    done = run.run(rec, choice, learnt.params, s, smooth=args.smooth)
    if done.shown.cov is None:
        raise BadInput(f"--filter: {choice.filter} reports no covariance")
    verdict = run.verdict(rec, done)
    lines += say(text.judged(verdict) + text.statuses(done))
    for path in args.out:
        output.write(path, rec, done, learnt, verdict, lines)
        say([f"written  {path}"])


def say(lines: list[str]) -> list[str]:
    """Prints lines at once, and returns them."""
    for line in lines:
        print(line, flush=True)
    return lines
