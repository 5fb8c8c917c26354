from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd
import pytest

from jaxfilt.__main__ import main
from jaxfilt.cli import compare, filters, learn, read, run, text
from jaxfilt.cli.read import Options
from jaxfilt.cli.units import BadInput, quantity, split

DATA = Path(__file__).parents[1] / "experiments" / "data"
T = 60  # rows of every file that is filtered, so that each filter compiles once


def straight(seed: int = 0, *, sigma: float = 2.0, q: float = 0.02) -> pd.DataFrame:
    """A target with white acceleration, seen with noise."""
    rng = np.random.default_rng(seed)
    velocity = np.array([5.0, -3.0]) + np.cumsum(np.sqrt(q) * rng.standard_normal((T, 2)), axis=0)
    x, y = (np.cumsum(velocity, axis=0) + sigma * rng.standard_normal((T, 2))).T
    return pd.DataFrame({"t": np.arange(T, dtype=float), "x": x, "y": y})


@pytest.fixture
def file(tmp_path, monkeypatch):
    """Writes text or a frame to a CSV file in the current folder, and returns its name."""
    monkeypatch.chdir(tmp_path)

    def write(content: str | bytes | pd.DataFrame, name: str = "f.csv") -> str:
        if isinstance(content, pd.DataFrame):
            content.to_csv(name, index=False)
        else:
            Path(name).write_bytes(content if isinstance(content, bytes) else content.encode())
        return name

    return write


SET = ["--set", "q=0.02", "--set", "sigma=2m"]

# ---------------------------------------------------------------------------------------------------------- reading


def rows(header: str, line: str, count: int = 12) -> str:
    return "\n".join([header, *(line.format(k=k, s=f"{k % 60:02d}") for k in range(count))])


@pytest.mark.parametrize(
    ("content", "options", "axes", "first", "dt"),
    [
        (rows("t,x,y", "{k},{k}.5,1"), {}, ("x", "y"), [[0.5, 1], [1.5, 1]], 1.0),
        (rows("time_ms;x [km];y [km]", "{k};{k},5;1"), {}, ("x", "y"), [[500, 1000], [1500, 1000]], 1e-3),
        (rows("Time (min)\tEasting\tNorthing", "{k}\t{k}\t0"), {}, ("easting", "northing"), [[0, 0], [1, 0]], 60.0),
        (rows("timestamp,x", "2026-03-01T12:00:{s}Z,{k}"), {}, ("x",), [[0], [1]], 1.0),
        (rows("a,b,c", "{k},{k},0"), {"time": "a:h", "position": "b:ft,c:m"}, ("b", "c"), [[0, 0], [0.3048, 0]], 3600),
        (rows("x,y,z", "{k},0,2"), {"interval": 0.5}, ("x", "y", "z"), [[0, 0, 2], [1, 0, 2]], 0.5),
        (rows("timestamp,x", "17000000{s}000,{k}"), {}, ("x",), [[0], [1]], 1.0),  # milliseconds since 1970
    ],
)  # fmt: skip
def test_columns_and_units_are_found_or_named(file, content, options, axes, first, dt):
    rec = read.read(file(content), Options(**options))
    assert rec.axes == axes
    np.testing.assert_allclose(rec.ys[:2], first, rtol=1e-12)
    np.testing.assert_allclose(rec.dt, dt, rtol=1e-9)


def test_rows_and_cells_may_be_missing(file):
    content = "t,x,y\n" + "\n".join(f"{k},{k},{k}" for k in range(11)) + "\n11,,\n\n12,NaN,4\n20,5,na\n"
    rec = read.read(file(content), Options())
    np.testing.assert_array_equal(rec.mask[10:], [[1, 1], [0, 0], [0, 1], [1, 0]])
    np.testing.assert_array_equal(rec.dt[-3:], [1, 1, 8])
    assert list(rec.cells.index[-3:]) == [13, 15, 16]  # lines as an editor counts them


def test_latitude_and_longitude_are_projected_as_the_recordings_own_meters():
    path = str(DATA / "glider_igc" / "soaring_1s.csv")
    globe = read.read(path, Options(lat_lon="lat_deg,lon_deg"))
    plane = read.read(path, Options())
    assert (globe.axes, plane.axes) == (("east", "north"), ("east", "north"))
    ours, theirs = globe.ys - globe.ys.mean(axis=0), plane.ys - plane.ys.mean(axis=0)
    assert np.abs(ours - theirs).max() < 2e-3 * np.abs(theirs).max()
    assert globe.place is not None
    lat, lon = globe.place.to_globe(*globe.ys.T)
    np.testing.assert_allclose(lat[0], 46.206317, rtol=1e-12)
    np.testing.assert_allclose(lon[0], 12.8472, rtol=1e-12)


def test_longitudes_wrap(file):
    content = "t,lat,lon\n" + "\n".join(f"{k},0,{-180 + k - 6 if k > 6 else 180 + k - 6}" for k in range(12))
    east = read.read(file(content), Options()).ys[:, 0]
    np.testing.assert_allclose(np.diff(east), np.diff(east)[0], rtol=1e-9)


def test_bearings_by_compass(file):
    rec = read.read(file(rows("t,range_km,az_deg", "{k},2,90")), Options(compass=True))
    np.testing.assert_allclose(rec.fixes[0], [2000, 0], atol=1e-9)
    assert rec.axes == ("east", "north")


GOOD = rows("t,x,y", "{k},{k},0")


WRONG = [
    (None, [], "no_such.csv: No such file"),
    ("", [], "f.csv: is empty"),
    (b"\x89PNG\r\n\x1a\n\x00\x00", [], "is no text file"),
    (b"t,x\n\xff\xfe,1\n", [], "is no text file"),
    ("0,1,2\n1,2,3\n", [], "has no header"),
    ("t,x,y\n", [], "has a header but no rows"),
    ("t,x,x\n0,1,1\n", [], "the header has 'x' twice"),
    (GOOD + "\n12,1,2,3\n", [], "line 14 has 4 cells, the header 3"),
    (GOOD + "\n12,1,oops\n", [], "line 14, column 'y': 'oops' is no number"),
    (GOOD + "\n12,1,inf\n", [], "line 14, column 'y': 'inf' is not finite"),
    (GOOD + "\n,1,2\n", [], "line 14, column 't': no time stamp"),
    (GOOD + "\n5,1,2\n", [], r"time goes back at line 14 \(5 after 11\)"),
    (GOOD + "\n11,1,2\n", [], "line 14 has the time stamp of the row before it"),
    (rows("t,x,y", "{k},,"), [], "all cells of x, y are empty"),
    (rows("t,x,y", "{k},1,2", 5), [], "only 5 rows with a whole measurement"),
    (rows("t,a,b", "{k},1,2"), [], "no columns of positions were recognized among t, a, b"),
    (rows("when,x,y", "{k},1,2"), [], "no column of times was recognized"),
    (rows("time,x,y", "noon {k},1,2"), [], "neither a number nor an ISO time stamp"),
    (GOOD, ["--position", "x,yy"], "there is no column 'yy'; did you mean 'y'"),
    (GOOD, ["--position", "x:furlong,y"], "'furlong' is no unit of length; known are m, km"),
    (GOOD, ["--time", "t:parsec"], "'parsec' is no unit of time"),
    (GOOD, ["--where", "y=7"], "no row is left; y has 0"),
    (GOOD, ["--model", "warp"], "--model: expected cv, ca"),
    (GOOD, ["--filter", "magic"], "--filter: expected one of kalman"),
    (GOOD, ["--model", "ct", "--filter", "kalman"], "ct is a nonlinear model"),
    (GOOD, ["--set", "mass=3"], "there is no parameter 'mass'"),
    (GOOD, ["--set", "tau=3s"], "the filter has no parameter 'tau'; it has q, sigma"),
    (GOOD, ["--set", "sigma=-3m"], "expected a value above 0"),
    (GOOD, ["--set", "sigma=3s"], "'s' is no unit of length"),
    (GOOD, ["--out", "a.pdf"], "ends in .csv, .png, .html"),
    (GOOD, ["--out", "no_folder/a.csv"], "there is no folder 'no_folder'"),
    (GOOD, ["--out", "f.csv"], "is the recording itself"),
    (GOOD, ["--learn-rows", "3"], "--learn-rows: expected 40 or more"),
    (GOOD, ["--nonsense"], "unrecognized arguments"),
    (rows("t,range_m,bearing", "{k},1,2"), [], "is 'bearing' in deg or in rad"),
    (rows("t,x,y,z", "{k},1,2,3"), ["--model", "ct", "--position", "x,y,z"], "ct is planar"),
]  # fmt: skip


@pytest.mark.parametrize(("content", "arguments", "says"), WRONG, ids=[says for *_, says in WRONG])
def test_what_is_wrong_is_said_in_one_line_with_exit_status_2(file, capsys, content, arguments, says):
    name = "no_such.csv" if content is None else file(content)
    assert main(["track", name, *arguments]) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert re.search(says, said), said


def test_rows_with_the_same_time_stamp_can_be_kept_or_dropped(file):
    name = file(GOOD + "\n11,1,2\n")
    assert not read.read(name, Options(duplicates="first")).mask[-1].any()
    both = read.read(name, Options(duplicates="both"))
    assert both.mask[-1].all()
    assert both.dt[-1] == 0


def test_units():
    assert quantity("5 km", "length", "") == 5000
    assert quantity("90deg", "angle", "") == pytest.approx(np.pi / 2)
    assert quantity("1e-3", "m^2/s^3", "") == 1e-3
    assert [split(h) for h in ("alt_ft", "X [m]", "lat_deg", "ground speed", "gps_fix")] == [
        ("alt", "ft"), ("x", "m"), ("lat", "deg"), ("ground speed", None), ("gps_fix", None),
    ]  # fmt: skip
    with pytest.raises(BadInput, match="expected a number with a unit"):
        quantity("much", "length", "")


# --------------------------------------------------------------------------------------------------------- learning


@pytest.fixture(scope="module")
def learnt(tmp_path_factory):
    path = tmp_path_factory.mktemp("cli") / "f.csv"
    straight().to_csv(path, index=False)
    rec = read.read(str(path), Options())
    choice, s = filters.parse("cv", rec), filters.scale(rec)
    return rec, choice, s, learn.learn(choice, rec, s, filters.space(choice, s, {}))


def test_what_is_learnt_is_likelier_than_its_neighbors_and_near_the_truth(learnt):
    rec, choice, s, found = learnt
    assert found.free == ("sigma", "q")
    assert 1.4 < found.params["sigma"] < 2.8
    assert 0.02 / 8 < found.params["q"] < 0.02 * 8

    def log_lik(**change: float) -> float:
        verdict = run.verdict(rec, run.run(rec, choice, {**found.params, **change}, s))
        assert verdict is not None
        return verdict.log_lik

    best = log_lik()
    assert best == pytest.approx(-found.result.loss, rel=1e-9)  # both are of the same fixes
    for name in found.params:
        for factor in (0.8, 1.25):
            assert log_lik(**{name: factor * found.params[name]}) < best


def test_a_bound_that_is_reached_is_reported(learnt):
    rec, choice, s, _ = learnt
    space = filters.space(choice, s, {"sigma": 2.0}) | {"q": learn.tune.positive(10.0, 5.0, 20.0)}
    found = learn.learn(choice, rec, s, space)
    assert found.free == ("q",)
    assert any(re.match(r"q ran to its lower bound, 5 m\^2/s\^3", w) for w in found.warnings)


def test_verdict_tells_too_sure_from_too_cautious(learnt):
    rec, choice, s, found = learnt
    for factor, word in ((1.0, "fits"), (0.5, "too sure"), (2.0, "too cautious")):
        params = {"sigma": factor * found.params["sigma"], "q": factor**2 * found.params["q"]}
        verdict = run.verdict(rec, run.run(rec, choice, params, s))
        assert verdict is not None
        assert word in verdict.sentence


# --------------------------------------------------------------------------------------------------------- commands


def test_track_writes_the_rows_of_the_file_in_its_units(file, capsys):
    df = straight()
    df.insert(0, "name", "a")
    seen = df.assign(x=df["x"] / 1000, y=df["y"] / 1000).rename(columns={"x": "x_km", "y": "y_km"})
    seen.loc[20:24, ["x_km", "y_km"]] = np.nan
    arguments = ["track", file(seen), *SET, "--out", "o.csv", "--out", "o.html"]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    for line in (
        r"60 rows over 59 s, 5 of them without a measurement",
        r"columns  time t; x_km \[km\], y_km \[km\]",
        r"sigma +2 m .*\(given\)",
        r"mean NIS [\d.]+, expected 2",
        r"status   MISSED 5",
        "written  o.html",
    ):
        assert re.search(line, said), line
    out: Any = pd.read_csv("o.csv")
    assert list(out["t"]) == list(seen["t"])
    np.testing.assert_allclose(out["x_km"], seen["x_km"], rtol=1e-12)
    assert {"x_est [km]", "x_std [km]", "x_velocity [km/s]", "y_velocity_std [km/s]", "nis", "status"} <= set(out)
    np.testing.assert_allclose(out["x_velocity [km/s]"][40:], 5e-3, atol=4e-3)
    assert (out["status"][20:25] == "MISSED").all()
    assert out["x_std [km]"][24] > 1.5 * out["x_std [km]"][19]
    page = Path("o.html").read_text(encoding="utf-8")
    assert "<script src=" not in page  # works offline
    for part in ("without measurement", "95 % ellipses", "sigma", "normalized innovation squared"):
        assert part in page


def test_an_imm_over_latitude_and_longitude_smoothed_with_a_picture(file, capsys):
    df = straight()
    seen = pd.DataFrame({"t": df["t"], "lat": 50 + df["y"] / 111_000, "lon": 7 + df["x"] / 71_000})
    given = ["q=0.02", "q_ct=0.02", "q_omega=1e-4", "sigma=2m", "life_cv=60s", "life_ct=0.5min"]
    options = [x for value in given for x in ("--set", value)]
    arguments = ["track", file(seen), "--model", "ct", "--filter", "imm", *options, "--smooth"]
    assert main([*arguments, "--out", "o.csv", "--out", "o.png"]) == 0
    assert "meters east and north of 49.9" in capsys.readouterr().out
    out = pd.read_csv("o.csv")
    np.testing.assert_allclose(out["lat_est [deg]"], seen["lat"], atol=1e-4)
    np.testing.assert_allclose(out["p_cv"] + out["p_ct"], 1, rtol=1e-9)
    assert "turn_rate [rad/s]" in out
    assert Path("o.png").read_bytes()[:4] == b"\x89PNG"


def test_range_and_bearing(file, capsys):
    df = straight()
    df["x"] += 1000
    seen = pd.DataFrame({"t": df["t"], "r": np.hypot(df["x"], df["y"]), "b": np.degrees(np.arctan2(df["y"], df["x"]))})
    options = [
        "--range-bearing",
        "r:m,b:deg",
        "--set",
        "q=0.02",
        "--set",
        "sigma_range=2m",
        "--set",
        "sigma_bearing=0.1deg",
    ]
    assert main(["track", file(seen), *options, "--out", "o.csv"]) == 0
    assert re.search(r"sigma_bearing +0.1 deg", capsys.readouterr().out)
    out = pd.read_csv("o.csv")
    np.testing.assert_allclose(out["x_est [m]"], df["x"], atol=8)


def test_alpha_beta_cannot_be_smoothed_and_says_so(file, capsys):
    arguments = ["track", file(straight()), "--filter", "alpha_beta", "--set", "index=0.1", "--set", "sigma=2m"]
    assert main(arguments) == 0
    assert "index" in capsys.readouterr().out
    assert main([*arguments, "--smooth"]) == 2
    assert "--smooth: alpha_beta cannot be smoothed" in capsys.readouterr().err


def test_compare_scores_what_was_held_out(file, capsys):
    name = file(straight(1))
    arguments = ["compare", name, "--filters", "cv,cv:alpha_beta", "--set", "q=0.02", "--set", "sigma=2m",
                 "--set", "index=3", "--hide", "3", "--train-share", "0.5"]  # fmt: skip
    assert main([*arguments, "--out", "s.csv", "--out", "s.png", "--out", "s.html"]) == 0
    said = capsys.readouterr().out
    assert "learnt from rows 1 to 30, scored on the 30 fixes of the other 30 rows" in said
    table: Any = pd.read_csv("s.csv")
    assert list(table["filter"]) == ["cv:kalman", "cv:alpha_beta"]  # an index of 3 follows the noise
    worse = [float(cell.split()[0]) for cell in table["RMSE in gaps [m]"]]
    assert worse[0] < worse[1]
    assert table["less the best's"][1].startswith("-")
    assert Path("s.png").exists()
    assert "±" in Path("s.html").read_text(encoding="utf-8")


def test_hidden_rows_are_predicted_from_what_came_before(learnt):
    rec, choice, s, found = learnt
    masks = compare.hiding(rec, 30, 3)
    assert (rec.mask[None] & ~masks).sum(axis=0)[30:].tolist() == [[1, 1]] * 30  # each row hidden once
    assert masks[:, :30].all()
    held = np.arange(T) >= 30
    scored = compare.score(rec, choice, found, s, held, masks)
    assert np.isnan(scored.hidden[:30]).all()
    k = 30  # hidden in the first run: the second of its predictions is two steps ahead of row 29
    moved = rec._replace(ys=rec.ys + np.where(np.arange(T) == k + 1, 100.0, 0.0)[:, None])
    other = compare.score(moved, choice, found, s, held, masks)
    assert other.hidden[k] == pytest.approx(scored.hidden[k], rel=1e-9)  # nothing of a hidden row leaks


def test_what_is_held_out_plays_no_part_in_learning(learnt):
    rec, choice, _, _ = learnt
    later = (np.arange(T) >= 30)[:, None]
    other = rec._replace(ys=np.where(later, 7.0 * rec.ys, rec.ys), fixes=np.where(later, 7.0 * rec.fixes, rec.fixes))
    seen = [learn.pieces(r, filters.scale(r, 30), choice, 30, 1000) for r in (rec, other)]
    for one, two in zip(jax.tree.leaves(seen[0]), jax.tree.leaves(seen[1]), strict=True):
        np.testing.assert_array_equal(one, two)
    assert not np.array_equal(filters.scale(rec).sigma, filters.scale(other).sigma)


def test_standard_errors_come_from_resampled_blocks():
    x = np.where(np.arange(400) // 20 % 2 == 0, 1.0, 3.0)
    block = np.arange(400) // 20
    values = compare.draws(x, block)
    assert values[0] == 2
    assert np.std(values[1:]) == pytest.approx(1 / np.sqrt(20), rel=0.1)
    assert text.with_error(1.2345, 0.0456) == "1.234 ± 0.046"


def test_compare_refuses_what_cannot_be_scored(file, capsys):
    name = file(straight())
    for extra, says in ((["--train-share", "0.99"], "--train-share"), (["--hide", "0"], "--hide"),
                        (["--filters", "cv,cv"], "--filters: expected different")):  # fmt: skip
        assert main(["compare", name, "--filters", "cv", *extra]) == 2
        assert says in capsys.readouterr().err


def test_a_missing_extra_gives_the_pip_command(file, capsys, monkeypatch):
    name = file(straight())
    for module, suffix in (("pandas", None), ("plotly.graph_objects", "html"), ("matplotlib.figure", "png")):
        with monkeypatch.context() as without:
            without.setitem(sys.modules, module, None)
            assert main(["track", name, *SET, *(["--out", f"o.{suffix}"] if suffix else [])]) == 2
        said = capsys.readouterr()
        assert 'pip install "jaxfilt[' in said.err
        assert not said.out  # before any work is done


def test_the_help_shows_examples():
    done = subprocess.run(
        [sys.executable, "-m", "jaxfilt", "track", "--help"], capture_output=True, text=True, check=True
    )
    assert "python -m jaxfilt track flight.csv" in done.stdout
    assert "q_omega" in done.stdout
