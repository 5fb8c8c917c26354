"""The extended and sigma-point filters on a coordinated turn seen in range and bearing, and scenes for their tests."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

import jaxfilt as jf
from jaxfilt.models.linear import value
from tests import reference
from tests.examples import GAP, Example

STEPS = 10
_TURN = {
    "dt": np.array(0.5),
    "q_omega": np.array(0.01),
    "q": np.array(0.1),
    "r": np.array(1.0),
    "m0": np.array([0.5, -0.3, 1.0, 0.7, 0.2]),
    "P0": np.diag([2.0, 1.5, 0.5, 0.6, 0.05]),
}
_SENSOR = {"R": np.array([[20.0, 0.3], [0.3, 0.5]]), "observer": np.array([-7.0, -5.0])}
_PARAMS = {"motion": _TURN, "sensor": _SENSOR}
_SPREAD = {**_PARAMS, "spread": {"alpha": np.array(0.9), "beta": np.array(2.0), "kappa": np.array(0.4)}}


def model(p):
    """A coordinated turn with a range-bearing sensor: n = 5, m = 2."""
    motion = jf.models.coordinated_turn(**p["motion"])
    return jf.models.with_sensor(motion, jf.models.sensors.range_bearing(**p["sensor"]))


def _extended(p):
    return jf.extended(model(p))


def _extended_second(p):
    return jf.extended(model(p), order=2)


def _sqrt_extended(p):
    return jf.sqrt_extended(model(p), iterations=2)


def _unscented(p):
    return jf.unscented(model(p), **p["spread"])


def _sqrt_unscented(p):
    return jf.sqrt_unscented(model(p), **p["spread"])


def _cubature(p):
    return jf.cubature(model(p))


def _sqrt_cubature(p):
    return jf.sqrt_cubature(model(p))


EXAMPLES: dict[str, Example] = {
    "extended": Example(jf.extended, _extended, _PARAMS, options=GAP),
    "extended_second": Example(jf.extended, _extended_second, _PARAMS, options=GAP, twin=True),
    "sqrt_extended": Example(jf.sqrt_extended, _sqrt_extended, _PARAMS, options=GAP, twin=True),
    "unscented": Example(jf.unscented, _unscented, _SPREAD, options=GAP),
    "sqrt_unscented": Example(jf.sqrt_unscented, _sqrt_unscented, _SPREAD, options=GAP, twin=True),
    "cubature": Example(jf.cubature, _cubature, _PARAMS, options=GAP, twin=True),
    "sqrt_cubature": Example(jf.sqrt_cubature, _sqrt_cubature, _PARAMS, options=GAP, twin=True),
}


def linear_case(seed=5):
    """A random model with inputs, and a series with partial gaps."""
    rng = np.random.default_rng(seed)
    matrices = reference.random_model(rng, 3, 2)
    model = jf.models.linear_gaussian(*matrices, B=rng.normal(size=(3, 2)), D=rng.normal(size=(2, 2)))
    options = {"mask": rng.random((STEPS, 2)) < 0.7, "u": rng.normal(size=(STEPS, 2))}
    return model, rng.normal(size=(STEPS, 2)), options


def scene(dtype=jnp.float64):
    """The turn of the registry with a series that its target could have given."""
    turning = model(jax.tree.map(lambda x: jnp.asarray(x, dtype), _PARAMS))
    rng = np.random.default_rng(1)
    x, ys = turning.m0, []
    for _ in range(STEPS):
        x = turning.f(x, None, None)
        ys.append(np.asarray(turning.h(x, None, None)) + rng.normal(size=2) * np.array([0.5, 0.1]))
    mask = rng.random((STEPS, 2)) < 0.8
    return turning._replace(R=jnp.asarray(_SENSOR["R"] / 50, dtype)), jnp.asarray(np.array(ys), dtype), mask


def boresight_bearing(turned, x, u, dt):
    """Range and bearing [rad] from a frame turned by an angle against the state's."""
    dx, dy = x[0] + 3.0, x[1] - 2.0
    return jnp.stack([jnp.hypot(dx, dy), jf.models.sensors.wrap(jnp.arctan2(dy, dx) + turned)])


def rotation(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.kron(np.eye(2), np.array([[c, -s], [s, c]]))


ANGLES = np.linspace(-np.pi, np.pi, 8) + np.array([0.0, 0.1, 0, 0, 0, 0, 0, 0])


def flight(make, turned, runs=4, frame=None):
    """Position errors of a crossing target seen in range and bearing, the whole scene turned.

    ``frame="bearing"``: the states' axes turn with the scene, so only the bearings' zero moves.
    """
    rng = np.random.default_rng(11)
    motion = jf.models.constant_velocity(dt=1.0, q=0.05, r=1.0, m0=np.zeros(4), P0=np.eye(4))
    F, Q = np.asarray(value(motion.F, None, None)), np.asarray(value(motion.Q, None, None))
    L, R, start = np.linalg.cholesky(Q), np.diag([0.2, 0.003]), np.array([6.0, -4.0, -0.5, 0.9])
    P0 = np.diag([4.0, 2.0, 0.3, 0.5])
    G = np.eye(4) if frame == "bearing" else rotation(turned)
    model = jf.models.constant_velocity(dt=1.0, q=0.05, r=1.0, m0=G @ start, P0=0.5 * (G @ P0 @ G.T + G @ P0.T @ G.T))
    if frame == "bearing":
        sensor = jf.models.Sensor(
            Partial(boresight_bearing, jnp.asarray(turned)), R, jf.models.sensors.range_bearing(R).residual
        )
    else:
        sensor = jf.models.sensors.range_bearing(R, observer=(G @ [-3.0, 2.0, 0, 0])[:2])
    filt = make(jf.models.with_sensor(model, sensor))
    x = start + rng.normal(size=(runs, 4)) @ np.linalg.cholesky(P0).T
    xs, ys = [], []
    for _ in range(12):
        x = x @ F.T + rng.normal(size=(runs, 4)) @ L.T
        seen = x[:, :2] - [-3.0, 2.0]
        noise = rng.normal(size=(runs, 2)) * np.sqrt(np.diag(R))
        angle = np.arctan2(seen[:, 1], seen[:, 0]) + turned + noise[:, 1]
        ys.append(np.stack([np.hypot(*seen.T) + noise[:, 0], np.angle(np.exp(1j * angle))], axis=1))
        xs.append(x @ G.T)
    ys, xs = np.stack(ys, axis=1), np.stack(xs, axis=1)
    means = np.stack([jf.filter(filt, y).mean for y in ys])
    return np.linalg.norm((means - xs)[..., :2], axis=-1)
