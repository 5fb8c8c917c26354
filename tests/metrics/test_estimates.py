"""Means over runs and their standard errors."""

import numpy as np
import pytest

from jaxfilt.metrics import mean, ratio, root_mean

RNG = np.random.default_rng(0)
COMMON = RNG.normal(size=800) ** 2
A = COMMON * (1.5 + 0.1 * RNG.normal(size=800))  # moves with B, as two filters on the same data do
B = COMMON


def bootstrap(statistic, resamples=2000):
    index = RNG.integers(0, 800, size=(resamples, 800))
    return statistic(A[index], B[index]).std()


@pytest.mark.parametrize(
    ("estimate", "statistic"),
    [
        (mean(A), lambda a, b: a.mean(1)),
        (root_mean(A), lambda a, b: np.sqrt(a.mean(1))),
        (ratio(A, B), lambda a, b: a.mean(1) / b.mean(1)),
        (ratio(A, B, root=True), lambda a, b: np.sqrt(a.mean(1) / b.mean(1))),
    ],
    ids=["mean", "root_mean", "ratio", "root_ratio"],
)
def test_standard_errors_are_those_of_the_bootstrap(estimate, statistic):
    np.testing.assert_allclose(estimate.value, statistic(A[None], B[None])[0], rtol=1e-13)
    np.testing.assert_allclose(estimate.standard_error, bootstrap(statistic), rtol=0.08)


def test_pairing_pays():
    unpaired = np.hypot(mean(A).standard_error / A.mean(), mean(B).standard_error / B.mean()) * A.mean() / B.mean()
    assert ratio(A, B).standard_error < 0.2 * unpaired


def test_axes_after_the_first_are_kept():
    values = RNG.normal(size=(50, 3, 2)) ** 2
    np.testing.assert_allclose(mean(values).value[1, 1], mean(values[:, 1, 1]).value)
    np.testing.assert_allclose(root_mean(values).standard_error[2, 0], root_mean(values[:, 2, 0]).standard_error)
    np.testing.assert_allclose(ratio(values, values + 1).value.shape, (3, 2))


def test_edges():
    assert mean([3.0]) == (3.0, np.inf)
    assert root_mean([0.0, 0.0]) == (0.0, 0.0)
    assert np.isnan(mean([1.0, np.nan]).value)
    with pytest.raises(ValueError, match="at least one run"):
        mean([])
    with pytest.raises(ValueError, match="denominator: expected the shape"):
        ratio([1.0, 2.0], [1.0])
