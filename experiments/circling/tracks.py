"""The flights as the filters see them: pieces without a gap, windows around gaps, estimates and their scores."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

import jaxfilt as jf
from experiments import planar
from experiments.lost_target.flight_gaps import CIRCLING, NAIVE, Flight, Windows, naive

WARMUP = 10  # fixes of a piece that are not scored: until then the prior matters
BLOCK = 60.0  # s: one-step errors are resampled in blocks of this length
# Nothing is known about the beginning but its place. The turn rate may be that of a tight circle, 20 s long.
START = planar.Start(np.zeros(4), np.diag([100.0] * 2 + [2500.0] * 2), acceleration=25.0, turn_rate=0.1)
SCALE = planar.Scale(r=4.0)
SMOOTHED = ", RTS offline"


class Pieces(NamedTuple):
    """Stretches of flights without a gap, padded to a common T at the end."""

    ys: np.ndarray  # (P, T, 2) m, about the first fix
    mask: np.ndarray  # (P, T) bool
    dt: np.ndarray  # (P, T) s
    block: np.ndarray  # (P, T) which block of :data:`BLOCK` seconds a fix is in
    circling: np.ndarray  # (P, T) bool
    flight: np.ndarray  # (P,) index

    @property
    def scored(self) -> np.ndarray:
        """(P, T) bool, without the warm-up."""
        return self.mask & (np.arange(self.mask.shape[1]) >= WARMUP)


class Estimate(NamedTuple):
    """What a filter says at each step, and what its smoother says afterwards."""

    position: Any  # (..., T, 2)
    cov: Any  # (..., T, 2, 2)
    smoothed: Any  # (..., T, 2)
    smoothed_cov: Any  # (..., T, 2, 2)
    innovation: Any  # (..., T, 2) of the prediction from the step before
    nis: Any  # (..., T)
    log_lik: Any  # (..., T)
    probabilities: Any  # (..., T, r) of an IMM's modes, else None


def pieces(flights: Iterable[Flight], T: int) -> Pieces:
    """The flights in pieces of ``T`` fixes or less; a real dropout begins a new piece."""
    rows = []
    blocks = 0
    for index, flight in enumerate(flights):
        steps = np.asarray(jf.intervals(flight.t, first=flight.interval))
        breaks = np.flatnonzero(steps > 10 * flight.interval)
        circling = flight.turn_rate > CIRCLING
        for first, stop in zip([0, *breaks], [*breaks, len(steps)], strict=True):
            for begin in range(first, stop, T):
                part = slice(begin, min(begin + T, stop))
                if part.stop - begin < 2 * WARMUP:
                    continue
                dt = steps[part].copy()
                dt[0] = flight.interval
                block = blocks + ((flight.t[part] - flight.t[begin]) // BLOCK).astype(int)
                blocks = block[-1] + 1
                seen = np.ones(len(dt), bool)
                columns = (flight.position[part] - flight.position[begin], seen, dt, block, circling[part])
                rows.append((*(planar.pad(c, T) for c in columns), index))
    made = Pieces(*(np.array(column) for column in zip(*rows, strict=True)))
    return made._replace(dt=np.where(made.mask, made.dt, 1.0))


def _outputs(state, info: jf.Info):
    del state
    return info


@jax.jit
def estimate(filt: jf.Filter, ys: Array, mask: Array, dt: Array) -> Estimate:
    """All pieces at once. The smoother sees the fixes after a gap too: no competitor, but the bound of what can be."""

    def one(y, mask, dt):
        out = jf.filter(filt, y, mask=mask, dt=dt, outputs=jf.everything, first_update_only=True)
        later = jf.rts(out)
        return Estimate(out.mean[:, :2], out.cov[:, :2, :2], later.mean[:, :2], later.cov[:, :2, :2], out.innovation,
                        out.nis, out.log_lik, out.extra.get("mode_probabilities"))  # fmt: skip

    return jax.vmap(one)(ys, mask, dt)


def estimates(
    params: Mapping[str, Mapping[str, Any]], windows: Windows, whole: Pieces
) -> tuple[dict[str, Estimate], dict[str, Estimate]]:
    """Per filter, and per baseline, what it says about the windows and about the pieces without a gap.

    Both have one length, so each filter is compiled once.
    """
    ys, mask, dt = (np.concatenate(pair) for pair in ((windows.ys, whole.ys), (windows.mask, whole.mask),
                                                      (windows.dt, whole.dt)))  # fmt: skip

    def job(name):
        out = estimate(planar.make(name, params[name], START), ys, mask, dt)
        return jax.tree.map(np.asarray, out)

    found = dict(zip(params, planar.in_parallel(job, list(params)), strict=True))
    for name in NAIVE:
        out = naive(name, ys, mask, dt)
        found[name] = Estimate(out.position, None, None, None, out.innovation, None, None, None)
    cut = len(windows.ys)
    return ({k: jax.tree.map(lambda x: x[:cut], v) for k, v in found.items()},
            {k: jax.tree.map(lambda x: x[cut:], v) for k, v in found.items()})  # fmt: skip
