"""The attitude EKF on a thousand recordings: one vmap, a loop over runs, and NumPy.

python -m experiments.benchmarks.attitude
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxfilt as jf
from experiments.report import Cell, Entry, Table

RUNS, SECONDS, RATE = 1000, 60.0, 100.0  # recordings, their length, samples per second
LOOP_RUNS, NUMPY_RUNS = 20, 2  # of which the slow ways are timed; their time for all runs is scaled up
G = 9.81


def recordings(runs: int, steps: int, key: Array) -> tuple[Array, Array]:
    """Gyro and accelerometer (runs, T, 3) of a body that rocks about two axes and trembles, each run by itself."""
    return jax.lax.map(lambda k: _recording(k, steps), jax.random.split(key, runs))


def _recording(key, steps):
    keys = jax.random.split(key, 3)
    t = jnp.arange(steps + 1, dtype=float) / RATE
    phase = jax.random.uniform(keys[0], (4,), maxval=2 * np.pi)
    ramp = jnp.clip(t - 1.0, 0.0, 1.0)
    roll = ramp * (0.4 * jnp.sin(0.6 * t + phase[0]) + 0.2 * jnp.sin(1.4 * t + phase[1]))
    pitch = ramp * (0.35 * jnp.sin(0.8 * t + phase[2]) + 0.2 * jnp.sin(9.0 * t + phase[3]))
    shake = 0.5 * ramp[:, None] * jax.random.normal(keys[1], (steps + 1, 3))
    run = jf.simulate.imu(
        jf.simulate.euler_attitude(roll, pitch, jnp.zeros_like(t)), shake, keys[2], dt=1 / RATE, bias_walk=1e-6
    )
    return run.gyr[:steps], run.acc[:steps]


def _mean(state: Any, info: jf.Info) -> Array:
    del state
    return info.mean


def one_run(filt: jf.Filter, gyr: Array, acc: Array) -> tuple[Array, Array]:
    """Means (T, 6) and the final covariance (6, 6): a whole history of covariances would be 6 times the data."""
    inputs = jf.inputs(acc, u=gyr)
    state, means = jf.scan(filt, filt.init(jax.tree.map(lambda x: x[0], inputs)), inputs, outputs=_mean)
    return means, state.cov


single = jax.jit(one_run)
batched = jax.jit(jax.vmap(one_run, (None, 0, 0)))


def numpy_run(gyr: np.ndarray, acc: np.ndarray, dt: float, kappa: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """The same filter in plain NumPy, written as one would from the paper's equations."""

    def skew(v):
        return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])

    eye, H = np.eye(3), np.hstack([G * np.eye(3), np.zeros((3, 3))])
    Z, b, a = acc[0] / np.linalg.norm(acc[0]), np.zeros(3), np.zeros(3)
    P = np.diag([1e-2] * 3 + [1e-4] * 3)
    means = np.empty((len(acc), 6))
    for k in range(len(acc)):
        w = -dt * (gyr[k] - b)
        angle = np.sqrt(w @ w)
        W = skew(w)
        first, second = (np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2) if angle else (1.0, 0.5)
        F = eye + first * W + second * W @ W
        Phi, Q = np.eye(6), np.zeros((6, 6))
        Phi[:3, :3], Phi[:3, 3:] = F, -dt * skew(Z)
        Q[:3, :3] = 1e-6 * Phi[:3, 3:] @ Phi[:3, 3:].T
        Q[3:, 3:] = 1e-8 * dt**2 * eye
        Z, P = F @ Z, Phi @ P @ Phi.T + Q
        R = 1e-4 + kappa**2 * (a @ a) / 3
        K = np.linalg.solve(H @ P @ H.T + R * eye, H @ P).T
        x = np.concatenate([Z, b]) + K @ (acc[k] - kappa * a - G * Z)
        rest = np.eye(6) - K @ H
        P = rest @ P @ rest.T + R * K @ K.T
        P = (P + P.T) / 2
        Z, b = x[:3] / np.linalg.norm(x[:3]), x[3:]
        a = acc[k] - G * Z
        means[k, :3], means[k, 3:] = Z, b
    return means, P


def _seconds(function: Callable[[], Any], repeats: int) -> float:
    """The shortest of several."""
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - begun)
    return min(times)


def measure(runs: int = RUNS, seconds: float = SECONDS, repeats: int = 3) -> Table:
    """Times of the three ways, and by how much they differ in what they find."""
    steps = round(seconds * RATE)
    gyr, acc = jax.jit(recordings, static_argnums=(0, 1))(runs, steps, jax.random.key(0))
    filt = jf.attitude(dt=1 / RATE, kappa=0.1)
    loop, naive = min(LOOP_RUNS, runs), min(NUMPY_RUNS, runs)

    def looped():
        return [single(filt, gyr[i], acc[i]) for i in range(loop)]

    begun = time.perf_counter()
    means, covs = jax.block_until_ready(batched(filt, gyr, acc))
    first = time.perf_counter() - begun
    begun = time.perf_counter()
    apart = jax.block_until_ready(single(filt, gyr[0], acc[0]))
    first_single = time.perf_counter() - begun
    by_hand = [numpy_run(np.asarray(gyr[i]), np.asarray(acc[i]), 1 / RATE) for i in range(naive)]
    differ = [
        max(float(jnp.abs(apart[0] - means[0]).max()), float(jnp.abs(apart[1] - covs[0]).max())),
        max(float(np.abs(np.asarray(means[i]) - by_hand[i][0]).max()) for i in range(naive)),
    ]
    times = [
        _seconds(lambda: batched(filt, gyr, acc), repeats),
        _seconds(looped, repeats) * runs / loop,
        _seconds(lambda: [numpy_run(np.asarray(gyr[i]), np.asarray(acc[i]), 1 / RATE) for i in range(naive)], 1)
        * runs
        / naive,
    ]
    names = ("jaxfilt, one vmap", "jaxfilt, loop over runs of the jitted filter", "NumPy, loop over runs and steps")
    timed = (runs, loop, naive)
    rows: list[list[Entry]] = []
    for i, (name, spent) in enumerate(zip(names, times, strict=True)):
        extra: Entry = "-" if i == 2 else (first, first_single)[i] - (times[0] if i == 0 else times[1] / runs)
        row: list[Entry] = [
            name,
            f"{timed[i]}",
            Cell(spent),
            Cell(1e6 * spent / (runs * steps)),
            Cell(spent / times[0]),
        ]
        rows.append([*row, extra, "-" if i == 0 else f"{differ[i - 1]:.0e}"])
    header = ["way", "runs timed", "all runs [s]", "per run and step [µs]", "times one vmap", "compilation [s]",
              "largest difference"]  # fmt: skip
    note = (
        f"{runs} recordings of {seconds:g} s at {RATE:g} Hz through the paper's filter, means and the final covariance "
        f"kept; float64, shortest of {repeats}. Where fewer runs were timed, the time is scaled up. Difference: from "
        "one vmap, in the means (and final covariance)."
    )
    return Table("attitude_batch", "A batch of recordings", header, rows, note)


def main() -> None:
    """Prints the table."""
    jax.config.update("jax_enable_x64", True)
    table = measure()
    print(f"{table.title}\n\n{table.text('simple')}\n\n{table.note}")


if __name__ == "__main__":
    main()
