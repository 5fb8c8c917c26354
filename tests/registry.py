"""Every public filter and wrapper with one small example: the generic properties run over all of them."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from tests.examples import (
    Example,
    T,
    adaptive,
    attitude,
    bearing,
    delayed,
    hinf,
    imm,
    interval,
    joint,
    linear,
    noise,
    nonlinear,
    particle,
    rao_blackwellized,
    sincos,
    steady,
)

REGISTRY: dict[str, Example] = {
    **adaptive.EXAMPLES, **attitude.EXAMPLES, **bearing.EXAMPLES, **delayed.EXAMPLES, **hinf.EXAMPLES,
    **linear.EXAMPLES, **nonlinear.EXAMPLES, **imm.EXAMPLES, **interval.EXAMPLES, **joint.EXAMPLES, **noise.EXAMPLES,
    **particle.EXAMPLES, **rao_blackwellized.EXAMPLES, **sincos.EXAMPLES,
    **steady.EXAMPLES,
}  # fmt: skip


def series(example: Example, dtype, runs: int | None = None):
    """Measurements (T, m), or (runs, T, m), of moderate size."""
    shape = (T, example.m) if runs is None else (runs, T, example.m)
    return jax.random.normal(jax.random.key(7), shape, dtype) + jnp.linspace(0, 2, T, dtype=dtype)[:, None].reshape(
        (1,) * (len(shape) - 2) + (T, 1)
    )


def params(example: Example, dtype):
    """The example's parameters in the dtype under test."""
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), example.params)
