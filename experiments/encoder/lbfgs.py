"""L-BFGS that stops where the gradient vanishes, for losses of a few parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

OPTIMIZER = optax.lbfgs()
STEPS, TOLERANCE = 60, 1e-6


class Minimum(NamedTuple):
    z: Array  # (d,)
    loss: Array  # ()
    slope: Array  # () norm of the gradient there
    evaluations: Array  # () of a value and a gradient


def minimize(value: Callable[[Array], Array], z0: Array) -> Minimum:
    """The minimum of a loss () of z (d,) that is scaled so that both are near 1."""

    def goes_on(carry):
        _, state, count, _ = carry
        return (count == 0) | ((count < STEPS) & (jnp.linalg.norm(optax.tree.get(state, "grad")) > TOLERANCE))

    def step(carry):
        z, state, count, evaluations = carry
        current, slope = optax.value_and_grad_from_state(value)(z, state=state)
        updates, state = OPTIMIZER.update(slope, state, z, value=current, grad=slope, value_fn=value)
        more = optax.tree.get(state, "num_linesearch_steps")
        return optax.apply_updates(z, updates), state, count + 1, evaluations + more.astype(jnp.int32)

    # optax mixes int32 counters with floats, which a caller's strict promotion would refuse
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        start = (z0, OPTIMIZER.init(z0), jnp.int32(0), jnp.int32(1))
        z, _, _, evaluations = jax.lax.while_loop(goes_on, step, start)
        final, slope = jax.value_and_grad(value)(z)
        return Minimum(jnp.asarray(z), final, jnp.linalg.norm(slope), evaluations)
