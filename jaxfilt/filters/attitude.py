"""Attitude (tilt) and gyro bias from a gyro and an accelerometer that is accelerated: extended Kalman filters.

The state is the vertical axis ``Z`` in the body's frame, the gyro's bias, and in one variant the velocity. The gyro is
the input ``u`` (3,) [rad/s] of a step, the mean rate since the last sample; the accelerometer is its measurement ``y``
(3,) [m/s^2], the specific force as a sensor gives it: ``y = G Z + a + noise``, with ``G = +gravity`` if Z points up
(``frame="up"``: at rest the sensor reads +9.81 along up) and ``G = -gravity`` if Z points down (``"down"``: NED axes).
In both, ``a`` is the true external acceleration in the body's axes.

    filt = jf.attitude_velocity(dt=0.01)
    out = jf.filter(filt, **jf.imu_inputs(gyr, acc), first_update_only=True)
    out.mean[:, :3], out.extra["roll"], out.extra["pitch"], out.extra["a_ext"]

The start comes from the first sample, which must be at rest, or from ``z0``. No heading is estimated.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from jaxfilt.core import (
    Filter,
    Info,
    Prediction,
    Static,
    Status,
    StepInput,
    bind,
    check_flag,
    flag,
    is_concrete,
    numbers,
    present,
)
from jaxfilt.filters.common import check_dtype, check_measurement
from jaxfilt.filters.update import joseph_update
from jaxfilt.linalg import rotation, scale_cov, skew, sym
from jaxfilt.models.linear import check_covariance, check_finite, check_positive, check_shape, common_dtype

GRAVITY = 9.81
FRAMES = {"up": 1.0, "down": -1.0}
PRINTED_BIAS_VAR = 1e-8  # (rad/s)^2, the paper's gyro bias variance


class AttitudeState(NamedTuple):
    """Posterior moments, and what the variants remember."""

    mean: Array  # (n,) vertical axis, gyro bias (, velocity)
    cov: Array  # (n, n)
    a_ext: Array  # (3,) external acceleration; between predict and update its prediction
    peak: Array | None  # () squared external acceleration that is held
    rate: Array  # (3,) the last finite gyro reading
    roll: Array  # () the last defined one
    pending: Array  # () int32, status that the next update reports


class _Params(NamedTuple):
    dt: Any
    gravity: Any  # signed
    gyro_var: Any
    acc_var: Any
    bias_var: Any  # per s^2
    bias_q: Any  # per step
    kappa: Any
    trust: Partial | None  # (state, y, seen) -> (what R is larger by, peak)
    velocity_var: Any
    z0: Any
    P0: Any
    bias_limit: Any
    options: Static


class _Options(NamedTuple):
    exact: bool
    project: bool


def attitude(
    *,
    dt: Any,
    kappa: Any = 0.1,
    c: Any = 1 / 3,
    gyro_var: Any = 1e-6,
    acc_var: Any = 1e-4,
    bias_var: Any = PRINTED_BIAS_VAR,
    bias_q: Any = None,
    frame: str = "up",
    gravity: Any = GRAVITY,
    prop: str = "exact",
    z0: Any = None,
    P0: Any = None,
    bias_limit: Any = None,
    project_cov: bool = False,
) -> Filter:
    """The tilt EKF whose external acceleration is a first-order process.

    State ``[Z, b]`` (6,). Predict: ``Z- = F Z`` with ``F = exp(-dt [(u - b) x])``. Update with
    ``y = G Z + kappa a + noise``, a the external acceleration that the last step found, and
    ``R = acc_var + c kappa^2 |a|^2``; then Z is made a unit vector again and ``a = y - G Z``.

    It is a filter with an adaptive R: the external acceleration that the last step thought it saw makes the sensor
    count less. Know its limits. R lags by one sample: where an acceleration passes through 0 between strokes, a wrong
    update gets full weight. A large tilt error looks like acceleration and slows its own correction. At ``kappa = 1`` a
    tilt error at rest gives no innovation any more. The bias about the vertical cannot be seen while Z stays where it
    is, and may run away. Under long, strong motion ``kappa > 0`` can be worse than 0; :func:`attitude_velocity` is
    what to take then.

    ``info.extra``: ``a_ext`` (3,) [m/s^2], ``roll`` and ``pitch`` () [rad] of ZYX Euler angles.
    Status: MISSED, NONFINITE (also a gyro reading that is not finite: the last one is held), SINGULAR; BOUND: the first
    sample was not within 0.5 to 1.5 g (reported in the first step; what direction it had is taken all the same), Z all
    but vanished in an update and was kept, a bias was clipped, or the pitch is within 1e-6 of a right angle, where roll
    keeps its last value. A missed sample is predicted only, and ``a`` becomes ``kappa a``.

    Args:
        dt: interval [s]; per step, ``jf.filter(..., dt=)`` overrides it.
        kappa: in [0, 1], what part of the external acceleration stays from sample to sample.
        c: 1/3 spreads ``|a|^2`` over the axes (the paper's print is illegible), 1 gives each axis all of it.
        gyro_var: gyro noise variance [(rad/s)^2] per sample.
        acc_var: accelerometer noise variance [(m/s^2)^2].
        bias_var: the bias moves by a variance of ``bias_var dt^2`` per step [(rad/s)^2 / s^2].
        bias_q: instead, its variance per step [(rad/s)^2]; 1e-8 is what the paper prints, with which its own table does
            not come out.
        frame: ``"up"`` or ``"down"``, where Z points.
        gravity: [m/s^2].
        prop: ``"exact"``, or ``"euler"`` for the paper's ``F = I - dt [w x]``, which drifts under fast rotation.
        z0: (3,) the initial vertical axis; None = from the first sample.
        P0: (6, 6); None = 1e-2 for Z and 1e-4 (rad/s)^2 for the bias.
        bias_limit: [rad/s] each component of the bias is clipped to this; None = not.
        project_cov: takes from the covariance what no unit vector can do.

    Raises:
        ValueError: kappa outside [0, 1], a variance, interval or gravity not positive, an unknown option, a z0 of no
            length, a P0 that is no covariance, wrong shapes.
        TypeError: integer arrays or mixed float dtypes.

    Source: Sabet, Mohammadi Daniali, Fathi and Alizadeh, with bias_q = bias_var dt^2 and Joseph's form; without the
    bias: Lee, Park and Robinovitch 2012, IEEE Trans. Instrum. Meas. 61(8).
    """
    _check_fraction("kappa", kappa)
    check_positive("c", c, zero=True)
    trust = Partial(_lagged, c)
    given = {"kappa": kappa, "trust": trust, "named": {"c": c}, "acc_var": acc_var}
    return _build(6, dt, gyro_var, bias_var, bias_q, frame, gravity, prop, z0, P0, bias_limit, project_cov, **given)


def attitude_peak(
    *,
    dt: Any,
    kappa: Any = 0.0,
    rho: Any = 1.0,
    decay: Any = 0.995,
    gyro_var: Any = 1e-6,
    acc_var: Any = 1e-4,
    bias_var: Any = PRINTED_BIAS_VAR,
    bias_q: Any = None,
    frame: str = "up",
    gravity: Any = GRAVITY,
    prop: str = "exact",
    z0: Any = None,
    P0: Any = None,
    bias_limit: Any = None,
    project_cov: bool = False,
) -> Filter:
    """:func:`attitude` whose R does not lag: it takes this sample's acceleration too, and holds peaks.

    ``R = acc_var + rho m``, ``m = max(|a|^2 of the last step, |y - G Z-|^2, decay^2 m of the last step)``.

    Args:
        dt: interval [s].
        kappa: as in :func:`attitude`, here for the innovation alone.
        rho: >= 0; ``kappa^2 / 3`` has the scale of :func:`attitude`.
        decay: in [0, 1], of the held magnitude per step; 0 holds nothing. 0.995 is for some 300 samples per second.
        gyro_var: as in :func:`attitude`, like the others.
        acc_var: likewise.
        bias_var: likewise.
        bias_q: likewise.
        frame: likewise.
        gravity: likewise.
        prop: likewise.
        z0: likewise.
        P0: likewise.
        bias_limit: likewise.
        project_cov: likewise.
    """
    _check_fraction("kappa", kappa)
    _check_fraction("decay", decay)
    check_positive("rho", rho, zero=True)
    given = {"kappa": kappa, "trust": Partial(_held, rho, decay), "acc_var": acc_var}
    given["named"] = {"rho": rho, "decay": decay}
    return _build(6, dt, gyro_var, bias_var, bias_q, frame, gravity, prop, z0, P0, bias_limit, project_cov, **given)


def attitude_switched(
    *,
    dt: Any,
    threshold: Any = 0.3,
    width: Any = None,
    moving_var: Any = 1e3,
    gyro_var: Any = 1e-6,
    acc_var: Any = 1e-4,
    bias_var: Any = PRINTED_BIAS_VAR,
    bias_q: Any = None,
    frame: str = "up",
    gravity: Any = GRAVITY,
    prop: str = "exact",
    z0: Any = None,
    P0: Any = None,
    bias_limit: Any = None,
    project_cov: bool = False,
) -> Filter:
    """:func:`attitude` without a model of the acceleration: a sample whose length is not that of gravity is shut out.

    ``R = acc_var``, and ``moving_var`` more where ``| |y| - gravity |`` is above the threshold. A sample with a missing
    component is taken as moving.

    Args:
        dt: interval [s].
        threshold: [m/s^2].
        width: [m/s^2] of a smooth step in place of the sharp one, through which a gradient can tune the threshold.
        moving_var: [(m/s^2)^2].
        gyro_var: as in :func:`attitude`, like the others.
        acc_var: likewise.
        bias_var: likewise.
        bias_q: likewise.
        frame: likewise.
        gravity: likewise.
        prop: likewise.
        z0: likewise.
        P0: likewise.
        bias_limit: likewise.
        project_cov: likewise.
    """
    check_positive("threshold", threshold)
    check_positive("moving_var", moving_var)
    if width is not None:
        check_positive("width", width)
    given = {"kappa": 0.0, "trust": Partial(_switched, gravity, threshold, width, moving_var), "acc_var": acc_var}
    given["named"] = {"threshold": threshold, "width": width, "moving_var": moving_var}
    return _build(6, dt, gyro_var, bias_var, bias_q, frame, gravity, prop, z0, P0, bias_limit, project_cov, **given)


def attitude_velocity(
    *,
    dt: Any,
    velocity_var: Any = 0.1,
    gyro_var: Any = 1e-6,
    acc_var: Any = 1e-4,
    bias_var: Any = PRINTED_BIAS_VAR,
    bias_q: Any = None,
    frame: str = "up",
    gravity: Any = GRAVITY,
    prop: str = "exact",
    z0: Any = None,
    P0: Any = None,
    bias_limit: Any = None,
    project_cov: bool = True,
) -> Filter:
    """The tilt EKF that knows that a body's velocity stays bounded: take this one.

    State ``[Z, b, v]`` (9,), v the velocity in the body's axes [m/s], from 0. It is the integral of what the
    accelerometer sees beside gravity, ``v- = F v + dt (y - G Z-)``, and each step the pseudo-measurement ``0 = v`` with
    variance ``velocity_var`` holds it. A tilt error would make it run away, an acceleration that returns does not: that
    is what a model of the acceleration's last value cannot know. Not for motion whose velocity is large for long, as a
    car's.

    Innovation, NIS and likelihood are those of the pseudo-measurement ([m/s], with the sign of y), ``info.noise_cov``
    is velocity_var, and ``r_scale`` scales it. A missed sample leaves v where it was.

    Args:
        dt: interval [s].
        velocity_var: [(m/s)^2] per sample. Velocities of neighboring samples are much alike, so it stands for more than
            the velocity's own variance: the spread squared times the samples in its correlation time.
        gyro_var: as in :func:`attitude`, like the others.
        acc_var: likewise.
        bias_var: likewise.
        bias_q: likewise.
        frame: likewise.
        gravity: likewise.
        prop: likewise.
        z0: likewise.
        P0: (9, 9); None = 1e-3 for Z, 1e-4 (rad/s)^2 for the bias, 1e-2 (m/s)^2 for v.
        bias_limit: likewise.
        project_cov: likewise.
    """
    check_positive("velocity_var", velocity_var)
    given = {"kappa": 0.0, "trust": None, "acc_var": acc_var, "velocity_var": velocity_var}
    return _build(9, dt, gyro_var, bias_var, bias_q, frame, gravity, prop, z0, P0, bias_limit, project_cov, **given)


def _build(
    n, dt, gyro_var, bias_var, bias_q, frame, gravity, prop, z0, P0, bias_limit, project_cov,
    *, kappa, trust, acc_var, named=None, velocity_var=None,
):  # fmt: skip
    sign = check_frame(frame)
    if prop not in ("exact", "euler"):
        raise ValueError(f'prop: expected "exact" or "euler", got {prop!r}')
    check_flag("project_cov", project_cov)
    for name, x in {"dt": dt, "gravity": gravity, "gyro_var": gyro_var, "acc_var": acc_var}.items():
        check_positive(name, x)
    check_positive("bias_var" if bias_q is None else "bias_q", bias_var if bias_q is None else bias_q)
    if bias_limit is not None:
        check_positive("bias_limit", bias_limit)
    z0 = check_start(z0)
    if P0 is not None:
        P0 = jnp.asarray(P0, common_dtype({"P0": P0}))
        check_shape("P0", P0, (n, n))
        check_covariance("P0", P0)
    p = _Params(
        dt, sign * gravity, gyro_var, acc_var, bias_var if bias_q is None else None, bias_q, kappa, trust, velocity_var,
        z0, P0, bias_limit, Static(_Options(prop == "exact", project_cov)),
    )  # fmt: skip
    check_positive("bias_var", bias_var)
    parameters = {**p._replace(trust=None, options=None)._asdict(), **(named or {})}
    common_dtype({name: x for name, x in parameters.items() if x is not None})
    for name, x in parameters.items():
        if name not in ("z0", "P0") and x is not None:
            check_shape(name, x, ())
    return bind(p, _init, _predict, _update if velocity_var is None else _update_velocity, _moments, _with_moments)


def check_frame(frame: str) -> float:
    """The sign of gravity's reading along Z; raises a ValueError for an unknown frame."""
    if frame not in FRAMES:
        raise ValueError(f'frame: expected "up" or "down", got {frame!r}')
    return FRAMES[frame]


def check_start(z0: Any) -> Array | None:
    """z0 (3,) as a unit vector; raises a ValueError for another shape or no length."""
    if z0 is None:
        return None
    z0 = jnp.asarray(z0, common_dtype({"z0": z0}))
    check_shape("z0", z0, (3,))
    check_finite("z0", z0)
    if is_concrete(z0) and not np.asarray(z0).any():
        raise ValueError("z0: expected a direction, got zeros")
    return z0 / jnp.sqrt(jnp.sum(z0 * z0))


def _check_fraction(name, x):
    if is_concrete(x) and not ((a := numbers(name, x)) >= 0).all() & (a <= 1).all():
        raise ValueError(f"{name}: expected a value in [0, 1], got {x}")


def start_axis(p: Any, inp: StepInput) -> tuple[Array, Array]:
    """Checks the first input, and gives the initial Z (3,) and the status to be reported with the first step.

    ``p`` has ``z0`` and a signed ``gravity``.
    """
    strong = [x for x in jax.tree.leaves(p) if hasattr(x, "dtype") and not getattr(x, "weak_type", False)]
    if strong:  # Python numbers alone take the dtype of ys
        check_dtype(inp, jnp.asarray(strong[0]))
    check_measurement(inp, 3, "an accelerometer has")
    if inp.u is None or jnp.shape(inp.u) != (3,):
        raise ValueError("u: expected the gyro's reading (3,) per step")
    if p.z0 is not None:
        return jnp.asarray(p.z0, inp.y.dtype), jnp.int32(0)
    gravity = jnp.asarray(p.gravity, inp.y.dtype)
    usable = (jnp.isfinite(inp.y) & present(inp)).all()
    up = jnp.asarray([0.0, 0.0, 1.0], inp.y.dtype)
    y = jnp.where(usable, inp.y, gravity * up)
    length = jnp.sqrt(jnp.sum(y * y))
    some = length > 0
    rest = usable & (length >= 0.5 * jnp.abs(gravity)) & (length <= 1.5 * jnp.abs(gravity))
    Z = jnp.where(some, jnp.sign(gravity) * y / jnp.where(some, length, jnp.ones_like(length)), up)
    return Z, flag(~rest, Status.BOUND)


def held_rate(last: Array, inp: StepInput) -> tuple[Array, Array]:
    """The gyro's reading with what is not finite replaced by the last one, and the status of it."""
    finite = jnp.isfinite(inp.u)
    return jnp.where(finite, inp.u, last), flag(~finite.all(), Status.NONFINITE)


def interval(p: Any, inp: StepInput) -> Array:
    """The step's interval, in the measurement's dtype."""
    return jnp.asarray(p.dt, inp.y.dtype) if inp.dt is None else inp.dt


def unit(v: Array, fallback: Array) -> tuple[Array, Array, Array]:
    """v / |v|, its length, and whether it was too short: then the fallback, and length 1."""
    length = jnp.sqrt(jnp.maximum(jnp.sum(v * v), 1e-12))
    lost = length < 1e-3
    length = jnp.where(lost, jnp.ones_like(length), length)
    return jnp.where(lost, fallback, v / length), length, lost


def angles(Z: Array, last_roll: Array) -> tuple[Array, Array, Array]:
    """Roll and pitch [rad] of the vertical axis, and whether roll is not defined and the last one is returned."""
    square = Z[1] * Z[1] + Z[2] * Z[2]
    upright = square < 1e-12
    one = jnp.ones_like(square)
    pitch = jnp.arctan2(-Z[0], jnp.sqrt(jnp.where(upright, one, square)))
    pitch = jnp.where(upright, -jnp.sign(Z[0]) * (0.5 * np.pi), pitch)
    roll = jnp.arctan2(jnp.where(upright, 0.0 * one, Z[1]), jnp.where(upright, one, Z[2]))
    return jnp.where(upright, last_roll, roll), pitch, upright


def _init(p, inp):
    Z, pending = start_axis(p, inp)
    zero = jnp.zeros((3,), Z.dtype)
    if p.velocity_var is None:
        mean, variances = jnp.concatenate([Z, zero]), (1e-2, 1e-4)
    else:
        mean, variances = jnp.concatenate([Z, zero, zero]), (1e-3, 1e-4, 1e-2)
    P0 = jnp.diag(jnp.repeat(jnp.asarray(variances, Z.dtype), 3)) if p.P0 is None else p.P0
    peak = zero[0] if p.trust is not None and p.trust.func is _held else None
    return AttitudeState(mean, P0, zero, peak, zero, angles(Z, zero[0])[0], pending)


def _predict(p, s, inp):
    dt = interval(p, inp)
    rate, status = held_rate(s.rate, inp)
    Z, b, v = s.mean[:3], s.mean[3:6], s.mean[6:]
    turn = -dt * (rate - b)
    eye, zeros = jnp.eye(3, dtype=Z.dtype), jnp.zeros((3, 3), Z.dtype)
    F = rotation(turn) if p.options.value.exact else eye + skew(turn)
    noisy = [-dt * skew(Z), zeros]  # what the gyro's noise does, and with the same sign its bias
    rows = [[F, noisy[0]], [zeros, eye]]
    parts = [F @ Z, b]
    if v.shape[0]:
        noisy.append(-dt * skew(v))
        rows = [[*rows[0], zeros], [*rows[1], zeros], [zeros, noisy[2], F]]
        parts.append(F @ v)
    if inp.mask is not None:  # a missed sample has no update that would make it a unit vector again
        parts[0] = jnp.where(inp.mask.any(), parts[0], unit(parts[0], Z)[0])
    mean = jnp.concatenate(parts)
    Phi, G = jnp.block(rows), jnp.concatenate(noisy)
    drift = p.bias_var * dt * dt if p.bias_q is None else jnp.asarray(p.bias_q, Z.dtype)
    at_bias = jnp.asarray((np.arange(len(mean)) // 3 == 1).astype(float), Z.dtype)
    Q = scale_cov(p.gyro_var * (G @ G.T) + jnp.diag(drift * at_bias), inp.q_scale)
    cross = s.cov @ Phi.T
    cov = sym(Phi @ cross + Q)
    peak = s.peak
    if peak is not None:
        decay = p.trust.args[1]
        peak = jnp.maximum(jnp.sum(s.a_ext * s.a_ext), decay * decay * peak)
    s = s._replace(mean=mean, cov=cov, a_ext=p.kappa * s.a_ext, peak=peak, rate=rate, pending=s.pending | status)
    return s, Prediction(mean, cov, cross)


def _lagged(c, s, y, seen):
    """The paper's: by the external acceleration of the last step, already times kappa."""
    del y, seen
    return c * jnp.sum(s.a_ext * s.a_ext), None


def _held(rho, decay, s, y, seen):
    """By the largest of the last step's, this one's and the one that is held."""
    del decay, y
    peak = jnp.maximum(s.peak, jnp.sum(seen * seen))
    return rho * peak, peak


def _switched(gravity, threshold, width, moving_var, s, y, seen):
    """By the length of the sample."""
    del s, seen
    square = jnp.sum(y * y)
    some = square > 0
    length = jnp.where(some, jnp.sqrt(jnp.where(some, square, jnp.ones_like(square))), jnp.zeros_like(square))
    excess = jnp.abs(length - gravity) - threshold
    share = jax.nn.sigmoid(excess / width) if width is not None else (excess > 0).astype(y.dtype)
    return moving_var * share, None


def _update(p, s, inp):
    gravity = jnp.asarray(p.gravity, inp.y.dtype)
    expected = gravity * s.mean[:3]
    usable = jnp.isfinite(inp.y) & present(inp)
    zero = jnp.zeros((), inp.y.dtype)
    seen = jnp.where(usable, inp.y - expected, zero)
    extra, peak = p.trust(s, jnp.where(usable, inp.y, zero), seen)
    if peak is not None:
        peak = jnp.where(usable.any(), peak, s.peak)
    eye = jnp.eye(3, dtype=inp.y.dtype)
    H = jnp.concatenate([gravity * eye, jnp.zeros_like(eye)], axis=1)
    R = scale_cov((p.acc_var + extra) * eye, inp.r_scale)
    info, cov = joseph_update(inp, s.mean, s.cov, expected + s.a_ext, H, R)
    return _finish(p, s._replace(peak=peak), inp, info, cov, usable)


def _update_velocity(p, s, inp):
    dt, gravity = interval(p, inp), jnp.asarray(p.gravity, inp.y.dtype)
    mean, n = s.mean, len(s.mean)
    here = present(inp)
    eye, zeros = jnp.eye(3, dtype=mean.dtype), jnp.zeros((3, 3), mean.dtype)
    # What the accelerometer sees beside gravity moves the velocity, by its axes that are present.
    moved = jnp.diag(jnp.where(here, dt, jnp.zeros((), mean.dtype)))
    T = jnp.eye(n, dtype=mean.dtype) + jnp.pad(-gravity * moved, ((6, 0), (0, 6)))
    noise = jnp.pad(p.acc_var * (moved @ moved), ((6, 0), (6, 0)))
    P = sym(T @ s.cov @ T.T + noise)
    step = dt * (inp.y - gravity * mean[:3])
    usable = jnp.isfinite(inp.y) & here
    v = mean[6:] + jnp.where(usable, step, jnp.zeros((), mean.dtype))
    # 0 = v, written so that the innovation has the sign of y.
    H = jnp.concatenate([zeros, zeros, -eye], axis=1)
    R = scale_cov(p.velocity_var * eye, inp.r_scale)
    moved_mean = jnp.concatenate([mean[:6], v])
    info, cov = joseph_update(inp._replace(y=step), moved_mean, P, -mean[6:], H, R)
    return _finish(p, s, inp, info, cov, usable)


def _finish(p, s, inp, info: Info, cov, usable):
    """The unit vector, the external acceleration, the angles."""
    Z, length, lost = unit(info.mean[:3], s.mean[:3])
    bias = info.mean[3:6]
    clipped = jnp.zeros((), bool)
    if p.bias_limit is not None:
        limit = jnp.asarray(p.bias_limit, bias.dtype)
        clipped = (jnp.abs(bias) > limit).any()
        bias = jnp.clip(bias, -limit, limit)
    mean = jnp.concatenate([Z, bias, info.mean[6:]])
    if p.options.value.project:
        n = len(mean)
        onto = (jnp.eye(3, dtype=Z.dtype) - Z[:, None] * Z[None, :]) / length
        M = jnp.eye(n, dtype=Z.dtype).at[:3, :3].set(onto)
        projected = sym(M @ cov @ M.T)
        cov = projected if inp.mask is None else jnp.where(inp.mask.any(), projected, cov)
    if inp.mask is not None:
        mean = jnp.where(inp.mask.any(), mean, s.mean)
        Z = mean[:3]
    a_ext = jnp.where(usable, inp.y - p.gravity * Z, s.a_ext)
    roll, pitch, undefined = angles(Z, s.roll)
    status = info.status | s.pending | flag(lost | clipped | undefined, Status.BOUND)
    extra = {"a_ext": a_ext, "roll": roll, "pitch": pitch}
    s = s._replace(mean=mean, cov=cov, a_ext=a_ext, roll=roll, pending=jnp.int32(0))
    return s, info._replace(mean=mean, cov=cov, status=status, extra=extra)


def _moments(p, s):
    return s.mean, s.cov


def _with_moments(p, s, mean, cov):
    return s._replace(mean=mean, cov=cov)
