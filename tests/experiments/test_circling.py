"""Circling gliders: nothing hidden is seen, published cells come back, the quick form works."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from experiments.__main__ import ROOT
from experiments.circling import run as circling
from experiments.circling import tracks
from experiments.lost_target import flight_gaps
from experiments.planar import MODES, Data, in_wind, loss, read_parameters, space
from experiments.report import Options, Report, compare
from jaxfilt import tune

pytestmark = pytest.mark.xdist_group("circling")  # one process, so that its tests share what they compute

PUBLISHED = json.loads((ROOT / "circling" / "published.json").read_text(encoding="utf-8"))
PARAMS = read_parameters(PUBLISHED["tables"]["circling_tuning"])
NAMES = ("CV", "IMM (CV, CT)")  # few to compile


@pytest.fixture(scope="module")
def outcome():
    """At full size, with the published parameters; one compiled program per filter serves all tests here."""
    return circling.compute({name: PARAMS[name] for name in NAMES}, 0)


def test_published_cells_come_back(outcome):
    """The parameters are read, not tuned again: all but the choice of the best filter must agree to 1e-6."""
    published = json.loads(json.dumps(PUBLISHED))
    tables = circling.score_tables(outcome, "IMM (CV, CT)")
    # The columns of the ratios depend on which filters there are.
    tables = [table for table in tables if table.name != "circling_ratio"]
    rerun = {row[0] for table in tables for row in table.rows}
    for table in tables:
        rows = published["tables"][table.name]["rows"]
        published["tables"][table.name]["rows"] = [row for row in rows if row[0] in rerun]
    assert sum(len(published["tables"][table.name]["rows"]) for table in tables) > 20
    assert compare(published, Report("circling", "", tables)) == []


def test_no_estimate_has_seen_a_hidden_fix(outcome):
    """Whatever stands behind the mask, all that is said is the same to the last bit, the smoother's word too."""
    windows, whole = outcome.windows, outcome.whole
    garbage = np.where(windows.mask[..., None], windows.ys, 1e6)
    params = {name: PARAMS[name] for name in NAMES}
    again, _ = tracks.estimates(params, windows._replace(ys=garbage), whole)
    for name, out in outcome.found.items():
        for a, b in zip(jax.tree.leaves(out), jax.tree.leaves(again[name]), strict=True):
            np.testing.assert_array_equal(a, b)


def test_pieces_cover_the_scoring_flights(outcome):
    whole = outcome.whole
    lost = sum(len(flight_gaps.load(name).t) for name in flight_gaps.TESTS) - whole.mask.sum()
    assert 0 <= lost < 3 * 2 * tracks.WARMUP  # at most a remainder of each of the three stretches
    assert (whole.dt <= 3.0).all()  # the dropout lies between two pieces
    assert 0.2 < whole.circling[whole.mask].mean() < 0.5
    for piece in range(len(whole.ys)):
        blocks = whole.block[piece, whole.mask[piece]]
        assert (np.diff(blocks) >= 0).all()
        lasting = np.bincount(blocks - blocks[0], whole.dt[piece, whole.mask[piece]])
        assert (lasting <= tracks.BLOCK + 3).all()  # an interval at the most beyond


def test_an_imm_helps_in_circles_and_a_smoother_more(outcome):
    """What the README finds, with a margin."""
    for length in flight_gaps.LENGTHS:
        rmse = {name: circling._draws(outcome, name, ("circling", length))[0] for name in outcome.scores}
        assert rmse["IMM (CV, CT)"] < 0.6 * rmse["CV"]
        assert rmse["IMM (CV, CT)" + tracks.SMOOTHED] < rmse["IMM (CV, CT)"]


def test_turn_in_wind_follows_circles_that_drift():
    """Without noise the wind's turn is exact; in still air it is the coordinated turn."""
    turn = jf.models.coordinated_turn(dt=1.0, q_omega=1e-3, r=1.0, m0=np.zeros(5), P0=np.eye(5))
    windy = in_wind(turn, 0.1, 1.0)
    dt = jnp.asarray(0.7)
    x = np.array([1.0, 2.0, 11.0, -3.0, 0.4, 0.0, 0.0])
    np.testing.assert_allclose(windy.f(x, None, dt)[:5], turn.f(x[:5], None, dt), rtol=1e-14)
    wind = np.array([3.0, -1.0])
    drifting = x + np.concatenate([np.zeros(2), wind, np.zeros(1), wind])
    still, moved = windy.f(x, None, dt), windy.f(drifting, None, dt)
    np.testing.assert_allclose(moved[:2], still[:2] + wind * 0.7, rtol=1e-14)
    np.testing.assert_allclose(moved[2:4], still[2:4] + wind, rtol=1e-14)
    Q = np.asarray(windy.Q(x, None, dt))  # pyright: ignore[reportCallIssue]
    np.testing.assert_allclose(Q[5:, 5:], 0.07 * np.eye(2), rtol=1e-14)
    assert (Q[:5, 5:] == 0).all()


def test_parameters_are_read_back_as_they_were():
    for name, params in PARAMS.items():
        assert params.keys() == space(name, tracks.SCALE).keys()
        assert np.size(params.get("stay", ())) == (len(MODES[name]) if name.startswith("IMM") else 0)


def test_loss_and_gradient_of_a_turn_model_are_finite():
    """On a short stretch with a gap, at the published parameters."""
    rng = np.random.default_rng(0)
    data = Data(rng.normal(size=(1, 6, 2)), np.arange(12).reshape(1, 6, 2) % 8 < 6, np.ones((1, 6)))
    objective = jax.tree_util.Partial(loss, jf.Static("CT"), tracks.START, jf.Static(1))
    value, slope = jax.value_and_grad(objective)({k: jnp.asarray(v) for k, v in PARAMS["CT"].items()}, data)
    assert np.isfinite([float(value), *map(float, slope.values())]).all()


def test_quick_form_gives_finite_tables_and_figures(tmp_path, monkeypatch):
    """With given parameters: tuning takes its time compiling, and has tests of its own."""
    monkeypatch.setattr(circling, "tuned", _given)
    monkeypatch.setattr(circling, "SLOT", flight_gaps.SLOT / 3)  # the full size's shapes, compiled already
    report = circling.run(Options(out=tmp_path, quick=True))
    for table in report.tables:
        for cell in table.cells().values():
            assert np.isfinite(float(cell["value"]))
            assert cell["se"] is None or np.isfinite(cell["se"])
    assert len(report.figures) == 2
    assert all(path.stat().st_size > 10_000 for path in report.figures)
    assert all("nan" not in finding for finding in report.findings)


def _given(steps, names):
    del steps
    history = tune.History(np.array([1]), np.array([0.0]), np.array([4.0]))
    return {name: tune.TuneResult(PARAMS[name], 4.0, history, 1, 0.0, 0.0, "given") for name in names}


@pytest.mark.slow
def test_tuning_lowers_the_loss():
    learnt = circling.tuned(6, ("CV", "IMM (CV, CT)"))
    assert learnt["IMM (CV, CT)"].loss < learnt["CV"].loss < 8
