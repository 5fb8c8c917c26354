"""jaxfilt against other libraries and a C loop: ``python -m experiments.benchmarks [--quick] [--only kalman,ekf]``.

Libraries that are not installed are left out and named; the C loop needs gcc. Ratios are of calls timed in turn in one
process. The cores are made JAX devices before JAX starts; peers run as ``jax.jit(jax.vmap(f))`` beside.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import platform
import sys
import time
from collections.abc import Sequence
from pathlib import Path


def main(argv: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="n = 4, 512 runs, below a minute")
    parser.add_argument("--only", help="some parts, with commas; a wrong name shows them all")
    parser.add_argument("--devices", type=int, default=os.cpu_count(), help="host devices and threads (default: cores)")
    parser.add_argument("--budget", type=float, default=3.0, help="seconds of timing per case (default: 3)")
    parser.add_argument("--out", type=Path, default=Path("results"), help="where to write (default: results)")
    parser.add_argument("--write-readme", action="store_true", help="publish in the README beside this file")
    options = parser.parse_args(argv)
    if options.write_readme and (options.quick or options.only):
        parser.error("--write-readme publishes all tables: not with --quick or --only")

    flag = f"--xla_force_host_platform_device_count={options.devices}"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}".strip()
    os.environ.setdefault("MPLBACKEND", "Agg")
    import jax

    jax.config.update("jax_enable_compilation_cache", False)  # compilation is measured

    from experiments.benchmarks import by_hand, peers, tables
    from experiments.benchmarks.suite import PARTS, Suite
    from experiments.report import Options, Report, provenance

    parts = options.only.split(",") if options.only else ["kalman"] if options.quick else list(PARTS)
    if unknown := set(parts) - set(PARTS):
        parser.error(f"--only: no {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    left_out = peers.missing()
    try:
        by_hand.library(4, 2, "float64")
    except ImportError as reason:
        left_out["C"] = str(reason)
    used = [f"{x} {importlib.metadata.version(x)}" for x in (*peers.JAX, "filterpy") if x not in left_out]
    asked = Options(out=options.out, quick=options.quick)
    folder = asked.directory("benchmarks")
    begun, load = time.perf_counter(), os.getloadavg()[0]

    def report() -> Report:
        picture = tables.figure(suite, folder / "throughput.png")
        facts = {
            "devices": f"{jax.local_device_count()} of {jax.devices()[0].platform}; C: {options.devices} threads",
            "processor": _processor(),
            "load average": f"{load:.1f} at the start, {os.getloadavg()[0]:.1f} at the end, this job included",
            "peers": ", ".join([*used, f"C: gcc {' '.join(by_hand.FLAGS[:4])}"]),
            "left out": ", ".join(f"{name} ({why})" for name, why in left_out.items()) or "nothing",
        }
        made = Report("benchmarks", "jaxfilt against other libraries and a C loop", tables.tables(suite),
                      [] if picture is None else [picture], tables.findings(suite), facts=facts)  # fmt: skip
        made.provenance = provenance(asked, time.perf_counter() - begun)
        return made

    suite = Suite(threads=options.devices, quick=options.quick, budget=options.budget)
    for part in parts:
        suite.run(part)
        report().write(options.out)  # after each part: an interrupted run keeps what it has
    done = report()
    print(done.to_console())
    print(f"report: {done.write(options.out) / 'report.md'}")
    if options.write_readme:
        done.write_readme(Path(__file__).with_name("README.md"))
    return 0


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")


if __name__ == "__main__":
    sys.exit(main())
