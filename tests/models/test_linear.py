"""The border of linear_gaussian: every refusal names its argument."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf

GOOD = {
    "F": np.eye(2), "H": np.ones((1, 2)), "Q": np.eye(2), "R": np.eye(1), "m0": np.zeros(2), "P0": np.eye(2),
}  # fmt: skip


@pytest.mark.parametrize("name", ["F", "H", "Q", "R", "m0", "P0"])
def test_a_wrong_shape_is_named(name):
    with pytest.raises(ValueError, match=rf"{name}: expected shape|m0: expected|F: expected"):
        jf.models.linear_gaussian(**{**GOOD, name: np.ones((3, 3, 3))})


@pytest.mark.parametrize(
    ("name", "bad", "message"),
    [
        ("F", np.eye(3), "F: expected shape (2, 2), got (3, 3)"),
        ("B", np.ones((3, 1)), "B: expected shape (2, any), got (3, 1)"),
        ("S", np.ones((1, 2)), "S: expected shape (2, 1), got (1, 2)"),
        ("Q", np.array([[1.0, 0.0], [0.0, -1.0]]), "Q: expected a positive semidefinite matrix"),
        ("Q", np.array([[1.0, 0.1], [0.0, 1.0]]), "Q: expected a symmetric matrix"),
        ("R", np.array([[-1.0]]), "R: expected a positive semidefinite matrix"),
        ("P0", np.full((2, 2), np.nan), "P0: expected finite values"),
        ("F", np.full((2, 2), np.inf), "F: expected finite values"),
        ("m0", np.array([0.0, np.nan]), "m0: expected finite values"),
        ("m0", np.zeros(0), "m0: expected shape (n,)"),
    ],
)
def test_a_bad_value_is_named(name, bad, message):
    with pytest.raises(ValueError) as error:  # noqa: PT011
        jf.models.linear_gaussian(**{**GOOD, name: bad})
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("name", "bad"),
    [("F", np.eye(2, dtype=int)), ("m0", np.zeros(2, np.float32)), ("R", "big"), ("H", np.ones((1, 2), bool))],
)
def test_a_wrong_dtype_is_a_type_error_that_names_it(name, bad):
    with pytest.raises(TypeError, match=name):
        jf.models.linear_gaussian(**{**GOOD, name: bad})


def test_python_numbers_take_the_arrays_dtype():
    model = jf.models.linear_gaussian(
        [[1, 0.5], [0, 1]], [[1, 0]], [[1, 0], [0, 1]], [[2]], jnp.zeros(2, jnp.float32), [[1, 0], [0, 1]]
    )
    assert {leaf.dtype for leaf in jax.tree.leaves(model)} == {jnp.dtype(jnp.float32)}


def test_asymmetry_below_the_tolerance_is_accepted():
    P0 = np.eye(2)
    P0[0, 1] = 1e-9
    jf.models.linear_gaussian(**{**GOOD, "P0": P0})


@pytest.mark.parametrize("name", ["F", "Q"])
def test_intervals_given_to_a_fixed_matrix_are_refused(name):
    model = jf.models.linear_gaussian(**GOOD)
    with pytest.raises(ValueError, match="dt: given, but the model's F is a fixed matrix"):
        jf.filter(jf.kalman(model), np.zeros((3, 1)), dt=1.0)


def test_nothing_is_raised_for_traced_values():
    """A population may hold an indefinite member: it is the tuner's business, and no NaN comes out."""

    def likelihood(q):
        model = jf.models.linear_gaussian(**{**GOOD, "Q": q * jnp.eye(2)})
        return jf.filter(jf.kalman(model), jnp.ones((3, 1))).log_lik.sum()

    assert np.isfinite(jax.vmap(likelihood)(jnp.array([1.0, 0.0]))).all()
