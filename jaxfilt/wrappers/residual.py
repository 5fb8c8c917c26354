"""Noise learned sample by sample from posterior residuals, and process noise enlarged by surprising innovations."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import Filter, Static, Status, Wrapped, flag, is_concrete, present, wrap
from jaxfilt.models.linear import check_positive
from jaxfilt.wrappers.common import check_count, covariances
from jaxfilt.wrappers.noise import check_rate, scaled, usable


class _Residual(NamedTuple):
    inner: Filter
    rate: Any  # ()
    largest: Any  # ()


class _Nis(NamedTuple):
    inner: Filter
    largest: Any  # ()
    window: Static


class _Window(NamedTuple):
    scale: Array  # ()
    nis: Array  # (N,), the newest first; 0 where there is none yet
    counts: Array  # (N,) components behind each


def residual_r(filt: Filter, *, rate: Any = 0.02, largest: Any = 100.0) -> Filter:
    """Estimates the diagonal of R from what is left of each measurement after its update.

    With the residual ``e = y - h(m+)`` and ``H+`` at the updated mean, per channel that was used::

        R_ii <- (1 - rate) R_ii + rate min(e_i^2 + (H+ P+ H+')_ii, largest R0_ii)

    Positive by construction, and no units are mixed. :func:`sage_husa` with a full memory (``forgetting = 1 - rate``,
    ``prior = 1 / rate``) is this rule with e and H P+ H' from the linearization at the prediction instead; what is said
    there of when it helps and when it harms holds here. What step k teaches is in force from step k+1 on.

    Info: ``extra["r_scale"]`` (m,): estimate times the model's own, after the step.

    Status: BOUND where a sample asked for more than ``largest``.

    Args:
        filt: reports innovation_cov and noise_cov, and honors r_scale. It is asked a second time after each update.
        rate: in [0, 1); 0 leaves the filter as it is. May be traced.
        largest: factor on R that a sample may ask for, > 0.

    Raises:
        ValueError: rate outside [0, 1), largest <= 0; at trace time, a filter without innovation_cov or noise_cov.

    Source: Akhlaghi, Zhou and Huang 2017; the bound is ours.
    """
    check_rate(rate)
    check_positive("largest", largest, scalar=True)
    return wrap(_Residual(filt, rate, largest), init=_residual_init, predict=_residual_predict, update=_residual_update)


def nis_q(filt: Filter, *, window: int = 25, largest: Any = 100.0) -> Filter:
    """Enlarges Q while innovations are larger than expected, always relative to the model's own Q.

    ``q_scale = clip(sum NIS / sum m, 1, largest)`` over the last ``window`` samples that were used, m the number of
    components of each. It cannot run away, and returns to 1 a window after the surprise. What step k teaches is in
    force from step k+1 on. NIS tells neither a wrong R from a wrong Q: use it where R is known, or nest it with a
    wrapper that adapts R at your own risk.

    Info: ``extra["q_scale"]`` (), after the step.

    Status: BOUND where more than ``largest`` was asked for.

    Args:
        filt: reports nis, and honors q_scale.
        window: samples, >= 2.
        largest: factor on Q, >= 1; 1 leaves the filter as it is. May be traced.

    Raises:
        ValueError: window < 2, largest < 1; at trace time, a filter without nis.
    """
    check_count("window", window, 2)
    check_positive("largest", largest, scalar=True)
    if is_concrete(largest) and not (np.asarray(largest) >= 1).all():
        raise ValueError(f"largest: expected a value >= 1, got {largest}")
    return wrap(_Nis(filt, largest, Static(window)), init=_nis_init, predict=_nis_predict, update=_nis_update)


def _residual_init(p, inp):
    return Wrapped(p.inner.init(inp), jnp.ones(inp.y.shape, inp.y.dtype))


def _residual_predict(p, s, inp):
    inner, prediction = p.inner.predict(s.inner, scaled("r", inp, s.memory))
    return s._replace(inner=inner), prediction


def _residual_update(p, s, inp):
    scale = s.memory
    inp_r = scaled("r", inp, scale)
    inner, info = p.inner.update(s.inner, inp_r)
    _, after = p.inner.update(inner, inp_r)  # dry: what the updated state expects, and how surely
    S, R = covariances(after, "residual_r")
    used = usable(inp, info)
    variance = jnp.diagonal(R)  # scale R0, and what curvature adds to it
    ok = used & (variance > 0)
    asked = scale * (after.innovation**2 + jnp.diagonal(S) - variance) / jnp.where(ok, variance, 1.0)
    largest, rate = jnp.asarray(p.largest, scale.dtype), jnp.asarray(p.rate, scale.dtype)
    new = jnp.where(ok, (1 - rate) * scale + rate * jnp.minimum(asked, largest), scale)
    status = info.status | flag((ok & (asked > largest)).any(), Status.BOUND)
    return Wrapped(inner, new), info._replace(status=status, extra={**info.extra, "r_scale": new})


def _nis_init(p, inp):
    empty = jnp.zeros((p.window.value,), inp.y.dtype)
    return Wrapped(p.inner.init(inp), _Window(jnp.ones((), inp.y.dtype), empty, empty))


def _nis_predict(p, s, inp):
    inner, prediction = p.inner.predict(s.inner, scaled("q", inp, s.memory.scale))
    return s._replace(inner=inner), prediction


def _nis_update(p, s, inp):
    memory = s.memory
    inner, info = p.inner.update(s.inner, scaled("q", inp, memory.scale))  # stationary filters solve for P here
    if info.nis is None:
        raise ValueError("filt: nis_q needs a filter that reports nis")
    used = usable(inp, info).any()
    count = present(inp).sum().astype(memory.nis.dtype)
    nis, counts = (
        jnp.where(used, jnp.concatenate([new[None], old[:-1]]), old)
        for new, old in ((info.nis, memory.nis), (count, memory.counts))
    )
    total = counts.sum()
    asked = nis.sum() / jnp.where(total > 0, total, 1.0)
    largest = jnp.asarray(p.largest, asked.dtype)
    scale = jnp.clip(asked, 1.0, largest)
    status = info.status | flag(used & (asked > largest), Status.BOUND)
    extra = {**info.extra, "q_scale": scale}
    return Wrapped(inner, _Window(scale, nis, counts)), info._replace(status=status, extra=extra)
