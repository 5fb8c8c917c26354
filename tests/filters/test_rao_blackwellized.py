"""The Rao-Blackwellized particle filter beside all histories of modes of a short series, and its limits."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from tests.examples import LINEAR

T, RUNS = 5, 200
KEYS = jax.random.split(jax.random.key(0), RUNS)
PI = np.array([[0.8, 0.2], [0.3, 0.7]])
MU0 = np.array([0.75, 0.25])
MODELS = [
    jf.models.linear_gaussian(**LINEAR),
    jf.models.linear_gaussian(**{**LINEAR, "F": -0.8 * LINEAR["F"], "Q": 4 * LINEAR["Q"], "R": 0.5 * LINEAR["R"]}),
]
YS = jnp.asarray(np.random.default_rng(3).normal(size=(T, 2)) + np.array([[1.0, -1.0]]))
MASK = jnp.ones((T, 2), bool).at[2].set(False).at[3, 0].set(False)


def bank(**options):
    return jf.rao_blackwellized(tuple(map(jf.kalman, MODELS)), PI, 40, mu0=MU0, **options)


class Exact:
    """By the Kalman filter along each of the 2^(T + 1) histories of modes."""

    def __init__(self):
        log_weights, means, covs, last = [], [], [], []
        step = jax.jit(jf.step)
        inputs = jf.inputs(YS, mask=MASK)
        filters = [jf.kalman(model) for model in MODELS]
        steps = [jax.tree.map(lambda leaf, k=k: leaf[k], inputs) for k in range(T)]
        for history in itertools.product((0, 1), repeat=T + 1):
            state, log_weight = filters[0].init(steps[0]), np.log(MU0[history[0]])
            for before, mode, inp in zip(history, history[1:], steps, strict=False):
                state, info = step(filters[mode], state, inp)
                log_weight += np.log(PI[before, mode]) + float(info.log_lik)
            log_weights.append(log_weight)
            means.append(info.mean)
            covs.append(info.cov)
            last.append(history[-1])
        log_weights, means = np.array(log_weights), np.array(means)
        self.log_lik = float(np.logaddexp.reduce(log_weights))
        weights = np.exp(log_weights - self.log_lik)
        self.mean = weights @ means
        apart = means - self.mean
        self.cov = np.einsum("i,iab->ab", weights, np.array(covs) + apart[:, :, None] * apart[:, None, :])
        self.mode = weights @ np.array(last)


@pytest.fixture(scope="module")
def exact():
    return Exact()


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"proposal": "prior", "resampling": "multinomial", "threshold": 1.0}, marks=pytest.mark.slow),
        pytest.param({"threshold": 1.0, "resampling": "stratified"}, marks=pytest.mark.slow),
    ],
    ids=["optimal", "prior", "every step"],
)
def test_likelihood_is_unbiased_and_moments_are_those_of_all_histories(options, exact):
    out = jax.jit(jax.vmap(lambda key: jf.filter(bank(**options), YS, mask=MASK, key=key)))(KEYS)
    ratio = np.exp(np.asarray(out.log_lik.sum(axis=1)) - exact.log_lik)
    assert abs(ratio.mean() - 1) <= 3.5 * ratio.std(ddof=1) / np.sqrt(RUNS)
    assert ratio.std() > 1e-3
    for found, expected in (
        (out.mean[:, -1], exact.mean),
        (out.cov[:, -1], exact.cov),
        (out.extra["mode_probabilities"][:, -1, 1], exact.mode),
    ):
        found = np.asarray(found)
        bias = 3 * np.abs(exact.cov).max() / 40  # of a ratio of two estimates, of order 1 / N
        error = np.abs(found.mean(axis=0) - expected)
        assert (error <= 4.5 * found.std(axis=0) / np.sqrt(RUNS) + bias * 0.1).all()


def test_the_first_step_is_exact():
    """N mu0 is whole, so each mode starts with its share, and the first step's moments come before any draw."""
    out = jf.filter(bank(keep=True), YS, mask=MASK, key=KEYS[0], outputs=jf.everything)
    first = jf.filter(jf.imm(tuple(map(jf.kalman, MODELS)), PI, mu0=MU0), YS, mask=MASK)
    for name in ("mean", "cov", "log_lik", "innovation", "innovation_cov", "nis", "noise_cov"):
        np.testing.assert_allclose(getattr(out, name)[0], getattr(first, name)[0], rtol=1e-10, err_msg=name)
    np.testing.assert_allclose(out.extra["mode_probabilities"][0], first.extra["mode_probabilities"][0], rtol=1e-10)
    assert out.prediction is not None
    for a, b in ((out.mean, out.prediction.mean), (out.cov, out.prediction.cov)):  # in the missed step
        np.testing.assert_allclose(a[2], b[2], rtol=1e-13, atol=1e-14)
    assert out.log_lik[2] == 0
    assert out.extra["modes"].shape == out.extra["ancestors"].shape == out.extra["log_weights"].shape == (T, 40)


def test_with_equal_modes_it_is_the_kalman_filter():
    equal = jf.rao_blackwellized((jf.kalman(MODELS[0]),) * 2, PI, 40, mu0=MU0, keep=True)
    check_kalman(jf.filter(equal, YS, mask=MASK, key=KEYS[0], outputs=jf.everything))


@pytest.mark.slow
def test_with_one_mode_it_is_the_kalman_filter():
    check_kalman(jf.filter(jf.rao_blackwellized((jf.kalman(MODELS[0]),), [[1.0]], 7), YS, mask=MASK, key=KEYS[0]))


def check_kalman(out):
    kalman = jf.filter(jf.kalman(MODELS[0]), YS, mask=MASK)
    for name in ("mean", "cov", "log_lik", "innovation", "innovation_cov"):
        np.testing.assert_allclose(getattr(out, name), getattr(kalman, name), rtol=1e-10, atol=1e-12, err_msg=name)


@pytest.mark.slow
def test_filters_of_different_kinds_are_run_one_by_one():
    """The square-root filter is the same filter, so the same draws give the same result."""
    mixed = jf.rao_blackwellized((jf.kalman(MODELS[0]), jf.sqrt_kalman(MODELS[1])), PI, 40, mu0=MU0)
    found = jf.filter(mixed, YS, mask=MASK, key=KEYS[0])
    expected = jf.filter(bank(), YS, mask=MASK, key=KEYS[0])
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-8)
    np.testing.assert_allclose(found.log_lik, expected.log_lik, rtol=1e-8)


@pytest.mark.slow
def test_gradient_has_the_score_correction():
    """Of the likelihood estimate by a transition probability and a noise level, beside differences of the exact one."""

    def value(theta, key):
        models = [MODELS[0], MODELS[1]._replace(Q=4 * jnp.exp(theta[0]) * LINEAR["Q"])]
        stay = jax.nn.sigmoid(theta[1])
        transition = jnp.stack([jnp.stack([stay, 1 - stay]), jnp.asarray(PI[1])])
        filt = jf.rao_blackwellized(
            tuple(map(jf.kalman, models)), transition, 20, mu0=MU0, resampling="multinomial", threshold=1.0
        )
        return jnp.exp(jf.filter(filt, YS, mask=MASK, key=key).log_lik.sum())

    theta = jnp.array([0.0, np.log(4.0)])
    keys = jax.random.split(jax.random.key(1), 2000)
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(value), (None, 0)))(theta, keys)
    slopes, h = np.asarray(slopes), 0.05
    differences = []
    for i in range(2):
        shift = h * jnp.eye(2)[i]
        up, down = (jax.jit(jax.vmap(value, (None, 0)))(theta + s, keys) for s in (shift, -shift))
        differences.append(np.asarray((up - down) / (2 * h)))
    for i in range(2):
        error = slopes[:, i].mean() - differences[i].mean()
        assert abs(error) <= 4 * np.hypot(slopes[:, i].std(), differences[i].std()) / np.sqrt(len(keys))
        assert abs(slopes[:, i].mean()) > 4 * slopes[:, i].std() / np.sqrt(len(keys))
    assert np.isfinite(values).all()


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
def test_survives_impossible_samples_and_a_single_particle(dtype):
    models = [jax.tree.map(lambda x: x.astype(dtype), model) for model in MODELS]
    far = jnp.asarray(YS, dtype).at[1].set(1e4).at[3].set(jnp.finfo(dtype).max / 8)
    filt = jf.rao_blackwellized(tuple(map(jf.kalman, models)), PI.astype(dtype), 1, mu0=MU0.astype(dtype), keep=True)
    out = jf.filter(filt, far, key=KEYS[0])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((out.log_lik, out.extra)))
    assert (out.status[3] & int(jf.Status.NONFINITE)) != 0
    assert (out.status[1] & int(jf.Status.NONFINITE)) == 0
    np.testing.assert_allclose(out.extra["mode_probabilities"].sum(axis=1), 1.0, rtol=1e-5)
    assert out.extra["modes"].shape == (T, 1)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: jf.rao_blackwellized(jf.kalman(MODELS[0]), [[1.0]], 5), TypeError, "filters: expected a tuple"),
        (lambda: jf.rao_blackwellized((jf.particle(MODELS[0], 5),), [[1.0]], 5), ValueError, r"filters\[0\]: has no"),
        (lambda: jf.rao_blackwellized((jf.kalman(MODELS[0]),), [[1.0]], 0), ValueError, "count: expected a whole"),
        (lambda: jf.rao_blackwellized((jf.kalman(MODELS[0]),), [[0.9]], 5), ValueError, "transition: expected rows"),
        (lambda: bank(proposal="best"), ValueError, "proposal: expected one of optimal, prior"),
        (lambda: bank(resampling="none"), ValueError, "resampling: expected one of"),
        (lambda: bank(threshold=2.0), ValueError, "threshold: expected|1 - threshold: expected"),
        (lambda: jf.filter(bank(), YS), ValueError, "key: a particle filter draws random numbers"),
    ],
)
def test_bad_arguments_are_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()
