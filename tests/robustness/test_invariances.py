"""Exact properties of linear filters for random models of any unit (hypothesis); all share one compiled shape."""

from __future__ import annotations

import functools

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies

import jaxfilt as jf
from tests import reference
from tests.robustness.problems import Linear
from tests.robustness.row import cast

N, M, T = 3, 2, 8
FORMS = {"kalman": jf.kalman, "sqrt_kalman": jf.sqrt_kalman}
every_form = pytest.mark.parametrize("form", FORMS)
examples = hypothesis.settings(max_examples=25)
seeds = strategies.integers(0, 2**32 - 1)
decades = strategies.floats(-12, 12)  # of the unit: 24 decades
ratios = strategies.floats(-3, 3)  # of P0 and R to Q


def draw(seed, unit, p, r, diagonal=False):
    """A random model in a random unit, and data of its size."""
    rng = np.random.default_rng(seed)
    scale = 10.0**unit
    F, H, Q, R, m0, P0 = reference.random_model(rng, N, M)
    R = np.diag(np.diag(R)) if diagonal else R
    model = Linear(F, H, scale**2 * Q, scale**2 * 10.0**r * R, scale * m0, scale**2 * 10.0**p * P0)
    return model, scale * 2 * rng.normal(size=(T, M)), rng, scale


@functools.partial(jax.jit, static_argnames=("form",))
def _run(form, models, ys, masks):
    """Two problems at once: a property compares them."""

    def one(model, y, mask):
        return jf.filter(FORMS[form](jf.models.linear_gaussian(*model)), y, mask=mask, outputs=jf.everything)

    return jax.vmap(one)(models, ys, masks)


def pair(form, first, second):
    """Info of ``(model, ys, mask)`` twice, as NumPy."""
    models, ys, masks = (jax.tree.map(lambda *x: np.stack(x), *parts) for parts in zip(first, second, strict=True))
    out = _run(form, cast(models, jnp.float64), jnp.asarray(ys), jnp.asarray(masks))
    return [jax.tree.map(lambda x, i=i: np.asarray(x[i]), out) for i in range(2)]


ALL = np.ones((T, M), bool)


def close(a, b, tol):
    np.testing.assert_allclose(a, b, rtol=0, atol=tol * np.abs(b).max())


@every_form
@examples
@hypothesis.given(seed=seeds, unit=decades, p=ratios, r=ratios)
def test_an_update_never_adds_uncertainty(form, seed, unit, p, r):
    model, ys, _, _ = draw(seed, unit, p, r)
    out, _ = pair(form, (model, ys, ALL), (model, ys, ALL))
    gap = np.linalg.eigvalsh(out.prediction.cov - out.cov)
    assert (gap[:, 0] >= -1e-12 * np.linalg.eigvalsh(out.prediction.cov)[:, -1]).all()


@every_form
@examples
@hypothesis.given(seed=seeds, unit=decades, p=ratios, r=ratios)
def test_the_order_of_independent_sensors_does_not_matter(form, seed, unit, p, r):
    model, ys, _, _ = draw(seed, unit, p, r, diagonal=True)
    other = model._replace(H=model.H[::-1], R=model.R[::-1, ::-1])
    a, b = pair(form, (model, ys, ALL), (other, ys[:, ::-1], ALL))
    close(b.mean, a.mean, 1e-9)
    close(b.cov, a.cov, 1e-9)
    close(b.log_lik, a.log_lik, 1e-9)


@every_form
@examples
@hypothesis.given(seed=seeds, unit=decades, p=ratios, r=ratios)
def test_other_coordinates_give_the_same_estimate_in_them(form, seed, unit, p, r):
    """x -> A x with a well-conditioned A."""
    model, ys, rng, _ = draw(seed, unit, p, r)
    A = np.linalg.qr(rng.normal(size=(N, N)))[0] @ np.diag(rng.uniform(0.3, 3, N))
    back = np.linalg.inv(A)
    Q, P0 = (A @ X @ A.T for X in (model.Q, model.P0))
    other = Linear(A @ model.F @ back, model.H @ back, (Q + Q.T) / 2, model.R, A @ model.m0, (P0 + P0.T) / 2)
    a, b = pair(form, (model, ys, ALL), (other, ys, ALL))
    close(b.mean, a.mean @ A.T, 1e-9)
    close(b.cov, A @ a.cov @ A.T, 1e-9)
    close(b.log_lik, a.log_lik, 1e-9)


@every_form
@examples
@hypothesis.given(seed=seeds, unit=decades, p=ratios, r=ratios)
def test_a_sensor_of_boundless_noise_is_none(form, seed, unit, p, r):
    """R -> infinity on one channel: what it tells vanishes as S / R."""
    model, ys, _, scale = draw(seed, unit, p, r, diagonal=True)
    blind = model._replace(R=model.R + np.diag([0.0, 1e18 * np.abs(model.P0).max() + 1e18 * scale**2]))
    mask = ALL.copy()
    mask[:, 1] = False
    a, b = pair(form, (model, ys, mask), (blind, ys, ALL))
    close(b.mean, a.mean, 1e-9)
    close(b.cov, a.cov, 1e-9)


@every_form
@examples
@hypothesis.given(seed=seeds, unit=decades, p=ratios, r=ratios)
def test_runs_of_a_batch_may_be_in_any_order(form, seed, unit, p, r):
    model, ys, rng, _ = draw(seed, unit, p, r)
    other = model._replace(m0=-model.m0), ys[::-1], rng.random((T, M)) < 0.6
    forth = pair(form, (model, ys, ALL), other)
    back = pair(form, other, (model, ys, ALL))
    for x, y in zip(jax.tree.leaves(forth), jax.tree.leaves(back[::-1]), strict=True):
        assert (x == y).all()


@every_form
@examples
@hypothesis.given(seed=seeds, unit=decades, p=ratios, r=ratios)
def test_units_do_not_matter(form, seed, unit, p, r):
    (base, ys, _, _), (scaled, ys_scaled, _, s) = draw(seed, 0.0, p, r), draw(seed, unit, p, r)
    a, b = pair(form, (base, ys, ALL), (scaled, ys_scaled, ALL))
    close(b.mean / s, a.mean, 1e-10)
    close(b.cov / s**2, a.cov, 1e-10)
    close(b.log_lik + M * np.log(s), a.log_lik, 1e-10)


@functools.partial(jax.jit, static_argnames=("form",))
def _intervals(form, q, r, ys, dt, mask):
    model = jf.models.constant_velocity(dt=1.0, q=q, r=r, m0=jnp.array([1.0, -1.0]), P0=jnp.diag(jnp.array([2.0, 0.5])))
    return jf.filter(FORMS[form](model), ys, dt=dt, mask=mask)


@every_form
@examples
@hypothesis.given(seed=seeds, q=decades, r=ratios)
def test_an_interval_may_be_split_into_parts(form, seed, q, r):
    """White noise on the acceleration, discretised exactly: three steps with one datum are one long step."""
    rng = np.random.default_rng(seed)
    dt, ys = rng.uniform(0.1, 2.0, 4), rng.normal(size=(4, 1))
    weights = rng.dirichlet(np.ones(3), 4)
    mask = np.arange(12) % 3 == 2
    q, r = 10.0 ** (q / 4), 10.0**r
    one = _intervals(form, q, r, jnp.asarray(ys), jnp.asarray(dt), jnp.ones((4, 1), bool))
    fine = np.zeros((12, 1))
    fine[mask] = ys
    parts = _intervals(
        form, q, r, jnp.asarray(fine), jnp.asarray((weights * dt[:, None]).ravel()), jnp.asarray(mask[:, None])
    )
    close(np.asarray(parts.mean)[mask], np.asarray(one.mean), 1e-9)
    close(np.asarray(parts.cov)[mask], np.asarray(one.cov), 1e-9)
    close(np.asarray(parts.log_lik)[mask], np.asarray(one.log_lik), 1e-9)
