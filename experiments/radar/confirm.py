"""Which of the tracks are real: confirmed by M of N, duplicates merged. Looks at detections, never at the truth."""

from __future__ import annotations

import numpy as np

from experiments.radar.scans import Tracks

M, N = 9, 18  # confirmed: updated in M of the first N radar scans, that is half of half a minute
MOVING = 1.0  # m/s, between the start and the N-th radar scan: what is slower is no boat under way


def confirmed(choice: np.ndarray) -> np.ndarray:
    """(B,) bool for tracks updated by radar alone; choice (B, T) is the detection taken in each scan, -1 = none."""
    return (choice[:, :N] >= 0).sum(axis=1) >= M


def moving(tracks: Tracks, position: np.ndarray) -> np.ndarray:
    """(B,) bool; position (B, T, 2) estimated by radar alone."""
    last = np.minimum(N, tracks.mask.sum(axis=1)) - 1
    rows = np.arange(len(last))
    elapsed = tracks.t[rows, last] - tracks.t_second
    return np.linalg.norm(position[rows, last] - tracks.second, axis=1) > MOVING * elapsed


def merged(tracks: Tracks, choice: np.ndarray, log_lik: np.ndarray) -> np.ndarray:
    """Indices of the tracks that are left when of those that share most of their detections the best is kept.

    Only tracks that begin with the same scan are compared. The best has the most updates, then the highest likelihood.
    """
    kept: list[int] = []
    updates = (choice >= 0).sum(axis=1)
    for i in np.lexsort((-log_lik.sum(axis=1), -updates)):
        same = [j for j in kept if tracks.scenario[j] == tracks.scenario[i] and tracks.scan[j] == tracks.scan[i]]
        shared = [((choice[i] == choice[j]) & (choice[i] >= 0)).sum() for j in same]
        if all(2 * count <= updates[i] for count in shared):
            kept.append(int(i))
    return np.sort(np.array(kept, int))
