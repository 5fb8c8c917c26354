"""The two tests of the paper as simulated motions: A, rotation by hand; B, a sensor slid over a table."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.simulate import Imu, euler_attitude, imu

DT, FINE = 0.01, 10  # s between samples; attitudes per sample
DURATION = {"A": 50.0, "B": 130.0}  # s
SLOW, FAST = (2.0, 25.0), (25.0, 40.5)  # s, the windows of test A
LEVER = (0.01, 0.02, 0.05)  # m
# Table 2 of the paper: peak accelerations of the linear and of the zigzag bursts [m/s^2].
LINEAR, ZIGZAG = (11.12, 12.50, 15.24, 16.28, 18.33, 22.39), (3.21, 5.13, 6.40, 7.23, 8.50, 12.5)
STROKES, STROKE = 12, 0.2  # in a burst; s


class Motion(NamedTuple):
    """What happens to the sensor."""

    attitude: Array  # ((T - 1) FINE + 1, 3, 3) body to earth
    acceleration: Array  # (T, 3) of the body, earth axes
    peaks: Array  # (12,) int32, samples at the bursts' peaks; test B


@partial(jax.jit, static_argnames=("test", "options"))
def draw(key: Array, test: str, options: tuple[tuple[str, Any], ...] = ()) -> tuple[Imu, Array]:
    """One run of a test: readings with their truth, and the samples at the peaks (12,)."""
    motion_key, sensor_key = jax.random.split(key)
    motion = {"A": rotation, "B": sliding}[test](motion_key)
    lever = LEVER if test == "A" else (0.0, 0.0, 0.0)
    run = imu(motion.attitude, motion.acceleration, sensor_key, dt=DT, lever=lever, **dict(options))
    return run, motion.peaks


@partial(jax.jit, static_argnames=("test", "runs", "options"))
def draw_runs(key: Array, test: str, runs: int, options: tuple[tuple[str, Any], ...] = ()) -> tuple[Imu, Array]:
    """Several runs, leading (runs,); run i takes ``fold_in(key, i)``."""
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(runs))
    return jax.lax.map(lambda k: draw(k, test, options), keys)


def rotation(key: Array) -> Motion:
    """Test A: turned slowly, then shaken, by a hand that trembles."""
    count = round(DURATION["A"] / DT)
    t = jnp.arange(count * FINE + 1, dtype=float) * (DT / FINE)
    slow, fast = window(t, *SLOW, 2.0), window(t, *FAST, 1.0)
    keys = jax.random.split(key, 2)
    phases = iter(jax.random.uniform(keys[0], (8,), maxval=2 * np.pi))

    def wave(degrees, hertz):
        return np.deg2rad(degrees) * jnp.sin(2 * np.pi * hertz * t + next(phases))

    roll = slow * (wave(25, 0.10) + wave(12, 0.23)) + fast * wave(14, 2.0)
    pitch = slow * (wave(20, 0.13) + wave(10, 0.29)) + fast * wave(12, 1.7)
    yaw = slow * wave(15, 0.07) + fast * wave(5, 1.6)
    at = t[::FINE]
    tremor = window(at, SLOW[0], FAST[1], 1.0)[:, None] * shaped(keys[1], len(at), 1.5, 0.25)
    return Motion(euler_attitude(roll, pitch, yaw), tremor, jnp.zeros((12,), jnp.int32))


def sliding(key: Array) -> Motion:
    """Test B: twelve bursts of strokes to and fro, roll and pitch zero."""
    count = round(DURATION["B"] / DT)
    at = jnp.arange(count + 1, dtype=float) * DT
    keys = jax.random.split(key, 5)
    bursts = len(LINEAR) + len(ZIGZAG)
    lengths = STROKE * jax.random.uniform(keys[0], (bursts, STROKES), minval=0.9, maxval=1.1)
    begins = 10.0 * np.arange(1.0, bursts + 1)[:, None] + jnp.cumsum(lengths, axis=1) - lengths
    share = jax.random.uniform(keys[1], (bursts, STROKES), minval=0.8).at[:, 6].set(1.0)
    signs = (-1.0) ** np.arange(STROKES)[None, :]
    listed = np.array([*LINEAR, *ZIGZAG])[:, None]
    along = strokes(at, begins, lengths, listed * share * signs)  # (bursts, T)
    # In a zigzag every second stroke has one across it, of double length and alternating sign.
    across_sign = np.where(np.arange(STROKES) % 4 == 0, 1.0, -1.0) * (np.arange(STROKES) % 2 == 0)
    across_sign = across_sign[None, :]
    across = strokes(at, begins, 2 * lengths, 0.5 * np.minimum(16.0, 1.1 * listed) * across_sign)
    linear = np.arange(bursts)[:, None] < len(LINEAR)
    x = jnp.where(linear, along, across).sum(axis=0)
    y = jnp.where(linear, 0.08 * along, along).sum(axis=0)
    ends = begins[:, -1] + lengths[:, -1]
    busy = jax.vmap(lambda a, b: window(at, a, b, 0.1))(begins[:, 0], ends).sum(axis=0)
    z = busy * shaped(keys[2], len(at), 8.0, 0.6)[:, 0]
    acceleration = jnp.stack([x, y, z], axis=1) + 0.02 * jax.random.normal(keys[3], (len(at), 3))

    fine = jnp.arange(count * FINE + 1, dtype=float) * (DT / FINE)
    phase = jax.random.uniform(keys[4], maxval=2 * np.pi)
    yaw = np.deg2rad(2.0) * jnp.sin(2 * np.pi * 2.0 * fine + phase) * jnp.interp(fine, at, busy)
    level = jnp.zeros_like(fine)
    peak = begins[:, 6] + lengths[:, 6] * (0.5 - np.sqrt(1 / 12))
    return Motion(euler_attitude(level, level, yaw), acceleration, jnp.round(peak / DT).astype(jnp.int32))


def window(t: Array, first: Any, last: Any, edge: float) -> Array:
    """1 between first and last, with quintic edges inside."""
    x = jnp.clip(jnp.minimum(t - first, last - t) / edge, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def strokes(t: Array, begins: Any, lengths: Any, peaks: Any) -> Array:
    """Accelerations (bursts, T) that move a body from rest to rest, each stroke with the given peak."""

    def add(total, stroke):
        begin, length, peak = stroke
        s = (t[None, :] - begin[:, None]) / length[:, None]
        a = peak[:, None] * (60 * s - 180 * s**2 + 120 * s**3) / 5.7735
        return total + jnp.where((s > 0) & (s < 1), a, 0.0), None

    columns = jax.tree.map(lambda x: jnp.swapaxes(jnp.broadcast_to(x, begins.shape), 0, 1), (begins, lengths, peaks))
    return jax.lax.scan(add, jnp.zeros((len(begins), len(t))), columns)[0]


def shaped(key: Array, count: int, corner: float, rms: float) -> Array:
    """Noise (count, 3) with the spectrum ``(f/f0) / (1 + (f/f0)^2)^1.5`` and the given rms per axis."""
    spectrum = jnp.fft.rfft(jax.random.normal(key, (count, 3)), axis=0)
    f = np.fft.rfftfreq(count, DT)[:, None] / corner
    noise = jnp.fft.irfft(spectrum * (f / (1 + f**2) ** 1.5).astype(complex), count, axis=0)
    return rms * noise / jnp.sqrt(jnp.mean(noise**2, axis=0, keepdims=True))
