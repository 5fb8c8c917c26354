"""Times of several libraries on one problem: results are compared first, then the calls are timed in turn."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks import by_hand, ours, peers
from experiments.benchmarks.cases import Data, Problem

# Largest relative difference from jaxfilt's results, by library and dtype. dynamax adds 1e-9 to the diagonal of the
# innovation covariance, which is 7e-6 of the smallest variance of a bearing here, where all others agree to 1e-13.
# cuthbert composes associative elements and loses 1e-6 with constant acceleration, where C loop and jaxfilt agree to
# 1e-13. Gradients and single precision lose more digits than likelihoods in float64.
AGREE = {"cuthbert": 1e-5, "C": 1e-9, "C full": 1e-9, "jaxfilt full": 1e-10, "jaxfilt dense": 1e-10}
AGREE_PEER, AGREE_BEARING, AGREE_GRADIENT, AGREE_SINGLE = 1e-6, 1e-5, 1e-5, 1e-2
# Runs on which slow libraries are timed; their time for the batch is scaled up. filterpy loops over them.
MOST_RUNS = {"filterpy": 2, "cuthbert": 512, "kalman-py": 512}
# A sample is so many calls that it lasts this long [s]: on a machine that does something else too, short calls would
# find a free moment that long ones cannot.
SAMPLE = 0.1
SLOW = 2.0  # a call that takes longer [s] is timed twice only
COMPARED = 32  # runs whose results are compared


class Case(NamedTuple):
    """What is measured."""

    problem: Problem
    quantity: str  # likelihood, history or gradient
    batch: int
    steps: int = 200
    dtype: str = "float64"


class Timing(NamedTuple):
    """Of one library in one case."""

    seconds: float  # the shortest call, for the whole batch
    spread: float  # the median call over the shortest
    compiling: float  # the first call less the shortest [s]
    samples: int
    rate: float  # steps of a run per second
    cpu_rate: float  # steps per second of processor time, the least of all samples: what else the machine does is out


class Candidate(NamedTuple):
    """A call to be timed; it handles ``runs`` of the batch's runs."""

    call: Callable[[], Any]
    runs: int


def candidates(case: Case, data: Data, names: Sequence[str], threads: int) -> dict[str, Candidate | str]:
    """The calls by library, or why there is none."""
    found: dict[str, Candidate | str] = {}
    for name in names:
        try:
            found[name] = _candidate(name, case, data, threads)
        except (ImportError, peers.NotOffered) as reason:
            found[name] = str(reason) or "not offered"
    return found


def _candidate(name, case, data, threads):
    p, quantity = case.problem.astype(np.dtype(case.dtype)), case.quantity
    if name in ("C", "C full"):
        if p.family != "kalman" or quantity == "gradient" or (name == "C full" and quantity != "history"):
            raise peers.NotOffered
        history = 0 if quantity == "likelihood" else 1 if name == "C" else 2
        return Candidate(by_hand.prepare(p, data, history, threads), case.batch)
    if name == "filterpy":
        few = data.first(MOST_RUNS[name])
        return Candidate(peers.filterpy(p, quantity, few), len(few.log_r))
    if name == "jaxfilt one":
        fn, args = ours.prepare_one(p, quantity, data)
    elif name.startswith("jaxfilt"):
        if name == "jaxfilt full" and quantity != "history":
            raise peers.NotOffered
        form = "dense" if name == "jaxfilt dense" else "auto"
        fn, args = ours.prepare(p, "full" if name == "jaxfilt full" else quantity, data, form)
    elif name == "dynamax one":
        one = peers.one_run("dynamax", p, quantity)
        fn, args = jax.jit(one), (jnp.asarray(data.log_r[0]), jnp.asarray(data.ys[0]))
    elif name.endswith(" split"):
        fn, args = peers.prepare_split(name.removesuffix(" split"), p, quantity, data)
    else:
        data = data.first(MOST_RUNS.get(name, case.batch))
        fn, args = peers.prepare(name, p, quantity, data)
    return Candidate(partial(_finished, fn, *args), len(data.log_r))


def _finished(fn, *args):
    return jax.block_until_ready(fn(*args))


def measure(
    case: Case,
    data: Data,
    names: Sequence[str],
    *,
    threads: int,
    budget: float = 4.0,
    rounds: int = 7,
    sample: float = SAMPLE,
) -> tuple[dict[str, Timing], dict[str, str]]:
    """Times by library, and why a library has none: not installed, not offered, or its results differ.

    Args:
        case: what to measure.
        data: of at least that batch and those steps.
        names: libraries; the first is what the others are compared with.
        threads: of the C loop.
        budget: seconds after which no further round begins (3 rounds at least).
        rounds: most rounds.
        sample: least length of a sample [s].
    """
    data = Data(data.log_r[: case.batch], data.ys[: case.batch, : case.steps])
    with jax.enable_x64(case.dtype == "float64"):
        found = candidates(case, data, names, threads)
        notes = {name: x for name, x in found.items() if isinstance(x, str)}
        ready = {name: x for name, x in found.items() if isinstance(x, Candidate)}
        first: dict[str, float] = {}
        reference = None
        for name, candidate in ready.items():
            begun = time.perf_counter()
            out = candidate.call()
            first[name] = time.perf_counter() - begun
            out = compared(name, case, out)
            reference = out if reference is None else reference
            try:
                check(name, case, out, reference)
            except AssertionError as reason:
                notes[name] = str(reason)
        ready = {name: x for name, x in ready.items() if name not in notes}
        times, cpu = _in_turn(ready, budget, rounds, sample)
    timings = {}
    for name, spent in times.items():
        best, share = min(spent), case.batch / ready[name].runs
        steps = ready[name].runs * case.steps
        timings[name] = Timing(
            best * share,
            float(np.median(spent)) / best,
            first[name] - best,
            len(spent),
            steps / best,
            steps / min(cpu[name]),
        )
    return timings, notes


def _in_turn(ready, budget, rounds, sample):
    """Seconds of a call, and of processor time, by library, one entry per round."""
    times: dict[str, list[float]] = {name: [] for name in ready}
    cpu: dict[str, list[float]] = {name: [] for name in ready}
    repeats: dict[str, int] = {}
    started = time.perf_counter()
    for k in range(rounds + 1):  # the first round finds out how long a call takes
        if k > 3 and time.perf_counter() - started > budget:
            break
        for name, candidate in ready.items():
            if len(times[name]) >= 2 and min(times[name]) > SLOW:
                continue
            many = repeats.get(name, 1)
            begun, used = time.perf_counter(), time.process_time()
            for _ in range(many):
                candidate.call()
            spent = (time.perf_counter() - begun) / many
            used = (time.process_time() - used) / many
            repeats.setdefault(name, max(1, min(1000, round(sample / spent))))
            if k or spent > SLOW:
                times[name].append(spent)
                cpu[name].append(max(used, 1e-9))
    return times, cpu


def compared(name: str, case: Case, out: Any) -> list[np.ndarray]:
    """The results of the first runs, in one layout: (runs,), or means (runs, T, n) and covariances as triangles."""
    if case.quantity != "history":
        return [np.atleast_1d(jax.tree.leaves(out)[0])[:COMPARED]]
    means, covs = jax.tree.leaves(out)
    if name.endswith(" one"):
        means, covs = means[None], covs[None]
    if name in ("C", "C full"):
        means, covs = (np.moveaxis(x[..., :COMPARED], -1, 0) for x in (means, covs))
    means, covs = np.asarray(means[:COMPARED]), np.asarray(covs[:COMPARED])
    rows, columns = np.tril_indices(case.problem.n)
    n = case.problem.n
    if covs.ndim == 4:
        covs = covs[..., rows, columns]
    elif covs.shape[-1] == n * n:
        covs = covs[..., rows * n + columns]
    return [means, covs]


def check(name: str, case: Case, out: list[np.ndarray], reference: list[np.ndarray]) -> None:
    """Raises an AssertionError where results differ by more than is allowed, relative to the largest entry."""
    allowed = AGREE.get(name, AGREE_PEER if case.problem.family == "kalman" else AGREE_BEARING)
    if case.quantity == "gradient":
        allowed = max(allowed, AGREE_GRADIENT)
    if case.dtype == "float32":
        allowed = AGREE_SINGLE
    for x, wanted in zip(out, reference, strict=True):
        wanted = wanted[: len(x)].astype(np.float64)
        difference = np.abs(x.astype(np.float64) - wanted).max() / np.abs(wanted).max()
        if not difference <= allowed:
            raise AssertionError(f"{name}: {case.problem.name}, {case.quantity}, {case.dtype}: "
                                 f"differs by {difference:.1e} relative, {allowed:.0e} allowed")  # fmt: skip


def memory(case: Case, data: Data, name: str) -> float:
    """Temporary memory and results of the compiled program [bytes], on all devices; NaN where XLA does not say."""
    data = Data(data.log_r[: case.batch], data.ys[: case.batch, : case.steps])
    p = case.problem.astype(np.dtype(case.dtype))
    with jax.enable_x64(case.dtype == "float64"):
        ours_ = name == "jaxfilt"
        fn, args = ours.prepare(p, case.quantity, data) if ours_ else peers.prepare(name, p, case.quantity, data)
        analysis = jax.jit(fn).lower(*args).compile().memory_analysis()
    if analysis is None:
        return float("nan")
    devices = jax.local_device_count() if ours_ else 1
    return float((analysis.temp_size_in_bytes + analysis.output_size_in_bytes) * devices)
