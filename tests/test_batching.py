"""The batch entry point."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxfilt as jf

T = 6
P0 = np.diag([100.0, 100.0, 10.0, 10.0])


def loss(log_r, y):
    model = jf.models.constant_velocity(dt=1.0, q=0.1, r=jnp.exp(log_r), m0=np.zeros(4), P0=P0)
    return jf.filter(jf.kalman(model), y, outputs=jf.log_lik, keep="sum")


def modes(log_r, y):
    models = [jf.models.constant_velocity(dt=1.0, q=q, r=jnp.exp(log_r), m0=np.zeros(4), P0=P0) for q in (0.1, 1.0)]
    filt = jf.imm([jf.kalman(model) for model in models], np.array([[0.9, 0.1], [0.1, 0.9]]))
    return jf.filter(filt, y, outputs=jf.log_lik, keep="sum")


def history(filt, y):
    return jf.filter(filt, y, outputs=jf.packed)


def data(runs):
    keys = jax.random.split(jax.random.key(0))
    return 3 + 0.1 * jax.random.normal(keys[0], (runs,)), 5 * jax.random.normal(keys[1], (runs, T, 2))


@pytest.fixture(scope="module")
def expected():
    """Of 20 runs."""
    log_r, ys = data(20)
    return jax.jit(jax.vmap(loss))(log_r, ys), jax.jit(jax.vmap(jax.grad(loss)))(log_r, ys)


@pytest.mark.parametrize("chunk", [8, 512])
def test_values_and_gradients_are_those_of_vmap(expected, chunk):
    """Also in parts, the last of which is not full."""
    np.testing.assert_allclose(jf.batch(loss, chunk=chunk)(*data(20)), expected[0], rtol=1e-13)
    np.testing.assert_allclose(jf.batch(jax.grad(loss), chunk=chunk)(*data(20)), expected[1], rtol=1e-12)


def test_axes_and_structures_of_arguments(expected):
    """As in vmap: a tree of axes, an axis that is not the first, what is shared, results that are trees."""
    log_r, ys = data(20)
    out = jf.batch(loss, (0, 1))(log_r, jnp.moveaxis(ys, 0, 1))
    np.testing.assert_allclose(out, expected[0], rtol=1e-13)
    out = jf.batch(_of_dict, ({"r": None, "y": -3},))({"r": log_r[0], "y": ys})
    want = jax.vmap(loss, (None, 0))(log_r[0], ys)
    np.testing.assert_allclose(out["sum"], want, rtol=1e-13)
    out = jf.batch(Partial(_bound, log_r[0]))(ys)
    np.testing.assert_allclose(out, want, rtol=1e-13)


def _of_dict(given):
    return {"sum": loss(given["r"], given["y"])}


def _bound(log_r, y):
    return loss(log_r, y)


def test_packed_covariances_of_a_filter_given_as_an_argument():
    """Shared by all runs, or one for each; its zeros and equal entries are seen in either case."""
    _, ys = data(20)
    model = jf.models.constant_velocity(dt=1.0, q=0.1, r=25.0, m0=np.zeros(4), P0=P0)
    want = jf.filter(jf.kalman(model), ys[0])
    mean, triangle = jf.batch(history, (None, 0))(jf.kalman(model), ys)
    assert mean.shape == (20, T, 4)
    assert triangle.shape == (20, T, 10)
    np.testing.assert_allclose(jf.unpack(triangle)[0], want.cov, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(mean[0], want.mean, rtol=1e-12)

    r = jnp.linspace(20.0, 30.0, 20)
    filts = jax.vmap(lambda r: jf.kalman(model._replace(R=r * jnp.eye(2))))(r)
    mean, triangle = jf.batch(history)(filts, ys)
    want = jf.filter(jf.kalman(model._replace(R=r[7] * jnp.eye(2))), ys[7])
    np.testing.assert_allclose(jf.unpack(triangle)[7], want.cov, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(mean[7], want.mean, rtol=1e-12)


def test_an_entry_that_is_zero_in_some_runs_only_is_not_zero():
    _, ys = data(8)
    R = jnp.stack([jnp.eye(2)] * 8).at[3, 0, 1].set(0.5).at[3, 1, 0].set(0.5)
    model = jf.models.constant_velocity(dt=1.0, q=0.1, r=25.0, m0=np.zeros(4), P0=P0)
    _, triangle = jf.batch(_with_noise, (None, 0, 0))(model, R, ys)
    for run in (3, 4):
        want = jf.filter(jf.kalman(model._replace(R=R[run])), ys[run])
        np.testing.assert_allclose(jf.unpack(triangle)[run], want.cov, rtol=1e-12, atol=1e-12)


def _with_noise(model, R, y):
    return jf.filter(jf.kalman(model._replace(R=R)), y, outputs=jf.packed)


def test_the_structure_of_an_argument_is_used_and_a_second_call_compiles_nothing(caplog):
    model = jf.models.constant_velocity(dt=1.0, q=0.1, r=25.0, m0=np.zeros(4), P0=P0)
    run = jf.batch(history, (None, 0))
    _, ys = data(8)
    run(jf.kalman(model), ys)
    with jax.log_compiles():
        jf.batch(history, (None, 0))(jf.kalman(model._replace(m0=jnp.ones(4))), 2 * ys)
    assert not [r for r in caplog.records if "Compiling _compute" in r.getMessage()]


def test_random_keys_are_batched_too():
    keys = jax.random.split(jax.random.key(1), 5)
    np.testing.assert_array_equal(jf.batch(jax.random.normal, chunk=2)(keys), jax.vmap(jax.random.normal)(keys))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: jf.batch(loss, chunk=0), "chunk: expected an int >= 1, got 0"),
        (lambda: jf.batch(loss, None)(*data(2)), "in_axes: expected .* got no batched argument"),
        (lambda: jf.batch(loss)(data(3)[0], data(2)[1]), r"in_axes: .* got \[2, 3\]"),
        (lambda: jf.batch(loss)(jnp.zeros(0), jnp.zeros((0, T, 2))), "expected at least one run"),
    ],
)
def test_bad_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_devices_give_the_same_numbers(tmp_path):
    code = (
        f"import sys, numpy as np, jax; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "jax.config.update('jax_enable_x64', True)\n"
        "import jaxfilt as jf; jf.use_cores(2)\n"
        "import test_batching as t; assert len(jax.devices()) == 2\n"
        "np.save(sys.argv[1], jf.batch(t.loss, chunk=4)(*t.data(19)))\n"
        "np.save(sys.argv[2], jf.batch(jax.grad(t.loss), chunk=4)(*t.data(19)))\n"
        "modes = jax.make_jaxpr(lambda *a: jf.batch(t.modes)(*a))(*t.data(64))\n"
        "assert 'dot_general' not in str(modes)\n"  # the scalar form, also where models are stacked
    )
    files = [str(tmp_path / name) for name in ("values.npy", "gradients.npy")]
    done = subprocess.run([sys.executable, "-c", code, *files], env=dict(os.environ), capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
    log_r, ys = data(19)
    for file, f in zip(files, (loss, jax.grad(loss)), strict=True):
        np.testing.assert_allclose(np.load(file), jf.batch(f)(log_r, ys), rtol=1e-12)
