from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilt import tune


class Params(NamedTuple):
    q: Any
    gains: Any
    corners: Any
    P0: Any
    bias: Any
    steps: Any


def make_space():
    P0 = np.array([[4.0, -1.0, 0.3], [-1.0, 2.0, 0.5], [0.3, 0.5, 1.0]])
    return Params(
        q=tune.positive([0.1, 30.0]),
        gains={"alpha": tune.interval(0.5, 0.0, 2.0), "beta": tune.unit([[0.2], [0.97]])},
        corners=tune.ordered([1.0, 2.0, 9.5], 0.0, 10.0),
        P0=tune.covariance(P0),
        bias=tune.real(-3.0, -10.0, 30.0),
        steps=3.0,
    )


def test_initial_values_survive_the_round_trip():
    space = make_space()
    z = tune.to_vector(space)
    assert z.shape == (tune.size(space),) == (2 + 1 + 2 + 3 + 6 + 1,)
    params = tune.constrain(space, z)
    expected = [0.5, [[0.2], [0.97]], [0.1, 30.0], [1.0, 2.0, 9.5], -3.0, 3.0]
    actual = [params.gains["alpha"], params.gains["beta"], params.q, params.corners, params.bias, params.steps]
    for a, b in zip(actual, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13)
    np.testing.assert_allclose(params.P0, space.P0.init, rtol=1e-13)


def test_any_point_of_the_box_survives_the_round_trip_and_keeps_its_constraints():
    space = make_space()
    zs = tune.sample(space, jax.random.key(1), 200)
    params = jax.jit(jax.vmap(partial(tune.constrain, space)))(zs)
    back = jax.jit(jax.vmap(partial(tune.unconstrain, space)))(params)
    np.testing.assert_allclose(back, zs, rtol=1e-7, atol=1e-7)
    assert (params.q > 0).all()
    assert ((params.gains["beta"] > 0) & (params.gains["beta"] < 1)).all()
    assert ((params.corners > 0) & (params.corners < 10)).all()
    assert (jnp.diff(params.corners, axis=1) > 0).all()
    assert (jnp.linalg.eigvalsh(params.P0) > 0).all()
    np.testing.assert_array_equal(params.P0, params.P0.swapaxes(1, 2))


def test_box_is_finite_holds_the_initial_values_and_gives_the_ends_that_were_asked_for():
    space = make_space()
    low, high = tune.bounds(space)
    z = tune.to_vector(space)
    assert np.isfinite(low).all()
    assert np.isfinite(high).all()
    assert ((low <= z) & (z <= high)).all()
    space = {"q": tune.positive(1.0, 0.2, 7.0), "x": tune.real([1.0, 2.0], [0.0, 1.0], 5.0)}
    for end, q, x in zip(tune.bounds(space), (0.2, 7.0), ([0.0, 1.0], [5.0, 5.0]), strict=True):
        params = tune.constrain(space, end)
        np.testing.assert_allclose(params["q"], q, rtol=1e-14)
        np.testing.assert_allclose(params["x"], x, atol=1e-14)


def test_box_widens_to_hold_an_initial_value_near_an_end():
    space = tune.unit(1.0 - 1e-6)
    low, high = tune.bounds(space)
    assert high[0] == tune.to_vector(space)[0] > 13.0
    assert low[0] == -7.0


def test_covariance_coordinates_have_no_unit():
    P = np.array([[4.0, -1.0], [-1.0, 2.0]])
    unit = np.diag([1e-3, 1e4])
    a, b = tune.covariance(P), tune.covariance(unit @ P @ unit)
    step = jnp.array([0.3, -0.2, 0.5])
    moved = tune.constrain(a, tune.to_vector(a) + step)
    scaled = tune.constrain(b, tune.to_vector(b) + step)
    np.testing.assert_allclose(scaled, unit @ moved @ unit, rtol=1e-12)


def test_gradients_agree_with_central_differences():
    space = make_space()
    z = tune.to_vector(space)
    weights = [jnp.cos(jnp.arange(np.size(leaf), dtype=z.dtype)) for leaf in jax.tree.leaves(tune.initial(space))]

    @jax.jit
    def f(z):
        leaves = jax.tree.leaves(tune.constrain(space, z))
        return sum((w * jnp.ravel(jnp.asarray(x, z.dtype))).sum() for w, x in zip(weights, leaves, strict=True))

    chex.assert_numerical_grads(f, (z,), order=1)


def test_python_numbers_take_the_dtype_of_the_arrays_beside_them():
    space = {"q": tune.positive(0.1), "P0": tune.covariance(np.eye(2, dtype=np.float32)), "frozen": 2.0}
    assert tune.to_vector(space).dtype == jnp.float32
    params = tune.constrain(space, tune.to_vector(space))
    assert params["q"].dtype == params["P0"].dtype == jnp.float32
    assert params["frozen"] == 2.0
    assert tune.to_vector({"q": tune.positive(0.1), "m0": jnp.zeros(2, jnp.float32)}).dtype == jnp.float32
    assert tune.to_vector({"q": tune.positive(0.1), "dt": 1.0}).dtype == jnp.float64
    jitted = jax.jit(tune.to_vector)({"q": tune.positive(0.1), "P0": tune.positive(jnp.float32(1)), "dt": 1.0})
    assert jitted.dtype == jnp.float32
    with pytest.raises(TypeError, match="space"):
        tune.to_vector([tune.positive(jnp.float32(1)), tune.positive(jnp.float64(1))])


def test_frozen_specs_become_their_initial_values():
    space = {"a": tune.frozen(tune.positive(2.0)), "b": tune.frozen({"c": tune.unit([0.5]), "d": "kept"}), "e": None}
    assert tune.size(space) == 0
    assert space["a"] == 2.0
    np.testing.assert_array_equal(space["b"]["c"], [0.5])
    assert space["b"]["d"] == "kept"


def test_another_initial_value_does_not_retrace():
    traces = []

    @jax.jit
    def f(space, z):
        traces.append(1)
        return tune.constrain(space, z)["q"] + tune.to_vector(space)[0]

    for q in (0.1, 0.7):
        space = {"q": tune.positive(q), "r": 2.0}
        f(space, tune.to_vector(space))
    assert len(traces) == 1


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: tune.positive(0.0), "init"),
        (lambda: tune.positive([1.0, np.nan]), "init"),
        (lambda: tune.positive(1.0, low=-1.0), "low"),
        (lambda: tune.positive(1.0, low=2.0), "init"),
        (lambda: tune.positive([1.0, 2.0], high=[3.0, 3.0, 3.0]), "high"),
        (lambda: tune.unit(1.0), "init"),
        (lambda: tune.interval(3.0, 0.0, 2.0), "init"),
        (lambda: tune.real(0.0, 1.0, 1.0), "low"),
        (lambda: tune.real(3.0, 0.0, 1.0), "init"),
        (lambda: tune.ordered([1.0, 1.0], 0.0, 2.0), "init"),
        (lambda: tune.ordered(1.0, 0.0, 2.0), "init"),
        (lambda: tune.covariance([[1.0, 2.0], [2.0, 1.0]]), "init"),
        (lambda: tune.covariance([[1.0, 0.5], [0.0, 1.0]]), "init"),
        (lambda: tune.covariance([1.0]), "init"),
        (lambda: tune.covariance([[1.0]], factor=1.0), "factor"),
        (lambda: tune.constrain(tune.unit(0.5), jnp.zeros(2)), "z"),
        (lambda: tune.unconstrain({"a": tune.unit([0.5, 0.5])}, {"a": 0.5}), "params"),
    ],
)
def test_bad_arguments_are_named(make, name):
    with pytest.raises(ValueError, match=f"^{name}: "):
        make()
