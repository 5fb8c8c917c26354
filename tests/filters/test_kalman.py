"""The covariance and square-root Kalman filters against references that share no code with them."""

from __future__ import annotations

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxfilt as jf
from tests import reference

FORMS = {"kalman": jf.kalman, "sqrt_kalman": jf.sqrt_kalman}
every_form = pytest.mark.parametrize("form", FORMS)
SIZES = [(1, 1), (2, 1), (3, 2), (4, 2), (6, 3), (2, 3)]


def random_case(seed, n, m, T=12, scale=1.0):
    rng = np.random.default_rng(seed)
    matrices = reference.random_model(rng, n, m, scale=scale)
    return matrices, np.sqrt(scale) * rng.normal(size=(T, m)) * 2, rng.random((T, m)) < 0.7


def close(a, b, tol):
    np.testing.assert_allclose(np.asarray(a), b, rtol=0, atol=tol * np.abs(b).max())


@every_form
@pytest.mark.parametrize(("n", "m"), SIZES)
def test_equals_the_naive_filter_with_partial_masks(form, n, m):
    matrices, ys, mask = random_case(n + 10 * m, n, m)
    for first in (False, True):
        means, covs, log_lik = reference.kalman(*matrices, ys, mask, first)
        out = jf.filter(FORMS[form](jf.models.linear_gaussian(*matrices)), ys, mask=mask, first_update_only=first)
        close(out.mean, means, 1e-10)
        close(out.cov, covs, 1e-10)
        close(out.log_lik, log_lik, 1e-10)


@every_form
@pytest.mark.parametrize(("n", "m"), SIZES)
def test_equals_the_dense_joint_gaussian(form, n, m):
    """Filtered and smoothed moments and likelihood, partial masks, from one big solve."""
    matrices, ys, mask = random_case(n + 20 * m, n, m, T=8)
    filtered, smoothed, log_lik = reference.joint_gaussian(*matrices, ys, mask)
    filt = FORMS[form](jf.models.linear_gaussian(*matrices))
    out = jf.filter(filt, ys, mask=mask)
    close(out.mean, filtered[0], 1e-10)
    close(out.cov, filtered[1], 1e-10)
    close(out.log_lik.sum(), log_lik, 1e-10)
    smooth = jf.smooth(filt, ys, mask=mask)
    close(smooth.mean, smoothed[0], 1e-9)
    close(smooth.cov, smoothed[1], 1e-9)


@every_form
def test_correlated_noise_equals_the_dense_joint_gaussian(form):
    matrices, ys, mask = random_case(3, 3, 2, T=8)
    F, H, Q, R, m0, P0 = matrices
    # A joint covariance of (w, v) that is positive definite by construction.
    A = np.random.default_rng(4).normal(size=(5, 5))
    joint = A @ A.T + 0.1 * np.eye(5)
    Q, R, S = joint[:3, :3], joint[3:, 3:], joint[:3, 3:]
    filt = FORMS[form](jf.models.linear_gaussian(F, H, Q, R, m0, P0, S=S))
    for masked in (None, mask):
        filtered, smoothed, log_lik = reference.joint_gaussian(F, H, Q, R, m0, P0, ys, masked, S=S)
        out = jf.filter(filt, ys, mask=masked)
        close(out.mean, filtered[0], 1e-10)
        close(out.cov, filtered[1], 1e-10)
        close(out.log_lik.sum(), log_lik, 1e-10)
        smooth = jf.smooth(filt, ys, mask=masked)
        close(smooth.mean, smoothed[0], 1e-9)
        close(smooth.cov, smoothed[1], 1e-9)


@every_form
def test_zero_correlation_is_no_correlation(form):
    matrices, ys, _ = random_case(5, 3, 2)
    plain = jf.filter(FORMS[form](jf.models.linear_gaussian(*matrices)), ys)
    zero = jf.filter(FORMS[form](jf.models.linear_gaussian(*matrices, S=np.zeros((3, 2)))), ys)
    close(zero.mean, np.asarray(plain.mean), 1e-12)
    close(zero.cov, np.asarray(plain.cov), 1e-12)


def _transition(u, dt):
    return u["F"]


def _noise(u, dt):
    return u["Q"]


@every_form
def test_time_varying_model_travels_in_u(form):
    rng = np.random.default_rng(8)
    (F, H, Q, R, m0, P0), ys, mask = random_case(8, 3, 2, T=8)
    Fs = F + 0.2 * rng.normal(size=(8, 3, 3))
    Qs = Q * rng.uniform(0.5, 2, size=(8, 1, 1))
    filtered, smoothed, log_lik = reference.joint_gaussian(Fs, H, Qs, R, m0, P0, ys, mask)
    filt = FORMS[form](jf.models.linear_gaussian(_transition, H, _noise, R, m0, P0))
    out = jf.filter(filt, ys, mask=mask, u={"F": Fs, "Q": Qs})
    close(out.mean, filtered[0], 1e-10)
    close(out.log_lik.sum(), log_lik, 1e-10)
    close(jf.smooth(filt, ys, mask=mask, u={"F": Fs, "Q": Qs}).cov, smoothed[1], 1e-9)


@every_form
def test_known_inputs_shift_the_mean_only(form):
    """With inputs B u and D u, the filter of x minus the response to u is the filter without inputs."""
    rng = np.random.default_rng(9)
    matrices, ys, _ = random_case(9, 3, 2)
    F, H = matrices[:2]
    B, D, u = rng.normal(size=(3, 2)), rng.normal(size=(2, 2)), rng.normal(size=(len(ys), 2))
    response = np.zeros(3)
    responses = []
    for k in range(len(ys)):
        response = F @ response + B @ u[k]
        responses.append(response)
    responses = np.array(responses)
    plain = jf.filter(FORMS[form](jf.models.linear_gaussian(*matrices)), ys)
    filt = FORMS[form](jf.models.linear_gaussian(*matrices, B=B, D=D))
    out = jf.filter(filt, ys + responses @ H.T + u @ D.T, u=u)
    close(out.mean, np.asarray(plain.mean) + responses, 1e-11)
    close(out.cov, np.asarray(plain.cov), 1e-13)
    with pytest.raises(ValueError, match="u: the model has an input matrix B"):
        jf.filter(filt, ys)


@every_form
def test_irregular_intervals_equal_a_fine_grid_with_gaps(form):
    """Skipping samples of a fine grid equals one filter with the longer intervals."""
    m0, P0 = np.array([0.0, 1.0]), np.diag([4.0, 1.0])
    filt = FORMS[form](jf.models.constant_velocity(dt=0.5, q=0.3, r=2.0, m0=m0, P0=P0))
    rng = np.random.default_rng(0)
    fine = rng.normal(size=(12, 1))
    kept = np.array([1, 2, 5, 6, 11])
    mask = np.zeros(12, bool)
    mask[kept] = True
    sparse = jf.filter(filt, fine[kept], dt=0.5 * np.diff(np.concatenate([[-1], kept])))
    dense = jf.filter(filt, fine, mask=mask)
    close(sparse.mean, np.asarray(dense.mean)[kept], 1e-12)
    close(sparse.cov, np.asarray(dense.cov)[kept], 1e-12)
    close(sparse.log_lik, np.asarray(dense.log_lik)[kept], 1e-12)


@every_form
def test_masking_rows_equals_dropping_them_gradient_included(form):
    (F, H, Q, R, m0, P0), ys, _ = random_case(11, 3, 3)
    mask = np.ones((len(ys), 3), bool)
    mask[:, 1] = False

    def masked(q, r):
        model = jf.models.linear_gaussian(F, H, q * Q, r * R, m0, P0)
        return jf.filter(FORMS[form](model), ys, mask=mask).log_lik.sum()

    def dropped(q, r):
        keep = np.array([0, 2])
        model = jf.models.linear_gaussian(F, H[keep], q * Q, r * R[np.ix_(keep, keep)], m0, P0)
        return jf.filter(FORMS[form](model), ys[:, keep]).log_lik.sum()

    point = (jnp.asarray(1.3), jnp.asarray(0.7))
    a, b = (jax.value_and_grad(f, argnums=(0, 1))(*point) for f in (masked, dropped))
    np.testing.assert_allclose(a[0], b[0], rtol=1e-12)
    np.testing.assert_allclose(a[1], b[1], rtol=1e-11)


@every_form
def test_noise_scales_scale_the_noise(form):
    (F, H, Q, R, m0, P0), ys, mask = random_case(12, 3, 2)
    filt = FORMS[form](jf.models.linear_gaussian(F, H, Q, R, m0, P0))
    q, r = np.array([0.5, 2.0, 3.0]), np.array([4.0, 0.25])
    T = len(ys)
    out = jf.filter(filt, ys, mask=mask, q_scale=np.tile(q, (T, 1)), r_scale=np.tile(r, (T, 1)))
    scaled = (F, H, np.sqrt(np.outer(q, q)) * Q, np.sqrt(np.outer(r, r)) * R, m0, P0)
    means, covs, log_lik = reference.kalman(*scaled, ys, mask)
    close(out.mean, means, 1e-10)
    close(out.cov, covs, 1e-10)
    close(out.log_lik, log_lik, 1e-10)
    both = jf.filter(filt, ys, q_scale=3.0, r_scale=3.0)
    triple = jf.filter(FORMS[form](jf.models.linear_gaussian(F, H, 3 * Q, 3 * R, m0, P0)), ys)
    close(both.mean, np.asarray(triple.mean), 1e-11)


@every_form
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_singular_innovation_uses_one_of_two_equal_sensors(form, dtype):
    """Two equal perfect sensors (R = 0): the posterior is that of one, and the status says so."""
    P0 = jnp.array([[2.0, 0.3], [0.3, 1.0]], dtype)
    H = jnp.array([[1.0, 0.5], [1.0, 0.5]], dtype)
    eye, zero = jnp.eye(2, dtype=dtype), jnp.zeros((2, 2), dtype)
    ys = jnp.ones((1, 2), dtype)

    def out(rows):
        model = jf.models.linear_gaussian(eye, H[:rows], zero, zero[:rows, :rows], jnp.zeros(2, dtype), P0)
        return jf.filter(FORMS[form](model), ys[:, :rows], first_update_only=True)

    two, one = out(2), out(1)
    tol = 1e-6 if dtype == jnp.float32 else 1e-13
    close(two.mean, np.asarray(one.mean), tol)
    close(two.cov, np.asarray(one.cov), tol)
    assert two.status[0] == jf.Status.SINGULAR
    assert one.status[0] == 0


@pytest.mark.parametrize(("dtype", "goal"), [(jnp.float32, 1e-3), (jnp.float64, 1e-8)])
def test_square_root_survives_dyer_mcreynolds(dtype, goal):
    """P = I, H = [1 1 1; 1 1 1+d], R = d^2 I with d = sqrt(eps), where Joseph's S is singular to working precision."""
    d = dtype(np.sqrt(jnp.finfo(dtype).eps))
    H = jnp.array([[1, 1, 1], [1, 1, 1 + d]], dtype)
    eye = jnp.eye(3, dtype=dtype)
    model = jf.models.linear_gaussian(eye, H, 0 * eye, d * d * jnp.eye(2, dtype=dtype), jnp.zeros(3, dtype), eye)
    Hx = [[round(float(x) * 2**60) for x in row] for row in np.asarray(H, float)]
    out = jf.filter(jf.sqrt_kalman(model), jnp.ones((1, 2), dtype), first_update_only=True)
    exact = _exact_posterior(Hx, float(d * d))
    error = np.linalg.norm(np.asarray(out.cov[0], float) - exact) / np.linalg.norm(exact)
    assert error <= goal
    assert out.status[0] == 0
    joseph = jf.filter(jf.kalman(model), jnp.ones((1, 2), dtype), first_update_only=True)
    assert joseph.status[0] == jf.Status.SINGULAR  # told, not hidden
    assert np.isfinite(joseph.cov).all()


def _exact_posterior(H_scaled, r):
    from fractions import Fraction

    H = [[Fraction(x, 2**60) for x in row] for row in H_scaled]
    r = Fraction(r)
    S = [
        [sum(a * b for a, b in zip(H[i], H[j], strict=True)) + (r if i == j else 0) for j in range(2)] for i in range(2)
    ]
    det = S[0][0] * S[1][1] - S[0][1] * S[1][0]
    inverse = [[S[1][1] / det, -S[0][1] / det], [-S[1][0] / det, S[0][0] / det]]
    return np.array(
        [
            [
                float((i == j) - sum(H[a][i] * inverse[a][b] * H[b][j] for a in range(2) for b in range(2)))
                for j in range(3)
            ]
            for i in range(3)
        ]
    )


@every_form
@pytest.mark.parametrize("exponent", [-12, -6, 6, 12])
def test_units_do_not_matter(form, exponent):
    """State and sensor in other units: nothing changes but the units."""
    (F, H, Q, R, m0, P0), ys, _ = random_case(13, 3, 2)
    base = jf.filter(FORMS[form](jf.models.linear_gaussian(F, H, Q, R, m0, P0)), ys)
    s = 10.0**exponent
    model = jf.models.linear_gaussian(F, H, s**2 * Q, s**2 * R, s * m0, s**2 * P0)
    out = jf.filter(FORMS[form](model), s * ys)
    close(out.mean / s, np.asarray(base.mean), 1e-10)
    close(out.cov / s**2, np.asarray(base.cov), 1e-10)
    close(out.log_lik + 2 * np.log(s), np.asarray(base.log_lik), 1e-10)


def _cv(P0, q, noise="continuous"):
    return jf.models.constant_velocity(dt=1.0, q=q, r=25.0, m0=jnp.array([0.0, 10.0]), P0=P0, noise=noise)


SINGULAR = {
    "P0 = 0": (np.zeros((2, 2)), 0.1, "continuous"),
    "Q = 0": (np.diag([100.0, 25.0]), 0.0, "continuous"),
    "Q of rank 1": (np.diag([100.0, 25.0]), 0.1, "piecewise"),
    "P0 = Q = 0": (np.zeros((2, 2)), 0.0, "continuous"),
}


@functools.partial(jax.jit, static_argnames=("form", "noise"))
def _singular_gradients(p, mask, form, noise):
    """Gradients of the log-likelihood and of the sum of means: compiled once per form, noise and dtype."""
    dtype = p["m0"].dtype
    ys = 10.0 * jnp.arange(1, 13, dtype=dtype)[:, None] + jax.random.normal(jax.random.key(0), (12, 1), dtype)

    def f(p):
        model = jf.models.constant_velocity(dt=p["dt"], q=p["q"], r=p["r"], m0=p["m0"], P0=p["P0"], noise=noise)
        out = jf.filter(FORMS[form](model), ys, mask=mask)
        return jnp.stack([out.log_lik.sum(), jnp.sum(out.mean)])

    def forward_difference(name):
        # One-sided, since q < 0 is no model; fourth order.
        h = 1e-4
        at = jax.vmap(lambda x: f({**p, name: p[name] + x})[0])(h * jnp.arange(5, dtype=dtype))
        return jnp.dot(at, jnp.array([-25, 48, -36, 16, -3], dtype)) / (12 * h)

    return jax.jacrev(f)(p), {name: forward_difference(name) for name in ("q", "r", "dt")}


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("case", SINGULAR)
@pytest.mark.parametrize("masked", [False, True], ids=["all present", "all missed"])
def test_gradients_at_singular_covariances(case, masked, dtype):
    """Finite in every form; for the likelihood of the covariance form equal to one-sided differences too."""
    P0, q, noise = SINGULAR[case]
    p = {"dt": 1.0, "q": q, "r": 25.0, "m0": np.array([0.0, 10.0]), "P0": P0}
    p = jax.tree.map(lambda x: jnp.asarray(x, dtype), p)
    mask = jnp.full((12, 1), not masked)
    for form in FORMS:
        gradient, numeric = _singular_gradients(p, mask, form, noise)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient)), form
        if form == "kalman" and dtype == jnp.float64:
            for name, slope in numeric.items():
                np.testing.assert_allclose(gradient[name][0], slope, rtol=1e-6, atol=1e-6)


def nile():
    path = Path(__file__).parent / "nile.csv"
    return np.loadtxt(path, delimiter=",", skiprows=1)[:, 1:]


def _local_level(eps, eta, dtype=jnp.float64):
    one = jnp.ones((1, 1), dtype)
    return jf.models.linear_gaussian(one, one, eta * one, eps * one, jnp.zeros(1, dtype), 1e9 * one)


@every_form
def test_nile_likelihood_as_published(form):
    """Durbin and Koopman 2012, section 2.10: observations 2..100 under a diffuse start."""
    ys = nile()
    out = jf.filter(FORMS[form](_local_level(15098.5, 1469.18)), ys)
    assert abs(out.log_lik[1:].sum() - -632.5456) < 1e-3


def test_nile_maximum_by_gradient():
    """Newton steps on (log var_eps, log var_eta) from a poor start find the published maximum to 0.1 %."""
    ys = nile()

    @jax.jit
    def nll(z):
        return -jf.filter(jf.kalman(_local_level(jnp.exp(z[0]), jnp.exp(z[1]))), ys).log_lik[1:].sum()

    z = jnp.log(jnp.array([1e4, 1e4]))
    value_and_grad, hessian = jax.jit(jax.value_and_grad(nll)), jax.jit(jax.hessian(nll))
    for _ in range(30):
        _, g = value_and_grad(z)
        eigenvalues, vectors = jnp.linalg.eigh(hessian(z))
        step = vectors @ ((vectors.T @ g) / jnp.maximum(jnp.abs(eigenvalues), 1.0))
        z = z - jnp.clip(step, -1.0, 1.0)
    np.testing.assert_allclose(jnp.exp(z), [15098.5, 1469.18], rtol=1e-3)
    assert abs(nll(z) - 632.5456) < 1e-3


@every_form
def test_without_process_noise_and_prior_it_is_the_line_through_all_past_data(form):
    """Spec 5.8 item 11: Q = 0 and a diffuse prior; coasting extrapolates the least-squares line, variance R l."""
    rng = np.random.default_rng(2)
    T, gap, R = 20, 6, 25.0
    ys = 10.0 * np.arange(T + gap)[:, None] + 5 * rng.normal(size=(T + gap, 1))
    mask = np.arange(T + gap) < T
    model = jf.models.constant_velocity(dt=1.0, q=0.0, r=R, m0=np.array([0.0, 10.0]), P0=1e9 * np.eye(2))
    out = jf.filter(FORMS[form](model), ys, mask=mask, first_update_only=True)
    t = np.arange(T)
    Phi = np.stack([np.ones(T), t], axis=1)
    theta = np.linalg.lstsq(Phi, ys[:T, 0], rcond=None)[0]
    for k in range(T, T + gap):
        phi = np.array([1.0, k])
        leverage = phi @ np.linalg.solve(Phi.T @ Phi, phi)
        np.testing.assert_allclose(out.mean[k, 0], phi @ theta, rtol=1e-7)
        np.testing.assert_allclose(out.cov[k, 0, 0], R * leverage, rtol=1e-7)


@every_form
def test_coasting_standard_deviations_of_the_hand_check(form):
    """Spec 5.8 item 12: scenario G1, exact covariance before and standard deviations inside the gap."""
    filt = FORMS[form](_cv(np.diag([100.0, 25.0]), 0.1))
    out = jf.filter(filt, np.zeros((41, 1)), mask=~np.isin(np.arange(41), np.arange(20, 26)), first_update_only=True)
    P = out.cov[19]
    np.testing.assert_allclose([P[0, 0], P[0, 1], P[1, 1]], [7.48837, 1.32437, 0.517130], rtol=1e-5)
    sigma = np.sqrt(out.cov[20:26, 0, 0])
    np.testing.assert_allclose(sigma, [3.2692, 3.8886, 4.5813, 5.3377, 6.1504, 7.0141], atol=1e-4)
    np.testing.assert_allclose(np.sqrt(np.mean(sigma**2)), 5.2012, atol=1e-4)


def test_covariances_stay_unbatched_under_vmap():
    """One Q, R and mask for all runs: the covariances are computed once, not per run."""
    filt = jf.kalman(_cv(np.diag([100.0, 25.0]), 0.1))
    ys = jax.random.normal(jax.random.key(0), (5, 41, 1))
    mask = ~np.isin(np.arange(41), np.arange(20, 26))

    def run(y):
        out = jf.filter(filt, y, mask=mask)
        return (out.mean, out.log_lik), (out.cov, out.innovation_cov, out.noise_cov)

    (mean, _), (cov, *_) = jax.vmap(run, out_axes=(0, None))(ys)  # refuses a batched covariance
    assert mean.shape == (5, 41, 2)
    assert cov.shape == (41, 2, 2)


def test_a_traced_negative_interval_is_flagged_and_the_estimate_stays_finite():
    filt = jf.kalman(_cv(np.diag([100.0, 25.0]), 0.1))
    out = jax.jit(lambda dt: jf.filter(filt, jnp.ones((3, 1)), dt=dt))(jnp.array([1.0, -1.0, 1.0]))
    assert out.status.tolist() == [0, int(jf.Status.BOUND), 0]
    assert np.isfinite(out.cov).all()
    same = jf.filter(filt, jnp.ones((3, 1)), dt=np.array([1.0, 0.0, 1.0]))
    close(out.mean, np.asarray(same.mean), 1e-13)


def _scaled(p, u, dt):
    return p


def test_model_functions_may_bind_traced_values():
    ys = jnp.ones((4, 1))

    @jax.grad
    def slope(q):
        one = jnp.ones((1, 1))
        model = jf.models.linear_gaussian(one, one, Partial(_scaled, q * one), one, jnp.zeros(1), one)
        return jf.filter(jf.kalman(model), ys).log_lik.sum()

    assert np.isfinite(slope(0.3))
