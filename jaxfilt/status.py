"""What the status bits of a run say, as an error or a warning that names the first bad step and what to do."""

from __future__ import annotations

import warnings
from typing import TypeVar

import numpy as np

from jaxfilt.core import Status

Output = TypeVar("Output")

_ADVICE = {
    Status.MISSED: "no component was present; if that is not meant, look at the mask",
    Status.GATED: "a gate refused the sample; if that happens often, R or Q is too small or the gate too narrow",
    Status.SINGULAR: "the innovation covariance is singular, and what it leaves undetermined was ignored; look for "
    "an R of 0 or two equal sensors, or use a square-root filter (jf.sqrt_kalman)",
    Status.NONFINITE: "a measurement or an estimate was NaN or infinite; mark missing samples with "
    "ys, mask = jf.mask_nan(ys), and look at the model's functions at the estimate before this step",
    Status.BOUND: "a value was capped at its bound: a negative dt, an infeasible theta, a scale outside its limits",
    Status.LOW_ESS: "few particles carry the weight, and they are resampled; if that is so in most steps, take more of "
    "them, a guided proposal, or a larger R",
    Status.PSEUDO: "a pseudo-measurement stood in for a missing sample",
}


class FilterError(ArithmeticError):
    """A filter's status has a bit that :func:`check` was told to refuse."""


class FilterWarning(UserWarning):
    """A filter's status has a bit that :func:`check` was told to warn of."""


def check(
    out: Output,
    *,
    error: Status = Status.NONFINITE,
    warn: Status = Status.SINGULAR | Status.BOUND,
) -> Output:
    """Raises or warns if a run's status has one of these bits; returns ``out`` otherwise, so that it can stand in line.

    The message tells how many steps (or runs) have the bit, the first of them, and what to do. Not under ``jit``: it
    looks at values.

    Args:
        out: what :func:`jaxfilt.filter` returned, of one run (T,) or of a batch (B, T); a
            :class:`jaxfilt.MonteCarloResult`; or anything else with ``status``, or a status array.
        error: bits that raise.
        warn: bits that warn. LOW_ESS is none of them by default: a particle filter that resamples now and then is well.

    Raises:
        FilterError: one of the bits ``error`` occurred.
        TypeError: ``out`` has no status.
    """
    for name, bits in (("error", error), ("warn", warn)):
        if not isinstance(bits, int):
            raise TypeError(f"{name}: expected bits of Status, got {bits!r}")
    words = getattr(out, "status", out)
    for name, word in words.items() if isinstance(words, dict) else [("", words)]:
        word = np.asarray(word)
        if word.dtype != np.int32:
            raise TypeError(f"out: expected an output with a status, got {type(out).__name__}")
        for bit in Status:
            if bit & (error | warn) and (found := (word & int(bit)) != 0).any():
                message = f"{name}{': ' if name else ''}{bit.name} {_where(found, bool(name))}: {_ADVICE[bit]}"
                if bit & error:
                    raise FilterError(message)
                warnings.warn(message, FilterWarning, stacklevel=2)
    return out


def _where(found, runs_only):
    first = tuple(int(i) for i in np.argwhere(found)[0])
    names = ("run",) if runs_only else {0: (), 1: ("step",)}.get(found.ndim, (*["run"] * (found.ndim - 1), "step"))
    place = ", ".join(f"{name} {i}" for name, i in zip(names, first, strict=True))
    return f"in {int(found.sum())} of {found.size} {names[-1]}s, first at {place}" if names else "in the step"
