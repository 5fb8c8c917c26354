"""Vessels: the recording is as described, nothing held out or hidden is seen, published cells come back."""

from __future__ import annotations

import json

import jax
import numpy as np
import pytest

from experiments.__main__ import ROOT
from experiments.planar import read_parameters
from experiments.report import Options, Report, compare
from experiments.vessels import run as vessels
from experiments.vessels import tracks
from jaxfilt import tune

pytestmark = pytest.mark.xdist_group("vessels")  # one process, so that its tests share what they compute

PUBLISHED = json.loads((ROOT / "vessels" / "published.json").read_text(encoding="utf-8"))
PARAMS = read_parameters(PUBLISHED["tables"]["vessels_tuning"])
NAMES = ("CV", "IMM (CV, CT)")  # few to compile


@pytest.fixture(scope="module")
def outcome():
    """At full size, with the published parameters; one compiled program per filter serves all tests here."""
    return vessels.compute({name: PARAMS[name] for name in NAMES}, 0)


def test_the_recording_is_that_of_its_readme():
    table = np.genfromtxt(tracks.DATA, delimiter=",", names=True)
    assert len(table) == 9101
    assert (np.diff(table["t_s"]) >= 0).all()
    reports = np.bincount(table["vessel"].astype(int))[1:]
    assert len(reports) == 17
    assert (np.diff(reports) <= 0).all()  # numbered by how many there are
    assert reports.min() >= 60
    longest = {v: np.diff(table["t_s"][table["vessel"] == v]).max() for v in (3, 12, 15)}
    assert {v: round(x) for v, x in longest.items()} == {3: 1311, 12: 540, 15: 890}
    tenths = table["sog_mps"] / (1852 / 36000)  # of a knot
    np.testing.assert_allclose(tenths, np.round(tenths), atol=0.02)
    for name in ("LICENSE.txt", "README.md"):
        assert (tracks.DATA.parent / name).is_file()


def test_split_covers_both_kinds_and_shares_no_vessel():
    assert not set(tracks.TRAINING) & set(tracks.TESTS)
    assert sorted(tracks.TRAINING + tracks.TESTS) == list(range(1, 18))
    for part in (tracks.TRAINING, tracks.TESTS):
        assert 2 <= len(set(part) & set(tracks.FAST)) < len(part)


def test_published_cells_come_back(outcome):
    """The parameters are read, not tuned again: all but the ratios to the best filter must agree to 1e-6."""
    published = json.loads(json.dumps(PUBLISHED))
    tables = [table for table in vessels.score_tables(outcome, "IMM (CV, CT)") if table.name != "vessels_ratio"]
    rerun = {row[0] for table in tables for row in table.rows}
    for table in tables:
        rows = published["tables"][table.name]["rows"]
        published["tables"][table.name]["rows"] = [row for row in rows if row[0] in rerun]
    assert sum(len(published["tables"][table.name]["rows"]) for table in tables) > 15
    assert compare(published, Report("vessels", "", tables)) == []


def test_no_estimate_has_seen_a_hidden_report(outcome):
    """Whatever stands behind the mask, all that is said is the same to the last bit."""
    gaps = outcome.gaps
    garbage = gaps._replace(ys=np.where(gaps.mask[..., None], gaps.ys, 1e6), velocity=gaps.velocity + 7.0)
    again, _ = tracks.estimates({name: PARAMS[name] for name in NAMES}, garbage, outcome.whole)
    for name, out in outcome.found.items():
        for a, b in zip(jax.tree.leaves(out), jax.tree.leaves(again[name]), strict=True):
            np.testing.assert_array_equal(a, b)


def test_gaps_hide_what_they_should(outcome):
    gaps = outcome.gaps
    rows = np.arange(len(gaps.ys))
    assert not (gaps.hidden & gaps.mask).any()
    assert gaps.hidden[rows, gaps.last].all()
    assert (gaps.hidden.sum(axis=1)[gaps.length == 0] == 1).all()
    t = np.cumsum(gaps.dt, axis=1)
    for length in tracks.LENGTHS:
        chosen = gaps.length == length
        assert (gaps.horizon[chosen] <= length).all()
        assert (gaps.horizon[chosen] >= 2 / 3 * length).all()
    first = np.argmax(gaps.hidden, axis=1)
    newest = np.max(np.where(gaps.mask, t, -np.inf), axis=1)  # nothing is seen after a gap
    assert (newest < t[rows, first]).all()
    np.testing.assert_allclose(t[rows, gaps.last] - newest, gaps.horizon, rtol=1e-9)
    assert gaps.horizon.max() == pytest.approx(1311, abs=1)


def test_long_intervals_are_stepped_through():
    for track in tracks.load((3, 17)):
        steps = np.diff(track.t)
        assert steps.max() <= 1.5 * tracks.STEP
        assert not track.position[~track.real].any()
    assert not track.velocity[~track.real].any()


def test_copies_by_hand():
    """Repeats within 5 s of the first report are copies; a vessel at rest keeps the later ones."""
    t = np.array([0.0, 2.0, 4.0, 6.0, 7.0, 9.0, 20.0])
    position = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 0.0], [9.0, 1.0], [9.0, 1.0], [9.0, 1.0], [9.0, 1.0]])
    np.testing.assert_array_equal(tracks.copied(t, position), [0, 0, 1, 0, 1, 1, 0])


def test_naive_baselines_by_hand():
    ys = np.array([[[0.0, 0.0], [2.0, 4.0], [9.0, 9.0], [9.0, 9.0], [5.0, 10.0]]])
    mask = np.array([[True, True, False, False, True]])
    dt = np.array([[1.0, 2.0, 1.0, 2.0, 1.0]])
    last, line = (tracks.naive(name, ys, mask, dt) for name in tracks.NAIVE)
    np.testing.assert_array_equal(last.position[0], [[0, 0], [2, 4], [2, 4], [2, 4], [5, 10]])
    assert not last.velocity.any()
    np.testing.assert_array_equal(line.position[0], [[0, 0], [2, 4], [3, 6], [5, 10], [5, 10]])
    np.testing.assert_array_equal(line.velocity[0], [[0, 0], [1, 2], [1, 2], [1, 2], [0.75, 1.5]])
    np.testing.assert_array_equal(line.innovation[0, -1], [-1.0, -2.0])


def test_training_pieces_hide_a_gap_each():
    data = tracks.training_pieces(tracks.load(tracks.TRAINING), np.random.default_rng(0))
    assert data.ys.shape[1:] == (tracks.SIZE, 2)
    assert data.mask[:, 0].all()  # each begins with a report
    assert (np.cumsum(data.dt, axis=1)[:, -1] > 0).all()
    assert np.isfinite(data.ys).all()


def test_quick_form_gives_finite_tables_and_a_figure(tmp_path, monkeypatch):
    """With given parameters: tuning takes its time compiling, and has tests of its own."""
    monkeypatch.setattr(vessels, "tuned", _given)
    monkeypatch.setattr(vessels, "SLOT", tracks.SLOT / 3)  # the full size's shapes, compiled already
    report = vessels.run(Options(out=tmp_path, quick=True))
    for table in report.tables:
        for cell in table.cells().values():
            assert np.isfinite(float(cell["value"]))
            assert cell["se"] is None or np.isfinite(cell["se"])
    assert all(path.stat().st_size > 10_000 for path in report.figures)
    assert all("nan" not in finding for finding in report.findings)


def _given(steps, names):
    del steps
    history = tune.History(np.array([1]), np.array([0.0]), np.array([6.0]))
    return {name: tune.TuneResult(PARAMS[name], 6.0, history, 1, 0.0, 0.0, "given") for name in names}


@pytest.mark.slow
def test_tuning_lowers_the_loss():
    learnt = vessels.tuned(10, ("CV",))
    assert learnt["CV"].loss < 7.2  # 8.0 at the start
