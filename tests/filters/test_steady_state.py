"""The steady-state filter against the limit of the Kalman filter, and its derivatives against differences."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from jax.tree_util import Partial

import jaxfilt as jf
from tests import reference


def random_model(seed, n, m):
    rng = np.random.default_rng(seed)
    matrices = reference.random_model(rng, n, m)
    return matrices, rng.normal(size=(400, m)) * 2


def close(a, b, tol):
    b = np.asarray(b)
    np.testing.assert_allclose(np.asarray(a), b, rtol=0, atol=tol * np.abs(b).max())


def after_transient(filt, ys, **options):
    out = jf.filter(filt, ys, outputs=jf.everything, **options)
    return jax.tree.map(lambda x: x[300:], out)


MODELS = {
    "random": lambda: jf.models.linear_gaussian(*random_model(0, 3, 2)[0]),
    "more sensors than states": lambda: jf.models.linear_gaussian(*random_model(1, 2, 3)[0]),
    "random walk": lambda: jf.models.linear_gaussian([[1.0]], [[1.0]], [[0.1]], [[2.0]], np.zeros(1), [[1e6]]),
    "constant velocity": lambda: jf.models.constant_velocity(dt=0.5, q=3.0, r=2.0, m0=[0.0] * 4, P0=1e3 * np.eye(4)),
    "noise of rank 1": lambda: jf.models.constant_acceleration(
        dt=1.0, q=0.5, r=2.0, m0=[0.0] * 3, P0=1e3 * np.eye(3), noise="piecewise"
    ),
    "perfect sensor": lambda: jf.models.constant_velocity(dt=1.0, q=0.5, r=0.0, m0=[0.0, 0.0], P0=np.eye(2)),
}  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
def test_equals_the_kalman_filter_after_the_transient(name):
    """Every field of Info, the prediction with its cross-covariance, and the smoothed moments."""
    model = MODELS[name]()
    m = jf.steady_state(model).init.args[0].model.H.shape[0]
    ys = np.random.default_rng(3).normal(size=(400, m))
    steady, varying = (after_transient(make(model), ys) for make in (jf.steady_state, jf.kalman))
    for a, b in zip(jax.tree.leaves(steady), jax.tree.leaves(varying), strict=True):
        close(a, b, 1e-9)
    for a, b in zip(jf.rts(steady), jf.rts(varying), strict=True):
        close(a, b, 1e-9)


def test_inputs_and_correlated_noise():
    rng = np.random.default_rng(4)
    (F, H, *_), ys = random_model(4, 3, 2)
    A = rng.normal(size=(5, 5))
    joint = A @ A.T + 0.1 * np.eye(5)
    model = jf.models.linear_gaussian(
        F, H, joint[:3, :3], joint[3:, 3:], np.zeros(3), np.eye(3), S=joint[:3, 3:],
        B=rng.normal(size=(3, 1)), D=rng.normal(size=(2, 1)),
    )  # fmt: skip
    u = rng.normal(size=(400, 1))
    steady, varying = (after_transient(make(model), ys, u=u) for make in (jf.steady_state, jf.kalman))
    for a, b in zip(jax.tree.leaves(steady), jax.tree.leaves(varying), strict=True):
        close(a, b, 1e-9)


@pytest.mark.parametrize(("q", "r"), [(1e-8, 1.0), (1.0, 1.0), (1e4, 1e-4)])
def test_solves_the_riccati_equation(q, r):
    """The residual in extended precision, for memories of 1 to 1000 samples."""
    model = jf.models.constant_velocity(dt=1.0, q=q, r=r, m0=[0.0, 0.0], P0=np.eye(2))
    steady = jf.steady_state(model).init.args[0]
    F, H, Q, R = (
        np.asarray(x, np.longdouble) for x in (steady.model.F, steady.model.H, steady.model.Q, steady.model.R)
    )
    P = np.asarray(steady.steady.predicted, np.longdouble)
    for _ in range(20_000 if q < 1 else 200):
        K = P @ H.T / (H @ P @ H.T + R)
        P = F @ (P - K @ H @ P) @ F.T + Q
        P = (P + P.T) / 2
    close(steady.steady.predicted, P.astype(float), 1e-11)


def test_gains_are_kalatas():
    index = jf.gains.tracking_index(2.0, 3.0, dt=0.5)
    alpha, beta = jf.gains.kalata(index)
    model = jf.models.constant_velocity(dt=0.5, q=2.0, r=3.0, m0=[0.0, 0.0], P0=np.eye(2), noise="piecewise")
    np.testing.assert_allclose(jf.steady_state(model).init.args[0].steady.gain[:, 0], [alpha, beta / 0.5], rtol=1e-12)


def test_a_partial_sample_is_the_kalman_update_of_the_steady_prediction():
    """Missing: the mean coasts and the covariance is the predicted one. Partial: the rows that are there."""
    (F, H, Q, R, m0, P0), ys = random_model(5, 3, 2)
    filt = jf.steady_state(jf.models.linear_gaussian(F, H, Q, R, m0, P0))
    predicted = filt.init.args[0].steady.predicted
    mask = np.array([[True, True], [True, False], [False, False], [False, False], [False, True], [True, True]])
    out = jf.filter(filt, ys[:6], mask=mask, outputs=jf.everything)
    previous = np.vstack([m0, out.mean[:-1]])
    close(out.prediction.mean, previous @ F.T, 1e-13)
    for k in range(6):
        kalman = jf.kalman(jf.models.linear_gaussian(F, H, Q, R, out.prediction.mean[k], predicted))
        one = jf.filter(kalman, ys[k : k + 1], mask=mask[k : k + 1], first_update_only=True)
        close(out.mean[k], one.mean[0], 1e-12)
        close(out.cov[k], one.cov[0], 1e-12)
        np.testing.assert_allclose(out.log_lik[k], one.log_lik[0], rtol=1e-11)
    smoothed = jf.rts(out)
    assert (np.linalg.eigvalsh(smoothed.cov) > 0).all()


@jax.jit
def _likelihood(p, ys):
    model = jf.models.linear_gaussian(p["F"], p["H"], p["Q"], p["R"], p["m0"], p["P0"], S=p["S"])
    out = jf.filter(jf.steady_state(model), ys)
    return out.log_lik.sum() + jnp.sum(out.cov[0])


def _problem():
    rng = np.random.default_rng(6)
    (F, H, *_), ys = random_model(6, 3, 2)
    A = rng.normal(size=(5, 5))
    joint = A @ A.T + np.eye(5)
    p = {"F": F, "H": H, "Q": joint[:3, :3], "R": joint[3:, 3:], "m0": np.ones(3), "P0": np.eye(3), "S": joint[:3, 3:]}
    return {name: jnp.asarray(x) for name, x in p.items()}, jnp.asarray(ys[:30])


H = 1e-4
STENCIL, WEIGHTS = H * jnp.array([-2.0, -1.0, 1.0, 2.0]), jnp.array([1.0, -8.0, 8.0, -1.0]) / (12 * H)


def test_gradient_equals_central_differences():
    """For each entry of F, H, Q, R, S. P0 does not matter."""
    p, ys = _problem()
    vector, unravel = ravel_pytree(p)
    near = vector[None, None] + STENCIL[:, None, None] * jnp.eye(vector.size)[None]
    values = jax.jit(jax.vmap(jax.vmap(lambda v: _likelihood(unravel(v), ys))))(near)
    found = jax.jit(jax.grad(lambda v: _likelihood(unravel(v), ys)))(vector)
    np.testing.assert_allclose(found, WEIGHTS @ values, rtol=1e-8, atol=1e-8 * float(jnp.abs(found).max()))
    assert (unravel(found)["P0"] == 0).all()


@pytest.mark.slow
def test_curvature_equals_central_differences():
    p, ys = _problem()
    vector, unravel = ravel_pytree(p)
    gradient = jax.jit(jax.grad(lambda v: _likelihood(unravel(v), ys)))
    direction = jnp.sin(jnp.arange(vector.size, dtype=vector.dtype))
    numeric = WEIGHTS @ jnp.stack([gradient(vector + s * direction) for s in STENCIL])
    curvature = jax.jit(lambda v: jax.jvp(gradient, (v,), (direction,))[1])(vector)
    np.testing.assert_allclose(curvature, numeric, rtol=1e-7, atol=1e-7 * float(jnp.abs(numeric).max()))


def test_no_covariance_is_computed_per_run():
    """Without a mask only means are batched, so that thousands of runs cost two products with the mean each."""
    (F, H, Q, R, m0, P0), _ = random_model(7, 3, 2)
    filt = jf.steady_state(jf.models.linear_gaussian(F, H, Q, R, m0, P0))
    ys = jnp.zeros((5, 12, 2))
    run = jax.vmap(lambda y: jf.filter(filt, y, outputs=_mean_and_covariances), out_axes=(0, None))
    mean, covariances = run(ys)  # out_axes None is refused for what is batched
    assert mean.shape == (5, 12, 3)
    assert covariances[0].shape == (12, 3, 3)


def _mean_and_covariances(state, info):
    del state
    return info.mean, (info.cov, info.innovation_cov)


WITHOUT = {
    "not driven": {"F": [[1.0, 1.0], [0.0, 1.0]], "H": [[1.0, 0.0]], "Q": [[0.0, 0.0], [0.0, 0.0]]},
    "not seen": {"F": [[1.0, 0.0], [0.0, 0.9]], "H": [[0.0, 1.0]], "Q": [[1.0, 0.0], [0.0, 1.0]]},
    "perfect sensor of what has no noise": {
        "F": [[1.0, 1.0], [0.0, 1.0]],
        "H": [[1.0, 0.0]],
        "Q": [[0.0, 0.0], [0.0, 1.0]],
    },
    "not seen, growing": {"F": [[1.2, 0.0], [0.0, 0.9]], "H": [[0.0, 1.0]], "Q": [[1.0, 0.0], [0.0, 1.0]]},
}


@pytest.mark.parametrize("case", WITHOUT)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_no_steady_state_is_refused_or_flagged(case, dtype):
    arrays = {name: jnp.asarray(x, dtype) for name, x in WITHOUT[case].items()}
    rest = {
        "R": jnp.full((1, 1), 0.0 if "perfect" in case else 1.0, dtype),
        "m0": jnp.zeros(2, dtype),
        "P0": jnp.eye(2, dtype=dtype),
    }
    with pytest.raises(ValueError, match="model: has no steady state"):
        jf.steady_state(jf.models.linear_gaussian(**arrays, **rest))

    def traced(arrays):
        out = jf.filter(jf.steady_state(jf.models.linear_gaussian(**arrays, **rest)), jnp.ones((4, 1), dtype))
        return out.log_lik.sum(), out

    gradient, out = jax.jit(jax.grad(traced, has_aux=True))(arrays)
    assert ((out.status & int(jf.Status.BOUND)) != 0).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((gradient, out)))


def test_undetectable_but_decaying_is_no_trouble():
    model = jf.models.linear_gaussian(
        np.diag([0.5, 0.9]), np.array([[0.0, 1.0]]), np.zeros((2, 2)), np.ones((1, 1)), np.zeros(2), np.eye(2)
    )
    assert (jf.steady_state(model).init.args[0].steady.predicted == 0).all()


def _of_u(u, dt):
    return u["F"]


def _of_dt(u, dt):
    return jnp.array([[1.0, dt], [0.0, 1.0]])


@pytest.mark.parametrize("function", [_of_u, _of_dt, Partial(_of_u)])
def test_a_model_that_varies_is_refused(function):
    eye = np.eye(2)
    model = jf.models.linear_gaussian(function, eye, eye, eye, np.zeros(2), eye)
    with pytest.raises(ValueError, match="model: F must not depend on u or dt in a steady-state filter"):
        jf.steady_state(model)


@pytest.mark.parametrize("name", ["dt", "q_scale", "r_scale"])
def test_what_would_change_the_gain_is_refused(name):
    (F, H, Q, R, m0, P0), ys = random_model(8, 3, 2)
    filt = jf.steady_state(jf.models.linear_gaussian(F, H, Q, R, m0, P0))
    with pytest.raises(ValueError, match=f"{name}: given, but the steady-state filter has one fixed interval"):
        jf.filter(filt, ys, **{name: 2.0})


def test_an_imm_replaces_the_mean():
    """``with_moments`` sets the mean; the covariance comes back with the next prediction."""
    (F, H, Q, R, m0, P0), ys = random_model(9, 3, 2)
    filters = [jf.steady_state(jf.models.linear_gaussian(F, H, s * Q, R, m0, P0)) for s in (1.0, 10.0)]
    out = jf.filter(jf.imm(filters, np.array([[0.95, 0.05], [0.05, 0.95]])), ys[:20])
    assert np.isfinite(out.mean).all()
    assert (np.linalg.eigvalsh(out.cov) > 0).all()
