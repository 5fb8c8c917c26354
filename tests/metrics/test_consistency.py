"""NEES, NIS, chi-square regions and whiteness: inside for a right model, outside for a wrong one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import jaxfilt as jf
from jaxfilt.metrics import chi2_quantile, chi2_region, consistency, nees, whiteness
from jaxfilt.simulate import simulate

RUNS, T = 1000, 30


@pytest.mark.parametrize("dof", [0.1, 1.0, 2.0, 3.0, 30.0, 250.0, 1e4, 4e5])
def test_quantiles_are_those_of_scipy(dof):
    for probability in (1e-6, 5e-4, 0.025, 0.5, 0.975, 0.9995, 1 - 1e-6):
        np.testing.assert_allclose(chi2_quantile(probability, dof), scipy.stats.chi2.ppf(probability, dof), rtol=1e-8)


def test_quantile_at_millions_of_degrees_of_freedom():
    # Against the Cornish-Fisher expansion (Goldberg and Levine 1946), whose error vanishes here.
    n, u = 5e6, scipy.stats.norm.ppf(1e-6)
    expansion = n + u * np.sqrt(2 * n) + 2 / 3 * (u**2 - 1) + (u**3 - 7 * u) / (9 * np.sqrt(2 * n))
    np.testing.assert_allclose(chi2_quantile(1e-6, n), expansion, rtol=1e-11)


@pytest.mark.parametrize(
    ("dof", "probability", "region"),
    [
        (1, 0.999, (0.859, 1.154)),
        (2, 0.999, (1.798, 2.215)),
        (4, 0.999, (3.712, 4.301)),
        (6, 0.999, (5.646, 6.367)),
        (2, 0.95, (1.878, 2.126)),
        (4, 0.95, (3.827, 4.177)),
    ],
)
def test_regions_of_a_thousand_runs(dof, probability, region):
    np.testing.assert_allclose(chi2_region(dof, 1000, probability), region, atol=6e-4)


@pytest.mark.parametrize(
    "call",
    [
        lambda: chi2_quantile(0.0, 1.0),
        lambda: chi2_quantile(1.0, 1.0),
        lambda: chi2_quantile(0.5, 0.0),
        lambda: chi2_quantile(0.5, float("nan")),
        lambda: chi2_region(2, 0),
        lambda: chi2_region(2, 10, 1.0),
        lambda: consistency([], 2),
        lambda: consistency([1.0, 2.0], [1.0]),
        lambda: consistency([1.0, 2.0], 2, probability=0.0),
    ],
)
def test_bad_arguments_are_refused(call):
    with pytest.raises(ValueError, match="expected"):
        call()


def test_nees_is_the_quadratic_form():
    rng = np.random.default_rng(0)
    error, factor = rng.normal(size=(5, 4, 3)), rng.normal(size=(5, 4, 3, 3))
    cov = factor @ factor.swapaxes(-1, -2)
    expected = np.einsum("abi,abi->ab", error, np.linalg.solve(cov, error[..., None])[..., 0])
    np.testing.assert_allclose(nees(np.zeros_like(error), cov, error), expected, rtol=1e-8)
    one = nees(np.zeros_like(error), cov, error, components=[2])
    np.testing.assert_allclose(one, error[..., 2] ** 2 / cov[..., 2, 2], rtol=1e-12)
    with pytest.raises(ValueError, match="expected mean"):
        nees(error, cov[0], error)


def test_nees_of_a_singular_covariance_is_finite():
    cov = jnp.array([[4.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 0.0]])

    def value(e):
        return nees(jnp.zeros(3), cov, e)

    error = jnp.array([2.0, 1.0, 0.0])
    np.testing.assert_allclose(value(error), 1.0)
    assert jnp.isfinite(jax.grad(value)(error)).all()


def model(q=1.0, r=1.0):
    P0 = jnp.array([[4.0, 0.5], [0.5, 1.0]])
    return jf.models.constant_velocity(dt=1.0, q=0.5 * q, r=2.0 * r, m0=jnp.array([1.0, -1.0]), P0=P0)


@jax.jit
def run(filt, keys):
    def one(key):
        sim = simulate(model(), T, key)
        out = jf.filter(filt, sim.ys)
        return nees(out.mean[-1], out.cov[-1], sim.states[-1]), out.nis, out.innovation, out.innovation_cov

    return jax.vmap(one, out_axes=(0, 0, 0, None))(keys)


@pytest.fixture(scope="module")
def keys():
    return jax.random.split(jax.random.key(0), RUNS)


def test_a_right_model_is_inside_every_region(keys):
    nees_last, nis, innovation, S = run(jf.kalman(model()), keys)
    assert consistency(nees_last, 2).inside
    assert consistency(nis.ravel(), 1).inside
    white = whiteness(innovation, innovation_cov=S)
    assert white.inside.all()
    np.testing.assert_allclose(white.bound, 3.3 / np.sqrt(RUNS * T), rtol=1e-12)


@pytest.mark.parametrize("wrong", [{"q": 2.0}, {"q": 0.5}, {"r": 2.0}, {"r": 0.5}])
def test_a_model_wrong_by_two_is_outside(keys, wrong):
    nees_last, nis, innovation, S = run(jf.kalman(model(**wrong)), keys)
    assert not consistency(nees_last, 2).inside
    assert not consistency(nis.ravel(), 1).inside
    white = whiteness(innovation, innovation_cov=S)
    assert not white.inside.all()


def test_dof_may_differ_between_values():
    rng = np.random.default_rng(0)
    dof = rng.integers(0, 3, size=(2000, 2))
    values = (rng.normal(size=(2000, 2, 2)) ** 2 * (np.arange(2) < dof[..., None])).sum(-1)
    result = consistency(values, dof)
    assert result.inside.all()
    low, high = chi2_region(dof[:, 1].mean(), 2000)
    np.testing.assert_allclose((result.low[1], result.high[1]), (low, high), rtol=1e-12)
    assert not consistency(1.2 * values, dof).inside.any()


def test_nan_is_outside():
    assert not consistency([1.0, np.nan], 1).inside


def test_whiteness_counts_only_what_is_present():
    rng = np.random.default_rng(0)
    S = jnp.array([[4.0, 1.0], [1.0, 2.0]])
    mask = rng.uniform(size=(200, 50, 2)) > 0.3
    nu = jnp.where(mask, rng.normal(size=(200, 50, 2)) @ np.linalg.cholesky(S).T, 0.0)
    white = whiteness(nu, innovation_cov=jnp.broadcast_to(S, (50, 2, 2)), mask=mask)
    np.testing.assert_allclose(white.bound, 3.3 / np.sqrt(mask.sum((0, 1))), rtol=1e-12)
    assert white.inside.all()
    smooth = whiteness(jnp.cumsum(nu, axis=1), mask=mask)
    assert not smooth.inside.any()
    with pytest.raises(ValueError, match="T > lags"):
        whiteness(nu[:, :5], lags=5)
