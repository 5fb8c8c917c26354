"""The recorded scans, the tracks started from them, what the filters see, and the published tables."""

from __future__ import annotations

import json

import jax
import numpy as np
import pytest

from experiments.radar import confirm, filters, run
from experiments.radar import scans as recorded
from experiments.radar import scores as scoring
from experiments.report import Options, Report, compare

pytestmark = pytest.mark.xdist_group("radar")  # one process, so that its tests share what they compute


@pytest.fixture(scope="module")
def each():
    return {source: run.tracks(source) for source in run.SOURCES}


@pytest.fixture(scope="module")
def params():
    return run.published_parameters()


@pytest.mark.parametrize(
    ("name", "seconds", "radar", "lidar"),
    [("04", 99, 59, 197), ("05", 139, 83, 276), ("16", 118, 72, 235), ("22", 84, 50, 168)],
)
def test_recordings_are_those_of_their_readme(name, seconds, radar, lidar):
    scans = recorded.load(name)
    assert np.bincount(scans.sensor).tolist() == [radar, lidar]
    assert scans.t[-1] == pytest.approx(seconds, abs=1.5)
    assert (np.diff(scans.t) > 0).all()
    steps = [np.median(np.diff(scans.t[scans.sensor == sensor])) for sensor in (0, 1)]
    np.testing.assert_allclose(steps, [1 / 0.6, 0.5], rtol=0.02)
    true = recorded.truth(name, scans.t)
    apart = np.linalg.norm(scans.position[:, :, None] - true[:, None], axis=-1).min(axis=-1)[scans.valid]
    for sensor, (low, high), (least, most) in ((0, (4.0, 9.7), (0.26, 0.49)), (1, (1.9, 4.3), (0.73, 0.97))):
        own = apart[np.repeat(scans.sensor[:, None], recorded.ROOM, axis=1)[scans.valid] == sensor]
        near = own < 20
        assert low - 0.1 < np.median(own[near]) < high + 0.1
        assert least - 0.01 < near.mean() < most + 0.01
    speed = np.linalg.norm(np.diff(true[::50], axis=0), axis=-1) / np.diff(scans.t[::50])[:, None]
    assert np.nanmax(speed) < 8  # so that the speed limit leaves room


def test_positions_and_polar_coordinates_agree_with_the_file():
    scans = recorded.load("04", ("radar",))
    table = recorded._table("04", "detections")
    listed = recorded._table("04", "scans")
    first = table[table["scan"] == listed[listed["sensor"] == "radar"]["scan"][0]]
    here = scans.position[0][scans.valid[0]] - scans.own[0]
    np.testing.assert_allclose(here, np.stack([first["east_m"], first["north_m"]], axis=1), atol=1e-9)


def test_tracks_start_from_pairs_that_a_boat_could_make(each):
    for t in each.values():
        apart = np.linalg.norm(t.second - t.first, axis=1)
        assert (apart < recorded.LIMIT * t.span).all()
        assert ((t.t > t.t_second[:, None]) | ~t.mask).all()
        assert (t.dt[t.mask] > 0).all()
        assert not (t.valid & ~t.mask[:, :, None]).any()
    for a, b in zip(each["radar"][:4], each["radar and lidar"][:4], strict=True):
        np.testing.assert_array_equal(a, b)  # the same starts: lidar only helps to go on


def test_two_point_start_by_hand():
    """100 m north of the ship: range is north, bearing east."""
    track = filters.Given(*[None] * len(filters.Given._fields))._replace(  # type: ignore[arg-type]
        first=jax.numpy.array([8.0, 99.0]), second=jax.numpy.array([10.0, 100.0]),
        own=jax.numpy.array([10.0, 0.0]), span=jax.numpy.array(2.0),
    )  # fmt: skip
    start = filters.two_point(track, jax.numpy.array([4.0, 1e-4]))
    np.testing.assert_allclose(start.mean, [10, 100, 1, 0.5])
    np.testing.assert_allclose(np.diag(start.cov), [1, 4, 0.5, 2], atol=1e-12)
    np.testing.assert_allclose(np.asarray(start.cov)[:2, 2:], [[0.5, 0], [0, 2]], atol=1e-12)


def test_confirmation_and_merging_by_hand(each):
    t = recorded.select(each["radar"], np.array([0, 0, 0]))
    choice = np.full((3, recorded.STEPS), -1)
    choice[0, :9], choice[1, 3:12], choice[2, :8] = 1, 1, 2
    assert confirm.confirmed(choice).tolist() == [True, True, False]
    # The first two share six of nine detections, so the likelier is left; the third shares none.
    log_lik = np.zeros(choice.shape)
    log_lik[1] = 1.0
    assert confirm.merged(t, choice, log_lik).tolist() == [1, 2]


def test_lost_by_hand():
    t = np.tile(np.arange(8.0) * 2, (3, 1))
    scored = np.ones(t.shape, bool)
    error = np.zeros(t.shape)
    error[0, 1:6] = 31  # eight seconds, and back
    error[1, 1:7] = 31  # ten
    error[2, 7] = 31  # at the end
    assert scoring.lost(error, t, scored).tolist() == [False, True, True]


@pytest.mark.parametrize("name", run.QUICK)
def test_the_filters_see_neither_truth_nor_what_is_not_there(each, params, name, monkeypatch):
    """Garbage in place of the truth, of missing detections and of scans beyond the end: the same to the last bit."""
    t = each["radar"]
    own = run.own_parameters(params[name], "radar", t)
    before = filters.run(name, own, filters.given(t))
    monkeypatch.setattr(recorded, "truth", lambda scenario, times: np.full((*np.shape(times), 2, 2), 1e6))
    again = run.tracks("radar")
    detections = np.where(again.valid[..., None], again.detections, 1e6)
    observer = np.where(again.mask[..., None], again.observer, -1e6)
    after = filters.run(name, own, filters.given(again._replace(detections=detections, observer=observer)))
    np.testing.assert_array_equal(before.choice, after.choice)
    for a, b in ((before.position, after.position), (before.cov, after.cov)):
        np.testing.assert_array_equal(np.asarray(a)[t.mask], np.asarray(b)[t.mask])
    assert (np.asarray(before.choice) >= 0).any()


def test_a_naive_tracker_follows_a_straight_line(each):
    """Made by hand: one detection per scan, on a line; both trackers take each of them."""
    t = recorded.select(each["radar"], np.array([0]))
    start, velocity = np.array([100.0, 50.0]), np.array([3.0, -1.0])
    place = start + velocity * (t.t[0] - t.t_second[0])[:, None]
    polar = np.stack([np.hypot(*place.T), np.arctan2(place[:, 1], place[:, 0])], axis=1)
    detections, valid = np.zeros_like(t.detections), np.zeros_like(t.valid)
    detections[0, :, 0], valid[0, :, 0] = polar, t.mask[0]
    t = t._replace(first=(start - velocity * t.span)[None], second=start[None], observer=np.zeros_like(t.observer),
                   detections=detections, valid=valid)  # fmt: skip
    for name in scoring.NAIVE:
        out = scoring.naive(name, t)
        assert (out.choice[t.mask] == 0).all()
        np.testing.assert_allclose(out.position[t.mask], place[t.mask[0]], atol=1e-9)
    np.testing.assert_allclose(out.predicted[t.mask], place[t.mask[0]], atol=1e-9)  # pyright: ignore


def test_published_tables_agree_with_a_rerun(each, params):
    """With the published parameters; they are not tuned again."""
    published = json.loads(run.PUBLISHED.read_text(encoding="utf-8"))
    shown = (*run.QUICK, run.UNTUNED, *scoring.NAIVE)
    for name in ("first", "every", "lidar"):
        rows = published["tables"][name]["rows"]
        published["tables"][name]["rows"] = [row for row in rows if row[0] in shown]
    o = run.evaluate({name: params[name] for name in run.QUICK}, each)
    tables = [run._first(o, 1), *(run._every(o, source, 1) for source in run.SOURCES)]
    assert compare(published, Report("radar", "", tables)) == []


@pytest.mark.slow  # `make reproduce` runs it too
def test_quick_form_gives_finite_tables_and_a_figure(tmp_path):
    report = run.run(Options(out=tmp_path, quick=True))
    for table in report.tables:
        for cell in table.cells().values():
            assert np.isfinite(float(cell["value"]))
            assert cell["se"] is None or np.isfinite(cell["se"])
    assert all(path.stat().st_size > 10_000 for path in report.figures)
    assert all("nan" not in finding for finding in report.findings)


@pytest.mark.slow
def test_each_set_of_parameters_is_tuned_by_itself(each):
    """Spoiling the tracks of one set leaves the path of the others as it is."""
    data = run.training(each)
    spoilt = data._replace(mask=data.mask.at[0].set(False))
    a, b = (run.learn("CV", d, steps=3).params for d in (data, spoilt))
    for key in a:
        np.testing.assert_allclose(np.asarray(a[key])[1:], np.asarray(b[key])[1:], rtol=1e-9)
    assert (np.asarray(a["cv_q"])[0] != np.asarray(b["cv_q"])[0]).all()
