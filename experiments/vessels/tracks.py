"""AIS reports as the filters see them: tracks, pieces for tuning, windows around gaps, estimates and their scores.

A report's position is measured; its speed and course over ground are held out and only score the velocity.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

import jaxfilt as jf
from experiments import planar

DATA = Path(__file__).resolve().parents[1] / "data" / "ais_solent" / "ais_solent.csv"
FAST = (1, 2, 3, 4, 8)  # fast craft, as the data's README has them; the others are slow craft and ships
# Every third in a numbering that goes by the number of reports, so without regard to how well a vessel is tracked.
TRAINING = (1, 4, 7, 10, 13, 16)
TESTS = tuple(vessel for vessel in range(1, 18) if vessel not in TRAINING)

REPEAT = 5.0  # s: a position that is met again within this time is taken for a delayed copy
STEP = 10.0  # s: an interval above 1.5 of it is stepped through in equal parts of this size or less
MOVING = 1.0  # m/s of SOG
NO_COURSE = 0.5  # m/s of SOG, below which the velocity counts as 0: the course means nothing

LENGTHS = (30, 60, 120)  # s of gaps made by hand
REAL = (60.0, 120.0)  # s: intervals without a report from here on are the real gaps, in two classes
SLOT = 180.0  # s: one place for gaps in each slot
BEFORE = 60  # rows before a gap
SIZE = 200  # rows of a training piece
WARMUP = 10  # rows of a piece that are not scored
BLOCK = 300.0  # s: errors are resampled in blocks of this length
NAIVE = ("last report", "line through 2 reports")

START = planar.Start(np.zeros(4), np.diag([400.0] * 2 + [100.0] * 2), acceleration=0.25, turn_rate=1e-3)
SCALE = planar.Scale(r=100.0, q=0.1, q_jerk=0.01, q_omega=1e-4)


class Track(NamedTuple):
    """One vessel: its reports, and rows without a report where it was silent for long."""

    vessel: int
    t: np.ndarray  # (T,) s
    position: np.ndarray  # (T, 2) east, north [m]; 0 without a report
    real: np.ndarray  # (T,) bool, there is a report
    velocity: np.ndarray  # (T, 2) of SOG and COG [m/s], held out
    moving: np.ndarray  # (T,) bool by SOG
    repeats: tuple[int, int, int]  # reports dropped as copies, those of them and those left that moved


class Rows(NamedTuple):
    """Parts of tracks, padded to a common T at the end."""

    ys: np.ndarray  # (B, T, 2) m about the first report
    mask: np.ndarray  # (B, T) bool, what is seen
    dt: np.ndarray  # (B, T) s
    hidden: np.ndarray  # (B, T) bool, reports in the gap, to be scored
    moving: np.ndarray  # (B, T) bool
    velocity: np.ndarray  # (B, T, 2) m/s, held out
    block: np.ndarray  # (B, T) which block of :data:`BLOCK` seconds a row is in; only of pieces without a gap
    last: np.ndarray  # (B,) the last hidden report
    length: np.ndarray  # (B,) s, of the gap made by hand; 0 = a real one, -1 = none
    horizon: np.ndarray  # (B,) s from the last report that is seen to the last hidden one
    vessel: np.ndarray  # (B,)

    @property
    def fast(self) -> np.ndarray:
        """(B,) bool."""
        return np.isin(self.vessel, FAST)


class Estimate(NamedTuple):
    """What a filter says at each row."""

    position: Any  # (..., T, 2)
    cov: Any  # (..., T, 2, 2)
    velocity: Any  # (..., T, 2)
    innovation: Any  # (..., T, 2)
    nis: Any  # (..., T)
    log_lik: Any  # (..., T)
    probabilities: Any  # (..., T, r) of an IMM's modes, else None


def load(vessels: Iterable[int]) -> list[Track]:
    """Tracks without the delayed copies of a position."""
    table = np.genfromtxt(DATA, delimiter=",", names=True)
    return [_track(vessel, table[table["vessel"] == vessel]) for vessel in vessels]


def _track(vessel: int, table: np.ndarray) -> Track:
    t, position, sog = table["t_s"], np.stack([table["east_m"], table["north_m"]], axis=1), table["sog_mps"]
    copies = copied(t, position)
    same = np.append(False, (np.diff(position, axis=0) == 0).all(axis=1))
    moving = sog >= MOVING
    repeats = int(copies.sum()), int((copies & moving).sum()), int((same & ~copies & moving).sum())
    course = np.where(sog >= NO_COURSE, np.nan_to_num(table["cog_rad"]), 0.0)
    speed = np.where((sog >= NO_COURSE) & np.isfinite(table["cog_rad"]), sog, 0.0)
    velocity = speed[:, None] * np.stack([np.sin(course), np.cos(course)], axis=1)
    t, position, velocity, moving = (x[~copies] for x in (t, position, velocity, moving))

    steps = np.diff(t)
    parts = np.where(steps > 1.5 * STEP, np.ceil(steps / STEP), 1).astype(int)
    row = np.append(0, np.cumsum(parts))  # where the reports stand among all rows
    real = np.zeros(row[-1] + 1, bool)
    real[row] = True

    def spread(x):
        out = np.zeros((len(real), *x.shape[1:]), x.dtype)
        out[row] = x
        return out

    times = np.interp(np.arange(len(real)), row, t)
    return Track(vessel, times, spread(position), real, spread(velocity), spread(moving), repeats)


def copied(t: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(T,) bool: reports of the position of the report before, within :data:`REPEAT` seconds of its first report.

    A vessel under way cannot be there still; of one at rest the later repeats remain. Only positions and times decide.
    """
    same = np.append(False, (np.diff(position, axis=0) == 0).all(axis=1))
    first = t[np.maximum.accumulate(np.where(same, 0, np.arange(len(t))))]
    return same & (t - first <= REPEAT)


def _rows(track: Track, part: slice, hidden: tuple[int, int], T: int, length: float, block: np.ndarray | None = None):
    """One of :class:`Rows`: a part of a track, of which the reports in rows ``hidden`` of it are not seen."""
    k = np.arange(part.stop - part.start)
    real = track.real[part]
    inside = (k >= hidden[0]) & (k < hidden[1])
    position = np.where(real[:, None], track.position[part] - track.position[part.start], 0.0)
    dt = np.diff(track.t[part], prepend=track.t[part.start] - STEP)
    dt = np.append(dt, np.ones(T - len(dt)))
    scored = np.flatnonzero(real & inside)
    last = scored[-1] if len(scored) else 0
    horizon = track.t[part][last] - track.t[part][hidden[0] - 1] if len(scored) else 0.0
    block = np.zeros(len(k), int) if block is None else block
    columns = position, real & ~inside, real & inside, track.moving[part], track.velocity[part], block
    ys, mask, lost, moving, velocity, block = (planar.pad(c, T) for c in columns)
    return ys, mask, dt, lost, moving, velocity, block, last, length, horizon, track.vessel


def _stack(rows: Sequence[tuple]) -> Rows:
    return Rows(*(np.array(column) for column in zip(*rows, strict=True)))


def _cut(track: Track, size: int) -> Iterator[slice]:
    """Parts of ``size`` rows or less; each begins with a report and is long enough for warm-up and a gap."""
    for begin in range(0, len(track.t), size):
        stop = min(begin + size, len(track.t))
        begin += int(np.argmax(track.real[begin:]))
        if stop - begin >= 4 * WARMUP:
            yield slice(begin, stop)


def training_pieces(tracks: Iterable[Track], rng: np.random.Generator) -> planar.Data:
    """Pieces of :data:`SIZE` rows or less, each with one gap, of every length in turn, at a random place."""
    rows = []
    for track in tracks:
        for part in _cut(track, SIZE):
            length = LENGTHS[len(rows) % len(LENGTHS)]
            t = track.t[part]
            first = int(rng.integers(2 * WARMUP, len(t) - WARMUP))
            gap = first, int(np.searchsorted(t, t[first] + length))
            rows.append(_rows(track, part, gap, SIZE, length))
    made = _stack(rows)
    return planar.Data(made.ys, np.stack([made.mask] * 2, axis=2), made.dt)


def windows(tracks: Iterable[Track], rng: np.random.Generator, slot: float, T: int) -> Rows:
    """Windows with one gap each: a place in every slot of a track and there a gap of every length; then the real gaps.

    A gap begins after a report, and its last report is hidden at two thirds of its length or later. Of a real gap the
    first report after it is hidden.
    """
    made, real = [], []
    for track in tracks:
        reports = np.flatnonzero(track.real)
        for start in np.arange(track.t[0], track.t[-1], slot):
            place = start + rng.uniform(0.0, slot)
            if place > track.t[-1]:
                continue
            k = reports[np.searchsorted(track.t[reports], place, side="right") - 1]
            for length in LENGTHS:
                stop = int(np.searchsorted(track.t, track.t[k] + length, side="right"))
                inside = np.flatnonzero(track.real[k + 1 : stop])
                if k < 2 * WARMUP or not len(inside):
                    continue
                if track.t[k + 1 + inside[-1]] - track.t[k] < 2 / 3 * length:
                    continue
                made.append(_window(track, reports, k, stop, T, length))
        for k, after in itertools.pairwise(reports):
            if k >= 2 * WARMUP and track.t[after] - track.t[k] >= REAL[0]:
                real.append(_window(track, reports, k, after + 1, T, 0.0))
    return _stack(made + real)


def _window(track, reports, k, stop, T, length):
    first = reports[np.searchsorted(reports, max(0, k + 1 - BEFORE))]
    return _rows(track, slice(first, stop), (k + 1 - first, stop - first), T, length)


def pieces(tracks: Iterable[Track], T: int) -> Rows:
    """The tracks without hidden reports, in pieces of ``T`` rows or less."""
    rows = []
    blocks = 0
    for track in tracks:
        for part in _cut(track, T):
            block = blocks + ((track.t[part] - track.t[part.start]) // BLOCK).astype(int)
            blocks = int(block[-1]) + 1
            rows.append(_rows(track, part, (0, 0), T, -1.0, block))
    return _stack(rows)


def _reported(state, info: jf.Info) -> Estimate:
    del state
    assert info.cov is not None
    return Estimate(info.mean[:2], info.cov[:2, :2], info.mean[2:4], info.innovation, info.nis, info.log_lik,
                    info.extra.get("mode_probabilities"))  # fmt: skip


@jax.jit
def estimate(filt: jf.Filter, ys: Array, mask: Array, dt: Array) -> Estimate:
    """All rows at once."""

    def one(y, mask, dt):
        return jf.filter(filt, y, mask=mask, dt=dt, outputs=_reported, first_update_only=True)

    return jax.vmap(one)(ys, mask, dt)


def naive(name: str, ys: np.ndarray, mask: np.ndarray, dt: np.ndarray) -> Estimate:
    """The last report, standing still; or the straight line through the last two, with their difference as velocity."""
    runs, T, _ = ys.shape
    t = np.cumsum(dt, axis=1)
    rows = np.arange(runs)[:, None]
    newest = np.maximum.accumulate(np.where(mask, np.arange(T), 0), axis=1)
    before = np.concatenate([np.zeros((runs, 1), int), newest[:, :-1]], axis=1)  # known before the row

    def slope(last):
        earlier = np.take_along_axis(before, last, axis=1)
        span = np.where(last > earlier, t[rows, last] - t[rows, earlier], 1.0)
        moves = name == NAIVE[1]
        return moves * (ys[rows, last] - ys[rows, earlier]) / span[..., None]

    prediction = ys[rows, before] + slope(before) * (t - t[rows, before])[..., None]
    seen = mask[..., None]
    return Estimate(np.where(seen, ys, prediction), None, slope(newest), np.where(seen, ys - prediction, 0.0), None,
                    None, None)  # fmt: skip


def estimates(params: Mapping[str, Mapping[str, Any]], *parts: Rows) -> list[dict[str, Estimate]]:
    """Per part, what each filter and each baseline says. The parts have one length: each filter is compiled once."""
    ys, mask, dt = (np.concatenate([getattr(part, name) for part in parts]) for name in ("ys", "mask", "dt"))

    def job(name):
        return jax.tree.map(np.asarray, estimate(planar.make(name, params[name], START), ys, mask, dt))

    found = dict(zip(params, planar.in_parallel(job, list(params)), strict=True))
    found |= {name: naive(name, ys, mask, dt) for name in NAIVE}
    edges = np.cumsum([0, *(len(part.ys) for part in parts)])
    return [
        {name: jax.tree.map(lambda x, a=a, b=b: x[a:b], out) for name, out in found.items()}
        for a, b in itertools.pairwise(edges)
    ]
