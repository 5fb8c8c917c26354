"""R from posterior residuals, Q from NIS, and the covariance at the updated state."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from tests import reference
from tests.examples.bearing import _TONE, tone
from tests.examples.nonlinear import linear_case

STEPS = 40
BOUND = int(jf.Status.BOUND)


def heard(seed=0, noise=1.0):
    """The tone of the registry with its measurements."""
    model = tone(jax.tree.map(jnp.asarray, _TONE))
    rng = np.random.default_rng(seed)
    x, ys = model.m0, []
    for _ in range(STEPS):
        x = model.f(x, None, None)
        ys.append(np.asarray(model.h(x, None, None)) + noise * rng.multivariate_normal(np.zeros(2), model.R))
    return model, jnp.asarray(np.array(ys))


def same(a, b, tol):
    for x, y in zip((a.mean, a.cov), (b.mean, b.cov), strict=True):
        np.testing.assert_allclose(x, y, rtol=tol, atol=tol * float(jnp.abs(y).max()))


def test_on_linear_models_the_modified_covariance_is_kalmans():
    model, ys, options = linear_case()
    plain = jf.filter(jf.kalman(model), ys, **options)
    same(jf.filter(jf.extended(model, relinearize=True), ys, **options), plain, 1e-10)
    same(jf.filter(jf.extended(model, order=2), ys, **options), plain, 1e-10)
    same(jf.filter(jf.unscented(model), ys, **options), plain, 1e-10)


def test_the_modified_covariance_is_that_of_the_updated_state():
    model, ys = heard()
    out = jf.filter(jf.extended(model, relinearize=True), ys, outputs=jf.everything)
    plain = jf.filter(jf.extended(model), ys[:1])
    np.testing.assert_allclose(out.mean[0], plain.mean[0], rtol=1e-13)
    P = np.asarray(out.prediction.cov[0])
    H = np.asarray(jax.jacfwd(lambda x: model.h(x, None, None))(out.mean[0]))
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.asarray(model.R))
    np.testing.assert_allclose(out.cov[0], (np.eye(5) - K @ H) @ P, rtol=1e-9, atol=1e-12)
    assert np.abs(np.asarray(out.cov[0] - plain.cov[0])).max() > 1e-6


@pytest.mark.parametrize("build", [
    lambda filt: jf.residual_r(filt, rate=0.0),
    lambda filt: jf.covariance_matching(filt, window=5, rate=0.0),
    lambda filt: jf.nis_q(filt, largest=1.0),
])  # fmt: skip
def test_what_does_not_adapt_leaves_the_filter_alone(build):
    model, ys = heard()
    inner = jf.extended(model, relinearize=True)
    same(jf.filter(build(inner), ys), jf.filter(inner, ys), 1e-12)


def test_residual_r_is_the_printed_recursion():
    """A naive loop, the second component missing now and then."""
    model, ys = heard(noise=2.0)
    mask = np.random.default_rng(3).random((STEPS, 2)) < 0.8
    out = jf.filter(jf.residual_r(jf.extended(model, relinearize=True), rate=0.1, largest=4.0), ys, mask=mask)
    assert model.f_jacobian is not None
    x, P = (np.asarray(a) for a in (model.m0, model.P0))
    F, Q, R0 = (np.asarray(a) for a in (model.f_jacobian(model.m0, None, None), model.Q, model.R))
    scale = np.ones(2)

    def at(x):
        x = jnp.asarray(x)
        return np.asarray(model.h(x, None, None)), np.asarray(jax.jacfwd(lambda x: model.h(x, None, None))(x))

    capped = 0
    for k in range(STEPS):
        x, P = F @ x, F @ P @ F.T + Q
        d = np.sqrt(scale)
        R = d[:, None] * R0 * d
        used = mask[k]
        if used.any():
            y, H = at(x)
            e = np.asarray(ys[k]) - y
            e[0] = (e[0] + np.pi) % (2 * np.pi) - np.pi
            Hu = H[used]
            S = Hu @ P @ Hu.T + R[np.ix_(used, used)]
            prior = P
            x = x + P @ Hu.T @ np.linalg.solve(S, e[used])
            y, H = at(x)
            Hu = H[used]
            K = P @ Hu.T @ np.linalg.inv(Hu @ P @ Hu.T + R[np.ix_(used, used)])
            P = (np.eye(5) - K @ Hu) @ prior
            e = np.asarray(ys[k]) - y
            e[0] = (e[0] + np.pi) % (2 * np.pi) - np.pi
            asked = (e**2 + np.diag(H @ P @ H.T)) / np.diag(R0)
            capped += int((asked > 4)[used].any())
            scale = np.where(used, 0.9 * scale + 0.1 * np.minimum(asked, 4.0), scale)
        np.testing.assert_allclose(out.mean[k], x, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(out.extra["r_scale"][k], scale, rtol=1e-8)
    assert 0 < capped == int(((np.asarray(out.status) & BOUND) != 0).sum())


def test_on_linear_models_it_is_sage_husa_with_a_full_memory():
    model, ys, options = linear_case()
    a = jf.filter(jf.residual_r(jf.kalman(model), rate=0.05, largest=1e6), ys, **options)
    b = jf.filter(jf.sage_husa(jf.kalman(model), forgetting=0.95, prior=20.0, bounds=(1e-6, 1e6)), ys, **options)
    same(a, b, 1e-10)
    np.testing.assert_allclose(a.extra["r_scale"], b.extra["r_scale"], rtol=1e-9)


def test_nis_q_is_a_clipped_mean_over_the_window():
    model = reference_model()
    ys = jnp.asarray(np.random.default_rng(0).normal(size=(STEPS, 2)) * 3)
    mask = np.random.default_rng(1).random((STEPS, 2)) < 0.7
    out = jf.filter(jf.nis_q(jf.kalman(model), window=4, largest=2.0), ys, mask=mask)
    nis, count, reached = [], [], 0
    for k in range(STEPS):
        if mask[k].any():
            nis.insert(0, float(out.nis[k]))
            count.insert(0, mask[k].sum())
        asked = sum(nis[:4]) / max(sum(count[:4]), 1)
        reached += asked > 2.0
        np.testing.assert_allclose(out.extra["q_scale"][k], np.clip(asked, 1, 2), rtol=1e-12)
    assert reached
    assert (np.asarray(out.extra["q_scale"]) == 1).any()


def reference_model():
    return jf.models.linear_gaussian(*reference.random_model(np.random.default_rng(2), 3, 2))


def test_a_wrong_r_is_learned():
    """R told four times too small in one channel and nine times too large in the other."""
    model = reference_model()
    F, H, Q, R, m0, P0 = (np.asarray(getattr(model, n)) for n in ("F", "H", "Q", "R", "m0", "P0"))
    R = np.diag(np.diag(R))
    rng = np.random.default_rng(0)
    x, ys = m0, []
    for _ in range(3000):
        x = F @ x + rng.multivariate_normal(np.zeros(3), 0.01 * Q)
        ys.append(H @ x + rng.multivariate_normal(np.zeros(2), R))
    told = jf.models.linear_gaussian(F, H, 0.01 * Q, R / np.array([4.0, 1 / 9.0]), m0, P0)
    for wrapped in (
        jf.residual_r(jf.kalman(told), rate=0.01),
        jf.covariance_matching(jf.kalman(told), window=25, rate=0.01),
    ):
        scale = np.asarray(jf.filter(wrapped, jnp.asarray(np.array(ys))).extra["r_scale"])[1000:].mean(axis=0)
        np.testing.assert_allclose(scale, [4, 1 / 9], rtol=0.1)


def test_missing_and_refused_samples_teach_nothing():
    model, ys = heard()
    ys = ys.at[5].set(jnp.array([3.0, 900.0])).at[8, 0].set(jnp.nan)
    ys, mask = jf.mask_nan(ys)
    mask = mask.at[11].set(False)
    for adaptive, key in ((jf.residual_r(jf.extended(model)), "r_scale"), (jf.nis_q(jf.extended(model)), "q_scale")):
        out = jf.filter(jf.gated(adaptive), ys, mask=mask)
        scale = np.asarray(out.extra[key])
        assert out.status[5] & int(jf.Status.GATED)
        np.testing.assert_array_equal(scale[5], scale[4])
        np.testing.assert_array_equal(scale[11], scale[10])
        if key == "r_scale":
            assert scale[8, 0] == scale[7, 0]
            assert scale[8, 1] != scale[7, 1]


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda f: jf.residual_r(f, rate=1.0), "rate"),
        (lambda f: jf.residual_r(f, rate=-0.1), "rate"),
        (lambda f: jf.residual_r(f, largest=0.0), "largest"),
        (lambda f: jf.covariance_matching(f, rate=1.1), "rate"),
        (lambda f: jf.covariance_matching(f, window=1), "window"),
        (lambda f: jf.nis_q(f, window=1), "window"),
        (lambda f: jf.nis_q(f, largest=0.5), "largest"),
        (lambda f: jf.extended(tone(jax.tree.map(jnp.asarray, _TONE)), order=2, relinearize=True), "relinearize"),
        (lambda f: jf.filter(jf.residual_r(jf.alpha_beta(dt=1.0, alpha=0.5, beta=0.1)), np.ones((3, 1))), "r_scale"),
        (lambda f: jf.filter(jf.nis_q(jf.alpha_beta(dt=1.0, alpha=0.5, beta=0.1)), np.ones((3, 1))), "q_scale"),
    ],
)
def test_bad_input_is_refused(call, named):
    with pytest.raises(ValueError, match=named):
        call(jf.kalman(reference_model()))
