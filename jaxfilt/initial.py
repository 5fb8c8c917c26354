"""Where to start a track: maximum likelihood over a batch of measurements, from many starts at once."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxfilt.core import PyTree, Status, StepInput, check_flag, flag, inputs
from jaxfilt.linalg import chol, solve_chol, solve_lower
from jaxfilt.metrics.cramer_rao import condition, inverse_information
from jaxfilt.models.linear import (
    LinearGaussian,
    check_covariance,
    check_finite,
    check_positive,
    check_shape,
    common_dtype,
)
from jaxfilt.models.nonlinear import Nonlinear, as_nonlinear
from jaxfilt.noise_free import noise_free
from jaxfilt.wrappers.common import check_count


class Start(NamedTuple):
    """A start found by :func:`batch_ml`: the best of those tried."""

    mean: Array  # (n,) estimate of x0
    cov: Array  # (n, n) inverse of the information; infinite on the diagonal where that is singular
    cost: Array  # () sum of squared whitened residuals (and of the prior's): chi-square with count - n degrees
    count: Array  # () int32, measured components
    information: Array  # (n, n) J'J at the estimate
    condition: Array  # () of the information scaled to a unit diagonal: large = hardly identifiable
    gradient: Array  # () largest component of the cost's gradient in units of the estimate's standard deviations
    costs: Array  # (S,) where each start ended
    means: Array  # (S, n)
    status: Array  # () int32: SINGULAR, NONFINITE, MISSED, as below


class _Search(NamedTuple):
    x: Array  # (n,)
    damping: Array  # ()
    cost: Array  # ()
    gradient: Array  # (n,) J'r
    information: Array  # (n, n)


def batch_ml(
    model: Nonlinear | LinearGaussian,
    ys: Any,
    starts: Any,
    *,
    prior: tuple[Any, Any] | None = None,
    scale: Any = None,
    iterations: int = 60,
    damping: Any = 1e-2,
    u: PyTree = None,
    dt: Any = None,
    mask: Any = None,
    first_update_only: bool = False,
) -> Start:
    """Finds the start of a noise-free motion that explains a series best, by Levenberg-Marquardt from several starts.

    Minimizes ``sum_k |R^-1/2 (y_k - h(x_k))|^2 (+ |P^-1/2 (x0 - m)|^2)`` over x0 with ``x_k = f(x_{k-1})``: maximum
    likelihood, or with a prior maximum a posteriori. Derivatives are automatic; each step solves
    ``(J'J + damping diag(J'J)) d = J'r``, is kept if it lowers the cost (damping / 5) and dropped otherwise
    (damping * 4). A fixed number of iterations, so ``vmap`` over series, models and starts is fast, and it can be
    compiled into what follows.

    The estimate is no better than the data: look at ``condition`` and ``cov``. (A single bearing and Doppler shift,
    for instance, leave the range open, and any optimizer returns what its search box says.)

    Args:
        model: its f, h, R and residual; Q, m0 and P0 are not used.
        ys: (T, m) measurements.
        starts: (S, n) where to start.
        prior: ``(m, P)`` of x0, (n,) and (n, n); None = nothing is known.
        scale: (n,) natural sizes of the unknowns [their units]; a floor of the damping, which matters only while the
            information about an unknown is next to none; None = none.
        iterations: >= 1.
        damping: at the start, > 0.
        u: as in :func:`jaxfilt.filter`.
        dt: as in :func:`jaxfilt.filter`.
        mask: as in :func:`jaxfilt.filter`.
        first_update_only: the first sample is of x0 itself.

    Returns:
        The start of least cost. Status: SINGULAR where the information is singular to working precision, so that
        something about x0 is not identifiable (its estimate is where the search happened to stay); NONFINITE where a
        traced measurement that no mask covers is not finite (left out) or no start led to a finite cost; MISSED where
        there was no measurement at all.

    Raises:
        ValueError: wrong shapes, iterations < 1, damping <= 0, a NaN that no mask covers (concrete arrays).

    Source: Levenberg 1944; Marquardt 1963.
    """
    check_count("iterations", iterations, 1)
    check_positive("damping", damping, scalar=True)
    check_flag("first_update_only", first_update_only)
    model = as_nonlinear(model)
    dtype = model.m0.dtype
    n = model.m0.shape[0]
    common_dtype({"starts": starts, "m0": model.m0})
    check_finite("starts", starts)
    starts = jnp.asarray(starts, dtype)
    if starts.ndim != 2 or starts.shape[1] != n or starts.shape[0] == 0:
        raise ValueError(f"starts: expected shape (S, {n}), got {starts.shape}")
    if prior is not None:
        if not isinstance(prior, tuple | list) or len(prior) != 2:
            raise ValueError(f"prior: expected (m, P), got {prior!r}")
        common_dtype({"prior": tuple(prior), "m0": model.m0})
        check_finite("prior", prior[0])
        mean, P = (jnp.asarray(x, dtype) for x in prior)
        if mean.shape != (n,) or P.shape != (n, n):
            raise ValueError(f"prior: expected shapes ({n},) and ({n}, {n}), got {mean.shape} and {P.shape}")
        check_covariance("prior", P)
        prior = (mean, chol(P))
    if scale is not None:
        check_positive("scale", scale)
        if jnp.shape(scale) not in ((), (n,)):
            raise ValueError(f"scale: expected shape ({n},), got {jnp.shape(scale)}")
        scale = jnp.broadcast_to(jnp.asarray(scale, dtype), (n,))
    stacked = inputs(ys, u=u, dt=dt, mask=mask)
    if stacked.y.dtype != dtype:
        raise TypeError(f"ys: is {stacked.y.dtype}, but the model is {dtype}; convert one of them")
    u0, dt0 = jax.tree.map(lambda leaf: leaf[0], (stacked.u, stacked.dt))
    if (m := jax.eval_shape(model.h, model.m0, u0, dt0).shape) != stacked.y.shape[1:]:
        raise ValueError(f"ys: expected shape (T, m) as h gives {m}, got {stacked.y.shape}")
    options = jnp.asarray(damping, dtype), scale
    return _search(model, stacked, starts, prior, options, iterations, first_update_only)


def cost(
    model: Nonlinear, x0: Array, stacked: StepInput, *, prior: tuple[Array, Array] | None = None,
    first_update_only: bool = False,
) -> Array:  # fmt: skip
    """The cost () that :func:`batch_ml` minimizes, for other optimizers; ``stacked`` from :func:`jaxfilt.inputs`.

    ``prior`` is ``(m, P)``. Differentiable in x0 and in the model.
    """
    model = as_nonlinear(model)
    if not isinstance(stacked, StepInput):
        raise TypeError(f"stacked: expected a StepInput, got {type(stacked).__name__}")
    check_flag("first_update_only", first_update_only)
    common_dtype({"x0": x0, "m0": model.m0})
    check_shape("x0", x0, model.m0.shape)
    if prior is not None and (not isinstance(prior, tuple | list) or len(prior) != 2):
        raise ValueError(f"prior: expected (m, P), got {prior!r}")
    prior = None if prior is None else (prior[0], chol(prior[1]))
    return _normal(model, x0, stacked, prior, first_update_only)[0]


def _normal(model, x0, stacked, prior, first_update_only):
    """``(cost, J'r, J'J)``."""
    path = noise_free(model, x0, stacked, first_update_only=first_update_only)
    with jax.default_matmul_precision("highest"):
        total = jnp.sum(path.residual**2)
        gradient = jnp.einsum("tmi,tm->i", path.sensitivity, path.residual)
        information = jnp.einsum("tmi,tmj->ij", path.sensitivity, path.sensitivity)
        if prior is not None:
            mean, L = prior
            white = solve_lower(L, mean - x0)
            inverse = solve_lower(L, jnp.eye(x0.shape[0], dtype=x0.dtype))
            total = total + jnp.sum(white**2)
            gradient, information = gradient + inverse.T @ white, information + inverse.T @ inverse
    return total, gradient, information


@partial(jax.jit, static_argnames=("iterations", "first_update_only"))
def _search(model, stacked, starts, prior, options, iterations, first_update_only):
    damping, scale = options

    def begin(x):
        return _Search(x, damping, *_normal(model, x, stacked, prior, first_update_only))

    def improve(s, _):
        diagonal = jnp.diagonal(s.information)
        floor = 0.0 if scale is None else 1e-12 / scale**2
        size = jnp.maximum(diagonal, floor)
        d = jnp.where(size > 0, 1 / jnp.sqrt(jnp.where(size > 0, size, 1.0)), 0.0)
        scaled = s.information * d[:, None] * d[None, :]
        L = chol(scaled + s.damping * jnp.eye(scaled.shape[0], dtype=scaled.dtype))
        tried = begin(s.x + d * solve_chol(L, d * s.gradient))
        better = tried.cost < s.cost  # false for NaN
        new = jax.tree.map(lambda a, b: jnp.where(better, a, b), tried, s)
        tiny, huge = 1e-12, 1e12  # of a factor without units: below the first it is Gauss-Newton, above it stands
        return new._replace(damping=jnp.clip(jnp.where(better, s.damping / 5, s.damping * 4), tiny, huge)), None

    found, _ = jax.lax.scan(lambda s, _: (jax.vmap(lambda one: improve(one, None)[0])(s), None),
                            jax.vmap(begin)(starts), length=iterations)  # fmt: skip
    costs = jnp.where(jnp.isfinite(found.cost), found.cost, jnp.inf)
    best = jax.tree.map(lambda leaf: leaf[jnp.argmin(costs)], found)
    there = jnp.ones(stacked.y.shape, bool) if stacked.mask is None else stacked.mask
    cov, number = inverse_information(best.information), condition(best.information)
    deviation = jnp.sqrt(jnp.where(jnp.isfinite(jnp.diagonal(cov)), jnp.diagonal(cov), 0.0))
    status = (
        flag(~jnp.isfinite(number) | ~jnp.isfinite(cov).all(), Status.SINGULAR)
        | flag((there & ~jnp.isfinite(stacked.y)).any() | ~jnp.isfinite(costs).any(), Status.NONFINITE)
        | flag(~there.any(), Status.MISSED)
    )
    count = (there & jnp.isfinite(stacked.y)).sum().astype(jnp.int32)
    steepness = jnp.max(jnp.abs(best.gradient) * deviation)
    return Start(best.x, cov, best.cost, count, best.information, number, steepness, costs, found.x, status)
