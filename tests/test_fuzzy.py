"""The fuzzy toolbox: the published rule tables and values, identities of the inference, what it survives."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt import fuzzy

UNIVERSE = np.array([40.0, 25.0, 23.0])
# Tables 2 to 5 of the balloon paper as printed: by z's set; rows x, columns y, each from low to very high.
PRINTED = [
    ["0000", "0000", "0000", "0000"],
    ["0000", "0111", "0111", "0111"],
    ["0000", "0111", "0122", "0122"],
    ["0000", "0111", "0122", "0123"],
]
INPUTS = [
    (0, 0, 0), (40, 25, 0), (10, 6, 6), (8, 25, 23), (15, 9, 9), (20, 12.5, 11.5), (20, 25, 23), (30, 20, 18),
    (40, 25, 23), (4e4, 25, 1e300),
]  # fmt: skip
STRENGTHS = [
    (1, 0, 0, 0), (1, 0, 0, 0), (0.32, 0.68, 0, 0), (0.6, 0.4, 0, 0), (0, 1, 0, 0), (0, 0.5, 0.5, 0), (0, 0.5, 0.5, 0),
    (0, 0, 12 / 23, 0.25), (0, 0, 0, 1), (0, 0, 0, 1),
]  # fmt: skip
ALPHA = [100 / 9, 100 / 9, 31.73, 27.48, 100 / 3, 50, 50, 67.86, 800 / 9, 800 / 9]
ALPHA_INNER = [20, 20, 32.96, 28.39, 40, 50, 50, 66.73, 80, 80]

infer = jax.jit(jax.vmap(fuzzy.infer, (None, 0)))
trapezoid = jax.jit(fuzzy.trapezoid)


def printed_rules():
    """(4, 4, 4) with axes x, y, z."""
    cells = [[[int(level) for level in row] for row in table] for table in PRINTED]
    return np.array(cells).transpose(1, 2, 0)


# Mamdani


def test_printed_rule_tables_are_the_minimum_in_all_64_cells():
    assert (fuzzy.minimum_rules(4, 3) == printed_rules()).all()
    assert np.bincount(printed_rules().ravel()).tolist() == [37, 19, 7, 1]


def test_values_of_the_printed_system():
    x = jnp.asarray(np.array(INPUTS, float))
    found = infer(fuzzy.mamdani(UNIVERSE, rules=printed_rules()), x)
    np.testing.assert_allclose(found.value, ALPHA, rtol=0, atol=0.006)  # as printed, to two digits
    np.testing.assert_allclose(found.strength, STRENGTHS, rtol=0, atol=1e-14)
    assert found.fired.all()
    assert found.lowest.tolist() == [True] + [False] * 9
    inner = infer(fuzzy.mamdani(UNIVERSE, outputs=fuzzy.triangles(inner=True)), x)
    np.testing.assert_allclose(inner.value, ALPHA_INNER, rtol=0, atol=0.006)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
def test_output_is_in_its_range_for_any_finite_input_and_signs_do_not_matter(dtype):
    rng = np.random.default_rng(0)
    largest = float(jnp.finfo(dtype).max)
    x = np.concatenate([
        rng.uniform(-60, 60, size=(2000, 3)),
        rng.choice([-largest, -1.0, -0.0, 0.0, float(jnp.finfo(dtype).tiny), largest], size=(200, 3)),
    ])  # fmt: skip
    system = fuzzy.mamdani(UNIVERSE)
    found = infer(system, jnp.asarray(x, dtype))
    assert found.fired.all()
    assert found.value.dtype == dtype
    value = np.asarray(found.value, float)
    assert value.min() >= 100 / 9 - 1e-4
    assert value.max() <= 800 / 9 + 1e-4
    assert np.ptp(value) > 70
    assert (found.value == infer(system, jnp.asarray(np.abs(x), dtype)).value).all()


def test_output_does_not_fall_along_the_diagonal():
    t = np.linspace(0, 1, 141)[:, None]
    value = np.asarray(infer(fuzzy.mamdani(UNIVERSE), jnp.asarray(t * UNIVERSE)).value)
    assert np.diff(value).min() > -1e-9


def test_nan_fires_nothing_and_a_gap_of_traced_corners_neither():
    x = jnp.array([[1.0, np.nan, 2.0], [1.0, 1.0, 1.0]])
    found = infer(fuzzy.mamdani(UNIVERSE), x)
    assert found.fired.tolist() == [False, True]
    assert found.value[0] == 0
    assert np.isfinite(found.value).all()

    def output(corners, x):
        found = fuzzy.infer(fuzzy.mamdani(10.0, corners=corners, outputs=fuzzy.triangles(2)), x)
        return found.value, found.fired

    gap = jnp.array([[0.0, 0.0, 1.0, 2.0], [5.0, 6.0, 10.0, 10.0]])  # not looked at when traced
    slopes = jax.jit(jax.grad(output, has_aux=True))
    slope, fired = slopes(gap, jnp.array([3.0]))
    assert not fired
    assert (slope == 0).all()
    assert slopes(gap, jnp.array([1.5]))[1]


def test_gradient_of_the_inference_by_its_corners():
    """Away from kinks, to what 1001 points allow."""

    def output(logits):
        corners = fuzzy.partition(UNIVERSE, 4, logits)
        return fuzzy.infer(fuzzy.mamdani(UNIVERSE, corners=corners), jnp.array([9.0, 5.0, 5.5])).value

    at, h = jnp.asarray(np.linspace(-0.2, 0.3, 7)), 0.02
    value = jax.jit(output)
    numeric = np.array([(value(at + e) - value(at - e)) / (2 * h) for e in h * np.eye(7)])
    slope = jax.jit(jax.grad(output))(at)
    assert np.abs(numeric).max() > 1
    np.testing.assert_allclose(slope, numeric, rtol=0, atol=0.02 * np.abs(numeric).max())


# Memberships


def test_equal_logits_give_the_printed_partition_and_any_logits_sum_to_one():
    s = 1 / 7
    expected = np.array(
        [[0, 0, s, 2 * s], [s, 2 * s, 3 * s, 4 * s], [3 * s, 4 * s, 5 * s, 6 * s], [5 * s, 6 * s, 1, 1]]
    )
    np.testing.assert_allclose(fuzzy.partition(40.0), 40 * expected, rtol=1e-14)
    np.testing.assert_allclose(
        fuzzy.partition(UNIVERSE, 4, np.zeros(7)), UNIVERSE[:, None, None] * expected, rtol=1e-14
    )
    rng = np.random.default_rng(1)
    for sets in (2, 3, 6):
        corners = fuzzy.partition(UNIVERSE, sets, rng.normal(size=(3, 2 * sets - 1)))
        assert corners.shape == (3, sets, 4)
        assert (np.diff(corners, axis=-1) >= 0).all()
        x = jnp.asarray(np.linspace(0, 1, 101) * UNIVERSE[:, None])
        mu = trapezoid(x[:, :, None], corners[:, None])
        np.testing.assert_allclose(mu.sum(axis=-1), 1, rtol=1e-12)
        assert (mu >= 0).all()


def test_stick_breaking_sums_to_one_for_any_widths():
    rng = np.random.default_rng(2)
    centers = fuzzy.ordered(jnp.asarray(rng.normal(size=(50, 1, 3))))
    widths = jnp.asarray(rng.exponential(size=(50, 1, 3)))
    mu = fuzzy.stick_breaking(jnp.asarray(rng.uniform(0, 50, size=(50, 40))), centers, widths)
    np.testing.assert_allclose(mu.sum(axis=-1), 1, rtol=1e-14)
    assert (mu >= 0).all()
    # With equal narrow widths they are the crisp sets between the crossing points.
    crisp = fuzzy.stick_breaking(jnp.array([1.0, 3.0, 5.0, 99.0]), jnp.array([[2.0, 4.0, 6.0]]), jnp.full((1, 3), 0.01))
    np.testing.assert_allclose(crisp, np.eye(4), atol=1e-12)


def test_ordered_points_and_their_inverse():
    raw = jnp.asarray(np.random.default_rng(3).normal(size=(4, 3)) * 5)
    points = fuzzy.ordered(raw)
    assert (points[:, 0] > 0).all()
    assert (np.diff(points, axis=1) > 0).all()
    np.testing.assert_allclose(fuzzy.unordered(points), raw, rtol=1e-9)


def test_shapes_of_single_sets():
    x = jnp.array([-1.0, 0.0, 0.5, 1.0, 2.0, 2.5, 3.0, 4.0])
    triangle = fuzzy.triangle(x, jnp.array([0.0, 1.0, 3.0]))
    np.testing.assert_allclose(triangle, [0, 0, 0.5, 1, 0.5, 0.25, 0, 0])
    cut = fuzzy.trapezoid(x, jnp.array([0.0, 0.0, 1.0, 3.0]))
    np.testing.assert_allclose(cut, [0, 1, 1, 1, 0.5, 0.25, 0, 0])
    bell = fuzzy.gaussian(x, jnp.asarray(1.0), jnp.asarray(2.0))
    np.testing.assert_allclose(bell, np.exp(-0.125 * (np.asarray(x) - 1) ** 2))


def test_gradients_are_finite_at_degenerate_feet():
    s = 2.0
    slopes = jax.jit(jax.vmap(jax.grad(fuzzy.trapezoid, (0, 1)), (0, None)))
    for corners in ([0.0, 0.0, s, 2 * s], [s, s, s, s], [0.0, s, 2 * s, 2 * s]):
        for slope in slopes(jnp.array([0.0, 0.5 * s, s, 1.5 * s, 2 * s]), jnp.array(corners)):
            assert np.isfinite(slope).all()
    assert jax.grad(fuzzy.trapezoid)(jnp.asarray(1.5 * s), jnp.array([0.0, 0.0, s, 2 * s])) == -1 / s


# Takagi-Sugeno


def test_tail_products_are_the_table_of_minimum_rules():
    rng = np.random.default_rng(4)
    for d, L in ((1, 4), (2, 3), (3, 4), (4, 2)):
        mu = jnp.asarray(rng.dirichlet(np.ones(L), size=(20, d)))
        table = jax.jit(jax.vmap(partial(fuzzy.rule_weights, rules=fuzzy.minimum_rules(L, d), levels=L)))(mu)
        np.testing.assert_allclose(jax.jit(jax.vmap(fuzzy.minimum_weights))(mu), table, rtol=0, atol=1e-12)
        np.testing.assert_allclose(table.sum(axis=1), 1, rtol=1e-12)


def test_rule_weights_follow_any_table_and_the_values_are_weighted():
    rng = np.random.default_rng(5)
    mu, rules = rng.dirichlet(np.ones(3), size=2), rng.integers(0, 4, size=(3, 3))
    weights = fuzzy.rule_weights(jnp.asarray(mu), rules, 4)
    expected = np.zeros(4)
    for i, j in np.ndindex(3, 3):
        expected[rules[i, j]] += mu[0, i] * mu[1, j]
    np.testing.assert_allclose(weights, expected, rtol=1e-13)
    values = rng.normal(size=(4, 2))
    np.testing.assert_allclose(fuzzy.takagi_sugeno(weights, jnp.asarray(values)), expected @ values, rtol=1e-13)


# Bad arguments


def test_bad_arguments_are_refused():
    sets = np.asarray(fuzzy.partition(10.0, 3))
    for bad, message in (
        ({"universe": 0.0}, "universe"),
        ({"universe": np.ones((2, 2))}, r"universe: expected shape \(d,\)"),
        ({"sets": 1}, "sets: expected an int >= 2"),
        ({"corners": sets[:, ::-1]}, "corners: must be ordered, but set 0 of input 0"),
        ({"corners": sets[:2]}, "corners: no set of input 0 holds 8"),
        ({"corners": [[0, 0, 1, 2], [3, 4, 10, 10]]}, "corners: no set of input 0 holds 2"),
        ({"corners": [[0, 0, 1, 2], [2, 4, 10, 10]]}, "corners: no set of input 0 holds 2"),
        ({"corners": sets[:, :3]}, r"corners: expected shape \(L, 4\)"),
        ({"corners": np.full_like(sets, np.nan)}, "corners: expected finite"),
        ({"rules": [0, 1, 2, 4]}, "rules: expected levels 0 to 3, got 0 to 4"),
        ({"rules": [0, -1, 2, 3]}, "rules: expected levels"),
        ({"rules": [0, 1]}, r"rules: expected shape \(4,\)"),
        ({"outputs": [[0.0, 50.0, 101.0]]}, "outputs: outside the output's universe"),
        ({"outputs": [[-1.0, 50.0, 100.0]]}, "outputs: outside"),
        ({"outputs": [[50.0, 40.0, 60.0]]}, "outputs: expected foot <= peak <= foot"),
        ({"outputs": [[50.0, 50.0, 50.0]]}, "outputs: expected foot <= peak <= foot"),
        ({"outputs": [0.0, 1.0, 2.0]}, r"outputs: expected shape \(K, 3\)"),
        ({"output_range": (1.0, 0.0)}, "output_range"),
    ):
        with pytest.raises(ValueError, match=message):
            fuzzy.mamdani(**{"universe": 10.0, **bad})
    with pytest.raises(TypeError, match="rules: expected integers"):
        fuzzy.mamdani(10.0, rules=[0.0, 1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="logits: expected shape"):
        fuzzy.partition(10.0, 3, np.zeros(7))
    with pytest.raises(ValueError, match="logits: expected finite"):
        fuzzy.partition(10.0, 3, np.full(5, np.inf))
    with pytest.raises(ValueError, match=r"x: expected shape \(3,\)"):
        fuzzy.infer(fuzzy.mamdani(UNIVERSE), jnp.zeros(2))


def test_is_public():
    assert jf.fuzzy is fuzzy
