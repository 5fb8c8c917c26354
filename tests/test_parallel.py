"""The filter and smoother in parallel over time against those in sequence."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxfilt as jf
from tests import reference

T = 60


def close(a, b, tol):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_allclose(np.asarray(x), np.asarray(y), rtol=0, atol=tol * max(1e-300, np.abs(y).max()))


def _turning(turn, u, dt):
    c, s = jnp.cos(turn * dt * u[0]), jnp.sin(turn * dt * u[0])
    rotation = jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])
    return 0.97 * jnp.block(
        [[rotation, jnp.zeros((2, 1), c.dtype)], [jnp.zeros((1, 2), c.dtype), jnp.ones((1, 1), c.dtype)]]
    )


def _noise(u, dt):
    return dt * (1 + u[1] ** 2) * jnp.asarray(np.diag([0.3, 0.2, 0.0]) + 0.05)


def _shift(u, dt):
    return dt * jnp.stack([u[1], u[0], u[0] * u[1]])


def _rows(u, dt):
    return jnp.stack([jnp.stack([u[0], jnp.ones(()), jnp.zeros(())]), jnp.stack([u[1], jnp.zeros(()), jnp.ones(())])])


@functools.cache
def case(name):
    """``(model, ys, options)`` of one way to use the filter."""
    rng = np.random.default_rng(3)
    F, H, Q, R, m0, P0 = reference.random_model(rng, 3, 2)
    ys, mask = rng.normal(size=(T, 2)) * 2, rng.random((T, 2)) < 0.7
    B, D, u = rng.normal(size=(3, 2)), rng.normal(size=(2, 2)), rng.normal(size=(T, 2))
    A = rng.normal(size=(5, 5))
    joint = A @ A.T + 0.1 * np.eye(5)
    plain = jf.models.linear_gaussian(F, H, Q, R, m0, P0)
    inputs = jf.models.linear_gaussian(F, H, Q, R, m0, P0, B=B, D=D)
    functions = jf.models.linear_gaussian(Partial(_turning, jnp.asarray(0.3)), _rows, _noise, R, m0, P0, B=_shift, D=D)
    correlated = jf.models.linear_gaussian(F, H, joint[:3, :3], joint[3:, 3:], m0, P0, B=B, D=D, S=joint[:3, 3:])
    scales = {"q_scale": rng.uniform(0.5, 2, (T, 3)), "r_scale": rng.uniform(0.5, 2, (T, 2))}
    dt = rng.uniform(0.1, 2, T)
    return {
        "plain": (plain, ys, {}),
        "masked": (plain, np.where(mask, ys, np.nan), {"mask": mask}),
        "missed samples": (plain, ys, {"mask": (np.arange(T) % 20) < 12}),
        "first update only": (inputs, ys, {"mask": mask, "u": u, "first_update_only": True}),
        "inputs": (inputs, ys, {"u": u, "mask": mask}),
        "scales": (plain, ys, {**scales, "mask": mask}),
        "functions": (functions, ys, {"u": u, "dt": dt, "mask": mask}),
        "correlated": (correlated, np.where(mask, ys, np.nan), {"u": u, "mask": mask, "q_scale": 1.5, "r_scale": 1.5}),
        "correlated, first update only": (correlated, ys, {"u": u, "first_update_only": True}),
        "intervals": (
            jf.models.constant_velocity(dt=1.0, q=0.3, r=2.0, m0=[0.0] * 4, P0=100 * np.eye(4)), ys, {"dt": dt}
        ),
    }[name]  # fmt: skip


CASES = ["masked", "first update only", "functions", "correlated"]
MORE = ["plain", "missed samples", "inputs", "scales", "correlated, first update only", "intervals"]


@pytest.mark.parametrize("name", [*CASES, *(pytest.param(name, marks=pytest.mark.slow) for name in MORE)])
def test_equals_the_filter_and_smoother_in_sequence(name):
    """Every field of Info, the prediction included, and the smoothed moments."""
    model, ys, options = case(name)
    expected = jf.filter(jf.kalman(model), ys, outputs=jf.everything, **options)
    out = jf.filter_parallel(model, ys, outputs=jf.everything, **options)
    smoothed = jf.rts_parallel(out)
    close(smoothed, jf.rts(expected), 1e-11)
    assert (np.asarray(smoothed.cov) == np.swapaxes(smoothed.cov, 1, 2)).all()
    assert (np.asarray(out.cov) == np.swapaxes(out.cov, 1, 2)).all()
    # Of the first step with what lies before it, which nothing uses; without a prediction it is no covariance.
    out, expected = (
        x._replace(prediction=x.prediction._replace(cross=x.prediction.cross[1:])) for x in (out, expected)
    )
    close(out, expected, 1e-12)


@pytest.mark.parametrize(
    ("block", "associative"),
    [
        (7, True),
        *(pytest.param(*x, marks=pytest.mark.slow) for x in [(1, True), (1, False), (T - 1, True), (1000, False)]),
    ],
)
def test_neither_the_blocks_nor_how_they_are_joined_matter(block, associative):
    model, ys, options = case("masked")
    expected = jf.filter(jf.kalman(model), ys, **options)
    close(jf.filter_parallel(model, ys, block=block, associative=associative, **options), expected, 1e-12)
    smoothed = jf.smooth_parallel(model, ys, block=block, associative=associative, **options)
    close(smoothed, jf.smooth(jf.kalman(model), ys, **options), 1e-12)


@pytest.mark.parametrize("length", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_short_series(length):
    model, ys, _ = case("plain")
    close(jf.filter_parallel(model, ys[:length]), jf.filter(jf.kalman(model), ys[:length]), 1e-13)
    close(jf.smooth_parallel(model, ys[:length]), jf.smooth(jf.kalman(model), ys[:length]), 1e-13)


def test_ten_thousand_steps():
    """A large prior, a memory of some hundred steps, a state that runs far off, gaps."""
    model = jf.models.constant_velocity(dt=1.0, q=1e-4, r=4.0, m0=[0.0, 0.0], P0=1e4 * np.eye(2))
    rng = np.random.default_rng(0)
    ys = 30.0 * np.arange(10_000)[:, None] + 2 * rng.normal(size=(10_000, 1))
    mask = (np.arange(10_000) % 700) < 550
    expected = jf.filter(jf.kalman(model), ys, mask=mask, outputs=jf.everything)
    out = jf.filter_parallel(model, ys, mask=mask, outputs=jf.everything)
    close(jf.summary(None, out), jf.summary(None, expected), 1e-9)
    close(jf.rts_parallel(out), jf.rts(expected), 1e-9)


@pytest.mark.slow
def test_larger_states_run_on_matrices():
    """Beyond the size where computing by entries pays."""
    matrices = reference.random_model(np.random.default_rng(5), 9, 4)
    ys = np.random.default_rng(6).normal(size=(30, 4))
    model = jf.models.linear_gaussian(*matrices)
    close(jf.smooth_parallel(model, ys), jf.smooth(jf.kalman(model), ys), 1e-11)


@pytest.mark.slow
def test_any_filter_is_smoothed_in_parallel():
    """Smoothing rests on what the filter reports, here the moments of two models."""
    F, H, Q, R, m0, P0 = reference.random_model(np.random.default_rng(7), 2, 1)
    filters = [jf.kalman(jf.models.linear_gaussian(F, H, s * Q, R, m0, P0)) for s in (1.0, 20.0)]
    ys = np.random.default_rng(8).normal(size=(40, 1))
    out = jf.filter(jf.imm(filters, np.array([[0.9, 0.1], [0.2, 0.8]])), ys, outputs=jf.everything)
    close(jf.rts_parallel(out), jf.rts(out), 1e-12)


def _moments(state, info):
    return state.mean, info.log_lik


def test_outputs_and_batches():
    model, ys, _ = case("plain")
    runs = ys[None] + np.arange(3.0)[:, None, None]
    mean, log_lik = jax.vmap(lambda y: jf.filter_parallel(model, y, outputs=_moments))(runs)
    expected = jax.vmap(lambda y: jf.filter(jf.kalman(model), y, outputs=_moments))(runs)
    close((mean, log_lik), expected, 1e-12)


@functools.partial(jax.jit, static_argnames=("name", "parallel"))
def _gradients(factors, name, parallel):
    model, ys, options = case(name)
    changed = {"m0": model.m0 + factors["m0"], "P0": factors["P0"] * model.P0, "R": factors["R"] * model.R}
    changed |= {} if callable(model.Q) else {"Q": factors["Q"] * model.Q, "F": factors["F"] * model.F}
    model = model._replace(**changed)
    if parallel:
        out = jf.filter_parallel(model, ys, outputs=jf.everything, **options)
        smoothed = jf.rts_parallel(out)
    else:
        out = jf.filter(jf.kalman(model), ys, outputs=jf.everything, **options)
        smoothed = jf.rts(out)
    return out.log_lik.sum() + jnp.sin(smoothed.mean).sum() + smoothed.cov.sum()


@pytest.mark.parametrize(
    "name", ["masked", *(pytest.param(x, marks=pytest.mark.slow) for x in ("correlated", "functions"))]
)
def test_gradients_equal_those_in_sequence(name):
    factors = {name: jnp.asarray(1.0) for name in ("m0", "P0", "Q", "R", "F")}
    found, expected = (jax.grad(_gradients)(factors, name, parallel) for parallel in (True, False))
    for key, slope in expected.items():
        np.testing.assert_allclose(found[key], slope, rtol=1e-8, atol=1e-10)


def _cv(P0, q, r, dtype, noise="continuous"):
    m0 = jnp.asarray([0.0, 10.0], dtype)
    args = {"dt": 1.0, "q": q, "r": r, "P0": P0}
    args = {name: jnp.asarray(x, dtype) for name, x in args.items()}
    return jf.models.constant_velocity(m0=m0, noise=noise, **args)


SINGULAR = {
    "P0 = 0": (np.zeros((2, 2)), 0.1, 25.0, "continuous"),
    "Q = 0": (np.diag([100.0, 25.0]), 0.0, 25.0, "continuous"),
    "Q of rank 1": (np.diag([100.0, 25.0]), 0.1, 25.0, "piecewise"),
    "P0 = Q = 0": (np.zeros((2, 2)), 0.0, 25.0, "continuous"),
    "R = 0": (np.diag([100.0, 25.0]), 0.1, 0.0, "continuous"),
    "R = 0, Q of rank 1": (np.zeros((2, 2)), 0.1, 0.0, "piecewise"),
}


@functools.partial(jax.jit, static_argnames=("noise", "parallel"))
def _singular(P0, q, r, ys, noise, parallel):
    """``(Info, smoothed, slope of the likelihood in r)``, compiled once for several cases."""

    def run(r):
        model = _cv(P0, q, r, ys.dtype, noise)
        if parallel:
            out = jf.filter_parallel(model, ys, outputs=jf.everything)
        else:
            out = jf.filter(jf.kalman(model), ys, outputs=jf.everything)
        return out.log_lik.sum(), out

    slope, out = jax.grad(run, has_aux=True)(r)
    return jf.summary(None, out), (jf.rts_parallel if parallel else jf.rts)(out), slope


@pytest.mark.parametrize(
    "case", [pytest.param(name, marks=[pytest.mark.slow] * ("rank 1" in name)) for name in SINGULAR]
)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_singular_covariances(case, dtype):
    """Finite and equal to the filter in sequence, the likelihood's gradient too."""
    *numbers, noise = SINGULAR[case]
    ys = 10.0 * jnp.arange(1, 41, dtype=dtype)[:, None] + 3 * jax.random.normal(jax.random.key(0), (40, 1), dtype)
    given = [jnp.asarray(x, dtype) for x in numbers]
    out, smoothed, slope = _singular(*given, ys, noise, True)
    expected = _singular(*given, ys, noise, False)
    tol = 2e-4 if dtype == jnp.float32 else 1e-9
    close(out, expected[0], tol)
    assert (out.status == expected[0].status).all()
    close(smoothed.mean, expected[1].mean, tol)
    # A smoother subtracts from filtered covariances, whose rounding stays in what is left.
    scale = float(jnp.abs(out.cov).max())
    np.testing.assert_allclose(smoothed.cov, expected[1].cov, rtol=0, atol=tol / 4 * scale)
    np.testing.assert_allclose(slope, expected[2], rtol=1e-3 if dtype == jnp.float32 else 1e-8)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_what_a_block_cannot_learn_is_flagged(dtype):
    """A perfect sensor of a state without noise: the blocks after the first say that they lack something."""
    model = _cv(np.diag([100.0, 25.0]), 0.0, 0.0, dtype)
    ys = 10.0 * jnp.arange(1, 17, dtype=dtype)[:, None]
    out = jf.filter_parallel(model, ys, block=4)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(out))
    assert (np.asarray(out.status[4:]) & int(jf.Status.SINGULAR) != 0).all()
    assert out.status[0] == 0
    masked = jf.filter_parallel(model, ys, mask=jnp.arange(16) > 12, block=4)  # nothing to learn before the last block
    assert (np.asarray(masked.status) & int(jf.Status.SINGULAR) == 0)[:13].all()


@jax.jit
def _flagged(ys, dt, mask):
    return jf.filter_parallel(case("intervals")[0], ys, dt=dt, mask=mask, block=10)


def test_bad_values_and_intervals_are_flagged_under_a_transformation():
    """A NaN counts as absent from the next block on; in sequence its innovation is 0."""
    _, ys, options = case("intervals")
    dirty, dt = jnp.asarray(ys).at[31, 0].set(jnp.nan), jnp.asarray(options["dt"]).at[17].set(-1.0)
    whole = jnp.ones(ys.shape, bool)
    out = _flagged(dirty, dt, whole)
    assert np.flatnonzero(out.status & int(jf.Status.NONFINITE)).tolist() == [31]
    assert np.flatnonzero(out.status & int(jf.Status.BOUND)).tolist() == [17]
    masked = _flagged(dirty, dt, whole.at[31, 0].set(False))
    for a, b in zip(jax.tree.leaves(out), jax.tree.leaves(masked), strict=True):
        np.testing.assert_allclose(np.delete(a, range(31, 40), axis=0), np.delete(b, range(31, 40), axis=0), rtol=1e-12)


@pytest.mark.parametrize("block", [0, -3, 2.5, True])
def test_a_bad_block_is_refused(block):
    model, ys, _ = case("plain")
    with pytest.raises(ValueError, match=r"block: expected an int >= 1"):
        jf.filter_parallel(model, ys, block=block)


def test_bad_input_is_refused_as_in_sequence():
    model, ys, _ = case("plain")
    with pytest.raises(ValueError, match="ys: expected 2 components"):
        jf.filter_parallel(model, ys[:, :1])
    with pytest.raises(TypeError, match="ys: is float32, but the filter's model is float64"):
        jf.filter_parallel(model, ys.astype(np.float32))
    with pytest.raises(ValueError, match="dt: given, but the model's F is a fixed matrix"):
        jf.filter_parallel(model, ys, dt=1.0)
    with pytest.raises(ValueError, match=r"ys\[4, 0\] is nan"):
        jf.filter_parallel(model, np.where(np.arange(T)[:, None] == 4, np.nan, ys))
    with pytest.raises(ValueError, match="u: the model has an input matrix B"):
        jf.filter_parallel(case("inputs")[0], ys)
    with pytest.raises(ValueError, match="u: the model has an input matrix B"):
        jf.filter_parallel(case("inputs")[0], ys, first_update_only=True)
    with pytest.raises(ValueError, match="out: has no prediction"):
        jf.rts_parallel(jf.filter_parallel(model, ys))
