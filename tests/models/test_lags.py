"""Probabilities of delays, and the model with lags against conditioning on all packets at once."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf


def test_probabilities_by_hand_and_back():
    p = jf.models.delay_probabilities(jnp.array([0.9, 0.5, 0.5]))
    np.testing.assert_allclose(p, [0.9, 0.05, 0.025, 0.025], rtol=1e-12)
    rng = np.random.default_rng(0)
    alpha = rng.uniform(size=(5, 3, 4))
    p = jf.models.delay_probabilities(alpha)
    np.testing.assert_allclose(p.sum(axis=-1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(jf.models.success_probabilities(p), alpha, rtol=1e-9)
    assert jf.models.success_probabilities(jnp.array([1.0, 0.0, 0.0])).tolist() == [1.0, 0.0]
    slope = jax.grad(lambda p: jf.models.success_probabilities(p)[1])(jnp.array([1.0, 0.0, 0.0]))
    assert np.isfinite(slope).all()


def _transition(u, dt):
    del dt
    return u


@pytest.mark.parametrize(
    ("make", "varying", "channels"),
    [(jf.kalman, False, False), (jf.kalman, True, False), (jf.kalman, False, True), (jf.sqrt_kalman, True, False)],
)
def test_filter_with_lags_conditions_on_what_has_arrived(make, varying, channels):
    """Several packets at once, older after newer ones, channels apart: against one dense Gaussian conditioning."""
    rng = np.random.default_rng(1)
    T, n, m, d = 9, 2, 2, 3
    F = rng.normal(size=(T, n, n)) if varying else np.tile(rng.normal(size=(n, n)), (T, 1, 1))
    H, Q, R = rng.normal(size=(m, n)), np.diag([0.4, 0.9]), np.array([[0.5, 0.1], [0.1, 0.3]])
    R = np.diag(np.diag(R)) if channels else R
    m0, P0 = rng.normal(size=n), np.diag([1.0, 2.0])
    model = jf.models.linear_gaussian(_transition if varying else F[0], H, Q, R, m0, P0)
    zs = rng.normal(size=(T, m))
    received = jf.simulate.deliver(zs, rng.integers(0, d + 2, (T, m) if channels else T), d)
    out = jf.filter(
        make(jf.models.with_lags(model, d)), received.packets, mask=received.arrived, u=F if varying else None
    )

    # Everything as a linear function of e = (x_{-1}, w_0, .., w_{T-1}, v_0, .., v_{T-1}).
    cov = np.zeros((n * (T + 1) + m * T,) * 2)
    cov[:n, :n] = P0
    for k in range(T):
        cov[n * (k + 1) : n * (k + 2), n * (k + 1) : n * (k + 2)] = Q
        at = n * (T + 1) + m * k
        cov[at : at + m, at : at + m] = R
    unit = np.eye(len(cov))
    mean, rows, x_mean, x_rows = m0, unit[:n], [], []
    for k in range(T):
        mean, rows = F[k] @ mean, F[k] @ rows + unit[n * (k + 1) : n * (k + 2)]
        x_mean.append(mean)
        x_rows.append(rows)
    arrived = np.asarray(received.arrived).reshape(T, d + 1, m)
    y, y_mean, y_rows = [], [], []
    for k in range(T):
        for lag, a in np.argwhere(arrived[k]):
            j = k - lag
            y.append(zs[j, a])
            y_mean.append(H[a] @ x_mean[j])
            y_rows.append(H[a] @ x_rows[j] + unit[n * (T + 1) + m * j + a])
        x, C = x_rows[k], x_rows[k] @ cov
        expected, P = x_mean[k], C @ x.T
        if y:
            rows = np.array(y_rows)
            gain = np.linalg.solve(rows @ cov @ rows.T, rows @ C.T).T
            expected, P = expected + gain @ (np.array(y) - y_mean), P - gain @ rows @ C.T
        np.testing.assert_allclose(out.mean[k, :n], expected, atol=1e-9)
        np.testing.assert_allclose(out.cov[k, :n, :n], P, atol=1e-9)


def test_the_last_block_is_the_fixed_lag_smoother():
    model = jf.models.linear_gaussian([[0.9]], [[1.0]], [[0.5]], [[0.3]], [0.0], [[1.0]])
    ys = np.random.default_rng(0).normal(size=(12, 1))
    out = jf.filter(jf.kalman(jf.models.with_lags(model, 2)), **jf.lag_inputs(ys, np.zeros(12, int), 2))
    smoothed = jf.smooth(jf.kalman(model), ys[:8])
    np.testing.assert_allclose(out.mean[7, 2], smoothed.mean[5, 0], rtol=1e-9)
    np.testing.assert_allclose(out.cov[7, 2, 2], smoothed.cov[5, 0, 0], rtol=1e-9)


def test_inputs_and_intervals_reach_a_model_with_lags():
    """A motion model with its functions of dt, and an input matrix: no delay is then the plain filter."""
    motion = jf.models.constant_velocity(dt=1.0, q=0.1, r=1.0, m0=[0.0, 1.0], P0=np.eye(2).tolist())
    motion = motion._replace(B=jnp.array([[0.5], [1.0]]))
    ys, dt, u = np.random.default_rng(0).normal(size=(6, 1)), np.linspace(0.5, 2.0, 6), np.ones((6, 1))
    plain = jf.filter(jf.kalman(motion), ys, dt=dt, u=u)
    lagged = jf.filter(
        jf.kalman(jf.models.with_lags(motion, 2)), **jf.lag_inputs(ys, np.zeros(6, int), 2), dt=dt, u=u
    )  # fmt: skip
    np.testing.assert_allclose(lagged.mean[:, :2], plain.mean, rtol=1e-12)
    np.testing.assert_allclose(lagged.log_lik, plain.log_lik, rtol=1e-12)
