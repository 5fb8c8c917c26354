"""Where a track can start: maximum likelihood over a batch, by Gauss-Newton and by gradient; and a GA on one sample."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

import jaxfilt as jf
from experiments.bearing_frequency.scenarios import NOISE, Geometry, model

RANGES = (2e3, 4e3, 6e3, 8e3, 11e3, 15e3, 20e3)  # m, of the starts along the first bearings
LENGTHS = (300, 600, 1000)  # s of data
SCALE = (1e3, 1e3, 1.0, 1.0, 1.0)
# the paper's GA
POPULATION, GENERATIONS, CROSSOVER, MUTATION = 50, 200, 0.8, 0.05
BOXES = {"[0, 12 km]²": (0.0, 12e3), "[-20, 20 km]²": (-20e3, 20e3), "truth ± 1 km": (5e3, 7e3)}


def starts(ys: Array, observer: Array) -> Array:
    """(7, 5) starts on the mean of the first 20 bearings, at rest, with the mean of the first 20 frequencies."""
    bearing = jnp.arctan2(jnp.sin(ys[:20, 0]).mean(), jnp.cos(ys[:20, 0]).mean())
    along = jnp.stack([jnp.sin(bearing), jnp.cos(bearing)])
    place = observer[0, :2][None] + jnp.asarray(RANGES)[:, None] * along[None]
    rest = jnp.array([0.0, 0.0, 0.0]).at[2].set(ys[:20, 1].mean())
    return jnp.concatenate([place, jnp.broadcast_to(rest, (len(RANGES), 3))], axis=1)


@partial(jax.jit, static_argnames="iterations")
def maximum_likelihood(observer: Array, ys: Array, iterations: int = 60) -> jf.initial.Start:
    """Batch ML of the state at 0 s from measurements (S, N, K + 1, 2); observer (S, K + 1, 4)."""
    still = model(jnp.zeros(5), jnp.eye(5))

    def one(own, y):
        return jf.initial.batch_ml(still, y, starts(y, own), scale=SCALE, iterations=iterations, u=own,
                                   first_update_only=True)  # fmt: skip

    return jax.vmap(jax.vmap(one, (None, 0)))(observer, ys)


class Descent(NamedTuple):
    """Adam on the same cost."""

    mean: Array  # (..., 5) the best of the starts at the end
    cost: Array  # (...)


@partial(jax.jit, static_argnames="steps")
def adam(observer: Array, ys: Array, steps: int) -> Descent:
    """The same problem by Adam on scaled unknowns, rate 0.1 with cosine decay, from the same starts."""
    still = model(jnp.zeros(5), jnp.eye(5))
    scale = jnp.asarray(SCALE)
    rule = optax.adam(optax.cosine_decay_schedule(0.1, steps))

    def one(own, y):
        inputs = jf.inputs(y, u=own)

        def loss(z):
            return jf.initial.cost(still, z * scale, inputs, first_update_only=True) / y.size

        def step(carry, _):
            z, state = carry
            with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
                updates, state = rule.update(jax.grad(loss)(z), state)
                return (z + jnp.asarray(updates), state), None

        def descend(z):
            (z, _), _ = jax.lax.scan(step, (z, rule.init(z)), length=steps)
            return z, loss(z)

        z, costs = jax.vmap(descend)(starts(y, own) / scale[None])
        best = jnp.argmin(costs)
        return Descent(z[best] * scale, costs[best] * y.size)

    return jax.vmap(jax.vmap(one, (None, 0)))(observer, ys)


def genetic_start(
    first: Array, observer: Array, key: Array, *, box: tuple[float, float],
    population: int = POPULATION, generations: int = GENERATIONS,
) -> Array:  # fmt: skip
    """The paper's start: the position (2,) in a box whose first residual a real-coded GA makes smallest.

    Velocity is 0 and the tone is what is heard first. The residual is the same all along the bearing, so what comes
    out is a place on that ray somewhere in the box: ``box`` (low, high) [m, each axis] has no default because it is
    the answer. (Written here in JAX, and not with pymoo, because hundreds of small searches run side by side.)

    Raises:
        ValueError: a box that is not low < high.
    """
    if not box[0] < box[1]:
        raise ValueError(f"box: expected (low, high) with low < high, got {box}")
    h = model(jnp.zeros(5), jnp.eye(5)).h
    low, high = box
    tone = jnp.array([0.0, 0.0, 0.0]).at[2].set(first[1])

    def cost(place):
        e = first - h(jnp.concatenate([place, tone]), observer, None)
        e = e.at[0].set(jf.models.sensors.wrap(e[0])) / jnp.asarray(NOISE)
        return jnp.sum(e * e)

    def generation(carry, key):
        members, costs = carry
        rivals, blend, crossed, mutated, fresh = jax.random.split(key, 5)
        # tournaments of two choose the parents; a child lies between them, and now and then a coordinate is new
        pairs = jax.random.randint(rivals, (2, 2, population), 0, population)
        winners = jnp.where(costs[pairs[0]] < costs[pairs[1]], pairs[0], pairs[1])
        a, b = members[winners[0]], members[winners[1]]
        weight = jax.random.uniform(blend, (population, 2), minval=-0.25, maxval=1.25)
        cross = jax.random.bernoulli(crossed, CROSSOVER, (population, 1))
        children = jnp.where(cross, a + weight * (b - a), a)
        new = jax.random.uniform(fresh, (population, 2), minval=low, maxval=high)
        children = jnp.where(jax.random.bernoulli(mutated, MUTATION, (population, 2)), new, children)
        children = jnp.clip(children, low, high).at[0].set(members[jnp.argmin(costs)])  # the best survives
        return (children, jax.vmap(cost)(children)), None

    begin, rest = jax.random.split(key)
    members = jax.random.uniform(begin, (population, 2), minval=low, maxval=high)
    carry = members, jax.vmap(cost)(members)
    (members, costs), _ = jax.lax.scan(generation, carry, jax.random.split(rest, generations))
    return members[jnp.argmin(costs)]


@partial(jax.jit, static_argnames="box")
def genetic_starts(paths: Geometry, first: Array, key: Array, box: tuple[float, float]) -> Array:
    """(S, N) position errors [m] of the GA's start from first measurements (S, N, 2)."""
    S, N = first.shape[:2]
    keys = jax.random.split(key, (S, N))

    def one(own, target, y, k):
        return jnp.linalg.norm(genetic_start(y, own, k, box=box) - target)

    many = jax.vmap(jax.vmap(one, (None, None, 0, 0)))
    return many(paths.observer[:, 0], paths.target[:, 0, :2], first, keys)


def start_bounds(paths: Geometry, length: int) -> tuple[np.ndarray, np.ndarray]:
    """(S,) the bound of the start's position [m], without prior, from 0 to ``length`` s; and the condition number."""

    def one(target, observer):
        start, _ = jf.metrics.start_bound(
            model(target[0], jnp.eye(5)), target[0], length + 1, u=observer[: length + 1], first_update_only=True
        )
        return jnp.sqrt(start.cov[-1, 0, 0] + start.cov[-1, 1, 1]), start.condition[-1]

    found = jax.jit(jax.vmap(one))(paths.target, paths.observer)
    return np.asarray(found[0]), np.asarray(found[1])


def costs_agree(found: jf.initial.Start) -> np.ndarray:
    """(..., 7) whether a start came to the same minimum as the best one."""
    costs = np.asarray(found.costs)
    return costs < costs.min(axis=-1, keepdims=True) + 1e-3


def per_degree(found: jf.initial.Start) -> np.ndarray:
    """Cost per measured number."""
    return np.asarray(found.cost) / np.asarray(found.count)


class MLStudy(NamedTuple):
    """Batch ML of the start from one length of data."""

    length: int
    errors: np.ndarray  # (3, N) m
    per_number: np.ndarray  # (3, N) cost per measured number
    agree: np.ndarray  # (3, N, 7) starts that came to the best minimum
    condition: np.ndarray  # (3, N)
    bound: np.ndarray  # (3,) m
    true_condition: np.ndarray  # (3,)


def ml_study(paths: Geometry, runs: Any, length: int) -> MLStudy:
    """Batch ML on the first ``length`` s of the runs."""
    ys = jnp.concatenate([runs.first[:, :, None], runs.ys[:, :, :length]], axis=2)
    found = maximum_likelihood(paths.observer[:, : length + 1], ys)
    errors = np.linalg.norm(np.asarray(found.mean[..., :2] - paths.target[:, None, 0, :2]), axis=-1)
    bound, number = start_bounds(paths, length)
    return MLStudy(length, errors, per_degree(found), costs_agree(found), np.asarray(found.condition),
                   bound, number)  # fmt: skip


ADAM_RUNS, ADAM_STEPS = 5, 400


def adam_study(paths: Geometry, runs: Any, length: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors [m] and costs per number (3, ADAM_RUNS) of gradient descent on the same problem."""
    ys = jnp.concatenate([runs.first[:, :, None], runs.ys[:, :, :length]], axis=2)[:, :ADAM_RUNS]
    found = adam(paths.observer[:, : length + 1], ys, steps)
    errors = np.linalg.norm(np.asarray(found.mean[..., :2] - paths.target[:, None, 0, :2]), axis=-1)
    return errors, np.asarray(found.cost) / (2 * (length + 1))


def ga_study(paths: Geometry, runs: Any, key: Array, boxes: Any = None) -> dict[str, np.ndarray]:
    """Position errors [m] (3, 30) of the paper's GA on the first residual, by search box."""
    first = runs.first[:, :30]
    boxes = BOXES if boxes is None else boxes
    return {name: np.asarray(genetic_starts(paths, first, key, box)) for name, box in boxes.items()}
