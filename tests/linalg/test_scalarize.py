"""The scalar form against the dense one: same numbers, same derivatives, and only what varies is carried."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt.linalg import is_zero, tria
from jaxfilt.linalg.entries import NoScalarForm, assemble, entries
from jaxfilt.linalg.scalarize import Interpreter
from tests.registry import REGISTRY, params, series

# Too many scalars, or random numbers: these stay dense.
DENSE = {
    "blend", "covariance_intersection", "extended_second", "fuzzy_difference", "fuzzy_noise",
    "fuzzy_scaled", "fuzzy_stationary", "nested", "sinusoid_fit", "sqrt_cubature", "sqrt_unscented",
    "variable_dimension", "joint_particle", "multi_mode_particle", "particle", "particle_guided", "particle_transport",
    "rao_blackwellized", "rao_blackwellized_union",
}  # fmt: skip


def names(default):
    return [
        pytest.param(name, marks=[] if name in default else [pytest.mark.slow])
        for name in sorted(set(REGISTRY) - DENSE)
    ]


def close(got, want, tol):
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=0, atol=tol * max(1.0, np.abs(b).max(initial=0)))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
@pytest.mark.parametrize("name", names({"imm", "kalman"}))
def test_all_outputs_equal_the_dense_ones(name, dtype):
    example = REGISTRY[name]
    filt, ys = example.make(params(example, dtype)), series(example, dtype, runs=3)[0]
    got, want = (
        jf.filter(filt, ys, form=form, outputs=jf.everything, **example.options) for form in ("scalar", "dense")
    )
    close(got, want, 1e-4 if dtype == jnp.float32 else 1e-12)


@pytest.mark.parametrize("name", names({"kalman"}))
def test_gradients_equal_the_dense_ones(name):
    example = REGISTRY[name]
    ys = series(example, jnp.float64, runs=3)[0]

    def loss(p, form):
        out = jf.filter(example.make(p), ys, form=form, **example.options)
        return sum(x.sum() for x in (out.mean**2, out.cov, out.log_lik) if x is not None)

    p = params(example, jnp.float64)
    got, want = (jax.jit(jax.grad(loss), static_argnames="form")(p, form) for form in ("scalar", "dense"))
    close(got, want, 1e-9)


def velocity(r, q=0.1):
    P0 = np.diag([100.0, 100.0, 10.0, 10.0])
    return jf.kalman(jf.models.constant_velocity(dt=1.0, q=q, r=r, m0=jnp.zeros(4), P0=P0))


def _log_lik(state, info):
    return info.log_lik


def scans(jaxpr):
    for eqn in jaxpr.eqns:
        if eqn.primitive.name == "scan":
            yield eqn
        else:
            for value in eqn.params.values():
                yield from scans(value.jaxpr) if hasattr(value, "jaxpr") else ()


def test_only_what_varies_is_carried():
    """Four means and three covariances for each axis; not the zeros between the axes, nor both triangles.

    Axes that are equal, noise and prior, have their covariances in common.
    """
    ys = jnp.zeros((6, 2))
    for r, carried in ((25.0, 4 + 3), (jnp.array([25.0, 30.0]), 4 + 2 * 3)):
        filt = velocity(r)
        closed = jax.make_jaxpr(lambda y, filt=filt: jf.filter(filt, y, form="scalar", outputs=_log_lik))(ys)
        (scan,) = scans(closed.jaxpr)
        assert scan.params["num_carry"] == carried


def test_structure_is_seen_of_motion_models_built_inside_jit():
    """What is traced there is the noise; the prior, H and the pattern of R are known."""

    def loss(log_r, y):
        return jf.filter(velocity(jnp.exp(log_r)), y, outputs=_log_lik, keep="sum")

    for log_r, carried in ((jnp.zeros(8), 4 + 3), (jnp.zeros((8, 2)), 4 + 2 * 3)):
        for f in (loss, jax.grad(loss)):
            closed = jax.make_jaxpr(jax.jit(jax.vmap(f)))(log_r, jnp.zeros((8, 6, 2)))
            forward = next(iter(scans(closed.jaxpr)))
            if f is loss:  # the sum besides
                assert forward.params["num_carry"] == carried + 1
            else:
                assert not any("dot_general" in str(scan) for scan in scans(closed.jaxpr))


def test_a_batch_takes_the_scalar_form_by_itself():
    """And a single run, or a few, the dense one."""
    filt = velocity(25.0)
    for runs, carried in ((1, 2), (7, 2), (8, 4 + 3)):
        closed = jax.make_jaxpr(jax.vmap(lambda y: jf.filter(filt, y, outputs=_log_lik)))(jnp.zeros((runs, 6, 2)))
        (scan,) = scans(closed.jaxpr)
        assert scan.params["num_carry"] == carried


def test_runs_with_noise_of_their_own_and_a_filter_that_is_traced():
    """Zeros are seen in a batched filter too; as an argument of jit it has none, and the numbers are the same."""
    ys = 5 * jax.random.normal(jax.random.key(0), (9, 12, 2))
    filters = jax.vmap(velocity)(jnp.linspace(10.0, 40.0, 9))
    want = jax.vmap(lambda f, y: jf.filter(f, y, form="dense"))(filters, ys)

    def run(f, y):
        return jf.filter(f, y, form="scalar")

    close(jax.vmap(run)(filters, ys), want, 1e-12)
    close(jax.jit(jax.vmap(run))(filters, ys), want, 1e-12)


def test_full_noise_is_not_taken_for_diagonal():
    R = jnp.array([[2.0, 1.5], [1.5, 3.0]])
    ys = jax.random.normal(jax.random.key(1), (8, 2))
    model = jf.models.constant_velocity(dt=1.0, q=0.1, r=R, m0=jnp.zeros(4), P0=jnp.eye(4))
    got, want = (jf.filter(jf.kalman(model), ys, form=form) for form in ("scalar", "dense"))
    close(got, want, 1e-12)


@pytest.mark.parametrize("first_update_only", [False, True])
def test_perfect_sensors_masks_and_bad_values(first_update_only):
    """A singular innovation covariance is flagged alike, and the same one of two equal sensors is used."""
    H, zero = jnp.array([[1.0, 0.0], [1.0, 0.0]]), jnp.zeros((2, 2))
    F = jnp.array([[1.0, 1.0], [0.0, 1.0]])
    filt = jf.kalman(jf.models.linear_gaussian(F, H, 0.1 * jnp.eye(2), zero, jnp.zeros(2), jnp.eye(2)))
    ys = jnp.arange(8.0)[:, None] * jnp.ones((1, 2))
    ys = ys.at[4, 0].set(jnp.nan)
    mask = np.array([[True, True], [False, True], [False, False], [True, True]] * 2)

    def run(form):
        return jax.jit(lambda y: jf.filter(filt, y, mask=mask, form=form, first_update_only=first_update_only))(ys)

    got, want = run("scalar"), run("dense")
    close(got, want, 1e-12)
    assert (np.asarray(got.status) & int(jf.Status.SINGULAR)).any()
    assert int(got.status[4]) & int(jf.Status.NONFINITE)


def test_what_has_no_scalar_form():
    particles = jf.particle(jf.models.constant_velocity(dt=1.0, q=1.0, r=1.0, m0=jnp.zeros(2), P0=jnp.eye(2)), 10)
    with pytest.raises(ValueError, match=r"form.*random numbers"):
        jf.filter(particles, jnp.zeros((3, 1)), key=jax.random.key(0), form="scalar")
    wide = jf.kalman(
        jf.models.linear_gaussian(jnp.eye(33), jnp.ones((1, 33)), jnp.eye(33), [[1.0]], jnp.zeros(33), jnp.eye(33))
    )
    with pytest.raises(ValueError, match=r"form.*shape \(33, 33\)"):
        jf.filter(wide, jnp.zeros((3, 1)), form="scalar")
    jax.vmap(lambda y: jf.filter(wide, y))(jnp.zeros((8, 3, 1)))  # dense, silently
    with pytest.raises(ValueError, match="form"):
        jf.filter(wide, jnp.zeros((3, 1)), form="sparse")


def test_no_retrace_with_new_data():
    ys = jnp.zeros((8, 5, 2))
    traced = []

    def outputs(state, info):
        traced.append(0)
        return info.log_lik

    run = jax.vmap(lambda f, y: jf.filter(f, y, outputs=outputs), (None, 0))
    run(velocity(25.0), ys)
    once = len(traced)
    run(velocity(30.0, q=0.2), ys + 1)
    assert len(traced) == once


PROGRAMS = {
    "indices": lambda A, v, i: (A[1], A[:, ::-1], v[jnp.array([2, 0])], A.at[1, 2].set(v[0]), A.at[0].add(v), A.T[i]),
    "window": lambda A, v, i: (
        jax.lax.dynamic_slice(A, (i, 0 * i), (1, 3)), jax.lax.dynamic_update_slice(v, v[:1] * 2, (i,)),
        jax.lax.dynamic_update_slice(A, A[:1] * 2, (i + 5, 0 * i)),
    ),
    "choices": lambda A, v, i: (
        jnp.argmin(A, axis=1), jnp.argmax(v), jax.lax.cond(v[0] > 0, jnp.sin, jnp.cos, v), jnp.where(A > 0, A, 0.0),
    ),
    "sums": lambda A, v, i: (
        jnp.cumsum(v), jnp.cumsum(A, axis=1), jax.nn.logsumexp(A, axis=0), jnp.prod(v), jnp.einsum("ij,kj->ik", A, A),
        jax.vmap(jnp.outer)(A, A), jnp.trace(A), jnp.kron(A, v),
    ),
    "shapes": lambda A, v, i: (
        jnp.pad(v, (1, 2)), jnp.tile(A, (2, 1)), jnp.stack([v, v], axis=1), jnp.diag(v), jnp.tril(A),
        jnp.hstack([A, A]),
    ),
    "functions": lambda A, v, i: (
        jnp.arctan2(v, A[0]), jnp.exp(v) / v, v**3, abs(v) ** 0.5, jnp.round(A), jnp.clip(v, -0.5, 0.5),
        jax.nn.softplus(v), jnp.linalg.eigvalsh(A @ A.T), v // 0.3,
    ),
    "scan": lambda A, v, i: jax.lax.scan(lambda c, a: (c + a, c * a), v, A, reverse=True),
}  # fmt: skip


@pytest.mark.parametrize("program", PROGRAMS, ids=str)
def test_programs_are_interpreted_as_they_run(program):
    A, v, i = jax.random.normal(jax.random.key(2), (3, 3)), jnp.array([0.3, -0.7, 1.2]), jnp.int32(1)
    closed = jax.make_jaxpr(PROGRAMS[program])(A, v, i)

    @jax.jit
    def interpreted(*args):
        out = Interpreter(10_000).run_closed(closed, [entries(x) for x in args])
        return [assemble(x, var.aval) for x, var in zip(out, closed.jaxpr.outvars, strict=True)]

    close(interpreted(A, v, i), jax.tree.leaves(PROGRAMS[program](A, v, i)), 1e-12)


def test_the_derivative_rule_of_the_array_forms_is_kept():
    """That of the program itself is not finite for a row of zeros."""
    A = jax.random.normal(jax.random.key(3), (2, 3)).at[1].set(0.0)
    closed = jax.make_jaxpr(tria)(A)

    def interpreted(A):
        return assemble(Interpreter(10_000).run_closed(closed, [entries(A)])[0], closed.jaxpr.outvars[0].aval)

    got, want = (jax.jit(jax.grad(lambda A, f=f: jnp.sin(f(A)).sum()))(A) for f in (interpreted, tria))
    assert np.isfinite(want).all()
    close(got, want, 1e-12)


def test_what_is_known_costs_nothing():
    """Zeros and ones are folded, and what is equal is computed once."""

    def f(A, B):
        return A @ B @ A.T

    closed = jax.make_jaxpr(f)(jnp.eye(2), jnp.eye(2))

    def count(A, B):
        interpreter = Interpreter(10_000)
        out = interpreter.run_closed(closed, [A, B])
        assert all(is_zero(out[0][i]) for i in ((0, 1), (1, 0)))
        return interpreter.count

    def trace(a, b):
        diagonal = entries(jnp.stack([a, b])[:, None] * jnp.eye(2), np.diag([1, 2]))
        counted.append(count(entries(np.eye(2)), diagonal))
        counted.append(count(diagonal, diagonal))
        return 0

    counted = []
    jax.eval_shape(trace, jnp.ones(()), jnp.ones(()))
    assert counted == [0, 4]
    with pytest.raises(NoScalarForm, match="more than 3"):
        jax.eval_shape(lambda x: Interpreter(3).run_closed(closed, [entries(x)] * 2)[0][0, 0], jnp.ones((2, 2)))


def test_covariances_that_no_run_changes_are_computed_once():
    """Same Q, R and mask in all runs: only the means are batched, not the covariances (the mask may part the axes)."""
    mask = np.array([True, True, False, True, True, True])
    batch = jax.vmap(lambda y: jf.filter(velocity(25.0), y, mask=mask, outputs=_log_lik))
    (scan,) = scans(jax.make_jaxpr(batch)(jnp.zeros((8, 6, 2))).jaxpr)
    carried = scan.invars[scan.params["num_consts"] :][: scan.params["num_carry"]]
    assert sorted(v.aval.shape for v in carried) == [()] * 6 + [(8,)] * 4
