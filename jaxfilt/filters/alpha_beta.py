"""Fixed-gain tracking filters: alpha-beta and alpha-beta-gamma, one implementation."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import Filter, Info, Prediction, Static, Status, StepInput, bind, flag, is_concrete, numbers, present
from jaxfilt.filters.common import check_dtype, check_measurement, decoupled, innovate, likelihood
from jaxfilt.filters.gains import check_stable, growing_memory, is_stable, to_kappa
from jaxfilt.linalg import chol, scale_cov, solve_lower, sym
from jaxfilt.models.linear import check_covariance, check_finite, check_positive, common_dtype

_STARTS = ("growing", "two_point", "none")
_NAMES = ("alpha", "beta", "gamma")


class FixedGainState(NamedTuple):
    """State of a fixed-gain filter over m axes. All but the mean depends on mask and dt only, so batches share it."""

    mean: Array  # (n,) positions, velocities (, accelerations)
    cov: Array | None  # (n, n), None without r
    count: Array  # (m,) int32, measurements of each axis so far; set it to 0 to start anew after a maneuver
    elapsed: Array  # (m,) time since the last of them (since the beginning before the first)
    interval: Array  # (m,) time between the last two


class _Params(NamedTuple):
    gains: tuple[Any, ...]  # alpha, beta (, kappa), each () or (K,)
    dt: Any
    r: Any
    m0: Any
    start: Static


def alpha_beta(alpha: Any, beta: Any, *, dt: Any, r: Any = None, m0: Any = None, start: str | None = None) -> Filter:
    """The alpha-beta filter: fixed gains on a constant-velocity prediction, for any number of independent axes.

    Per axis: ``p- = p + dt v``, ``e = z - p-``, ``p = p- + alpha e``, ``v = v- + (beta / h) e``, with ``h`` the time
    since the axis' last measurement, which is ``dt`` unless samples are missing. The state is
    ``[positions (m,), velocities (m,)]``; m is taken from the measurements.

    A missing component is predicted only: its axis' measurement counter stands still, and its next residual and its
    next gain use the elapsed time. A masked series therefore equals the series without those samples and with their
    intervals summed. (With ``beta / dt`` instead, Cohen's gains diverge where one sample in 20 is present.)

    Args:
        alpha: position gain, scalar or one per measurement (K,), indexed by the count of the axis' measurements, the
            last one held. May be traced. See :mod:`jaxfilt.gains` for the rules.
        beta: velocity gain, likewise.
        dt: interval [s]; per step, ``jf.filter(..., dt=)`` overrides it.
        r: measurement variance [m^2]: scalar, (m,) or (m, m). With it the filter reports the covariance of what the
            measurement noise alone does to the estimate, ``P = A P A' + K r K'`` from 0 at the beginning, and with that
            S, NIS and log-likelihood. The motion is taken as free of noise and ``m0`` as exact, so it says nothing of
            the lag behind a maneuver, and a smoother has no use for it (``jf.rts`` refuses).
        m0: (2 m,) mean before the first prediction; zeros if None.
        start: how the first measurements of an axis are used.
            ``"growing"`` (default without m0): growing-memory gains floored by the constant ones; exactly the
            least-squares line until the floor is reached. The first measurement sets the position.
            ``"two_point"``: position from the first measurement, velocity from the first two (not with m0).
            ``"none"`` (default with m0, which it needs): the constant gains from the first measurement on.
            Measurements that a start uses to determine the state (two, for alpha-beta-gamma three) have no predictive
            density: they are left out of NIS and log-likelihood.

    ``info.extra["stable"]`` () bool says whether the (last) gains are stable; traced gains cannot be refused.
    Status: MISSED, NONFINITE (its innovation is taken as 0, and it counts as a measurement), SINGULAR, BOUND (a
    measurement no time after the last: the velocity gain then uses the nominal ``dt``).

    Raises:
        ValueError: concrete gains outside the stable region (of those per measurement the last), dt <= 0, r not
            positive, wrong shapes; at trace time ``q_scale``, or ``r_scale`` without ``r``, which cannot be honored.
        TypeError: integer arrays or mixed float dtypes.

    Source: Sklansky 1957; Benedict and Bordner 1962; thesis, eqs. (2-1) to (2-32); Joseph form for any gain: Bucy and
    Joseph 1968.
    """
    return _fixed_gain((alpha, beta), dt, r, m0, start)


def alpha_beta_gamma(
    alpha: Any,
    beta: Any,
    gamma: Any,
    *,
    dt: Any,
    r: Any = None,
    m0: Any = None,
    start: str | None = None,
    convention: str = "kappa",
) -> Filter:
    """The alpha-beta-gamma filter: fixed gains on a constant-acceleration prediction.

    As :func:`alpha_beta`, with ``[positions, velocities, accelerations]`` (3 m,) as the state and
    ``a = a- + (kappa / h^2) e``.

    Args:
        alpha: position gain, scalar or (K,).
        beta: velocity gain, scalar or (K,).
        gamma: acceleration gain, scalar or (K,), in the given convention.
        dt: interval [s].
        r: measurement variance [m^2]: scalar, (m,) or (m, m).
        m0: (3 m,) mean before the first prediction.
        start: ``"growing"`` (least-squares parabola), ``"two_point"`` (moreover the acceleration from the second
            difference of the first three measurements), or ``"none"``.
        convention: ``"kappa"``: kappa = gamma (what :mod:`jaxfilt.gains` returns); ``"double"``: kappa = 2 gamma;
            ``"kalata"``: kappa = gamma / 2.

    Source: Simpson 1963; Kalata 1984; thesis, eqs. (2-33) to (2-50).
    """
    if isinstance(gamma, list | tuple):
        gamma = tuple(to_kappa(g, convention) for g in gamma)
    else:
        if is_concrete(gamma):
            numbers("gamma", gamma)
        gamma = to_kappa(gamma, convention)
    return _fixed_gain((alpha, beta, gamma), dt, r, m0, start)


def _fixed_gain(gains, dt, r, m0, start):
    if start is None:
        start = "growing" if m0 is None else "none"
    if start not in _STARTS:
        raise ValueError(f"start: expected one of {', '.join(map(repr, _STARTS))}, got {start!r}")
    if start == "none" and m0 is None:
        raise ValueError('m0: start="none" needs it, got None')
    if start == "two_point" and m0 is not None:
        raise ValueError('m0: start="two_point" takes the state from the measurements; give one of them')
    p = _Params(tuple(_floats(g) for g in gains), _floats(dt), _floats(r), _floats(m0), Static(start))
    optional = {name: x for name, x in (("r", p.r), ("m0", p.m0)) if x is not None}
    common_dtype({**dict(zip(_NAMES, p.gains, strict=False)), "dt": p.dt, **optional})
    check_positive("dt", p.dt)
    for name, gain in zip(_NAMES, p.gains, strict=False):
        if len(_shape(gain)) > 1 or 0 in _shape(gain):
            raise ValueError(f"{name}: expected a scalar or one gain per measurement (K,), got shape {_shape(gain)}")
        check_finite(name, gain)
    check_stable(*(_last(g) for g in p.gains), third="kappa of gamma")
    if len(_shape(p.dt)) > 0:
        raise ValueError(f"dt: expected a scalar, got shape {_shape(p.dt)}; per step, use jf.filter(..., dt=)")
    if len(_shape(p.r)) > 2 or len(set(_shape(p.r))) > 1:
        raise ValueError(f"r: expected a scalar, shape (m,) or (m, m), got {_shape(p.r)}")
    if len(_shape(p.r)) == 2:
        if is_concrete(p.r):
            check_covariance("r", np.asarray(p.r))
    elif p.r is not None:
        check_positive("r", p.r)
    if p.m0 is not None:
        if len(_shape(p.m0)) != 1 or _shape(p.m0)[0] % len(gains):
            raise ValueError(f"m0: expected shape ({len(gains)} m,) for m axes, got {_shape(p.m0)}")
        check_finite("m0", p.m0)
    if p.r is None:
        return bind(p, _init, _predict, _update)
    return bind(p, _init, _predict, _update, _moments, _with_moments)


def _floats(x):
    """Python numbers (and sequences of them) stay Python numbers, so that they take the dtype of the measurements."""
    if isinstance(x, list | tuple):
        return tuple(_floats(item) for item in x)
    return float(x) if isinstance(x, int) else x


def _shape(x) -> tuple[int, ...]:
    if isinstance(x, tuple):
        return (len(x), *(_shape(x[0]) if x else ()))
    return () if x is None else jnp.shape(x)


def _last(gain):
    if len(_shape(gain)) == 0:
        return gain
    # A transformation traces even the indexing of a concrete JAX array.
    return np.asarray(gain)[-1] if is_concrete(gain) else gain[-1]


def _init(p, inp: StepInput):
    m, dtype = inp.y.shape[0], inp.y.dtype
    strong = [x for x in jax.tree.leaves(p) if hasattr(x, "dtype") and not getattr(x, "weak_type", False)]
    if strong:  # Python numbers alone take the dtype of ys
        check_dtype(inp, jnp.asarray(strong[0]))
    n = len(p.gains) * m
    if p.m0 is not None:
        check_measurement(inp, _shape(p.m0)[0] // len(p.gains), "m0")
    if len(_shape(p.r)) > 0:
        check_measurement(inp, _shape(p.r)[0], "r")
    mean = jnp.zeros((n,), dtype) if p.m0 is None else jnp.asarray(p.m0, dtype)
    cov = None if p.r is None else jnp.zeros((n, n), dtype)
    zeros = jnp.zeros((m,), dtype)
    return FixedGainState(mean, cov, jnp.zeros((m,), jnp.int32), zeros, zeros)


def _predict(p, s: FixedGainState, inp: StepInput):
    if inp.q_scale is not None:
        raise ValueError("q_scale: a fixed-gain filter has no process noise to scale")
    m, blocks = inp.y.shape[0], len(p.gains)
    dt = jnp.asarray(p.dt, inp.y.dtype) if inp.dt is None else inp.dt
    taylor = (jnp.ones((), dt.dtype), dt, 0.5 * dt * dt)
    X = s.mean.reshape(blocks, m)
    # Written out: a product with F would be a small matrix product per run of a batch, several times slower.
    mean = jnp.concatenate([sum((taylor[j - i] * X[j] for j in range(i + 1, blocks)), X[i]) for i in range(blocks)])
    s = s._replace(mean=mean, elapsed=s.elapsed + dt)
    if s.cov is None:
        return s, Prediction(mean)
    zero = jnp.zeros((), dt.dtype)
    F = jnp.stack([jnp.stack([taylor[j - i] if j >= i else zero for j in range(blocks)]) for i in range(blocks)])
    F = _per_axis(jnp.broadcast_to(F[:, :, None], (blocks, blocks, m)))
    cov = sym(F @ s.cov @ F.T)
    # No cross-covariance: without process noise a smoother would only extrapolate the last estimate backwards.
    return s._replace(cov=cov), Prediction(mean, cov)


def _update(p, s, inp: StepInput):
    if inp.r_scale is not None and p.r is None:
        raise ValueError("r_scale: the filter was made without r, so there is no measurement noise to scale")
    m, blocks = inp.y.shape[0], len(p.gains)
    here = present(inp)
    X = s.mean.reshape(blocks, m)
    nu, _, status = innovate(inp, X[0])
    gain, carry, interval = _gain(p, s)
    gain = jnp.where(here[None, :], gain, 0.0)
    mean = X + gain * nu[None, :]
    if carry is not None:
        carry = jnp.where(here, carry, 0.0)
        mean = mean + jnp.stack([jnp.zeros_like(carry), jnp.zeros_like(carry), carry * X[1]])
    status = status | flag((here & (s.count > 0) & (s.elapsed <= 0)).any(), Status.BOUND)

    cov = S = nis = log_lik = R = None
    if p.r is not None:
        R = _noise(p, inp)
        S = sym(s.cov[:m, :m] + R)
        # Joseph's form, right for any gain: x = A x- + K z. G takes the first block.
        A = jnp.broadcast_to(jnp.eye(blocks, dtype=gain.dtype)[:, :, None], (blocks, blocks, m))
        A = A.at[:, 0, :].add(-gain)
        if carry is not None:
            A = A.at[2, 1, :].add(carry)
        A, K = _per_axis(A), _per_axis(gain[:, None, :])
        cov = sym(A @ s.cov @ A.T + K @ R @ K.T)
        scored = inp.mask
        if p.start.value != "none":
            scored = here & (s.count >= blocks)  # earlier ones determine the state: nothing predicted them
        L = chol(decoupled(scored, S))
        whitened = solve_lower(L, nu if scored is None else jnp.where(scored, nu, 0.0))
        nis, log_lik, singular = likelihood(scored, L, whitened)
        status = status | singular

    stable = jnp.asarray(is_stable(*(jnp.asarray(_last(g), inp.y.dtype) for g in p.gains)))
    s = FixedGainState(
        mean.reshape(-1),
        cov,
        s.count + here.astype(jnp.int32),
        jnp.where(here, 0.0, s.elapsed),
        jnp.where(here, interval, s.interval),
    )
    return s, Info(s.mean, cov, nu, S, nis, log_lik, status, noise_cov=R, extra={"stable": stable})


def _gain(p, s):
    """``(gain, carry, interval)``: the gain (blocks, m), what the start adds to a per unit of v- (m,), and h (m,)."""
    dtype = s.mean.dtype
    h = jnp.where(s.elapsed > 0, s.elapsed, jnp.asarray(p.dt, dtype))  # no prediction before this update: nominal
    blocks, k = len(p.gains), s.count + 1
    gains = [_at(gain, s.count, dtype) for gain in p.gains]
    carry = None
    if p.start.value == "growing":
        growing = growing_memory(k.astype(dtype), order=blocks - 1)
        gains = [jnp.where(k < blocks, a, jnp.maximum(a, b)) for a, b in zip(growing, gains, strict=True)]
    elif p.start.value == "two_point":
        gains[0] = jnp.where(k == 1, 1.0, gains[0])
        gains[1] = jnp.where(k == 1, 0.0, jnp.where(k == 2, 1.0, gains[1]))
        if blocks == 3:
            # a = 2 ((z2 - z1) / h - (z1 - z0) / h1) / (h + h1) from what the state still knows of the measurements:
            # (z1 - z0) / h1 = v-, z1 = z2 - e - h v- + (1 - alpha) h1 v-.
            alpha = _at(p.gains[0], s.count - 1, dtype)
            gains[2] = jnp.where(k < 3, 0.0, jnp.where(k == 3, 2 * h / (h + s.interval), gains[2]))
            carry = jnp.where(k == 3, -2 * (1 - alpha) * s.interval / (h * (h + s.interval)), 0.0)
    return jnp.stack([gain / h**i for i, gain in enumerate(gains)]), carry, h


def _at(gain, count, dtype):
    gain = jnp.asarray(gain, dtype)
    if gain.ndim == 0:
        return jnp.broadcast_to(gain, count.shape)
    return gain[jnp.clip(count, 0, gain.shape[0] - 1)]


def _noise(p, inp):
    m, r = inp.y.shape[0], jnp.asarray(p.r, inp.y.dtype)
    R = r if r.ndim == 2 else jnp.diag(jnp.broadcast_to(r, (m,)))
    return scale_cov(R, inp.r_scale)


def _per_axis(B):
    """The (i m, j m) matrix that applies B[:, :, a] (i, j) to axis a, in block order."""
    i, j, m = B.shape
    return (jnp.swapaxes(B, 1, 2)[:, :, :, None] * jnp.eye(m, dtype=B.dtype)[None, :, None, :]).reshape(i * m, j * m)


def _moments(p, s):
    return s.mean, s.cov


def _with_moments(p, s, mean, cov):
    return s._replace(mean=mean, cov=cov)
