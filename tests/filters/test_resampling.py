"""Resampling: unbiased counts, awkward weights."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilt.filters.resampling import SCHEMES, ancestors, effective_sample_size

schemes = pytest.mark.parametrize("scheme", SCHEMES)


def counts(log_weights, scheme, draws=4000):
    """(draws, N) how often each particle was drawn."""
    N = log_weights.shape[0]
    found = jax.jit(jax.vmap(lambda key: ancestors(log_weights, key, scheme)))(
        jax.random.split(jax.random.key(0), draws)
    )
    assert found.dtype == jnp.int32
    assert (np.diff(found, axis=1) >= 0).all()
    return (np.asarray(found)[:, :, None] == np.arange(N)).sum(axis=1)


@schemes
def test_counts_are_unbiased_and_as_even_as_promised(scheme):
    weights = np.random.default_rng(1).dirichlet(np.ones(8))
    found = counts(jnp.log(weights), scheme)
    expected = 8 * weights
    assert (found.sum(axis=1) == 8).all()
    error = found.mean(axis=0) - expected
    assert (np.abs(error) <= 4 * found.std(axis=0) / np.sqrt(len(found)) + 1e-12).all()
    assert (found >= np.floor(expected) - (scheme == "multinomial") * 8 - (scheme == "stratified")).all()
    if scheme == "systematic":
        assert (np.abs(found - expected) < 1).all()
    if scheme == "multinomial":
        np.testing.assert_allclose(found.var(axis=0), expected * (1 - weights), rtol=0.15)


@schemes
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
def test_awkward_weights(scheme, dtype):
    """Equal weights keep every particle but for multinomial; one that has all is taken; what has none is never."""
    equal = jnp.full((1000,), -np.log(1000), dtype)
    for seed in range(5):
        found = np.asarray(ancestors(equal, jax.random.key(seed), scheme))
        assert found.min() >= 0
        assert found.max() <= 999
        if scheme in ("systematic", "residual"):
            assert (np.diff(found) <= 2).all()
    one = jnp.full((7,), -np.inf, dtype).at[3].set(0.0)
    assert (ancestors(one, jax.random.key(0), scheme) == 3).all()
    none = jnp.log(jnp.array([0.0, 0.5, 0.0, 0.5, 0.0], dtype))
    assert set(np.unique(jax.vmap(lambda k: ancestors(none, k, scheme))(jax.random.split(jax.random.key(1), 200)))) == {
        1,
        3,
    }
    assert ancestors(jnp.zeros((1,), dtype), jax.random.key(0), scheme).tolist() == [0]


def test_effective_sample_size():
    assert float(effective_sample_size(jnp.full((10,), -np.log(10)))) == pytest.approx(10.0)
    assert float(effective_sample_size(jnp.array([0.0, -jnp.inf]))) == pytest.approx(1.0)


def test_unknown_scheme_is_refused():
    with pytest.raises(ValueError, match="scheme: expected one of systematic"):
        ancestors(jnp.zeros((1,)), jax.random.key(0), "none")
