"""The filters: planar motion models on the position alone, and a car model with wheel speed and gyroscope."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments import planar
from jaxfilt import tune

# What each filter is given of [east, north, wheel speed, yaw rate].
PLANAR = ("CV", "CA", "CT", "IMM (CV, CT)")
CAR = {
    "car, GNSS alone": (True, True, False, False),
    "car, wheels": (True, True, True, False),
    "car, wheels and gyro": (True, True, True, True),
}
UKF = "car, wheels and gyro, UKF"
SCALE = planar.Scale(r=0.01, q=0.1, q_jerk=0.1, q_omega=1e-3, stay=0.95)
WARMUP = 20  # epochs

Params = dict[str, Any]


class Given(NamedTuple):
    """One run; the series of all runs are the same but for the mask."""

    ys: Array  # (T, 4)
    mask: Array  # (T, 4) bool
    dt: Array  # (T,)


class Reported(NamedTuple):
    """What a filter says at each epoch."""

    position: Array  # (..., T, 2) m
    cov: Array  # (..., T, 2, 2) m^2


def space(name: str) -> dict[str, Any]:
    """The parameters of a filter."""
    if name in planar.MODES:
        return planar.space(name, SCALE)
    specs = {"r": 0.01, "q_speed": 0.1, "q_turn": 1e-4}
    given = CAR[name]
    specs |= {"r_wheel": 0.01} if given[2] else {}
    specs |= {"r_gyro": 1e-4} if given[3] else {}
    return {key: tune.positive(value, 1e-5 * value, 1e5 * value) for key, value in specs.items()}


def make(name: str, params: Params, first: Array) -> jf.Filter:
    """A filter for a drive whose first fix is at ``first`` (2,); of its velocity nothing is known but the size."""
    if name in planar.MODES:
        mean = jnp.concatenate([first, jnp.zeros(2)])
        return planar.make(name, params, planar.Start(mean, jnp.diag(jnp.array([1.0, 1.0, 400.0, 400.0]))))
    model = car(params, first)
    return jf.unscented(model) if name == UKF else jf.extended(model)


def car(params: Params, first: Array) -> jf.models.Nonlinear:
    """A car: state ``[x, y, v, heading, yaw rate, gyro bias, wheel scale]``.

    Speed and yaw rate are random walks; the gyroscope's bias [rad/s] and the wheels' scale are unknown constants.
    The prior heading is north, along the road, within 30 degrees.
    """
    m0 = jnp.concatenate([first, jnp.array([8.0, jnp.pi / 2, 0.0, 0.0, 1.0])])
    P0 = jnp.diag(jnp.square(jnp.array([1.0, 1.0, 10.0, 0.5, 0.1, 0.1, 0.03])))
    q = jnp.stack([jnp.asarray(params["q_speed"]), jnp.asarray(params["q_turn"])])
    # What a filter is not given is masked always, so that its noise does not matter.
    R = jnp.stack([params["r"], params["r"], params.get("r_wheel", 1.0), params.get("r_gyro", 1.0)])
    return jf.models.nonlinear(_move, _measure, Partial(_noise, q), jnp.diag(R), m0, P0)


def _move(x, u, dt):
    del u
    heading = x[3] + x[4] * dt
    middle = x[3] + 0.5 * x[4] * dt
    ahead = x[2] * dt * jnp.stack([jnp.cos(middle), jnp.sin(middle)])
    return jnp.concatenate([x[:2] + ahead, x[2:3], heading[None], x[4:]])


def _measure(x, u, dt):
    del u, dt
    return jnp.stack([x[0], x[1], x[6] * x[2], x[4] + x[5]])


def _noise(q, x, u, dt):
    """White acceleration along the heading, white yaw acceleration."""
    del u
    speed, turn = q
    along = jnp.stack([jnp.cos(x[3]), jnp.sin(x[3])])
    Q = jnp.zeros((7, 7), x.dtype)
    Q = Q.at[:2, :2].set(speed * dt**3 / 3 * jnp.outer(along, along))
    Q = Q.at[:2, 2].set(speed * dt**2 / 2 * along).at[2, :2].set(speed * dt**2 / 2 * along).at[2, 2].set(speed * dt)
    block = jnp.stack([jnp.stack([dt**3 / 3, dt**2 / 2]), jnp.stack([dt**2 / 2, dt])])
    return Q.at[3:5, 3:5].set(turn * block)


def _series(name, run):
    """The components and the mask as the filter takes them."""
    if name in planar.MODES:
        return run.ys[:, :2], run.mask[:, :2]
    return run.ys, run.mask & jnp.asarray(CAR["car, wheels and gyro" if name == UKF else name])[None]


def loss(name: jf.Static, params: Params, run: Given) -> Array:
    """Innovation likelihood of one series."""
    ys, mask = _series(name.value, run)
    filt = make(name.value, params, run.ys[0, :2])
    options: dict[str, Any] = {"warmup": WARMUP, "first_update_only": True}
    return tune.innovation_nll(filt, ys[None], mask=mask[None], dt=run.dt[None], **options)


def reported(state: Any, info: jf.Info) -> Reported:
    """``outputs`` of the filters."""
    del state
    assert info.cov is not None
    return Reported(info.mean[:2], info.cov[:2, :2])


@partial(jax.jit, static_argnames="name")
def run(name: str, params: Params, ys: Array, masks: Array, dt: Array) -> Reported:
    """All cuts at once: masks (B, T, 4)."""

    def one(mask):
        series, seen = _series(name, Given(ys, mask, dt))
        filt = make(name, params, ys[0, :2])
        return jf.filter(filt, series, mask=seen, dt=dt, outputs=reported, first_update_only=True)

    return jax.vmap(one)(masks)
