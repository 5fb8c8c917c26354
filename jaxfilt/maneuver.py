"""Detecting that a target maneuvers: statistics of the innovations of a filter that assumes it does not.

While the model holds, innovations are white with covariance S, and each statistic here has a known law; a maneuver
biases them. The statistics are recursions over :class:`jaxfilt.Info` (:func:`start`, :func:`advance`,
:func:`evaluate`), used by :func:`jaxfilt.detected` and :func:`jaxfilt.variable_dimension`; :func:`cumulative` is for
looking back at a whole run.

Source: Bar-Shalom, Li and Kirubarajan 2001, sections 5.4 and 11.2; thesis on lost targets, eqs. (3-17) to (3-22).
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.chi2 import chi2_quantile
from jaxfilt.core import Info, Status, check_count, check_float, is_concrete, number, real_array
from jaxfilt.filters.common import decoupled
from jaxfilt.linalg import chol, solve_lower, sym

STATISTICS = ("nis", "fading", "window", "sum")


class Detector(NamedTuple):
    """Which statistic, and when it alarms; all static, since the thresholds are computed while tracing."""

    statistic: str
    p_false: float
    forgetting: float
    window: int


class Memory(NamedTuple):
    """What a detector carries: terms of the last used samples, the newest first (only one for ``"fading"``)."""

    terms: Array  # (L,) NIS, or (L, m) whitened innovations for "sum"
    counts: Array  # int32, like terms: the components that stand behind each


class Cumulative(NamedTuple):
    """The NIS summed from the first sample on."""

    statistic: Array  # (..., T)
    dof: Array  # (..., T) degrees of freedom if the model is right
    p_value: Array  # (..., T) probability of at least this value then


def detector(statistic: str = "fading", *, p_false: float = 1e-3, forgetting: float = 0.8, window: int = 5) -> Detector:
    """Options of a detector, checked.

    With ``eps = nu' S^-1 nu`` and m measured components:

    * ``"nis"``: ``eps_k``, chi-square with m degrees of freedom (3-17);
    * ``"fading"``: ``rho_k = lambda rho_{k-1} + eps_k`` (3-20), mean ``m / (1 - lambda)``, variance
      ``2 m / (1 - lambda^2)``; by these moments ``(1 + lambda) rho`` is about chi-square with
      ``m (1 + lambda) / (1 - lambda)`` degrees of freedom;
    * ``"window"``: the sum of the last L ``eps``, chi-square with m L;
    * ``"sum"``: ``D' D / L`` with ``D`` the sum of the last L whitened innovations ``S^-1/2 nu``, chi-square with m
      (3-21, where the innovations are not whitened). Innovations of a constant bias add up here, so this one is the
      quickest to see a weak maneuver.

    A sample without any usable component contributes nothing: rho is held, not decayed, and the window does not move.
    A partly present sample counts with the components it has: exactly, but for ``"fading"``, whose threshold stays that
    of whole samples (fewer alarms). The same goes for the first samples, where the window is not yet full.

    Args:
        statistic: ``"nis"``, ``"fading"``, ``"window"`` or ``"sum"``.
        p_false: probability of an alarm per sample while the model is right.
        forgetting: lambda of ``"fading"``, in [0, 1); the effective memory is 1 / (1 - lambda) samples.
        window: L of ``"window"`` and ``"sum"``, in samples.

    Raises:
        ValueError: an unknown statistic or a value out of range.
        TypeError: p_false or forgetting is no plain number.

    Source: Bar-Shalom, Li and Kirubarajan 2001, sections 5.4.2 and 11.2.
    """
    if statistic not in STATISTICS:
        raise ValueError(f"statistic: expected one of {STATISTICS}, got {statistic!r}")
    p_false, forgetting = static_number("p_false", p_false), static_number("forgetting", forgetting)
    if not 1e-9 <= p_false < 1:
        raise ValueError(f"p_false: expected a value in [1e-9, 1), got {p_false}")
    if not 0 <= forgetting < 1:
        raise ValueError(f"forgetting: expected a value in [0, 1), got {forgetting}")
    check_count("window", window, 1)
    return Detector(statistic, p_false, forgetting, 1 if statistic in ("nis", "fading") else window)


def static_number(name: str, value: Any) -> float:
    """The value as a Python float, or a TypeError that names it: a traced value cannot be static."""
    try:
        return number(name, value)
    except (TypeError, ValueError, jax.errors.ConcretizationTypeError):
        raise TypeError(f"{name}: expected a plain number (it is static), got {value!r}") from None


def threshold(detector: Detector, dof: int) -> float:
    """The value above which the detector alarms.

    Args:
        detector: from :func:`detector`.
        dof: degrees of freedom of the statistic; for ``"fading"`` those m of one sample.
    """
    probability = 1 - detector.p_false
    if detector.statistic != "fading":
        return _quantile(probability, dof)
    lam = detector.forgetting
    return _quantile(probability, dof * (1 + lam) / (1 - lam)) / (1 + lam)


_quantile = cache(chi2_quantile)


def start(detector: Detector, y: Array) -> Memory:
    """The memory before the first sample, for measurements like y (m,)."""
    shape = (detector.window, *y.shape) if detector.statistic == "sum" else (detector.window,)
    return Memory(jnp.zeros(shape, y.dtype), jnp.zeros(shape, jnp.int32))


def advance(detector: Detector, memory: Memory, info: Info, usable: Array) -> Memory:
    """The memory with one step's Info taken in; unchanged by a missed or gated sample, or one with nothing usable.

    Args:
        detector: from :func:`detector`.
        memory: from :func:`start` or the step before.
        info: of the step's update.
        usable: (m,) bool, the components that are present and finite.

    Raises:
        ValueError: at trace time, if the filter reports no ``nis`` (for ``"sum"``: no ``innovation_cov``).
    """
    if (info.innovation_cov if detector.statistic == "sum" else info.nis) is None:
        raise ValueError(f'filt: the statistic "{detector.statistic}" needs a filter that reports nis, innovation_cov')
    info = jax.lax.stop_gradient(info)  # an alarm is a hard decision
    if detector.statistic == "sum":
        S: Any = info.innovation_cov
        term, count = solve_lower(chol(decoupled(usable, S)), info.innovation), usable.astype(jnp.int32)
    else:
        term, count = jnp.asarray(info.nis), usable.sum().astype(jnp.int32)
    if detector.statistic == "fading":
        new = Memory(detector.forgetting * memory.terms + term, jnp.full_like(memory.counts, usable.shape[0]))
    else:
        new = Memory(
            jnp.concatenate([term[None], memory.terms[:-1]]),
            jnp.concatenate([count[None], memory.counts[:-1]]),
        )
    used = usable.any() & ((info.status & int(Status.MISSED | Status.GATED)) == 0)
    return jax.tree.map(lambda a, b: jnp.where(used, a, b), new, memory)


def evaluate(detector: Detector, memory: Memory, m: int) -> tuple[Array, Array]:
    """``(statistic (), alarm () bool)`` of a memory, for m measured components."""
    terms, largest = memory.terms, m
    if detector.statistic == "sum":
        counts = memory.counts.sum(axis=0)
        squares = terms.sum(axis=0) ** 2 / jnp.maximum(counts, 1).astype(terms.dtype)
        statistic, dof = squares.sum(), (counts > 0).sum()
    else:
        statistic, dof = terms.sum(), memory.counts.sum()
        largest = m * detector.window
    table = np.array([np.inf, *(threshold(detector, d) for d in range(1, largest + 1))])
    return statistic, statistic > jnp.asarray(table, statistic.dtype)[dof]


def cumulative(nis: Any, mask: Any = None, *, m: int = 1) -> Cumulative:
    """The NIS summed from the first sample on (3-18): an offline check of a whole run, not a detector.

    Its degrees of freedom grow with every sample, so it forgets nothing and reacts ever more slowly.

    Args:
        nis: (..., T) from a filter's outputs.
        mask: (T, m) or (..., T, m) bool, True = present; None = all present.
        m: number of measured components, if no mask is given.

    Returns:
        ``Cumulative(statistic, dof, p_value)``, each (..., T); p_value is 1 before the first sample.
    """
    check_float("nis", nis)
    check_count("m", m, 1)
    nis = jnp.asarray(nis)
    mask = jnp.ones((*nis.shape[-1:], m), bool) if mask is None else real_array("mask", mask)
    if mask.dtype != np.dtype(bool):
        raise TypeError(f"mask: expected bool, got {mask.dtype}")
    if is_concrete(nis) and (np.asarray(nis) < 0).any():
        raise ValueError(f"nis: expected values >= 0, got {np.asarray(nis).min()}")
    if nis.ndim == 0 or mask.ndim < 2 or mask.shape[:-1] not in (nis.shape, nis.shape[-1:]):
        raise ValueError(f"nis, mask: expected shapes (..., T) and (..., T, m), got {nis.shape} and {mask.shape}")
    counts = mask.sum(axis=-1)
    dof = jnp.broadcast_to(jnp.cumsum(counts, axis=-1), nis.shape)
    statistic = jnp.cumsum(nis, axis=-1)
    p_value = jax.scipy.special.gammaincc(0.5 * jnp.maximum(dof, 1).astype(nis.dtype), 0.5 * statistic)
    return Cumulative(statistic, dof, jnp.where(dof > 0, p_value, jnp.ones_like(p_value)))


def restart(mean: Array, cov: Array, y: Array, R: Array, T: Array) -> tuple[Array, Array]:
    """Moments of ``[p, v, a]`` at a sample, if a constant acceleration of unknown size began an interval T before it.

    From the constant-velocity estimate ``p, v`` at the beginning::

        a = 2 (y - p - T v) / T^2,     p' = y,     v' = v + T a

    and the covariance is that of ``M [y; p; v]``, with ``Cov(y) = R`` and the given one of ``[p; v]``. It equals the
    limit of a constant-acceleration filter without process noise whose prior variance of a goes to infinity.

    Args:
        mean: (2d,) positions and velocities one interval earlier.
        cov: (2d, 2d).
        y: (d,) measured positions.
        R: (d, d).
        T: () interval, > 0.

    Returns:
        ``(mean (3d,), cov (3d, 3d))``.

    Source: Bar-Shalom and Birmiwal 1982; Bar-Shalom, Li and Kirubarajan 2001, section 11.4; (3-22).
    """
    d = y.shape[0]
    zero, one = jnp.zeros_like(T), jnp.ones_like(T)
    rows = [[one, zero, zero], [2 / T, -2 / T, -one], [2 / T**2, -2 / T**2, -2 / T]]
    M = jnp.kron(jnp.stack([jnp.stack(row) for row in rows]), jnp.eye(d, dtype=T.dtype))
    joint = jnp.zeros((3 * d, 3 * d), T.dtype).at[:d, :d].set(R).at[d:, d:].set(cov)
    return M @ jnp.concatenate([y, mean]), sym(M @ joint @ M.T)


def significance(mean: Array, cov: Array, d: int) -> Array:
    """``a' P_aa^-1 a`` (), how significant the acceleration of a state ``[p, v, a]`` over d axes is."""
    whitened = solve_lower(chol(cov[2 * d :, 2 * d :]), mean[2 * d :])
    return jnp.sum(whitened * whitened)
