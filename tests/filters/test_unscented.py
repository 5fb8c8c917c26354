"""Sigma-point filters: exact on linear models, the textbook's sums on curved ones, and PSD with any weights."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt.models.nonlinear import covariance
from tests.examples.nonlinear import ANGLES, flight, linear_case, scene

UNSCENTED = {"unscented": jf.unscented, "sqrt_unscented": jf.sqrt_unscented}
CUBATURE = {"cubature": jf.cubature, "sqrt_cubature": jf.sqrt_cubature}
BOUND = int(jf.Status.BOUND)
every_form = pytest.mark.parametrize("form", UNSCENTED)
# The first needs digits, the second has a negative central weight, the last two subtract for a curved function.
SPREADS = [
    (1e-3, 2.0, 0.0),
    (0.5, 2.0, 0.0),
    (1.0, 2.0, 0.0),
    (1.0, 0.0, 1.0),
    (0.1, 0.0, 2.0),
    (1.0, 0.0, -2.0),
    (0.7, 0.1, -1.0),
]


def close(a, b, tol):
    a, b = np.asarray(a), np.asarray(b)
    np.testing.assert_allclose(a, b, rtol=0, atol=tol * max(1.0, np.abs(b).max()))


def all_close(a, b, tol):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        close(x, y, tol)


def spread(alpha, beta, kappa):
    return {"alpha": alpha, "beta": beta, "kappa": kappa}


@every_form
def test_equals_the_kalman_filter_on_a_linear_model(form):
    model, ys, given = linear_case()
    want = jf.filter(jf.kalman(model), ys, outputs=jf.everything, **given)
    for parameters in SPREADS:
        got = jf.filter(UNSCENTED[form](model, **spread(*parameters)), ys, outputs=jf.everything, **given)
        tol = 1e-9 if parameters[0] < 0.01 else 1e-10
        all_close(got, want, tol)
        all_close(jf.rts(got), jf.rts(want), tol)


@pytest.mark.parametrize("form", CUBATURE)
def test_cubature_equals_the_kalman_filter_on_a_linear_model(form):
    model, ys, given = linear_case()
    want = jf.filter(jf.kalman(model), ys, outputs=jf.everything, **given)
    got = jf.filter(CUBATURE[form](model), ys, outputs=jf.everything, **given)
    all_close(got, want, 1e-10)
    all_close(jf.rts(got), jf.rts(want), 1e-10)


def textbook(model, ys, mask, alpha, beta, kappa):
    """The scaled unscented filter as the thesis writes it: sums over weighted points, P - K S K'."""
    f, h = (jax.jit(jax.vmap(lambda x, fn=fn: fn(x, None, None))) for fn in (model.f, model.h))
    Q, R, n = np.asarray(covariance(model.Q, model.m0, None, None)), np.asarray(model.R), model.m0.size
    lam = alpha**2 * (n + kappa) - n
    W_m = np.full(2 * n + 1, 0.5 / (n + lam))
    W_c = W_m.copy()
    W_m[0] = lam / (n + lam)
    W_c[0] = W_m[0] + 1 - alpha**2 + beta

    def points(m, P):
        L = np.linalg.cholesky((n + lam) * P)
        return np.concatenate([m[None], m + L.T, m - L.T])

    def moments(X, noise):
        mean = W_m @ X
        return mean, (W_c[:, None] * (X - mean)).T @ (X - mean) + noise

    m, P, out = np.asarray(model.m0), np.asarray(model.P0), []
    for y, present in zip(np.asarray(ys), mask, strict=True):
        m, P = moments(np.asarray(f(points(m, P))), Q)
        X = points(m, P)
        Y = np.asarray(h(X))
        predicted, S = moments(Y, R)
        C = (W_c[:, None] * (X - m)).T @ (Y - predicted)
        nu, C, S = (y - predicted)[present], C[:, present], S[np.ix_(present, present)]
        K = C @ np.linalg.inv(S)
        m, P = m + K @ nu, P - K @ S @ K.T
        out.append((m, P, -0.5 * (nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(2 * np.pi * S)[1])))
    return [np.array(x) for x in zip(*out, strict=True)]


@every_form
def test_equals_the_textbook_on_a_turn(form):
    model, ys, mask = scene()
    for parameters in [(0.5, 2.0, 0.0), (1.0, 2.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, -2.0), (0.8, 0.1, -1.0)]:
        mean, cov, log_lik = textbook(model, ys, mask, *parameters)
        out = jf.filter(UNSCENTED[form](model, **spread(*parameters)), ys, mask=mask, outputs=jf.everything)
        close(out.mean, mean, 1e-9)
        close(out.cov, cov, 1e-9)
        close(out.log_lik, log_lik, 1e-9)
        assert not (out.status & BOUND).any()


def test_array_forms_equal_covariance_forms():
    model, ys, mask = scene()
    pairs = [(jf.unscented(model, **spread(*p)), jf.sqrt_unscented(model, **spread(*p))) for p in SPREADS[1:]]
    for a, b in [*pairs, (jf.cubature(model), jf.sqrt_cubature(model))]:
        results = [jf.filter(filt, ys, mask=mask, outputs=jf.everything) for filt in (a, b)]
        all_close(results[1], results[0], 1e-9)
        all_close(jf.rts(results[1]), jf.rts(results[0]), 1e-8)


def length_squared(x, u, dt):
    return jnp.stack([jnp.sum(x * x), x[0]])


def lengthened(x, u, dt):
    return x.at[0].add(jnp.sum(x * x))


def same(x, u, dt):
    return x


@every_form
@pytest.mark.parametrize("where", ["predict", "update"])
def test_what_cannot_be_subtracted_is_dropped_and_flagged(form, where):
    """kappa = 3 - n with n = 6, of a squared length: the textbook's variance is negative."""
    n = 6
    f, h = (same, length_squared) if where == "update" else (lengthened, lambda x, u, dt: x[:2])
    P0 = np.diag([1e-4] + [1.0] * (n - 1))
    model = jf.models.nonlinear(f, h, 1e-4 * np.eye(n), 0.01 * np.eye(2), np.zeros(n), P0)
    ys = np.array([[3.0, 0.01], [4.0, 0.02], [5.0, 0.0]])
    bad = jf.filter(UNSCENTED[form](model, **spread(1.0, 0.0, 3.0 - n)), ys, outputs=jf.everything)
    assert ((np.asarray(bad.status) & BOUND) != 0).all()
    assert not (np.asarray(bad.status) & int(jf.Status.NONFINITE)).any()
    for cov in (bad.cov, bad.prediction.cov, bad.innovation_cov):
        assert np.linalg.eigvalsh(cov).min() > -1e-14
    other = jf.filter(UNSCENTED["unscented"](model, **spread(1.0, 0.0, 3.0 - n)), ys, outputs=jf.everything)
    all_close(bad, other, 1e-9)
    good = jf.filter(UNSCENTED[form](model), ys)
    assert not (np.asarray(good.status) & BOUND).any()


@every_form
def test_a_traced_spread_that_is_none_is_flagged(form):
    model, ys, given = linear_case()

    @jax.jit
    def run(kappa):
        return jf.filter(UNSCENTED[form](model, kappa=kappa), ys, **given)

    bad, good = run(-4.0), run(1.0)
    assert (np.asarray(bad.status) & BOUND != 0).all()
    assert np.isfinite(bad.mean).all()
    assert not (np.asarray(good.status) & BOUND).any()


@every_form
def test_float32_keeps_the_covariance_of_a_linear_map_far_from_the_origin(form):
    rng = np.random.default_rng(6)
    A = rng.normal(size=(4, 4))
    F, P0 = rng.normal(size=(4, 4)), A @ A.T
    m0 = 100 + rng.normal(size=4)
    arrays = [np.asarray(x, np.float32) for x in (F, np.eye(2, 4), np.zeros((4, 4)), np.eye(2), m0, P0)]
    model = jf.models.linear_gaussian(*arrays)
    want = F @ P0 @ F.T
    ys = np.zeros((1, 2), np.float32)

    def error(**options):
        out = jf.filter(UNSCENTED[form](model, **options), ys, outputs=jf.everything)
        assert out.cov.dtype == jnp.float32
        return np.abs(np.asarray(out.prediction.cov[0], float) - want).max() / np.abs(want).max()

    assert error() < 1e-5
    with pytest.warns(UserWarning, match="alpha: with 0.01 < 0.1 a covariance loses its digits in float32"):
        assert error(alpha=0.01) > 1e-4


def test_float32_is_close_to_float64():
    outs = []
    for dtype in (jnp.float32, jnp.float64):
        model, ys, mask = scene(dtype)
        outs.append(jf.filter(jf.sqrt_unscented(model), ys, mask=mask))
    close(outs[0].mean, outs[1].mean, 1e-4)
    close(outs[0].cov, outs[1].cov, 1e-4)


FACTORIES = {
    "unscented": lambda model: jf.unscented(model, alpha=0.5),
    "sqrt_unscented": jf.sqrt_unscented,
    "cubature": jf.cubature,
}


@pytest.mark.parametrize("name", FACTORIES)
def test_turning_the_scene_changes_nothing(name):
    """With the states' axes turned along, through the line where bearings jump: equal to rounding."""
    errors = [flight(FACTORIES[name], angle, frame="bearing") for angle in ANGLES]
    assert np.abs(np.array(errors) - errors[0]).max() < 1e-9
    assert 0.05 < np.sqrt(np.mean(errors[0] ** 2)) < 2


def test_turning_the_axes_too_changes_only_which_root_is_drawn_from():
    """Turned axes give P another Cholesky root: the points differ, their moments to third order do not.

    Half a turn has the same root. Otherwise the RMSE moves, by 1.2 % for this wide prior.
    """
    rmse = [np.sqrt(np.mean(flight(jf.unscented, angle) ** 2)) for angle in (0.0, *ANGLES)]
    assert np.abs(np.array(rmse) / rmse[0] - 1).max() < 0.02
    assert abs(rmse[1] - rmse[0]) < 1e-9


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"alpha": 0.0}, ValueError, "alpha: expected a finite value > 0"),
        ({"alpha": np.nan}, ValueError, "alpha: expected a finite value > 0"),
        ({"kappa": -3.0}, ValueError, r"kappa: expected n \+ kappa > 0 with n = 3"),
        ({"beta": np.float32(2)}, TypeError, "beta is float32"),
    ],
    ids=str,
)
def test_bad_parameters_are_refused(options, error, message):
    for factory in UNSCENTED.values():
        with pytest.raises(error, match=message):
            factory(linear_case()[0], **options)


def test_gradients_reach_the_spread():
    """Of the likelihood with respect to alpha, beta and kappa, against differences."""
    model = jf.models.nonlinear(same, length_squared, 0.1 * np.eye(2), 5 * np.eye(2), np.array([0.5, -1]), np.eye(2))
    ys = np.array([[3.0, 1.0], [2.0, 0.5], [4.0, 0.7]])

    @jax.jit
    @jax.value_and_grad
    def total(v):
        filt = jf.unscented(model, alpha=v[0], beta=v[1], kappa=v[2])
        return jf.filter(filt, ys).log_lik.sum()

    for v in ((0.9, 2.0, 0.3), (1.0, 0.1, -1.5)):
        v, h = jnp.array(v), 1e-5
        numeric = [(total(v.at[i].add(h))[0] - total(v.at[i].add(-h))[0]) / (2 * h) for i in range(3)]
        np.testing.assert_allclose(total(v)[1], numeric, rtol=1e-5, atol=1e-7)
