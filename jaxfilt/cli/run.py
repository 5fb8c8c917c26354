"""A filter over a recording, and what can be said about the run without knowing the truth."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from jaxfilt.cli import filters
from jaxfilt.cli.filters import Choice, Scale
from jaxfilt.cli.learn import scored_rows
from jaxfilt.cli.read import Recording
from jaxfilt.cli.units import BadInput
from jaxfilt.metrics import chi2_region, consistency, whiteness

# The samples without a measurement are counted by themselves: a filter that is told of them is not in trouble.
_TROUBLE = jf.Status.SINGULAR | jf.Status.NONFINITE | jf.Status.BOUND | jf.Status.GATED


class Run(NamedTuple):
    """A filtered recording, in SI units, as NumPy arrays."""

    choice: Choice
    out: jf.Info  # with predictions
    shown: Any  # jf.Info or, if asked for, jf.Smoothed: whose mean and covariance are the estimate
    scored: np.ndarray  # (T,) bool
    modes: np.ndarray | None  # (T, modes)


class Verdict(NamedTuple):
    """How the stated covariances compare with the innovations met."""

    log_lik: float  # nats per scored fix
    fixes: int
    nis: float  # mean
    dof: float  # its mean degrees of freedom
    low: float  # region of 95 % of the mean
    high: float
    share: float  # of fixes within the 95 % region of a single one
    correlation: float  # of successive innovations, the largest component; NaN if it cannot be told
    bound: float  # 99.9 % of white innovations are below
    sentence: str


def run(rec: Recording, choice: Choice, params: dict[str, float], s: Scale, *, smooth: bool = False) -> Run:
    """Filters all rows, and smooths them if asked to.

    Raises:
        BadInput: if the filter cannot be smoothed.
    """
    filt = filters.make(choice, params, filters.start(rec, slice(None), s))
    out = filtered(rec, filt, rec.mask)
    shown = out
    if smooth:
        try:
            shown = jf.rts(out)
        except ValueError as error:
            raise BadInput(f"--smooth: {choice.filter} cannot be smoothed ({error})") from None
    modes = out.extra.get("mode_probabilities")
    modes = None if modes is None else np.asarray(modes)
    return Run(choice, out, shown, scored_rows(rec.present, choice), modes)


def filtered(rec: Recording, filt: jf.Filter, mask: np.ndarray) -> jf.Info:
    """All rows, of which ``mask`` (T, m) are seen."""
    dt = None if rec.regular else jnp.asarray(rec.dt)
    return jf.filter(
        filt, jnp.asarray(rec.ys), mask=jnp.asarray(mask), dt=dt, outputs=jf.everything, first_update_only=True
    )


def verdict(rec: Recording, done: Run, rows: np.ndarray | None = None) -> Verdict | None:
    """Of the scored fixes (or of the ``rows`` (T,) among them); None if none is left."""
    rows = done.scored if rows is None else rows & done.scored
    if done.out.nis is None or done.out.log_lik is None or not rows.any():
        return None
    nis, dof = np.asarray(done.out.nis)[rows], rec.mask[rows].sum(axis=1).astype(float)
    found = consistency(nis, dof, probability=0.95)
    low, high = _regions(dof)
    inside = (low <= nis) & (nis <= high)
    correlation, bound = _correlation(rec, done, rows)
    sentence = _sentence(found, float(inside.mean()), len(nis), correlation, bound)
    return Verdict(
        float(np.asarray(done.out.log_lik)[rows].mean()), int(rows.sum()), float(found.mean), float(dof.mean()),
        float(found.low), float(found.high), float(inside.mean()), correlation, bound, sentence,
    )  # fmt: skip


def _regions(dof):
    """The regions of 95 % of single values, (2, ...)."""
    of = {d: chi2_region(d, 1, 0.95) for d in np.unique(dof)}
    return np.array([of[d] for d in dof]).T


def _correlation(rec, done, rows):
    out = done.out
    k = np.flatnonzero(rows)
    if len(k) < 10 or out.innovation_cov is None:
        return np.nan, np.nan
    found = whiteness(out.innovation[k], innovation_cov=out.innovation_cov[k], mask=jnp.asarray(rec.mask[k]), lags=1)
    r = np.asarray(found.autocorrelation)[0]
    worst = int(np.argmax(np.abs(r)))
    return float(r[worst]), float(np.asarray(found.bound)[worst])


def _sentence(found, share, count, correlation, bound) -> str:
    if found.inside:
        text = "on average the filter's covariance fits its errors of prediction"
    elif found.mean > found.high:
        text = "the filter is too sure: its errors of prediction are larger than it says"
    else:
        text = "the filter is too cautious: its errors of prediction are smaller than it says"
    if found.inside and share < 0.95 - 3 * np.sqrt(0.95 * 0.05 / count):
        text += ", but many are small and some far too large: maneuvers or outliers"
    if np.isfinite(correlation) and abs(correlation) > bound:
        way = "lags behind the motion" if correlation > 0 else "follows the noise too eagerly, or reports are smoothed"
        text += f"; successive innovations are correlated ({correlation:+.2f}, noise stays below {bound:.2f}): it {way}"
    return text


def advice(out: jf.Info) -> list[str]:
    """What :func:`jaxfilt.check` says about the run."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", jf.FilterWarning)
        jf.check(out, error=jf.Status(0), warn=_TROUBLE)
    return [str(one.message) for one in said]
