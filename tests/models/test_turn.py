"""Coordinated turns: the limit of no turn, derivatives, and the switch between series and closed form."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt.models.linear import value
from jaxfilt.models.nonlinear import covariance
from jaxfilt.models.turn import arc


def turn(dtype=jnp.float64, **options):
    given = {"dt": 0.7, "q_omega": 0.2, "q": 0.3, "r": 2.0, "m0": jnp.zeros(5, dtype), "P0": jnp.eye(5, dtype=dtype)}
    return jf.models.coordinated_turn(**{**given, **options})


def known(omega, dtype=jnp.float64, **options):
    given = {"dt": 0.7, "q": 0.3, "r": [1.0, 2.0], "m0": jnp.zeros(4, dtype), "P0": jnp.eye(4, dtype=dtype)}
    return jf.models.known_turn(omega=omega, **{**given, **options})


def hand_jacobian(x, T):
    """The thesis prints none; this one is the specification's, exact branch only."""
    _, _, vx, vy, w = x
    u = w * T
    sin, cos = np.sin(u), np.cos(u)
    s, c = sin / w, (cos - 1) / w
    s_w, c_w = (u * cos - sin) / w**2, (-u * sin - cos + 1) / w**2
    J = np.eye(5)
    J[:4, 2:4] = [[s, c], [-c, s], [cos, -sin], [sin, cos]]
    J[:4, 4] = [s_w * vx + c_w * vy, -c_w * vx + s_w * vy, -T * (sin * vx + cos * vy), T * (cos * vx - sin * vy)]
    return J


@pytest.mark.parametrize("dt", [None, 0.0, 2.5])
def test_without_a_turn_it_is_constant_velocity(dt):
    straight = jf.models.constant_velocity(dt=0.7, q=0.3, r=[1.0, 2.0], m0=np.zeros(4), P0=np.eye(4))
    step = None if dt is None else jnp.asarray(dt)
    for name in ("F", "Q", "H", "R"):
        want = value(getattr(straight, name), None, step)
        np.testing.assert_allclose(value(getattr(known(0.0), name), None, step), want, rtol=1e-15)
    x = jnp.array([1.0, -2.0, 3.0, 0.5, 0.0])
    model = turn()
    np.testing.assert_allclose(model.f(x, None, step)[:4], value(straight.F, None, step) @ x[:4], rtol=1e-15)
    Q = covariance(model.Q, x, None, step)
    np.testing.assert_allclose(Q[:4, :4], value(straight.Q, None, step), rtol=1e-15)
    np.testing.assert_allclose(Q[4], [0, 0, 0, 0, 0.2 * (0.7 if dt is None else dt)], rtol=1e-15)


def test_a_quarter_turn_is_a_quarter_of_a_circle():
    model = turn(dt=np.pi / 2)
    np.testing.assert_allclose(model.f(jnp.array([0.0, 0, 1, 0, 1]), None, None), [1, 1, 0, 1, 1], atol=1e-15)
    np.testing.assert_allclose(
        value(known(-1.0, dt=np.pi / 2).F, None, None) @ np.array([0.0, 0, 1, 0]), [1, -1, 0, -1], atol=1e-15
    )


def test_jacobian_equals_the_one_by_hand():
    model = turn()
    derivative = jax.jit(jax.jacfwd(lambda x: model.f(x, None, None)))
    rng = np.random.default_rng(0)
    for omega in (-2.0, -0.3, 0.016, 0.5, 4.0):
        x = np.append(rng.normal(size=4) * 10, omega)
        np.testing.assert_allclose(derivative(jnp.asarray(x)), hand_jacobian(x, 0.7), atol=1e-10)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
def test_value_and_derivatives_are_right_where_there_is_no_turn(dtype):
    dt = jnp.asarray(0.7, dtype)
    zero = jnp.zeros((), dtype)

    def s_and_c(w):
        return jnp.stack(arc(w, dt)[:2])

    @jax.jit
    def derivatives(w):
        first = jax.jacfwd(s_and_c)
        return s_and_c(w), first(w), jax.jacrev(s_and_c)(w), jax.jacfwd(first)(w)

    tolerance = 1e-6 if dtype == jnp.float32 else 1e-14
    slope = [0, -(0.7**2) / 2]
    for got, want in zip(derivatives(zero), ([0.7, 0], slope, slope, [-(0.7**3) / 3, 0]), strict=True):
        np.testing.assert_allclose(got, want, atol=tolerance)
    model = turn(dtype)
    x = jnp.asarray([1.0, 2, 3, 4, 0], dtype)
    every_derivative = jax.jit(lambda x: [d(model.f)(x, None, None) for d in (jax.jacfwd, jax.jacrev, jax.hessian)])
    assert all(np.isfinite(derivative).all() for derivative in every_derivative(x))


@pytest.mark.parametrize(("dtype", "switch", "tolerance"), [(jnp.float32, 0.2, 2e-6), (jnp.float64, 0.01, 1e-9)])
def test_the_series_joins_the_closed_form(dtype, switch, tolerance):
    """Value, first and second derivative on both sides of the switch, against float64 references."""
    dt = 1.0

    def exact(w):
        # By the half angle, with Taylor's sum where even that cancels: 12 terms of each series.
        k = np.arange(12)
        fact = np.cumprod(np.concatenate([[1.0], np.arange(1, 26)]))
        s, c = (-1.0) ** k / fact[2 * k + 1], -((-1.0) ** k) / fact[2 * k + 2]
        powers_s, powers_c = 2 * k, 2 * k + 1
        value = [np.sum(s * w**powers_s), np.sum(c * w**powers_c)]
        first = [np.sum(s * powers_s * w ** np.maximum(powers_s - 1, 0)), np.sum(c * powers_c * w ** (powers_c - 1))]
        second = [
            np.sum(s * powers_s * (powers_s - 1) * w ** np.maximum(powers_s - 2, 0)),
            np.sum(c * powers_c * (powers_c - 1) * w ** np.maximum(powers_c - 2, 0)),
        ]
        return np.array([value, first, second])

    def s_and_c(w):
        return jnp.stack(arc(w, jnp.asarray(dt, dtype))[:2])

    evaluate = jax.jit(jax.vmap(lambda w: jnp.stack([s_and_c(w), jax.jacfwd(s_and_c)(w), jax.hessian(s_and_c)(w)])))
    omegas = switch * np.array([0.5, 0.999, 1.001, 2.0, -0.999, -1.001])
    got = np.asarray(evaluate(jnp.asarray(omegas, dtype)), float)
    want = np.array([exact(w) for w in np.asarray(jnp.asarray(omegas, dtype), float)])
    np.testing.assert_allclose(got[:, :2], want[:, :2], atol=tolerance)
    np.testing.assert_allclose(got[:, 2], want[:, 2], atol=10 * tolerance)


def test_an_aliased_turn_warns():
    with pytest.warns(UserWarning, match="omega: a turn of 3.5 rad per interval is aliased"):
        known(5.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        known(4.0)
        jax.jit(lambda w: value(known(w).F, None, None))(5.0)
        turn(m0=jnp.array([0.0, 0, 0, 0, 9.0]))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"dt": 0.0}, ValueError, "dt: expected a finite value > 0"),
        ({"q": -1.0}, ValueError, "q: expected a finite value >= 0"),
        ({"q": [1.0, 2.0]}, ValueError, "q: expected shape"),
        ({"m0": np.zeros(6)}, ValueError, "m0: expected shape"),
        ({"r": np.ones(3)}, ValueError, "r: expected a scalar"),
        ({"dt": np.float32(1)}, TypeError, "dt is float32"),
    ],
    ids=str,
)
def test_bad_parameters_are_refused(options, error, message):
    for build in (turn, lambda **o: known(0.1, **o)):
        with pytest.raises(error, match=message):
            build(**options)


def test_bad_rates_are_refused():
    with pytest.raises(ValueError, match="q_omega: expected a finite value >= 0"):
        turn(q_omega=-0.1)
    with pytest.raises(ValueError, match="omega: expected finite"):
        known(np.nan)


def test_the_rate_can_be_learned_by_gradient():
    """The likelihood of a turning track has its maximum, by the sign of its slope, near the true rate."""
    model = known(0.3)
    F, x, ys = np.asarray(value(model.F, None, None)), np.array([0.0, 0, 5, 0]), []
    for _ in range(10):
        x = F @ x
        ys.append(x[:2])
    ys = np.stack(ys)
    slope = jax.jit(jax.grad(lambda w: jf.filter(jf.kalman(known(w, r=0.1)), ys).log_lik.sum()))
    assert slope(0.25) > 0 > slope(0.35)
    assert np.isfinite(slope(0.0))
