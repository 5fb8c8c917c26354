"""Backward smoothing of particles beside the Rauch-Tung-Striebel smoother."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf

T, N, RUNS = 12, 200, 40
U = jnp.linspace(-1, 1, T)[:, None]
DT = jnp.array([1.0, 0.5, 2.0, 1.0, 0.2, 1.0, 1.5, 1.0, 0.7, 1.0, 3.0, 1.0])
MASK = jnp.ones((T, 1), bool).at[3].set(False).at[7:9].set(False)
KEYS = jax.random.split(jax.random.key(0), RUNS)


def _transition(u, dt):
    del u
    return jnp.array([[1.0, 0.0], [0.0, 0.9]]) + dt * jnp.array([[0.0, 1.0], [0.0, 0.0]])


def _noise(u, dt):
    del u
    return dt * jnp.array([[0.5, 0.1], [0.1, 0.3]])


def _push(u, dt):
    return dt * jnp.concatenate([jnp.zeros((1,)), u])


MODEL = jf.models.linear_gaussian(
    _transition, [[1.0, 0.0]], _noise, [[1.0]], jnp.array([0.0, 0.5]), jnp.diag(jnp.array([2.0, 1.0])), B=_push
)
YS = jnp.cumsum(0.5 + jax.random.normal(jax.random.key(5), (T, 1)), axis=0)
WITH = {"mask": MASK, "dt": DT, "u": U}
HOW = {
    "marginal": {},
    "paths": {"paths": 300},
    "metropolis": {"paths": 300, "proposals": 10},
}


def smoothed(how, key, scheme="multinomial", threshold=1.0):
    filt = jf.particle(MODEL, N, resampling=scheme, threshold=threshold, keep=True)
    out = jf.filter(filt, YS, key=key, **WITH)
    options = {**how, "key": jax.random.fold_in(key, 9)} if "paths" in how else how
    found = jf.smooth_particles(MODEL, out, dt=DT, u=U, **options)
    return found.mean, found.cov, jnp.exp(found.log_weights).sum(axis=1), out.mean


@pytest.fixture(scope="module")
def exact():
    return jf.smooth(jf.kalman(MODEL), YS, **WITH)


@pytest.mark.parametrize("name", HOW)
def test_smoothed_moments_are_those_of_rts(name, exact):
    """With a gap, varying intervals and inputs; the filter's own mean fails the same check."""
    mean, cov, total, filtered = jax.jit(jax.vmap(lambda key: smoothed(HOW[name], key)))(KEYS)
    np.testing.assert_allclose(total, 1.0, rtol=1e-9)
    scale = np.sqrt(np.asarray(exact.cov).diagonal(axis1=1, axis2=2))

    def worst(found, expected, scale):
        error = (np.asarray(found) - np.asarray(expected)).mean(axis=0) / scale
        bias = 6 / N  # of a ratio of two estimates, of order 1 / N
        return (np.abs(error) / (4.5 * (np.asarray(found) / scale).std(axis=0) / np.sqrt(RUNS) + bias)).max()

    assert worst(mean, exact.mean, scale) <= 1
    assert worst(cov, exact.cov, scale[:, :, None] * scale[:, None, :]) <= 1
    assert worst(filtered, exact.mean, scale) > 2


@pytest.mark.slow
def test_few_proposals_suffice_where_all_steps_resample_and_more_help_where_not(exact):
    """From the ancestor even one Metropolis step is right; without resampling in every step it is not."""

    def error(proposals, threshold):
        how = {"paths": 300, "proposals": proposals}
        mean, *_ = jax.jit(jax.vmap(lambda key: smoothed(how, key, "systematic", threshold)))(KEYS)
        return float(jnp.abs(mean.mean(axis=0) - exact.mean).max())

    assert error(1, 1.0) < 0.15
    assert error(50, 0.3) < 0.15


def test_paths_are_made_of_the_particles():
    filt = jf.particle(MODEL, N, resampling="multinomial", threshold=1.0, keep=True)
    out = jf.filter(filt, YS, key=KEYS[0], **WITH)
    found = jf.smooth_particles(MODEL, out, dt=DT, u=U, key=KEYS[1], **HOW["paths"])
    for k in (0, T - 1):
        assert np.isin(found.particles[k, :, 0], out.extra["particles"][k, :, 0]).all()
    moments = jf.smooth_particles(MODEL, out, dt=DT, u=U)
    np.testing.assert_allclose(moments.mean[-1], out.mean[-1], rtol=1e-9)
    np.testing.assert_allclose(found.mean, moments.mean, atol=0.5)


def test_singular_noise_is_refused_and_flagged():
    model = MODEL._replace(Q=jnp.diag(jnp.array([1.0, 0.0])))
    out = jf.filter(jf.particle(MODEL, N, resampling="multinomial", threshold=1.0, keep=True), YS, key=KEYS[0], **WITH)
    with pytest.raises(ValueError, match="Q: is singular on the interval that ends at k = 1"):
        jf.smooth_particles(model, out, dt=DT, u=U)
    status = jax.jit(lambda m, o: jf.smooth_particles(m, o, dt=DT, u=U).status)(model, out)
    assert (status[:-1] == int(jf.Status.SINGULAR)).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"paths": 0, "key": KEYS[0]}, "paths: expected a whole number >= 1"),
        ({"paths": 5, "proposals": 1.5, "key": KEYS[0]}, "proposals: expected a whole number >= 1"),
        ({"paths": 5}, "key: paths are drawn"),
        ({"proposals": 5}, "paths: without them nothing is drawn"),
    ],
)
def test_bad_arguments_are_refused(options, message):
    extra = {"particles": jnp.zeros((T, 5, 2)), "log_weights": jnp.zeros((T, 5)), "ancestors": jnp.zeros((T, 5), int)}
    mean = jnp.zeros((T, 2))
    out = jf.Info(mean, None, mean, None, None, None, jnp.zeros((T,), jnp.int32), extra=extra)
    with pytest.raises(ValueError, match=message):
        jf.smooth_particles(MODEL, out, dt=DT, u=U, **options)
    with pytest.raises(ValueError, match="out: has no particles, log_weights, ancestors"):
        jf.smooth_particles(MODEL, out._replace(extra={}), dt=DT, u=U)
