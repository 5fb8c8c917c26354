"""The three scenarios: who goes where, what is heard, and where the filters start."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxfilt as jf

KNOT = 1852 / 3600  # m/s
STEPS, CONVERGED = 2000, 1000  # s
SOUND, TONE = 1500.0, 500.0  # m/s, Hz
NOISE = (np.radians(2.0), 0.3)  # rad, Hz
START_ERROR = 500.0  # m per axis, of the start "near"
P_NEAR = (1000.0, 1000.0, 8.0, 8.0, 3.0)  # m, m/s, Hz: what the filter believes of it
RAY = (10_000.0, 3000.0)  # m: range of the start "ray", and its standard deviation along the ray
P_REST = (8.0, 8.0, 3.0)  # m/s, Hz
SIGMA = (1e-4, 1e-4)  # m/s^2, Hz: process noise
SCENARIOS = ("approaching", "receding", "manoeuvring")
# observer's and target's course [deg, counter-clockwise from east], and the observer's turn rate [deg/s]
COURSES = {"approaching": (20.0, 260.0, 0.0), "receding": (70.0, 170.0, 0.0), "manoeuvring": (0.0, 250.0, 0.06)}


class Geometry(NamedTuple):
    """True paths, start included."""

    observer: Array  # (..., T + 1, 4)
    target: Array  # (..., T + 1, 5)


class Runs(NamedTuple):
    """What the filters are given of a run."""

    first: Array  # (..., 2) the measurement at 0 s, which only the start uses
    ys: Array  # (..., T, 2) the measurements from 1 s on
    m0: Array  # (..., 5)
    P0: Array  # (..., 5, 5)


def geometry(scenario: str, turn: tuple[float, float, float] | None = None) -> Geometry:
    """The paths of a scenario; ``turn``: the target turns by (rate [deg/s], from, to [s])."""
    own, other, rate = COURSES[scenario]
    t = np.arange(STEPS + 1)
    observer = _path(np.zeros(2), 5 * KNOT, np.radians(own + rate * t))
    course = np.full(STEPS + 1, np.radians(other))
    if turn is not None:
        course += np.radians(turn[0]) * np.clip(t - turn[1], 0, turn[2] - turn[1])
    target = _path(np.full(2, 6000.0), 15 * KNOT, course)
    return Geometry(jnp.asarray(observer), jnp.asarray(np.column_stack([target, np.full(STEPS + 1, TONE)])))


def _path(start, speed, course):
    velocity = speed * np.column_stack([np.cos(course), np.sin(course)])
    return np.column_stack([start + np.vstack([np.zeros(2), velocity[:-1].cumsum(0)]), velocity])


def geometries() -> Geometry:
    """All three, side by side."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(geometry, SCENARIOS))


def own_place(u: Array, dt: Any) -> Array:
    """The sensor's observer: what is in ``u``."""
    del dt
    return u


def covariance_r(noise: Any = NOISE) -> Array:
    """R of standard deviations of bearing [rad] and frequency [Hz]."""
    return jnp.diag(jnp.square(jnp.asarray(noise)))


def model(m0: Any, P0: Any, R: Any = None, sigma: Any = SIGMA, doppler: str = "first") -> jf.models.Nonlinear:
    """Constant velocity and tone, heard by compass bearing and frequency; one second a step."""
    F = jnp.eye(5).at[0, 2].set(1.0).at[1, 3].set(1.0)
    G = jnp.array([[0.5, 0.0], [0.0, 0.5], [1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    tone = jnp.zeros((5, 5)).at[4, 4].set(1.0)
    Q = sigma[0] ** 2 * G @ G.T + sigma[1] ** 2 * tone
    R = covariance_r() if R is None else R
    motion = jf.models.linear_gaussian(F, jnp.eye(2, 5), Q, R, m0, P0)
    heard = jf.models.sensors.bearing_doppler(R, speed=SOUND, observer=own_place, compass=True, doppler=doppler)
    return jf.models.with_sensor(motion, heard)


def measured(paths: Geometry) -> Array:
    """(T + 1, 2) noise-free measurements of one scenario."""
    h = model(jnp.zeros(5), jnp.eye(5)).h
    return jax.vmap(lambda x, o: h(x, o, None))(paths.target, paths.observer)


@partial(jax.jit, static_argnames=("runs", "start"))
def draw(paths: Geometry, key: Array, runs: int, start: str = "near") -> Runs:
    """``runs`` runs of one scenario: measurement noise, and the start that it or a draw gives."""
    noise_key, error_key = jax.random.split(key)
    noise = jax.random.normal(noise_key, (runs, STEPS + 1, 2)) * jnp.asarray(NOISE)[None, None]
    ys = measured(paths)[None] + noise
    ys = ys.at[..., 0].set(jf.models.sensors.wrap(ys[..., 0]))
    first = ys[:, 0]
    if start == "near":
        place = paths.target[0, :2][None] + START_ERROR * jax.random.normal(error_key, (runs, 2))
        P = jnp.broadcast_to(jnp.diag(jnp.square(jnp.asarray(P_NEAR))), (runs, 5, 5))
    else:
        place, P = jax.vmap(ray)(first[:, 0], jnp.broadcast_to(paths.observer[0, :2], (runs, 2)))
    m0 = jnp.concatenate([place, jnp.zeros((runs, 2)), first[:, 1:]], axis=1)
    return Runs(first, ys[:, 1:], m0, P)


def ray(bearing: Array, observer: Array) -> tuple[Array, Array]:
    """A place on a compass bearing at a guessed range, and P(0) of the state."""
    along = jnp.stack([jnp.sin(bearing), jnp.cos(bearing)])
    across = jnp.stack([along[1], -along[0]])
    reach, spread = RAY
    place = spread**2 * jnp.outer(along, along) + (reach * NOISE[0]) ** 2 * jnp.outer(across, across)
    P = jnp.zeros((5, 5)).at[:2, :2].set(place) + jnp.diag(jnp.square(jnp.array([0.0, 0.0, *P_REST])))
    return observer + reach * along, P


@partial(jax.jit, static_argnames=("runs", "start"))
def draw_all(paths: Geometry, key: Array, runs: int, start: str = "near") -> Runs:
    """The same of all scenarios: (3, runs, ...)."""
    return jax.vmap(lambda p, k: draw(p, k, runs, start))(paths, jax.random.split(key, len(SCENARIOS)))


def start_cov() -> np.ndarray:
    """(5, 5) the covariance by which the start "near" is off, as the bound takes it.

    The position's is what is drawn. Velocity and tone are not drawn but set (to 0, and to what is heard first), so the
    filter's own P(0) stands for what is known of them.
    """
    return np.diag(np.square([START_ERROR, START_ERROR, *P_NEAR[2:]]))


def bounds(paths: Geometry, P0: Any = None) -> jf.metrics.Bound:
    """The bound of one scenario's noise-free motion, (T, 5, 5), with the start error that is drawn."""
    P0 = start_cov() if P0 is None else P0
    # Q = 0: the motion that is simulated has no process noise.
    still = model(paths.target[0], jnp.asarray(P0), sigma=(0.0, 0.0))
    return jf.metrics.posterior_bound(still, paths.target, P0=P0, u=paths.observer[1:])


def bound_variances(cov: Array, paths: Geometry) -> dict[str, Array]:
    """The bound (T, 5, 5) for each quantity of the tables, as a variance (T,); angles in deg^2."""
    states, own = paths.target[1:], paths.observer[1:]
    degrees = (180 / np.pi) ** 2

    def of(fn):
        J = jax.vmap(jax.grad(fn))(states, own)
        return jnp.einsum("ti,tij,tj->t", J, cov, J)

    h = model(jnp.zeros(5), jnp.eye(5)).h
    return {
        "position": cov[:, 0, 0] + cov[:, 1, 1],
        "speed": of(lambda x, o: jnp.hypot(x[2], x[3])),
        "course": degrees * of(lambda x, o: jnp.arctan2(x[3], x[2])),
        "base frequency": cov[:, 4, 4],
        "bearing": degrees * of(lambda x, o: h(x, o, None)[0]),
        "received frequency": of(lambda x, o: h(x, o, None)[1]),
    }


def squared_errors(means: Array, paths: Geometry) -> dict[str, Array]:
    """The squared errors (T,) of a run's estimates (T, 5), alike."""
    states, own = paths.target[1:], paths.observer[1:]
    h = jax.vmap(model(jnp.zeros(5), jnp.eye(5)).h, (0, 0, None))
    degrees = (180 / np.pi) ** 2

    def angle(a, b):
        return degrees * jf.models.sensors.wrap(a - b) ** 2

    def course(x):
        return jnp.arctan2(x[:, 3], x[:, 2])

    heard, true = h(means, own, None), h(states, own, None)
    return {
        "position": jnp.sum((means - states)[:, :2] ** 2, axis=1),
        "speed": (jnp.hypot(means[:, 2], means[:, 3]) - jnp.hypot(states[:, 2], states[:, 3])) ** 2,
        "course": angle(course(means), course(states)),
        "base frequency": (means[:, 4] - states[:, 4]) ** 2,
        "bearing": angle(heard[:, 0], true[:, 0]),
        "received frequency": (heard[:, 1] - true[:, 1]) ** 2,
    }
