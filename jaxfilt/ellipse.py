"""The ellipse through the samples of a sine/cosine sensor: its imperfections without any reference."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.linalg import solve_triangular

from jaxfilt.core import Status, check_count, check_float, flag, is_concrete
from jaxfilt.models.linear import check_positive, check_shape
from jaxfilt.sincos import Parameters, both_present


class EllipseFit(NamedTuple):
    """A fitted ellipse ``[o_a + R_a cos t, o_b + R_b sin(t + quadrature)]``."""

    parameters: Parameters  # for jaxfilt.sincos.correct
    values: Array  # (5,) o_a, o_b, R_a, R_b [units of the signal], quadrature [rad]
    std: Array  # (5,) their standard deviations, in the same units
    relative_std: Array  # (5,) offsets and radii by the mean radius, quadrature in rad
    coverage: Array  # () part of the cycle that the samples cover: 1 less the largest gap
    accepted: Array  # () bool: an ellipse, covered well enough, and all of relative_std below the limit
    status: Array  # () int32: SINGULAR (no ellipse, or too little of it), BOUND (a relative_std above the limit)


def fit_ellipse(
    ys: Any, *, mask: Any = None, block: int = 1, limit: float = 0.1, least_coverage: float = 0.75
) -> EllipseFit:
    """Fits the ellipse of two signals by least squares of ``a x^2 + b y^2 + h x y + f x + g y = 1``.

    The origin must lie inside the ellipse. Noise shrinks such an algebraic fit by a part of order (noise / radius)^2.
    The standard deviations are those of the fit's own residuals, of whatever distribution ("sandwich"): the samples'
    influences on the parameters, summed in blocks, squared.

    Args:
        ys: (T, 2) signals, T >= 6.
        mask: (T,) or (T, 2) bool, True = present; a sample counts if both signals are present.
        block: consecutive samples whose residuals belong together. With 1 they are taken as independent, which
            understates the standard deviations of slow disturbances.
        limit: on ``relative_std``; above it a fit is flagged and not ``accepted``.
        least_coverage: part of the cycle that the samples must cover.

    Returns:
        The fit. Under a transformation, what would raise is flagged as SINGULAR, and ``values`` are finite but
        meaningless.

    Raises:
        ValueError: shape, (concrete arrays only) a NaN that no mask covers, fewer than 6 samples, less of the cycle
            than ``least_coverage``, or a conic that is no ellipse.

    Source: Heydemann 1981; the standard deviations: White 1980.
    """
    check_float("ys", ys)
    ys = jnp.asarray(ys)
    if ys.ndim != 2 or ys.shape[1] != 2:
        raise ValueError(f"ys: expected shape (T, 2), got {ys.shape}; batch with jax.vmap")
    check_count("block", block, 1)
    check_positive("limit", limit)
    check_positive("least_coverage", least_coverage, zero=True)
    check_shape("limit", limit, ())
    check_shape("least_coverage", least_coverage, ())
    here = both_present(ys, mask)
    if is_concrete((ys, here)):
        if not np.isfinite(np.asarray(ys)[np.asarray(here)]).all():
            raise ValueError("ys: expected finite values where no mask covers them; use jf.mask_nan")
        if int(here.sum()) < 6:
            raise ValueError(f"ys: expected at least 6 samples, got {int(here.sum())}")
    here = here & jnp.isfinite(ys).all(axis=1)
    fit = _fit(ys, here, block, jnp.asarray(limit, ys.dtype), jnp.asarray(least_coverage, ys.dtype))
    if is_concrete(fit.status) and int(fit.status) & int(Status.SINGULAR):
        covered = float(fit.coverage)
        if covered < least_coverage:
            raise ValueError(
                f"ys: expected samples of {least_coverage:g} of the cycle (least_coverage), got {covered:.3g}"
            )
        raise ValueError("ys: the best conic is not an ellipse around the origin")
    return fit


@partial(jax.jit, static_argnames=("block",))
def _fit(ys, here, block, limit, least_coverage):
    dtype = ys.dtype
    weight = here.astype(dtype)
    count = weight.sum()
    ys = jnp.where(here[:, None], ys, 0.0)
    unit = jnp.sqrt((ys * ys).sum() / jnp.maximum(count, 1.0))  # the radius: the design then has no unit
    unit = jnp.where(unit > 0, unit, 1.0)
    x, y = (ys / unit).T
    design = jnp.stack([x * x, y * y, x * y, x, y], axis=1)
    with jax.default_matmul_precision("highest"):
        Q, R = jnp.linalg.qr(design)
        pivots = jnp.abs(jnp.diagonal(R))
        regular = pivots.min() > design.shape[0] * jnp.finfo(dtype).eps * pivots.max()
        R = jnp.where(regular, R, jnp.eye(5, dtype=dtype))
        conic = solve_triangular(R, Q.T @ weight)
        discriminant = 4 * conic[0] * conic[1] - conic[2] ** 2
        circle = jnp.array([1.0, 1.0, 0.0, 0.0, 0.0], dtype)
        ellipse = regular & (discriminant > 0) & (_scale(jnp.where(discriminant > 0, conic, circle)) > 0)
        conic = jnp.where(ellipse, conic, circle)
        values, J = _values(conic), jax.jacfwd(_values)(conic)
        residual = weight - design @ conic
        # (T, 5): by how much each residual moved the parameters
        influence = (design * residual[:, None]) @ solve_triangular(R, solve_triangular(R, J.T, trans=1))
        pad = -influence.shape[0] % block
        sums = jnp.pad(influence, ((0, pad), (0, 0))).reshape(-1, block, 5).sum(axis=1)
        blocks = (jnp.pad(here, (0, pad)).reshape(-1, block).any(axis=1)).sum().astype(dtype)
        std = jnp.sqrt((sums * sums).sum(axis=0) * blocks / jnp.maximum(blocks - 5, 1.0))

    radius = 0.5 * (values[2] + values[3])
    relative = std / jnp.stack([radius, radius, radius, radius, jnp.ones((), dtype)])
    coverage = _coverage(x - values[0], y - values[1], here)
    sound = ellipse & (coverage >= least_coverage)
    certain = (relative < limit).all()
    length = jnp.stack([unit, unit, unit, unit, jnp.ones((), dtype)])
    values, std = values * length, std * length
    mean = 0.5 * (values[2] + values[3])
    gain = (values[2] - values[3]) / mean
    parameters = Parameters(values[0], values[1], mean, gain, values[4])
    status = flag(~sound, Status.SINGULAR) | flag(~certain, Status.BOUND)
    return EllipseFit(parameters, values, std, relative, coverage, sound & certain, status)


def _centre(conic):
    a, b, h, f, g = conic
    d = 4 * a * b - h * h
    return (h * g - 2 * b * f) / d, (h * f - 2 * a * g) / d


def _scale(conic):
    """What the quadratic form is on the ellipse about its centre; positive for a real one that holds the origin."""
    a, b, h, _, _ = conic
    x, y = _centre(conic)
    return (1 + a * x * x + b * y * y + h * x * y) * jnp.where(a > 0, 1.0, -1.0)


def _values(conic):
    """``(o_a, o_b, R_a, R_b, quadrature)``: the form's inverse is ``M M'``, M the map from the circle."""
    a, b, h, _, _ = conic
    x, y = _centre(conic)
    k = 1 + a * x * x + b * y * y + h * x * y
    d = a * b - 0.25 * h * h
    first, second, both = k * b / d, k * a / d, -0.5 * k * h / d
    return jnp.stack([x, y, jnp.sqrt(first), jnp.sqrt(second), jnp.arcsin(both / jnp.sqrt(first * second))])


def _coverage(x, y, here):
    """1 less the largest gap between neighbouring directions, in cycles; it asks for no order of the samples."""
    angle = jnp.sort(jnp.where(here, jnp.arctan2(y, x) / (2 * np.pi), jnp.inf))
    last = jnp.where(here, jnp.arctan2(y, x) / (2 * np.pi), -jnp.inf).max()
    gaps = jnp.diff(angle)
    gaps = jnp.where(jnp.isfinite(gaps), gaps, 0.0)
    return 1 - jnp.maximum(gaps.max(), angle[0] + 1 - last)
