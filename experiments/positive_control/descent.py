"""The same design without a linear program: gradients with a barrier, and a genetic algorithm with a penalty.

The objective is the worst-case cost sum_k 1'x_k under A_high, in closed form. Positivity is a set of inequalities, and
the best gain lies on its edge, which a barrier only approaches as its weight goes to 0.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from experiments.positive_control.system import A_HIGH, A_LOW, PRINTED, X0, B, C
from jaxfilt import tune

BARRIERS = (1.0, 1e-1, 1e-2, 1e-3)
STEPS = 300  # for each barrier
PENALTY = 1e3


class Found(NamedTuple):
    """A gain, and the price of finding it."""

    K: np.ndarray  # (2, 1)
    evaluations: int
    seconds: float  # compilation excluded


def space(K: Any = PRINTED) -> dict[str, Any]:
    """Both components up to 20, from a gain."""
    return {"K": tune.real(np.ravel(K), 0.0, 20.0)}


def cost(K: Array) -> tuple[Array, Array]:
    """The worst-case cost, and the smallest component of what it sums, negative where A_high is not Schur."""
    total = jnp.linalg.solve(jnp.eye(2) - A_HIGH - B @ K[:, None] @ C, jnp.asarray(X0))
    return total.sum(), total.min()


def barred(params: dict[str, Array], barrier: Array) -> Array:
    """The cost with log-barriers on A_low + B K C and on K; NaN outside, from where the tuner steps back."""
    value, least = cost(params["K"])
    entries = jnp.concatenate([(A_LOW + B @ params["K"][:, None] @ C).ravel(), params["K"]])
    inside = (entries > 0).all() & (least > 0)
    safe = jnp.where(inside, entries, 1.0)
    return jnp.where(inside, value - barrier * jnp.log(safe).sum(), jnp.nan)


def penalised(params: dict[str, Array], weight: Array) -> Array:
    """The cost with what is violated added."""
    value, least = cost(params["K"])
    entries = A_LOW + B @ params["K"][:, None] @ C
    return jnp.where(least > 0, value, jnp.inf) + weight * jnp.maximum(-entries, 0.0).sum()


def by_gradient() -> Found:
    """From the printed gain, with a barrier that falls."""
    K, evaluations, seconds = PRINTED, 0, 0.0
    optimizer = optax.adam(optax.cosine_decay_schedule(0.1, STEPS))
    for barrier in BARRIERS:
        result = tune.gradient(
            barred, space(K), jnp.asarray(barrier), key=jax.random.key(0), optimizer=optimizer, steps=STEPS, block=STEPS
        )
        K, evaluations, seconds = result.params["K"], evaluations + result.evaluations, seconds + result.wall_time
    return Found(np.asarray(K)[:, None], evaluations, seconds)


def by_genetic(key: Array) -> Found:
    """With as many evaluations."""
    result = tune.genetic(
        penalised, space(), jnp.asarray(PENALTY), key=key, population=30, generations=len(BARRIERS) * STEPS // 30
    )
    return Found(np.asarray(result.params["K"])[:, None], result.evaluations, result.wall_time)
