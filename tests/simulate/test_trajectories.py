"""Simulated trajectories: moments, keys, conventions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxfilt as jf
from jaxfilt.metrics import consistency
from jaxfilt.simulate import measure, simulate

KEY = jax.random.key(3)
RUNS = 20_000


def by_time(matrices, u, dt):
    del dt
    return jnp.take(matrices, u["k"], axis=0)


def time_varying():
    """A model whose every matrix changes with time, with inputs and correlated noise: matrices (T, ...)."""
    rng = np.random.default_rng(0)
    T, n, m = 4, 2, 2
    F = np.eye(n) + 0.4 * rng.normal(size=(T, n, n))
    H = rng.normal(size=(T, m, n))
    joint = rng.normal(size=(T, n + m, n + m))
    joint = joint @ joint.transpose(0, 2, 1)  # of the noise that follows sample k, and the noise of sample k
    Q = np.concatenate([np.eye(n)[None], joint[:-1, :n, :n]])
    S, R = joint[:, :n, n:], joint[:, n:, n:]
    B, D = rng.normal(size=(T, n)), rng.normal(size=(T, m))
    m0, P0 = np.array([1.0, -2.0]), np.array([[2.0, 0.5], [0.5, 1.0]])
    arrays = {"F": F, "H": H, "Q": Q, "R": R, "B": B, "D": D, "S": S}
    model = jf.models.linear_gaussian(
        m0=jnp.asarray(m0), P0=jnp.asarray(P0), **{k: Partial(by_time, jnp.asarray(a)) for k, a in arrays.items()}
    )
    return model, {"k": jnp.arange(T, dtype=jnp.int32)}, arrays, m0, P0


def joint_moments(a, m0, P0, first_update_only):
    """Mean and covariance of all states and samples stacked, by writing each as a linear map of independent noise."""
    T, n, m = len(a["F"]), len(m0), a["H"].shape[1]
    size = n + T * (n + m)
    # Noise vector: x0, w_0 .. w_{T-1}, v_0 .. v_{T-1}.
    C = np.zeros((size, size))
    C[:n, :n] = P0
    w = [slice(n + k * n, n + (k + 1) * n) for k in range(T)]
    v = [slice(n + T * n + k * m, n + T * n + (k + 1) * m) for k in range(T)]
    for k in range(T):
        C[w[k], w[k]], C[v[k], v[k]] = a["Q"][k], a["R"][k]
        if k + 1 < T:
            C[w[k + 1], v[k]] = a["S"][k]
            C[v[k], w[k + 1]] = a["S"][k].T
    mean, X = m0, np.eye(n, size)
    means_x, means_y, Xs, Ys = [], [], [], []
    for k in range(T):
        if not (first_update_only and k == 0):
            X = a["F"][k] @ X
            X[:, w[k]] += np.eye(n)
            mean = a["F"][k] @ mean + a["B"][k]
        Y = a["H"][k] @ X
        Y[:, v[k]] += np.eye(m)
        means_x.append(mean)
        means_y.append(a["H"][k] @ mean + a["D"][k])
        Xs.append(X)
        Ys.append(Y)
    A = np.concatenate([*Xs, *Ys])
    return np.concatenate([*means_x, *means_y]), A @ C @ A.T


@pytest.mark.parametrize("first_update_only", [False, True])
def test_joint_moments_are_those_of_the_model(first_update_only):
    model, u, arrays, m0, P0 = time_varying()
    keys = jax.random.split(KEY, RUNS)
    sim = jax.vmap(lambda key: simulate(model, 4, key, u=u, first_update_only=first_update_only))(keys)
    drawn = np.concatenate([np.asarray(sim.states).reshape(RUNS, -1), np.asarray(sim.ys).reshape(RUNS, -1)], axis=1)
    mean, cov = joint_moments(arrays, m0, P0, first_update_only)
    std = np.sqrt(np.diag(cov))
    assert np.abs((drawn.mean(0) - mean) / std).max() < 4.5 / np.sqrt(RUNS)
    # The standard deviation of a sample correlation is at most sqrt(2 / N).
    error = (np.cov(drawn.T) - cov) / np.outer(std, std)
    assert np.abs(error).max() < 5 * np.sqrt(2 / RUNS)


def test_the_filter_of_the_same_model_is_consistent():
    # Irregular intervals through the filter's own arguments: the conventions of both agree.
    model = jf.models.constant_velocity(
        dt=1.0, q=0.3, r=[2.0, 0.5], m0=[0.0, 1.0, 2.0, 0.0], P0=np.diag([9.0, 4.0, 1.0, 1.0])
    )
    dt = jnp.array([0.5, 2.0, 0.1, 1.0, 3.0])
    keys = jax.random.split(KEY, 4000)
    ys = jax.vmap(lambda key: simulate(model, 5, key, dt=dt).ys)(keys)
    nis = jax.vmap(lambda y: jf.filter(jf.kalman(model), y, dt=dt).nis)(ys)
    assert consistency(nis, 2).inside.all()
    wrong = jax.vmap(lambda y: jf.filter(jf.kalman(model), y, dt=dt, first_update_only=True).nis)(ys)
    assert not consistency(wrong, 2).inside.all()


def test_longer_simulations_begin_with_the_shorter_ones():
    model = jf.models.constant_acceleration(dt=0.1, q=0.05, r=0.01, m0=[0.0, 0.0, 2.0], P0=np.eye(3))
    short, long = simulate(model, 5, KEY), simulate(model, 12, KEY)
    np.testing.assert_array_equal(short.states, long.states[:5])
    np.testing.assert_array_equal(short.ys, long.ys[:5])


def test_start_is_taken_as_given():
    model = jf.models.constant_velocity(dt=2.0, q=0.0, r=1.0, m0=[0.0, 0.0], P0=np.eye(2))
    sim = simulate(model, 3, KEY, x0=[1.0, 3.0])
    np.testing.assert_allclose(sim.states, [[7, 3], [13, 3], [19, 3]])
    sim = simulate(model, 3, KEY, x0=[1.0, 3.0], first_update_only=True)
    np.testing.assert_allclose(sim.states, [[1, 3], [7, 3], [13, 3]])


def test_singular_covariances_are_fine():
    F, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.eye(2)
    model = jf.models.linear_gaussian(F, H, np.diag([0.0, 1.0]), np.zeros((2, 2)), np.zeros(2), np.zeros((2, 2)))
    sim = simulate(model, 6, KEY)
    np.testing.assert_array_equal(sim.ys, sim.states)
    np.testing.assert_allclose(sim.states[1:, 0], sim.states[:-1, 0] + sim.states[:-1, 1], rtol=1e-14)


def test_measure_adds_only_sensor_noise():
    model = jf.models.constant_velocity(dt=1.0, q=0.1, r=4.0, m0=np.zeros(2), P0=np.eye(2))
    path = jnp.stack([jnp.linspace(0.0, 5.0, 6), jnp.ones(6)], axis=1)
    ys = jax.vmap(lambda key: measure(model, path, key))(jax.random.split(KEY, RUNS))
    noise = np.asarray(ys)[..., 0] - np.asarray(path)[:, 0]
    np.testing.assert_allclose(np.cov(noise.T), 4 * np.eye(6), atol=4 * 5 * np.sqrt(2 / RUNS))


def test_the_dtype_is_the_models():
    model = jf.models.constant_velocity(
        dt=1.0, q=0.1, r=4.0, m0=np.zeros(2, np.float32), P0=np.eye(2, dtype=np.float32)
    )
    sim = simulate(model, 3, KEY, dt=0.5)
    assert sim.states.dtype == sim.ys.dtype == jnp.float32
    with pytest.raises(TypeError, match="x0: is float64"):
        simulate(model, 3, KEY, x0=np.zeros(2))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"T": 0}, "T: expected an int >= 1"),
        ({"T": 2.0}, "T: expected an int >= 1"),
        ({"x0": np.zeros(3)}, r"x0: expected shape \(2,\)"),
        ({"x0": np.array([np.nan, 0.0])}, "x0: expected finite"),
        ({"dt": np.array([1.0, -1.0, 1.0])}, "dt: expected finite intervals >= 0"),
        ({"u": np.zeros((2, 1))}, "u: expected leaves with leading T = 3"),
    ],
)
def test_bad_input_is_refused(options, message):
    model = jf.models.constant_velocity(dt=1.0, q=0.1, r=4.0, m0=np.zeros(2), P0=np.eye(2))
    with pytest.raises(ValueError, match=message):
        simulate(**{"model": model, "T": 3, "key": KEY, **options})
