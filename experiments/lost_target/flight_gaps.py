"""Recorded glider flights: windows around gaps made by hand, noise learnt by likelihood, estimates and their scores.

There is no truth but the fixes themselves. What is hidden is what is scored: an estimate at a hidden fix has seen the
fixes around it, never the fix.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.planar import in_parallel
from jaxfilt import tune

DATA = Path(__file__).resolve().parents[1] / "data" / "glider_igc"
TRAINING = "soaring_1s"
TESTS = ("soaring_gap_1s", "sailplane_3s")

# A gap's length is the horizon of its last hidden fix: the time since the last fix that was seen. Multiples of both
# sampling intervals.
LENGTHS = (6, 12, 24, 48)  # s
BEFORE = 60  # fixes seen before a gap; a filter with the noise learnt here forgets its prior within ten
AFTER = 20  # s after a gap
SLOT = 60.0  # s: one gap in each slot, so that gaps do not overlap
CIRCLING = 6.0  # deg/s of mean turn rate in the gap; the rates met are below 3 or above 8, few lie between
DROPOUT = 0  # "length" of the window with the real dropout

ORDERS = {"CV": 2, "CA": 3}  # derivatives in the state, position included
NAIVE = ("last fix", "line through 2 fixes")
STRATEGIES = {
    "coast": lambda filt: filt,
    "coast_inflated x10": jf.coast_inflated,
    "hold": jf.hold_last,
    "mean 5": jf.mean_of_recent,
    "fit N10 p1": jf.polynomial_fit,
    "fit N20 p2": lambda filt: jf.polynomial_fit(filt, window=20, degree=2),
    "fit_weighted N10 p1": lambda filt: jf.polynomial_fit(filt, weighted=True),
    "fit_ci N10 p1": jf.covariance_intersection,
    "blend": jf.blend,
}
SMOOTHER = "RTS, offline"

# What is shown for CA too. The other strategies override either model in the gap, so small is the noise r learnt here.
CORE = ("coast", "coast_inflated x10", "fit N10 p1", "fit_weighted N10 p1", "fit_ci N10 p1", "blend")
QUICK = ("coast", "coast_inflated x10", "hold", "fit N10 p1", "blend")
SPLIT = (12, 48)  # s, the lengths that are looked at more closely

Key = tuple[str, str]  # strategy, model
Noise = dict[str, dict[str, float]]  # per model: q, r


class Flight(NamedTuple):
    """A recording."""

    name: str
    t: np.ndarray  # (T,) s
    position: np.ndarray  # (T, 2) east, north [m]
    interval: float  # s, the usual one

    @property
    def turn_rate(self) -> np.ndarray:
        """(T,) deg/s, the size of the rate of the course, itself taken over 6 s: fixes are rounded to about 2 m."""
        reach = max(1, round(3.0 / self.interval))
        course = np.zeros(len(self.t))
        course[reach:-reach] = np.arctan2(*(self.position[2 * reach :] - self.position[: -2 * reach]).T)
        course[:reach], course[-reach:] = course[reach], course[-reach - 1]
        return np.abs(np.degrees(np.gradient(np.unwrap(course), self.t)))


class Windows(NamedTuple):
    """Pieces of flights, each with one gap; positions relative to the first fix. Padded to a common T at the end."""

    ys: np.ndarray  # (B, T, 2) m, all fixes
    mask: np.ndarray  # (B, T) bool, the fixes that are seen
    dt: np.ndarray  # (B, T) s
    hidden: np.ndarray  # (B, T) bool, the fixes that are scored
    after: np.ndarray  # (B, T) bool, fixes after the gap without the first of them
    last: np.ndarray  # (B,) index of the last hidden fix
    length: np.ndarray  # (B,) s
    flight: np.ndarray  # (B,) index into TESTS
    circling: np.ndarray  # (B,) bool


class Reported(NamedTuple):
    """What a strategy says at each step."""

    position: Array | np.ndarray  # (..., T, 2)
    cov: Array | None  # (..., T, 2, 2) of the position
    innovation: Array | np.ndarray | None  # (..., T, 2) of the prediction from the step before
    nis: Array | None  # (..., T)


class Scores(NamedTuple):
    """Sums of squared distances per window."""

    gap: np.ndarray  # (B,) m^2 over the hidden fixes
    end: np.ndarray  # (B,) m^2 at the last hidden fix
    after: np.ndarray | None  # (B,) m^2 of one-step predictions after the gap
    nees: np.ndarray | None  # (B,) at the last hidden fix, over 2


def load(name: str) -> Flight:
    """A recording of ``experiments/data/glider_igc``."""
    table = np.genfromtxt(DATA / f"{name}.csv", delimiter=",", names=True)
    t = table["t_s"]
    return Flight(name, t, np.stack([table["east_m"], table["north_m"]], axis=1), float(np.median(np.diff(t))))


def make_model(order: int, q: Any, r: Any) -> jf.models.LinearGaussian:
    """CV (order 2) or CA (3) in the plane about the first fix, about which nothing else is known."""
    variances = [100.0] * 2 + [2500.0] * 2 + [25.0] * 2
    build = jf.models.constant_velocity if order == 2 else jf.models.constant_acceleration
    P0 = np.diag(variances[: 2 * order]).tolist()
    return build(dt=1.0, q=q, r=r, m0=[0.0] * (2 * order), P0=P0)


# ------------------------------------------------------------------------------------------------- learning the noise


class Training(NamedTuple):
    ys: Array  # (B, T, 2) pieces of one flight, each about its first fix
    mask: Array  # (B, T, 2)
    dt: Array  # (B, T)


def training_pieces(flight: Flight, rng: np.random.Generator, size: int = 300) -> Training:
    """A flight cut into pieces of ``size`` fixes; each with one gap of every length, at random places."""
    count = len(flight.t) // size
    dt = np.asarray(jf.intervals(flight.t, first=flight.interval))[: count * size].reshape(count, size)
    ys = flight.position[: count * size].reshape(count, size, 2)
    mask = np.ones((count, size), bool)
    slot = size // len(LENGTHS)
    for piece in mask:
        for i, length in enumerate(rng.permutation(LENGTHS)):
            hidden = round(length / flight.interval)
            first = i * slot + rng.integers(10, slot - hidden)  # ten fixes at least between two gaps
            piece[first : first + hidden] = False
    return Training(jnp.asarray(ys - ys[:, :1]), jnp.asarray(np.stack([mask, mask], axis=2)), jnp.asarray(dt))


def loss(order: jf.Static, params: dict[str, Array], data: Training) -> Array:
    """Innovation likelihood of the fixes that are seen; the first of them only tell where the flight is."""
    filt = jf.kalman(make_model(order.value, params["q"], params["r"]))
    return tune.innovation_nll(
        filt, data.ys, mask=data.mask, dt=data.dt, warmup=10, first_update_only=True
    )  # fmt: skip


def learn(order: int, data: Training, steps: int = 80) -> tune.TuneResult:
    """q and r (variance per axis [m^2]) of a motion model."""
    space = {"q": tune.positive(1.0, 1e-4, 1e4), "r": tune.positive(4.0, 1e-3, 1e3)}
    objective = Partial(loss, jf.Static(order))
    return tune.gradient(objective, space, data, key=jax.random.key(0), steps=steps, block=steps)


# ---------------------------------------------------------------------------------------------------------- the gaps


def cut(flights: Iterable[Flight], rng: np.random.Generator, lengths: Iterable[int], slot: float) -> Windows:
    """Windows with one gap each: one place in every slot of each flight, and there a gap of every length.

    Last come the real dropouts, with the missing samples put in at the usual interval. The first fix after one counts
    as hidden, so that all strategies predict it alike.
    """
    lengths = tuple(lengths)
    windows, dropouts = [], []
    for index, flight in enumerate(flights):
        dt = np.asarray(jf.intervals(flight.t, first=flight.interval))
        rate = flight.turn_rate
        after = round(AFTER / flight.interval)
        for start in np.arange(flight.t[BEFORE], flight.t[-1] - slot - AFTER, slot):
            first = int(np.searchsorted(flight.t, start + rng.uniform(0.0, slot - max(lengths))))
            for length in lengths:
                stop = first + round(length / flight.interval)
                piece = slice(first - BEFORE, stop + after)
                if piece.start < 0 or piece.stop > len(dt) or dt[piece][1:].max() > 1.5 * flight.interval:
                    continue  # reaches beyond the flight, or over the real dropout
                circling = rate[first:stop].mean() > CIRCLING
                windows.append((flight.position[piece], dt[piece], stop - first, (length, index, circling)))
        dropouts += [_dropout(flight, index, k) for k in np.flatnonzero(dt > 10 * flight.interval)]
    return _pad(windows + dropouts)


def _dropout(flight, index, k):
    """The window about the dropout that ends with fix k."""
    missing = round((flight.t[k] - flight.t[k - 1]) / flight.interval) - 1
    ys = np.insert(flight.position, k, np.full((missing, 2), np.nan), axis=0)
    ys = ys[k - BEFORE : k + missing + round(AFTER / flight.interval)]
    return ys, np.full(len(ys), flight.interval), missing + 1, (DROPOUT, index, False)


def _pad(windows):
    T = max(len(ys) for ys, *_ in windows)
    padded = []
    for ys, dt, lost, label in windows:
        k = np.arange(T)
        seen = (k < len(ys)) & ((k < BEFORE) | (k >= BEFORE + lost))
        values = np.zeros((T, 2))
        values[: len(ys)] = ys - ys[0]
        hidden = (k >= BEFORE) & (k < BEFORE + lost) & np.isfinite(values[:, 0])
        intervals = np.ones(T)
        intervals[: len(ys)] = dt
        after = seen & (k > BEFORE + lost)
        padded.append((np.nan_to_num(values), seen, intervals, hidden, after, BEFORE + lost - 1, *label))
    return Windows(*(np.array(column) for column in zip(*padded, strict=True)))


# ------------------------------------------------------------------------------------------------------ the estimates


def reported(state: Any, info: jf.Info) -> Reported:
    """``outputs`` of the filters."""
    del state
    assert info.cov is not None
    return Reported(info.extra.get("reported", info.mean[:2]), info.cov[:2, :2], info.innovation, info.nis)


@jax.jit
def estimate(filt: jf.Filter, ys: Array, mask: Array, dt: Array) -> Reported:
    """All windows at once. Each has its own intervals, so covariances are per window, and so may masks be."""

    def one(y, mask, dt):
        return jf.filter(filt, y, mask=mask, dt=dt, outputs=reported, first_update_only=True)

    return jax.vmap(one)(ys, mask, dt)


@jax.jit
def smoothed(filt: jf.Filter, ys: Array, mask: Array, dt: Array) -> Reported:
    """The smoother sees the fixes after the gap too, so it is no competitor but the bound of what can be had."""

    def one(y, mask, dt):
        out = jf.smooth(filt, y, mask=mask, dt=dt, first_update_only=True)
        return Reported(out.mean[:, :2], out.cov[:, :2, :2], None, None)

    return jax.vmap(one)(ys, mask, dt)


def naive(name: str, ys: np.ndarray, mask: np.ndarray, dt: np.ndarray) -> Reported:
    """The last fix seen, or the straight line through the last two."""
    runs, T, _ = ys.shape
    t = np.cumsum(dt, axis=1)
    newest = np.maximum.accumulate(np.where(mask, np.arange(T), 0), axis=1)
    # What is known before step k: the fixes up to k - 1.
    last = np.concatenate([np.zeros((runs, 1), int), newest[:, :-1]], axis=1)
    rows = np.arange(runs)[:, None]
    prediction = ys[rows, last]
    if name == NAIVE[1]:
        earlier = np.take_along_axis(last, last, axis=1)  # the newest fix before the last one
        span = np.where(last > earlier, t[rows, last] - t[rows, earlier], 1.0)
        slope = (ys[rows, last] - ys[rows, earlier]) / span[..., None]
        prediction = prediction + slope * (t - t[rows, last])[..., None]
    seen = mask[..., None]
    return Reported(np.where(seen, ys, prediction), None, np.where(seen, ys - prediction, 0.0), None)


def estimates(noise: Noise, windows: Windows, *, quick: bool = False) -> dict[Key, Reported]:
    """What each (strategy, model) says about the windows."""
    given = (windows.ys, windows.mask, windows.dt)
    jobs: dict[Key, tuple] = {}
    for model, params in noise.items():
        filt = jf.kalman(make_model(ORDERS[model], **params))
        strategies = QUICK if quick else STRATEGIES if model == "CV" else CORE
        jobs |= {(name, model): (estimate, STRATEGIES[name](filt), *given) for name in strategies}
        jobs[SMOOTHER, model] = smoothed, filt, *given
    found = dict(zip(jobs, in_parallel(lambda job: job[0](*job[1:]), jobs.values()), strict=True))
    return found | {(name, "none"): naive(name, *given) for name in NAIVE}


# --------------------------------------------------------------------------------------------------------- the scores


def score(out: Reported, windows: Windows, r: float) -> Scores:
    """Squared horizontal distances from the fixes. NEES counts the noise of the fix, which stands in for the truth."""
    position = np.asarray(out.position)
    squared = np.sum((position - windows.ys) ** 2, axis=-1)
    rows = np.arange(len(squared))
    after = nees = None
    if out.innovation is not None:
        after = (np.sum(np.asarray(out.innovation) ** 2, axis=-1) * windows.after).sum(axis=1)
    if out.cov is not None:
        cov = np.asarray(out.cov)[rows, windows.last] + r * np.eye(2)
        nees = np.asarray(jf.metrics.nees(position[rows, windows.last], cov, windows.ys[rows, windows.last])) / 2
    return Scores((squared * windows.hidden).sum(axis=1), squared[rows, windows.last], after, nees)
