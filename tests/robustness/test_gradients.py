"""Gradients under transformations, over long series, where particles tie, and with JAX's own check for NaN.

That they equal differences, in forward and reverse mode, in float32, in gaps and at singular covariances is tested for
every filter in tests/test_properties.py and in R1, R6 to R8 and R18.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf

FORMS = {"kalman": jf.kalman, "sqrt_kalman": jf.sqrt_kalman, "extended": jf.extended}


def velocity(q, P0=25.0):
    return jf.models.constant_velocity(dt=1.0, q=q, r=4.0, m0=np.zeros(2), P0=P0 * np.eye(2))


def series(T, runs=None):
    shape = (T, 1) if runs is None else (runs, T, 1)
    return np.cumsum(np.random.default_rng(8).normal(size=shape), axis=-2)


@pytest.mark.parametrize("name", ["kalman", *(pytest.param(name, marks=pytest.mark.slow) for name in list(FORMS)[1:])])
def test_jit_vmap_and_grad_agree_in_any_order(name):
    """The batch takes another form (scalars) than one run (matrices): 1e-9 of the largest slope."""

    def loss(q, y):
        return jf.filter(FORMS[name](velocity(q)), y, outputs=jf.log_lik).sum()

    q, ys = jnp.linspace(0.2, 2.0, 10), jnp.asarray(series(20, 10))
    slopes = jax.jit(jax.vmap(jax.grad(loss)))(q, ys)
    of_sum = jax.jit(jax.grad(lambda q: jax.vmap(loss)(q, ys).sum()))(q)
    one = jax.jit(jax.grad(loss))
    alone = jnp.stack([one(q[i], ys[i]) for i in range(len(q))])
    for other in (of_sum, alone, jax.vmap(jax.grad(loss))(q, ys)):
        np.testing.assert_allclose(other, slopes, rtol=0, atol=1e-9 * float(jnp.abs(slopes).max()))


def test_the_gradient_of_ten_thousand_steps_takes_less_than_a_megabyte():
    """In segments of 100 steps, beside more than 3 MB without; and it is the same."""
    ys = jnp.asarray(series(10_000))

    def slope(segment):
        f = jax.grad(lambda q: jf.filter(jf.kalman(velocity(q)), ys, outputs=jf.log_lik, segment=segment).sum())
        program = jax.jit(f).lower(jnp.asarray(0.5)).compile()
        memory = program.memory_analysis()
        assert memory is not None
        return float(program(jnp.asarray(0.5))), memory.temp_size_in_bytes

    (short, small), (plain, large) = slope(100), slope(None)
    np.testing.assert_allclose(short, plain, rtol=1e-10)
    assert small < 1e6
    assert large > 3e6


def test_the_gradient_is_finite_where_particles_tie():
    """All particles in one place, with equal weights, and resampled in each step."""

    def value(q, P0):
        model = velocity(q, P0)
        out = jf.filter(jf.particle(model, 8, threshold=1.0), jnp.asarray(series(6)), key=jax.random.key(0))
        return out.log_lik.sum() + out.mean.sum()

    for at in ((0.0, 0.0), (0.0, 25.0), (0.5, 0.0)):
        assert np.isfinite(jax.jit(jax.grad(value, (0, 1)))(*map(jnp.asarray, at))).all(), at


@pytest.mark.parametrize(
    "name", ["sqrt_kalman", *(pytest.param(x, marks=pytest.mark.slow) for x in ("kalman", "extended"))]
)
def test_nothing_is_nan_at_singular_covariances_by_jax_debug_nans(name):
    """P0 = 0, Q = 0, a gap; values and gradients."""
    mask = np.array([True] * 4 + [False] * 3 + [True] * 3)

    def loss(q, P0):
        return jf.filter(FORMS[name](velocity(q, P0)), series(10), mask=mask, outputs=jf.log_lik).sum()

    with jax.debug_nans(True):
        for at in ((0.0, 0.0), (0.5, 0.0), (0.0, 25.0)):
            jax.block_until_ready(jax.jit(jax.value_and_grad(loss, (0, 1)))(*map(jnp.asarray, at)))
