"""The benchmarks' harness on tiny batches: all libraries agree, tables are built; and the scalar form pays."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from experiments.benchmarks import by_hand, cases, measure, tables
from experiments.benchmarks.measure import Case
from experiments.benchmarks.suite import MAIN, QUANTITIES, Result, Suite

LIBRARIES = ["jaxfilt", "jaxfilt full", "dynamax", "filterpy", "C", "C full"]


@pytest.fixture(scope="module")
def quick():
    """A suite of the quick form's three cases, at 3 runs of 5 steps."""
    return Suite(threads=1, quick=True, budget=0.0)


def test_libraries_agree_and_the_quick_tables_are_built(quick, lenient, tmp_path):
    """`measure` compares the results with each other before it times anything."""
    for name in ("dynamax.linear_gaussian_ssm.inference", "filterpy.kalman"):
        pytest.importorskip(name)
    data = cases.simulate(MAIN, 3, 5)
    with lenient():
        for quantity in QUANTITIES:
            case = Case(MAIN, quantity, 3, 5)
            timings, notes = measure.measure(case, data, LIBRARIES, threads=1, budget=0.0, rounds=1, sample=0.0)
            expected = {"jaxfilt", "dynamax"} | ({"filterpy"} if quantity != "gradient" else set())
            assert expected <= timings.keys()
            if shutil.which("gcc") and quantity != "gradient":
                assert {"C"} <= timings.keys(), notes
            assert all(t.rate > 0 and t.spread >= 1 for t in timings.values())
            quick.results.append(Result("kalman", case, timings, notes))
    (table,) = tables.tables(quick)
    assert [row[1] for row in table.rows] == ["likelihood", "history", "history, full P", "gradient"]
    assert table.text("pipe").count("\n") == 5
    assert tables.findings(quick)[-1].startswith("A peer wins")
    assert tables.figure(quick, tmp_path / "none.png") is None


def test_a_wrong_result_is_refused():
    case = Case(MAIN, "likelihood", 3, 5)
    right = [np.array([1.0, -2.0, 3.0])]
    measure.check("dynamax", case, [right[0] * (1 + 1e-8)], right)
    with pytest.raises(AssertionError, match=r"dynamax.*differs by 1\.0e-05"):
        measure.check("dynamax", case, [right[0] * (1 + 1e-5)], right)
    with pytest.raises(AssertionError, match=r"C: .*differs by nan"):
        measure.check("C", case, [right[0] * np.nan], right)


def test_dense_axes_leave_the_likelihood():
    """The dense F is the block F in turned axes, so the C loop must find the same likelihood on the same data."""
    if not shutil.which("gcc"):
        pytest.skip("no gcc")
    block, dense = cases.KALMAN[1], cases.KALMAN[2]
    data = cases.simulate(block, 3, 5)
    a, b = (by_hand.prepare(p, data, 0, 1)()[0] for p in (block, dense))
    np.testing.assert_allclose(a, b, rtol=1e-12)
    assert np.float64(1e-310) * np.float64(0.5) > 0, "the C library makes the process flush subnormal numbers to 0"


@pytest.mark.slow
def test_scalar_form_is_twice_as_fast_as_dense():
    case = Case(MAIN, "likelihood", 512)
    data = cases.simulate(MAIN, case.batch, case.steps)
    timings, _ = measure.measure(case, data, ["jaxfilt", "jaxfilt dense"], threads=1)
    assert timings["jaxfilt"].rate >= 2 * timings["jaxfilt dense"].rate
