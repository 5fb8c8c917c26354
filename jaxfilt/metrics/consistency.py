"""Does a filter's covariance tell the truth? NEES, NIS, their chi-square regions, and whiteness of innovations.

Source: Bar-Shalom, Li and Kirubarajan 2001, section 5.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxfilt.chi2 import chi2_quantile
from jaxfilt.core import check_count, check_float, number, numbers, real_array
from jaxfilt.linalg import chol, solve_lower
from jaxfilt.metrics.errors import check_components
from jaxfilt.models.linear import check_finite, common_dtype


class Consistency(NamedTuple):
    """An averaged statistic against its chi-square region; fields have the shape of one sample."""

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    inside: np.ndarray  # bool


class Whiteness(NamedTuple):
    """Sample autocorrelation of innovations, and the bound that it should stay within."""

    autocorrelation: Array  # (lags, m) at lags 1, 2, ...
    bound: Array  # (m,)
    inside: Array  # (lags, m) bool, |autocorrelation| <= bound


def nees(mean: ArrayLike, cov: ArrayLike, truth: ArrayLike, *, components: Sequence[int] | None = None) -> Array:
    """Normalized estimation error squared ``e' P^-1 e``, ``e = truth - mean``: chi-square with n degrees of freedom.

    Leading axes are free (runs, times). A covariance without the run's axis is factored once for all runs when called
    under ``jax.vmap``.

    Args:
        mean: (..., n).
        cov: (..., n, n). A direction of zero variance is skipped: it adds nothing, and nothing becomes NaN.
        truth: (..., n).
        components: the part of the state to look at; None = all.

    Returns:
        (...), without unit.

    Raises:
        ValueError: shapes that do not fit.
    """
    common_dtype({"mean": mean, "cov": cov, "truth": truth})
    mean, cov, truth = jnp.asarray(mean), jnp.asarray(cov), jnp.asarray(truth)
    if mean.ndim == 0 or mean.shape != truth.shape or cov.shape != (*mean.shape, *mean.shape[-1:]):
        raise ValueError(
            f"expected mean (..., n), cov (..., n, n), truth (..., n); got {mean.shape}, {cov.shape}, {truth.shape}"
        )
    error = truth - mean
    if components is not None:
        picked = check_components(components, mean.shape[-1])
        error, cov = error[..., picked], cov[..., picked, :][..., picked]
    one = _mahalanobis
    for _ in range(error.ndim - 1):
        one = jax.vmap(one)
    return one(error, cov)


def _mahalanobis(error, cov):
    whitened = solve_lower(chol(cov), error)
    # A covariance that is not finite has a factor of zeros: it must not look like one without any variance.
    return jnp.where(jnp.isfinite(cov).all(), jnp.sum(whitened * whitened), jnp.asarray(np.nan, cov.dtype))


def chi2_region(dof: float, runs: int, probability: float = 0.999) -> tuple[float, float]:
    """The two-sided region of the average of ``runs`` independent chi-square values with ``dof`` degrees of freedom.

    Args:
        dof: degrees of freedom of one value: n for NEES, m for NIS.
        runs: number of independent values averaged.
        probability: of a consistent filter's average to fall inside; the rest is split evenly between the tails.

    Returns:
        ``(low, high)``: quantiles of chi-square with ``dof * runs`` degrees of freedom, divided by ``runs``.

    Raises:
        ValueError: values out of range.
    """
    check_count("runs", runs, 1)
    dof = number("dof", dof)
    if not dof > 0:
        raise ValueError(f"dof: expected a value > 0, got {dof}")
    low, high = _tails(probability)
    return chi2_quantile(low, dof * runs) / runs, chi2_quantile(high, dof * runs) / runs


def _tails(probability):
    probability = number("probability", probability)
    if not 0 < probability < 1:
        raise ValueError(f"probability: expected a value in (0, 1), got {probability}")
    return 0.5 * (1 - probability), 0.5 * (1 + probability)


def consistency(values: Any, dof: Any, *, probability: float = 0.999) -> Consistency:
    """Tests an averaged NEES or NIS against its chi-square region.

    Args:
        values: (N, ...) independent values along the first axis: NEES at the same time of N runs, or NIS of all steps
            of N runs put together (innovations of a consistent filter are independent; NEES of one run's steps is not).
        dof: degrees of freedom of a value: one number, or an array of the shape of ``values`` where they differ, as the
            NIS of partly missing samples does (0 where all was missing).
        probability: of a consistent filter to be inside.

    Returns:
        ``Consistency(mean, low, high, inside)``, each of shape (...), float64 and bool. NaN in ``values`` is outside.

    Raises:
        ValueError: no values, or dof of another shape or 0 in total.
    """
    values, dof = (numbers(name, x).astype(np.float64) for name, x in (("values", values), ("dof", dof)))
    if values.ndim == 0 or values.shape[0] == 0:
        raise ValueError(f"values: expected shape (N, ...) with N >= 1, got {values.shape}")
    if dof.shape not in ((), values.shape):
        raise ValueError(f"dof: expected one number or shape {values.shape}, got {dof.shape}")
    count = values.shape[0]
    total = np.broadcast_to(dof, values.shape).sum(axis=0)
    distinct, where = np.unique(total, return_inverse=True)
    bounds = [np.array([chi2_quantile(p, d) / count for d in distinct]) for p in _tails(probability)]
    low, high = (bound[where].reshape(total.shape) for bound in bounds)
    mean = values.mean(axis=0)
    return Consistency(mean, low, high, (low <= mean) & (mean <= high))


def whiteness(
    innovations: ArrayLike,
    *,
    innovation_cov: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    lags: int = 5,
) -> Whiteness:
    """Lagged sample autocorrelation of innovations, which are white if the filter is consistent.

    ``r(l) = sum nu_k nu_{k+l} / sum nu_k^2`` per component, over all runs and times. Under whiteness each value has a
    standard deviation of about 1 / sqrt(number of innovations); ``bound`` is 3.3 of these (99.9 %).

    Args:
        innovations: (..., T, m); leading axes are runs. Absent components must be 0, as filters report them.
        innovation_cov: (..., T, m, m) or (T, m, m): whitens each innovation with its own covariance first, which the
            bound presupposes when the covariance changes over time.
        mask: (..., T, m) or (T, m) bool, True = present, for the count in the bound; None = all present.
        lags: number of lags.

    Returns:
        ``Whiteness(autocorrelation (lags, m), bound (m,), inside (lags, m))``.

    Raises:
        ValueError: fewer than lags + 1 samples.
    """
    check_count("lags", lags, 1)
    check_float("innovations", innovations)
    nu = jnp.asarray(innovations)
    if nu.ndim < 2 or not 1 <= lags < nu.shape[-2]:
        raise ValueError(f"innovations: expected shape (..., T, m) with T > lags = {lags}, got {nu.shape}")
    if innovation_cov is not None:
        check_finite("innovation_cov", innovation_cov)
    present = jnp.ones(nu.shape, bool) if mask is None else _whole("mask", mask, nu.shape)
    if present.dtype != np.dtype(bool):
        raise TypeError(f"mask: expected bool, got {present.dtype}")
    if innovation_cov is not None:
        common_dtype({"innovations": innovations, "innovation_cov": innovation_cov})
        S = _whole("innovation_cov", innovation_cov, (*nu.shape, nu.shape[-1]))
        whiten = _whiten
        for _ in range(nu.ndim - 1):
            whiten = jax.vmap(whiten)
        nu = whiten(nu, S, present)
    axes = tuple(range(nu.ndim - 1))
    power = jnp.sum(nu * nu, axis=axes)
    nonzero = power > 0
    power = jnp.where(nonzero, power, jnp.ones_like(power))
    r = jnp.stack([jnp.sum(nu[..., :-lag, :] * nu[..., lag:, :], axis=axes) / power for lag in range(1, lags + 1)])
    bound = 3.3 / jnp.sqrt(jnp.maximum(present.sum(axis=axes), 1).astype(nu.dtype))
    return Whiteness(r, bound, jnp.abs(r) <= bound[None, :])


def _whole(name, x, shape):
    x = real_array(name, x)
    if x.shape != shape[len(shape) - x.ndim :]:
        raise ValueError(f"{name}: expected shape {shape} as innovations, or its last axes, got {x.shape}")
    return jnp.broadcast_to(x, shape)


def _whiten(nu, S, present):
    # Absent components are decoupled and keep their own variance, so that they stay exactly 0.
    keep = (present[:, None] & present[None, :]) | np.eye(nu.shape[0], dtype=bool)
    return solve_lower(chol(jnp.where(keep, S, jnp.zeros((), S.dtype))), nu)
