"""The simulated encoder after demodulation: motion, imperfections of a device, signals."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.sincos import Parameters, signals

CYCLES = 40  # per turn
DT = 1e-3  # [s]
TURN = 8000  # samples of the full turn; then come the two moves
MOVES = (10.0, 3.0)  # [deg], ten hand steps each
STEP, HOLD = 250, 150  # samples
MOVE = HOLD + 10 * (STEP + HOLD)
SAMPLES = TURN + len(MOVES) * MOVE
RADIUS = 18e-3  # mean radius of the electrodes [m]
SETTLED = 200  # samples of the turn that are not scored

# Samples of the reference points: the end of each hold, the first before the first step.
HOLDS = {
    move: TURN + i * MOVE + HOLD - 1 + (STEP + HOLD) * np.arange(11) for i, move in enumerate(MOVES)
}  # fmt: skip


class Ring(NamedTuple):
    """Eccentricity and tilt as complex numbers, the stator's part fixed and the rotor's turning along; each ()."""

    centre_stator: Array  # offset of the centre [m] and its direction
    centre_rotor: Array
    tilt_stator: Array  # relative variation of the gap
    tilt_rotor: Array


class Device(NamedTuple):
    """One device and its noise."""

    parameters: Parameters
    ring: Ring
    noise: Array  # () standard deviation per sample


class Data(NamedTuple):
    """A run, or a stack of them."""

    angle: Array  # (T,) of the shaft [deg]
    ys: Array  # (T, 2)
    device: Device


NOMINAL = Device(
    Parameters(0.015, -0.010, 1.0, 0.03, np.deg2rad(1.2), 0.006, 0.002, 0.003, -0.003),
    Ring(
        jnp.asarray(30e-6 * np.exp(0.3j)), jnp.asarray(20e-6 * np.exp(1.9j)),
        jnp.asarray(0.2 * np.exp(1.2j)), jnp.asarray(0.1 * np.exp(0.4j)),
    ),
    jnp.asarray(1e-3),
)  # fmt: skip


def draw_device(key: Array) -> Device:
    """Plausible imperfections (ours)."""
    normal = jax.random.normal(key, (12,))
    direction = _unit(2 * np.pi * jax.random.uniform(jax.random.fold_in(key, 1), (4,)))
    o_a, o_b, gain, quadrature, h3, h5, h2_a, h2_b = normal[:8] * jnp.asarray(
        [0.015, 0.015, 0.03, np.deg2rad(1.2), 0.006, 0.003, 0.004, 0.004]
    )
    # |G| needs a gap that never closes
    size = jnp.minimum(jnp.abs(normal[8:]) * jnp.asarray([30e-6, 30e-6, 0.2, 0.1]), 0.45)
    parameters = Parameters(o_a, o_b, jnp.ones(()), gain, quadrature, h3, h5, h2_a, h2_b)
    return Device(parameters, Ring(*(jax.lax.complex(size, jnp.zeros_like(size)) * direction)), jnp.asarray(1e-3))


_FIELDS = (*Parameters._fields, "ring")
# What is left in a device when one cause is looked at alone; noise stays.
CAUSES = {
    "all": set(_FIELDS),
    "offset": {"offset_a", "offset_b"},
    "quadrature": {"quadrature"},
    "gain": {"gain"},
    "h3": {"h3"},
    "h2, h5, ring": {"h2_a", "h2_b", "h5", "ring"},
    "ring": {"ring"},
    "noise": set(),
}


def only(device: Device, cause: str) -> Device:
    """The device, or a stack of them, with the imperfections of one cause left."""
    keep = CAUSES[cause] | {"amplitude"}
    parameters = Parameters(*(x if name in keep else 0 * x for name, x in device.parameters._asdict().items()))
    ring = device.ring if "ring" in keep else jax.tree.map(jnp.zeros_like, device.ring)
    return Device(parameters, ring, device.noise)


def quintic(s: Array) -> Array:
    """A smooth step from 0 to 1."""
    return s**3 * (10 - 15 * s + 6 * s * s)


def motion(key: Array) -> Array:
    """(T,) a turn by hand, then two moves of ten unequal steps [deg]."""
    turn, *moves = jax.random.split(key, 1 + len(MOVES))
    amplitude, frequency, phase = jax.random.uniform(turn, (3, 4, 1))
    amplitude, frequency = 0.1 + 0.4 * amplitude, 0.5 + 3.5 * frequency
    t = DT * jnp.arange(TURN, dtype=float)
    s = t / (DT * TURN)
    tremor = (amplitude * jnp.sin(2 * np.pi * (frequency * t[None, :] + phase))).sum(axis=0)
    parts = [360 * quintic(s) + jnp.sin(np.pi * s) ** 2 * tremor]
    ramp = jnp.concatenate([quintic(jnp.arange(1, STEP + 1, dtype=float) / STEP), jnp.ones((HOLD,))])
    start = jnp.asarray(360.0)
    for k, total in zip(moves, MOVES, strict=True):
        sizes = jax.random.uniform(k, (10,), minval=0.5, maxval=1.5)
        sizes = total * sizes / sizes.sum()
        before = start + jnp.cumsum(sizes) - sizes
        parts += [jnp.full((HOLD,), start), (before[:, None] + sizes[:, None] * ramp[None, :]).ravel()]
        start = start + total
    return jnp.concatenate(parts)


def ring_gain(theta_m: Array, ring: Ring, cycles: int = CYCLES, radius: float = RADIUS) -> Array:
    """Complex gain (n,) of the full ring of electrodes at shaft angles (n,) [rad]: mean over 64 azimuths."""
    turning = _unit(theta_m)
    centre = (ring.centre_stator + ring.centre_rotor * turning) / radius
    tilt = ring.tilt_stator + ring.tilt_rotor * turning
    azimuth = _unit(-2 * np.pi / 64 * jnp.arange(64, dtype=theta_m.dtype))[None, :]
    # |z| cos(phi - arg z) and -|z| sin(phi - arg z) are the parts of z e^{-j phi}
    gap = 1 + jnp.real(tilt[:, None] * azimuth)
    shift = -cycles * jnp.imag(centre[:, None] * azimuth)
    return jax.lax.complex(jnp.cos(shift) / gap, jnp.sin(shift) / gap).mean(axis=-1)


def _unit(phase):
    return jax.lax.complex(jnp.cos(phase), jnp.sin(phase))


def measure(angle: Array, device: Device, key: Array) -> Array:
    """(T, 2) demodulated signals at shaft angles (T,) [deg], which begin with a turn."""
    gap, noise = jax.random.split(key)
    T = angle.shape[0]
    knots = 1.0 + 0.05 * jax.random.normal(gap, (T // 2000 + 2,))
    k = jnp.arange(T, dtype=angle.dtype)
    drift = jnp.interp(k, 2000.0 * jnp.arange(knots.shape[0], dtype=float), knots)
    theta_m = jnp.deg2rad(angle)
    coarse = jnp.arange(0, T + 8, 8)  # the gain is smooth: every 8th sample, and interpolated
    G = ring_gain(theta_m[jnp.minimum(coarse, T - 1)], device.ring)
    at = coarse.astype(angle.dtype)
    real, imaginary = jnp.interp(k, at, jnp.real(G)), jnp.interp(k, at, jnp.imag(G))
    parameters = device.parameters._replace(amplitude=device.parameters.amplitude * drift * jnp.hypot(real, imaginary))
    theta = CYCLES * theta_m + jnp.arctan2(imaginary, real)
    return signals(theta, parameters) + device.noise * jax.random.normal(noise, (T, 2))


@jax.jit
def devices(keys: Array) -> Device:
    """A stack of devices drawn from the keys, and the nominal one behind them."""
    drawn = jax.vmap(draw_device)(keys)
    return jax.tree.map(lambda x, y: jnp.concatenate([x, jnp.full((1, *x.shape[1:]), y, x.dtype)]), drawn, NOMINAL)


@jax.jit
def simulate(keys: Array, stack: Device) -> Data:
    """A run of each device: motion and noise from its key."""

    def one(key, device):
        b, c = jax.random.split(key)
        angle = motion(b)
        return Data(angle, measure(angle, device, c), device)

    return jax.vmap(one)(keys, stack)


def draw(runs: int, seed: int, cause: str = "all") -> Data:
    """Runs of that many random devices, and one of the nominal device behind them.

    The same seed gives the same devices, motion and noise for every cause.
    """
    key = jax.random.key(seed)
    keys = jax.random.split(key, runs + 1)
    return simulate(keys, only(devices(keys[:-1]), cause))
