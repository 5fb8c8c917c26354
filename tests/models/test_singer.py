"""Singer's model against its closed form and its two limits; Van Loan's discretization."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm

import jaxfilt as jf
from jaxfilt.models.linear import value


def build(tau, dtype=jnp.float64, d=1, **options):
    n = 3 * d
    given = {"dt": 0.5, "variance": 2.0, "r": 1.0, "m0": jnp.zeros(n, dtype), "P0": jnp.eye(n, dtype=dtype)}
    return jf.models.singer(tau=tau, **{**given, **options})


def closed_form(T, tau, variance):
    """Singer 1970, for one axis."""
    e = 1 / tau
    E = np.exp(-e * T)
    F = np.array([[1, T, (e * T - 1 + E) / e**2], [0, 1, (1 - E) / e], [0, 0, E]])
    q11 = 1 - E**2 + 2 * e * T + 2 / 3 * (e * T) ** 3 - 2 * (e * T) ** 2 - 4 * e * T * E
    q12 = E**2 + 1 - 2 * E + 2 * e * T * E - 2 * e * T + (e * T) ** 2
    q13, q22, q23, q33 = 1 - E**2 - 2 * e * T * E, 4 * E - 3 - E**2 + 2 * e * T, E**2 + 1 - 2 * E, 1 - E**2
    Q = np.array(
        [
            [q11 / e**5, q12 / e**4, q13 / e**3],
            [q12 / e**4, q22 / e**3, q23 / e**2],
            [q13 / e**3, q23 / e**2, q33 / e],
        ]
    )
    return F, e * variance * Q


@pytest.mark.parametrize("ratio", [0.2, 0.35, 1.9, 2.1, 10.0])
def test_equals_the_closed_form(ratio):
    model = build(tau=0.5 / ratio)
    F, Q = closed_form(0.5, 0.5 / ratio, 2.0)
    np.testing.assert_allclose(value(model.F, None, None), F, rtol=1e-10)
    np.testing.assert_allclose(value(model.Q, None, None), Q, rtol=1e-10)


@pytest.mark.parametrize("ratio", [1e-4, 0.05])
def test_keeps_its_digits_where_the_closed_form_does_not(ratio):
    """Against the integral itself. The closed form is negative at 1e-4."""
    T, tau = 0.5, 0.5 / ratio
    A = np.eye(3, k=1)
    A[2, 2] = -1 / tau
    want, _ = quad_vec(lambda s: np.outer(expm(A * s)[:, 2], expm(A * s)[:, 2]), 0, T, epsabs=1e-18, epsrel=1e-13)
    np.testing.assert_allclose(value(build(tau).Q, None, None), 4.0 / tau * want, rtol=1e-11)
    assert ratio > 1e-3 or closed_form(T, tau, 2.0)[1][0, 0] < 0


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
def test_limits_are_constant_acceleration_and_constant_velocity(dtype):
    q, T = 0.3, 0.5
    prior = {"m0": jnp.zeros(3, dtype), "P0": jnp.eye(3, dtype=dtype)}
    smooth = jf.models.constant_acceleration(dt=T, q=q, r=1.0, **prior)
    slow = build(tau=T / 1e-3, variance=q * T / 1e-3 / 2, dtype=dtype)
    for name in ("F", "Q"):
        np.testing.assert_allclose(
            value(getattr(slow, name), None, None), value(getattr(smooth, name), None, None), rtol=2e-3
        )
    prior = {"m0": jnp.zeros(2, dtype), "P0": jnp.eye(2, dtype=dtype)}
    white = jf.models.constant_velocity(dt=T, q=q, r=1.0, **prior)
    fast = build(tau=T / 1e3, variance=q / (2 * T / 1e3), dtype=dtype)
    for name in ("F", "Q"):
        np.testing.assert_allclose(
            value(getattr(fast, name), None, None)[:2, :2], value(getattr(white, name), None, None), rtol=5e-3
        )


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
def test_gradients_are_finite_from_slow_to_fast(dtype):
    @jax.jit
    def total(tau, dt):
        model = build(tau, dtype=dtype)
        return jnp.sum(value(model.Q, None, dt)) + jnp.sum(value(model.F, None, dt))

    slope = jax.jit(jax.grad(total, argnums=(0, 1)))
    for dt in (0.0, 0.5):
        for tau in (1e-6, 0.2, 0.25, 0.3, 1e6):
            assert np.isfinite(slope(jnp.asarray(tau, dtype), jnp.asarray(dt, dtype))).all()
    if dtype == jnp.float64:
        for tau in (0.2, 0.3):  # on both sides of the switch
            h = 1e-5
            both = [total(jnp.asarray(tau + side), jnp.asarray(0.5)) for side in (h, -h)]
            np.testing.assert_allclose(slope(tau, 0.5)[0], (both[0] - both[1]) / (2 * h), rtol=1e-6)


def test_intervals_add_up_and_axes_are_apart():
    model = build(0.8, d=2, variance=np.array([2.0, 5.0]))
    one = build(0.8, variance=5.0)
    F, Q = value(model.F, None, jnp.asarray(0.3)), value(model.Q, None, jnp.asarray(0.3))
    F2, Q2 = value(model.F, None, jnp.asarray(0.6)), value(model.Q, None, jnp.asarray(0.6))
    np.testing.assert_allclose(F @ F, F2, atol=1e-14)
    np.testing.assert_allclose(F @ Q @ F.T + Q, Q2, atol=1e-14)
    np.testing.assert_allclose(Q[1::2, 1::2], value(one.Q, None, jnp.asarray(0.3)), atol=1e-15)
    assert (np.asarray(Q)[::2, 1::2] == 0).all()
    assert (np.asarray(value(model.F, None, jnp.asarray(0.0))) == np.eye(6)).all()


def test_van_loan_equals_the_integral():
    rng = np.random.default_rng(4)
    A = rng.normal(size=(3, 3))
    Qc = A @ A.T
    F, Q = jf.models.van_loan(jnp.asarray(A), jnp.asarray(Qc), 0.7)
    want, _ = quad_vec(lambda s: expm(A * s) @ Qc @ expm(A * s).T, 0, 0.7, epsabs=1e-13, epsrel=1e-12)
    np.testing.assert_allclose(F, expm(A * 0.7), rtol=1e-12)
    np.testing.assert_allclose(Q, want, rtol=1e-10)
    assert (np.asarray(Q) == np.asarray(Q).T).all()


def test_variance_of_a_ternary_uniform_acceleration():
    """Singer's formula, against draws from the density it is the variance of."""
    rng = np.random.default_rng(5)
    kind = rng.random(400_000)
    uniform = rng.uniform(-30, 30, size=kind.size)
    draws = np.where(kind < 0.1, -30, np.where(kind < 0.2, 30, np.where(kind < 0.5, 0, uniform)))
    np.testing.assert_allclose(jf.models.maneuver_variance(30.0, p_largest=0.1, p_zero=0.3), draws.var(), rtol=0.01)
    with pytest.raises(ValueError, match="p_largest: expected 2 p_largest"):
        jf.models.maneuver_variance(30.0, p_largest=0.4, p_zero=0.3)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"tau": 0.0}, ValueError, "tau: expected a finite value > 0"),
        ({"tau": -1.0}, ValueError, "tau: expected a finite value > 0"),
        ({"dt": 0.0}, ValueError, "dt: expected a finite value > 0"),
        ({"variance": -1.0}, ValueError, "variance: expected a finite value >= 0"),
        ({"variance": np.ones(2)}, ValueError, "variance: expected a scalar or shape"),
        ({"m0": np.zeros(4)}, ValueError, "m0: expected shape"),
        ({"r": np.ones(3)}, ValueError, "r: expected a scalar"),
        ({"tau": np.float32(1)}, TypeError, "tau is float32"),
    ],
    ids=str,
)
def test_bad_parameters_are_refused(options, error, message):
    with pytest.raises(error, match=message):
        build(**{"tau": 1.0, **options})
