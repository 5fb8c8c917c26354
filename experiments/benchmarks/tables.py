"""What the measurements say: tables, a figure, and sentences whose numbers are computed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.benchmarks.measure import Timing
from experiments.benchmarks.suite import BATCHES, LONGEST_CALL, MAIN, RUNS, STEPS, Result, Suite
from experiments.report import Cell, Entry, Table

PEERS = ("dynamax", "cuthbert", "kalman-py", "filterpy", "C")
# What the project wants: (part of the model's name, quantity) -> least ratio to dynamax; to C of the likelihood.
BARS = {
    "n = 4, m = 2, CV": {"likelihood": 20, "history": 8, "gradient": 15},
    "n = 6, m = 2, CA": {"likelihood": 8, "history": 4, "gradient": 6},
    "n = 9, m = 3, CA": {"likelihood": 8, "history": 4, "gradient": 6},
}
# Which forms of ours and of peers are of one kind.
WINS = (*((peer, "jaxfilt") for peer in ("dynamax", "dynamax split", "cuthbert", "kalman-py", "filterpy", "C")),
        ("C full", "jaxfilt full"), ("dynamax one", "jaxfilt one"))  # fmt: skip
BAR_C, BAR_NONLINEAR, BAR_LONG = 0.5, 3.0, 1.1


def tables(suite: Suite) -> list[Table]:
    """All tables for which something was measured."""
    of = {part: [r for r in suite.results if r.part == part] for part in {r.part for r in suite.results}}
    nonlinear = [r for family in ("ekf", "ukf", "imm") for r in of.get(family, [])]
    found = []
    if "kalman" in of:
        found.append(_throughput("kalman", "Kalman filters in float64", of["kalman"]))
    if "float32" in of:
        found.append(_throughput("float32", "Kalman filters in float32", of["float32"]))
    if nonlinear:
        found.append(_throughput("nonlinear", "EKF, UKF and IMM in float64", nonlinear))
    if "batches" in of:
        found.append(_batches(of["batches"]))
    if "linear" in of:
        found.append(_linear(of["linear"]))
    if "long" in of:
        found.append(_long(of["long"]))
    if "kalman" in of and not suite.quick:
        found.append(_programs(of["kalman"], suite.memory))
    return found


def _rate(timing: Timing | None) -> Entry:
    return "-" if timing is None else Cell(timing.rate / 1e6)


def ratio(result: Result, name: str, other: str, *, cpu: bool = False) -> float | None:
    """How many times the throughput of ``other`` that of ``name`` is; per processor time with ``cpu``."""
    if name not in result.timings or other not in result.timings:
        return None
    a, b = result.timings[name], result.timings[other]
    return a.cpu_rate / b.cpu_rate if cpu else a.rate / b.rate


def _cell(x: float | None) -> Entry:
    return "-" if x is None else Cell(x)


def _throughput(name, title, results: Sequence[Result]) -> Table:
    peers = [p for p in PEERS if any(p in r.timings for r in results)]
    others = [(p, f"/ {p}") for p in ("dynamax", "C") if p in peers]
    dense = any("jaxfilt dense" in r.timings for r in results)
    header = ["model", "quantity", "jaxfilt", *peers, *(label for _, label in others)]
    header += [f"{label}, CPU" for _, label in others] + ["/ own dense form"] * dense + ["spread"]
    rows: list[list[Entry]] = []
    for r in results:
        rows.append(_row(r, r.case.quantity, "jaxfilt", peers, others, dense, "C"))
        if "jaxfilt full" in r.timings:
            rows.append(_row(r, "history, full P", "jaxfilt full", peers, others, dense, "C full"))
    sizes = sorted({(r.case.batch, r.case.steps) for r in results})
    what = ", ".join(f"{batch} runs of {steps} steps" for batch, steps in sizes)
    note = (
        f"Million steps of a run per second, {what}, R of each run its own; the ratios are of the same run. History: "
        "means and lower triangles (jaxfilt, C) or full covariances (all others, and the rows that say so). Gradient: "
        "of the log-likelihood with respect to log R. CPU: ratios per processor time, which other work on the machine "
        "moves less, but which does not see idle cores. Spread: the largest ratio of a median sample to the shortest."
    )
    return Table(name, title, header, rows, note)


def _row(r: Result, label, own, peers, others, dense, c) -> list[Entry]:
    def key(peer):
        return c if peer == "C" else peer

    row: list[Entry] = [r.case.problem.name, label, _rate(r.timings.get(own))]
    row += [_rate(r.timings.get(key(p))) for p in peers]
    row += [_cell(ratio(r, own, key(p))) for p, _ in others]
    row += [_cell(ratio(r, own, key(p), cpu=True)) for p, _ in others]
    row += [_cell(ratio(r, own, "jaxfilt dense"))] * dense
    return [*row, Cell(max(t.spread for t in r.timings.values()))]


def _batches(results: Sequence[Result]) -> Table:
    names = [n for n in ("jaxfilt", "dynamax", "cuthbert", "C") if any(n in r.timings for r in results)]
    rows: list[list[Entry]] = []
    for r in results:
        row: list[Entry] = [r.case.dtype, r.case.quantity, f"{r.case.batch}"]
        row += [
            _rate(r.timings[n]) if n in r.timings else r.notes.get(n, "-").replace("not offered", "-") for n in names
        ]
        rows.append([*row, _cell(ratio(r, "jaxfilt", "dynamax")), _cell(ratio(r, "jaxfilt", "C"))])
    note = (
        f"Million steps of a run per second; {MAIN.name}, 200 steps. A dash: not measured, since a call would take "
        f"more than {LONGEST_CALL:g} s, or not offered."
    )
    return Table(
        "batches", "From one run to 100000", ["type", "quantity", "runs", *names, "/ dynamax", "/ C"], rows, note
    )


def _linear(results: Sequence[Result]) -> Table:
    steps = sorted({r.case.steps for r in results})
    runs = sorted({r.case.batch for r in results})
    at = {(r.case.batch, r.case.steps): 1e9 / r.timings["jaxfilt"].rate for r in results}
    rows: list[list[Entry]] = [[f"{n} runs", *(_cell(at.get((n, T))) for T in steps)] for n in runs]
    header = ["", *(f"{T} steps" for T in steps)]
    return Table("linear", "Cost is linear in runs and steps", header, rows,
                 f"ns per step and run; likelihood, {MAIN.name}, float64.")  # fmt: skip


def _long(results: Sequence[Result]) -> Table:
    rows: list[list[Entry]] = []
    for r in results:
        times = [r.timings.get(name) for name in ("jaxfilt one", "dynamax one")]
        shown: list[Entry] = ["-" if t is None else Cell(1e3 * t.seconds) for t in times]
        rows.append([r.case.quantity, *shown, _cell(ratio(r, "dynamax one", "jaxfilt one"))])
    header = ["quantity", "jaxfilt [ms]", "dynamax [ms]", "jaxfilt's share"]
    note = f"{MAIN.name}, float64, sequential; jf.filter and lgssm_filter under jit, no batch."
    return Table("long", "One run of 100000 steps", header, rows, note)


def _programs(results: Sequence[Result], memory) -> Table:
    rows: list[list[Entry]] = []
    for r in results:
        for name in ("jaxfilt", "dynamax", "cuthbert", "kalman-py"):
            if name in r.timings:
                used = memory.get((name, r.case.quantity)) if r.case.problem is MAIN else None
                rows.append([r.case.problem.name, r.case.quantity, name, Cell(r.timings[name].compiling),
                             "-" if used is None else Cell(used / 2**20)])  # fmt: skip
    header = ["model", "quantity", "library", "compilation [s]", "memory [MiB]"]
    note = (
        f"Compilation: the first call less the shortest later one, tracing included. Memory: temporary and results of "
        f"the compiled program, all devices, {RUNS} runs of 200 steps."
    )
    return Table("programs", "Compilation and memory", header, rows, note)


def findings(suite: Suite) -> list[str]:
    """The bars, and where a peer wins."""
    out = []
    for r in suite.results:
        name, quantity = r.case.problem.name, r.case.quantity
        where = f"{name}, {quantity}"
        if r.part == "kalman" and not suite.quick:
            if (bar := BARS.get(name, {}).get(quantity)) and (x := ratio(r, "jaxfilt", "dynamax")):
                out.append(_bar(f"{where}: {x:.3g} times dynamax", x >= bar, f"at least {bar}"))
            if name in BARS and name == MAIN.name and quantity == "likelihood" and (x := ratio(r, "jaxfilt", "C")):
                out.append(_bar(f"{where}: {x:.2f} of the C loop", x >= BAR_C, f"at least {BAR_C}"))
            if x := ratio(r, "jaxfilt", "jaxfilt dense"):
                out.append(_bar(f"{where}: {x:.3g} times the own dense form", x >= 1, "not below it"))
            if quantity != "history" and name in BARS:
                limit, seconds = (4, 10)[quantity == "gradient"], r.timings["jaxfilt"].compiling
                out.append(_bar(f"{where}: compiled in {seconds:.1f} s", seconds < limit, f"below {limit} s"))
        if r.part in ("ekf", "ukf") and (x := ratio(r, "jaxfilt", "dynamax")):
            out.append(_bar(f"{where}: {x:.3g} times dynamax", x >= BAR_NONLINEAR, f"at least {BAR_NONLINEAR:g}"))
        if r.part == "long" and (x := ratio(r, "dynamax one", "jaxfilt one")):
            out.append(_bar(f"one run of {r.case.steps} steps, {quantity}: {x:.2f} of dynamax's time",
                            x <= BAR_LONG, f"at most {BAR_LONG}"))  # fmt: skip
    differ = [note for r in suite.results for note in r.notes.values() if "differs" in note]
    if differ:
        out.append("Not timed, since results differ: " + "; ".join(differ) + ".")
    wins: dict[tuple[str, ...], dict[int, float]] = {}
    for r in suite.results:
        for peer, own in WINS:
            if (x := ratio(r, peer, own)) and x > 1:
                wins.setdefault((peer, name_of(r), r.case.quantity, r.case.dtype), {})[r.case.batch] = x
    listed = [
        f"{', '.join(key)}, {' and '.join(str(batch) for batch in found)} runs (up to {max(found.values()):.3g} times)"
        for key, found in wins.items()
    ]
    out.append("A peer wins: " + ("; ".join(listed) if listed else "nowhere that was measured") + ".")
    return out


def name_of(r: Result) -> str:
    """The model's name, with the steps where they are not the usual ones."""
    return r.case.problem.name if r.case.steps == STEPS else f"{r.case.problem.name}, {r.case.steps} steps"


def _bar(text: str, met: bool, wanted: str) -> str:
    return f"{text} (wanted: {wanted}; {'met' if met else 'missed'})."


def figure(suite: Suite, path: Path) -> Path | None:
    """Throughput against batch size, by library; None if the part was not measured."""
    results = [r for r in suite.results if r.part == "batches"]
    if not results:
        return None
    import matplotlib.pyplot as plt

    colors = {"jaxfilt": "C0", "C": "C3", "dynamax": "C1", "cuthbert": "C2"}
    quantities = list(dict.fromkeys(r.case.quantity for r in results))
    fig, axes = plt.subplots(1, len(quantities), figsize=(4.2 * len(quantities), 3.8), sharey=True, squeeze=False)
    for ax, quantity in zip(axes[0], quantities, strict=True):
        for dtype, style in (("float64", "-"), ("float32", "--")):
            for name, color in colors.items():
                points: list[Any] = [(r.case.batch, r.timings[name].rate) for r in results
                          if r.case.quantity == quantity and r.case.dtype == dtype and name in r.timings]  # fmt: skip
                if points:
                    ax.loglog(
                        *zip(*points, strict=True), style, color=color, marker="o", ms=3, label=f"{name}, {dtype}"
                    )
        ax.set(title=quantity, xlabel="runs in a batch", xlim=(0.8, 1.3 * BATCHES[-1]))
        ax.grid(alpha=0.3)
    axes[0][0].set_ylabel("steps per second")
    handles, labels = axes[0][0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    fig.suptitle(f"Kalman filter, {MAIN.name}, 200 steps")
    fig.tight_layout(rect=(0, 0.13, 1, 1))
    fig.savefig(path, dpi=130)
    plt.close(fig)
    return path
