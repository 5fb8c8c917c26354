"""Time per step of the joint particle filter: ``python -m experiments.benchmarks.joint_tracking``.

All on the same data in one run, compiled beforehand, the fastest of some repeats: the single filter with 5000 particles
over 5 modes and 2 classes, the reference with 5000 for each class, the IMM bank, and the single filter in NumPy, which
is vectorised over the particles and loops over steps and runs.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.joint_tracking import system
from experiments.joint_tracking.runs import CHUNK, filtered
from experiments.report import Cell, Entry, Table

NAMES = ("single filter, 5000", "one filter per class, 2 x 5000", "IMM bank of EKFs", "single filter in NumPy, 5000")


def measure(runs: int, steps: int, repeats: int, count: int = 5000) -> dict[str, float]:
    """Seconds per step and run, by :data:`NAMES`."""
    data = system.simulate(system.DEMO, 1, runs, jax.random.key(0))
    data = data._replace(ys=data.ys[:, :steps])
    makes = (
        Partial(system.single, jf.Static((count,)), 0.5), Partial(system.multi, jf.Static((count,))),
        Partial(system.imm_bank),
    )  # fmt: skip
    # The same number of particles at once: twice as many leave the cache, which is not the reference's fault.
    chunks = (min(CHUNK, runs), max(1, min(CHUNK, runs) // 2), min(CHUNK, runs))
    calls: dict[str, Callable[[], Any]] = {
        name: Partial(_finished, jf.Static(chunk), make, data)
        for name, make, chunk in zip(NAMES[:3], makes, chunks, strict=True)
    }
    classes = jnp.repeat(jnp.arange(2), count // 2)
    start = np.asarray(system.start(data.first[0], system.DEMO, jax.random.key(0), classes, None))
    ys = np.asarray(data.ys[0])
    share = {**dict.fromkeys(calls, runs * len(ys)), NAMES[3]: len(ys)}
    calls[NAMES[3]] = lambda: numpy_filter(start, ys, np.random.default_rng(0))
    for call in calls.values():
        call()
    best = dict.fromkeys(calls, np.inf)
    for _ in range(repeats):  # in turn, so that what else the machine does meets all of them
        for name, call in calls.items():
            begun = time.perf_counter()
            call()
            best[name] = min(best[name], (time.perf_counter() - begun) / share[name])
    return best


def _finished(chunk: jf.Static, make: Partial, data: system.Data) -> Any:
    return jax.block_until_ready(filtered(make, system.DEMO, data, chunk.value))


def numpy_filter(start: np.ndarray, ys: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """log p of the classes (T, 2): the single filter written in NumPy for one run, from draws (N, 4) by class."""
    c, count = system.DEMO, len(start)
    half = count // 2
    counts = np.array([half, count - half])
    x = start.T
    m = rng.integers(5, size=count)
    log_w, log_p = np.full(count, -np.log(half)), np.log([0.5, 0.5])
    stay = np.exp(-c.dt / c.dwell)
    pi = np.where(np.eye(5, dtype=bool), stay, (1 - stay) / 4).cumsum(axis=1)
    accel = np.array([[0, a, -a, 0, 0] for a in c.accel])
    omega = np.array([[0, 0, 0, w, -w] for w in c.omega])
    u = omega * c.dt
    w = np.where(omega == 0, 1.0, omega)
    arcs = np.stack([np.where(omega == 0, c.dt, np.sin(u) / w), np.where(omega == 0, 0.0, (np.cos(u) - 1) / w),
                     np.cos(u), np.sin(u)])  # fmt: skip
    sigma = np.array(c.sigma_w)
    found = []
    for z in ys:
        k = np.repeat([0, 1], counts)
        weights = np.exp(log_w)
        ess = [1 / np.sum(part**2) for part in np.split(weights, counts[:1])]
        if (ess < 0.5 * counts).any():
            first_count = int(np.clip(round(count * np.exp(log_p[0])), half // 2, count - half // 2))
            wanted = np.array([first_count, count - first_count])
            index = []
            for begin, n, size in zip((0, counts[0]), wanted, counts, strict=True):
                cumulated = np.cumsum(weights[begin : begin + size])
                points = (np.arange(n) + rng.uniform()) / n * cumulated[-1]
                index.append(begin + np.searchsorted(cumulated, points, side="right"))
            index = np.concatenate(index)
            x, m, counts, k = x[:, index], m[index], wanted, np.repeat([0, 1], wanted)
            log_w = -np.log(wanted)[k]
        m = np.sum(rng.uniform(size=count)[None] >= pi[m, :4].T, axis=0)
        s, q, cos, sin = arcs[:, k, m]
        push = accel[k, m] / np.hypot(x[2], x[3])
        e = sigma[k] * rng.standard_normal((2, count))
        ax, ay = push * x[2] + e[0], push * x[3] + e[1]
        h = c.dt**2 / 2
        x = np.stack([x[0] + s * x[2] + q * x[3] + h * ax, x[1] - q * x[2] + s * x[3] + h * ay,
                      cos * x[2] - sin * x[3] + c.dt * ax, sin * x[2] + cos * x[3] + c.dt * ay])  # fmt: skip
        bearing = z[1] - np.arctan2(x[1], x[0])
        bearing -= 2 * np.pi * np.round(bearing / (2 * np.pi))
        v = np.hypot(x[2], x[3])
        g = np.where(k == 0, np.clip(0.8 - 0.0035 * (v - 100), 0.1, 0.8), np.clip(0.1 + 0.0017 * (v - 150), 0.1, 0.95))
        joint = log_w - 0.5 * ((z[0] - np.hypot(x[0], x[1])) / c.sigma_r) ** 2 - 0.5 * (bearing / c.sigma_theta) ** 2
        joint += c.gamma * np.log(g)
        shift = np.array([part.max() for part in np.split(joint, counts[:1])])
        weights = np.exp(joint - shift[k])
        total = np.array([part.sum() for part in np.split(weights, counts[:1])])
        log_w = np.log(np.maximum(weights / total[k], 1e-300))
        log_p = log_p + shift + np.log(total)
        log_p -= np.logaddexp(*log_p)
        found.append(log_p)
    return np.array(found)


def table(seconds: dict[str, float], runs: int) -> Table:
    """Time per step, and as a share of the reference's."""
    reference = seconds[NAMES[1]]
    rows: list[list[Entry]] = [[name, Cell(1e3 * x), Cell(x / reference)] for name, x in seconds.items()]
    note = (
        f"{runs} runs at once (NumPy: one), float64, fastest repeat; times depend on the machine and on "
        "what else it does, ratios less."
    )
    return Table("cost", "Cost of a step", ["filter", "ms per step and run", "share of the reference"], rows, note)


def main(argv: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m experiments.benchmarks.joint_tracking")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    made = table(measure(options.runs, options.steps, options.repeats), options.runs)
    print(f"{made.title}\n\n{made.text('simple')}\n\n{made.note}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
