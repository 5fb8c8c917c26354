"""Leaving out measurements that the prediction says cannot be used."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxfilt.core import Filter, Status, aspartial, check_filter, flag, present, wrap


class _Params(NamedTuple):
    inner: Filter
    condition: Any  # Partial


def usable_where(filt: Filter, condition: Callable) -> Filter:
    """Treats the components of a sample as missing where ``condition`` fails, and says so.

    For measurements that the geometry makes useless, such as the bearing of a target on top of the observer
    (:func:`jaxfilt.models.sensors.apart`), or that cannot be, such as a negative frequency.

    Status: BOUND where a present component was left out; MISSED from the filter inside if nothing was left.

    Args:
        filt: the filter; must have moments.
        condition: ``(mean, y, u, dt) -> (m,) bool`` of the predicted mean and the sample, True = usable. Where a NaN in
            ``y`` makes it true or false does not matter: an absent component stays absent.

    Raises:
        ValueError: a filter without moments; at trace time, a condition of another shape.
    """
    check_filter(filt)
    if filt.moments is None:
        raise ValueError("filt: usable_where needs a filter with moments")
    return wrap(_Params(filt, aspartial(condition, "condition")), update=_update)


def _update(p, s, inp):
    mean, _ = p.inner.moments(s.inner)
    ok = p.condition(mean, inp.y, inp.u, inp.dt)
    if ok.shape != inp.y.shape or ok.dtype != bool:
        raise ValueError(f"condition: expected bool of shape {inp.y.shape}, got {ok.dtype} {ok.shape}")
    mask = present(inp)
    inner, info = p.inner.update(s.inner, inp._replace(mask=mask & ok))
    status = info.status | flag((mask & ~ok).any(), Status.BOUND)
    return s._replace(inner=inner), info._replace(status=status)
