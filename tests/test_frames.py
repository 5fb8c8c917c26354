from __future__ import annotations

import sys

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import jaxfilt as jf
from jaxfilt.frames import from_frame, status_text, to_frame, to_xarray


@pytest.fixture(scope="module")
def df() -> pd.DataFrame:
    return pd.DataFrame({"t": [10.0, 11.0, 13.0, 14.0], "x": [0.0, 1.0, np.nan, 4.0], "n": [1, 2, 3, 4]})


@pytest.fixture(scope="module")
def out(df) -> jf.Info:
    series = from_frame(df, ["x"], time="t")
    cv = {"dt": 1.0, "r": 1.0, "m0": [0.0, 0.0], "P0": [[1.0, 0.0], [0.0, 1.0]]}
    models = [jf.models.constant_velocity(q=q, **cv) for q in (0.1, 1.0)]
    filt = jf.imm([jf.kalman(model) for model in models], [[0.9, 0.1], [0.1, 0.9]])
    return jf.filter(filt, series.ys, mask=series.mask, dt=series.dt, outputs=jf.everything)


def test_empty_cells_are_masked_and_intervals_are_those_of_the_time_column(df):
    series = from_frame(df, ["x", "n"], time="t")
    np.testing.assert_array_equal(series.ys, [[0, 1], [1, 2], [0, 3], [4, 4]])
    np.testing.assert_array_equal(series.mask, [[True, True], [True, True], [False, True], [True, True]])
    np.testing.assert_array_equal(series.dt, [1, 1, 2, 1])  # the first is the median
    np.testing.assert_array_equal(series.times, [0, 1, 3, 4])
    assert series.ys.dtype == jnp.zeros(()).dtype


def test_dates_are_taken_from_a_column_or_from_the_index(df):
    stamps = pd.to_datetime("2026-01-01") + pd.to_timedelta(df["t"], unit="s")
    by_column = from_frame(df.assign(t=stamps), ["x"], time="t")
    by_index = from_frame(df.set_index(pd.DatetimeIndex(stamps)), ["x"])
    zoned = from_frame(df.set_index(pd.DatetimeIndex(stamps).tz_localize("UTC")), ["x"], first=0.5)
    np.testing.assert_allclose(np.asarray(by_column.dt), [1, 1, 2, 1], rtol=1e-12)
    np.testing.assert_array_equal(by_index.dt, by_column.dt)
    np.testing.assert_allclose(np.asarray(zoned.dt), [0.5, 1, 2, 1], rtol=1e-12)
    assert from_frame(df, ["x"]).dt is None


def test_missing_values_of_nullable_columns_are_masked():
    df = pd.DataFrame({"x": pd.array([1, None, 3], dtype="Int64")})
    np.testing.assert_array_equal(from_frame(df, ["x"]).mask[:, 0], [True, False, True])


@pytest.mark.parametrize(
    ("change", "columns", "time", "text"),
    [
        ({}, ["y"], "t", "columns: there is no column 'y'; the frame has 't', 'x', 'n'"),
        ({}, ["x"], "time", "time: there is no column 'time'"),
        ({"t": [0.0, 1.0, 1.0, 2.0]}, ["x"], "t", "time: must increase, but row 2 is not after row 1"),
        ({"t": [0.0, np.nan, 1.0, 2.0]}, ["x"], "t", "time: row 1 has no time stamp"),
        ({"x": ["a", "b", "c", "d"]}, ["x"], "t", "columns: 'x' holds no numbers"),
        ({"x": [0.0, np.inf, 1.0, 2.0]}, ["x"], "t", "columns: expected finite values, but row 1 has not"),
    ],
)
def test_a_bad_frame_is_refused_by_row_and_column(df, change, columns, time, text):
    with pytest.raises((ValueError, TypeError), match=text):
        from_frame(df.assign(**change), columns, time=time)


def test_to_frame_has_estimates_deviations_and_status_as_text(df, out):
    table = to_frame(out, index=df["t"], names=["x", "v"])
    assert list(table) == ["x", "x_std", "v", "v_std", "nis", "log_lik", "status", "mode_0", "mode_1"]
    np.testing.assert_array_equal(table["x"], out.mean[:, 0])
    np.testing.assert_allclose(table["v_std"] ** 2, out.cov[:, 1, 1], rtol=1e-12)  # pyright: ignore[reportOptionalSubscript]
    assert list(table["status"]) == ["", "", "MISSED", ""]
    assert list(table.index) == list(df["t"])
    smoothed = to_frame(jf.rts(out))
    assert list(smoothed) == ["x0", "x0_std", "x1", "x1_std"]


def test_to_xarray_keeps_covariances_and_explains_the_status(df, out):
    found = to_xarray(out, times=df["t"], names=["x", "v"])
    assert found["cov"].dims == ("time", "state", "state_")
    assert float(found["cov"].sel(time=13.0, state="x", state_="v")) == float(out.cov[2, 0, 1])  # pyright: ignore[reportOptionalSubscript]
    assert found["mode_probabilities"].shape == (4, 2)
    assert found["status"].attrs["flag_meanings"].split()[0] == "MISSED"
    assert found["status"].attrs["flag_masks"][0] == 1
    batch = jf.Info(*(None if x is None else jnp.stack([x, x]) for x in out[:7]))
    assert to_xarray(batch)["mean"].dims == ("run", "time", "state")
    with pytest.raises(ValueError, match=r"out: .* to_xarray"):
        to_frame(batch)


def test_status_text_names_all_bits():
    words = np.array([0, 1, 1 | 2], np.int32)
    assert status_text(words) == ["", "MISSED", "MISSED|GATED"]


def test_a_missing_extra_gives_the_pip_command(monkeypatch, df, out):
    for name, call in {"pandas": lambda: from_frame(df, ["x"]), "xarray": lambda: to_xarray(out)}.items():
        monkeypatch.setitem(sys.modules, name, None)
        with pytest.raises(ImportError, match=r'pip install "jaxfilt\[data\]"'):
            call()
        monkeypatch.undo()
