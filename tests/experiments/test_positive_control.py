"""Output feedback for positive systems: the programs' optima, the printed solution, robustness, the loop."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.__main__ import ROOT
from experiments.positive_control import descent, design, estimates, run, system
from experiments.positive_control.system import A_HIGH, A_LOW, PRINTED, PRINTED_WEIGHTS, PRINTED_Z, B, C
from experiments.report import Report, compare

STAR = np.array([[5.0], [0.0]])
SYSTEM = (A_LOW, A_HIGH, B, C)


# --- design -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("nonneg_u", [True, False])
def test_the_optima_that_can_be_had_by_hand(nonneg_u):
    found = design.output_feedback(*SYSTEM, nonneg_u=nonneg_u)
    assert found.margin == pytest.approx(21 / 13, abs=1e-7)
    assert found.gain is not None
    assert found.weights is not None
    np.testing.assert_allclose(found.gain, STAR, atol=1e-7)
    np.testing.assert_allclose(found.weights, [30 / 13, 35 / 13], atol=1e-7)
    assert design.output_feedback(*SYSTEM, nonneg_u=nonneg_u, objective="decay").margin == pytest.approx(0.4, abs=1e-5)


def test_the_observer_is_the_dual():
    found = design.observer(A_LOW, A_HIGH, C)
    assert found.margin == pytest.approx(21 / 65, abs=1e-6)
    assert found.gain is not None
    np.testing.assert_allclose(found.gain, -B @ STAR, atol=1e-6)
    np.testing.assert_allclose(found.gain, estimates.GAIN, atol=1e-6)
    assert design.observer(A_LOW, A_HIGH, C, objective="decay").margin == pytest.approx(0.4, abs=1e-5)


def test_the_printed_solution():
    checked = design.check(*SYSTEM, PRINTED)
    np.testing.assert_allclose(PRINTED[:, 0], [0.0265, 13.1872], atol=1e-4)
    np.testing.assert_allclose(checked.low, [[0.4285, 0.3285], [0.2291, 0.4291]], atol=1e-4)
    np.testing.assert_allclose(checked.high, [[0.6285, 0.3285], [0.2291, 0.6291]], atol=1e-4)
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(checked.high)), [0.35447, 0.90316], atol=1e-4)
    slack = design.slacks(*SYSTEM, PRINTED_WEIGHTS, PRINTED_Z)
    assert [name for name, value in slack.items() if value < 0] == ["(19)"]
    assert slack["(19)"] == pytest.approx(-0.24, abs=2e-3)
    c = C[0] @ PRINTED_WEIGHTS
    scaled = design.slacks(*SYSTEM, PRINTED_WEIGHTS / c, PRINTED_Z / c)
    assert min(scaled.values()) > -1e-12
    assert scaled["(19)"] > 0.19


def test_the_kronecker_rows_are_the_matrix_conditions():
    rng = np.random.default_rng(0)
    M, X, N = rng.normal(size=(3, 4)), rng.normal(size=(4, 2)), rng.normal(size=(2, 5))
    np.testing.assert_allclose((M @ X @ N).flatten("F"), np.kron(N.T, M) @ X.flatten("F"), rtol=1e-12)
    rows, right = design.printed_rows(*SYSTEM)
    weights, z = rng.uniform(1, 5, 2), rng.uniform(0, 30, 2)
    c = C[0] @ weights
    direct = np.concatenate([
        (A_HIGH - np.eye(2)) @ weights + B @ z,
        -weights,
        [1 - c],
        -(c * A_LOW + np.outer(B @ z, C[0]) + (1 - c) * np.eye(2)).flatten("F"),
        -z,
    ])  # fmt: skip
    np.testing.assert_allclose(rows @ np.concatenate([weights, z]) - right, direct, atol=1e-12 * np.abs(direct).max())


def _random_system(rng, outputs):
    """A box for which a gain exists by construction."""
    n, p = int(rng.integers(2, 9)), int(rng.integers(1, 4))
    low, width = rng.uniform(size=(n, n)), rng.uniform(size=(n, n))
    scale = 0.9 / np.abs(np.linalg.eigvals(low + width)).max()
    B, C, K = rng.uniform(size=(n, p)), rng.uniform(size=(outputs, n)), rng.uniform(size=(p, outputs))
    low, width = scale * low, scale * width
    return low, width, B, C, K


def test_random_feasible_systems_are_solved():
    rng = np.random.default_rng(1)
    for _ in range(50):
        low, width, B, C, K = _random_system(rng, 1)
        A = low - B @ K @ C
        found = design.output_feedback(A, A + width, B, C, nonneg_u=bool(rng.integers(2)))
        assert found.feasible
        checked = design.check(A, A + width, B, C, found.gain)
        assert checked.radius < 1
        assert checked.low.min() >= -1e-9
    for _ in range(50):
        low, width, _, C, _ = _random_system(rng, int(rng.integers(1, 4)))
        L = rng.uniform(size=(len(low), len(C)))
        A = low + L @ C
        found = design.observer(A, A + width, C)
        assert found.gain is not None
        assert (A - found.gain @ C).min() >= -1e-9
        assert np.abs(np.linalg.eigvals(A + width - found.gain @ C)).max() < 1


def test_infeasible_systems_are_reported():
    f = design.output_feedback
    A = np.array([[0.1, -0.2], [0.1, 0.1]])
    half = [[0.5, 0.5]]
    unreachable = f(A, A + 0.1, [[0.0], [1.0]], half, nonneg_u=False)
    assert unreachable[:3] == (False, None, None)
    assert "infeasible" in unreachable.message
    edge = f(np.diag([1.2, 0.1]), np.diag([1.3, 0.2]), [[1.0], [0.0]], half, nonneg_u=False)
    assert not edge.feasible
    assert edge.margin == pytest.approx(0, abs=1e-9)
    unstable = ([[1.2, 0.5], [0, 0.1]], [[1.3, 0.6], [0, 0.2]], [[1.0], [0.0]], half)
    found = f(*unstable, nonneg_u=False)
    assert found.margin == pytest.approx(3.2 / 11, abs=1e-7)
    assert found.gain is not None
    np.testing.assert_allclose(found.gain, [[-1.0]], atol=1e-7)
    refused = f(*unstable, nonneg_u=True)
    assert not refused.feasible
    assert refused.margin <= 0
    assert not f(*unstable, nonneg_u=True, objective="decay").feasible


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: design.check_system(A_HIGH, A_LOW, B, C), r"A_low\[0, 0\]"),
        (lambda: design.check_system(A_LOW, A_HIGH * np.nan, B, C), "A_high: expected finite"),
        (lambda: design.check_system(A_LOW, A_HIGH, B[:1], C), "shapes do not fit"),
        (lambda: design.check_system(A_LOW, A_HIGH, B, C[:, :1]), "shapes do not fit"),
        (lambda: design.check_system(A_LOW, A_HIGH, B, -C), "C: expected a nonnegative"),
        (lambda: design.check_system(A_LOW, A_HIGH, B, 0 * C), "C: expected a nonnegative"),
        (lambda: design.output_feedback(A_LOW, A_HIGH, B, np.eye(2), nonneg_u=True), "one row"),
        (lambda: design.check(*SYSTEM, np.ones((1, 1))), "K: expected"),
        (lambda: design.check(*SYSTEM, PRINTED * np.inf), "K: expected"),
        (lambda: system.worst_cost(PRINTED, np.array([1.0, -1.0])), "x0: expected"),
    ],
)
def test_bad_input_is_refused(call, match):
    with pytest.raises(ValueError, match=match):
        call()


# --- robustness -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)])
def test_ten_thousand_draws(seed):
    keys = jax.random.split(jax.random.key(seed), 10_000)
    for K, last in ((PRINTED, 1e-2), (STAR, 1e-15)):
        for varying in (False, True):
            found = system.robustness(keys, K, varying=varying)
            assert min(found.least_x, found.least_u) >= -1e-12
            assert max(found.above_worst, found.above_bound) <= 1e-12
            assert found.last < last


def test_the_worst_case_cost_in_closed_form():
    for K, cost in ((PRINTED, 31.99248), (STAR, 4.7619048)):
        x = system.worst(jnp.asarray(K), jnp.asarray(system.X0), steps=400).x
        assert system.worst_cost(K) == pytest.approx(float(x.sum()), rel=1e-9)
        assert system.worst_cost(K) == pytest.approx(cost, rel=1e-6)


def test_vmap_over_draws_is_a_loop_and_compiles_once():
    keys = jax.random.split(jax.random.key(0), 3)
    K, x0 = jnp.asarray(PRINTED), jnp.asarray(system.X0)
    together = system.rollout(keys, K, x0, varying=True).x
    alone = jnp.concatenate([system.rollout(k[None], K, x0, varying=True).x for k in keys])
    np.testing.assert_allclose(together, alone, rtol=1e-14)
    before = system.rollout._cache_size()  # pyright: ignore[reportAttributeAccessIssue]
    system.rollout(keys, jnp.asarray(STAR), x0, varying=True)
    assert system.rollout._cache_size() == before  # pyright: ignore[reportAttributeAccessIssue]


# --- descent ----------------------------------------------------------------------------------------------------------


def test_the_barred_cost_has_the_gradient_of_differences_and_descends():
    K, barrier = jnp.asarray(PRINTED[:, 0]), jnp.asarray(0.1)
    found = jax.grad(lambda k: descent.barred({"K": k}, barrier))(K)
    h = 1e-6
    for i in range(2):
        step = h * jnp.eye(2)[i]
        plus, minus = (descent.barred({"K": K + s}, barrier) for s in (step, -step))
        assert float(found[i]) == pytest.approx(float((plus - minus) / (2 * h)), rel=1e-6)
    assert bool(jnp.isnan(descent.barred({"K": jnp.array([0.1, 0.1])}, barrier)))  # not positive
    assert 4.7619 < system.worst_cost(descent.by_gradient().K) < 6.0


# --- estimates --------------------------------------------------------------------------------------------------------


def _scores(seed, runs, K, v, source):
    keys = jax.random.split(jax.random.key(seed), runs)
    out = estimates.simulate(
        keys, jnp.asarray(K), estimates.observer(v), estimates.kalman(v), jnp.asarray(v), source=source
    )  # fmt: skip
    return estimates.score(out)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)])
def test_bounds_coverage_and_spread(seed):
    raw = _scores(seed, 500, PRINTED, 0.02, "y")
    filtered = _scores(seed, 500, PRINTED, 0.02, "filter")
    star = _scores(seed, 500, STAR, 0.02, "y")
    assert raw.outside == filtered.outside == star.outside == 0
    for s in (raw, star):
        predicted = estimates.width_in_closed_form(s.mean.mean(axis=0), 0.02)
        np.testing.assert_allclose(s.width.mean(axis=0), predicted, rtol=0.02)
    assert ((raw.covered.mean(axis=0) > 0.80) & (raw.covered.mean(axis=0) < 0.95)).all()
    assert (star.covered.mean(axis=0) > 0.99).all()
    spread = [np.sqrt(run.about_mean(s)[:, 0].mean()) for s in (filtered, raw)]
    assert spread[0] < 0.6 * spread[1]
    assert filtered.clipped.max() == 0


def test_missing_samples_hold_the_input_and_keep_the_bounds():
    mask = np.ones(estimates.STEPS, bool)
    mask[100:110] = False
    keys = jax.random.split(jax.random.key(5), 50)
    v = 0.02
    out = estimates.simulate(
        keys, jnp.asarray(STAR), estimates.observer(v), estimates.kalman(v), jnp.asarray(v), jnp.asarray(mask)
    )  # fmt: skip
    assert estimates.score(out).outside == 0
    np.testing.assert_array_equal(out.u[:, 100:110], jnp.broadcast_to(out.u[:, 99:100], (50, 10, 2)))
    assert bool(out.possible.all())


def test_published_tables_agree_with_a_small_run():
    published = json.loads((ROOT / "positive_control" / "published.json").read_text(encoding="utf-8"))
    gains = {"printed": PRINTED, "linear program, margin": STAR}
    scores = run.scores_of(300, 1, gains)
    two, _ = run.printed_table()
    report = Report("positive_control", "", [two, run.interval_table(scores, 300), run.loop_table(scores, 300)])
    assert compare(published, report) == []
