"""Sensors: what they measure, where bearings jump, and what happens at the observer itself."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt.models import sensors

X = jnp.array([4.0, 1.0, 2.0, -1.0, 0.3])


def test_what_is_measured():
    np.testing.assert_array_equal(sensors.position(np.eye(2)).h(X, None, None), X[:2])
    np.testing.assert_array_equal(sensors.position_velocity(np.eye(4)).h(X, None, None), X[:4])
    there = np.array([1.0, -3.0])  # 3 and 4 away, seen under atan(4 / 3)
    seen = [5.0, np.arctan2(4, 3)]
    np.testing.assert_allclose(sensors.range_bearing(np.eye(2), observer=there).h(X, None, None), seen)
    np.testing.assert_allclose(sensors.bearing(np.eye(1), observer=there.tolist()).h(X, None, None), seen[1:])
    np.testing.assert_allclose(sensors.bearing(np.eye(1)).h(X[:2], None, None), [np.arctan2(1, 4)])
    rate = (3 * 2 - 4 * 1) / 5
    np.testing.assert_allclose(sensors.range_rate(np.eye(3), observer=there).h(X, None, None), [*seen, rate])
    moving = np.array([1.0, -3.0, 2.0, -1.0])  # at the target's own velocity
    np.testing.assert_allclose(sensors.range_rate(np.eye(3), observer=moving).h(X, None, None), [*seen, 0], atol=1e-15)


def platform(u, dt):
    return u


def test_the_observer_may_move_with_the_input():
    """The same track seen from a moving and from a fixed observer, each with its own measurements."""
    motion = jf.models.coordinated_turn(
        dt=1.0, q_omega=1e-3, q=0.1, r=1.0, m0=np.array([9.0, 4, 0, 1, 0]), P0=np.eye(5)
    )
    rng = np.random.default_rng(0)
    path = rng.normal(size=(8, 2)).cumsum(0)
    truth = np.array([9.0, 4.0]) + np.arange(1, 9)[:, None] * [0.0, 1.0]
    seen = truth - path
    ys = np.stack([np.hypot(*seen.T), np.arctan2(*seen.T[::-1])], axis=1)
    R = np.diag([0.01, 1e-4])
    out = jf.filter(jf.extended(jf.models.with_sensor(motion, sensors.range_bearing(R, observer=platform))), ys, u=path)
    assert np.abs(out.mean[:, :2] - truth).max() < 0.1


def test_wrapped_angles_keep_their_digits():
    np.testing.assert_allclose(
        sensors.wrap(jnp.array([3.5, -3.5, 7.0, 40.0])), np.angle(np.exp(1j * np.array([3.5, -3.5, 7, 40])))
    )
    small = jnp.array([1e-12, -3e-9, 3.1])
    assert (sensors.wrap(small) == small).all()
    assert np.abs(sensors.wrap(jnp.array([np.pi, -np.pi]))).max() == np.pi
    np.testing.assert_array_equal(jax.vmap(jax.grad(sensors.wrap))(jnp.array([0.0, 3.5, -9.0])), 1)
    residual = sensors.range_bearing(np.eye(2)).residual
    assert residual is not None
    np.testing.assert_allclose(residual(jnp.array([9.0, 3.1]), jnp.array([2.0, -3.1])), [7, 6.2 - 2 * np.pi])


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
def test_derivatives_are_finite_at_the_observer(dtype):
    R = np.eye(3, dtype=dtype)
    sensor = sensors.range_rate(R)
    x = jnp.zeros(5, dtype).at[2].set(1)
    derivatives = jax.jit(lambda x: [d(sensor.h)(x, None, None) for d in (jax.jacfwd, jax.jacrev, jax.hessian)])
    for out in derivatives(x):
        assert np.isfinite(out).all()
        assert out.dtype == dtype
    prior = {"m0": jnp.zeros(4, dtype), "P0": jnp.eye(4, dtype=dtype)}
    model = jf.models.with_sensor(jf.models.constant_velocity(dt=1.0, q=0.1, r=1.0, **prior), sensor)
    for factory in (jf.extended, jf.cubature):
        out = jf.filter(factory(model), jnp.ones((3, 3), dtype), first_update_only=True)
        assert np.isfinite(out.mean).all()


def test_bad_sensors_are_refused():
    with pytest.raises(ValueError, match=r"R: expected shape \(2, 2\), got \(3, 3\)"):
        sensors.range_bearing(np.eye(3))
    with pytest.raises(ValueError, match="R: expected a positive semidefinite"):
        sensors.bearing([[-1.0]])
    with pytest.raises(ValueError, match=r"observer: expected shape \(2,\) or \(4,\), got \(3,\)"):
        sensors.bearing(np.eye(1), observer=np.zeros(3)).h(X, None, None)
    with pytest.raises(ValueError, match="needs a state that begins with 4 components, got 2"):
        sensors.range_rate(np.eye(3)).h(X[:2], None, None)
    with pytest.raises(TypeError, match="observer is float32"):
        sensors.bearing(np.eye(1), observer=np.zeros(2, np.float32)).h(X, None, None)
