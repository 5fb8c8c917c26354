"""A channel that delays and loses packets."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import check_count, check_key, real_array
from jaxfilt.models.delays import check_probabilities
from jaxfilt.models.linear import common_dtype


class Received(NamedTuple):
    """What arrives of a series of packets, at most d samples late."""

    ys: Array  # (T, m) the newest packet that arrives at k, 0 where none does
    mask: Array  # (T, m) bool, whether one does
    lag: Array  # (T, m) int32, how many samples ago it was sent; -1 for none
    packets: Array  # (T, (d+1) m) all that arrives at k: [z_k, z_{k-1}, .., z_{k-d}], 0 where absent
    arrived: Array  # (T, (d+1) m) bool, which of these do


def draw_delays(probabilities: Any, shape: tuple[int, ...], key: Array) -> Array:
    """Independent delays of packets, in samples; d+1 stands for lost.

    Args:
        probabilities: (..., d+2) of a packet being 0..d samples late, or lost; see
            :func:`jaxfilt.models.delay_probabilities`. Leading axes broadcast against ``shape``: (d+2,) for all
            packets, (m, d+2) for each channel of (T, m), (T, d+2) for each packet of (T,).
        shape: ``(T,)``, or ``(T, m)`` if each channel is delayed by itself.
        key: random key. Prefix-stable: packet k takes ``fold_in(key, k)``.

    Returns:
        int32 of the given shape.

    Raises:
        ValueError: no probabilities, or shapes that do not fit.
    """
    p = jnp.asarray(probabilities, common_dtype({"probabilities": probabilities}))
    check_probabilities("probabilities", p)
    check_key(key)
    if not isinstance(shape, tuple | list) or len(shape) not in (1, 2):
        raise ValueError(f"shape: expected (T,) or (T, m), got {shape!r}")
    for size in shape:
        check_count("shape", size, 1)
    try:
        p = jnp.broadcast_to(p, (*shape, p.shape[-1]))
    except ValueError:
        raise ValueError(f"probabilities: {p.shape} do not fit to packets of shape {shape}") from None
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, np.arange(shape[0], dtype=np.uint32))
    u = jax.vmap(lambda k: jax.random.uniform(k, shape[1:], p.dtype))(keys)
    edges = jnp.cumsum(p, axis=-1)[..., :-1]
    return (u[..., None] >= edges).sum(axis=-1).astype(jnp.int32)


def deliver(zs: Any, delays: Any, max_delay: int) -> Received:
    """What arrives when: the newest packet of each step, with and without its time stamp, and all packets.

    An older packet that arrives together with a newer one is discarded in ``ys``. Nothing was sent before the first
    sample.

    Args:
        zs: (T, m) packets as sent.
        delays: (T,), or (T, m) for each channel: int samples, of the packet *sent* at k. What is later than
            ``max_delay`` (or negative) is lost.
        max_delay: d >= 0.

    Raises:
        ValueError: wrong shapes, d < 0.
        TypeError: delays that are not integers.

    Source: Sun 2013, eq. (1); the recursion over the packets under way gives the same series.
    """
    common_dtype({"zs": zs})
    zs, delays = jnp.asarray(zs), real_array("delays", delays)
    check_count("max_delay", max_delay, 0)
    if zs.ndim != 2 or zs.size == 0:
        raise ValueError(f"zs: expected shape (T, m), got {zs.shape}")
    if not jnp.issubdtype(delays.dtype, jnp.integer):
        raise TypeError(f"delays: expected integers, got {delays.dtype}")
    if delays.shape not in (zs.shape[:1], zs.shape):
        raise ValueError(f"delays: expected shape {zs.shape[:1]} or {zs.shape}, got {delays.shape}")
    T = len(zs)
    delays = jnp.broadcast_to(delays.reshape(T, -1), zs.shape).astype(jnp.int32)
    lags = np.arange(max_delay + 1, dtype=np.int32)
    sent = np.arange(T)[:, None] - lags[None, :]  # (T, d+1) when the packet with this lag was sent
    before = np.maximum(sent, 0)
    arrived = (delays[before] == lags.astype(delays.dtype)[None, :, None]) & (sent >= 0)[:, :, None]
    packets = jnp.where(arrived, zs[before], jnp.zeros((), zs.dtype))
    mask = arrived.any(axis=1)
    newest = jnp.argmax(arrived, axis=1).astype(jnp.int32)  # the smallest lag
    ys = jnp.take_along_axis(packets, newest[:, None, :], axis=1)[:, 0]
    lag = jnp.where(mask, newest, jnp.int32(-1))
    return Received(ys, mask, lag, packets.reshape(T, -1), arrived.reshape(T, -1))
