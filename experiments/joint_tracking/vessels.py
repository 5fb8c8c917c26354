"""Recorded vessels: fast craft or ship, from positions alone? The labels are weak: the data's README by vessel."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.report import Entry, Table
from experiments.vessels import tracks
from jaxfilt.models.turn import arc

CLASSES = ("ship", "fast craft")
LABELS = {1: 1, 2: 1, 4: 1, 8: 1, 10: 0, 11: 0, 12: 0, 13: 0, 14: 0}
TRAINING = (1, 8, 10, 12, 14)  # every other one of each class
SIZE = 40  # reports in a piece
SIGMA_Z = 10.0  # m
DWELL = 60.0  # s
# What a class may be: noise [m/s^2], acceleration along the course [m/s^2], turn rate [rad/s]
GRID = np.array([(w, a, o) for w in (0.01, 0.03, 0.1, 0.3) for a in (0.02, 0.1, 0.4) for o in (0.005, 0.02, 0.08)])


class Pieces(NamedTuple):
    """Parts of tracks under way."""

    ys: np.ndarray  # (B, T, 2) m about the first report
    dt: np.ndarray  # (B, T) s
    speed: np.ndarray  # (B,) m/s, mean speed over ground as reported: not seen by the filters
    vessel: np.ndarray  # (B,)

    @property
    def label(self) -> np.ndarray:
        """(B,) the weak labels."""
        return np.array([LABELS[int(v)] for v in self.vessel])


def pieces(vessels: tuple[int, ...]) -> Pieces:
    """Consecutive pieces in which a vessel moves at half of its reports or more."""
    found = []
    for track in tracks.load(vessels):
        t, position = track.t[track.real], track.position[track.real]
        speed, moving = np.hypot(*track.velocity[track.real].T), track.moving[track.real]
        for begin in range(1, len(t) - SIZE + 1, SIZE):
            part = slice(begin, begin + SIZE)
            if moving[part].mean() >= 0.5:
                found.append((position[part] - position[begin - 1], np.diff(t[begin - 1 : begin + SIZE]),
                              speed[part].mean(), track.vessel))  # fmt: skip
    return Pieces(*(np.array(column) for column in zip(*found, strict=True)))


class _Mode(NamedTuple):
    accel: Any
    omega: Any


def _move(mode: _Mode, x: Array, u: Any, dt: Any) -> Array:
    del u
    px, py, vx, vy = x
    s, c, cos, sin = arc(mode.omega, dt)
    speed = jnp.sqrt(vx * vx + vy * vy + 1e-6)
    # a vessel slows down to a stop, not to backwards
    push = jnp.maximum(mode.accel * dt, -speed) / speed
    half = 0.5 * dt * push
    return jnp.stack([
        px + s * vx + c * vy + half * vx, py - c * vx + s * vy + half * vy,
        cos * vx - sin * vy + push * vx, sin * vx + cos * vy + push * vy,
    ])  # fmt: skip


def _noise(sigma: Any, x: Array, u: Any, dt: Any) -> Array:
    del x, u
    eye = jnp.eye(2, dtype=dt.dtype)
    G = jnp.concatenate([0.5 * dt**2 * eye, dt * eye])
    return sigma**2 * (G @ G.T)


def models(values: Array) -> list[jf.models.Nonlinear]:
    """Five modes of a class for a row of :data:`GRID`."""
    sigma, a, w = values
    zero = jnp.zeros_like(a)
    sensor = jf.models.sensors.position(SIGMA_Z**2 * np.eye(2))
    m0, P0 = np.zeros(4), np.diag([SIGMA_Z**2] * 2 + [36.0] * 2)
    modes = ((zero, zero), (a, zero), (-a, zero), (zero, w), (zero, -w))
    Q = Partial(_noise, sigma)
    return [jf.models.nonlinear(Partial(_move, _Mode(*mode)), sensor.h, Q, sensor.R, m0, P0) for mode in modes]


def transition(interval: float) -> np.ndarray:
    """(5, 5) for the median interval between reports."""
    stay = np.exp(-interval / DWELL)
    return np.where(np.eye(5, dtype=bool), stay, (1 - stay) / 4)


def imm(values: Array, pi: Any) -> jf.Filter:
    """The five modes by EKF."""
    return jf.imm([jf.extended(m) for m in models(values)], pi)


def _log_lik(state, info):
    del state
    return info.log_lik


@jax.jit
def likelihoods(grid: Array, pi: Array, ys: Array, dt: Array) -> Array:
    """(B, G) log-likelihood of each piece at each row of the grid."""
    return jax.vmap(lambda y, d: jax.vmap(
        lambda g: jf.filter(imm(g, pi), y, dt=d, outputs=_log_lik).sum()
    )(grid))(ys, dt)  # fmt: skip


def learn(train: Pieces, pi: np.ndarray) -> np.ndarray:
    """(2, 3) the most likely values of each class on the grid; each vessel counts alike."""
    found = np.asarray(likelihoods(jnp.asarray(GRID), jnp.asarray(pi), jnp.asarray(train.ys), jnp.asarray(train.dt)))
    best = []
    for label in (0, 1):
        vessels = [v for v in np.unique(train.vessel) if LABELS[int(v)] == label]
        score = np.mean([found[train.vessel == v].mean(axis=0) for v in vessels], axis=0)
        best.append(GRID[int(score.argmax())])
    return np.array(best)


def _end(state, info):
    del state
    return info.extra["log_probabilities"]


@partial(jax.jit, static_argnames="count")
def classify(values: Array, pi: Array, ys: Array, dt: Array, keys: Array, count: int) -> tuple[Array, Array]:
    """log-probabilities of the classes (B, 2) at the end of each piece: single particle filter, IMM bank."""
    joint = jf.joint_particle([models(v) for v in values], pi, count, noise_rank=2, score_gradient=False)
    bank = jf.bank([imm(v, pi) for v in values])

    def one(x):
        y, d, key = x
        return tuple(jf.filter(f, y, dt=d, key=key, outputs=_end)[-1] for f in (joint, bank))

    return jax.lax.map(one, (ys, dt, keys), batch_size=8)


def confusion(key: Array, count: int) -> tuple[list[Table], list[str]]:
    """The confusion table of pieces and vessels that were not learnt from, and what it says."""
    train, test = pieces(TRAINING), pieces(tuple(v for v in LABELS if v not in TRAINING))
    pi = transition(float(np.median(train.dt)))
    values = learn(train, pi)
    keys = jax.random.split(key, len(test.ys))
    arguments = (jnp.asarray(values), jnp.asarray(pi), jnp.asarray(test.ys), jnp.asarray(test.dt), keys)
    joint, bank = (np.asarray(x) for x in classify(*arguments, count))
    # The simplest rule for comparison: the mean speed half-way between the classes' training means.
    border = np.mean([train.speed[train.label == c].mean() for c in (0, 1)])
    said = {"single particle filter": joint.argmax(axis=1), "IMM bank": bank.argmax(axis=1),
            "rule: reported speed": (test.speed > border).astype(int)}  # fmt: skip
    rows: list[list[Entry]] = []
    balanced = {}
    for name, x in said.items():
        hits = []
        for c, label in enumerate(CLASSES):
            of = test.label == c
            hits.append(float(np.mean(x[of] == c)))
            majority = sum(np.mean(x[test.vessel == v] == c) > 0.5 for v in np.unique(test.vessel[of]))
            rows.append([name, label, f"{int(of.sum())}", *(f"{int(np.sum(x[of] == k))}" for k in (0, 1)),
                         f"{int(majority)} of {len(np.unique(test.vessel[of]))}"])  # fmt: skip
        balanced[name] = np.mean(hits)
    header = ["method", "weak label", "pieces", *(f"called {name}" for name in CLASSES), "vessels right by majority"]
    shown = ", ".join(f"{n}: noise {v[0]:g} m/s², acceleration {v[1]:g} m/s², turn {v[2]:g} rad/s"
                      for n, v in zip(CLASSES, values, strict=True))  # fmt: skip
    note = (f"Pieces of {SIZE} reports of vessels {', '.join(str(v) for v in np.unique(test.vessel))}; {count} "
            f"particles. Learnt from vessels {', '.join(map(str, TRAINING))} by likelihood: {shown}.")  # fmt: skip
    agree = float(np.mean(joint.argmax(axis=1) == bank.argmax(axis=1)))
    fast, slow = (np.median(test.dt[test.label == c]) for c in (1, 0))
    findings = [
        f"Recorded vessels: of {len(test.ys)} pieces that were not learnt from, the mean of the two hit rates is "
        + ", ".join(f"{100 * v:.0f} % ({n})" for n, v in balanced.items())
        + f"; the two filters agree on {100 * agree:.0f} %. The labels are a description of {len(LABELS)} vessels, "
        f"{len(np.unique(test.vessel))} of which are left for the test, so that this is no accuracy; and the classes "
        f"differ in what is not motion, a report every {fast:.1f} s (fast craft) and {slow:.1f} s (ships)."
    ]
    cells = Table("vessels", "Recorded vessels: confusion against weak labels", header, rows, note)
    return [cells], findings
