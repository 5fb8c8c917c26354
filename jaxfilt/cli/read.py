"""A recording from a CSV file: columns found or named, units converted, missing cells masked, all assumptions noted."""

from __future__ import annotations

import csv
import difflib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfilt.cli.units import ANGLE, LENGTH, TIME, BadInput, split, unit

LEAST = 10  # fixes below which there is nothing to learn

_NAMES = {
    "time": ("t", "time", "timestamp", "time_stamp", "datetime", "date_time", "utc", "elapsed", "epoch", "seconds"),
    "x": ("x", "east", "easting", "e", "px", "pos_x", "x_pos", "position_x"),
    "y": ("y", "north", "northing", "n", "py", "pos_y", "y_pos", "position_y"),
    "z": ("z", "alt", "altitude", "height", "up", "elevation", "pz", "pos_z", "z_pos", "position_z"),
    "lat": ("lat", "latitude"),
    "lon": ("lon", "lng", "long", "longitude"),
    "range": ("range", "rho", "distance", "r"),
    "bearing": ("bearing", "azimuth", "az", "theta"),
    "one": ("position", "pos", "p"),
}


class Options(NamedTuple):
    """The command line's say in how a file is read; None = find out."""

    time: str | None = None  # NAME or NAME:UNIT
    interval: float | None = None  # s, for files without time
    position: str | None = None  # NAME,NAME,... each with :UNIT
    lat_lon: str | None = None
    range_bearing: str | None = None
    compass: bool = False
    where: Sequence[str] = ()
    duplicates: str = "error"


class Column(NamedTuple):
    """A measured column."""

    name: str
    unit: str
    factor: float  # to SI


class Place(NamedTuple):
    """Local meters east and north about a point of the ellipsoid WGS 84, by the curvatures there.

    The scale is off by about the tangent of the latitude times the distance north over the earth's radius: at 45
    degrees 0.16 % 10 km north.
    """

    lat: float  # deg
    lon: float
    per_lat: float  # m per deg
    per_lon: float

    def to_plane(self, lat: np.ndarray, lon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """East and north [m]; longitudes wrap."""
        return ((lon - self.lon + 180) % 360 - 180) * self.per_lon, (lat - self.lat) * self.per_lat

    def to_globe(self, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Latitude and longitude [deg]."""
        return self.lat + north / self.per_lat, (self.lon + east / self.per_lon + 180) % 360 - 180


class Recording(NamedTuple):
    """A file in SI units, in the order of its rows."""

    path: str
    cells: Any  # pandas DataFrame of text as it stood in the file, the rows that were kept
    time: str | None  # column of time stamps
    start: str  # the first stamp as it stood there
    times: np.ndarray  # (T,) s since the first row
    dt: np.ndarray  # (T,) s; the first is the median
    kind: str  # "position" or "polar"
    columns: tuple[Column, ...]
    axes: tuple[str, ...]  # names of the d positions of the state
    axis_units: tuple[Column, ...]  # in what they are written out
    ys: np.ndarray  # (T, m): positions [m], or range [m] and bearing [rad, counter-clockwise from x]
    mask: np.ndarray  # (T, m) bool
    fixes: np.ndarray  # (T, d) [m] the measurements as positions, NaN where missing
    place: Place | None
    notes: tuple[str, ...]

    @property
    def regular(self) -> bool:
        """Whether all intervals are the same."""
        return bool(np.allclose(self.dt, self.dt[0], rtol=1e-9))

    @property
    def present(self) -> np.ndarray:
        """(T,) bool, whether the row has any measurement."""
        return np.asarray(self.mask.any(axis=1))


def read(path: str, options: Options, *, planar: bool = False) -> Recording:
    """Reads a recording.

    Args:
        path: of a CSV file with one header line.
        options: columns and units.
        planar: leaves out a height that was found without being named.

    Raises:
        BadInput: says what is wrong, with line and column.
    """
    if options.duplicates not in ("error", "first", "both"):
        raise BadInput(f"--duplicates: expected error, first or both, got {options.duplicates}")
    if sum(x is not None for x in (options.position, options.lat_lon, options.range_bearing)) > 1:
        raise BadInput("give one of --position, --lat-lon and --range-bearing")
    cells, notes = _cells(path)
    cells = _chosen(cells, options.where)
    kind, names = _measured(cells, options, planar)
    units = {"position": ("length",) * 3, "globe": ("angle", "angle", "length"), "polar": ("length", "angle")}[kind]
    columns = tuple(_column(cells, name, what, kind, options) for name, what in zip(names, units, strict=False))
    raw, mask = _numbers(cells, columns, notes)
    times, name, start = _times(cells, options, notes)
    dt = np.diff(times, prepend=times[0])
    order = np.flatnonzero(dt < 0)
    if order.size:
        k = int(order[0])
        raise BadInput(
            f"{path}: time goes back at {_line(cells, k)} ({_shown(cells, name, k)} after "
            f"{_shown(cells, name, k - 1)}); sort the rows by time, or choose one target with --where COLUMN=VALUE"
        )
    same = np.flatnonzero(dt[1:] == 0) + 1
    if same.size and options.duplicates == "error":
        raise BadInput(
            f"{path}: {_line(cells, same[0])} has the time stamp of the row before it ({same.size} such rows); choose "
            "one target with --where COLUMN=VALUE, or --duplicates first (the others count as missing) or both"
        )
    if same.size and options.duplicates == "first":
        mask[same] = False
        notes.append(f"{same.size} rows with a repeated time stamp count as missing")
    place = None
    if kind == "globe":
        raw, place = _project(raw, mask, notes)
        kind, axes, shown = "position", ("east", "north", "up")[: len(columns)], (Column("", "m", 1.0),) * len(columns)
    elif kind == "polar":
        axes, shown = ("x", "y"), (Column("", columns[0].unit, columns[0].factor),) * 2
        if options.compass:
            raw[:, 1] = (np.pi / 2 - raw[:, 1] + np.pi) % (2 * np.pi) - np.pi
            axes = ("east", "north")
        mask &= mask.all(axis=1, keepdims=True)  # a range or a bearing alone starts no track
    else:
        axes, shown = tuple(_stem(column.name) for column in columns), columns
        axes = axes if len(set(axes)) == len(axes) else tuple(column.name for column in columns)
    fixes = np.where(mask, raw, np.nan)
    if kind == "polar":
        fixes = fixes[:, :1] * np.stack([np.cos(fixes[:, 1]), np.sin(fixes[:, 1])], axis=1)
    if (count := int(mask.all(axis=1).sum())) < LEAST:
        raise BadInput(f"{path}: only {count} rows with a whole measurement; {LEAST} or more are needed")
    forward = dt[1:][dt[1:] > 0]
    if not forward.size:
        raise BadInput(f"{path}: all rows have the same time stamp")
    dt[0] = np.median(forward)
    ys = np.where(mask, raw, 0.0)
    return Recording(
        path, cells, name, start, times, dt, kind, columns, axes, shown, ys, mask, fixes, place, tuple(notes)
    )


def _cells(path: str) -> tuple[Any, list[str]]:
    """The file as a frame of text whose index holds line numbers."""
    try:
        import pandas as pd
    except ImportError as error:
        raise ImportError('the command line needs pandas: pip install "jaxfilt[cli]"') from error
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise BadInput(f"{path}: {error.strerror or error}") from None
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise BadInput(f"{path}: is no text file (UTF-8); export it as CSV")
    if not text.strip():
        raise BadInput(f"{path}: is empty")
    lines = text.splitlines()
    header = next(k for k, line in enumerate(lines) if line.strip() and not line.startswith("#"))
    counts = {mark: lines[header].count(mark) for mark in ",;\t|"}
    mark = max(counts, key=lambda m: counts[m])
    notes = [] if mark == "," else [f"columns are separated by {'tab' if mark == chr(9) else mark!r}"]
    if not counts[mark]:
        mark, notes = ",", []
    try:
        rows = list(csv.reader(lines[header:], delimiter=mark, skipinitialspace=True))
    except csv.Error as error:
        raise BadInput(f"{path}: {error}") from None
    names = [name.strip() for name in rows[0]]
    if all(_is_number(name) for name in names):
        raise BadInput(f"{path}: has no header; put a line with the columns' names first")
    if len(set(names)) < len(names):
        double = next(name for name in names if names.count(name) > 1)
        raise BadInput(f"{path}: the header has {double!r} twice")
    kept, index = [], []
    for k, row in enumerate(rows[1:], header + 2):
        if not any(cell.strip() for cell in row):
            continue
        if len(row) > len(names):
            raise BadInput(f"{path}: line {k} has {len(row)} cells, the header {len(names)}")
        kept.append([cell.strip() for cell in row] + [""] * (len(names) - len(row)))
        index.append(k)
    if not kept:
        raise BadInput(f"{path}: has a header but no rows")
    return pd.DataFrame(kept, index=pd.Index(index, name="line"), columns=pd.Index(names), dtype=str), notes


def _chosen(cells: Any, where: Sequence[str]) -> Any:
    for condition in where:
        name, equals, wanted = condition.partition("=")
        if not equals:
            raise BadInput(f"--where: expected COLUMN=VALUE, got {condition!r}")
        column = cells[_existing(cells, name.strip(), "--where")]
        cells, before = cells[[_equal(cell, wanted.strip()) for cell in column]], cells
        if not len(cells):
            seen = sorted(set(before[name.strip()]))
            listed = ", ".join(seen[:8]) + (", ..." if len(seen) > 8 else "")
            raise BadInput(f"--where {condition}: no row is left; {name.strip()} has {listed}")
    return cells


def _equal(cell: str, wanted: str) -> bool:
    return cell == wanted or (_is_number(cell) and _is_number(wanted) and float(cell) == float(wanted))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _existing(cells: Any, name: str, what: str) -> str:
    if name in cells.columns:
        return name
    close = difflib.get_close_matches(name, list(cells.columns), 1, 0.5)
    hint = f"did you mean {close[0]!r}? " if close else ""
    raise BadInput(f"{what}: there is no column {name!r}; {hint}the file has {', '.join(cells.columns)}")


def _measured(cells: Any, options: Options, planar: bool) -> tuple[str, list[str]]:
    """The kind and the columns, as NAME or NAME:UNIT."""
    given = {
        "position": ("--position", options.position, (1, 2, 3)),
        "globe": ("--lat-lon", options.lat_lon, (2, 3)),
        "polar": ("--range-bearing", options.range_bearing, (2,)),
    }
    for kind, (option, text, sizes) in given.items():
        if text is not None:
            names = next(csv.reader([text])) if text.strip() else []
            if len(names) not in sizes:
                counts = " or ".join(map(str, sizes))
                raise BadInput(f"{option}: expected {counts} columns with commas between, got {text!r}")
            return kind, [name.strip() for name in names]
    found = {role: _find(cells, role) for role in _NAMES}
    height = [found["z"]] if found["z"] and not planar else []
    for kind, roles in {"position": ("x", "y"), "globe": ("lat", "lon"), "polar": ("range", "bearing")}.items():
        if all(found[role] for role in roles):
            return kind, [found[role] for role in roles] + (height if kind != "polar" else [])
    for role in ("x", "one", "z"):
        if found[role]:
            return "position", [found[role]]
    raise BadInput(
        f"no columns of positions were recognized among {', '.join(cells.columns)}; "
        "give --position X,Y or --lat-lon LAT,LON or --range-bearing R,B"
    )


def _find(cells: Any, role: str) -> str:
    """The first column of a role, "" if none."""
    stems = {name: split(name)[0] for name in cells.columns}
    for wanted in _NAMES[role]:
        for name, stem in stems.items():
            if stem == wanted:
                return name
    return ""


def _stem(name: str) -> str:
    return split(name)[0].replace(" ", "_")


def _column(cells: Any, text: str, what: str, kind: str, options: Options) -> Column:
    option = {"position": "--position", "globe": "--lat-lon", "polar": "--range-bearing"}[kind]
    name, given = _with_unit(cells, text, option)
    if given is not None:
        given = unit(given, what, f"{option} {name}")
    else:
        own = split(name)[1]
        known = ANGLE if what == "angle" else LENGTH
        if kind == "polar" and what == "angle" and own not in known:
            raise BadInput(f"{option}: is {name!r} in deg or in rad? say --range-bearing RANGE:m,{name}:deg")
        given = own if own in known else "deg" if what == "angle" else "m"
    return Column(name, given, (ANGLE if what == "angle" else LENGTH)[given])


def _with_unit(cells: Any, text: str, option: str) -> tuple[str, str | None]:
    if text in cells.columns:
        return text, None
    name, colon, given = text.rpartition(":")
    return (_existing(cells, name, option), given) if colon else (_existing(cells, text, option), None)


def _numbers(cells: Any, columns: Sequence[Column], notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Values in SI, and where they are present."""
    values = []
    for column in columns:
        values.append(_values(cells, column.name, notes) * column.factor)
    raw = np.stack(values, axis=1)
    mask = ~np.isnan(raw)
    if not mask.any():
        raise BadInput(f"all cells of {', '.join(column.name for column in columns)} are empty")
    return raw, mask


_MISSING = {"", "nan", "na", "n/a", "null", "none", "-", "--"}


def _values(cells: Any, name: str, notes: list[str]) -> np.ndarray:
    """A column as numbers, NaN where a cell is empty."""
    text = list(cells[name])
    if any(re.fullmatch(r"[-+]?\d+,\d+", cell) for cell in text):
        text = [cell.replace(",", ".") for cell in text]
        if (note := "numbers have a decimal comma") not in notes:
            notes.append(note)
    values = np.empty(len(text))
    for k, cell in enumerate(text):
        if cell.lower() in _MISSING:
            values[k] = np.nan
            continue
        try:
            values[k] = float(cell)
        except ValueError:
            raise BadInput(f"{_line(cells, k)}, column {name!r}: {cell!r} is no number") from None
        if not np.isfinite(values[k]):
            raise BadInput(f"{_line(cells, k)}, column {name!r}: {cell!r} is not finite")
    return values


def _times(cells: Any, options: Options, notes: list[str]) -> tuple[np.ndarray, str | None, str]:
    """Seconds since the first row, the column, and its first stamp."""
    if options.interval is not None:
        if options.time is not None:
            raise BadInput("give --time or --interval, not both")
        return options.interval * np.arange(len(cells)), None, "0"
    given = None
    if options.time is not None:
        name, given = _with_unit(cells, options.time, "--time")
    elif not (name := _find(cells, "time")):
        raise BadInput(
            f"no column of times was recognized among {', '.join(cells.columns)}; give --time NAME:UNIT, or --interval "
            "for rows that are equally spaced"
        )
    text = list(cells[name])
    for k, cell in enumerate(text):
        if cell.lower() in _MISSING:
            raise BadInput(f"{_line(cells, k)}, column {name!r}: no time stamp; every row needs one")
    if given == "iso" or not _is_number(text[0].replace(",", ".")):
        return _iso(cells, name, text), name, text[0]
    values = _values(cells, name, notes)
    if given is not None:
        given = unit(given, "time", f"--time {name}")
    elif (given := split(name)[1]) not in TIME:
        # Time since 1970 tells its unit by its size.
        given = next((u for u, least in (("ns", 1e17), ("us", 1e14), ("ms", 1e11)) if abs(values[0]) >= least), "s")
        notes.append(f"{name} is taken to be in {given}")
    return (values - values[0]) * TIME[given], name, text[0]


def _iso(cells: Any, name: str, text: list[str]) -> np.ndarray:
    import pandas as pd

    stamps = pd.to_datetime(pd.Series(text), format="ISO8601", errors="coerce", utc=True)
    if stamps.isna().any():
        k = int(np.argmax(stamps.isna()))
        raise BadInput(f"{_line(cells, k)}, column {name!r}: {text[k]!r} is neither a number nor an ISO time stamp")
    return (stamps - stamps.iloc[0]).dt.total_seconds().to_numpy(np.float64).copy()


def _project(raw: np.ndarray, mask: np.ndarray, notes: list[str]) -> tuple[np.ndarray, Place]:
    """Latitude and longitude [rad] to meters east and north; a row that lacks one of them lacks both."""
    degrees = np.degrees(raw[:, :2])
    mask[:, :2] &= mask[:, :2].all(axis=1, keepdims=True)
    if not mask[:, :2].any():
        raise BadInput("no row has both latitude and longitude")
    lat, lon = degrees[mask[:, 0]].T
    if (np.abs(lat) > 90).any() or (np.abs(lon) > 360).any():
        raise BadInput("latitudes beyond 90 or longitudes beyond 360 degrees: is --lat-lon the wrong way round?")
    lat0 = float((lat.min() + lat.max()) / 2)
    a, e2 = 6378137.0, 6.69437999014e-3
    w = 1 - e2 * np.sin(np.radians(lat0)) ** 2
    per_lat = np.radians(a * (1 - e2) / w**1.5)
    per_lon = np.radians(a / np.sqrt(w) * np.cos(np.radians(lat0)))
    if per_lon < 1e-3 * per_lat:
        raise BadInput("positions at a pole cannot be put into a plane of east and north here")
    place = Place(lat0, float(lon[0]), float(per_lat), float(per_lon))
    notes.append(f"positions are meters east and north of {lat0:.5f}, {lon[0]:.5f}")
    if (half := (lat.max() - lat.min()) / 2 * per_lat) > 50e3:
        notes.append(f"they reach {half / 1000:.0f} km north and south of it: one plane distorts them")
    east, north = place.to_plane(degrees[:, 0], degrees[:, 1])
    return np.column_stack([east, north, raw[:, 2:]]), place


def _line(cells: Any, k: int) -> str:
    return f"line {cells.index[int(k)]}"


def _shown(cells: Any, name: str | None, k: int) -> str:
    return "" if name is None else cells[name].iloc[int(k)]
