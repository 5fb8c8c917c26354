"""What the status bits say as errors and warnings; that each occurs and is carried on: test_status_bits.py."""

from __future__ import annotations

import warnings

import jax
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt.core import Status

MODEL = jf.models.constant_velocity(dt=1.0, q=0.1, r=25.0, m0=np.zeros(2), P0=np.eye(2))


def words(*steps, T=5):
    """Status words (T,) with the given {step: bits}."""
    out = np.zeros(T, np.int32)
    for k, bit in steps:
        out[k] |= int(bit)
    return out


def test_nothing_to_say():
    """And what is ordinary says nothing: missing samples, refused ones, pseudo-measurements, particles resampled."""
    out = jf.filter(jf.kalman(MODEL), np.ones((5, 1)), mask=np.array([True, False, True, True, True]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert jf.check(out) is out
        jf.check(words((1, Status.GATED), (2, Status.PSEUDO), (3, Status.LOW_ESS)))


@pytest.mark.parametrize("bit", list(Status))
def test_each_bit_raises_or_warns_and_says_what_to_do(bit):
    out = words((2, bit), (3, bit), (4, Status.MISSED if bit != Status.MISSED else Status.GATED))
    with pytest.raises(jf.FilterError, match=rf"^{bit.name} in 2 of 5 steps, first at step 2: \w.{{20}}"):
        jf.check(out, error=bit)
    with pytest.warns(jf.FilterWarning, match=rf"^{bit.name} in 2 of 5 steps"):
        jf.check(out, error=Status(0), warn=bit)


def test_of_a_batch_the_run_is_named():
    out = np.stack([words(), words((4, Status.NONFINITE))])
    with pytest.raises(jf.FilterError, match=r"NONFINITE in 1 of 10 steps, first at run 1, step 4"):
        jf.check(out)
    with pytest.raises(jf.FilterError, match=r"NONFINITE in the step"):
        jf.check(out[1, 4])


def test_of_a_monte_carlo_the_filter_and_the_run():
    perfect = jf.models.linear_gaussian(np.eye(1), np.ones((2, 1)), np.eye(1), np.zeros((2, 2)), np.zeros(1), np.eye(1))
    result = jf.monte_carlo(
        jf.scenario(perfect, 5), {"exact": jf.kalman(perfect)}, _no_score, 3, jax.random.key(0), chunk=4
    )
    with pytest.warns(jf.FilterWarning, match=r"^exact: SINGULAR in 3 of 3 runs, first at run 0"):
        jf.check(result)


def _no_score(truth, ys, out):
    del truth, ys
    return {"last": out.mean[-1, 0]}


def test_what_has_no_status_is_refused():
    with pytest.raises(TypeError, match="out: expected an output with a status, got ndarray"):
        jf.check(np.zeros(3))
