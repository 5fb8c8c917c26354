"""Measures the rows and writes the table: ``python -m tests.robustness [--rows R1,R2] [--quick] [--write]``."""

from __future__ import annotations

import argparse
import gc
import json
import time

import jax
import numpy as np


def main() -> None:
    """Measures, prints, and with ``--write`` updates the README, the numbers and the figure beside this file."""
    parser = argparse.ArgumentParser(prog="python -m tests.robustness", description=__doc__)
    parser.add_argument("--rows", help="comma-separated; all if not given")
    parser.add_argument(
        "--quick", action="store_true", help="the small form, as in the default tests; the table says so"
    )
    parser.add_argument("--write", action="store_true", help="update README.md, measured.json and the figure")
    parser.add_argument("--render", action="store_true", help="write from what was measured before; measure nothing")
    parser.add_argument("--no-figure", action="store_true", help="leave the figure as it is")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    jax.config.update("jax_numpy_rank_promotion", "raise")

    from tests.robustness import table
    from tests.robustness.row import F32, F64

    found = table.measured()
    names = [] if args.render else args.rows.split(",") if args.rows else list(table.ROWS)
    for name in names:
        row, start, figures = table.ROWS[name], time.perf_counter(), {}
        for label, dtype in (("f32", F32), ("f64", F64)):
            for key, value in row.measure(dtype, not args.quick).items():
                figures.setdefault(key, {})[label] = _number(value)
            # Compiled programs hold memory maps, of which Linux gives a process 65530.
            jax.clear_caches()
            gc.collect()
        figures = {key: {"f32": None, "f64": None, **figures.get(key, {})} for key in row.goals}
        print(f"{name} ({time.perf_counter() - start:.0f} s)", flush=True)
        for key, goal in row.goals.items():
            for label, dtype in (("f32", F32), ("f64", F64)):
                value, limit = figures[key][label], goal.of(dtype)
                failed = value is not None and limit is not None and not float(value) <= limit
                print(f"  {'MISSED ' if failed else ''}{label} {value} <= {limit}: {key}", flush=True)
        # Read anew: another process may have measured other rows.
        found = {**table.measured(), name: {"full": not args.quick, "figures": figures}}
        if args.write:
            table.MEASURED.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    if args.write or args.render:
        from tests.robustness.figure import draw

        text = table.README.read_text(encoding="utf-8")
        for marker, content in (("table: rows", table.table(found)), ("remarks", table.remarks()),
                                ("elsewhere", table.elsewhere())):  # fmt: skip
            text = table.fill(text, marker, content)
        table.README.write_text(text, encoding="utf-8")
        if not args.no_figure:
            draw(table.HERE / "curves.png")


def _number(x):
    """JSON has no nan and inf; as text, ``float`` reads them back."""
    x = float(x)
    return float(f"{x:.3g}") if np.isfinite(x) else str(x)


if __name__ == "__main__":
    main()
