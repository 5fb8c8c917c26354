"""Evolution on the same coordinates and box: pymoo breeds, JAX evaluates the whole population as one batch."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import aspartial, check_count, check_flag, check_key, numbers
from jaxfilt.linalg import structure
from jaxfilt.models.linear import check_finite
from jaxfilt.progress import rounds
from jaxfilt.tune import params as spaces
from jaxfilt.tune.result import Front, TuneResult, check_time_limit, make_result

PyTree = Any

_PENALTY = 1e30  # stands for a non-finite loss inside pymoo, which ranks numbers


def genetic(
    loss: Callable[[PyTree, PyTree], Array],
    space: PyTree,
    data: PyTree = None,
    *,
    key: Array,
    population: int = 30,
    generations: int = 40,
    time_limit: float | None = None,
    progress: bool = False,
) -> TuneResult:
    """Minimizes a loss with pymoo's genetic algorithm (simulated binary crossover, polynomial mutation, elitism).

    Args:
        loss: ``(params, data) -> ()``, deterministic: random numbers belong to ``data``. A non-finite loss ranks last.
        space: a pytree of specs (see :mod:`jaxfilt.tune.params`).
        data: a pytree of arrays passed to the loss.
        key: random key. The first population is the space's initial value and uniform draws from its box.
        population: members, evaluated as one vmapped batch. Memory grows with it.
        generations: number of generations, the first population included.
        time_limit: seconds after which no new generation is begun, compilation excluded.
        progress: shows a bar (needs tqdm).

    Raises:
        ImportError: if pymoo is missing.
        ValueError: nothing to tune in ``space``, ``population`` below 2 or ``generations`` below 1.
    """
    losses = jax.tree_util.Partial(_as_vector, aspartial(loss, "loss"))
    options = {"population": population, "generations": generations, "time_limit": time_limit, "progress": progress}
    best, _, rows, compile_time = _evolve("genetic", losses, space, data, key, None, **options)
    return make_result(spaces.constrain(space, best[0]), best[1], rows, compile_time, "genetic")


def nsga2(
    losses: Callable[[PyTree, PyTree], Array],
    space: PyTree,
    data: PyTree = None,
    *,
    key: Array,
    population: int = 40,
    generations: int = 40,
    weights: Sequence[float] | None = None,
    time_limit: float | None = None,
    progress: bool = False,
) -> TuneResult:
    """Finds the trade-off between several losses with NSGA-II (Deb et al. 2002), through pymoo.

    Args:
        losses: ``(params, data) -> (k,)``; otherwise as the loss of :func:`genetic`.
        space: a pytree of specs.
        data: a pytree of arrays passed to the losses.
        key: random key.
        population: members, evaluated as one vmapped batch.
        generations: number of generations, the first population included.
        weights: (k,) default ones. They play no part in the search: ``params``, ``loss`` and the history of the result
            are those of the lowest weighted sum met, so that it compares with tuners of that one loss.
        time_limit: seconds after which no new generation is begun, compilation excluded.
        progress: shows a bar (needs tqdm).

    Returns:
        The result; ``front`` holds the last generation's non-dominated solutions, in the order of the first loss.

    Raises:
        ImportError: if pymoo is missing.
        ValueError: as in :func:`genetic`, or ``weights`` of another length.
    """
    losses = aspartial(losses, "losses")
    options = {"population": population, "generations": generations, "time_limit": time_limit, "progress": progress}
    best, front, rows, compile_time = _evolve("nsga2", losses, space, data, key, weights, **options)
    members = jax.vmap(spaces.constrain, (None, 0))(space, front[0])
    return make_result(spaces.constrain(space, best[0]), best[1], rows, compile_time, "nsga2", Front(front[1], members))


def _evolve(method, losses, space, data, key, weights, *, population, generations, time_limit, progress):
    """Returns ``(z, loss)`` of the best, ``(z (k, d), losses (k, objectives))`` of the front, rows and compile time."""
    check_key(key)
    check_count("population", population, 2)
    check_count("generations", generations, 1)
    check_time_limit(time_limit)
    check_flag("progress", progress)
    if spaces.size(space) == 0:
        raise ValueError("space: expected at least one spec, but every leaf is a plain value")
    pymoo = _pymoo()

    begun = time.perf_counter()
    low, high = spaces.bounds(space)
    sample_key, seed_key = jax.random.split(key)
    z0 = jnp.clip(spaces.to_vector(space), low, high)
    first = jnp.concatenate([z0[None, :], spaces.sample(space, sample_key, population - 1)])
    labels = structure.of(losses)
    evaluate = _evaluate.lower(losses, space, data, first, labels).compile()
    objectives = evaluate.out_info.shape[1]
    weights = np.ones(objectives) if weights is None else numbers("weights", weights).astype(np.float64)
    check_finite("weights", weights)
    if weights.shape != (objectives,):
        raise ValueError(f"weights: expected shape ({objectives},), got {weights.shape}")
    bars = rounds(generations, method, progress)
    compile_time = time.perf_counter() - begun

    seed = int(jax.random.randint(seed_key, (), 0, np.iinfo(np.int32).max))
    make = pymoo["nsga2"] if method == "nsga2" else pymoo["genetic"]
    algorithm = make(pop_size=population, sampling=np.asarray(first, np.float64))
    box = {"xl": np.asarray(low, np.float64), "xu": np.asarray(high, np.float64)}
    problem = pymoo["problem"](n_var=first.shape[1], n_obj=objectives, **box)
    # Without a termination of ours pymoo would stop by criteria of its own.
    algorithm.setup(problem, termination=("n_gen", generations + 1), seed=seed, verbose=False)

    best, rows, evaluations = (np.asarray(z0), np.inf), [], 0
    begun = time.perf_counter()
    for _ in bars:
        members = algorithm.ask()
        if members is None or len(members) == 0:  # nothing new can be bred any more
            break
        z = members.get("X")
        count = len(z)
        # Fewer members than usual are padded: another shape would be compiled anew.
        padded = np.concatenate([z, np.repeat(z[:1], population - count, axis=0)])
        values = np.asarray(evaluate(losses, space, data, jnp.asarray(padded, first.dtype)), np.float64)[:count]
        finite = np.all(np.isfinite(values), axis=1)
        members.set("F", np.where(finite[:, None], values, _PENALTY))
        algorithm.tell(infills=members)

        total = np.where(finite, np.where(finite[:, None], values, 0.0) @ weights, np.inf)
        winner = int(total.argmin())
        if total[winner] < best[1]:
            best = z[winner], float(total[winner])
        evaluations += count
        elapsed = time.perf_counter() - begun
        rows.append((evaluations, elapsed, best[1]))
        if time_limit is not None and elapsed >= time_limit:
            break
    z, values = np.atleast_2d(algorithm.opt.get("X")), np.atleast_2d(algorithm.opt.get("F"))
    order = np.lexsort(values.T[::-1])
    front = jnp.asarray(z[order], first.dtype), np.where(values[order] < _PENALTY, values[order], np.inf)
    return (jnp.asarray(best[0], first.dtype), best[1]), front, rows, compile_time


@partial(jax.jit, static_argnames="labels")
def _evaluate(losses, space, data, z, labels):
    """Losses (population, k) of z (population, d)."""
    losses = structure.noted(losses, labels)
    return jax.vmap(lambda member: losses(spaces.constrain(space, member), data))(z)


def _as_vector(loss, params, data):
    return loss(params, data)[None]


def _pymoo() -> dict[str, Any]:
    try:
        from pymoo.algorithms.moo.nsga2 import NSGA2
        from pymoo.algorithms.soo.nonconvex.ga import GA
        from pymoo.core.problem import Problem
    except ImportError as error:
        raise ImportError('evolution needs pymoo: pip install "jaxfilt[tune]"') from error
    return {"nsga2": NSGA2, "genetic": GA, "problem": Problem}
