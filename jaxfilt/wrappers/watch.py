"""Noticing that a filter has lost what it tracks."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxfilt.core import Filter, Static, Status, Wrapped, flag, present, wrap
from jaxfilt.models.linear import check_positive
from jaxfilt.wrappers.common import check_count


class _Params(NamedTuple):
    inner: Filter
    limit: Any  # ()
    count: Static


def watched(filt: Filter, *, limit: Any = 5.0, count: int = 20) -> Filter:
    """Says when a filter has lost its track: some innovation beyond ``limit`` deviations in ``count`` samples on end.

    The estimate is the filter's own. ``info.extra["lost"]`` () bool is true from the sample that completes the row
    until one without such an innovation, and the status is then BOUND. A missed sample neither adds to the row nor ends
    it. To start anew: ``filt.with_moments(state, mean, cov)``.

    Args:
        filt: the filter; must report innovation_cov.
        limit: in standard deviations of each innovation, > 0.
        count: samples on end, >= 1.

    Raises:
        ValueError: limit <= 0 or count < 1; at trace time, a filter that reports no innovation_cov.
    """
    check_positive("limit", limit, scalar=True)
    check_count("count", count, 1)
    return wrap(_Params(filt, limit, Static(count)), init=_init, update=_update)


def _init(p, inp):
    return Wrapped(p.inner.init(inp), jnp.zeros((), jnp.int32))


def _update(p, s, inp):
    inner, info = p.inner.update(s.inner, inp)
    if info.innovation_cov is None:
        raise ValueError("filt: watched needs a filter that reports innovation_cov")
    variance = jnp.diagonal(info.innovation_cov)
    far = (info.innovation**2 > jnp.asarray(p.limit, variance.dtype) ** 2 * variance).any()
    seen = (info.status & int(Status.MISSED)) == 0
    row = jnp.where(seen & present(inp).any(), jnp.where(far, s.memory + 1, 0), s.memory).astype(jnp.int32)
    row = jnp.minimum(row, jnp.int32(p.count.value))
    lost = row >= p.count.value
    info = info._replace(status=info.status | flag(lost, Status.BOUND), extra={**info.extra, "lost": lost})
    return Wrapped(inner, row), info
