"""What an experiment hands back: tables with standard errors, figures, findings; and how they are shown and kept."""

from __future__ import annotations

import importlib.metadata
import itertools
import json
import math
import os
import platform
import re
import resource
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, SupportsFloat

from tabulate import tabulate

if TYPE_CHECKING:
    from jaxfilt.metrics import Estimate  # `list` answers at once without it

PACKAGES = ("jaxfilt", "jax", "jaxlib", "numpy", "optax", "scipy", "pymoo")


@dataclass(frozen=True)
class Options:
    """What the command line asks of an experiment."""

    runs: int | None = None  # Monte-Carlo runs; None = the experiment's own number
    seed: int = 0
    out: Path = Path("results")
    quick: bool = False

    def count(self, full: int, quick: int) -> int:
        """The number of runs: as asked, else ``full``, or ``quick`` in the quick form."""
        if self.runs is not None:
            return self.runs
        return quick if self.quick else full

    def directory(self, name: str) -> Path:
        """The folder for the files of an experiment, made if need be."""
        path = self.out / name
        path.mkdir(parents=True, exist_ok=True)
        return path


@dataclass(frozen=True)
class Cell:
    """A computed number, with its standard error where it comes from runs.

    Attributes:
        value: the number.
        se: its standard error; None = not known, and :func:`compare` skips the cell.
        digits: significant digits shown.
        exact: does not depend on random numbers: :func:`compare` asks for equality to 1e-6 relative.
    """

    value: SupportsFloat
    se: SupportsFloat | None = None
    digits: int = 3
    exact: bool = False

    @classmethod
    def of(cls, estimate: Estimate) -> Cell:
        """The cell of an estimate over runs."""
        return cls(float(estimate.value), float(estimate.standard_error))

    def __str__(self) -> str:
        value = float(self.value)
        if self.se is None or not math.isfinite(value) or not math.isfinite(float(self.se)):
            return _number(value, _decimals(value, self.digits))
        se = float(self.se)
        # one digit of the standard error is always seen, however small it is beside the value
        decimals = min(max(_decimals(value, self.digits), _decimals(se, 1)), _decimals(value, self.digits) + 3)
        return f"{_number(value, decimals)} ± {_number(se, decimals)}"


Entry = Cell | str | SupportsFloat


@dataclass
class Table:
    """A table; ``rows`` begin with the text cells that name them."""

    name: str  # lower case, as in the README's markers
    title: str
    header: list[str]
    rows: list[list[Entry]]
    note: str = ""
    runs: int | None = None  # runs behind each row

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(f"table {self.name}: expected rows of {len(self.header)} cells, got {row}")

    def text(self, style: Literal["simple", "pipe"]) -> str:
        """The table alone, for the console (``simple``) or as Markdown (``pipe``)."""
        rows = [[_shown(entry) for entry in row] for row in self.rows]
        header = self.header
        if style == "pipe":
            rows = [[cell.replace("|", r"\|") for cell in row] for row in rows]
            header = [cell.replace("|", r"\|") for cell in header]
        align = [
            "left" if all(isinstance(e, str) for e in column) else "right" for column in zip(*self.rows, strict=True)
        ]
        return tabulate(rows, header, tablefmt=style, disable_numparse=True, colalign=align if rows else None)

    def cells(self) -> dict[tuple[str, str], dict[str, Any]]:
        """The numbers by (row's label, column); a label that occurs again gets a number."""
        return _cells(self.to_json())

    def to_json(self) -> dict[str, Any]:
        """Plain data: numbers with their standard errors, text as it is."""
        rows = [[entry if isinstance(entry, str) else _to_json(entry) for entry in row] for row in self.rows]
        return {"title": self.title, "note": self.note, "runs": self.runs, "header": self.header, "rows": rows}


@dataclass
class Report:
    """The outcome of one experiment.

    Attributes:
        name: the experiment's package.
        title: one line.
        tables: in the order shown.
        figures: files that the experiment wrote into ``options.directory(name)``.
        findings: sentences on what the tables show, reproduced or not.
        headline: the few of them that belong into the project's README.
        facts: what else is worth a line, as runs per second.
        provenance: how it was made; filled in by the runner with :func:`provenance`.
    """

    name: str
    title: str
    tables: list[Table] = field(default_factory=list)
    figures: list[Path] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)
    headline: list[str] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)

    def to_markdown(self) -> str:
        """The whole report."""
        parts = [f"# {self.title}"]
        if self.findings:
            parts.append(_bullets(self.findings))
        for table in self.tables:
            parts.append(f"## {table.title}\n\n{self._table(table)}")
        parts += [f"![{Path(figure).stem}]({Path(figure).name})" for figure in self.figures]
        facts = {**self.facts, **self.provenance}
        parts.append(f"## How it was made\n\n{_bullets(_facts(facts))}")
        return "\n\n".join(parts) + "\n"

    def to_console(self) -> str:
        """The tables and findings as text for a terminal."""
        parts = [f"{self.title}\n{'=' * len(self.title)}"]
        parts += [f"{table.title}{self._caption(table, ' | ')}\n\n{table.text('simple')}" for table in self.tables]
        parts += [f"* {finding}" for finding in self.findings]
        parts += _facts(self.facts)
        return "\n\n".join(parts) + "\n"

    def to_json(self) -> dict[str, Any]:
        """The tables with their standard errors, for programs and for :func:`compare`."""
        tables = {table.name: table.to_json() for table in self.tables}
        return {"name": self.name, "provenance": self.provenance, "tables": tables}

    def write(self, out: Path) -> Path:
        """Writes ``report.md`` and ``tables.json`` into ``out/<name>`` and returns that folder."""
        directory = Options(out=out).directory(self.name)
        (directory / "report.md").write_text(self.to_markdown(), encoding="utf-8")
        _write_json(directory / "tables.json", self.to_json())
        return directory

    def write_readme(self, path: Path) -> None:
        """Publishes the results in an experiment's README.

        Replaces what stands between ``<!-- table: NAME -->`` and ``<!-- /table: NAME -->``, and ``findings`` alike,
        copies the figures into ``figures/`` beside it and keeps the numbers in ``published.json`` for :func:`compare`.

        Raises:
            ValueError: the README has a table that the report lacks, or a marker without its end.
        """
        text = path.read_text(encoding="utf-8")
        tables = {table.name: table for table in self.tables}
        for name in re.findall(r"<!-- table: (\S+) -->", text):
            if name not in tables:
                raise ValueError(f"{path}: no table {name} in the report, which has {', '.join(tables) or 'none'}")
            text = _fill(path, text, f"table: {name}", self._table(tables[name]))
        if "<!-- findings -->" in text:
            text = _fill(path, text, "findings", _bullets([*self.findings, *_facts(self.facts)]))
        path.write_text(text, encoding="utf-8")
        _write_json(path.parent / "published.json", self.to_json())
        for figure in self.figures:
            (path.parent / "figures").mkdir(exist_ok=True)
            shutil.copy(figure, path.parent / "figures")

    def write_headline(self, path: Path) -> None:
        """Publishes the headline in the project's README, between the markers ``findings: NAME`` if it has them."""
        text = path.read_text(encoding="utf-8")
        if f"<!-- findings: {self.name} -->" in text:
            path.write_text(_fill(path, text, f"findings: {self.name}", _bullets(self.headline)), encoding="utf-8")

    def _table(self, table: Table) -> str:
        caption = self._caption(table, "")
        return table.text("pipe") + (f"\n\n*{caption}*" if caption else "")

    def _caption(self, table: Table, prefix: str) -> str:
        runs = f"{table.runs} runs, seed {self.provenance.get('seed', 0)}." if table.runs else ""
        caption = " ".join(part for part in (runs, table.note) if part)
        return prefix + caption if caption else ""


def _fill(path: Path, text: str, marker: str, content: str) -> str:
    """The text with what stands between ``<!-- MARKER -->`` and ``<!-- /MARKER -->`` replaced."""
    start, end = f"<!-- {marker} -->", f"<!-- /{marker} -->"
    if text.count(start) != 1 or text.count(end) != 1 or text.index(end) < text.index(start):
        raise ValueError(f"{path}: expected {start} once, and {end} once after it")
    return f"{text[: text.index(start)]}{start}\n\n{content}\n\n{text[text.index(end) :]}"


def _bullets(sentences: Sequence[str]) -> str:
    return "\n".join(f"* {sentence}" for sentence in sentences)


def _facts(facts: dict[str, Any]) -> list[str]:
    return [f"{key}: {_shown(value)}" for key, value in facts.items()]


def provenance(options: Options, seconds: float) -> dict[str, Any]:
    """How a report was made: seed, form, date, wall time, peak memory, versions and machine."""
    made: dict[str, Any] = {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "form": "quick" if options.quick else "full",
        "runs": "each table's own" if options.runs is None else options.runs,
        "seed": options.seed,
        "wall time": f"{seconds:.1f} s",
        "peak memory of the process": f"{peak_memory() / 2**20:.0f} MiB",
    }
    first = environment_seconds()
    if first is not None:
        made["environment, made once"] = f"{first:.0f} s"
    made["versions"] = (
        ", ".join(f"{name} {_version(name)}" for name in PACKAGES) + f", Python {platform.python_version()}"
    )
    made["machine"] = f"{os.cpu_count()} cores, {platform.system()} {platform.machine()}"
    return made


def peak_memory() -> int:
    """The peak resident memory of this process so far, in bytes."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def environment_seconds() -> float | None:
    """How long ``make env`` took when it made this environment; None where make did not."""
    try:
        return float((Path(sys.prefix) / "stamp").read_text())
    except (OSError, ValueError):
        return None


def compare(published: dict[str, Any], report: Report, sigmas: float = 4.0) -> list[str]:
    """Compares a re-run with published figures.

    Args:
        published: the content of a ``published.json``.
        report: a re-run, at any number of runs.
        sigmas: how many combined standard errors a cell may deviate.

    Returns:
        A line for each cell that deviates, and for each published cell that the re-run lacks, in the tables that both
        have. A cell without a standard error counts only if it is ``exact``.

    Raises:
        ValueError: there was nothing to compare.
    """
    deviations: list[str] = []
    compared = 0
    for table in report.tables:
        if table.name not in published["tables"]:
            continue
        now = table.cells()
        for (row, column), old in _cells(published["tables"][table.name]).items():
            if not old["exact"] and old["se"] is None:
                continue
            compared += 1
            where = f"{table.name}, {row}, {column}"
            new = now.get((row, column))
            if new is None:
                deviations.append(f"{where}: published, but not in the re-run")
            elif not _agree(old, new, sigmas):
                deviations.append(f"{where}: published {_label(old)}, now {_label(new)}")
    if not compared:
        raise ValueError(f"{report.name}: no published cell has a standard error or is exact; nothing to compare")
    return deviations


def _agree(old: dict[str, Any], new: dict[str, Any], sigmas: float) -> bool:
    a, b = float(old["value"]), float(new["value"])
    if not (math.isfinite(a) and math.isfinite(b)):
        return a == b or (math.isnan(a) and math.isnan(b))
    if old["exact"]:
        return math.isclose(a, b, rel_tol=1e-6)
    return abs(a - b) <= sigmas * math.hypot(float(old["se"]), float(new["se"] or 0.0))


def _label(cell: dict[str, Any]) -> str:
    return f"{cell['value']}" if cell["se"] is None else f"{cell['value']} ± {cell['se']}"


def _cells(table: dict[str, Any]) -> dict[tuple[str, str], dict[str, Any]]:
    cells: dict[tuple[str, str], dict[str, Any]] = {}
    seen: dict[str, int] = {}
    for row in table["rows"]:
        label = " / ".join(itertools.takewhile(lambda entry: isinstance(entry, str), row)) or str(row[0]["value"])
        seen[label] = seen.get(label, 0) + 1
        if seen[label] > 1:
            label = f"{label} #{seen[label]}"
        for column, entry in zip(table["header"], row, strict=True):
            if not isinstance(entry, str):
                cells[label, column] = entry
    return cells


def _to_json(entry: Cell | SupportsFloat) -> dict[str, Any]:
    cell = entry if isinstance(entry, Cell) else Cell(entry)
    return {
        "value": _json_number(cell.value),
        "se": None if cell.se is None else _json_number(cell.se),
        "exact": cell.exact,
    }


def _json_number(x: SupportsFloat) -> float | str:
    """JSON has no nan and inf; as text, ``float`` reads them back."""
    x = float(x)
    return x if math.isfinite(x) else str(x)


def _write_json(path: Path, data: dict[str, Any]) -> None:
    path.write_text(json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")


def _shown(entry: Any) -> str:
    if isinstance(entry, str | int):
        return str(entry)
    return str(entry if isinstance(entry, Cell) else Cell(entry))


def _decimals(x: float, digits: int) -> int:
    """Decimals that show ``digits`` significant digits of x."""
    return digits - 1 - math.floor(math.log10(abs(x))) if x and math.isfinite(x) else digits - 1


def _number(x: float, decimals: int) -> str:
    if decimals > 7:  # tiny numbers
        return f"{x:.2e}"
    return f"{x:.{max(decimals, 0)}f}"


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "(not installed)"
