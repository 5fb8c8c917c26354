"""The filters: CV, CA, CT and IMM with range and bearing, each track choosing its nearest detection."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments import planar
from experiments.radar.scans import Tracks
from jaxfilt import tune

P_FALSE = 1e-3  # of the gate
WARMUP = 3  # scans of each track that the loss leaves out
REFUSAL = 8.0  # nats: what a detection from anywhere within 500 m is worth, log(500 m * 2 pi rad)
# Where the search begins; the standard deviations of range [m] and bearing [rad] by radar and by lidar.
SCALE = planar.Scale(r=1.0, q=0.1, q_jerk=0.01, q_omega=1e-3, stay=0.95)
NOISE = ((5.0, 0.03), (2.0, 0.02))
ACCELERATION, TURN_RATE = 0.1, 0.01  # variances at the start

Params = dict[str, Any]


class Given(NamedTuple):
    """What the filters are given of :class:`Tracks`: no truth, and not where the tracks come from."""

    first: Array
    second: Array
    own: Array
    span: Array
    dt: Array
    sensor: Array
    mask: Array
    observer: Array
    detections: Array
    valid: Array


class Reported(NamedTuple):
    """What a filter says at each scan."""

    position: Array  # (..., T, 2) m
    cov: Array  # (..., T, 2, 2) m^2
    predicted: Array  # (..., T, 2) m, before the scan
    choice: Array  # (..., T) index of the detection taken, or -1
    log_lik: Array  # (..., T)
    modes: Array | None  # (..., T, r) probabilities, where there are several


def given(tracks: Tracks) -> Given:
    """Tracks as the filters take them."""
    return Given(*(jnp.asarray(getattr(tracks, name)) for name in Given._fields))


def make(name: str, params: Params, track: Given) -> jf.Filter:
    """A filter of :data:`planar.MODES` for one track, which starts at the second of its two detections."""
    start = two_point(track, params["noise"][0])
    sensor = jf.models.sensors.range_bearing(_noise, observer=_observer)
    return jf.nearest_neighbor(planar.make(name, params | {"r": 1.0}, start, sensor), P_FALSE)


def two_point(track: Given, noise: Array) -> planar.Start:
    """Position from the later detection, velocity from the difference; both by the noise (2,) of range and bearing."""
    x, y = track.second - track.own
    distance = jnp.hypot(x, y)
    along = jnp.stack([x, y]) / distance
    across = jnp.stack([-y, x])  # its length is the range, by which a bearing is worth more
    R = noise[0] * jnp.outer(along, along) + noise[1] * jnp.outer(across, across)
    velocity = (track.second - track.first) / track.span
    cov = jnp.block([[R, R / track.span], [R / track.span, 2 * R / track.span**2]])
    return planar.Start(jnp.concatenate([track.second, velocity]), cov, ACCELERATION, TURN_RATE)


def _noise(x, u, dt):
    del x, dt
    return u["R"]


def _observer(u, dt):
    del dt
    return u["observer"]


def reported(state: Any, info: jf.Info) -> Reported:
    """``outputs`` of the filters."""
    del state
    assert info.cov is not None
    assert info.log_lik is not None
    assert info.prediction is not None
    return Reported(info.mean[:2], info.cov[:2, :2], info.prediction.mean[:2], info.extra["choice"], info.log_lik,
                    info.extra.get("mode_probabilities"))  # fmt: skip


def one(name: str, params: Params, track: Given) -> Reported:
    """One track."""
    noise = params["noise"][track.sensor]  # (T, 2)
    u = {"observer": track.observer, "R": jax.vmap(jnp.diag)(noise)}
    scans = jf.scan_inputs(track.detections, track.valid, u=u)
    return jf.filter(make(name, params, track), **scans, mask=track.mask, dt=track.dt, outputs=reported)


def _several(name, params, tracks):
    return jax.vmap(Partial(one, name), (None, 0))(params, tracks)


@partial(jax.jit, static_argnames="name")
def run(name: str, params: Params, tracks: Given) -> Reported:
    """All tracks at once, each with parameters of its own: (B, ...)."""
    return jax.vmap(Partial(one, name))(params, tracks)


def space(name: str, sets: int) -> dict[str, Any]:
    """``sets`` sets of parameters of a filter of :data:`planar.MODES`, side by side."""
    specs = planar.space(name, SCALE)
    specs["noise"] = tune.positive(jnp.square(jnp.asarray(NOISE)), 1e-6, 1e4)
    return {key: _stack(spec, sets) for key, spec in specs.items() if key != "r"}


def _stack(spec, sets):
    init = jnp.broadcast_to(jnp.asarray(spec.init), (sets, *jnp.shape(spec.init)))
    if spec.kind == "interval":
        return tune.interval(init, 0.5, 0.9999)
    return tune.positive(init, 1e-3 * init, 1e3 * init)


def loss(name: jf.Static, params: Params, data: tuple[Given, Array]) -> Array:
    """Innovation negative log-likelihood per scan, summed over sets; ``data`` is (tracks (sets, B, ...), cost ()).

    A scan counts that updates a track. So does one whose detections the gate refuses, at ``cost`` nats; with cost 0 it
    does not count, and then it pays to refuse all but the best detections.
    """
    tracks, cost = data
    out = jax.vmap(Partial(_several, name.value))(params, tracks)
    settled = (jnp.arange(out.choice.shape[-1]) >= WARMUP)[None, None] & tracks.mask
    updated = settled & (out.choice >= 0)
    refused = settled & (out.choice < 0) & tracks.valid.any(axis=-1) & (cost > 0)
    total = jnp.sum(jnp.where(updated, -out.log_lik, jnp.where(refused, cost, 0.0)), axis=(1, 2))
    return jnp.sum(total / jnp.maximum(jnp.sum(updated | refused, axis=(1, 2)), 1).astype(total.dtype))
