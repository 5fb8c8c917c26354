"""All rows, what was measured of them, and the table of both."""

from __future__ import annotations

import json
import math
from pathlib import Path

from tests.robustness import families, long, series, updates
from tests.robustness.row import F32, F64, Goal, Row
from tests.robustness.row import ROWS as _ROWS

MODULES = (updates, series, long, families)  # importing them registers their rows
ROWS: dict[str, Row] = dict(sorted(_ROWS.items(), key=lambda item: item[1].number))
HERE = Path(__file__).parent
README, MEASURED = HERE / "README.md", HERE / "measured.json"
HEADER = ["", "figure", "proposed", "goal", "reached, float32", "reached, float64", "peers"]


def measured() -> dict[str, dict]:
    """``{row: {"full": bool, "figures": {figure: {"f32": value, "f64": value}}}}`` as last written."""
    return json.loads(MEASURED.read_text(encoding="utf-8")) if MEASURED.exists() else {}


def table(found) -> str:
    """The table in Markdown; rows that were not measured are left out."""
    lines = ["| " + " | ".join(HEADER) + " |", "|" + " --- |" * len(HEADER)]
    for name, row in ROWS.items():
        if name not in found:
            continue
        form = "" if found[name]["full"] else " (small form)"
        lines.append(_line([f"**{name}**", f"**{row.problem}**{form}", "", "", "", "", row.peers]))
        for key, goal in row.goals.items():
            values = found[name]["figures"].get(key, {})
            reached = [_cell(values.get(label), goal.of(dtype), goal) for label, dtype in (("f32", F32), ("f64", F64))]
            proposed = goal.proposed or _limits(goal)
            lines.append(_line(["", key, proposed, _limits(goal), *reached, ""]))
    return "\n".join(lines)


def remarks() -> str:
    """Why goals are looser than proposed, and what is known to be wrong."""
    lines = []
    for name, row in ROWS.items():
        for key, goal in row.goals.items():
            if goal.why:
                lines.append(f"* {name}, {key}: {_limits(goal)} instead of {goal.proposed}: {goal.why}.")
            if goal.bug:
                lines.append(f"* {name}, {key}: **missed**: {goal.bug}.")
    return "\n".join(dict.fromkeys(lines))


def elsewhere() -> str:
    """Tests of other files on the same problems."""
    return "\n".join(
        f"* {name}: " + ", ".join(f"`{test}`" for test in row.also) for name, row in ROWS.items() if row.also
    )


def _limits(goal: Goal) -> str:
    texts = ["–" if x is None else f"{x:g}" for x in (goal.f32, goal.f64)]
    return texts[0] if texts[0] == texts[1] else ", ".join(texts)


def _cell(value, limit, goal: Goal) -> str:
    if value is None:
        return "–"
    value = max(float(value), 0.0) + 0.0  # negative: an eigenvalue well above 0
    text = f"{value:g}" if value == round(value) and abs(value) < 1e6 else f"{value:.1e}"
    if not math.isfinite(value):
        text = str(value)
    met = limit is None or value <= limit
    return text if met else f"**{text}**"


def _line(cells) -> str:
    return "| " + " | ".join(str(c).replace("|", r"\|") for c in cells) + " |"


def fill(text: str, marker: str, content: str) -> str:
    """The text with what stands between ``<!-- MARKER -->`` and ``<!-- /MARKER -->`` replaced."""
    start, end = f"<!-- {marker} -->", f"<!-- /{marker} -->"
    if text.count(start) != 1 or text.count(end) != 1:
        raise ValueError(f"{README}: expected {start} once, and {end} once")
    return f"{text[: text.index(start)]}{start}\n\n{content}\n\n{text[text.index(end) :]}"
