"""Predictive control by homotopy perturbation: the printed series, the engine's exactness, the loop with a filter."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.__main__ import ROOT
from experiments.homotopy_control import boundary, filtered, loop, ltv, run, series, siso, tuning
from experiments.homotopy_control import rig as rigs
from experiments.report import Report, compare

ANGLE = float(np.deg2rad(70.0))
SHORT = run.HORIZONS["0.1 s"]


# --- the series -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def deviations():
    """From what is printed, by example, step and function."""
    return run.printed_deviations()


def test_every_printed_coefficient(deviations):
    assert len(deviations) == 26
    for where, (_, deviation) in deviations.items():
        assert deviation < 1e-4, where


def test_the_three_forms_agree():
    p = ltv.settings(order=12, T=0.2)
    M, b, _ = ltv.hamiltonian(p, jnp.asarray(0.3))
    z0 = jnp.array([0.2, 1.0, -3.0, 2.0])
    terms = series.affine_series(M, b, z0, 4)
    times, nodes = jax.jit(lambda z: series.chebyshev_series(Partial(ltv.field, p), z, 0.3, 0.2, 4))(z0)
    for k in (7, 24):
        values = jax.vmap(series.evaluate, (0, None))(terms, times[k])
        np.testing.assert_allclose(values, nodes[:, k], rtol=1e-11, atol=1e-11 * float(jnp.abs(nodes).max()))
    np.testing.assert_allclose(series.picard(M, b, z0, 3), terms.sum(axis=0), rtol=1e-12, atol=1e-12)


def test_taylor_coefficients_by_recurrence_by_jet_and_on_nodes():
    p = rigs.corrected(ANGLE)
    z0 = jnp.array([*rigs.START, 0.3, -0.2, 0.5, 0.1])
    field = Partial(rigs.hamiltonian_field, p, jnp.asarray(ANGLE))
    c = jax.jit(lambda z: series.quadratic_series(rigs.field(p, jnp.asarray(ANGLE)), rigs.lift(z), 3)[:, :8])(z0)
    scale = np.abs(np.asarray(c)).max(axis=1, keepdims=True)
    by_jet = jax.jit(lambda z: series.taylor_series(field, z, 3))(z0)
    np.testing.assert_allclose(by_jet / scale, c / scale, atol=1e-12)
    # for an autonomous field the m-th term is c_m t^m
    times, nodes = jax.jit(lambda z: series.chebyshev_series(lambda z, t: field(z), z, 0.0, 0.1, 3, nodes=8))(z0)
    for m in range(3):
        expected = np.asarray(times)[:, None] ** m * np.asarray(c[m])
        np.testing.assert_allclose(nodes[m], expected, atol=1e-12 * np.abs(expected).max())


def test_many_terms_are_the_matrix_exponential():
    assert siso.gain(siso.settings(terms=24)) == pytest.approx(siso.exact_gain(1.0), abs=1e-8)
    assert 2 * siso.exact_gain(1.0) == pytest.approx(4.316487, abs=1e-6)


@pytest.mark.parametrize("horizon", [2, 3])
def test_closed_forms_of_two_terms(horizon):
    p, T = siso.settings(horizon=horizon), horizon * siso.DELTA
    assert siso.gain(p) == pytest.approx(siso.closed_form(T) / (2 * siso.R), rel=1e-12)
    # a constant reference leaves the offset of a weighed input
    window = jnp.full(horizon + 1, 0.5)
    rest = {2: 100 * 0.5 / 10.11, 3: 125 * 0.5 / 12.615}[horizon]
    planned = siso.plan(p, window, jnp.array([rest]))
    assert float(planned.states[1, 0]) == pytest.approx(0.0, abs=1e-9)


def test_a_linear_plant_through_newton_is_one_linear_solve():
    p = ltv.settings()
    M, b, _ = ltv.hamiltonian(p, jnp.zeros(()))
    x = jnp.array(ltv.X0)

    def residual(alpha):
        z = series.evaluate(series.affine_series(M, b, jnp.concatenate([x, alpha]), 3).sum(axis=0), 0.2)
        return z[2:] - 3.0 * z[:2]

    solved = jax.jit(lambda start: boundary.newton(residual, start, 1).value)(jnp.array([5.0, -7.0]))
    np.testing.assert_allclose(solved, jax.jit(lambda: boundary.solve_affine(residual, 2))(), rtol=1e-12)


# --- bands ------------------------------------------------------------------------------------------------------------


def test_bands_of_the_linear_examples():
    _, facts = run.siso_table((2,))
    assert facts["2 hold -0.1"] < 0.01
    assert max(facts["2 hold -0.05"], facts["2 hold -0.2"]) < 0.06
    assert facts["2 poly -0.1"] > 0.1
    assert 1.50 <= run.input_ratios()[0] <= 1.54
    _, iae = run.ltv_table({name: ltv.course(ltv.settings(w)) for name, w in ltv.WEIGHTS.items()})
    assert (iae["I"] < 0.5 * iae["III"]).all()
    assert (iae["III"] < 0.7 * iae["II"]).all()


def test_the_published_controllers_of_the_rig():
    five = rigs.course(rigs.printed(T=0.1, delta=0.05), 1.2217, apply="poly", state="model")
    psi = np.rad2deg(np.asarray(five.x[:, 0]))
    assert 67.5 <= psi[20] <= 70
    assert 63 <= psi[400] <= 69
    off = [float(jnp.abs(jnp.rad2deg(run.fig7(h).x[-1, 0]) - 90)) for h in (0.25, 1.0, 10.0, 20.0)]
    assert off == sorted(off, reverse=True)
    assert max(off[2:]) < 3
    assert min(off[:2]) > 10


def test_the_corrected_controller_settles():
    course = rigs.course(rigs.corrected(ANGLE), ANGLE, seconds=8)
    psi = np.rad2deg(np.asarray(course.x[:, 0]))
    assert abs(psi[-1] - 70) < 1e-2
    assert psi.max() < 72
    assert (np.abs(psi[40:] - 70) < 0.02 * 10).all()
    assert float(course.plans.residual.max()) < 1e-8
    assert bool(course.plans.ok.all())


def test_equilibrium_costates_and_riccati():
    for degrees, rotor in ((60, 0.59384), (70, 0.61890), (90, 0.63869)):
        x, u, exists = rigs.equilibrium(rigs.Rig(), jnp.asarray(np.deg2rad(degrees)))
        assert float(u) == pytest.approx(rotor, abs=1e-5)
        assert bool(exists)
        np.testing.assert_allclose(rigs.derivative(rigs.Rig(), x, u), 0, atol=1e-12)
    A, B = rigs.linearised(rigs.Rig(), ANGLE)
    for q, expected in (((10.0, 0, 1, 0), (1.85979, 1.12743, 10.45911, 0.89754)),
                        ((80.0, 0, 80, 0), (6.41223, 2.76600, 21.72118, 1.46635))):  # fmt: skip
        S = boundary.care(A, B, np.diag(q), np.eye(1))
        np.testing.assert_allclose(np.asarray(B.T) @ S, [expected], atol=1e-5)
        np.testing.assert_allclose(boundary.care_by_sign(A, B, jnp.diag(jnp.array(q)), jnp.eye(1)), S, rtol=1e-10)
    p, z = rigs.corrected(ANGLE), jnp.array([1.0, 0.2, 0.5, -0.3, 0.3, -0.2, 0.5, 0.1])
    both = jax.jit(
        lambda p, angle, z, d: (
            rigs.hamiltonian_field(p, angle, z, d),
            series.quadratic_series(rigs.field(p, angle, d), rigs.lift(z), 1),
        )
    )
    for d in (0.0, 0.01):
        expected, c = both(p, jnp.asarray(ANGLE), z, d)
        np.testing.assert_allclose(c[1, :8], expected, atol=1e-12 * float(jnp.abs(expected).max()))


@pytest.mark.parametrize(
    ("T", "stages", "steps", "bound"), [(0.5, 10, 0, 1e-5), pytest.param(2.0, 20, 8, 1e-3, marks=pytest.mark.slow)]
)
def test_alpha_against_scipys_collocation(T, stages, steps, bound):
    """By single shooting, and over a long horizon by multiple shooting."""
    x = filtered.rest_at(float(np.deg2rad(60.0)))
    p = rigs.corrected(ANGLE, q=(80.0, 0.0, 80.0, 0.0), T=T, stages=stages)
    alpha, residual = rigs.alpha_of(p, jnp.asarray(ANGLE), x, steps)
    reference = rigs.boundary_reference(p, ANGLE, np.asarray(x))
    assert np.abs(np.asarray(alpha) - reference).max() < bound * np.abs(reference).max()
    assert float(residual) < 1e-9


@pytest.mark.slow
def test_short_multiple_shooting_is_single_shooting():
    x = filtered.rest_at(float(np.deg2rad(60.0)))
    p = rigs.corrected(ANGLE, T=0.1, degree=4, stages=2)
    one, other = (rigs.alpha_of(p, jnp.asarray(ANGLE), x, steps)[0] for steps in (0, 4))
    np.testing.assert_allclose(one, other, rtol=1e-10)


# --- the filter in the loop -------------------------------------------------------------------------------------------


def _check_loop(seed, horizon):
    table, loops, scores = run.loop_table(100, seed, (horizon,))
    assert all(bool(jnp.isfinite(out.x).all() & jnp.isfinite(out.u).all()) for out in loops.values())
    assert np.sqrt(scores[f"EKF, 70°, T = {horizon}"].square.mean()) < 0.12
    assert np.sqrt(scores[f"EKF + torque, 70°, T = {horizon}"].square.mean()) < 0.2
    assert abs(scores[f"EKF, gravity +10 %, T = {horizon}"].mean.mean()) > 4
    assert abs(scores[f"EKF + torque, gravity +10 %, T = {horizon}"].mean.mean()) < 0.15
    return table


def test_the_filter_in_the_loop_and_the_published_tables(deviations):
    """100 runs with another seed than the published ones."""
    published = json.loads((ROOT / "homotopy_control" / "published.json").read_text(encoding="utf-8"))
    loop = published["tables"]["loop"]
    loop["rows"] = [row for row in loop["rows"] if row[1] == "0.1 s"]
    tables = [run.series_table(deviations), _check_loop(1, "0.1 s"), run.lqg_table(2000, 1)]
    assert compare(published, Report("homotopy_control", "", tables)) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_filter_in_the_loop_with_the_long_horizon(seed):
    _check_loop(seed, "0.5 s")


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3])
def test_the_filter_in_the_loop_with_the_short_horizon(seed):
    _check_loop(seed, "0.1 s")


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)])
def test_lqg_agrees_with_lyapunov(seed):
    k = siso.gain(siso.settings())
    variance, error, gain = siso.lqg_theory(k)
    assert k == pytest.approx(1.557377, abs=1e-6)
    np.testing.assert_allclose([variance, error, gain], [0.0059158, 0.0036844, 3.68438], rtol=1e-5)
    model = siso.lqg_model()
    out = siso.lqg(jf.kalman(model), model, jnp.asarray(k), jax.random.split(jax.random.key(seed), 2000))
    assert float((out.x[:, 50:] ** 2).mean()) == pytest.approx(variance, rel=0.03)
    assert float((out.error[:, 50:] ** 2).mean()) == pytest.approx(error, rel=0.03)


def test_vmap_over_starts_is_a_loop_and_compiles_once():
    p = ltv.settings()
    t = ltv.DELTA * jnp.arange(20).astype(float)
    starts = jnp.array(ltv.X0)[None] + jax.random.normal(jax.random.key(0), (3, 2))
    traces = []

    @jax.jit
    def course(p, x):
        traces.append(None)
        return loop.receding(Partial(ltv.plan, p), Partial(ltv.plant), x, t, ltv.DELTA, apply="poly", state="plant").x

    alone = jnp.stack([course(p, x) for x in starts])
    course(p._replace(q=2 * p.q), starts[0])
    assert len(traces) == 1
    np.testing.assert_allclose(jax.vmap(course, (None, 0))(p, starts), alone, rtol=1e-12, atol=1e-12)


# --- gradients --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_gradient_of_the_closed_loop_is_that_of_differences():
    data = tuning.draw(jax.random.key(0), 2)
    params = jax.tree.map(lambda x: jnp.asarray(x, float), tuning.tune.initial(tuning.space()))
    loss = jax.jit(tuning.loss)
    found = jax.jit(jax.jacfwd(tuning.loss))(params, data)
    for name, value in params.items():
        h = 1e-4 * value
        difference = (loss({**params, name: value + h}, data) - loss({**params, name: value - h}, data)) / (2 * h)
        assert float(found[name]) == pytest.approx(float(difference), rel=1e-5), name


def test_the_implicit_derivative_of_the_costate():
    """By gravity and by the weight of the input, against differences. (The closed loop's is in forward mode.)"""
    p = rigs.corrected(ANGLE, **SHORT)

    @jax.jit
    def first_input(theta):
        changed = p._replace(rig=rigs.Rig(gravity=theta[0]), cost=p.cost._replace(r=theta[1]))
        return rigs.plan(changed, jnp.asarray(ANGLE), jnp.asarray(rigs.START)).inputs[0, 0]

    theta = jnp.array([0.0755, 1.0])
    steps = 1e-5 * np.diag(np.asarray(theta))
    differences = [(first_input(theta + s) - first_input(theta - s)) / (2 * s.sum()) for s in steps]
    np.testing.assert_allclose(jax.grad(first_input)(theta), differences, rtol=1e-6)


# --- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "build",
    [
        lambda: rigs.corrected(ANGLE, r=0.0),
        lambda: rigs.corrected(ANGLE, q=(-1.0, 0.0, 0.0, 0.0)),
        lambda: rigs.corrected(ANGLE, delta=0.0),
        lambda: rigs.corrected(ANGLE, T=0.0),
        lambda: rigs.corrected(ANGLE, T=0.04),
        lambda: rigs.corrected(ANGLE, degree=0),
        lambda: rigs.corrected(ANGLE, stages=0),
        lambda: rigs.corrected(-0.5),  # the rotor cannot push down
        lambda: rigs.corrected(ANGLE, rig=rigs.Rig(gravity=float("nan"))),
        lambda: rigs.corrected(ANGLE, terminal=np.eye(3)),
        lambda: rigs.printed(T=0.1, delta=0.05, h=-1.0),
        lambda: siso.settings(terms=1),
        lambda: siso.settings(r=-1.0),
        lambda: siso.settings(horizon=0),
        lambda: ltv.settings(((0.0, 1.0), (1.0, 1.0), (1.0, 1.0))),
        lambda: boundary.care(np.eye(2), np.zeros((2, 1)), np.eye(2), np.eye(1)),  # not stabilisable
        lambda: boundary.care(np.eye(2), np.ones((2, 1)), -np.eye(2), np.eye(1)),
        lambda: boundary.care(np.eye(2), np.ones((2, 1)), np.eye(2), -np.eye(1)),
        lambda: boundary.care(np.eye(3), np.ones((2, 1)), np.eye(2), np.eye(1)),
        lambda: loop.steps_of((0.0, 10.2), (0.0, 1.0), 0.5, 40),  # a change inside a step
    ],
)
def test_bad_settings_are_refused(build):
    with pytest.raises(ValueError, match=r"expected|no equilibrium|no stabilising|do not fit|inside a step"):
        build()


def test_trouble_inside_the_loop_is_flagged_and_the_input_stays_finite():
    p = rigs.corrected(ANGLE, **SHORT)
    last = rigs.Held(jnp.asarray(0.7), jnp.arange(4.0), jnp.zeros(()), jnp.ones((), bool))
    held = jax.jit(rigs.control)
    x = jnp.asarray(rigs.START)
    good = held(p, jnp.asarray(ANGLE), x, jnp.zeros(()), last)
    assert bool(good.ok)
    # no estimate: the equilibrium's input
    none = held(p, jnp.asarray(ANGLE), x.at[1].set(jnp.nan), jnp.zeros(()), last)
    assert not bool(none.ok)
    assert float(none.u) == pytest.approx(0.6189, abs=1e-4)
    # no solution (a Newton matrix that is not finite): the last input and costate
    broken = p._replace(cost=p.cost._replace(terminal=jnp.full((4, 4), jnp.inf)))
    kept = held(broken, jnp.asarray(ANGLE), x, jnp.zeros(()), last)
    assert not bool(kept.ok)
    assert float(kept.u) == 0.7
    np.testing.assert_array_equal(kept.alpha, last.alpha)
    # a torque that no rotor balances: flagged, finite
    pushed = held(p, jnp.asarray(ANGLE), x, jnp.asarray(0.2), last)
    assert not bool(pushed.ok)
    assert bool(jnp.isfinite(pushed.u))


def test_missing_measurements_are_predicted_through():
    """A second without samples: the estimate goes on, and the loop settles after it."""
    p = rigs.corrected(ANGLE, **SHORT)
    x0 = filtered.rest_at(float(np.deg2rad(60.0)))
    mask = np.ones(filtered.STEPS, bool)
    mask[20:40] = False
    keys = jax.random.split(jax.random.key(0), 4)
    out = filtered.simulate(
        p, jf.extended(filtered.model(x0)), rigs.Rig(), jnp.asarray(ANGLE), x0, keys, jnp.asarray(mask)
    )  # fmt: skip
    assert bool(jnp.isfinite(out.x).all())
    # prediction alone: the same u and model give the next estimate without the sample
    moved = jax.vmap(lambda x, u: filtered.transition(rigs.Rig(), x, u[None], None))(
        out.estimate[0, 20:39], out.u[0, 20:39]
    )
    np.testing.assert_allclose(out.estimate[0, 21:40], moved, rtol=1e-10, atol=1e-12)
    assert np.abs(np.rad2deg(np.asarray(out.x[:, -1, 0])) - 70).max() < 1


def test_scipys_exponential_is_what_the_affine_series_tends_to():
    M, d = siso.hamiltonian(siso.settings())
    z0 = jnp.array([2.0, 0.1])
    z = series.evaluate(series.affine_series(M[None], jnp.zeros((1, 2)), z0, 24).sum(axis=0), 1.0)
    np.testing.assert_allclose(z, scipy.linalg.expm(np.asarray(M)) @ np.asarray(z0), rtol=1e-12)
    assert d.shape == (2,)
