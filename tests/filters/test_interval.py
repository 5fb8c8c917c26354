"""The interval observer: bounds that hold, their closed-form width, and what it refuses."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf

A_LOW = np.array([[-0.1, -0.2], [-0.3, -0.1]])
A_HIGH = np.array([[0.1, -0.2], [-0.3, 0.1]])
C = np.array([[0.2, 0.2]])
L = np.array([[-1.0], [-1.5]])
BOUNDS = {"w_low": 0.35, "w_high": 0.5, "v_bound": 0.02, "x_low": 0.2, "x_high": 2.0}


def build(**changes):
    given = {"A_low": A_LOW, "A_high": A_HIGH, "C": C, "L": L, **BOUNDS, "nonnegative": True, **changes}
    return jf.interval_observer(**given)


# A plant that forgets slowly, so that samples are needed.
SLOW = {"A_low": np.array([[0.8, 0.2], [0.1, 0.8]]), "A_high": np.array([[0.81, 0.21], [0.11, 0.81]]),
        "C": np.array([[1.0, 1.0]]), "L": np.array([[0.2], [0.1]])}  # fmt: skip


@jax.jit
def many(keys, filt, mask, system):
    """Truth (runs, 100, 2) and the observer's output, for a positive plant drawn anew at every step."""
    return jax.vmap(lambda key: run(key, 100, filt, mask, system))(keys)


def run(key, steps, filt, mask, system):
    k = jax.random.split(key, 4)
    A_low, C = system["A_low"], system["C"]
    box = system["A_high"] - A_low
    A = jax.vmap(lambda share: A_low + share * box)(jax.random.uniform(k[0], (steps, 2, 2)))
    w = jax.random.uniform(k[1], (steps, 2), float, BOUNDS["w_low"], BOUNDS["w_high"])
    v = BOUNDS["v_bound"] * jax.random.uniform(k[2], (steps, 1), float, -1.0, 1.0)
    x0 = jax.random.uniform(k[3], (2,), float, BOUNDS["x_low"], 0.8)
    x = jax.lax.scan(lambda x, s: (s[0] @ x + s[1],) * 2, x0, (A, w))[1]
    return x, jf.filter(filt, x @ C.T + v, mask=mask)


def check_bounds(key, mask, system, runs=200):
    keys = jax.random.split(key, runs)
    x, out = many(keys, build(**system), mask, jax.tree.map(jnp.asarray, system))
    assert bool((x >= 0).all())  # what `nonnegative` was told
    assert bool((out.extra["lower"] <= x + 1e-12).all() & (x <= out.extra["upper"] + 1e-12).all())
    assert bool(((out.status & int(jf.Status.BOUND)) == 0).all())
    return out


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_bounds_hold_at_every_step(seed):
    out = check_bounds(jax.random.key(seed), np.ones(100, bool), {"A_low": A_LOW, "A_high": A_HIGH, "C": C, "L": L})
    np.testing.assert_allclose(out.mean, 0.5 * (out.extra["lower"] + out.extra["upper"]), rtol=1e-12)


def test_the_bounds_hold_through_gaps_and_are_wider_after_them():
    mask = np.ones(100, bool)
    mask[40:60] = False
    out = check_bounds(jax.random.key(4), mask, SLOW)
    width = np.asarray(out.extra["upper"] - out.extra["lower"]).mean(axis=0)
    assert (width[55] > 1.2 * width[30]).all()
    np.testing.assert_allclose(width[90], width[30], rtol=0.2)


def test_without_a_sample_each_bound_meets_the_other_where_a_is_negative():
    """One step by hand: upper = A_high+ upper - A_high- lower + w_high, the lower clipped at 0."""
    out = jf.filter(build(), jnp.zeros((1, 1)), mask=np.zeros((1, 1), bool))
    np.testing.assert_allclose(
        out.extra["upper"][0], [0.1 * 2 - 0.2 * 0.2 + 0.5, -0.3 * 0.2 + 0.1 * 2 + 0.5], rtol=1e-12
    )
    np.testing.assert_allclose(out.extra["lower"][0], [0.0, 0.0])


def test_with_a_sample_the_recursions_are_the_published_ones():
    ys = jnp.array([[0.3], [0.25]])
    out = jf.filter(build(), ys, first_update_only=True)
    L_y, spread = L[:, 0] * 0.3, np.abs(L[:, 0]) * 0.02
    upper = (A_HIGH - L @ C) @ np.full(2, 2.0) + L_y + spread + 0.5
    lower = np.maximum((A_LOW - L @ C) @ np.full(2, 0.2) + L_y - spread + 0.35, 0.0)
    np.testing.assert_allclose(out.extra["upper"][1], upper, rtol=1e-12)
    np.testing.assert_allclose(out.extra["lower"][1], lower, rtol=1e-12)


def test_a_sample_that_nothing_within_the_bounds_explains_is_flagged():
    ys = jnp.array([[0.2], [5.0], [0.2]])
    out = jf.filter(build(), ys)
    assert ((np.asarray(out.status) & int(jf.Status.BOUND)) != 0).tolist()[:2] == [False, True]
    assert out.cov is None
    assert out.log_lik is None


def test_an_unmasked_nan_counts_as_absent():
    ys = jnp.array([[0.2], [jnp.nan], [0.2], [0.2]])
    out = jax.jit(lambda ys: jf.filter(build(), ys))(ys)
    masked = jf.filter(build(), jnp.nan_to_num(ys), mask=~np.isnan(ys))
    np.testing.assert_array_equal(out.extra["upper"], masked.extra["upper"])
    assert int(out.status[1]) & int(jf.Status.NONFINITE)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"A_low": A_HIGH + 0.1}, r"A_low: is above A_high at \[0, 0\]"),
        ({"nonnegative": False}, "guarantee that by nonnegative"),
        ({"L": -L}, "A_low - L C >= 0"),
        ({"A_low": A_LOW + 2, "A_high": A_HIGH + 2}, "Schur"),
        ({"v_bound": -0.1}, "v_bound: expected bounds >= 0"),
        ({"w_low": 1.0}, "w_low: is above w_high"),
        ({"x_high": 0.1}, "x_low: is above x_high"),
        ({"x_low": -2.0, "x_high": -1.0}, "x_high: expected values >= 0"),
        ({"C": np.ones((1, 3))}, "C: expected shape"),
        ({"L": np.ones((2, 2))}, "L: expected shape"),
        ({"x_low": np.zeros(3)}, "x_low: expected shape"),
        ({"B": np.ones((3, 1))}, "B: expected shape"),
        ({"A_high": A_HIGH * np.nan}, "A_high: expected finite values"),
        ({"w_high": np.inf}, "w_high: expected finite values"),
    ],
)
def test_bad_parameters_are_refused(changes, match):
    with pytest.raises(ValueError, match=match):
        build(**changes)


@pytest.mark.parametrize("option", [{"dt": 1.0}, {"q_scale": 2.0}, {"r_scale": 2.0}, {"u": jnp.zeros((3, 1))}])
def test_what_it_cannot_honor_is_refused(option):
    with pytest.raises(ValueError, match=next(iter(option))):
        jf.filter(build(), jnp.zeros((3, 1)), **option)
