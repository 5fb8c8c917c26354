"""Batch maximum likelihood of a start: linear least squares, the bound, and what cannot be identified."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from tests import reference

T = 12


def linear(seed=4):
    matrices = reference.random_model(np.random.default_rng(seed), 3, 2)
    model = jf.models.linear_gaussian(*matrices)
    rng = np.random.default_rng(1)
    return model, rng.normal(size=(T, 2)), rng.random((T, 2)) < 0.8


def dense(model, ys, mask, first):
    F, H, R = (np.asarray(x) for x in (model.F, model.H, model.R))
    A, b = [], []
    for k in range(T):
        used = mask[k]
        if used.any():
            W = np.linalg.inv(np.linalg.cholesky(R[np.ix_(used, used)]))
            A.append(W @ H[used] @ np.linalg.matrix_power(F, k if first else k + 1))
            b.append(W @ ys[k, used])
    return np.concatenate(A), np.concatenate(b)


@pytest.mark.parametrize("first", [False, True])
def test_on_linear_models_it_is_least_squares(first):
    model, ys, mask = linear()
    found = jf.initial.batch_ml(model, ys, np.zeros((2, 3)), mask=mask, first_update_only=first)
    A, b = dense(model, ys, mask, first)
    x, residual, *_ = np.linalg.lstsq(A, b, rcond=None)
    np.testing.assert_allclose(found.mean, x, rtol=1e-8)
    np.testing.assert_allclose(found.cost, residual[0], rtol=1e-10)
    np.testing.assert_allclose(found.information, A.T @ A, rtol=1e-10)
    np.testing.assert_allclose(found.cov, np.linalg.inv(A.T @ A), rtol=1e-8)
    assert int(found.count) == mask.sum()
    assert int(found.status) == 0


def test_with_a_prior_it_is_the_smoother_of_noise_free_motion():
    model, ys, mask = linear()
    still = model._replace(Q=jnp.zeros((3, 3)))
    found = jf.initial.batch_ml(
        model, ys, np.zeros((1, 3)), mask=mask, prior=(model.m0, model.P0), first_update_only=True
    )
    smoothed = jf.filter(jf.kalman(still), ys, mask=mask, first_update_only=True)
    end = np.linalg.matrix_power(np.asarray(model.F), T - 1)
    np.testing.assert_allclose(end @ found.mean, smoothed.mean[-1], rtol=1e-7)
    np.testing.assert_allclose(end @ found.cov @ end.T, smoothed.cov[-1], rtol=1e-6)


def seen(x, u, dt):
    return jnp.stack([jnp.hypot(x[0], x[1]), jnp.arctan2(x[1], x[0])])


def crossing(runs, seed=0):
    """A line seen in range and bearing from the origin."""
    R = np.diag([0.04, 1e-4])
    F = np.eye(4) + np.eye(4, k=2)
    motion = jf.models.linear_gaussian(F, np.eye(2, 4), np.zeros((4, 4)), R, np.zeros(4), np.eye(4))
    model = jf.models.with_sensor(motion, jf.models.sensors.range_bearing(R))
    x0 = np.array([-6.0, 5.0, 1.0, -0.2])
    path = np.stack([np.linalg.matrix_power(F, k) @ x0 for k in range(T)])
    true = np.asarray(jax.vmap(lambda x: seen(x, None, None))(path))
    rng = np.random.default_rng(seed)
    return model, x0, true + rng.normal(size=(runs, T, 2)) * np.sqrt(np.diag(R))


def many(model, ys, starts):
    return jax.jit(jax.vmap(lambda y: jf.initial.batch_ml(model, y, starts, first_update_only=True, iterations=30)))(ys)


def test_it_reaches_the_bound_and_says_how_sure_it_is():
    model, x0, ys = crossing(400)
    found = many(model, ys, np.array([[-3.0, 3.0, 0, 0], [-9.0, 9.0, 0, 0], [5.0, 5.0, 0, 0]]))
    bound, _ = jf.metrics.start_bound(model, x0, T, first_update_only=True)
    error = np.asarray(found.mean) - x0
    scaled = np.einsum("ri,rij,rj->r", error, np.asarray(found.information), error)
    assert abs(scaled.mean() - 4) < 3.5 * np.sqrt(8 / 400)
    ratio = (error**2).mean(axis=0) / np.diagonal(bound.cov[-1])
    assert (np.abs(ratio - 1) < 3.5 * np.sqrt(2 / 400)).all()
    assert abs(np.asarray(found.cost).mean() - (2 * T - 4)) < 3.5 * np.sqrt(2 * (2 * T - 4) / 400)
    assert (np.asarray(found.gradient) < 1e-4).all()
    np.testing.assert_allclose(np.median(found.condition), bound.condition[-1], rtol=0.2)


def test_the_best_of_the_starts_is_taken():
    model, _, ys = crossing(1)
    found = jax.tree.map(lambda x: x[0], many(model, ys, np.array([[-3.0, 3.0, 0, 0], [6.0, -5.0, 0, 0]])))
    assert found.costs.shape == (2,)
    assert float(found.cost) == float(found.costs.min())
    np.testing.assert_array_equal(found.mean, found.means[int(found.costs.argmin())])


def test_cost_is_that_of_the_search_and_its_gradient_vanishes_there():
    model, _, ys = crossing(1)
    found = jax.tree.map(lambda x: x[0], many(model, ys, np.array([[-3.0, 3.0, 0, 0], [6.0, -5.0, 0, 0]])))
    inputs = jf.inputs(ys[0])
    value, slope = jax.value_and_grad(lambda x: jf.initial.cost(model, x, inputs, first_update_only=True))(found.mean)
    np.testing.assert_allclose(value, found.cost, rtol=1e-12)
    assert np.abs(np.asarray(slope) * np.sqrt(np.diagonal(found.cov))).max() < 1e-4


def test_bearings_alone_from_a_straight_course_leave_the_scale_open():
    model, _, ys = crossing(1)
    R = np.array([[1e-4]])
    motion = jf.models.linear_gaussian(
        np.eye(4) + np.eye(4, k=2), np.eye(1, 4), np.zeros((4, 4)), R, np.zeros(4), np.eye(4)
    )
    blind = jf.models.with_sensor(motion, jf.models.sensors.bearing(R))
    found = jf.initial.batch_ml(blind, ys[0, :, 1:], np.array([[-3.0, 3.0, 0.1, 0]]), first_update_only=True)
    assert int(found.status) & int(jf.Status.SINGULAR) or float(found.condition) > 1e8
    assert np.isfinite(np.asarray(found.mean)).all()
    nothing = jf.initial.batch_ml(model, ys[0], np.array([[-3.0, 3.0, 0.1, 0]]), mask=np.zeros((T, 2), bool))
    expected = int(jf.Status.SINGULAR | jf.Status.MISSED)
    assert int(nothing.status) == expected
    np.testing.assert_array_equal(nothing.mean, [-3.0, 3.0, 0.1, 0])


def test_a_traced_nan_is_left_out_and_flagged():
    model, ys, _ = linear()
    bad = jnp.asarray(ys).at[3, 1].set(jnp.nan)
    found = jax.jit(lambda y: jf.initial.batch_ml(model, y, np.zeros((1, 3))))(bad)
    hidden = jf.initial.batch_ml(model, ys, np.zeros((1, 3)), mask=np.isfinite(np.asarray(bad)))
    np.testing.assert_allclose(found.mean, hidden.mean, rtol=1e-9)
    assert int(found.status) == int(jf.Status.NONFINITE)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"starts": np.zeros(3)}, "starts"),
        ({"starts": np.zeros((0, 3))}, "starts"),
        ({"starts": np.zeros((2, 4))}, "starts"),
        ({"iterations": 0}, "iterations"),
        ({"damping": 0.0}, "damping"),
        ({"scale": -1.0}, "scale"),
        ({"prior": (np.zeros(3), -np.eye(3))}, "prior"),
        ({"prior": (np.zeros(2), np.eye(3))}, "prior"),
        ({"ys": np.full((T, 2), np.nan)}, "no mask covers it"),
    ],
)
def test_bad_input_is_refused(options, named):
    model, ys, _ = linear()
    with pytest.raises(ValueError, match=named):
        jf.initial.batch_ml(model, **{"ys": ys, "starts": np.zeros((1, 3)), **options})
