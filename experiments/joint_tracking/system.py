"""The target, its radar and the filters: two classes of aircraft, each with five modes of motion.

Class 1 is the low-manoeuvre one and class 2 the high-manoeuvre one; in code they are 0 and 1.
"""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from jaxfilt.models.sensors import wrap
from jaxfilt.models.turn import arc

CLASSES = ("low-manoeuvre", "high-manoeuvre")
MODES = ("straight", "faster", "slower", "left", "right")
SPEEDS = ((100.0, 300.0), (150.0, 650.0))  # m/s, the range of each class
DURATION = 20.0  # s
SPREAD = 0.3  # rad, the prior's half range of headings
HEADING = 0.5  # rad


class Config(NamedTuple):
    """A set-up; pairs are by class."""

    dt: Any = 0.1  # s
    accel: Any = (5.0, 20.0)  # m/s^2 along the course
    omega: Any = (0.05, 0.2)  # rad/s
    sigma_w: Any = (1.0, 3.0)  # m/s^2
    dwell: Any = 2.0  # s, the mean time in a mode
    sigma_r: Any = 10.0  # m
    sigma_theta: Any = 2e-3  # rad
    gamma: Any = 0.1  # exponent of the speed score in each step


DEMO = Config()
# The published values; a dwell of 0.0196 s is 0.6 on the diagonal of the transition matrix.
PAPER = Config(
    dt=0.01, omega=(0.5, 1.0), sigma_w=(5.0, 10.0), dwell=-0.01 / np.log(0.6), sigma_r=0.001**0.5,
    sigma_theta=0.001**0.5, gamma=1.0,
)  # fmt: skip


class Data(NamedTuple):
    """Runs on one path."""

    truth: Array  # (T, 4) [x, y, vx, vy]
    first: Array  # (runs, 2) the measurement at the start, which the prior is made of
    ys: Array  # (runs, T, 2) range [m] and bearing [rad]
    keys: Array  # (runs,)


class _Mode(NamedTuple):
    arc: Any  # (4,) of the turn in one step
    accel: Any
    dt: Any


def turn_matrix(arc4: Array) -> Array:
    """(4, 4) of a turn for the state [x, y, vx, vy]; its argument is ``jnp.stack(arc(omega, dt))``."""
    s, c, cos, sin = arc4
    one, zero = jnp.ones_like(s), jnp.zeros_like(s)
    rows = [[one, zero, s, c], [zero, one, -c, s], [zero, zero, cos, -sin], [zero, zero, sin, cos]]
    return jnp.stack([jnp.stack(row) for row in rows])


def move(mode: _Mode, x: Array, u: Any, dt: Any) -> Array:
    """One step: a turn by ``mode.arc``, and ``mode.accel`` along the velocity before it."""
    del u, dt
    px, py, vx, vy = x
    s, c, cos, sin = mode.arc
    push = mode.accel * mode.dt / jnp.sqrt(vx * vx + vy * vy + 1e-6)
    half = 0.5 * mode.dt * push
    return jnp.stack([
        px + s * vx + c * vy + half * vx, py - c * vx + s * vy + half * vy,
        cos * vx - sin * vy + push * vx, sin * vx + cos * vy + push * vy,
    ])  # fmt: skip


def start(first: Array, config: Config, key: Array, classes: Array, inp: Any) -> Array:
    """Draws (N, 4) from the prior: position about the first measurement, speed and heading uniform."""
    del inp
    kr, kb, ks, kh = jax.random.split(key, 4)
    N = classes.shape
    r = first[0] + config.sigma_r * jax.random.normal(kr, N, first.dtype)
    b = first[1] + config.sigma_theta * jax.random.normal(kb, N, first.dtype)
    low, high = jnp.asarray(SPEEDS, first.dtype)[classes].T
    speed = low + (high - low) * jax.random.uniform(ks, N, first.dtype)
    heading = HEADING + SPREAD * jax.random.uniform(kh, N, first.dtype, -1.0, 1.0)
    return jnp.stack([r * jnp.cos(b), r * jnp.sin(b), speed * jnp.cos(heading), speed * jnp.sin(heading)], axis=1)


def start_moments(first: Array, config: Config, c: int) -> tuple[Array, Array]:
    """Mean (4,) and covariance (4, 4) of :func:`start` for a class, for filters that start from a Gaussian."""
    r, b = first
    along = jnp.stack([jnp.cos(b), jnp.sin(b)])
    across = jnp.stack([-jnp.sin(b), jnp.cos(b)])
    position = config.sigma_r**2 * jnp.outer(along, along)
    position = position + (r * config.sigma_theta) ** 2 * jnp.outer(across, across)
    low, high = SPEEDS[c]
    speed, square = (low + high) / 2, (low**2 + low * high + high**2) / 3
    one, two = np.sin(SPREAD) / SPREAD, np.sin(2 * SPREAD) / (2 * SPREAD)  # how much of a mean a spread leaves
    mean = speed * one * np.array([np.cos(HEADING), np.sin(HEADING)])
    cos2, sin2 = two * np.cos(2 * HEADING), two * np.sin(2 * HEADING)
    velocity = square / 2 * np.array([[1 + cos2, sin2], [sin2, 1 - cos2]]) - np.outer(mean, mean)
    zeros = jnp.zeros((2, 2), first.dtype)
    cov = jnp.block([[position, zeros], [zeros, jnp.asarray(velocity, first.dtype)]])
    return jnp.concatenate([r * along, jnp.asarray(mean, first.dtype)]), (cov + cov.T) / 2


def models(config: Config, first: Array, c: int) -> list[jf.models.Nonlinear]:
    """The five modes of a class, built alike."""
    dtype = first.dtype
    dt, a, w = (jnp.asarray(x, dtype) for x in (config.dt, config.accel[c], config.omega[c]))
    eye = jnp.eye(2, dtype=dtype)
    G = jnp.concatenate([0.5 * dt**2 * eye, dt * eye])
    Q = jnp.asarray(config.sigma_w[c], dtype) ** 2 * (G @ G.T)
    R = jnp.diag(jnp.stack([jnp.asarray(s, dtype) ** 2 for s in (config.sigma_r, config.sigma_theta)]))
    m0, P0 = start_moments(first, config, c)
    sensor = jf.models.sensors.range_bearing(R)
    zero = jnp.zeros((), dtype)
    found = []
    for accel, omega in ((zero, zero), (a, zero), (-a, zero), (zero, w), (zero, -w)):
        f = Partial(move, _Mode(jnp.stack(arc(omega, dt)), accel, dt))
        found.append(jf.models.nonlinear(f, sensor.h, Q, R, m0, P0, residual=residual))
    return found


def residual(y: Array, predicted: Array) -> Array:
    """The difference of two measurements, its bearing wrapped to [-pi, pi]."""
    d = y - predicted
    return jnp.stack([d[0], wrap(d[1])])


def transition(config: Config) -> Array:
    """(5, 5) of a mean dwell time; from a mode to each other one alike."""
    stay = jnp.exp(-jnp.asarray(config.dt) / config.dwell)
    off = (1 - stay) / 4
    return off * jnp.ones((5, 5)) + (stay - off) * jnp.eye(5)


def log_speed_score(v: Array, c: Array) -> Array:
    """log g of a speed [m/s] for a class: 0.8 falling to 0.1, or 0.1 rising to 0.95."""
    low = jnp.clip(0.8 - 0.0035 * (v - 100), 0.1, 0.8)
    high = jnp.clip(0.1 + 0.0017 * (v - 150), 0.1, 0.95)
    return jnp.log(jnp.where(c == 0, low, high))


def speed_score(gamma: Any, x: Array, c: Array) -> Array:
    """The potential of a state for a class."""
    return gamma * log_speed_score(jnp.sqrt(x[2] * x[2] + x[3] * x[3] + 1e-6), c)


def single(static: jf.Static, floor: Any, config: Config, first: Array) -> jf.Filter:
    """The single filter over state, class and mode; ``static`` is (particles,)."""
    return jf.joint_particle(
        [models(config, first, c) for c in (0, 1)], transition(config), static.value[0], floor=floor,
        score=Partial(speed_score, config.gamma), start=Partial(start, first, config), noise_rank=2,
        score_gradient=False,
    )  # fmt: skip


def _own_score(gamma: Any, number: Array, x: Array, c: Array) -> Array:
    return speed_score(gamma, x, c + number)


def multi(static: jf.Static, config: Config, first: Array) -> jf.Filter:
    """The reference: one multi-mode particle filter for each class; ``static`` is (particles of each,)."""
    return jf.bank([
        jf.multi_mode_particle(
            models(config, first, c), transition(config), static.value[0], noise_rank=2,
            score=Partial(_own_score, config.gamma, jnp.int32(c)),
            start=Partial(_class_start, first, config, jnp.int32(c)),
            score_gradient=False,
        )
        for c in (0, 1)
    ])  # fmt: skip


def _class_start(first: Array, config: Config, c: Array, key: Array, classes: Array, inp: Any) -> Array:
    return start(first, config, key, classes + c, inp)


def imm_bank(config: Config, first: Array) -> jf.Filter:
    """No particles: one IMM of five extended Kalman filters for each class."""
    pi = transition(config)
    filters = [jf.imm([jf.extended(m) for m in models(config, first, c)], pi) for c in (0, 1)]
    return jf.bank(filters, score=Partial(speed_score, config.gamma))


class _Printed(NamedTuple):
    inner: jf.Filter


def printed(static: jf.Static, floor: Any, config: Config, first: Array) -> jf.Filter:
    """The recursion as it is printed.

    It sums weights over a class's particles, whose number follows its probability, and multiplies by that again.
    """
    inner = jf.joint_particle(
        [models(config, first, c) for c in (0, 1)], transition(config), static.value[0], floor=floor, threshold=1.0,
        score=Partial(speed_score, config.gamma), start=Partial(start, first, config), noise_rank=2,
        score_gradient=False,
    )  # fmt: skip
    return as_printed(inner)


def as_printed(joint: jf.Filter) -> jf.Filter:
    """A joint filter that resamples in every step, with the printed class probabilities."""
    return jf.wrap(_Printed(joint), update=_printed_update)


def _printed_update(p, s, inp):
    inner, info = p.inner.update(s.inner, inp)
    log_p = jax.nn.log_softmax(inner.log_classes + jnp.log(inner.counts.astype(inner.log_classes.dtype)))
    log_p = jnp.maximum(log_p, -1e6)
    extra = {**info.extra, "log_probabilities": log_p}
    return s._replace(inner=inner._replace(log_classes=log_p)), info._replace(
        mean=jnp.exp(log_p) @ info.extra["means"], extra=extra
    )


# ---------------------------------------------------------------------------------------------------------------- runs

# (seconds, acceleration along the course, turn rate), noise-free
PATHS = (
    ((4.0, 0.0, 0.0), (5.0, 5.0, 0.0), (4.0, 0.0, 0.0), (4.0, 0.0, 0.05), (3.0, 0.0, 0.0)),
    ((4.0, 0.0, 0.0), (10.0, 20.0, 0.0), (3.0, 0.0, 0.0), (3.0, 0.0, 0.2)),
)


def path(c: int, dt: float) -> np.ndarray:
    """(T + 1, 4) the true path of a class, from (3, 4) km at 200 m/s."""
    x = np.array([3000.0, 4000.0, 200 * np.cos(HEADING), 200 * np.sin(HEADING)])
    states = [x]
    for seconds, accel, omega in PATHS[c]:
        for _ in range(round(seconds / dt)):
            u = omega * dt
            s, q = (np.sin(u) / omega, (np.cos(u) - 1) / omega) if omega else (dt, 0.0)
            F = np.array([[1, 0, s, q], [0, 1, -q, s], [0, 0, np.cos(u), -np.sin(u)], [0, 0, np.sin(u), np.cos(u)]])
            a = accel * x[2:] / np.hypot(*x[2:])
            x = F @ x + np.concatenate([dt**2 / 2 * a, dt * a])
            states.append(x)
    return np.array(states)


def measure(states: Array, config: Config, key: Array) -> Array:
    """(T, 2) range and bearing with fresh noise."""
    z = jnp.stack([jnp.hypot(states[:, 0], states[:, 1]), jnp.arctan2(states[:, 1], states[:, 0])], axis=1)
    scale = jnp.stack([jnp.asarray(s, states.dtype) for s in (config.sigma_r, config.sigma_theta)])
    return z + scale[None, :] * jax.random.normal(key, z.shape, z.dtype)


def simulate(config: Config, c: int, runs: int, key: Array) -> Data:
    """Runs on the path of a class. Data and filter keys of run i depend on the key and i only."""
    states = jnp.asarray(path(c, float(config.dt)))
    keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.fold_in(key, c), jnp.arange(runs))
    ys = jax.vmap(lambda k: measure(states, config, jax.random.fold_in(k, 0)))(keys)
    return Data(states[1:], ys[:, 0], ys[:, 1:], jax.vmap(lambda k: jax.random.fold_in(k, 1))(keys))


def check(config: Config) -> None:
    """Raises a ValueError for noise that is not positive; warns where a linearised filter cannot work."""
    for name in ("sigma_r", "sigma_theta", "sigma_w"):
        x = np.asarray(getattr(config, name), float)
        if not (x >= 0).all() or (name != "sigma_w" and not (x > 0).all()):
            raise ValueError(f"{name}: expected a positive number, got {x}")
    if not np.asarray(config.sigma_w, float).all():
        warnings.warn("sigma_w: without noise particles that are drawn again stay copies of each other", stacklevel=2)
    bend = 5000.0 * float(config.sigma_theta) ** 2
    if bend > 0.5 * float(config.sigma_r):
        warnings.warn(f"a range of 5 km bends the bearing's error by {bend:.3g} m, which linearised filters do not see",
                      stacklevel=2)  # fmt: skip
