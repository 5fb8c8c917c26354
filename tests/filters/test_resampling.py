"""Resampling: unbiased counts, awkward weights."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilt.filters.resampling import SCHEMES, ancestors, effective_sample_size, score_correction, soften, transport

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


def test_score_correction_is_zero_with_the_slope_of_what_was_drawn():
    log_weights, index = jnp.log(jnp.array([0.2, 0.3, 0.5])), jnp.array([2, 2, 0])
    value, slope = jax.jvp(lambda x: score_correction(x, index), (log_weights,), (jnp.array([1.0, 2.0, 3.0]),))
    assert value.tolist() == [0.0, 0.0, 0.0]
    assert slope.tolist() == [3.0, 3.0, 1.0]


def test_soft_weights():
    weights = jnp.array([0.0, 0.25, 0.75])
    np.testing.assert_allclose(jnp.exp(soften(jnp.log(weights), 0.4)), 0.4 * weights + 0.2, rtol=1e-12)


def test_transport_keeps_the_mean_and_in_one_dimension_the_order():
    """A small epsilon gives the quantiles of the weighted cloud; units do not matter; what cannot move stays."""
    x = jnp.sort(jax.random.normal(jax.random.key(0), (40, 1)), axis=0) * jnp.array([[1e4, 0.0]])
    log_weights = jax.nn.log_softmax(-0.5 * (x[:, 0] / 1e4 - 1) ** 2 / 0.3)
    moved = transport(x, log_weights, 0.02, 1000)
    np.testing.assert_allclose(moved.mean(axis=0), jnp.exp(log_weights) @ x, rtol=1e-9)
    assert (jnp.diff(moved[:, 0]) > 0).all()
    assert (moved[:, 1] == 0).all()
    # Without regularization place j is the mean of the quantiles between j / N and (j + 1) / N.
    cumulated = np.cumsum(np.exp(log_weights))
    quantiles = np.asarray(x)[np.searchsorted(cumulated / cumulated[-1], (np.arange(40_000) + 0.5) / 40_000), 0]
    error = np.sqrt(np.mean((moved[:, 0] - quantiles.reshape(40, 1000).mean(axis=1)) ** 2))
    assert error < np.sqrt(0.02) * x[:, 0].std()  # the plan is blurred by sqrt(epsilon n / 2) standard deviations
    one = jnp.full((40,), -1e300).at[3].set(0.0)
    np.testing.assert_allclose(transport(x, one, 0.02, 1000), jnp.broadcast_to(x[3], x.shape), rtol=1e-6)


def test_unknown_scheme_is_refused():
    with pytest.raises(ValueError, match="scheme: expected one of systematic"):
        ancestors(jnp.zeros((1,)), jax.random.key(0), "none")
