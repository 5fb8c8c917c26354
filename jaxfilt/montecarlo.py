"""Monte-Carlo batches: several filters on the same simulated runs, in compiled chunks that fit memory.

A run's random numbers depend on the key and the run's index only, so its scores do not depend on the chunk size, on the
number of runs or on the devices. Nothing but the scores leaves the compiled chunk.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from jaxfilt import core, describe, metrics
from jaxfilt.batching import in_parts
from jaxfilt.checkpoint import Store, stored_chunk
from jaxfilt.core import Filter, PyTree, Static, Status, aspartial
from jaxfilt.linalg import structure
from jaxfilt.metrics import Estimate
from jaxfilt.models.linear import LinearGaussian, check_linear
from jaxfilt.progress import maker
from jaxfilt.simulate import simulate

# More runs in one call cost memory and save nothing: from 256 to 16384 the processor time per run is the same.
_LARGEST_CHUNK = 4096
_AT_ONCE = 512  # of which so many are computed side by side: what a step works on then stays in the cache


class Draw(NamedTuple):
    """One run's data. A ``simulate`` function may return a bare ``(truth, ys)`` instead."""

    truth: PyTree  # whatever the score wants to compare with
    ys: Array  # (T, m)
    mask: Array | None = None  # (T,) or (T, m) bool, only if it differs from run to run
    dt: Array | None = None  # likewise
    u: PyTree = None  # likewise

    def __repr__(self) -> str:
        """Shapes."""
        return describe.fields(self)


class Scenario(NamedTuple):
    """What is simulated and what the filters are told. Build the common case with :func:`scenario`.

    What all runs share stands here and not in the :class:`Draw`: covariances then do not depend on the run and are
    computed once per chunk (measured: 28 against 2200 ms for 5000 runs with a shared and with a per-run mask).
    """

    simulate: Callable[[Array], Any]  # key -> Draw or (truth, ys); module-level, or a Partial of such
    mask: Any = None  # as in jaxfilt.filter
    dt: Any = None
    u: PyTree = None
    first_update_only: bool = False  # static

    def __repr__(self) -> str:
        """What simulates, and the inputs by shape."""
        return describe.fields(self)


class MonteCarloResult(NamedTuple):
    """Scores run by run, and how the batch went."""

    scores: dict[str, dict[str, np.ndarray]]  # [filter][score] -> (runs, ...)
    status: dict[str, np.ndarray]  # [filter] -> (runs,) int32, the bits of Status that occurred in any step
    runs: int
    chunk: int
    compile_seconds: float  # tracing and compiling; next to nothing when the same job has run before
    wall_seconds: float  # the computation, compiling apart

    @property
    def runs_per_second(self) -> float:
        """Runs per second of the computation, each with all filters."""
        return self.runs / self.wall_seconds

    def __repr__(self) -> str:
        """Each filter's scores as mean and standard error over runs, its status bits, and the speed."""
        return describe.monte_carlo(self, Status)

    def mean(self, filt: str, score: str) -> Estimate:
        """Mean of a score over runs with its standard error."""
        return metrics.mean(self._scores(filt, score))

    def root_mean(self, filt: str, score: str) -> Estimate:
        """Root of the mean of a score over runs (an RMSE, if the score is a mean square) with its standard error."""
        return metrics.root_mean(self._scores(filt, score))

    def ratio(self, numerator: tuple[str, str], denominator: tuple[str, str], *, root: bool = False) -> Estimate:
        """Ratio of the means of two ``(filter, score)`` over the same runs; see :func:`jaxfilt.metrics.ratio`."""
        return metrics.ratio(self._scores(*numerator), self._scores(*denominator), root=root)

    def status_counts(self, filt: str) -> dict[Status, int]:
        """In how many runs each status bit occurred; bits that did not occur are left out."""
        words = self.status[filt]
        counts = {bit: int(((words & int(bit)) != 0).sum()) for bit in Status}
        return {bit: count for bit, count in counts.items() if count}

    def _scores(self, filt, score):
        if filt not in self.scores:
            raise ValueError(f"filter: expected one of {sorted(self.scores)}, got {filt!r}")
        if score not in self.scores[filt]:
            raise ValueError(f"score: expected one of {sorted(self.scores[filt])}, got {score!r}")
        return self.scores[filt][score]


def scenario(
    model: LinearGaussian,
    T: int,
    *,
    mask: Any = None,
    dt: Any = None,
    u: PyTree = None,
    first_update_only: bool = False,
) -> Scenario:
    """The scenario that draws runs from a model; the truth is the states (T, n).

    Args:
        model: the true model. The filters under test may have another.
        T: number of samples.
        mask: (T,) or (T, m) bool, True = present, for all runs.
        dt: (T,) or scalar intervals, for simulation and filters.
        u: pytree with leading T, for simulation and filters.
        first_update_only: the start is at the first sample, for simulation and filters.
    """
    check_linear(model)
    core.check_count("T", T, 1)
    core.check_flag("first_update_only", first_update_only)
    shared = core.inputs(np.zeros((T, 1), model.m0.dtype), dt=dt, u=u)
    draw = Partial(_draw_from_model, model, Static((T, first_update_only)), shared.dt, shared.u)
    return Scenario(draw, mask, shared.dt, shared.u, first_update_only)


def _draw_from_model(model, static, dt, u, key):
    T, first_update_only = static.value
    return simulate(model, T, key, dt=dt, u=u, first_update_only=first_update_only)


def monte_carlo(
    scenario: Scenario,
    filters: Mapping[str, Filter],
    score: Callable[[PyTree, Array, Any], Mapping[str, Array]],
    runs: int,
    key: Array,
    *,
    chunk: int | None = None,
    outputs: Callable[[PyTree, core.Info], PyTree] = core.everything,
    memory_limit: int = 256 * 2**20,
    devices: Sequence[Any] | None = None,
    checkpoint: str | Path | None = None,
    progress: bool = False,
) -> MonteCarloResult:
    """Runs several filters on the same simulated data, many times, and scores each run.

    Run i draws its data with ``fold_in(fold_in(key, i), 0)``; a filter that needs random numbers gets
    ``fold_in(fold_in(key, i), 1)``, the same for all filters. Scores are the same, run by run, for any chunk size,
    number of runs or devices, up to rounding (1e-12 relative).

    Args:
        scenario: what is simulated, and the inputs that all runs share.
        filters: by name; all see the same data.
        score: ``(truth, ys, out) -> dict`` of scalars or arrays for one run; ``out`` is what :func:`jaxfilt.filter`
            returns. A module-level function or a ``Partial`` of one: anything made anew at each call compiles anew.
        runs: number of runs.
        key: random key.
        chunk: runs computed at once; None = chosen from the memory limit. Rounded up to a multiple of the devices. The
            last chunk is computed in full and cut, so that there is one compilation.
        outputs: as in :func:`jaxfilt.filter`. What the score does not use is not computed, hence the default.
        memory_limit: bytes for one chunk's working set per device, for ``chunk=None``.
        devices: JAX devices of this process; the chunk is split over these; None = all local ones of the default
            backend. After ``jax.distributed.initialize`` every process calls this function with the same arguments, the
            chunks are shared out, and every process gets all scores.
        checkpoint: a directory for the results of finished chunks. The same call then goes on where an interrupted one
            was, also with more runs, and gives the same numbers to the bit.
        progress: shows a progress bar (needs tqdm).

    Returns:
        Scores as NumPy arrays by filter and name, status bits, and times.

    Raises:
        ValueError: no filters, runs or chunk below 1, a score that is no dict, inputs of wrong shape, a ``checkpoint``
            of another job.
        ImportError: ``progress`` without tqdm.
    """
    core.check_count("runs", runs, 1)
    core.check_key(key)
    if not core.number("memory_limit", memory_limit) > 0:
        raise ValueError(f"memory_limit: expected bytes > 0, got {memory_limit}")
    core.check_callable("outputs", outputs)
    core.check_flag("progress", progress)
    if not isinstance(scenario, Scenario):
        raise TypeError(f"scenario: expected a Scenario, got {type(scenario).__name__}")
    if not isinstance(filters, Mapping) or not filters:
        raise ValueError(f"filters: expected at least one, in a dict, got {type(filters).__name__}")
    filters = dict(filters)
    for name, filt in filters.items():
        core.check_filter(filt, f"filters[{name!r}]")
    make_bar = maker(progress)
    devices = tuple(jax.local_devices() if devices is None else devices)

    started = time.perf_counter()
    static = Static((scenario.first_update_only, outputs, structure.of(filters)))
    job = (aspartial(scenario.simulate), _checked_inputs(scenario, key), filters, aspartial(score, "score"), key)
    bytes_per_run = _check_and_size(job, static)
    if chunk is None and checkpoint is not None:
        chunk = stored_chunk(checkpoint)
    if chunk is None:
        per_device = _choose_chunk(-(-runs // len(devices)), bytes_per_run, memory_limit)
    else:
        core.check_count("chunk", chunk, 1)
        per_device = -(-chunk // len(devices))
    compiled, lowered = _compile(job, per_device, static, devices)
    if chunk is None and (used := _working_memory(compiled)) > memory_limit:
        # The estimate saw data and outputs, but not what a filter with a large state needs in between.
        per_device = _choose_chunk(per_device, -(-used // per_device), memory_limit)
        compiled, lowered = _compile(job, per_device, static, devices)
    chunk = per_device * len(devices)
    store = None if checkpoint is None else Store(checkpoint, lowered.as_text(), job, chunk)
    indices = np.arange(chunk, dtype=np.uint32)
    compile_seconds = time.perf_counter() - started

    # Chunk by chunk in turn to the processes; all compute equally many, so that their results can be gathered.
    started = time.perf_counter()
    stride = chunk * jax.process_count()
    tree = jax.tree.structure(lowered.out_info)
    parts: list[Any] = []
    pending: tuple[Any, int] | None = None
    with make_bar(total=runs, unit="run", unit_scale=True) if make_bar else contextlib.nullcontext() as bar:
        for first in range(chunk * jax.process_index(), stride * math.ceil(runs / stride), stride):
            found = None if store is None else store.load(first, tree)
            result = (compiled(job, indices + np.uint32(first)) if found is None else found), first
            if pending is not None:  # one chunk is in flight while the one before it is fetched
                parts.append(_fetch(*pending, store, bar, min(stride, runs)))
            pending = result
        assert pending is not None
        parts.append(_fetch(*pending, store, bar, runs - stride * len(parts)))
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *parts)
    scores, status = jax.tree.map(partial(_in_order, runs=runs), _of_all_processes(stacked))
    return MonteCarloResult(scores, status, runs, chunk, compile_seconds, time.perf_counter() - started)


@partial(jax.jit, static_argnames=("static", "devices"))
def _run_chunk(job, indices, static, devices):
    run = partial(_run, static=static, results=_scored)
    return in_parts(run, (job,), indices, len(indices), _AT_ONCE, devices)


def _run(job, index, static, results):
    """One run: draws the data and filters them with each filter."""
    simulate_run, (mask, dt, u), filters, score, key = job
    first_update_only, outputs, labels = static.value
    filters = structure.noted(filters, labels)
    key = jax.random.fold_in(key, index)
    draw = Draw(*simulate_run(jax.random.fold_in(key, 0)))
    options = {
        "mask": mask if draw.mask is None else draw.mask,
        "dt": dt if draw.dt is None else draw.dt,
        "u": u if draw.u is None else draw.u,
        "key": jax.random.fold_in(key, 1),
        "first_update_only": first_update_only,
    }
    outs = {name: core.filter(filt, draw.ys, outputs=outputs, **options) for name, filt in filters.items()}
    return results(score, draw, outs)


def _scored(score, draw, outs):
    scores = {name: dict(score(draw.truth, draw.ys, out)) for name, out in outs.items()}
    words = {name: getattr(out, "status", None) for name, out in outs.items()}
    status = {name: _any_bits(word) for name, word in words.items() if word is not None}
    return jax.tree.map(jnp.asarray, scores), status


def _any_bits(words):
    return jax.lax.reduce(words, np.int32(0), jax.lax.bitwise_or, (0,))


def _all_of_it(score, draw, outs):
    return draw, outs, {name: score(draw.truth, draw.ys, out) for name, out in outs.items()}


@partial(jax.jit, static_argnames="static")
def _run_once(job, index, static):
    return _run(job, index, static, _all_of_it)


def _checked_inputs(scenario, key):
    """The shared (mask, dt, u), checked here because nothing can raise inside the compiled chunk."""
    draw = Draw(*jax.eval_shape(scenario.simulate, key))
    shared = core.inputs(np.zeros(draw.ys.shape, draw.ys.dtype), mask=scenario.mask, dt=scenario.dt, u=scenario.u)
    return shared.mask, shared.dt, shared.u


def _check_and_size(job, static):
    """Bytes of one run's data and outputs, which is what a chunk must hold for each run; checks the score."""
    draw, outs, scores = _run_once.eval_shape(job, np.uint32(0), static)
    for name, value in scores.items():
        if not isinstance(value, Mapping):
            raise ValueError(f"score: expected a dict of arrays, got {type(value).__name__} for filter {name!r}")
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves((draw, outs)))


def _choose_chunk(runs, bytes_per_run, memory_limit):
    """A power of two that fits memory: other numbers of runs then meet the same compilation."""
    wanted = min(max(1, memory_limit // bytes_per_run), _LARGEST_CHUNK)
    largest = 1 << (wanted.bit_length() - 1)
    enough = 1 << (runs - 1).bit_length()
    return min(largest, enough)


def _compile(job, per_device, static, devices):
    indices = np.arange(per_device * len(devices), dtype=np.uint32)
    lowered = _run_chunk.lower(job, indices, static, devices)
    return lowered.compile(), lowered


def _working_memory(compiled):
    analysis = compiled.memory_analysis()  # None where the backend does not know
    return 0 if analysis is None else analysis.temp_size_in_bytes


def _fetch(result, first, store, bar, count):
    part = jax.tree.map(np.asarray, result)
    if store is not None and not isinstance(jax.tree.leaves(result)[0], np.ndarray):  # it does not come from there
        store.save(first, part)
    if bar is not None:
        bar.update(count)
    return part


def _of_all_processes(stacked):
    """(rounds, chunk, ...) of each process as (processes, rounds, chunk, ...) in all of them."""
    if jax.process_count() == 1:
        return jax.tree.map(lambda x: x[None], stacked)
    from jax.experimental import multihost_utils

    return multihost_utils.process_allgather(stacked)


def _in_order(x, runs):
    x = np.swapaxes(x, 0, 1)
    return x.reshape(-1, *x.shape[3:])[:runs]
