"""What a gyro and an accelerometer measure on a given motion."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import check_key, numbers
from jaxfilt.filters.attitude import GRAVITY, check_frame
from jaxfilt.linalg import sym
from jaxfilt.models.linear import check_finite, check_positive, check_shape, common_dtype


class Imu(NamedTuple):
    """Simulated readings with their truth; T samples."""

    gyr: Array  # (T, 3) [rad/s], the mean rate since the last sample
    acc: Array  # (T, 3) [m/s^2] specific force
    axis: Array  # (T, 3) the vertical axis in the body's frame
    bias: Array  # (T, 3) of the gyro [rad/s]
    a_ext: Array  # (T, 3) external acceleration in the body's frame [m/s^2]


def imu(
    attitude: Any,
    acceleration: Any,
    key: Array,
    *,
    dt: Any,
    lever: Any = (0.0, 0.0, 0.0),
    gyr_std: Any = 1e-3,
    acc_std: Any = 1e-2,
    bias0: Any = (0.01, -0.007, 0.004),
    bias_walk: Any = 1e-4,
    acc_bias: Any = (0.0, 0.0, 0.0),
    gyr_matrix: Any = None,
    acc_matrix: Any = None,
    frame: str = "up",
    gravity: Any = GRAVITY,
) -> Imu:
    """Readings of an inertial sensor on a body of given attitude and acceleration. Batch it with ``jax.vmap``.

    ``gyr[k] = M_g (log(C_{k-1}' C_k) / dt) + bias + noise``, ``acc = M_a (G Z + C' a) + acc_bias + noise`` with Z the
    third row of C. The attitude may be given on a grid that is finer by a whole number than the samples', which the
    acceleration of a lever arm (second differences) needs.

    Random numbers: ``fold_in(key, 0)`` for the gyro, 1 for the accelerometer, 2 for the bias's walk.

    Args:
        attitude: ((T - 1) K + 1, 3, 3) rotation matrices C, body to earth; K >= 1.
        acceleration: (T, 3) of the body's origin, in earth axes [m/s^2].
        key: random key.
        dt: [s] between samples.
        lever: (3,) [m] where on the body the sensor sits.
        gyr_std: [rad/s] white noise.
        acc_std: [m/s^2] white noise.
        bias0: (3,) [rad/s] first bias of the gyro.
        bias_walk: [rad/s] standard deviation of the bias's step from sample to sample.
        acc_bias: (3,) [m/s^2].
        gyr_matrix: (3, 3) scale factors and misalignment; None = identity.
        acc_matrix: (3, 3) likewise.
        frame: ``"up"`` or ``"down"``, where the earth's third axis points.
        gravity: [m/s^2].

    Raises:
        ValueError: wrong shapes, dt or gravity not positive, an unknown frame.
        TypeError: integer arrays or mixed float dtypes.
    """
    given: dict[str, Any] = {"lever": lever, "bias0": bias0, "acc_bias": acc_bias}
    sizes = {"dt": dt, "gyr_std": gyr_std, "acc_std": acc_std, "bias_walk": bias_walk, "gravity": gravity}
    shapes = {"gyr_matrix": gyr_matrix, "acc_matrix": acc_matrix}
    shapes = {name: x for name, x in shapes.items() if x is not None}
    dtype = common_dtype({"attitude": attitude, "acceleration": acceleration, **given, **sizes, **shapes})
    check_key(key)
    for name, x in sizes.items():
        check_shape(name, x, ())
        check_positive(name, x, zero=name not in ("dt", "gravity"))
    for name, x in {"attitude": attitude, "acceleration": acceleration, **shapes}.items():
        check_finite(name, x)
    attitude, acceleration = jnp.asarray(attitude, dtype), jnp.asarray(acceleration, dtype)
    check_shape("attitude", attitude, (None, 3, 3))
    check_shape("acceleration", acceleration, (None, 3))
    fine, samples = len(attitude) - 1, len(acceleration) - 1
    if samples < 1 or fine < samples or fine % samples:
        raise ValueError(f"attitude: expected (T - 1) K + 1 entries for T = {samples + 1}, got {fine + 1}")
    vectors = {name: jnp.asarray(x, dtype) for name, x in given.items()}
    for name, x in vectors.items():
        check_shape(name, x, (3,))
        check_finite(name, x)
    matrices = [jnp.eye(3, dtype=dtype) if x is None else jnp.asarray(x, dtype) for x in (gyr_matrix, acc_matrix)]
    for name, x in zip(("gyr_matrix", "acc_matrix"), matrices, strict=True):
        check_shape(name, x, (3, 3))
    scalars = [jnp.asarray(x, dtype) for x in (dt, gyr_std, acc_std, bias_walk, check_frame(frame) * gravity)]
    return _imu(attitude, acceleration, key, fine // samples, *scalars, *vectors.values(), *matrices)


@partial(jax.jit, static_argnums=3)
def _imu(C, acceleration, key, K, dt, gyr_std, acc_std, bias_walk, gravity, lever, bias0, acc_bias, M_g, M_a):
    T, dtype = len(acceleration), acceleration.dtype
    noise = [jax.random.normal(jax.random.fold_in(key, i), (T, 3), dtype) for i in range(3)]
    with jax.default_matmul_precision("highest"):
        arm = C @ lever
        bent = (arm[2:] - 2 * arm[1:-1] + arm[:-2]) / (dt / K) ** 2
        zero = jnp.zeros((1, 3), dtype)
        total = acceleration + jnp.concatenate([zero, bent, zero])[::K]
        C = C[::K]
        a_ext = jnp.einsum("tij,ti->tj", C, total)
        rate = jax.vmap(_logarithm)(jnp.einsum("tij,tik->tjk", C[:-1], C[1:])) / dt
        rate = jnp.concatenate([rate[:1], rate])  # nothing is known of what was before the first sample
        steps = jnp.concatenate([bias0[None, :], bias_walk * noise[2][1:]])
        bias = jnp.cumsum(steps, axis=0)
        gyr = rate @ M_g.T + bias + gyr_std * noise[0]
        acc = (gravity * C[:, 2] + a_ext) @ M_a.T + acc_bias[None, :] + acc_std * noise[1]
    return Imu(gyr, acc, C[:, 2], bias, a_ext)


def _logarithm(R):
    """The rotation vector of R (3, 3), for turns of less than half a revolution."""
    v = 0.5 * jnp.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = jnp.sqrt(jnp.maximum(jnp.sum(v * v), jnp.finfo(v.dtype).tiny))
    angle = jnp.arctan2(sine, 0.5 * (jnp.trace(sym(R)) - 1))
    return v * jnp.where(sine > jnp.finfo(v.dtype).eps, angle / sine, jnp.ones_like(sine))


def euler_attitude(roll: Array, pitch: Array, yaw: Array) -> Array:
    """Rotation matrices (T, 3, 3), body to earth, of ZYX Euler angles (T,) [rad]."""
    common_dtype({"roll": roll, "pitch": pitch, "yaw": yaw})
    roll, pitch, yaw = jnp.asarray(roll), jnp.asarray(pitch), jnp.asarray(yaw)
    if not roll.shape == pitch.shape == yaw.shape:
        raise ValueError(f"roll, pitch, yaw: expected one shape, got {roll.shape}, {pitch.shape}, {yaw.shape}")
    cr, sr = jnp.cos(roll), jnp.sin(roll)
    cp, sp = jnp.cos(pitch), jnp.sin(pitch)
    cy, sy = jnp.cos(yaw), jnp.sin(yaw)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def axis_of_quaternion(q: Any) -> np.ndarray:
    """The vertical axis (..., 3) in the body's frame, of quaternions (..., 4) body to earth, scalar first."""
    q = numbers("q", q).astype(np.float64)
    if q.ndim == 0 or q.shape[-1] != 4:
        raise ValueError(f"q: expected shape (..., 4), got {q.shape}")
    w, x, y, z = np.moveaxis(q, -1, 0)
    return np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z], axis=-1)
