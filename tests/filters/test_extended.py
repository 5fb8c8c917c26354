"""Extended Kalman filters: exact on linear models, and against formulas, samples and an optimizer on curved ones."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from scipy.optimize import minimize

import jaxfilt as jf
from tests.examples.nonlinear import ANGLES, STEPS, flight, linear_case, scene

FORMS = {"extended": jf.extended, "sqrt_extended": jf.sqrt_extended}
every_form = pytest.mark.parametrize("form", FORMS)
OPTIONS = [{}, {"order": 2}, {"iterations": 2}, {"iterations": 3}, {"iterations": 5}]


def close(a, b, tol):
    a, b = np.asarray(a), np.asarray(b)
    np.testing.assert_allclose(a, b, rtol=0, atol=tol * max(1.0, np.abs(b).max()))


@every_form
@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_equals_the_kalman_filter_on_a_linear_model(form, options):
    model, ys, given = linear_case()
    filt = FORMS[form](model, **options)
    want = jf.filter(jf.kalman(model), ys, outputs=jf.everything, **given)
    got = jf.filter(filt, ys, outputs=jf.everything, **given)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        close(a, b, 1e-10)
    for a, b in zip(jf.rts(got), jf.rts(want), strict=True):
        close(a, b, 1e-10)


def test_equals_the_kalman_filter_where_dt_varies():
    prior = {"m0": np.zeros(4), "P0": np.eye(4)}
    model = jf.models.constant_velocity(dt=1.0, q=0.3, r=[1.0, 2.0], **prior)
    rng = np.random.default_rng(2)
    ys, dt = rng.normal(size=(STEPS, 2)), rng.uniform(0.2, 2, size=STEPS)
    want = jf.filter(jf.kalman(model), ys, dt=dt)
    close(jf.filter(jf.extended(model), ys, dt=dt).cov, want.cov, 1e-10)
    close(jf.filter(jf.sqrt_extended(model), ys, dt=dt).mean, want.mean, 1e-10)


@pytest.mark.parametrize("options", OPTIONS[:4], ids=str)
def test_array_form_equals_covariance_form(options):
    model, ys, mask = scene()
    want = jf.filter(jf.extended(model, **options), ys, mask=mask, outputs=jf.everything)
    got = jf.filter(jf.sqrt_extended(model, **options), ys, mask=mask, outputs=jf.everything)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        close(a, b, 1e-9)


@every_form
def test_one_iteration_is_the_plain_filter_and_two_are_not(form):
    model, ys, mask = scene()
    plain = jf.filter(FORMS[form](model), ys, mask=mask)
    once = jf.filter(FORMS[form](model, iterations=1), ys, mask=mask)
    twice = jf.filter(FORMS[form](model, iterations=2), ys, mask=mask)
    assert (plain.mean == once.mean).all()
    assert np.abs(plain.mean - twice.mean).max() > 1e-4


@pytest.mark.parametrize("options", [{}, {"order": 2}, {"iterations": 3}], ids=str)
def test_float32_is_close_to_float64(options):
    outs = []
    for dtype in (jnp.float32, jnp.float64):
        model, ys, mask = scene(dtype)
        outs.append(jf.filter(jf.sqrt_extended(model, **options), ys, mask=mask))
        assert outs[-1].mean.dtype == dtype
    close(outs[0].mean, outs[1].mean, 1e-4)
    close(outs[0].cov, outs[1].cov, 1e-4)


# A quadratic measurement, and a quadratic motion, of known Hessians.
HESSIANS = np.array([[[0.8, 0.3], [0.3, -0.4]], [[0.1, -0.6], [-0.6, 0.5]]])
SLOPES = np.array([[1.0, -0.5], [0.3, 2.0]])


def quadratic(A, B, x, u, dt):
    return A @ x + 0.5 * jnp.einsum("iab,a,b->i", B, x, x)


def curved_model(f=None, h=None):
    P0 = np.array([[0.5, 0.2], [0.2, 0.4]])
    function = Partial(quadratic, SLOPES, HESSIANS)
    flat = Partial(quadratic, np.eye(2), np.zeros((2, 2, 2)))
    return jf.models.nonlinear(f or flat, h or function, 0.1 * np.eye(2), 0.3 * np.eye(2), np.array([0.4, -0.7]), P0)


@every_form
def test_second_order_equals_its_formula(form):
    """nu, S, K and P = P- - K S K' as written in the thesis, by hand."""
    model = curved_model()
    y = np.array([0.9, -0.2])
    m, P = np.array(model.m0), np.array(model.P0)
    H = SLOPES + HESSIANS @ m
    spread = np.array([[np.trace(A @ P @ B @ P) / 2 for B in HESSIANS] for A in HESSIANS])
    S = H @ P @ H.T + 0.3 * np.eye(2) + spread
    nu = y - SLOPES @ m - [m @ A @ m / 2 + np.trace(A @ P) / 2 for A in HESSIANS]
    K = P @ H.T @ np.linalg.inv(S)
    out = jf.filter(FORMS[form](model, order=2), y[None], first_update_only=True)
    close(out.innovation[0], nu, 1e-12)
    close(out.innovation_cov[0], S, 1e-12)
    close(out.mean[0], m + K @ nu, 1e-12)
    close(out.cov[0], P - K @ S @ K.T, 1e-12)
    close(out.noise_cov[0], 0.3 * np.eye(2) + spread, 1e-12)


@every_form
def test_second_order_gives_the_moments_of_a_quadratic(form):
    """Mean and covariance of f(x) and h(x) from 1e6 draws; the first order misses them."""
    function = Partial(quadratic, SLOPES, HESSIANS)
    rng = np.random.default_rng(3)
    model = curved_model()
    x = rng.multivariate_normal(model.m0, model.P0, size=1_000_000)
    values = x @ SLOPES.T + 0.5 * np.einsum("iab,ka,kb->ki", HESSIANS, x, x)
    mean, cov = values.mean(0), np.cov(values.T)
    y = np.zeros((1, 2))
    misses = []
    for order in (1, 2):
        seen = jf.filter(FORMS[form](model, order=order), y, first_update_only=True)
        moved = jf.filter(FORMS[form](curved_model(f=function), order=order), y, outputs=jf.everything).prediction
        errors = [-seen.innovation[0] - mean, seen.innovation_cov[0] - 0.3 * np.eye(2) - cov]
        errors += [moved.mean[0] - mean, moved.cov[0] - 0.1 * np.eye(2) - cov]
        misses.append(max(float(np.abs(e).max()) for e in errors))
    assert misses[1] < 0.01  # of the draws: their standard deviation is about 0.003
    assert misses[0] > 0.1


@every_form
def test_iterations_find_the_maximum_of_the_posterior(form):
    """Of -2 log p(x | y), by scipy, and the covariance of the linearization there."""
    model, ys, _ = scene()
    # A well-informed bearing over a wide prior: the plain update is far from the optimum.
    model = model._replace(R=jnp.diag(jnp.array([0.05, 1e-3])), P0=model.P0 * 3)
    y = ys[0]
    m0, P0 = np.asarray(model.m0), np.asarray(model.P0)
    residual = model.residual
    assert residual is not None
    information, weight = np.linalg.inv(P0), np.linalg.inv(np.asarray(model.R))

    @jax.jit
    def cost(x):
        nu = residual(y, model.h(x, None, None))
        return (x - m0) @ information @ (x - m0) + nu @ weight @ nu

    found = minimize(cost, m0, jac=jax.jit(jax.grad(cost)), method="BFGS", options={"gtol": 1e-9})
    out = jf.filter(FORMS[form](model, iterations=15), y[None], first_update_only=True)
    plain = jf.filter(FORMS[form](model), y[None], first_update_only=True)
    close(out.mean[0], found.x, 1e-7)
    assert np.abs(plain.mean[0] - found.x).max() > 0.02
    H = jax.jacfwd(model.h)(out.mean[0], None, None)
    close(out.cov[0], np.linalg.inv(information + H.T @ weight @ H), 1e-7)
    close(out.nis, plain.nis, 0)  # the likelihood is the prediction's


def test_an_unusable_value_moves_nothing_however_often_iterated():
    """Under a transformation a NaN or infinity is ignored and flagged; iterations agree about what that means."""
    model, ys, given = linear_case()
    given = {"u": given["u"]}
    ys = jnp.asarray(ys).at[3, 1].set(jnp.nan).at[5, 0].set(jnp.inf)
    want = jax.jit(lambda y: jf.filter(jf.kalman(model), y, **given))(ys)
    got = jax.jit(lambda y: jf.filter(jf.extended(model, iterations=3), y, **given))(ys)
    close(got.mean, want.mean, 1e-10)
    assert (got.status == want.status).all()
    assert int(got.status[3]) == int(jf.Status.NONFINITE)


@pytest.mark.parametrize("options", [{}, {"order": 2}, {"iterations": 3}], ids=str)
def test_turning_the_scene_changes_nothing(options):
    errors = [flight(lambda model: jf.extended(model, **options), angle) for angle in ANGLES]
    assert np.abs(np.array(errors) - errors[0]).max() < 1e-9
    assert 0.05 < np.sqrt(np.mean(errors[0] ** 2)) < 2


@every_form
def test_noise_may_be_scaled_and_depend_on_the_state(form):
    """R of the predicted state, in proportion to range, and the scales of Q and R."""
    model, ys, _ = scene()
    steps = {"q_scale": 2.0, "r_scale": np.array([[0.5, 3.0]] * STEPS)}
    D = np.diag(np.sqrt([0.5, 3.0]))
    base = jf.filter(FORMS[form](model), ys, **steps)
    scaled = model._replace(R=D @ model.R @ D, Q=Partial(_doubled, model.Q))
    close(base.mean, jf.filter(FORMS[form](scaled), ys).mean, 1e-10)
    varying = model._replace(R=Partial(_noise_of_range))
    out = jf.filter(FORMS[form](varying), ys, outputs=jf.everything)
    close(out.noise_cov[2], _noise_of_range(out.prediction.mean[2], None, None), 1e-12)


def _doubled(Q, x, u, dt):
    return 2 * Q(x, u, dt)


def _noise_of_range(x, u, dt):
    return jnp.diag(jnp.stack([0.01 * (x[0] ** 2 + x[1] ** 2) + 0.1, jnp.ones((), x.dtype)]))


def test_options_are_checked():
    model, *_ = linear_case()
    for bad in ({"order": 3}, {"iterations": 0}, {"iterations": True}, {"order": 2, "iterations": 2}):
        with pytest.raises(ValueError, match=r"order|iterations"):
            jf.extended(model, **bad)
