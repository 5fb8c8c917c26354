"""The paper's example, and what happens to it when A is drawn from its box."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

# A = [[t1, -0.2], [-0.3, t2]], |t_i| <= 0.1
A_LOW = np.array([[-0.1, -0.2], [-0.3, -0.1]])
A_HIGH = np.array([[0.1, -0.2], [-0.3, 0.1]])
B = np.array([[0.2, 0.2], [0.3, 0.2]])
C = np.array([[0.2, 0.2]])
X0 = np.array([1.0, 2.0])

PRINTED_WEIGHTS = np.array([5.6917, 5.1709])
PRINTED_Z = np.array([0.0576, 28.6495])
PRINTED = (PRINTED_Z / (C[0] @ PRINTED_WEIGHTS))[:, None]  # (2, 1): K = [0.0265, 13.1872]


class Drawn(NamedTuple):
    """Courses, (runs, ...) in front."""

    x: Array  # (steps + 1, 2)
    u: Array  # (steps, 2)


@partial(jax.jit, static_argnames=("varying", "steps"))
def rollout(keys: Array, K: Array, x0: Array, *, varying: bool, steps: int = 60) -> Drawn:
    """The closed loop for A uniform in its box, one draw per run or one per step."""

    def one(key):
        share = jax.random.uniform(key, (steps if varying else 1, 2, 2))
        A = jnp.broadcast_to(jax.vmap(lambda part: A_LOW + part * (A_HIGH - A_LOW))(share), (steps, 2, 2))
        return follow(A, K, x0)

    return jax.vmap(one)(keys)


@partial(jax.jit, static_argnames="steps")
def worst(K: Array, x0: Array, *, steps: int = 60) -> Drawn:
    """The course with A_high, which no other in the box exceeds."""
    return follow(jnp.broadcast_to(jnp.asarray(A_HIGH), (steps, 2, 2)), K, x0)


def follow(A: Array, K: Array, x0: Array) -> Drawn:
    """x_{k+1} = A_k x_k + B K C x_k."""

    def advance(x, A):
        u = K @ (C @ x)
        x = A @ x + B @ u
        return x, (x, u)

    x, u = jax.lax.scan(advance, x0, A)[1]
    return Drawn(jnp.concatenate([x0[None], x]), u)


class Checks(NamedTuple):
    """Over all draws."""

    least_x: float
    least_u: float
    last: float  # the largest component at the end
    above_worst: float  # by how much a course exceeds that of A_high
    above_bound: float  # ... or c gamma^k lambda


def robustness(keys: Array, K: np.ndarray, *, varying: bool) -> Checks:
    """Positivity, dominance by A_high and contraction."""
    drawn = rollout(keys, jnp.asarray(K), jnp.asarray(X0), varying=varying)
    x = np.asarray(drawn.x)
    top = np.asarray(worst(jnp.asarray(K), jnp.asarray(X0)).x)
    gamma, weights = contraction(A_HIGH + B @ K @ C)
    bound = (X0 / weights).max() * gamma ** np.arange(len(top))[:, None] * weights
    return Checks(
        float(x.min()), float(drawn.u.min()), float(x[:, -1].max()), float((x - top).max()), float((x - bound).max())
    )


def contraction(A: np.ndarray) -> tuple[float, np.ndarray]:
    """The Perron root of a nonnegative Schur matrix, and a positive vector with A lambda <= gamma lambda.

    Any lambda > 0 with A lambda < lambda would do; the sum of all powers makes one.
    """
    weights = np.linalg.solve(np.eye(len(A)) - A, np.ones(len(A)))
    return float((A @ weights / weights).max()), weights


def worst_cost(K: np.ndarray, x0: np.ndarray = X0) -> float:
    """sum_k 1'x_k under A_high: no draw costs more.

    Raises:
        ValueError: a negative start, for which none of this holds.
    """
    if not (np.asarray(x0) >= 0).all():
        raise ValueError(f"x0: expected values >= 0, got {x0}")
    return float(np.linalg.solve(np.eye(2) - (A_HIGH + B @ K @ C), x0).sum())
