"""Particle filters: unbiased likelihood and moments beside the Kalman filter's, and what they survive."""

from __future__ import annotations

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from tests.examples import GAP, LINEAR

module = importlib.import_module("jaxfilt.filters.particle")  # the name is the factory's in the package
MODEL = jf.models.linear_gaussian(**LINEAR)
T, RUNS = 10, 400
YS = jnp.asarray(np.random.default_rng(7).normal(size=(T, 2)) + np.linspace(0, 2, T)[:, None])
MASK = GAP["mask"][2:]
KEYS = jax.random.split(jax.random.key(0), RUNS)
FORMS = {
    "bootstrap": {},
    "stratified": {"resampling": "stratified"},
    "multinomial": {"resampling": "multinomial", "threshold": 1.0},
    "residual": {"resampling": "residual"},
    "guided": {"guide": jf.extended},
    "auxiliary": {"auxiliary": True},
}


_FIRST = ("bootstrap", "guided")


def runs(filt, ys=YS, mask=MASK):
    """The same series with many keys."""
    return jax.jit(jax.vmap(lambda key: jf.filter(filt, ys, mask=mask, key=key)))(KEYS)


def deviation(out, exact):
    """Of the likelihood estimate's mean from the exact one, in standard errors."""
    ratio = np.exp(np.asarray(out.log_lik.sum(axis=1) - exact.log_lik.sum()))
    return (ratio.mean() - 1) / (ratio.std(ddof=1) / np.sqrt(len(ratio)))


@pytest.fixture(scope="module")
def exact():
    return jf.filter(jf.kalman(MODEL), YS, mask=MASK)


@pytest.mark.parametrize(
    "name",
    ["bootstrap", "guided", *(pytest.param(name, marks=pytest.mark.slow) for name in FORMS if name not in _FIRST)],
)
def test_likelihood_is_unbiased_and_moments_are_the_kalman_filters(name, exact):
    out = runs(jf.particle(MODEL, 300, **FORMS[name]))
    assert abs(deviation(out, exact)) <= 3.5
    for found, expected in ((out.mean, exact.mean), (out.cov, exact.cov)):
        found = np.asarray(found)
        error = found.mean(axis=0) - np.asarray(expected)
        bias = 6 * np.abs(np.asarray(exact.cov)).max() / 300  # of a ratio of two estimates, of order 1 / N
        assert (np.abs(error) <= 4.5 * found.std(axis=0) / np.sqrt(RUNS) + bias).all()


def test_the_check_can_fail(exact, monkeypatch):
    """Weights that are squared by mistake do not pass it."""
    right = module._log_likelihood

    def squared(*args):
        log_lik, status = right(*args)
        return 2 * log_lik, status

    monkeypatch.setattr(module, "_log_likelihood", squared)
    jax.clear_caches()
    try:
        assert abs(deviation(runs(jf.particle(MODEL, 299)), exact)) > 10
    finally:
        jax.clear_caches()


@pytest.mark.slow
def test_looking_ahead_pays_with_a_precise_sensor():
    """R a hundredth: the guided filter's estimate of the log-likelihood varies far less."""
    sharp = jf.models.linear_gaussian(**{**LINEAR, "R": LINEAR["R"] / 100})
    spread = {}
    for name in ("bootstrap", "guided"):
        spread[name] = float(jnp.std(runs(jf.particle(sharp, 100, **FORMS[name]), mask=None).log_lik.sum(axis=1)))
    assert spread["guided"] < 0.4 * spread["bootstrap"]


def test_missed_samples_say_nothing():
    out = runs(jf.particle(MODEL, 50))
    missed = ~MASK.any(axis=1)
    assert (np.asarray(out.log_lik)[:, missed] == 0).all()
    assert ((np.asarray(out.status) & int(jf.Status.MISSED)) != 0).any(axis=0).tolist() == missed.tolist()
    np.testing.assert_allclose(np.asarray(out.cov)[:, missed].mean(axis=0)[0, 0, 0],
                               jf.filter(jf.kalman(MODEL), YS, mask=MASK).cov[missed][0, 0, 0], rtol=0.1)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
def test_survives_underflow_domination_and_a_single_particle(dtype):
    model = jax.tree.map(lambda x: x.astype(dtype), MODEL)
    far = jnp.asarray(YS, dtype).at[4].set(1e4).at[6].set(jnp.finfo(dtype).max / 8)
    for count in (1, 100):
        for name in ("bootstrap", "guided", "auxiliary") if dtype == jnp.float32 else ("guided",):
            out = jf.filter(jf.particle(model, count, **FORMS[name], keep=True), far, key=jax.random.key(0))
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((out.mean, out.cov, out.log_lik, out.extra)))
            bits = np.asarray(out.status)
            assert (bits[6] & int(jf.Status.NONFINITE)) != 0  # no particle has a finite likelihood
            assert (bits[5] & int(jf.Status.NONFINITE)) == 0
            np.testing.assert_allclose(np.exp(out.extra["log_weights"]).sum(axis=1), 1.0, rtol=1e-4)
    assert out.extra["particles"].shape == (T, 100, 3)


@pytest.mark.slow
def test_bearings_do_not_mind_where_the_angle_wraps():
    """The same scene turned by half a circle, with particles on both sides of pi."""
    motion = jf.models.constant_velocity(dt=1.0, q=0.01, r=1.0, m0=[5.0, 0.0, 0.0, 0.1], P0=np.eye(4) * 0.3)
    turned = motion._replace(m0=-motion.m0)
    sensor = jf.models.sensors.bearing(np.array([[0.01]]))
    angles = 0.02 * jnp.arange(8.0)[:, None] - 0.05
    found = []
    for model, ys in ((motion, angles), (turned, jf.models.sensors.wrap(angles + np.pi))):
        filt = jf.particle(jf.models.with_sensor(model, sensor), 500)
        found.append(jax.vmap(lambda k, f=filt, y=ys: jf.filter(f, y, key=k))(KEYS[:20]))
    bearing = [
        np.arctan2(sign * out.mean[..., 1], sign * out.mean[..., 0]) for sign, out in zip((1, -1), found, strict=True)
    ]
    np.testing.assert_allclose(bearing[0].mean(axis=0), bearing[1].mean(axis=0), atol=0.01)
    np.testing.assert_allclose(found[0].nis.mean(axis=0), found[1].nis.mean(axis=0), rtol=0.2, atol=0.05)
    np.testing.assert_allclose(found[0].log_lik.mean(), found[1].log_lik.mean(), atol=0.1)


def _noise(x, u, dt):
    del u, dt
    return jnp.diag(0.1 + 0.2 * jnp.abs(x))


@pytest.mark.slow
def test_state_dependent_process_noise():
    """Each particle draws its own; the prediction's covariance is the mean's."""
    F = LINEAR["F"]
    model = jf.models.as_nonlinear(MODEL)._replace(Q=jax.tree_util.Partial(_noise))
    out = jf.filter(jf.particle(model, 4000), YS[:1], key=jax.random.key(0), outputs=jf.everything)
    draws = np.random.default_rng(0).multivariate_normal(LINEAR["m0"], LINEAR["P0"], 200_000)
    expected = F @ LINEAR["P0"] @ F.T + np.diag(0.1 + 0.2 * np.abs(draws).mean(axis=0))
    assert out.prediction is not None
    np.testing.assert_allclose(out.prediction.cov[0], expected, atol=0.15)


@pytest.mark.slow
def test_gradient_is_that_of_the_same_draws():
    """Without resampling the estimate is a smooth function; its slope is exact, and near the Kalman filter's."""

    def value(scale, key):
        model = jf.models.linear_gaussian(**{**LINEAR, "R": scale * LINEAR["R"]})
        return jf.filter(jf.particle(model, 2000, threshold=0.0), YS[:4], key=key).log_lik.sum()

    at, h = jnp.asarray(1.3), 1e-4
    slopes = jax.jit(jax.vmap(jax.grad(value), (None, 0)))(at, KEYS[:8])
    difference = (value(at + h, KEYS[0]) - value(at - h, KEYS[0])) / (2 * h)
    np.testing.assert_allclose(slopes[0], difference, rtol=1e-6)

    def kalman(scale):
        model = jf.models.linear_gaussian(**{**LINEAR, "R": scale * LINEAR["R"]})
        return jf.filter(jf.kalman(model), YS[:4]).log_lik.sum()

    assert abs(slopes.mean() - jax.grad(kalman)(at)) <= 4.5 * slopes.std() / np.sqrt(7) + 0.02


def test_the_score_correction_changes_no_bit_of_the_estimate():
    found = [jf.filter(jf.particle(MODEL, 50, gradient=name, keep=True), YS, mask=MASK, key=KEYS[0])
             for name in ("none", "score")]  # fmt: skip
    for a, b in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_array_equal(a, b)
    ancestors = np.asarray(found[0].extra["ancestors"])
    assert (np.diff(ancestors, axis=1) >= 0).all()
    assert (ancestors != np.arange(50)).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "unbiased"),
    [
        ({"gradient": "score"}, True),
        ({"gradient": "full_score"}, True),
        ({"gradient": "score", "guide": jf.extended}, True),
        ({"gradient": "full_score", "guide": jf.extended}, True),
        ({"gradient": "score", "auxiliary": True}, True),
        ({"gradient": "none"}, False),
        ({"gradient": "none", "auxiliary": True}, False),
        ({"gradient": "soft"}, False),
    ],
)
def test_gradient_of_the_likelihood_estimate(options, unbiased):
    """Beside the Kalman filter's: unbiased with the score correction, and biased without, by the same check."""

    def value(theta, key, filt):
        model = jf.models.linear_gaussian(
            **{**LINEAR, "R": jnp.exp(theta[0]) * LINEAR["R"], "Q": jnp.exp(theta[1]) * LINEAR["Q"]}
        )
        out = jf.filter(filt(model), YS[:6], mask=jnp.ones((6, 2), bool).at[3].set(False), key=key)
        return out.log_lik.sum()

    theta = jnp.array([0.3, -0.2])
    exact, slope = jax.value_and_grad(value)(theta, None, jf.kalman)

    def one(theta, key):
        particles = lambda m: jf.particle(m, 50, resampling="multinomial", threshold=1.0, **options)  # noqa: E731
        return jnp.exp(value(theta, key, particles) - exact)

    keys = jax.random.split(jax.random.key(2), 6000)
    found = np.asarray(jax.jit(lambda keys: jax.lax.map(lambda k: jax.grad(one)(theta, k), keys, batch_size=500))(keys))
    deviation = np.abs(found.mean(axis=0) - np.asarray(slope)) / (found.std(axis=0) / np.sqrt(len(keys)))
    assert (deviation <= 4).all() if unbiased else (deviation > 6).any()


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
@pytest.mark.parametrize("gradient", ["score", "full_score", "soft", "transport"])
def test_gradients_survive_underflow_and_a_single_particle(gradient, dtype):
    model = jax.tree.map(lambda x: x.astype(dtype), MODEL)
    far = jnp.asarray(YS, dtype).at[4].set(1e4)

    def value(scale, count):
        filt = jf.particle(model._replace(R=scale * model.R), count, threshold=1.0, gradient=gradient, sweeps=10)
        return jf.filter(filt, far, key=jax.random.key(0)).log_lik.sum()

    for count in (1, 30):
        assert all(np.isfinite(x) for x in jax.value_and_grad(value)(jnp.asarray(1.0, dtype), count))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jf.particle(MODEL, 0), "count: expected a whole number of particles >= 1"),
        (lambda: jf.particle(MODEL, 2.5), "count: expected a whole number"),  # pyright: ignore[reportArgumentType]
        (lambda: jf.particle(MODEL, 5, resampling="none"), "resampling: expected one of"),
        (lambda: jf.particle(MODEL, 5, guide=jf.extended, auxiliary=True), "guide: not together with auxiliary"),
        (lambda: jf.particle(MODEL, 5, gradient="exact"), "gradient: expected one of score, full_score, none"),
        (lambda: jf.particle(MODEL, 5, gradient="soft", auxiliary=True), "gradient: 'soft' is another way"),
        (lambda: jf.particle(MODEL, 5, gradient="soft", alpha=0.0), "alpha: expected a finite value > 0"),
        (lambda: jf.particle(MODEL, 5, gradient="soft", alpha=1.1), "1 - alpha: expected"),
        (lambda: jf.particle(MODEL, 5, gradient="transport", epsilon=0.0), "epsilon: expected a finite value > 0"),
        (lambda: jf.particle(MODEL, 5, gradient="transport", sweeps=0), "sweeps: expected a whole number"),
        (lambda: jf.particle(MODEL, 5, threshold=1.5), "threshold: expected"),
        (lambda: jf.particle(MODEL, 5, threshold=-0.1), "threshold: expected"),
        (lambda: jf.filter(jf.particle(MODEL, 5), YS), "key: a particle filter draws random numbers"),
    ],
)
def test_bad_arguments_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
