"""Rao-Blackwellized particle filters: equal structures run as one, and states of different size."""

from __future__ import annotations

import jax
import numpy as np

import jaxfilt as jf
from tests.examples import GAP, Example
from tests.examples.imm import _PARAMS, _filters, _transition

COUNT = 10


def _equal(p):
    large, _ = _filters(p)
    filters = (jf.kalman(large), jf.kalman(large._replace(R=p["small"]["R"])))
    return jf.rao_blackwellized(filters, _transition(p["stay"]), COUNT)


def _different(p):
    large, small = _filters(p)
    filters = (jf.kalman(large), jf.kalman(small))
    return jf.rao_blackwellized(
        filters, _transition(p["stay"]), COUNT, index=((0, 1), (1,)), mu0=np.array([0.7, 0.3]).astype(p["stay"].dtype)
    )


_OPTIONS = {**GAP, "key": jax.random.key(3)}
_SUMMED = "the moments of all hypotheses are summed before and after the update: they are equal but for rounding"
_DRAWN = "modes are drawn: which one comes out is a step function of the parameters"
_EXEMPT = {"all_false_mask": _SUMMED, "differences": _DRAWN}

EXAMPLES: dict[str, Example] = {
    "rao_blackwellized": Example(jf.rao_blackwellized, _equal, _PARAMS, options=_OPTIONS, exempt=_EXEMPT, twin=True),
    "rao_blackwellized_union": Example(
        jf.rao_blackwellized, _different, _PARAMS, options=_OPTIONS, exempt=_EXEMPT, twin=True
    ),
}
