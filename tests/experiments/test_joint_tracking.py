"""Joint tracking and classification: exact checks, bands S1 to S7 and gradient criteria of the specification."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.__main__ import ROOT
from experiments.benchmarks import joint_tracking as cost
from experiments.joint_tracking import exact, run, system, vessels
from experiments.joint_tracking.runs import evaluate
from experiments.joint_tracking.system import DEMO, PAPER
from experiments.report import Report, compare
from jaxfilt.models.turn import arc


def turn(omega, dt):
    return system.turn_matrix(jnp.stack(arc(jnp.asarray(omega), jnp.asarray(dt))))


def test_the_turn_matrix():
    """E1, in the order [x, y, vx, vy]."""
    x = jnp.array([0.0, 0.0, 100.0, 0.0])
    np.testing.assert_allclose(turn(0.5, 1.0) @ x, [95.885108, 24.483488, 87.758256, 47.942554], rtol=0, atol=1e-6)
    start = jnp.array([1.0, -2.0, 30.0, 40.0])
    speed = np.hypot(*(turn(0.7, 0.3) @ start)[2:])
    np.testing.assert_allclose(speed, 50.0, rtol=1e-12)
    straight = np.eye(4) + 2.0 * np.eye(4, k=2)
    np.testing.assert_allclose(turn(1e-12, 2.0), straight, atol=1e-10)
    slope = jax.jacfwd(lambda w: turn(w, 2.0))(0.0)
    assert np.isfinite(slope).all()
    np.testing.assert_allclose(slope[2, 3], -2.0, rtol=1e-12)
    np.testing.assert_allclose(
        np.linalg.matrix_power(np.asarray(turn(2 * np.pi / 36, 1.0)), 36) @ start, start, rtol=1e-10
    )


def test_modes_move_as_they_say():
    """Each mode against its own formula; the pairs of a class differ in sign only."""
    x = jnp.array([10.0, 20.0, 30.0, 40.0])
    models = system.models(DEMO, jnp.array([5000.0, 0.9]), 1)
    moved = [np.asarray(m.f(x, None, None)) for m in models]
    dt = DEMO.dt
    straight = np.array([10 + 30 * dt, 20 + 40 * dt, 30, 40])
    np.testing.assert_allclose(moved[0], straight, rtol=1e-12)
    push = 20.0 * np.array([0.6, 0.8])
    kick = np.concatenate([dt**2 / 2 * push, dt * push])
    np.testing.assert_allclose(moved[1], straight + kick, rtol=1e-8)
    np.testing.assert_allclose(moved[2], straight - kick, rtol=1e-8)
    np.testing.assert_allclose(moved[3], turn(0.2, dt) @ x, rtol=1e-12)
    np.testing.assert_allclose(moved[4], turn(-0.2, dt) @ x, rtol=1e-12)


def test_the_speed_score():
    """E2: values at 200 m/s, ends, and the speed where the classes are equal."""
    g = np.exp(system.log_speed_score(jnp.array([50.0, 200.0, 250.9615, 900.0])[:, None], jnp.arange(2)[None, :]))
    np.testing.assert_allclose(g[[0, 1, 3]], [[0.8, 0.1], [0.45, 0.185], [0.1, 0.95]], rtol=1e-12)
    np.testing.assert_allclose(g[2], 0.271635, atol=1e-5)


def test_the_printed_recursion_counts_the_prior_twice():
    """E7: with equal likelihoods (0.6, 0.4) becomes (9/13, 4/13); the sound filter stays where it is."""
    model = exact.model(1.0)
    joint = jf.joint_particle([[model]] * 2, [[1.0]], 1000, prior=(0.6, 0.4), floor=0.1, threshold=1.0)
    mask = np.array([[False, False]])
    y = jnp.zeros((1, 2))
    inp = jax.tree.map(lambda a: a[0], jf.inputs(y, mask=mask, key=jax.random.key(0)))
    for make, expected in ((system.as_printed, (9 / 13, 4 / 13)), (lambda f: f, (0.6, 0.4))):
        filt = make(joint)
        state = filt.init(inp)
        inner = state.inner if hasattr(state, "inner") else state
        inner = inner._replace(counts=jnp.array([600, 400], jnp.int32), log_weights=jnp.repeat(
            -jnp.log(jnp.array([600.0, 400.0])), np.array([600, 400])))  # fmt: skip
        state = state._replace(inner=inner) if hasattr(state, "inner") else inner
        _, info = filt.update(state, inp)
        np.testing.assert_allclose(np.exp(info.extra["log_probabilities"]), expected, rtol=1e-12)


def test_paths_are_those_of_the_specification():
    """Final ranges and speeds of the demo."""
    for label, final, speed in ((1, 10951.0, 400.0), (0, 9161.0, 225.0)):
        states = system.path(label, 0.1)
        assert len(states) == 201
        np.testing.assert_allclose(np.hypot(*states[-1, :2]), final, atol=1.0)
        np.testing.assert_allclose(np.hypot(*states[-1, 2:]), speed, rtol=1e-9)


def test_the_prior_has_the_moments_that_the_gaussian_filters_get():
    first = jnp.array([5000.0, 0.927])
    draws = system.start(first, DEMO, jax.random.key(0), jnp.repeat(jnp.arange(2), 50_000), None)
    for c in (0, 1):
        mean, cov = system.start_moments(first, DEMO, c)
        part = np.asarray(draws)[50_000 * c : 50_000 * (c + 1)]
        se = np.sqrt(np.diag(cov) / 50_000)
        np.testing.assert_array_less(np.abs(part.mean(axis=0) - mean), 5 * se + 0.1)
        np.testing.assert_allclose(np.cov(part.T), cov, atol=0.03 * float(np.abs(cov).max()))


@pytest.mark.parametrize("name", ["sigma_r", "sigma_theta", "sigma_w"])
def test_noise_that_is_not_positive_is_refused(name):
    bad = (-1.0, 1.0) if name == "sigma_w" else 0.0
    with pytest.raises(ValueError, match=name):
        system.check(DEMO._replace(**{name: bad}))


def test_warnings_of_a_configuration():
    with pytest.warns(UserWarning, match="copies"):
        system.check(DEMO._replace(sigma_w=(0.0, 1.0)))
    with pytest.warns(UserWarning, match="linearised"):
        system.check(PAPER)
    system.check(DEMO)


def test_a_class_that_does_not_exist_is_refused():
    with pytest.raises(ValueError, match="label"):
        evaluate(Partial(system.imm_bank), DEMO, 2, 1, jax.random.key(0))


def test_the_numpy_filter_finds_the_same_classes():
    """The benchmark's NumPy loop does the same work: its class posterior agrees with the IMM bank's at the end."""
    data = system.simulate(DEMO, 1, 1, jax.random.key(0))
    classes = jnp.repeat(jnp.arange(2), 1000)
    start = system.start(data.first[0], DEMO, jax.random.key(0), classes, None)
    log_p = cost.numpy_filter(np.asarray(start), np.asarray(data.ys[0]), np.random.default_rng(0))
    assert log_p[-1, 1] > np.log(0.99)
    assert np.isfinite(log_p).all()


def test_pieces_of_vessels():
    """Only labelled vessels, intervals positive, training and test apart."""
    found = vessels.pieces((2, 13))
    assert set(found.vessel) == {2, 13}
    assert (found.dt > 0).all()
    assert set(found.label) == {0, 1}
    assert not set(vessels.TRAINING) & {v for v in vessels.LABELS if v not in vessels.TRAINING}


PUBLISHED = ROOT / "joint_tracking" / "published.json"


def _published():
    return json.loads(PUBLISHED.read_text(encoding="utf-8"))


@pytest.mark.parametrize("label", [0, 1])
def test_published_table_agrees_with_a_small_run(label):
    """Another seed, 20 runs, the IMM bank: without particles, so that it stays small."""
    out = evaluate(Partial(system.imm_bank), DEMO, label, 20, jax.random.key(1))
    published = _published()
    name = f"class{label + 1}"
    table = published["tables"][name]
    table["rows"] = [row for row in table["rows"] if row[0] == run.IMM]
    assert compare(published, Report("joint_tracking", "", [run.table({run.IMM: out}, label)])) == []


def test_the_single_filter_on_a_few_runs():
    """Seed 1, four runs of class 2: within 9 s sure of the class, and no worse than the raw measurements."""
    out = evaluate(Partial(system.single, jf.Static((5000,)), 0.5), DEMO, 1, 4, jax.random.key(1))
    assert out.right.all()
    assert (out.settled < 9).all()
    assert float(np.median(out.rmse(slice(0, 2)))) <= 10


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_bands(seed):
    """S1, S2, S3 (accuracy), S5 for each seed; S4 over 150 runs."""
    one = {run.SINGLE: evaluate(*run.filters(0, True)[run.SINGLE], 0, 50, jax.random.key(seed))}
    two = run.simulate(1, 50, seed, quick=True)
    low, high = (
        np.append(two[name].rmse(slice(0, 2)), run.pooled(1, floor, seed, 2, 50))
        for name, floor in ((run.LOW, 0.1), (run.SINGLE, 0.5))
    )
    checks = run.bands(one, two, low, high, None, None)
    assert [(number, met) for number, _, met, ok in checks if not ok] == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_exact_posterior_evidence_and_the_printed_recursion(seed):
    """S6, S7."""
    found = exact.study(jax.random.key(seed), 60, 1600)  # of 400 the mean of so skewed a ratio is not yet normal
    assert np.abs(found["sound"].mean(axis=1) - found["exact"]).max() < 0.01
    for floor in exact.FLOORS:
        x = found[f"Z {floor}"]
        assert (np.abs(x.mean(axis=1) - 1) < 3.5 * x.std(axis=1, ddof=1) / np.sqrt(x.shape[1])).all()
    assert np.mean(found["printed"][: exact.SETS] > 0.5) >= 0.2


@pytest.mark.slow
def test_cost_against_the_reference():
    """S3, time: 0.4 to 0.65 of the multi-filter's."""
    seconds = cost.measure(20, 20, 5)
    assert 0.4 <= seconds[cost.NAMES[0]] / seconds[cost.NAMES[1]] <= 0.65


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_gradient_criteria(seed):
    """Section 9: N = 2000, 48 runs: within 5 % with the score of the choices, more than 20 % off without."""
    found = {kind: x[:, 1].mean() for kind, x in exact.gradients(jax.random.key(seed), 2000, 48).items()}
    assert abs(found["score"] / found["exact"] - 1) <= 0.05
    assert abs(found["draws"] / found["exact"] - 1) > 0.2


def test_gradient_with_the_score_is_nearer_to_the_exact_one():
    """At 1000 particles and 16 runs."""
    found = {kind: x[:, 1].mean() for kind, x in exact.gradients(jax.random.key(1), 1000, 16).items()}
    assert abs(found["score"] / found["exact"] - 1) < 0.1
    assert abs(found["draws"] / found["exact"] - 1) > 0.2
