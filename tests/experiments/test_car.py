"""The recorded minute, what the filters see of it, and the published tables."""

from __future__ import annotations

import json

import numpy as np
import pytest

from experiments.car import drive as recorded
from experiments.car import filters, run
from experiments.report import Options, Report, compare

pytestmark = pytest.mark.xdist_group("car")  # one process, so that its tests share what they compute

CHOSEN = ("CV", "car, wheels", "car, wheels and gyro")  # the quick form's, so that the same programs serve


@pytest.fixture(scope="module")
def drive():
    return recorded.load()


@pytest.fixture(scope="module")
def cuts(drive):
    return recorded.cut(drive)


@pytest.fixture(scope="module")
def params():
    return run.published_parameters()


def test_the_recording_is_that_of_its_readme(drive):
    with np.load(recorded.DATA) as file:
        rates = {"imu": 104, "wheel": 83, "gnss": 10, "truth": 20}
        for name, rate in rates.items():
            t = file[f"{name}_t_s"]
            assert 1 / np.median(np.diff(t)) == pytest.approx(rate, rel=0.1)
        error = file["gnss_enu_m"][:, :2] - np.stack(
            [np.interp(file["gnss_t_s"], file["truth_t_s"], column) for column in file["truth_enu_m"][:, :2].T], axis=1
        )
    np.testing.assert_allclose(error.mean(axis=0), [-0.45, -1.38], atol=0.01)
    np.testing.assert_allclose(error.std(axis=0), [0.08, 0.27], atol=0.01)
    assert drive.ys.shape == (579, 4)
    assert np.isfinite(drive.ys).all()
    speed = np.linalg.norm(np.diff(drive.truth, axis=0), axis=1) / drive.dt[1:]
    assert speed.min() > 7
    assert speed.max() < 21


def test_the_gyroscope_turns_as_the_course_does_before_the_first_cut(drive):
    """The sign of the device's axis. The road is nearly straight and the receiver's course rough: over two seconds."""
    first = drive.t < recorded.SPLIT
    turned = np.cumsum(drive.ys[first, 3] * drive.dt[first])
    reference = np.arctan2(drive.direction[first, 1], drive.direction[first, 0])
    change, of_course, of_reference = (x[20:] - x[:-20] for x in (turned, drive.course[first], reference))
    assert np.corrcoef(change, of_course)[0, 1] > 0.3
    assert np.corrcoef(change, of_reference)[0, 1] > 0.5


def test_what_is_averaged_ends_at_its_epoch():
    """A sample after the last epoch changes nothing, one before it only its own interval."""
    t = np.array([0.1, 0.2, 0.3])
    times = np.linspace(0.01, 0.4, 40)
    values = np.arange(40.0)
    before = recorded._averaged(times, values, t)
    later = recorded._averaged(times, np.where(times > 0.3, 1e6, values), t)
    np.testing.assert_array_equal(before, later)
    middle = recorded._averaged(times, np.where((times > 0.101) & (times < 0.199), 1e6, values), t)
    assert (middle != before).tolist() == [False, True, False]


def test_cuts_lie_in_the_second_half(drive, cuts):
    for hidden, last, length, start in zip(*cuts, strict=True):
        t = drive.t[hidden]
        assert recorded.SPLIT <= start < t[0]
        assert t[-1] == drive.t[last]
        assert length - 0.25 < drive.t[last] - start <= length
    assert np.bincount(cuts.length)[list(recorded.LENGTHS)].tolist() == [25, 20, 10]


@pytest.mark.parametrize("name", CHOSEN)
def test_no_estimate_has_seen_a_hidden_sample(drive, cuts, params, name):
    """Garbage in place of what the filter is not given leaves the estimates the same to the last bit."""
    one = int(np.flatnonzero(cuts.length == 20)[0])
    garbage = drive.ys.copy()
    garbage[cuts.hidden[one], :2] = 1e6
    unseen = [2, 3] if name == "CV" else [3] if name == "car, wheels" else []
    garbage[:, unseen] = -1e6
    a, b = (run.estimate(name, params[name], ys, drive, cuts) for ys in (drive.ys, garbage))
    np.testing.assert_array_equal(a.position[one], b.position[one])
    np.testing.assert_array_equal(a.cov[one], b.cov[one])
    assert (np.asarray(a.position[0]) != np.asarray(b.position[0])).any() or name != "CV"  # other cuts did see it


def test_the_truth_moves_no_estimate(drive, cuts, params):
    other = drive._replace(truth=np.full_like(drive.truth, 1e6), offset=drive.offset + 1e6)
    a, b = (run.estimate("car, wheels", params["car, wheels"], d.ys, d, cuts) for d in (drive, other))
    np.testing.assert_array_equal(a.position, b.position)


def test_baselines_see_nothing_in_the_cut_but_the_wheels(drive, cuts):
    one = int(np.flatnonzero(cuts.length == 20)[0])
    hidden = cuts.hidden[one]
    garbage = drive.ys.copy()
    garbage[hidden, :2] = 1e6
    other = drive._replace(
        ys=garbage, speed=np.where(hidden, 1e6, drive.speed), course=np.where(hidden, 9, drive.course)
    )
    for name in run.BASELINES:
        a, b = (run.baseline(name, d, cuts)[one][hidden] for d in (drive, other))
        np.testing.assert_array_equal(a, b)


def test_a_straight_drive_at_constant_speed_is_bridged_without_error(drive, cuts, params):
    """Made by hand: 10 m/s north, wheels 1 % low, gyroscope with a bias. These are learnt before the cut."""
    t = drive.t
    ys = np.stack([0 * t, 10 * t, 0 * t + 9.9, 0 * t + 0.07], axis=1)
    out = run.estimate("car, wheels and gyro", params["car, wheels and gyro"], ys, drive, cuts)
    error = np.linalg.norm(np.asarray(out.position) - ys[:, :2], axis=-1)
    assert error[cuts.hidden].max() < 0.05


def test_published_table_agrees_with_a_rerun(params):
    """With the published parameters; they are not tuned again."""
    published = json.loads(run.PUBLISHED.read_text(encoding="utf-8"))
    shown = (*CHOSEN, *run.BASELINES)
    for name in ("errors", "parts"):
        rows = published["tables"][name]["rows"]
        published["tables"][name]["rows"] = [row for row in rows if row[0] in shown]
    o = run.evaluate({name: params[name] for name in CHOSEN}, {}, seed=1)
    assert compare(published, Report("car", "", [run._errors(o), run._parts(o)])) == []


def test_quick_form_gives_finite_tables_and_a_figure(tmp_path):
    report = run.run(Options(out=tmp_path, quick=True))
    for table in report.tables:
        for cell in table.cells().values():
            assert np.isfinite(float(cell["value"]))
            assert cell["se"] is None or np.isfinite(cell["se"])
    assert all(path.stat().st_size > 10_000 for path in report.figures)
    assert all("nan" not in finding for finding in report.findings)


@pytest.mark.slow
def test_tuning_lowers_the_loss_from_its_start(drive):
    few = run.learn("car, wheels", drive, steps=1)
    more = run.learn("car, wheels", drive, steps=20)
    assert more.loss < few.loss - 0.1
    assert set(more.params) == set(filters.space("car, wheels"))
