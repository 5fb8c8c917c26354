"""Errors over windows and components."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilt.metrics import mse, rmse, squared_error
from jaxfilt.simulate import gap_mask

RNG = np.random.default_rng(0)
TRUTH = RNG.normal(size=(3, 10, 4))
ESTIMATE = TRUTH + RNG.normal(size=(3, 10, 4))
ERROR = ESTIMATE - TRUTH


def test_windows_and_components_are_plain_slices():
    np.testing.assert_allclose(squared_error(ESTIMATE, TRUTH), (ERROR**2).sum(-1), rtol=1e-13)
    expected = (ERROR[:, 2:6, [0, 2]] ** 2).sum(-1).mean(-1)
    np.testing.assert_allclose(mse(ESTIMATE, TRUTH, components=[0, 2], window=(2, 5)), expected, rtol=1e-13)
    np.testing.assert_allclose(
        rmse(ESTIMATE, TRUTH, components=slice(0, 3, 2), window=(2, 5)), expected**0.5, rtol=1e-13
    )


def test_a_mask_is_a_window():
    inside = ~gap_mask(10, (2, 5))
    np.testing.assert_allclose(mse(ESTIMATE, TRUTH, window=inside), mse(ESTIMATE, TRUTH, window=(2, 5)), rtol=1e-13)
    traced = jax.jit(lambda window: mse(ESTIMATE, TRUTH, window=window))(jnp.asarray(inside))
    np.testing.assert_allclose(traced, mse(ESTIMATE, TRUTH, window=(2, 5)), rtol=1e-13)


@pytest.mark.parametrize(
    ("truth", "window", "message"),
    [
        (TRUTH[:, :5], None, "estimate: expected the shape of truth"),
        (TRUTH, (5, 10), "last < 10"),
        (TRUTH, np.zeros(10, bool), "counts no sample"),
        (TRUTH, np.zeros(9, bool), "window: expected"),
        (TRUTH, np.zeros(10), "window: expected"),
    ],
)
def test_bad_windows_are_refused(truth, window, message):
    with pytest.raises(ValueError, match=message):
        mse(ESTIMATE, truth, window=window)
