"""The experiments' command line: ``python -m experiments list | run | reproduce``.

An experiment is a package in this folder with a module ``run`` that has ``TITLE: str``, ``MAIN: bool`` (at full size in
``reproduce``) and ``run(options: Options) -> Report``.
"""

from __future__ import annotations

import argparse
import ast
import gc
import importlib
import os
import pkgutil
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tqdm.auto import tqdm

from experiments.report import Options, Report, Table, environment_seconds, provenance

ROOT = Path(__file__).parent


@dataclass(frozen=True)
class Experiment:
    """An experiment as found on disk."""

    name: str
    title: str
    main: bool
    directory: Path

    def load(self) -> Callable[[Options], Report]:
        """Imports the experiment and returns its ``run``."""
        return importlib.import_module(f"{self.directory.parent.name}.{self.name}.run").run


def discover(root: Path = ROOT) -> list[Experiment]:
    """All experiments, the main ones first. Reads their constants without importing them: ``list`` answers at once."""
    found = []
    for module in pkgutil.iter_modules([str(root)]):
        path = root / module.name / "run.py"
        if path.is_file():
            constants = _constants(path)
            found.append(Experiment(module.name, str(constants["TITLE"]), bool(constants["MAIN"]), path.parent))
    return sorted(found, key=lambda experiment: (not experiment.main, experiment.name))


def _constants(path: Path) -> dict[str, object]:
    constants = {}
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        if isinstance(target, ast.Name) and target.id in ("TITLE", "MAIN"):
            constants[target.id] = ast.literal_eval(node.value)
    missing = {"TITLE", "MAIN"} - constants.keys()
    if missing:
        raise ValueError(f"{path}: expected the literals TITLE and MAIN, lacks {', '.join(sorted(missing))}")
    return constants


def run(experiment: Experiment, options: Options, *, write_readme: bool = False) -> Report:
    """Runs one experiment, prints its tables, writes its report and, if asked, its README."""
    from jaxfilt.progress import everywhere

    start = time.perf_counter()
    with everywhere():
        report = experiment.load()(options)
    report.provenance = provenance(options, time.perf_counter() - start)
    _say(report.to_console())
    _say(f"report: {report.write(options.out) / 'report.md'}\n")
    if write_readme:
        report.write_readme(experiment.directory / "README.md")
        report.write_headline(ROOT.parent / "README.md")
    return report


def run_all(jobs: Sequence[tuple[Experiment, Options]], out: Path, *, write_readme: bool = False) -> int:
    """Runs several experiments and writes ``out/report.md``; one that fails does not stop the others."""
    start = time.perf_counter()
    rows = []
    failed = 0
    for experiment, options in (bar := tqdm(jobs, unit="experiment", disable=None)):
        begun = time.perf_counter()
        bar.set_description(experiment.name)
        _say(f"{experiment.name} ({'quick' if options.quick else 'full'}) ...")
        try:
            run(experiment, options, write_readme=write_readme)
            outcome = f"[report]({experiment.name}/report.md)"
        except Exception:
            with tqdm.external_write_mode(file=sys.stderr):
                traceback.print_exc()
            failed += 1
            outcome = "failed"
        _release_programs()
        form = "quick" if options.quick else "full"
        rows.append([experiment.name, experiment.title, form, f"{time.perf_counter() - begun:.0f} s", outcome])
    total = time.perf_counter() - start
    made = environment_seconds()
    table = Table("experiments", "Experiments", ["experiment", "title", "form", "time", "outcome"], rows)
    summary = [f"{len(jobs) - failed} of {len(jobs)} experiments in {total:.0f} s."]
    if made is not None:
        summary.append(f"Making the environment took {made:.0f} s, so the first time took {made + total:.0f} s in all.")
    out.mkdir(parents=True, exist_ok=True)
    text = f"# Experiments\n\n{table.text('pipe')}\n\n{' '.join(summary)}\n"
    (out / "report.md").write_text(text, encoding="utf-8")
    print(f"{table.text('simple')}\n\n{' '.join(summary)}\n{out / 'report.md'}")
    return 1 if failed else 0


def _say(text: str) -> None:
    """Prints above the progress bars."""
    tqdm.write(text)
    sys.stdout.flush()


def _release_programs() -> None:
    """Compiled programs hold memory maps, of which Linux gives a process 65530: a dozen experiments reach that."""
    import jax

    jax.clear_caches()
    gc.collect()


def main(argv: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m experiments", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="name the experiments")
    one = commands.add_parser("run", help="run one experiment, or all of them")
    one.add_argument("name", help="an experiment, or all")
    one.add_argument("--runs", type=_positive, help="Monte-Carlo runs (default: the experiment's own number)")
    one.add_argument("--quick", action="store_true", help="small, to see that it works")
    one.add_argument("--write-readme", action="store_true", help="publish the tables and figures in its README")
    both = commands.add_parser("reproduce", help="the main job at full size, all others in their quick form")
    for command in (one, both):
        command.add_argument("--seed", type=int, default=0)
        command.add_argument("--out", type=Path, default=Path("results"), help="where to write (default: results)")
    arguments = parser.parse_args(argv)

    experiments = discover()
    if arguments.command == "list":
        for experiment in experiments:
            print(f"{experiment.name:24}{experiment.title}{' (main)' if experiment.main else ''}")
        return 0

    _prepare()
    options = Options(seed=arguments.seed, out=arguments.out)
    if arguments.command == "reproduce":
        jobs = [(experiment, replace(options, quick=not experiment.main)) for experiment in experiments]
        return run_all(jobs, options.out)

    if arguments.quick and arguments.write_readme:
        parser.error("--write-readme publishes figures: not from a --quick run")
    options = replace(options, runs=arguments.runs, quick=arguments.quick)
    if arguments.name == "all":
        return run_all([(e, options) for e in experiments], options.out, write_readme=arguments.write_readme)
    for experiment in experiments:
        if experiment.name == arguments.name:
            run(experiment, options, write_readme=arguments.write_readme)
            return 0
    parser.error(f"no experiment {arguments.name}; there are {', '.join(e.name for e in experiments) or 'none'}")


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a positive number, got {text}")
    return value


def _prepare() -> None:
    """What must be set before an experiment is imported."""
    os.environ.setdefault("MPLBACKEND", "Agg")  # figures go to files
    import jax

    jax.config.update("jax_enable_x64", True)


if __name__ == "__main__":
    sys.exit(main())
