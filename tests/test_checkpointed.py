"""The checkpointed scan against the plain one."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt import checkpointed, core
from tests import reference


def _recursion(a, carry, x):
    """A nonlinear map, an integer counter, a dict of outputs."""
    mean, count = carry
    mean = jnp.tanh(a @ mean + x["y"])
    return (mean, count + x["k"]), {"mean": mean, "square": jnp.sum(mean * mean)}


def _inputs(T):
    return {"y": jax.random.normal(jax.random.key(0), (T, 3)), "k": jnp.ones((T,), jnp.int32)}


A = jax.random.normal(jax.random.key(1), (3, 3))
START = (jnp.ones(3), jnp.int32(0))


@pytest.mark.parametrize(("T", "segment"), [(1, None), (12, 4), (13, 4), (13, 1), (13, 13), (13, 99), (50, None)])
def test_is_the_plain_scan(T, segment):
    xs = _inputs(T)
    carry, out = checkpointed.scan(partial(_recursion, A), START, xs, segment)
    expected_carry, expected = jax.lax.scan(partial(_recursion, A), START, xs)
    assert jax.tree.structure(out) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves((carry, out)), jax.tree.leaves((expected_carry, expected)), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=1e-13)


@pytest.mark.parametrize("segment", [0, -1, 2.0, True])
def test_a_bad_segment_is_refused(segment):
    with pytest.raises(ValueError, match="segment: expected an int >= 1"):
        checkpointed.scan(partial(_recursion, A), START, _inputs(5), segment)


def _log_lik(log_q, ys, scan):
    F, H, Q, R, m0, P0 = reference.random_model(np.random.default_rng(0), 3, 2)
    filt = jf.kalman(jf.models.linear_gaussian(F, H, jnp.exp(log_q) * Q, R, m0, P0))
    inputs = jf.inputs(ys)
    state = filt.init(jax.tree.map(lambda leaf: leaf[0], inputs))
    body = partial(core._step_of, filt, outputs=_only_log_lik)
    return jnp.sum(scan(body, state, (inputs, None))[1])


def _only_log_lik(state, info):
    del state
    return info.log_lik


def test_the_gradient_is_the_same_and_its_memory_does_not_grow_with_the_steps():
    """Four times the steps: four times the memory of the plain scan, about twice that of the checkpointed one."""
    memory = {}
    for T in (500, 2000):
        ys = jax.random.normal(jax.random.key(2), (T, 2))
        slopes = {}
        for name, scan in (("plain", jax.lax.scan), ("checkpointed", checkpointed.scan)):
            gradient = jax.jit(jax.grad(partial(_log_lik, scan=scan))).lower(jnp.asarray(0.3), ys).compile()
            slopes[name] = gradient(jnp.asarray(0.3), ys)
            memory[name, T] = gradient.memory_analysis().temp_size_in_bytes  # pyright: ignore[reportOptionalMemberAccess]
        np.testing.assert_allclose(slopes["checkpointed"], slopes["plain"], rtol=1e-12)
    assert memory["plain", 2000] > 3 * memory["plain", 500]
    assert memory["checkpointed", 2000] < 3 * memory["checkpointed", 500]
    assert memory["checkpointed", 2000] < 0.2 * memory["plain", 2000]


def test_higher_derivatives_and_batches():
    xs = _inputs(30)

    def f(a, scan):
        return scan(partial(_recursion, a), START, xs)[1]["square"].sum()

    for transform in (jax.grad, lambda g: jax.jacfwd(jax.grad(g))):
        found, expected = (transform(partial(f, scan=scan))(A) for scan in (checkpointed.scan, jax.lax.scan))
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)
    several = jnp.stack([A, 0.5 * A])
    found, expected = (jax.vmap(partial(f, scan=scan))(several) for scan in (checkpointed.scan, jax.lax.scan))
    np.testing.assert_allclose(found, expected, rtol=1e-13)


@pytest.mark.parametrize("form", ["dense", "scalar"])
def test_segments_of_a_filter(form):
    """The same outputs, sums and gradients; a bad segment is refused."""
    F, H, Q, R, m0, P0 = reference.random_model(np.random.default_rng(0), 3, 2)
    ys = jax.random.normal(jax.random.key(2), (13, 2))

    def loss(log_q, segment, keep):
        filt = jf.kalman(jf.models.linear_gaussian(F, H, jnp.exp(log_q) * Q, R, m0, P0))
        return jnp.sum(jf.filter(filt, ys, outputs=jf.log_lik, keep=keep, segment=segment, form=form))

    want = jax.value_and_grad(loss)(0.3, None, "stack")
    for keep in ("stack", "sum"):
        np.testing.assert_allclose(jax.value_and_grad(loss)(0.3, 4, keep), want, rtol=1e-12)
    with pytest.raises(ValueError, match="segment: expected an int >= 1, got 0"):
        loss(0.3, 0, "stack")
