"""Cramer-Rao bounds: the Kalman filter's covariance, information summed by hand, and a simulation."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt.metrics import posterior_bound, start_bound
from tests import reference

T = 30


def linear(seed=3, q=1.0):
    rng = np.random.default_rng(seed)
    F, H, Q, R, m0, P0 = reference.random_model(rng, 3, 2)[:6]
    return jf.models.linear_gaussian(F, H, q * np.asarray(Q), R, m0, P0)


def simulate(model, runs, seed=0):
    """(runs, T + 1, 3) states and (runs, T, 2) measurements with a drawn start."""
    rng = np.random.default_rng(seed)
    F, H, Q, R = (np.asarray(x) for x in (model.F, model.H, model.Q, model.R))
    x = rng.multivariate_normal(np.asarray(model.m0), np.asarray(model.P0), size=runs)
    states, ys = [x], []
    for _ in range(T):
        x = x @ F.T + rng.multivariate_normal(np.zeros(3), Q, size=runs)
        states.append(x)
        ys.append(x @ H.T + rng.multivariate_normal(np.zeros(2), R, size=runs))
    return np.stack(states, axis=1), np.stack(ys, axis=1)


@pytest.mark.parametrize("q", [1.0, 0.0])
def test_on_linear_models_it_is_the_kalman_covariance(q):
    model = linear(q=q)
    states, ys = simulate(model, 7)
    mask = np.random.default_rng(1).random((T, 2)) < 0.7
    for first in (False, True):
        drawn = states[:, 1:] if first else states
        out = jf.filter(jf.kalman(model), ys[0], mask=mask, first_update_only=first)
        bound = posterior_bound(model, drawn, mask=mask, first_update_only=first)
        np.testing.assert_allclose(bound.cov, out.cov, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(
            posterior_bound(model, drawn[0], mask=mask, first_update_only=first).cov, out.cov, rtol=1e-10, atol=1e-12
        )


def test_the_kalman_filter_reaches_it():
    model = linear()
    states, ys = simulate(model, 400, seed=2)
    out = jax.vmap(lambda y: jf.filter(jf.kalman(model), y).mean)(ys)
    squared = ((np.asarray(out) - states[:, 1:]) ** 2).sum(-1).mean(1)
    bound = np.trace(np.asarray(posterior_bound(model, states[0]).cov), axis1=1, axis2=2).mean()
    assert abs(squared.mean() - bound) < 3.5 * squared.std() / 20


def test_without_noise_both_forms_agree():
    """Recursion with Q = 0 and summed information of the start, with the prior and as it is measured."""
    model = linear(q=0.0)
    states, _ = simulate(model, 1)
    mask = np.random.default_rng(1).random((T, 2)) < 0.7
    for first in (False, True):
        x0 = states[0, 1 if first else 0]
        recursive = posterior_bound(model, states[0, 1:] if first else states[0], mask=mask, first_update_only=first)
        start, now = start_bound(model, x0, T, prior=model.P0, mask=mask, first_update_only=first)
        np.testing.assert_allclose(now.cov[5:], recursive.cov[5:], rtol=1e-6)
        np.testing.assert_allclose(start.condition[0] > 1, True)


def test_nothing_is_known_before_enough_is_measured():
    model = jf.models.constant_velocity(dt=1.0, q=1.0, r=4.0, m0=np.zeros(2), P0=np.eye(2))
    start, now = start_bound(model, np.zeros(2), 4, first_update_only=True)
    assert np.isinf(start.condition[0])
    assert np.isinf(np.diagonal(now.cov[0])).all()
    # a line through k points: variance of its slope and its beginning
    np.testing.assert_allclose(start.cov[1], [[4, -4], [-4, 8]], rtol=1e-12)
    np.testing.assert_allclose(now.cov[1], [[4, 4], [4, 8]], rtol=1e-12)


def bent(x, u, dt):
    return jnp.stack([0.9 * x[0] + 0.3 * jnp.sin(x[1]), 0.8 * x[1] + 0.1 * x[0] ** 2])


def seen(x, u, dt):
    return jnp.arctan2(x[1:2], 2 + x[:1])


def test_nonlinear_transitions_give_the_recursion_of_tichavsky():
    Q, R, P0 = np.diag([0.2, 0.1]), np.array([[0.05]]), np.diag([0.5, 0.4])
    model = jf.models.nonlinear(bent, seen, Q, R, np.zeros(2), P0)
    states = np.random.default_rng(0).normal(size=(6, 5, 2))
    J = np.linalg.inv(P0)
    for k in range(4):
        F = np.stack([jax.jacfwd(bent)(x, None, None) for x in jnp.asarray(states[:, k])])
        H = np.stack([jax.jacfwd(seen)(x, None, None) for x in jnp.asarray(states[:, k + 1])])
        Qi = np.linalg.inv(Q)
        D11 = np.mean(np.swapaxes(F, 1, 2) @ Qi @ F, axis=0)
        D12 = -np.mean(np.swapaxes(F, 1, 2), axis=0) @ Qi
        D22 = Qi + np.mean(np.swapaxes(H, 1, 2) @ np.linalg.inv(R) @ H, axis=0)
        J = D22 - D12.T @ np.linalg.inv(J + D11) @ D12
        np.testing.assert_allclose(posterior_bound(model, states).cov[k], np.linalg.inv(J), rtol=1e-10)


def test_a_constant_bearing_leaves_the_range_open():
    """Target and observer move alike: no error, a large condition number, and P does not collapse along the range."""
    m0, P0 = np.array([6000.0, 6000.0, 3.0, 1.0, 500.0]), np.diag([1e6, 1e6, 1e-4, 1e-4, 9.0])
    R = np.diag([np.radians(2.0) ** 2, 0.09])
    F = np.eye(5) + np.eye(5, k=2) * np.array([1, 1, 0, 0, 0])[:, None]
    motion = jf.models.linear_gaussian(F, np.eye(2, 5), np.zeros((5, 5)), R, m0, P0)
    model = jf.models.with_sensor(motion, jf.models.sensors.bearing_doppler(R, observer=_own, compass=True))
    own = np.arange(1, 201)[:, None] * [3.0, 1.0, 0, 0] + [0, 0, 3.0, 1.0]
    states = np.concatenate([m0[None], np.stack([np.linalg.matrix_power(F, k) @ m0 for k in range(1, 201)])])
    bound = posterior_bound(model, states, u=own)
    along = np.array([1, 1, 0, 0, 0]) / np.sqrt(2)
    assert along @ np.asarray(bound.cov[-1]) @ along > 0.99e6
    assert np.isinf(start_bound(model, m0, 200, u=own)[0].condition[-1])
    ys = np.tile([np.pi / 4, 500.0], (200, 1))
    out = jf.filter(jf.extended(model), ys, u=own)
    assert along @ np.asarray(out.cov[-1]) @ along > 0.99e6


def _own(u, dt):
    return u


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda m: posterior_bound(m, np.zeros((4, 2))), "states"),
        (lambda m: posterior_bound(m, np.zeros((1, 3))), "states"),
        (lambda m: posterior_bound(m, np.zeros((4, 3)), P0=-np.eye(3)), "P0"),
        (lambda m: start_bound(m, np.zeros(2), 4), "x0"),
        (lambda m: start_bound(m, np.zeros(3), 4, prior=-np.eye(3)), "prior"),
    ],
)
def test_bad_input_is_refused(call, named):
    with pytest.raises(ValueError, match=named):
        call(linear())
