"""Fixed-interval smoothing on what ``predict`` reports: one smoother for all filters."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxfilt import core, describe
from jaxfilt.core import Filter, Info
from jaxfilt.linalg import chol, solve_chol, sym


class Smoothed(NamedTuple):
    """Moments of p(x_k | y_1..T)."""

    mean: Array  # (T, n)
    cov: Array  # (T, n, n)

    def __repr__(self) -> str:
        """Shapes."""
        return describe.fields(self)


def rts(out: Info) -> Smoothed:
    """The Rauch-Tung-Striebel smoother over the output of ``jf.filter(..., outputs=jf.everything)``.

    Backwards from the last step, with the predicted moments and the cross-covariance C of step k+1:
    ``G = C (P-)^-1``, ``m_s = m + G (m_s' - m-)``, ``P_s = P + G (P_s' - P-) G'``.

    Raises:
        ValueError: if the filter reports no covariance or cross-covariance, or the prediction was dropped.

    Source: Rauch, Tung and Striebel 1965.
    """
    check_smoothable(out)
    return _rts(out.mean, out.cov, out.prediction)


def check_smoothable(out: Info) -> None:
    """Raises a ValueError unless ``out`` has the predictions that smoothing needs."""
    if not isinstance(out, Info):
        raise TypeError(f"out: expected the Info that jf.filter returns, got {type(out).__name__}")
    prediction = out.prediction
    if prediction is None:
        raise ValueError("out: has no prediction; filter with outputs=jf.everything")
    if out.cov is None or prediction.cov is None or prediction.cross is None:
        raise ValueError("out: the filter reports no covariance or no cross-covariance, so it cannot be smoothed")


@jax.jit
def _rts(mean, cov, prediction):
    def backward(carry, x):
        mean_next, cov_next = carry
        m, P, later = x
        G = solve_chol(chol(later.cov), later.cross.T).T
        m = m + G @ (mean_next - later.mean)
        P = sym(P + G @ (cov_next - later.cov) @ G.T)
        return (m, P), (m, P)

    with jax.default_matmul_precision("highest"):
        last = mean[-1], cov[-1]
        steps = (mean[:-1], cov[:-1], jax.tree.map(lambda leaf: leaf[1:], prediction))
        _, (means, covs) = jax.lax.scan(backward, last, steps, reverse=True)
    return Smoothed(jnp.concatenate([means, mean[-1:]]), jnp.concatenate([covs, cov[-1:]]))


def smooth(filt: Filter, ys: Any, **options: Any) -> Smoothed:
    """Filters and smooths one series; arguments as :func:`jaxfilt.filter` except ``outputs``."""
    return rts(core.filter(filt, ys, outputs=core.everything, **options))
