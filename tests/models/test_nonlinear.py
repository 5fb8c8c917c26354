"""Nonlinear models: what they check, and what is left of a linear model in nonlinear form."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxfilt as jf
from jaxfilt.models.nonlinear import jacobian

YS = np.ones((3, 2))


def move(x, u, dt):
    return x + 0.1 * jnp.sin(x)


def see(x, u, dt):
    return x[:2] ** 2


def noise(x, u, dt):
    return jnp.eye(3, dtype=x.dtype) * (1.0 if dt is None else dt)


def build(**changed):
    given = {"f": move, "h": see, "Q": np.eye(3), "R": np.eye(2), "m0": np.zeros(3), "P0": np.eye(3), **changed}
    return jf.models.nonlinear(**given)


def test_numbers_take_the_arrays_dtype():
    model = build(Q=np.eye(3).tolist(), R=[[1, 0], [0, 1]], m0=jnp.zeros(3, jnp.float32), P0=np.eye(3).tolist())
    assert model.Q.dtype == model.R.dtype == model.P0.dtype == jnp.float32
    assert jf.filter(jf.unscented(model), YS.astype(np.float32)).mean.dtype == jnp.float32


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        ({"m0": np.zeros((3, 1))}, ValueError, "m0: expected shape"),
        ({"m0": np.array([0, np.nan, 0])}, ValueError, "m0: expected finite"),
        ({"Q": np.eye(2)}, ValueError, "Q: expected shape"),
        ({"R": np.array([[1.0, 0.5], [0.4, 1.0]])}, ValueError, "R: expected a symmetric"),
        ({"P0": -np.eye(3)}, ValueError, "P0: expected a positive semidefinite"),
        ({"Q": np.eye(3, dtype=np.float32)}, TypeError, "Q is float32"),
        ({"P0": np.eye(3, dtype=int)}, TypeError, "P0: expected a float array"),
    ],
    ids=str,
)
def test_bad_models_are_refused(changed, error, message):
    with pytest.raises(error, match=message):
        build(**changed)


@pytest.mark.parametrize("factory", [jf.extended, jf.sqrt_extended, jf.unscented, jf.sqrt_unscented])
def test_filters_check_what_the_functions_return(factory):
    with pytest.raises(ValueError, match="ys: expected 2 components per sample as the model's h gives, got 3"):
        jf.filter(factory(build()), np.ones((3, 3)))
    with pytest.raises(ValueError, match=r"f: expected shape \(3,\), got \(2,\)"):
        jf.filter(factory(build(f=see)), YS)
    with pytest.raises(ValueError, match=r"R: expected shape \(2, 2\), got \(3, 3\)"):
        jf.filter(factory(build(R=noise)), YS)
    with pytest.raises(ValueError, match=r"h: expected shape \(None,\), got \(\)"):
        jf.filter(factory(build(h=lambda x, u, dt: x[0])), YS)


@pytest.mark.parametrize("factory", [jf.extended, jf.sqrt_extended, jf.unscented, jf.sqrt_unscented])
def test_an_interval_needs_a_noise_that_knows_it(factory):
    with pytest.raises(ValueError, match="dt: given, but the model's Q is a fixed matrix"):
        jf.filter(factory(build()), YS, dt=0.5)
    jf.filter(factory(build(Q=noise)), YS, dt=0.5)
    fixed = jf.models.linear_gaussian(np.eye(2), np.eye(2), lambda u, dt: np.eye(2), np.eye(2), np.zeros(2), np.eye(2))
    with pytest.raises(ValueError, match="dt: given, but the model's F is a fixed matrix"):
        jf.filter(factory(fixed), YS, dt=0.5)


def test_a_linear_model_keeps_what_it_says():
    matrices = [np.eye(2), np.eye(2), np.eye(2), np.eye(2), np.zeros(2), np.eye(2)]
    with pytest.raises(ValueError, match="u: the model has an input matrix B"):
        jf.filter(jf.extended(jf.models.linear_gaussian(*matrices, B=np.eye(2))), YS)
    correlated = jf.models.linear_gaussian(*matrices, S=0.1 * np.eye(2))
    with pytest.raises(ValueError, match="noise correlated between process and measurement"):
        jf.models.as_nonlinear(correlated)
    with pytest.raises(ValueError, match="noise correlated between process and measurement"):
        jf.models.with_sensor(correlated, jf.models.sensors.position(np.eye(2)))


def test_given_jacobians_are_used():
    def wrong(x, u, dt):
        return jnp.full((2, 3), 7.0, x.dtype)

    model = build(h_jacobian=wrong)
    x = jnp.ones(3)
    assert (jacobian(model.h, model.h_jacobian, x, None, None) == 7).all()
    np.testing.assert_allclose(jacobian(model.h, None, x, None, None), np.diag([2.0, 2.0, 0])[:2])
    assert jf.models.with_sensor(model, jf.models.sensors.position(np.eye(2))).h_jacobian is None


def test_with_sensor_keeps_the_motion_and_takes_its_dtype():
    m0, P0 = jnp.zeros(4, jnp.float32), jnp.eye(4, dtype=jnp.float32)
    motion = jf.models.constant_velocity(dt=1.0, q=0.1, r=1.0, m0=m0, P0=P0)
    model = jf.models.with_sensor(motion, jf.models.sensors.bearing([[0.01]]))
    assert model.R.dtype == jnp.float32
    assert model.R.shape == (1, 1)
    np.testing.assert_array_equal(model.f(jnp.ones(4, jnp.float32), None, None), [2, 2, 1, 1])
    with pytest.raises(TypeError, match="R is float64, m0 is float32"):
        jf.models.with_sensor(motion, jf.models.sensors.bearing(np.eye(1)))
    with pytest.raises(ValueError, match="R: expected shape"):
        jf.models.with_sensor(motion, jf.models.Sensor(see, np.ones((2, 3), np.float32)))
    own = jf.models.with_sensor(motion, jf.models.Sensor(see, Partial(noise)))
    assert callable(own.R)
