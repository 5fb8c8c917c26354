"""Roll and pitch under external acceleration: a paper's EKF, its variants and rivals, simulated and recorded."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax

from experiments.attitude import figures, recorded, synthetic, tuning
from experiments.attitude.synthetic import VELOCITY
from experiments.benchmarks import attitude as benchmark
from experiments.planar import in_parallel
from experiments.report import Options, Report

TITLE = "Attitude under external acceleration: a paper's EKF, its variants, complementary filters and VQF"
MAIN = False


def published() -> dict[str, Any]:
    """What the README publishes."""
    return json.loads((Path(__file__).parent / "published.json").read_text(encoding="utf-8"))


def simulated(options: Options, report: Report) -> None:
    """Tables 1 and 2 and the baselines."""
    where, quick = options.directory("attitude"), options.quick
    runs = synthetic.draw(options.count(16, 6), options.seed)
    swept = {kappa: synthetic.run(filt, runs) for kappa, filt in synthetic.sweep().items()}
    chosen = {name: f for name, f in synthetic.filters().items() if not quick or name == VELOCITY}
    found = {name: synthetic.run(filt, runs) for name, filt in chosen.items()}
    found |= synthetic.outsiders(runs)
    rivals = {"velocity (V)": found[VELOCITY], "VQF": found["VQF"]}
    report.tables += [synthetic.table_1(swept), synthetic.table_2(swept, rivals)]
    report.figures.append(figures.kappas(swept, where))
    if quick:
        return
    fixed = synthetic.draw(options.count(16, 6), options.seed + 1, bias_walk=0.0)
    steady = {name: synthetic.run(filt, fixed) for name, filt in chosen.items()} | synthetic.outsiders(fixed)
    report.tables.append(synthetic.baselines(found, steady))
    report.findings += synthetic.findings(swept, found)
    report.figures.append(figures.one_run(runs, where))


def recordings(options: Options, report: Report) -> None:
    """The trials; the quick form takes the published parameters of a few filters."""
    trials = recorded.load()
    rotated: dict[str, Any] = {}
    if options.quick:
        learnt = {recorded.LEARNT: recorded.read_learnt(published())[recorded.LEARNT]}
        filters = recorded.not_learnt(trials)
    else:
        names = list(recorded.learnable())
        jobs = [(name, recorded.TRAINING) for name in names]
        jobs += [(recorded.LEARNT, trial) for trial in recorded.TRIALS if trial != recorded.TRAINING]
        results = in_parallel(lambda job: recorded.learn(job[0], trials, job[1], options.seed).params, jobs)
        found = dict(zip(jobs, results, strict=True))
        learnt = {name: found[name, recorded.TRAINING] for name in names}
        rotated = {trial: found[recorded.LEARNT, trial] for trial in recorded.TRIALS}
        filters = recorded.not_learnt(trials)
    errors = recorded.run({**{n: recorded.made(n, p, trials) for n, p in learnt.items()}, **filters}, trials)
    drawn = recorded.Draws(trials, options.seed)
    draws = {name: drawn.rms(tilt) for name, tilt in errors.items()}
    report.tables.append(recorded.table(draws, trials))
    trained = {}
    if rotated:
        for trial, params in rotated.items():
            again = recorded.run({recorded.LEARNT: recorded.made(recorded.LEARNT, params, trials)}, trials)
            trained[trial] = drawn.rms(again[recorded.LEARNT])
        report.tables.append(recorded.rotated_table(trained, draws["VQF"], rotated))
        report.tables.append(recorded.learnt_table(learnt))
    report.findings += recorded.findings(draws, trained, trials)
    report.figures.append(figures.trials(errors, draws, options.directory("attitude")))


def run(options: Options) -> Report:
    """The whole experiment; the quick form leaves out the tuners, the benchmark and most filters."""
    report = Report("attitude", TITLE)
    simulated(options, report)
    if not options.quick:
        outcome = tuning.run(options.seed)
        tables, findings = tuning.tables(outcome, tuning.FULL, jax.random.key(options.seed))
        report.tables += tables
        report.findings += findings
        report.figures.append(tuning.figure(outcome, options.directory("attitude")))
    recordings(options, report)
    if not options.quick:
        report.tables.append(benchmark.measure(repeats=2))
    report.headline = [finding for finding in report.findings if finding.startswith(("Recorded", "The goal"))]
    return report
