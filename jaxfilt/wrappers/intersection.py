"""Fusing a fit with the filter's own estimate when both come from the same data."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxfilt.core import Filter, Static, Status, Wrapped, check_filter, flag, multiply, present, wrap
from jaxfilt.filters.common import decoupled
from jaxfilt.linalg import chol, solve_lower
from jaxfilt.wrappers.common import covariances, predict_measurement
from jaxfilt.wrappers.window import check_fit, extrapolate, init_window, predict_window, push, select

_GRID = 20  # weights 1/20 .. 1


class _Options(NamedTuple):
    window: int
    degree: int
    max_age: int | None


class _Params(NamedTuple):
    inner: Filter
    forgetting: Any  # ()
    options: Static


def covariance_intersection(
    filt: Filter, *, window: int = 10, degree: int = 1, forgetting: Any = 1.0, max_age: int | None = None
) -> Filter:
    """Fuses the coasting filter with a polynomial through the last samples by covariance intersection.

    The fit z with variance R l (l its leverage) depends on data that the filter has used. Whatever the correlation,
    ``P_w^-1 = w P^-1 + (1 - w) H' (R l)^-1 H`` is no smaller than the error covariance of
    ``m_w = P_w (w P^-1 m + (1 - w) H' (R l)^-1 z)`` as long as P and R l are right. That is an update of ``(m, P / w)``
    with noise ``R l / (1 - w)``. w is the one of 1/20, 2/20, ..., 1 with the smallest ``log det P_w``; w = 1 is plain
    coasting. Only absent components are fused so, after the update with the present ones.

    Info is that of the real data (``log_lik`` is exactly 0 in a gap), with the fused mean and cov. ``extra["weight"]``
    () is w. Status: PSEUDO where w < 1; MISSED stays set.

    Args:
        filt: the filter, with ``moments`` and ``with_moments``; must honor ``r_scale``.
        window: number N of samples of each channel.
        degree: of the polynomial, less than ``window``.
        forgetting: weight of a sample per step of its age, in (0, 1]. May be traced.
        max_age: as in :func:`jaxfilt.polynomial_fit`.

    The choice of w is hard: gradients go through the chosen one only.

    Raises:
        ValueError: a filter without moments or with_moments; window < 1, degree < 0 or >= window, forgetting outside
            (0, 1], max_age < 1; at trace time, a filter that reports no innovation_cov or noise_cov.

    Source: Julier and Uhlmann 1997.
    """
    check_filter(filt)
    if filt.moments is None or filt.with_moments is None:
        raise ValueError("filt: covariance intersection needs a filter with moments and with_moments")
    max_age = 3 * window if max_age is None and isinstance(window, int) else max_age
    check_fit(window, degree, forgetting, max_age)
    params = _Params(filt, forgetting, Static(_Options(window, degree, max_age)))
    return wrap(params, init=init_window, predict=predict_window, update=_update)


def _update(p, s, inp):
    options, inner = p.options.value, p.inner
    mask = present(inp)
    after, real = inner.update(s.inner, inp)
    predicted, dry = predict_measurement(inner, after, inp)
    memory = push(s.memory, jnp.where(mask & jnp.isfinite(inp.y), inp.y, predicted), mask)
    one = jnp.ones((), inp.y.dtype)
    if inp.mask is None:
        return Wrapped(after, memory), real._replace(extra={**real.extra, "weight": one})
    S, R = covariances(dry, "covariance intersection")
    used = select(s.memory, options.window, options.max_age)
    fit = extrapolate(s.memory, used, options.degree, p.forgetting)
    filled = ~mask & fit.available
    mean, cov = inner.moments(after)
    leverage = jnp.where(filled, fit.leverage, one)
    spread = jnp.sqrt(leverage)
    fit_cov = spread[:, None] * R * spread[None, :]
    w = _best_weight(S - R, fit_cov, filled, mean.shape[0])
    fused = filled.any() & (w < 1)
    w_fit = jnp.where(fused, 1 - w, one)  # at w = 1 the fit's noise would be infinite
    pseudo = inp._replace(
        y=jnp.where(filled, fit.value, predicted),
        mask=filled,
        r_scale=multiply(inp.r_scale, leverage / w_fit),
    )
    # Of the second update only the moments are kept: other memories of the filter belong to real data.
    moments = inner.moments(inner.update(inner.with_moments(after, mean, cov / w), pseudo)[0])
    after = jax.tree.map(lambda new, old: jnp.where(fused, new, old), inner.with_moments(after, *moments), after)
    info = real._replace(
        mean=jnp.where(fused, moments[0], real.mean),
        cov=jnp.where(fused, moments[1], real.cov),
        status=real.status | flag(fused, Status.PSEUDO),
        extra={**real.extra, "weight": w},
    )
    return Wrapped(after, memory), info


def _best_weight(A, B, filled, n):
    """The w of the grid with the smallest log det P_w, up to a constant: of ``-n log w - log det(I + (1-w)/w B^-1 A)``.

    A = H P H' and B = R l (m, m) count over the filled components only.
    """
    L = chol(decoupled(filled, B))
    A = jnp.where(filled[:, None] & filled[None, :], A, jnp.zeros((), A.dtype))
    whitened = solve_lower(L, solve_lower(L, A).T)
    grid = jnp.arange(_GRID, 0, -1, dtype=A.dtype) / _GRID  # from 1 down, so that a tie leaves the filter alone

    def log_det(w):
        diagonal = jnp.diagonal(chol(jnp.eye(A.shape[0], dtype=A.dtype) + (1 - w) / w * whitened))
        return -n * jnp.log(w) - 2 * jnp.sum(jnp.log(diagonal))

    return grid[jnp.argmin(jax.vmap(log_det)(grid))]
