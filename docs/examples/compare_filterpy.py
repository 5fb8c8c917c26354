"""Both trackers on the same data: lines of code, agreement, time. `--write` puts the table into the page.

Called as ``python docs/examples/compare_filterpy.py [--runs 1000] [--write]``.
"""

import argparse
import ast
import io
import os
import time
import tokenize
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np
import range_bearing_data as data
import range_bearing_filterpy

import jaxfilt as jf

HERE = Path(__file__).parent
PAGE = HERE.parent / "from_filterpy.md"
BEGIN, END = "<!-- table: filterpy -->", "<!-- /table: filterpy -->"
SKIPPED = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def lines_of_code(path):
    """Lines that hold code: no blank lines, comments or docstrings."""
    text = path.read_text(encoding="utf-8")
    lines = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in SKIPPED:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.FunctionDef) and ast.get_docstring(node):
            docstring = node.body[0]
            lines -= set(range(docstring.lineno, (docstring.end_lineno or docstring.lineno) + 1))
    return len(lines)


def code_lines():
    """Lines of code of the two trackers, by library."""
    return {name: lines_of_code(HERE / f"range_bearing_{name}.py") for name in ("filterpy", "jaxfilt")}


def differences(mine, theirs):
    """Largest relative differences of means (per component, against its largest), covariances and likelihoods."""
    return [
        float(np.max(np.max(np.abs(a - b), axis=axes) / np.max(np.abs(b), axis=axes)))
        for a, b, axes in zip(map(np.asarray, mine), theirs, [(0, 1), (0, 1), 0], strict=True)
    ]


def position_rmse(means, truth):
    """Root of the mean squared distance from the truth [m]."""
    return float(np.sqrt(np.mean(np.sum((np.asarray(means) - truth)[..., :2] ** 2, axis=-1))))


def timed(run, *args):
    """What ``run`` returns, computed, with wall and processor time [s]."""
    wall, cpu = time.perf_counter(), time.process_time()
    out = jax.block_until_ready(run(*args))
    return out, time.perf_counter() - wall, time.process_time() - cpu


def measure(runs, repeats=5):
    """A row per filter: dict of the figures."""
    import range_bearing_jaxfilt  # builds its model, which must not happen before jf.use_cores

    truth, ys, mask = data.simulate(runs)
    rows = []
    for name in ("ekf", "ukf"):
        theirs, loop_wall, loop_cpu = timed(getattr(range_bearing_filterpy, name), ys, mask)
        ours = getattr(range_bearing_jaxfilt, name)
        _, first, first_cpu = timed(ours, ys, mask)
        again = [timed(ours, ys, mask) for _ in range(repeats)]
        wall, cpu = (min(sample[i] for sample in again) for i in (1, 2))
        rows.append(
            {
                "name": name.upper(),
                "filterpy": loop_wall, "filterpy_cpu": loop_cpu,
                "jaxfilt": wall, "jaxfilt_cpu": cpu, "compile": first - wall, "compile_cpu": first_cpu - cpu,
                "rmse": position_rmse(again[0][0][0], truth), "their_rmse": position_rmse(theirs[0], truth),
                "difference": max(differences(again[0][0], theirs)),
            }
        )  # fmt: skip
    return rows


def table(rows, runs, load):
    """The page's table and what it was measured on."""
    lines = code_lines()
    text = ["| | filterpy | jaxfilt | ratio |", "|:--|--:|--:|--:|"]
    text.append(f"| lines of code, both filters | {lines['filterpy']} | {lines['jaxfilt']} | |")
    for r in rows:
        for label, key in ((f"{runs} runs, wall time", ""), ("processor time", "_cpu")):
            theirs, ours = r["filterpy" + key], r["jaxfilt" + key]
            text.append(f"| {r['name']}: {label} | {theirs:.3g} s | {ours:.3g} s | {theirs / ours:.0f} |")
        text.append(f"| {r['name']}: compilation, once, wall time | none | {r['compile']:.2g} s | |")
        text.append(f"| {r['name']}: compilation, processor time | none | {r['compile_cpu']:.2g} s | |")
        text.append(f"| {r['name']}: position RMSE | {r['their_rmse']:.2f} m | {r['rmse']:.2f} m | |")
        text.append(f"| {r['name']}: largest relative difference | | {r['difference']:.1e} | |")
    versions = ", ".join(f"{name} {version(name)}" for name in ("filterpy", "jaxfilt", "jax", "numpy"))
    note = (
        f"*{runs} runs of {data.SCANS} scans, float64, all means, covariances and likelihoods returned; the difference "
        "is over these. filterpy: a loop. jaxfilt: `jf.batch`, "
        f"{jax.local_device_count()} CPU devices, shortest of 5 calls; compilation: the first call less that. "
        f"{versions}. Load average at the start {load:.1f} on {os.cpu_count()} cores.*"
    )
    return "\n".join([BEGIN, "", *text, "", note, "", END])


def main():
    """Measures, prints, and writes the page if told."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    load = os.getloadavg()[0]
    jf.use_cores(os.cpu_count() or 1)
    text = table(measure(args.runs), args.runs, load)
    print(text)
    if args.write:
        page = PAGE.read_text(encoding="utf-8")
        before, rest = page.split(BEGIN)
        PAGE.write_text(before + text + rest.split(END)[1], encoding="utf-8")


if __name__ == "__main__":
    main()
