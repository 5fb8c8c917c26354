"""Each status bit is reached by a filter, and carried on by what stands around a filter: see ``REACHED``."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxfilt as jf
from jaxfilt import status as advice
from jaxfilt.core import Status
from tests.robustness import border

YS = np.array([[0.3, 0.1], [0.2, -0.4], [1.0, 0.5], [0.7, 0.2]])
SECOND_LOST = np.array([True, False, True, True])


def _plain(filt, ys=YS, **options):
    return jax.jit(lambda f, y: jf.filter(f, y, **options))(filt, ys)


def _missed():
    return _plain(border.filt(), mask=SECOND_LOST)


def _gated():
    ys = YS.copy()
    ys[1] = 1e3
    return _plain(jf.gated(border.filt()), ys)


def _singular():
    n = np.eye(2)
    return _plain(jf.kalman(jf.models.linear_gaussian(n, n, 0 * n, 0 * n, np.zeros(2), 0 * n)))


def _nonfinite():
    ys = YS.copy()
    ys[1, 0] = np.nan
    return _plain(border.filt(), ys)


def _bound():
    dt = np.array([1.0, -1.0, 1.0, 1.0])
    return jax.jit(lambda d: jf.filter(jf.kalman(border.planar()), YS, dt=d))(dt)


def _low_ess():
    return _plain(jf.particle(border.model(), 20, threshold=1.0), key=border.KEY)


def _pseudo():
    return _plain(jf.hold_last(border.filt()), mask=SECOND_LOST)


# Which run has the bit in its second step.
REACHED = {
    Status.MISSED: _missed, Status.GATED: _gated, Status.SINGULAR: _singular, Status.NONFINITE: _nonfinite,
    Status.BOUND: _bound, Status.LOW_ESS: _low_ess, Status.PSEUDO: _pseudo,
}  # fmt: skip


def test_every_bit_has_advice_and_a_run_that_reaches_it():
    assert set(advice._ADVICE) == set(Status) == set(REACHED)
    assert all(len(text) > 30 for text in advice._ADVICE.values())


@pytest.mark.parametrize("bit", list(Status))
def test_the_bit_is_reached(bit):
    assert int(REACHED[bit]().status[1]) & int(bit)


def _with_bits(update, bits, state, inp):
    state, info = update(state, inp)
    return state, info._replace(status=info.status | bits)


def reporting(filt, bits):
    """The filter with more bits in each status that it reports."""
    return filt._replace(update=Partial(_with_bits, filt.update, bits))


def _around(name):
    """``(filters, function of filters that gives the filter around them)``, from the table of valid calls."""
    arguments = border.CALLS[name]()
    make = getattr(jf, name)
    if "filt" in arguments:
        inner = arguments.pop("filt")
        return (inner,), lambda filters: make(filters[0], **arguments)
    inner = arguments.pop("filters")
    return inner, lambda filters: make(filters, **arguments)


# What needs inputs of its own, and where it is tested.
ELSEWHERE = {"nearest_neighbor": "takes detections as its input; tests/wrappers/test_gate.py"}
WRAPPERS = [
    name
    for name in border.CALLS
    if "." not in name
    and {"filt", "filters"} & set(border.CALLS[name]())
    and getattr(jf, name) not in (jf.filter, jf.scan, jf.step, jf.smooth, jf.monte_carlo)
    and name not in ELSEWHERE
]
FEW = {"bank", "gated", "imm", "polynomial_fit", "sage_husa"}


@functools.cache
def _statuses(name):
    filters, around = _around(name)
    key = border.KEY if name == "rao_blackwellized" else None

    @jax.jit
    def run(filters, bits):
        inner = (reporting(filters[0], bits), *filters[1:])
        return jf.filter(around(inner), YS, key=key).status

    return lambda bits: np.asarray(run(filters, jnp.int32(bits)))


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n not in FEW)) for n in WRAPPERS])
def test_bits_of_a_filter_within_are_carried(name):
    """Of the first of several filters, in all steps; and none is made up."""
    plain = _statuses(name)(0)
    for bit in Status:
        found = _statuses(name)(int(bit))
        assert ((found & int(bit)) != 0).all(), bit
        assert (((found & ~plain) | int(bit)) == int(bit)).all(), bit


def _no_score(truth, ys, out):
    del truth, ys
    return {"last": out.mean[-1, 0]}


def test_monte_carlo_reports_all_bits_of_a_run():
    every = sum(int(bit) for bit in Status)
    filters = {"all": reporting(border.filt(), jnp.int32(every)), "none": border.filt()}
    result = jf.monte_carlo(jf.scenario(border.model(), 3), filters, _no_score, 2, border.KEY, chunk=2)
    assert (np.asarray(result.status["all"]) == every).all()
    assert (np.asarray(result.status["none"]) == 0).all()
