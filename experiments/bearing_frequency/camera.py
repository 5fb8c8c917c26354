"""Recorded camera bearings of two boats from a moving ferry: tracks by bearing alone.

Nothing here but :func:`truth` (in ``experiments.radar.scans``), called by :func:`scores`, reads the boats' positions.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxfilt as jf
from experiments.radar.scans import DATA, truth
from jaxfilt.models.sensors import wrap

SCENARIO, CAMERA = "04", "eo"
P_FALSE = 1e-3  # of the gate
NOISE = np.radians(1.0)  # rad, of a bearing
Q = 0.02  # m^2/s^3, white acceleration
RANGE, SPREAD, SPEED = 150.0, 75.0, 4.0  # m, m, m/s: what is taken to be known at the start
BATCH = 50  # scans, 10 s: what a maximum-likelihood start uses
EVERY, UNTIL = 5, 40.0  # a track from every detection of each fifth scan until then [s]
ASSIGN, OFF = np.radians(3.0), np.radians(10.0)  # a start belongs to the boat so near; a track so far off is lost
FILTERS = ("EKF", "UKF", "EKF + residual R")
STARTS = ("ray", "ML", "ML with the ray as prior")


class Scans(NamedTuple):
    """All scans of the camera."""

    t: np.ndarray  # (T,) s
    own: np.ndarray  # (T, 2) the ferry's position, east and north [m]
    bearing: np.ndarray  # (T, D) rad, counter-clockwise from east
    valid: np.ndarray  # (T, D) bool


class Tracks(NamedTuple):
    """B tracks, each from one detection, and the scans that follow; what is beyond the end is masked."""

    first: Array  # (B,) rad
    place: Array  # (B, 2) m, where the ferry was
    dt: Array  # (B, T) s
    own: Array  # (B, T, 2) m
    detections: Array  # (B, T, D, 1) rad
    valid: Array  # (B, T, D) bool


class Reported(NamedTuple):
    """What a filter says at each scan."""

    mean: Array  # (..., T, 4)
    choice: Array  # (..., T) index of the detection taken, or -1
    nis: Array  # (..., T)


def load() -> Scans:
    """The scans of the daylight camera."""
    scans, found = (
        np.genfromtxt(DATA / f"scenario{SCENARIO}_{kind}.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
        for kind in ("scans", "detections")
    )
    scans = scans[scans["sensor"] == CAMERA]
    room = int(scans["n_det"].max())
    bearing, valid = np.zeros((len(scans), room)), np.zeros((len(scans), room), bool)
    for k, number in enumerate(scans["scan"]):
        seen = found["bearing_rad"][found["scan"] == number]
        bearing[k, : len(seen)] = np.asarray(wrap(jnp.asarray(np.pi / 2 - seen)))
        valid[k, : len(seen)] = True
    return Scans(scans["t_s"], np.stack([scans["own_east_m"], scans["own_north_m"]], axis=1), bearing, valid)


def tracks(scans: Scans) -> tuple[Tracks, np.ndarray]:
    """A track from every detection of the scans that start one; and those scans' numbers (B,)."""
    count = len(scans.t)
    rows, begins = [], []
    for b in np.flatnonzero(scans.t < UNTIL)[::EVERY]:
        index = np.minimum(np.arange(b + 1, b + count), count - 1)
        inside = np.arange(b + 1, b + count) < count
        dt = np.where(inside, np.diff(scans.t[index], prepend=scans.t[b]), 1.0)
        valid = scans.valid[index] & inside[:, None]
        for seen in scans.bearing[b][scans.valid[b]]:
            rows.append((seen, scans.own[b], dt, scans.own[index], scans.bearing[index][..., None], valid))
            begins.append(b)
    return Tracks(*(jnp.asarray(np.array(column)) for column in zip(*rows, strict=True))), np.array(begins)


def _place(u, dt):
    del dt
    return u


def _model(m0, P0):
    motion = jf.models.constant_velocity(dt=0.2, q=Q, r=1.0, m0=m0, P0=P0)
    return jf.models.with_sensor(motion, jf.models.sensors.bearing(jnp.full((1, 1), NOISE**2), observer=_place))


def ray(first: Array, place: Array) -> tuple[Array, Array]:
    """The start on a bearing: a guessed range with its spread, and a velocity of 0 with its."""
    along = jnp.stack([jnp.cos(first), jnp.sin(first)])
    across = jnp.stack([-along[1], along[0]])
    P = SPREAD**2 * jnp.outer(along, along) + (RANGE * NOISE) ** 2 * jnp.outer(across, across)
    mean = jnp.concatenate([place + RANGE * along, jnp.zeros(2)])
    return mean, jnp.zeros((4, 4)).at[:2, :2].set(P) + jnp.diag(jnp.array([0.0, 0.0, SPEED**2, SPEED**2]))


def _make(name, mean, P):
    model = _model(mean, P)
    inner = {
        "EKF": lambda: jf.extended(model),
        "UKF": lambda: jf.unscented(model),
        "EKF + residual R": lambda: jf.residual_r(jf.extended(model), rate=0.02),
    }[name]()
    return jf.nearest_neighbor(inner, P_FALSE)


def _reported(state: Any, info: jf.Info) -> Reported:
    del state
    assert info.nis is not None
    return Reported(info.mean, info.extra["choice"], info.nis)


@partial(jax.jit, static_argnames="name")
def run(name: str, mean: Array, P: Array, given: Tracks) -> Reported:
    """All tracks by one filter from starts (B, 4) and (B, 4, 4)."""

    def one(mean, P, track):
        scans = jf.scan_inputs(track.detections, track.valid, u=track.own)
        return jf.filter(_make(name, mean, P), **scans, dt=track.dt, outputs=_reported)

    return jax.vmap(one)(mean, P, given)


@partial(jax.jit, static_argnames="name")
def last_moments(name: str, mean: Array, P: Array, given: Tracks) -> tuple[Array, Array]:
    """Where a filter stands after all scans given: mean (B, 4) and covariance (B, 4, 4)."""

    def one(mean, P, track):
        scans = jf.scan_inputs(track.detections, track.valid, u=track.own)
        out = jf.filter(_make(name, mean, P), **scans, dt=track.dt, outputs=_moments)
        return out[0][-1], out[1][-1]

    return jax.vmap(one)(mean, P, given)


def _moments(state: Any, info: jf.Info) -> tuple:
    del state
    return info.mean, info.cov


class MLStart(NamedTuple):
    """Starts by batch ML, carried on to the end of the batch."""

    mean: Array  # (B, 4)
    cov: Array  # (B, 4, 4)
    found: jf.initial.Start


@partial(jax.jit, static_argnames="with_prior")
def ml_starts(given: Tracks, choice: Array, with_prior: bool) -> MLStart:
    """Batch ML of each track from the bearings that a gated filter chose (B, T) in the first BATCH scans."""

    def one(track, chosen):
        mean, P = ray(track.first, track.place)
        model = _model(mean, P)
        picked = jnp.take_along_axis(track.detections[:BATCH, :, 0], jnp.maximum(chosen[:BATCH, None], 0), axis=1)
        ys = jnp.concatenate([track.first[None, None], picked])
        mask = jnp.concatenate([jnp.ones((1,), bool), chosen[:BATCH] >= 0])
        along = jnp.stack([jnp.cos(track.first), jnp.sin(track.first)])
        reach = jnp.array([30.0, 60.0, 100.0, 150.0, 200.0, 300.0])
        starts = jnp.concatenate([track.place[None] + reach[:, None] * along[None], jnp.zeros((6, 2))], axis=1)
        found = jf.initial.batch_ml(
            model, ys, starts, prior=(mean, P) if with_prior else None, scale=(100.0, 100.0, 1.0, 1.0), mask=mask,
            u=jnp.concatenate([track.place[None], track.own[:BATCH]]), first_update_only=True,
            dt=jnp.concatenate([jnp.zeros(1), track.dt[:BATCH]]),
        )  # fmt: skip
        elapsed = track.dt[:BATCH].sum()
        F, noise = model.f_jacobian(mean, None, elapsed), model.Q(mean, None, elapsed)  # pyright: ignore
        return MLStart(F @ found.mean, F @ found.cov @ F.T + noise, found)

    return jax.vmap(one)(given, choice)


class Scores(NamedTuple):
    """What the truth says of tracks, (B,) each; only tracks that start on a boat are ``scored``."""

    scored: np.ndarray
    lost: np.ndarray  # the last five seconds' bearings are off the boat's by more than OFF on average
    other: np.ndarray  # ... and on the other boat's bearing
    updated: np.ndarray  # share of scans in which a detection was taken, of those after the batch
    squared: np.ndarray  # m^2, mean squared position error after the batch
    bearing: np.ndarray  # rad^2, alike
    relative: np.ndarray  # squared relative error of the range, alike


def scores(scans: Scans, given: Tracks, begins: np.ndarray, out: Reported, first: int = 0) -> Scores:
    """Scores of tracks from the end of the batch to the end of the record.

    Args:
        scans: all scans.
        given: the tracks.
        begins: (B,) the scan that each began with.
        out: what the filter said, from step ``first`` on.
        first: the step of the tracks that ``out`` begins with.
    """
    mean, choice = np.asarray(out.mean), np.asarray(out.choice)
    rows = []
    for b, seen, x, chosen in zip(begins, np.asarray(given.first), mean, choice, strict=True):
        boats = truth(SCENARIO, scans.t[b:])  # (., 2, 2)
        away = boats[0] - scans.own[b]
        off = np.abs(np.asarray(wrap(jnp.asarray(np.arctan2(away[:, 1], away[:, 0]) - seen))))
        mine = int(np.argmin(off))
        boat, stranger = boats[:, mine][BATCH + 1 :], boats[:, 1 - mine][BATCH + 1 :]
        own = scans.own[b + BATCH + 1 :]
        last = len(own)
        x, chosen = x[BATCH - first : BATCH - first + last], chosen[BATCH - first : BATCH - first + last]
        there, true = x[:, :2] - own, boat - own
        angle, strange = _between(there, true), _between(there, stranger - own)
        good = np.isfinite(true).all(axis=1)
        relative = np.hypot(*there.T) / np.hypot(*true.T) - 1
        end = np.flatnonzero(good)[-25:]
        rows.append((
            off.min() < ASSIGN, not np.abs(angle[end]).mean() < OFF, np.nanmean(np.abs(strange[end])) < OFF,
            (chosen >= 0).mean(),
            (np.sum((x[:, :2] - boat)[good] ** 2, axis=1)).mean(), (angle[good] ** 2).mean(),
            (relative[good] ** 2).mean(),
        ))  # fmt: skip
    return Scores(*(np.array(column) for column in zip(*rows, strict=True)))


def _between(a, b):
    """The angle [rad] between plane vectors (..., 2)."""
    turned = (a[:, 0] + 1j * a[:, 1]) * (b[:, 0] - 1j * b[:, 1])
    return np.angle(turned)


def later(given: Tracks) -> Tracks:
    """The tracks after their batch."""
    return given._replace(**{name: getattr(given, name)[:, BATCH:] for name in ("dt", "own", "detections", "valid")})


class CameraRow(NamedTuple):
    """One filter from one kind of start on the recorded bearings."""

    filt: str
    start: str
    used: int  # tracks that the start could serve
    scores: Scores
    nis: float


class CameraStudy(NamedTuple):
    """All of them, and the ML starts."""

    rows: list[CameraRow]
    found: dict[str, jf.initial.Start]
    tracks: int
    scans: Scans
    example: dict[str, np.ndarray]  # a track's positions by each filter from the ray
    example_begin: int
    steps: int


def camera_study(names: Any = FILTERS) -> CameraStudy:
    """Bearings of scenario 04: filters from the ray, and from batch ML where it is of use."""
    scans = load()
    given, begins = tracks(scans)
    mean, P = jax.vmap(ray)(given.first, given.place)
    rows, outs = [], {}
    for name in names:
        outs[name] = run(name, mean, P, given)
        rows.append(_camera_row(name, "ray", len(begins), scans, given, begins, outs[name], 0))
    found = {}
    after = later(given)
    for label, with_prior in (("ML", False), ("ML with the ray as prior", True)):
        ml = ml_starts(given, outs["EKF"].choice, with_prior)
        found[label] = ml.found
        deviation = np.sqrt(np.asarray(ml.cov)[:, 0, 0] + np.asarray(ml.cov)[:, 1, 1])
        usable = jnp.asarray(np.isfinite(deviation) & (deviation < SPREAD) & (np.asarray(ml.found.status) == 0))
        for name in names:
            # where ML knows less than the guess, the filter goes on from the guess
            there = _moments_at_batch(name, mean, P, given)
            start = jnp.where(usable[:, None], ml.mean, there[0])
            cov = jnp.where(usable[:, None, None], jnp.where(jnp.isfinite(ml.cov), ml.cov, 0.0), there[1])
            out = run(name, start, cov, after)
            rows.append(_camera_row(name, label, int(usable.sum()), scans, given, begins, out, BATCH))
    shown = 0
    example = {name: np.asarray(out.mean[shown]) for name, out in outs.items()}
    return CameraStudy(rows, found, len(begins), scans, example, int(begins[shown]), given.dt.shape[1])


def _moments_at_batch(name, mean, P, given):
    until = given._replace(
        **{field: getattr(given, field)[:, :BATCH] for field in ("dt", "own", "detections", "valid")}
    )
    return last_moments(name, mean, P, until)


def _camera_row(name, start, used, scans, given, begins, out, first):
    taken = np.asarray(out.choice) >= 0
    nis = float(np.asarray(out.nis)[taken].mean())
    return CameraRow(name, start, used, scores(scans, given, begins, out, first), nis)
