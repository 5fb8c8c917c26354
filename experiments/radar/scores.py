"""Scores of the tracks. This module alone compares with the true positions; and a naive tracker to compare with."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

import jaxfilt as jf
from experiments.radar.scans import LIMIT, SCENARIOS, Tracks, truth

NEAR = 20.0  # m: a detection that close to a boat counts as the boat's
LOST = 30.0  # m
LOST_FOR = 10.0  # s
HORIZON = 30.0  # s, how long the tracks from every scan are followed
BLOCK = 15.0  # s: the tracks that start within one are resampled together


class Runs(NamedTuple):
    """Which boat each track is meant to follow, and where that boat was."""

    boat: np.ndarray  # (B,) 0 or 1; -1 = the track did not start from two detections of one boat
    position: np.ndarray  # (B, T, 2) true position of the boat [m]
    scored: np.ndarray  # (B, T) bool: radar scans of which the truth is known
    block: np.ndarray  # (B,) index of the block of time that the track starts in, by scenario and boat


class Scores(NamedTuple):
    """Per track, over its scored scans."""

    count: np.ndarray  # (B,) scored scans
    squared: np.ndarray  # (B,) sum of squared distances from the truth [m^2]
    predicted: np.ndarray | None  # (B,) the same of the predictions, before each scan's detection
    inside: np.ndarray | None  # (B,) scans with the truth inside the ellipse of 95 %
    updated: np.ndarray  # (B,) scans that had a detection for the track
    right: np.ndarray  # (B,) scans whose chosen detection is within NEAR of the boat
    lost: np.ndarray  # (B,) bool


def runs(tracks: Tracks) -> Runs:
    """A track is of the boat that both its first detections are near to; of the nearer boat if of both."""
    size = len(tracks.scan)
    first, second, position = np.zeros((size, 2, 2)), np.zeros((size, 2, 2)), np.zeros((*tracks.t.shape, 2, 2))
    for i, name in enumerate(SCENARIOS):
        own = tracks.scenario == i
        first[own], second[own] = truth(name, tracks.t_first[own]), truth(name, tracks.t_second[own])
        position[own] = truth(name, tracks.t[own])
    apart = [np.linalg.norm(a[:, None] - b, axis=-1) for a, b in ((tracks.first, first), (tracks.second, second))]
    rows = np.arange(size)
    boat = np.argmin(np.nan_to_num(apart[0] + apart[1], nan=np.inf), axis=1)
    near = np.maximum(*apart)[rows, boat] < NEAR  # false for NaN
    position = position[rows, :, boat]
    scored = tracks.mask & (tracks.sensor == 0) & np.isfinite(position).all(axis=-1)
    label = np.stack([tracks.scenario, boat, tracks.t_second // BLOCK], axis=1)
    return Runs(np.where(near, boat, -1), position, scored, np.unique(label, axis=0, return_inverse=True)[1].ravel())


def within(tracks: Tracks, r: Runs, horizon: float) -> Runs:
    """The runs cut to a horizon [s]; those that the scenario does not have to its end are dropped (boat -1)."""
    near = tracks.t <= tracks.t_second[:, None] + horizon
    complete = ((tracks.t > tracks.t_second[:, None] + horizon - 2.0) & r.scored & near).any(axis=1)
    return r._replace(scored=r.scored & near, boat=np.where(complete, r.boat, -1))


def score(out: Any, tracks: Tracks, r: Runs) -> Scores:
    """Scores of what a filter or the naive tracker reports (``position``, ``choice``, and, if any, more)."""
    position, choice = np.asarray(out.position), np.asarray(out.choice)
    error = np.linalg.norm(position - r.position, axis=-1)
    # The detection that was chosen, as a position.
    taken = np.take_along_axis(tracks.detections, np.maximum(choice, 0)[..., None, None], axis=2)[:, :, 0]
    taken = tracks.observer + taken[..., :1] * np.stack([np.cos(taken[..., 1]), np.sin(taken[..., 1])], axis=-1)
    right = (choice >= 0) & (np.linalg.norm(taken - r.position, axis=-1) < NEAR)
    predicted = inside = None
    if out.predicted is not None:
        predicted = _total(np.linalg.norm(np.asarray(out.predicted) - r.position, axis=-1) ** 2, r.scored)
    if out.cov is not None:
        nees = np.asarray(jf.metrics.nees(position, np.asarray(out.cov), np.nan_to_num(r.position)))
        inside = _total(nees < jf.metrics.chi2_quantile(0.95, 2), r.scored)
    return Scores(
        r.scored.sum(axis=1), _total(error**2, r.scored), predicted, inside,
        _total(choice >= 0, r.scored), _total(right, r.scored), lost(error, tracks.t, r.scored),
    )  # fmt: skip


def _total(values, scored):
    return np.where(scored, values, 0.0).sum(axis=1)


def lost(error: np.ndarray, t: np.ndarray, scored: np.ndarray) -> np.ndarray:
    """(B,) bool: off by more than LOST at the last scored scan, or at all scored scans of LOST_FOR seconds in a row."""
    found = []
    for e, times, which in zip(error, t, scored, strict=True):
        far, times = e[which] > LOST, times[which]
        since, longest = None, 0.0
        for away, now in zip(far, times, strict=True):
            since = (now if since is None else since) if away else None
            longest = max(longest, 0.0 if since is None else now - since)
        found.append(bool(len(far)) and (bool(far[-1]) or longest >= LOST_FOR))
    return np.array(found)


class Naive(NamedTuple):
    """What the naive tracker says at each scan."""

    position: np.ndarray  # (B, T, 2)
    predicted: np.ndarray  # (B, T, 2)
    choice: np.ndarray  # (B, T)
    cov: None = None


NAIVE = ("last detection held", "line through two detections")


def naive(name: str, tracks: Tracks) -> Naive:
    """Takes the detection nearest to where the last one was, or to the line through the last two.

    The gate is the distance that LIMIT allows since the last detection. All tracks at once, in plain numpy.
    """
    rows = np.arange(len(tracks.scan))
    old, new = tracks.first.copy(), tracks.second.copy()
    t_old, t_new = tracks.t_first.copy(), tracks.t_second.copy()
    reported = []
    for k in range(tracks.t.shape[1]):
        t = tracks.t[:, k]
        guess = new.copy()
        if name == NAIVE[1]:
            guess += (new - old) * ((t - t_new) / (t_new - t_old))[:, None]
        reach, angle = tracks.detections[:, k, :, 0], tracks.detections[:, k, :, 1]
        candidates = tracks.observer[:, k, None] + reach[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        apart = np.linalg.norm(candidates - guess[:, None], axis=-1)
        usable = tracks.valid[:, k] & tracks.mask[:, k, None] & (apart < LIMIT * (t - t_new)[:, None])
        choice = np.where(usable.any(axis=1), np.argmin(np.where(usable, apart, np.inf), axis=1), -1)
        hit = choice >= 0
        position = np.where(hit[:, None], candidates[rows, choice], guess)
        reported.append((position, guess, choice))
        old, t_old = np.where(hit[:, None], new, old), np.where(hit, t_new, t_old)
        new, t_new = np.where(hit[:, None], position, new), np.where(hit, t, t_new)
    position, predicted, choice = (np.stack(column, axis=1) for column in zip(*reported, strict=True))
    return Naive(position, predicted, choice)
