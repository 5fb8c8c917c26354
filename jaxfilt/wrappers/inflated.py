"""More process noise while data are missing."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxfilt.core import Filter, multiply, present, wrap
from jaxfilt.models.linear import check_positive


class _Params(NamedTuple):
    inner: Filter
    factor: Any  # ()


def coast_inflated(filt: Filter, factor: Any = 10.0) -> Filter:
    """Coasts through gaps with the process noise multiplied: ``Q -> factor Q`` in every step without any measurement.

    Nothing else changes, so the mean of a linear filter in the gap is that of plain coasting, its covariance is larger
    and the first samples after the gap weigh more. Costs little when the model is right and helps much after the gap
    when it is not. A step of which some component is present is predicted as usual.

    Args:
        filt: the filter; must honor ``q_scale``.
        factor: on Q, > 0; 1 is plain coasting. May be traced.

    Raises:
        ValueError: factor <= 0.
    """
    check_positive("factor", factor, scalar=True)
    return wrap(_Params(filt, factor), predict=_predict)


def _predict(p, s, inp):
    if inp.mask is not None:
        one = jnp.ones((), inp.y.dtype)
        factor = jnp.where(present(inp).any(), one, jnp.asarray(p.factor, inp.y.dtype))
        inp = inp._replace(q_scale=multiply(inp.q_scale, factor))
    inner, prediction = p.inner.predict(s.inner, inp)
    return s._replace(inner=inner), prediction
