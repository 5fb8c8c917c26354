"""Data frames in and out: pandas and xarray at the border (extra ``data``), arrays inside.

series = jf.frames.from_frame(df, ["x", "y"], time="t")
out = jf.filter(filt, series.ys, mask=series.mask, dt=series.dt)
jf.frames.to_frame(out, index=df["t"], names=["x", "y", "vx", "vy"]).to_csv("estimate.csv")
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import Info, Status, intervals, number
from jaxfilt.smooth import Smoothed


class Series(NamedTuple):
    """A recorded series as :func:`jaxfilt.filter` takes it, in JAX's default float dtype."""

    ys: Array  # (T, m), 0 where missing
    mask: Array  # (T, m) bool, True = present
    dt: Array | None  # (T,) s; None if the frame has no time
    times: Array | None  # (T,) s since the first row


def from_frame(df: Any, columns: Sequence[str], *, time: str | None = None, first: float | None = None) -> Series:
    """Measurements, mask and intervals of a pandas ``DataFrame``; empty cells (NaN, None, NA) are missing.

    Args:
        df: the frame, one row per sample.
        columns: names of the m measured columns, numbers.
        time: name of the column of time stamps: seconds as numbers, or dates or durations of pandas. None = the
            frame's index if that holds dates or durations, else the intervals stay the model's own (``dt`` None).
        first: interval before the first row [s]; None = the median of the others. Without meaning with
            ``first_update_only=True``.

    Raises:
        ImportError: without pandas.
        TypeError: no frame, or a column that holds no numbers.
        ValueError: an unknown column, no rows, time stamps that are missing or do not increase.
    """
    pd = _import("pandas")
    if not isinstance(df, pd.DataFrame):
        raise TypeError(f"df: expected a pandas DataFrame, got {type(df).__name__}")
    if isinstance(columns, str) or not isinstance(columns, Sequence):
        raise TypeError(f"columns: expected a list of names, got {columns!r}")
    if not len(columns) or not len(df):
        raise ValueError(f"columns: expected one or more columns of one or more rows, got {columns!r} of {len(df)}")
    dtype = jax.dtypes.canonicalize_dtype(float)
    values = np.stack([_numbers(pd, "columns", _column(df, "columns", name)) for name in columns], axis=1)
    if np.isinf(values).any():
        raise ValueError(f"columns: expected finite values, but row {int(np.argwhere(np.isinf(values))[0][0])} has not")
    mask = ~np.isnan(values)
    ys = jnp.asarray(np.where(mask, values, 0.0), dtype)
    stamps = _stamps(pd, df, time)
    if stamps is None:
        if first is not None:
            raise ValueError("first: given, but the frame has no time")
        return Series(ys, jnp.asarray(mask), None, None)
    if np.isnan(stamps).any():
        raise ValueError(f"time: row {int(np.argmax(np.isnan(stamps)))} has no time stamp")
    if (bad := np.flatnonzero(np.diff(stamps) <= 0)).size:
        raise ValueError(f"time: must increase, but row {bad[0] + 1} is not after row {bad[0]}")
    if first is None:
        first = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 1.0
    elif not 0 <= (first := number("first", first)) < np.inf:
        raise ValueError(f"first: expected a finite interval >= 0, got {first}")
    return Series(ys, jnp.asarray(mask), intervals(stamps, first=first), jnp.asarray(stamps - stamps[0], dtype))


def to_frame(out: Info | Smoothed, *, index: Any = None, names: Sequence[str] | None = None) -> Any:
    """A pandas ``DataFrame`` of one run: a row per sample.

    Columns: each state component by its name, its standard deviation as ``<name>_std`` (if there is a covariance), and
    of a filter's output ``nis``, ``log_lik``, ``status`` (text, empty if all is well) and ``mode_0``, ``mode_1``, ...

    Args:
        out: what :func:`jaxfilt.filter` or :func:`jaxfilt.smooth` returned, (T, n), no batch axis.
        index: (T,) the frame's index, e.g. the times; None = 0, 1, ...
        names: n names of the state's components; None = ``x0``, ``x1``, ...

    Raises:
        ImportError: without pandas.
        TypeError: no such output.
        ValueError: a batch (use :func:`to_xarray`), or names or index of another length.
    """
    pd = _import("pandas")
    mean = _mean(out)
    if mean.ndim != 2:
        raise ValueError(f"out: expected one run, mean (T, n), got {mean.shape}; to_xarray takes batches")
    names = _names(names, mean.shape[-1])
    if index is not None and np.shape(index) != mean.shape[:1]:
        raise ValueError(f"index: expected shape ({len(mean)},), got {np.shape(index)}")
    columns: dict[str, Any] = {}
    deviations = None if out.cov is None else np.sqrt(np.maximum(_diagonal(out.cov), 0))
    for i, name in enumerate(names):
        columns[name] = mean[:, i]
        if deviations is not None:
            columns[f"{name}_std"] = deviations[:, i]
    if isinstance(out, Info):
        columns |= {name: np.asarray(x) for name in ("nis", "log_lik") if (x := getattr(out, name)) is not None}
        columns["status"] = status_text(out.status)
        if (modes := out.extra.get("mode_probabilities")) is not None:
            columns |= {f"mode_{j}": np.asarray(modes)[:, j] for j in range(modes.shape[1])}
    return pd.DataFrame(columns, index=None if index is None else pd.Index(index))


def to_xarray(out: Info | Smoothed, *, times: Any = None, names: Sequence[str] | None = None) -> Any:
    """An xarray ``Dataset`` with all covariances, of one run or of a batch (leading dimension ``run``).

    Dimensions ``time``, ``state`` (and ``state_`` for a covariance's columns), ``measurement``, ``mode``. ``status``
    carries its bits as ``flag_masks`` and ``flag_meanings`` (CF conventions).

    Args:
        out: what :func:`jaxfilt.filter` or :func:`jaxfilt.smooth` returned, (T, n) or (runs, T, n).
        times: (T,) the time coordinate; None = none.
        names: n names of the state's components; None = ``x0``, ``x1``, ...

    Raises:
        ImportError: without xarray.
        TypeError: no such output.
        ValueError: names or times of another length, more than one batch axis.
    """
    xr = _import("xarray")
    mean = _mean(out)
    if mean.ndim not in (2, 3):
        raise ValueError(f"out: expected mean (T, n) or (runs, T, n), got {mean.shape}")
    lead = ("run", "time")[3 - mean.ndim :]
    names = _names(names, mean.shape[-1])
    if times is not None and np.shape(times) != mean.shape[-2:-1]:
        raise ValueError(f"times: expected shape ({mean.shape[-2]},), got {np.shape(times)}")
    dims = {
        "mean": ("state",), "cov": ("state", "state_"), "innovation": ("measurement",),
        "innovation_cov": ("measurement", "measurement_"), "noise_cov": ("measurement", "measurement_"),
        "nis": (), "log_lik": (), "status": (),
    }  # fmt: skip
    known = {name: getattr(out, name, None) for name in dims}
    data = {name: ((*lead, *dims[name]), np.asarray(x)) for name, x in known.items() if x is not None}
    if isinstance(out, Info) and (modes := out.extra.get("mode_probabilities")) is not None:
        data["mode_probabilities"] = ((*lead, "mode"), np.asarray(modes))
    coords: dict[str, Any] = {"state": names} | ({"state_": names} if "cov" in data else {})
    if times is not None:
        coords["time"] = np.asarray(times)
    found = xr.Dataset(data, coords)
    if "status" in found:
        meanings = " ".join(str(bit.name) for bit in Status)
        found["status"].attrs = {"flag_masks": [int(bit) for bit in Status], "flag_meanings": meanings}
    return found


def status_text(status: Any) -> list[str]:
    """Status words (T,) as text: the names of their bits, joined by ``|``; empty where all is well."""
    words = np.asarray(status)
    if words.ndim != 1 or words.dtype != np.int32:
        raise TypeError(f"status: expected int32 words (T,), got {words.dtype} {words.shape}")
    text = {int(w): "|".join(str(bit.name) for bit in Status if w & bit) for w in np.unique(words)}
    return [text[int(w)] for w in words]


def _import(name: str) -> Any:
    try:
        return __import__(name)
    except ImportError as error:
        raise ImportError(f'data frames need {name}: pip install "jaxfilt[data]"') from error


def _column(df, arg, name):
    if name not in df.columns:
        raise ValueError(f"{arg}: there is no column {name!r}; the frame has {', '.join(map(repr, df.columns))}")
    return df[name]


def _numbers(pd, arg, column) -> np.ndarray:
    if not pd.api.types.is_numeric_dtype(column) or pd.api.types.is_complex_dtype(column):
        raise TypeError(f"{arg}: {column.name!r} holds no numbers but {column.dtype}; see pandas.to_numeric")
    return column.to_numpy(dtype=np.float64, na_value=np.nan)


def _stamps(pd, df, time) -> np.ndarray | None:
    """(T,) float64 seconds, NaN where missing."""
    if time is None:
        index = df.index
        if not isinstance(index, pd.DatetimeIndex | pd.TimedeltaIndex):
            return None
        stamps = index.to_series()
    else:
        stamps = _column(df, "time", time)
    if pd.api.types.is_datetime64_any_dtype(stamps):
        stamps = stamps - stamps.min()
    if pd.api.types.is_timedelta64_dtype(stamps):
        return stamps.dt.total_seconds().to_numpy(np.float64)
    return _numbers(pd, "time", stamps)


def _mean(out) -> np.ndarray:
    if not isinstance(out, Info | Smoothed):
        raise TypeError(f"out: expected what jf.filter or jf.smooth returns, got {type(out).__name__}")
    return np.asarray(out.mean)


def _names(names, n) -> list[str]:
    if names is None:
        return [f"x{i}" for i in range(n)]
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise TypeError(f"names: expected a list of names, got {names!r}")
    if len(names) != n or len(set(names)) != n:
        raise ValueError(f"names: expected {n} different names, got {list(names)}")
    return list(names)


def _diagonal(cov) -> np.ndarray:
    return np.diagonal(np.asarray(cov), axis1=-2, axis2=-1)
