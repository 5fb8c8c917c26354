"""The channel: what arrives when, against the recursion over packets under way, and how often."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf


def recursion(zs, delays, d):
    """What is under way, step by step: Z_l is what will arrive in l samples as far as it has been decided."""
    T, m = zs.shape
    under_way = np.zeros((d + 2, m))
    ys = np.zeros_like(zs)
    for k in range(T):
        new = np.zeros_like(under_way)
        for lag in range(d + 1):
            hit = delays[k] == lag
            new[lag] = np.where(hit, zs[k], under_way[lag + 1])
        under_way = new
        ys[k] = under_way[0]
    return ys


def test_table_of_the_paper():
    """Packets 1, 2 and 7 on time, 3 one late, 4 two late, 5 and 6 not in the window (Nikfetrat et al., Table 1)."""
    zs = jnp.arange(1.0, 8.0)[:, None]
    received = jf.simulate.deliver(zs, jnp.array([0, 0, 1, 2, 3, 3, 0]), 2)
    assert received.ys[:, 0].tolist() == [1, 2, 0, 3, 0, 4, 7]
    assert received.mask[:, 0].tolist() == [True, True, False, True, False, True, True]
    assert received.lag[:, 0].tolist() == [0, 0, -1, 1, -1, 2, 0]


@pytest.mark.parametrize("channels", [False, True])
@pytest.mark.parametrize("d", [0, 1, 3])
def test_equals_the_recursion(d, channels):
    rng = np.random.default_rng(d)
    zs = rng.normal(size=(60, 2))
    delays = rng.integers(0, d + 2, (60, 2) if channels else 60)
    received = jf.simulate.deliver(zs, delays, d)
    wide = delays if channels else np.stack([delays, delays], axis=1)
    np.testing.assert_array_equal(received.ys, recursion(zs, wide, d))
    # All packets, at the step and the place where they belong.
    packets, arrived = received.packets.reshape(60, d + 1, 2), np.asarray(received.arrived).reshape(60, d + 1, 2)
    for k in range(60):
        for lag in range(d + 1):
            on = (wide[k - lag] == lag) if k >= lag else np.zeros(2, bool)
            np.testing.assert_array_equal(arrived[k, lag], on)
            np.testing.assert_array_equal(packets[k, lag], np.where(on, zs[k - lag], 0.0))
    assert (np.asarray(received.mask) == arrived.any(axis=1)).all()
    assert not np.asarray(received.ys)[~np.asarray(received.mask)].any()


def test_frequencies_of_delays_and_of_empty_samples():
    for alpha, empty in (((0.9, 0.5, 0.5), 0.0926), ((0.5, 0.9, 0.5), 0.2681)):
        p = jf.models.delay_probabilities(jnp.array(alpha))
        delays = jf.simulate.draw_delays(p, (200_000,), jax.random.key(1))
        found = np.bincount(np.asarray(delays), minlength=4) / 200_000
        np.testing.assert_array_less(np.abs(found - p), 4 * np.sqrt(np.asarray(p) / 200_000))
        none = 1 - np.asarray(jf.simulate.deliver(jnp.ones((200_000, 1)), delays, 2).mask).mean()
        assert none == pytest.approx(np.prod(1 - np.asarray(p)[:3]), abs=4 * np.sqrt(empty / 100_000))
        assert np.prod(1 - np.asarray(p)[:3]) == pytest.approx(empty, abs=5e-5)


def test_delays_are_prefix_stable_and_broadcast():
    key = jax.random.key(0)
    p = jnp.array([[0.5, 0.3, 0.2], [0.1, 0.2, 0.7]])
    long, short = (jf.simulate.draw_delays(p, (T, 2), key) for T in (500, 20))
    np.testing.assert_array_equal(long[:20], short)
    on_time = (np.asarray(long) == 0).mean(axis=0)
    np.testing.assert_allclose(on_time, [0.5, 0.1], atol=0.1)
    changing = jnp.concatenate([jnp.tile(jnp.array([[1.0, 0.0]]), (10, 1)), jnp.tile(jnp.array([[0.0, 1.0]]), (5, 1))])
    assert jf.simulate.draw_delays(changing, (15,), key).tolist() == [0] * 10 + [1] * 5
    with pytest.raises(ValueError, match="do not fit"):
        jf.simulate.draw_delays(p, (500, 3), key)


def test_wrong_types_are_refused():
    with pytest.raises(TypeError, match="delays: expected integers"):
        jf.simulate.deliver(jnp.zeros((3, 1)), jnp.zeros(3), 1)
    with pytest.raises(TypeError, match="lag: expected integers"):
        jf.lag_inputs(jnp.zeros((3, 1)), jnp.zeros(3), 1)
    with pytest.raises(ValueError, match=r"zs: expected shape \(T, m\)"):
        jf.simulate.deliver(jnp.zeros(3), jnp.zeros(3, jnp.int32), 1)
    with pytest.raises(ValueError, match="lag: expected shape"):
        jf.lag_inputs(jnp.zeros((3, 1)), jnp.zeros((3, 2), jnp.int32), 1)
