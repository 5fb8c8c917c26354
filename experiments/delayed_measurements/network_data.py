"""Messages of a vehicle over a 5G network: what was sent when, and how many samples late it arrived."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from experiments.__main__ import ROOT

FOLDER = ROOT / "data" / "network_cicv5g"
LEARN, TRANSFER = "rural_weak_10s_stalls", "strong_to_weak"
D = 4  # samples; what is later counts as lost
NOISE_SEED = 5  # of the noise added to the recorded positions
SIGMA = 1.0  # m, of this noise
BLOCK = 5.0  # s, of the bootstrap's blocks
START = 5.0  # s at the start of a recording that are not scored


class Record(NamedTuple):
    """A recording, padded to T samples; only :attr:`scored` ones count. All but the first field are by sample."""

    name: str
    t: np.ndarray  # (T,) s, the sending times
    position: np.ndarray  # (T, 2) m, at these times; east and north of the first one
    packets: np.ndarray  # (T, 2) m, the positions with noise: what is sent
    delays: np.ndarray  # (T,) int32 samples; D + 1 = lost
    scored: np.ndarray  # (T,) bool
    block: np.ndarray  # (T,) int, block of time


class Given(NamedTuple):
    """What a filter gets: no truth, and no more of the delays than it is told."""

    ys: np.ndarray
    mask: np.ndarray | None


def load(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sending times (T,) [s], positions (T, 2) [m] and delays (T,) in samples, D + 1 = lost.

    A sample is the instant at which a message is sent. A message that is under way when the next one is sent arrives
    at a later sample: the first one not before it is received. So none is on time, and on a good network all are one
    sample late.
    """
    sent, received, east, north = np.genfromtxt(
        FOLDER / f"{name}.csv", delimiter=",", skip_header=1, usecols=(0, 1, 2, 3)
    ).T
    late = np.searchsorted(sent, received, "left") - np.arange(len(sent))
    late[received > sent[-1]] = D + 1  # arrives after the recording
    return sent, np.stack([east, north], axis=1), np.minimum(late, D + 1).astype(np.int32)


def records() -> dict[str, Record]:
    """Both recordings at one length, so that they share compiled programs; the longer one's first half is learnt on."""
    loaded = {name: load(name) for name in (LEARN, TRANSFER)}
    T = max(len(t) for t, _, _ in loaded.values())
    rng = np.random.default_rng(NOISE_SEED)
    found = {}
    for name, (t, position, delays) in loaded.items():
        n, more = len(t), T - len(t)
        interval = np.median(np.diff(t))
        t = np.concatenate([t, t[-1] + interval * np.arange(1, more + 1)])
        position = np.pad(position, ((0, more), (0, 0)))
        first = t[half(n)] if name == LEARN else START
        scored = (t >= first) & (np.arange(T) < n)
        block = ((t - first) // BLOCK).astype(int)
        packets = position + SIGMA * rng.standard_normal(position.shape)
        delays = np.pad(delays, (0, more), constant_values=D + 1)
        found[name] = Record(name, t, position, packets, delays, scored, block)
    return found


def half(n: int) -> int:
    """The first sample of the second half."""
    return n // 2


def intervals(t: np.ndarray) -> np.ndarray:
    """(T,) the actual intervals between sending times; the first is not used: the prior is at the first sample."""
    return np.diff(t, prepend=t[0] - np.median(np.diff(t)))


def shuffled(record: Record, rng: np.random.Generator) -> np.ndarray:
    """The delays with their order lost in the scored part: the same frequencies, no bursts."""
    delays = record.delays.copy()
    delays[record.scored] = rng.permutation(delays[record.scored])
    return delays


def _nothing(r: jf.simulate.Received) -> tuple:
    return r.ys, None


def _arrivals(r: jf.simulate.Received) -> tuple:
    return r.ys, r.mask


def _stamps(r: jf.simulate.Received) -> tuple:
    given = jf.lag_inputs(r.ys, r.lag, D)
    return given["ys"], given["mask"]


def _packets(r: jf.simulate.Received) -> tuple:
    return r.packets, r.arrived


TOLD: dict[str, Callable[[jf.simulate.Received], tuple]] = {
    "nothing": _nothing,
    "arrivals": _arrivals,
    "stamps": _stamps,
    "packets": _packets,
}


def given(packets: np.ndarray, delays: np.ndarray, told: str) -> Given:
    """What arrives, with as much as a filter is told about it."""
    ys, mask = TOLD[told](jf.simulate.deliver(jnp.asarray(packets), jnp.asarray(delays), D))
    return Given(np.asarray(ys), None if mask is None else np.asarray(mask))


def bursts(late: np.ndarray) -> np.ndarray:
    """Lengths of the runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], late, [False]]).astype(int)))
    return edges[1::2] - edges[::2]
