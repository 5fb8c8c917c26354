"""Quantiles of the chi-square distribution, for gates, detectors and consistency regions."""

from __future__ import annotations

import math

import numpy as np

from jaxfilt import core


def chi2_quantile(probability: float, dof: float) -> float:
    """The x with ``P(chi2_dof <= x) = probability``, in float64 whatever JAX's precision.

    Bisection on the series of the regularized incomplete gamma function, which stays accurate at the millions of
    degrees of freedom of long Monte-Carlo averages. Relative error below 1e-9 up to 1 - 1e-6, below 1e-6 to the end.

    Raises:
        ValueError: a probability outside (0, 1 - 1e-9], or dof <= 0.
    """
    probability, dof = core.number("probability", probability), core.number("dof", dof)
    if not 0 < probability <= 1 - 1e-9:
        raise ValueError(f"probability: expected a value in (0, 1 - 1e-9], got {probability}")
    if not (dof > 0 and math.isfinite(dof)):
        raise ValueError(f"dof: expected a finite value > 0, got {dof}")
    # P(chi2 > dof + 2 sqrt(dof t) + 2 t) <= exp(-t) (Laurent and Massart 2000), here with t = 25.
    low, high = 0.0, dof + 10 * math.sqrt(dof) + 50
    while high - low > 1e-13 * high > 0:
        middle = 0.5 * (low + high)
        if _chi2_cdf(middle, dof) < probability:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def _chi2_cdf(x, dof):
    # P(a, z) = z^a e^-z / Gamma(a + 1) * sum_i z^i / ((a + 1) ... (a + i)), all terms positive.
    a, z = 0.5 * dof, 0.5 * x
    if z <= 0:
        return 0.0
    if a < 100:
        log_first = a * math.log(z) - z - math.lgamma(a + 1)
    else:  # Stirling's series with the large parts canceled by hand
        excess = (z - a) / a
        stirling = 0.5 * math.log(2 * math.pi * a) + 1 / (12 * a) - 1 / (360 * a**3) + 1 / (1260 * a**5)
        log_first = a * (math.log1p(excess) - excess) - stirling
    terms = int(max(z - a, 0.0) + 12 * math.sqrt(max(z, a)) + 100)
    log_terms = np.cumsum(math.log(z) - np.log(a + np.arange(1, terms + 1)))
    return float(math.exp(log_first) + np.exp(log_first + log_terms).sum())
