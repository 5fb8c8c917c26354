"""Motion models against their defining integrals, and what they refuse."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

import jaxfilt as jf
from jaxfilt.models.linear import value

ORDERS = {jf.models.constant_velocity: 2, jf.models.constant_acceleration: 3, jf.models.constant_jerk: 4}
every = pytest.mark.parametrize("builder", ORDERS, ids=lambda b: b.__name__)


def build(builder, d=1, dtype=jnp.float64, **options):
    n = ORDERS[builder] * d
    arguments = {"dt": 0.7, "q": 0.3, "r": 2.0, "m0": jnp.zeros(n, dtype), "P0": jnp.eye(n, dtype=dtype)}
    return builder(**{**arguments, **options})


def van_loan(n, dt, q):
    """F and Q of a chain of n integrators driven by white noise, by the matrix exponential (Van Loan 1978)."""
    A, G = np.eye(n, k=1), np.zeros((n, n))
    G[-1, -1] = q
    block = expm(np.block([[-A, G], [np.zeros((n, n)), A.T]]) * dt)
    F = block[n:, n:].T
    return F, F @ block[:n, n:]


@every
@pytest.mark.parametrize("dt", [0.0, 0.01, 0.7, 3.0])
def test_continuous_noise_is_the_integral(builder, dt):
    n = ORDERS[builder]
    F, Q = van_loan(n, dt, 0.3)
    model = build(builder)
    step = jnp.asarray(dt)
    np.testing.assert_allclose(value(model.F, None, step), F, atol=1e-13)
    np.testing.assert_allclose(value(model.Q, None, step), Q, atol=1e-13 * max(1.0, Q.max()))


@every
def test_piecewise_noise_has_rank_one(builder):
    Q = np.asarray(value(build(builder, noise="piecewise").Q, None, None))
    g = {2: [0.245, 0.7], 3: [0.245, 0.7, 1.0], 4: [0.343 / 6, 0.245, 0.7, 1.0]}[ORDERS[builder]]
    np.testing.assert_allclose(Q, 0.3 * np.outer(g, g), rtol=1e-14)


@every
def test_axes_come_in_blocks(builder):
    """Two axes: position block, velocity block, ...; each axis is the one-axis model with its own q."""
    n = ORDERS[builder]
    model = build(builder, d=2, q=[0.3, 0.6], r=[2.0, 3.0])
    one, other = build(builder), build(builder, q=0.6)
    for name in ("F", "Q"):
        both = np.asarray(value(getattr(model, name), None, None))
        np.testing.assert_allclose(both[0::2, 0::2], value(getattr(one, name), None, None), rtol=1e-15)
        np.testing.assert_allclose(both[1::2, 1::2], value(getattr(other, name), None, None), rtol=1e-15)
        assert (both[0::2, 1::2] == 0).all()
    np.testing.assert_array_equal(model.H, np.eye(2, 2 * n))
    np.testing.assert_array_equal(model.R, np.diag([2.0, 3.0]))


@every
def test_step_interval_overrides_the_models_own(builder):
    model = build(builder)
    np.testing.assert_array_equal(value(model.F, None, jnp.asarray(0.7)), value(model.F, None, None))
    filt = jf.kalman(model)
    ys = jnp.ones((3, 1))
    np.testing.assert_array_equal(jf.filter(filt, ys, dt=0.7).mean, jf.filter(filt, ys).mean)


@every
def test_float32_stays_float32(builder):
    model = build(builder, dtype=jnp.float32)
    for name in ("F", "Q", "H", "R"):
        assert value(getattr(model, name), None, None).dtype == jnp.float32


@every
def test_parameters_are_differentiable(builder):
    def trace_of_q(dt, q):
        return jnp.trace(value(build(builder, dt=dt, q=q).Q, None, None))

    gradients = jax.grad(trace_of_q, argnums=(0, 1))(jnp.asarray(0.7), jnp.asarray(0.3))
    h = 1e-6
    numeric = (trace_of_q(0.7 + h, 0.3) - trace_of_q(0.7 - h, 0.3)) / (2 * h)
    np.testing.assert_allclose(gradients[0], numeric, rtol=1e-7)
    np.testing.assert_allclose(gradients[1], trace_of_q(0.7, 1.0), rtol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dt": 0.0}, "dt: expected a finite value > 0"),
        ({"dt": -1.0}, "dt: expected a finite value > 0"),
        ({"dt": np.nan}, "dt: expected a finite value > 0"),
        ({"q": -0.1}, "q: expected a finite value >= 0"),
        ({"q": [0.1, 0.2, 0.3]}, "q: expected a scalar or shape"),
        ({"r": -1.0}, "r: expected a finite value >= 0"),
        ({"r": [1.0, 2.0, 3.0]}, "r: expected a scalar"),
        ({"m0": np.zeros(3)}, "m0: expected shape"),
        ({"m0": np.zeros((2, 2))}, "m0: expected shape"),
        ({"P0": np.eye(3)}, "P0: expected shape"),
        ({"P0": np.array([[1.0, 2.0], [2.0, 1.0]])}, "P0: expected a positive semidefinite matrix"),
        ({"P0": np.array([[1.0, 0.1], [0.2, 1.0]])}, "P0: expected a symmetric matrix"),
        ({"noise": "white"}, "noise: expected"),
    ],
)
def test_bad_arguments_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        build(jf.models.constant_velocity, **options)


@pytest.mark.parametrize("options", [{"m0": np.zeros(2, int)}, {"P0": np.eye(2, dtype=np.float32)}])
def test_integer_or_mixed_dtypes_are_type_errors(options):
    with pytest.raises(TypeError, match=next(iter(options))):
        build(jf.models.constant_velocity, **options)
