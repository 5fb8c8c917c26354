"""The acceptance bands of scenarios G1 and G2 (specification, section 5.8, items 16 to 18), for three seeds each."""

from __future__ import annotations

import functools
import json

import jax
import pytest

import experiments.lost_target.run as lost_target
import jaxfilt as jf
from experiments.__main__ import ROOT
from experiments.lost_target.run import CA_FILTER
from experiments.report import Options, Report, compare

pytestmark = pytest.mark.xdist_group("lost_target")  # one process, so that its tests share what they compute

RUNS = 1000
seeds = pytest.mark.parametrize(
    "seed", [pytest.param(0, marks=pytest.mark.slow), 1, pytest.param(2, marks=pytest.mark.slow)]
)


@functools.cache
def regime(name: str) -> lost_target.Regime:
    return next(r for r in lost_target.regimes() if r.name == name)


@functools.cache
def result(name: str, seed: int) -> jf.MonteCarloResult:
    return lost_target.simulate(regime(name), RUNS, seed)


def ratio(name, seed, a, b, part="gap"):
    return float(result(name, seed).ratio((a, part), (b, part), root=True).value)


def nees(name, seed, strategy):
    return float(result(name, seed).mean(strategy, "nees").value)


@seeds
def test_g1_matched(seed):
    name = "g1-matched"
    assert 4.7 <= float(result(name, seed).root_mean("coast", "gap").value) <= 5.6
    assert 0.8 <= nees(name, seed, "coast") <= 1.2
    assert ratio(name, seed, "mean 5", "coast") >= 7
    assert ratio(name, seed, "hold", "coast") >= 4.5
    assert 1.03 <= ratio(name, seed, "fit N10 p1", "coast") <= 1.12
    assert ratio(name, seed, "fit N10 p1", "coast", "after") >= 1.2
    assert nees(name, seed, "fit N10 p1") >= 5
    assert ratio(name, seed, "blend", "coast") <= 1.15
    assert ratio(name, seed, "blend", "coast", "after") <= 1.05


@seeds
def test_g1_accelerating(seed):
    name = "g1-accelerating"
    assert ratio(name, seed, CA_FILTER, "fit N20 p2") < 1
    assert ratio(name, seed, "fit N20 p2", "coast") <= 0.5
    assert ratio(name, seed, "blend", "coast") <= 0.5
    assert ratio(name, seed, "blend", "coast", "after") <= 0.6


@seeds
def test_g2_matched(seed):
    name = "g2-matched"
    assert 0.99 <= ratio(name, seed, "fit N20 p2", "coast") <= 1.05
    assert ratio(name, seed, "fit N20 p2", "coast", "after") >= 6
    assert ratio(name, seed, "fit_weighted N20 p2", "coast", "after") <= 2
    assert ratio(name, seed, "fit_weighted N20 p2", "fit N20 p2", "after") <= 0.25
    assert ratio(name, seed, "hold", "coast") >= 10
    assert ratio(name, seed, "mean 5", "coast") >= 10


@seeds
def test_g2_with_a_velocity_filter(seed):
    assert ratio("g2-velocity", seed, "fit N20 p2", "coast") <= 0.25


def test_published_tables_agree_with_a_small_run():
    """Another seed and fewer runs: no published cell of these tables lies more than 4 standard errors away."""
    published = json.loads((ROOT / "lost_target" / "published.json").read_text(encoding="utf-8"))
    report = Report("lost_target", lost_target.TITLE)
    results = {name: result(name, 1) for name in ("g1-matched", "g1-accelerating", "g2-matched", "g2-velocity")}
    report.tables = [lost_target.table(regime(name), results[name]) for name in results]
    report.tables += [lost_target.claims(results), lost_target.wiener_table(Options(runs=200, seed=1))]
    assert compare(published, report) == []
    # The comparison can fail: the same tables of a filter with another q deviate.
    wrong = regime("g1-matched")._replace(model=regime("g1-q-large").model)
    other = lost_target.table(wrong, lost_target.simulate(wrong, RUNS, 1))
    assert compare(published, Report("lost_target", "", tables=[other])) != []


def test_every_series_of_a_batch_is_as_if_alone():
    """One run of the table, filtered by itself, has the score that the batch gave it."""
    from experiments.lost_target import scenarios

    r = regime("g1-matched")
    batch = lost_target.simulate(r, 7, 3, ("coast",))
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(3), 5), 0)
    truth, ys = r.scenario.simulate(key)
    out = jf.filter(
        jf.kalman(r.model), ys, mask=r.gap.mask, first_update_only=True, outputs=scenarios.reported
    )  # fmt: skip
    alone = scenarios.scorer(r.gap)(truth, ys, out)
    assert abs(float(alone["gap"]) - batch.scores["coast"]["gap"][5]) <= 1e-12 * float(alone["gap"])
