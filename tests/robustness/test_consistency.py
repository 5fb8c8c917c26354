"""Statistical consistency of the Gaussian filters in 1000 runs, and that a model wrong by 2 is found out.

The Kalman filter itself is in tests/metrics/test_consistency.py.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt.metrics import consistency, nees, whiteness

RUNS, T = 1000, 20
WRONG = [{"q": 2.0}, {"q": 0.5}, {"r": 2.0}, {"r": 0.5}]
SENSOR = {"R": np.diag([1.0, 1e-4]), "observer": np.array([-60.0, -30.0])}  # far off: nearly linear


def _slow(name):
    return pytest.param(name, marks=pytest.mark.slow)


def motion(q=1.0, r=1.0):
    m0, P0 = jnp.array([1.0, -1.0, 0.5, 0.3]), jnp.diag(jnp.array([4.0, 3.0, 0.5, 0.4]))
    return jf.models.constant_velocity(dt=1.0, q=0.1 * q, r=2.0 * r, m0=m0, P0=P0)


def range_bearing(q=1.0, r=1.0):
    sensor = jf.models.sensors.range_bearing(jnp.asarray(SENSOR["R"]) * r, observer=SENSOR["observer"])
    return jf.models.with_sensor(motion(q), sensor)


@functools.cache
def drawn():
    """States (RUNS, T, 4), linear measurements, and range and bearing of the same paths."""
    sim = jax.vmap(lambda key: jf.simulate.simulate(motion(), T, key))(jax.random.split(jax.random.key(5), RUNS))
    seen = np.asarray(sim.states)[..., :2] - SENSOR["observer"]
    noise = np.random.default_rng(5).normal(size=seen.shape) * np.sqrt(np.diag(SENSOR["R"]))
    polar = np.stack([np.hypot(seen[..., 0], seen[..., 1]), np.arctan2(seen[..., 1], seen[..., 0])], axis=-1) + noise
    return sim.states, sim.ys, jnp.asarray(polar)


@functools.partial(jax.jit, static_argnames=("make",))
def run(make, model, states, ys):
    def one(states, y):
        out = jf.filter(make(model), y)
        error = out.mean[-1] - states[-1]
        return (
            nees(out.mean[-1], out.cov[-1], states[-1]),
            out.nis,
            out.innovation,
            out.innovation_cov,
            error,
            out.cov[-1],
        )

    return jax.vmap(one)(states, ys)


def inside(make, model, states, ys):
    """Whether NEES at the end, NIS of all steps, and whiteness are inside their 99.9 % regions."""
    values, nis, innovation, S, _, _ = run(make, model, states, ys)
    white = whiteness(innovation, innovation_cov=S)
    return bool(consistency(values, 4).inside), bool(consistency(nis.ravel(), 2).inside), bool(white.inside.all())


@pytest.mark.parametrize("name", ["sqrt_kalman", _slow("unscented"), _slow("sqrt_cubature")])
def test_linear_model(name):
    states, ys, _ = drawn()
    make = getattr(jf, name)
    assert inside(make, motion(), states, ys) == (True, True, True)
    for wrong in WRONG:
        assert inside(make, motion(**wrong), states, ys) == (False, False, False), wrong


@pytest.mark.parametrize("name", ["extended", _slow("unscented"), _slow("sqrt_extended")])
def test_nearly_linear_sensor(name):
    states, _, polar = drawn()
    make = getattr(jf, name)
    assert inside(make, range_bearing(), states, polar) == (True, True, True)
    for wrong in WRONG:
        assert inside(make, range_bearing(**wrong), states, polar)[:2] == (False, False), wrong


def test_errors_reach_the_bound():
    """RMSE of each component within three standard errors and 3 % of the posterior Cramer-Rao bound."""
    states, ys, _ = drawn()
    error = np.asarray(run(jf.sqrt_kalman, motion(), states, ys)[4])
    sim = jnp.concatenate([states[:1, :1], states[:1]], axis=1)  # linear: the bound does not depend on the path
    bound = np.diag(np.asarray(jf.metrics.posterior_bound(motion(), sim).cov[-1]))
    ratio = np.sqrt((error**2).mean(axis=0) / bound)
    assert np.abs(ratio - 1).max() < 0.03 + 3 / np.sqrt(2 * RUNS)


@pytest.mark.slow
def test_particles_are_uniform_around_the_truth():
    """Probability integral transform of two components over 1000 runs; with R or Q wrong by 2 it is not uniform."""
    states, ys, _ = drawn()
    keys = jax.random.split(jax.random.key(1), RUNS)

    @jax.jit
    def ranks(model):
        filt = jf.particle(model, 500, keep=True)

        def one(x, y, key):
            out = jf.filter(filt, y, key=key)
            below = (out.extra["particles"][-1] < x[-1]).astype(y.dtype)
            return jnp.exp(out.extra["log_weights"][-1]) @ below

        return jax.vmap(one)(states, ys, keys)

    from scipy.stats import kstest

    right = np.asarray(ranks(motion()))
    assert all(kstest(right[:, i], "uniform").pvalue > 1e-3 for i in range(4))
    wrong = np.asarray(ranks(motion(q=0.25, r=0.25)))
    assert all(kstest(wrong[:, i], "uniform").pvalue < 1e-3 for i in range(4))
