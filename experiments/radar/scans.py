"""Recorded radar and lidar scans of two boats, seen from a moving ship; and the tracks that can be started from them.

Nothing here but :func:`truth` reads the boats' true positions.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import NamedTuple

import numpy as np

DATA = Path(__file__).resolve().parents[1] / "data" / "autoferry"
SCENARIOS = ("04", "05", "16", "22")
SENSORS = ("radar", "lidar")
LIMIT = 10.0  # m/s: two detections further apart are not of one boat; the boats' speed over ground is below 8
STEPS = 82  # scans after the two of the start: all that the longest scenario has by radar, 32 s by radar and lidar
ROOM = 12  # detections in the fullest scan


class Scans(NamedTuple):
    """The scans of a scenario, by one sensor or several."""

    t: np.ndarray  # (T,) s
    sensor: np.ndarray  # (T,) index into SENSORS
    own: np.ndarray  # (T, 2) the ship's position, east and north [m]
    detections: np.ndarray  # (T, ROOM, 2) range [m] and bearing [rad, counter-clockwise from east], from the ship
    valid: np.ndarray  # (T, ROOM) bool, which there are

    @property
    def position(self) -> np.ndarray:
        """(T, ROOM, 2) the detections' east and north [m]."""
        reach, angle = self.detections[..., 0], self.detections[..., 1]
        return self.own[:, None] + reach[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


class Tracks(NamedTuple):
    """B tracks, each started from a detection of a radar scan and one of the next, and the scans that follow."""

    first: np.ndarray  # (B, 2) position of the earlier detection [m]
    second: np.ndarray  # (B, 2) position of the later one; the track begins here
    own: np.ndarray  # (B, 2) where the ship was then
    span: np.ndarray  # (B,) s between the two
    t: np.ndarray  # (B, STEPS) s
    dt: np.ndarray  # (B, STEPS) s from the scan before
    sensor: np.ndarray  # (B, STEPS) index into SENSORS
    mask: np.ndarray  # (B, STEPS) bool, False beyond the scenario's end
    observer: np.ndarray  # (B, STEPS, 2) the ship's position [m]
    detections: np.ndarray  # (B, STEPS, ROOM, 2)
    valid: np.ndarray  # (B, STEPS, ROOM) bool
    scenario: np.ndarray  # (B,) index into SCENARIOS
    scan: np.ndarray  # (B,) the radar scan that the track begins with
    t_first: np.ndarray  # (B,) s
    t_second: np.ndarray  # (B,) s


def load(scenario: str, sensors: tuple[str, ...] = SENSORS) -> Scans:
    """The scans of a scenario of ``experiments/data/autoferry``."""
    scans = _table(scenario, "scans")
    scans = scans[np.isin(scans["sensor"], sensors)]
    found = _table(scenario, "detections")
    detections = np.zeros((len(scans), ROOM, 2))
    valid = np.zeros((len(scans), ROOM), bool)
    for k, scan in enumerate(scans["scan"]):
        own = found[found["scan"] == scan]
        polar = np.hypot(own["north_m"], own["east_m"]), np.arctan2(own["north_m"], own["east_m"])
        detections[k, : len(own)] = np.stack(polar, axis=1)
        valid[k, : len(own)] = True
    own = np.stack([scans["own_east_m"], scans["own_north_m"]], axis=1)
    return Scans(scans["t_s"], (scans["sensor"] == SENSORS[1]).astype(int), own, detections, valid)


def truth(scenario: str, t: np.ndarray) -> np.ndarray:
    """(..., 2, 2) true east and north [m] of both boats at times t (...); NaN outside of what was recorded."""
    table = _table(scenario, "truth")
    boats = [table[table["target"] == target] for target in (1, 2)]
    return np.stack([
        np.stack([np.interp(t, boat["t_s"], boat[name], np.nan, np.nan) for name in ("east_m", "north_m")], axis=-1)
        for boat in boats
    ], axis=-2)  # fmt: skip


def _table(scenario, kind):
    path = DATA / f"scenario{scenario}_{kind}.csv"
    return np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")


def start(scenario: str, scans: Scans) -> Tracks:
    """A track from every pair of detections in two consecutive radar scans that are no further apart than LIMIT allows.

    Args:
        scenario: a name of SCENARIOS.
        scans: its scans. Lidar scans update tracks, but start none.
    """
    radar = np.flatnonzero(scans.sensor == 0)
    position = scans.position
    rows = []
    for number, (a, b) in enumerate(itertools.pairwise(radar)):
        span = scans.t[b] - scans.t[a]
        apart = np.linalg.norm(position[b][None] - position[a][:, None], axis=-1)
        near = (apart < LIMIT * span) & scans.valid[a][:, None] & scans.valid[b][None]
        after = _after(scans, b)
        for i, j in np.argwhere(near):
            begun = SCENARIOS.index(scenario), number, scans.t[a], scans.t[b]
            rows.append((position[a, i], position[b, j], scans.own[b], span, *after, *begun))
    return Tracks(*(np.array(column) for column in zip(*rows, strict=True)))


def _after(scans, b):
    """The STEPS scans after scan b."""
    index = np.arange(b + 1, b + 1 + STEPS)
    inside = index < len(scans.t)
    index = np.minimum(index, len(scans.t) - 1)
    t = scans.t[index]
    dt = np.where(inside, np.diff(t, prepend=scans.t[b]), 1.0)
    valid = scans.valid[index] & inside[:, None]
    return t, dt, scans.sensor[index], inside, scans.own[index], scans.detections[index], valid


def join(tracks: list[Tracks]) -> Tracks:
    """Tracks of several scenarios in one batch."""
    return Tracks(*(np.concatenate(column) for column in zip(*tracks, strict=True)))


def select(tracks: Tracks, which: np.ndarray) -> Tracks:
    """Some of the tracks, by bool or index."""
    return Tracks(*(column[which] for column in tracks))
