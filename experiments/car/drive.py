"""The recorded minute on one grid of time stamps, and the cuts in it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

DATA = Path(__file__).resolve().parents[1] / "data" / "car_comma2k19" / "highway_60s.npz"
SPLIT = 30.0  # s: tuned before, cut after
LENGTHS = (5, 10, 20)  # s
COMPONENTS = ("east", "north", "wheel speed", "yaw rate")


class Drive(NamedTuple):
    """All at the epochs of the GNSS receiver; the other sensors averaged over the interval that ends there."""

    t: np.ndarray  # (T,) s
    dt: np.ndarray  # (T,) s from the epoch before
    ys: np.ndarray  # (T, 4) east and north [m], wheel speed [m/s], yaw rate, left positive [rad/s]
    speed: np.ndarray  # (T,) by the receiver [m/s]
    course: np.ndarray  # (T,) by the receiver, counter-clockwise from east [rad]
    truth: np.ndarray  # (T, 2) reference, moved to the receiver's antenna [m]
    direction: np.ndarray  # (T, 2) unit vector along the reference track
    offset: np.ndarray  # (2,) what it was moved by [m]


class Cuts(NamedTuple):
    """B times the whole drive, each with the position cut once."""

    hidden: np.ndarray  # (B, T) bool, epochs without position
    last: np.ndarray  # (B,) the last of them
    length: np.ndarray  # (B,) s
    start: np.ndarray  # (B,) s


def load() -> Drive:
    """The recording of ``experiments/data/car_comma2k19``."""
    with np.load(DATA) as file:
        d = {name: np.asarray(file[name], float) for name in file.files}
    t = d["gnss_t_s"]
    wheel = _averaged(d["wheel_t_s"], d["wheel_fl_fr_rl_rr_mps"].mean(axis=1), t)
    yaw = _averaged(d["imu_t_s"], -d["gyr_frd_radps"][:, 2], t)  # the device's z axis points down
    position = d["gnss_enu_m"][:, :2]
    reference = _interpolated(t, d["truth_t_s"], d["truth_enu_m"][:, :2])
    velocity = _interpolated(t, d["truth_t_s"], d["truth_vel_enu_mps"][:, :2])
    offset = (position - reference)[t < SPLIT].mean(axis=0)
    course = np.unwrap(np.pi / 2 - d["gnss_course_rad"])
    return Drive(
        t, np.diff(t, prepend=t[0] - 0.1), np.column_stack([position, wheel, yaw]), d["gnss_speed_mps"], course,
        reference + offset, velocity / np.linalg.norm(velocity, axis=1, keepdims=True), offset,
    )  # fmt: skip


def _averaged(times, values, t):
    """Mean of the samples in each interval that ends at t; nothing later is looked at."""
    edges = np.searchsorted(times, np.append(t[0] - 0.1, t), side="right")
    total = np.append(0.0, np.cumsum(values))[edges]
    return np.diff(total) / np.diff(edges)


def _interpolated(t, times, values):
    return np.stack([np.interp(t, times, column) for column in values.T], axis=1)


def cut(drive: Drive, lengths: tuple[int, ...] = LENGTHS, every: float = 1.0) -> Cuts:
    """A cut of each length at every second of the second half where it fits. They overlap."""
    rows = []
    for length in lengths:
        for start in np.arange(SPLIT, drive.t[-1] - length, every):
            hidden = (drive.t > start) & (drive.t <= start + length)
            rows.append((hidden, np.flatnonzero(hidden)[-1], length, start))
    return Cuts(*(np.array(column) for column in zip(*rows, strict=True)))
