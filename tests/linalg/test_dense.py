"""Guarded factorisations: right where NumPy is right, finite where NumPy is not."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilt import linalg

chol, solve_lower, solve_lower_t = jax.jit(linalg.chol), jax.jit(linalg.solve_lower), jax.jit(linalg.solve_lower_t)
solve_chol, tria = jax.jit(linalg.solve_chol), jax.jit(linalg.tria)
dtypes = pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])


def tol(dtype):
    return 50 * float(jnp.finfo(dtype).eps)


@dtypes
def test_cholesky_and_solves_equal_numpy(dtype):
    rng = np.random.default_rng(0)
    A = rng.normal(size=(4, 6))
    A = A @ A.T
    b = rng.normal(size=(4, 3))
    L = chol(jnp.asarray(A, dtype))
    np.testing.assert_allclose(L, np.linalg.cholesky(A), atol=tol(dtype) * 10)
    np.testing.assert_allclose(solve_chol(L, jnp.asarray(b, dtype)), np.linalg.solve(A, b), atol=tol(dtype) * 100)
    x = solve_lower(L, jnp.asarray(b[:, 0], dtype))
    np.testing.assert_allclose(L @ x, b[:, 0], atol=tol(dtype) * 10)
    x = solve_lower_t(L, jnp.asarray(b[:, 0], dtype))
    np.testing.assert_allclose(L.T @ x, b[:, 0], atol=tol(dtype) * 10)


@dtypes
@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
def test_a_singular_matrix_gives_zero_columns_whatever_its_unit(dtype, unit):
    g = np.array([0.5, 1.0, 2.0])
    A = jnp.asarray(unit * np.outer(g, g), dtype)  # rank 1
    L = chol(A)
    np.testing.assert_allclose(L @ L.T, A, rtol=tol(dtype))
    assert (np.diagonal(L)[1:] == 0).all()
    assert np.isfinite(solve_chol(L, jnp.ones(3, dtype))).all()
    assert (chol(jnp.zeros((3, 3), dtype)) == 0).all()


@dtypes
def test_gradients_are_finite_at_singular_matrices(dtype):
    def f(A):
        L = linalg.chol(A)
        return jnp.sum(linalg.solve_chol(L, jnp.ones(3, A.dtype))) + jnp.sum(L)

    gradient = jax.jit(jax.grad(f))
    for A in (np.zeros((3, 3)), np.outer([0.5, 1, 2], [0.5, 1, 2]), np.diag([1.0, 0.0, 2.0])):
        assert np.isfinite(gradient(jnp.asarray(A, dtype))).all()


@dtypes
@pytest.mark.parametrize("shape", [(3, 7), (4, 4), (4, 2), (1, 3)])
def test_tria_is_the_lower_factor(dtype, shape):
    A = jnp.asarray(np.random.default_rng(1).normal(size=shape), dtype)
    L = tria(A)
    n = shape[0]
    assert L.shape == (n, n)
    assert (np.triu(L, 1) == 0).all()
    assert (np.diagonal(L) >= 0).all()
    np.testing.assert_allclose(L @ L.T, A @ A.T, atol=tol(dtype) * 10)


@dtypes
def test_tria_leaves_the_mass_of_a_dependent_row_to_the_rows_below(dtype):
    """A dependent row has a zero pivot and an empty column; L L' = A A' all the same."""
    rng = np.random.default_rng(2)
    A = rng.normal(size=(4, 5))
    A[1] = 2 * A[0]
    A = jnp.asarray(A, dtype)
    L = tria(A)
    assert (np.asarray(L)[:, 1] == 0).all()
    np.testing.assert_allclose(L @ L.T, A @ A.T, atol=tol(dtype) * 10)


@dtypes
@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
def test_tria_keeps_what_a_row_has_apart_however_small_and_only_that(dtype, unit):
    """One update whose posterior is far below the prior (Bierman 1977), then one that leaves nothing (R = 0)."""
    e = 2 * float(jnp.finfo(dtype).eps)
    L = np.eye(2) / e
    H = np.array([[1.0, e], [1.0, 1.0]])
    array = jax.jit(linalg.tria, static_argnums=1)
    A = jnp.asarray(unit * np.block([[H @ L, np.eye(2)], [L, np.zeros((2, 2))]]), dtype)
    L_new = np.asarray(array(A, 2), float)[2:, 2:] / unit
    np.testing.assert_allclose(L_new @ L_new.T, [[1, -1], [-1, 2]], rtol=20 * e)
    rng = np.random.default_rng(7)
    for _ in range(20):
        L = np.tril(rng.normal(size=(3, 3))) * 10.0 ** rng.uniform(-3, 3, (3, 1))
        A = jnp.asarray(unit * np.block([[L[:1], np.zeros((1, 1))], [L, np.zeros((3, 1))]]), dtype)
        L_new = np.asarray(array(A, 1))[1:, 1:]
        assert (L_new[0] == 0).all()  # the first state was measured exactly


def test_tria_derivative_by_log_diagonal_and_triangular_solve():
    """Against the derivatives of slogdet and of a dense solve: R R' alone would not see a wrong skew part."""
    A = jnp.asarray(np.random.default_rng(3).normal(size=(3, 7)))
    b = jnp.array([1.0, -2.0, 0.5])

    def by_tria(A):
        L = linalg.tria(A)
        return jnp.stack([jnp.sum(jnp.log(jnp.diagonal(L))), jnp.sum(linalg.solve_lower(L, b) ** 2)])

    def by_dense(A):
        return jnp.stack([0.5 * jnp.linalg.slogdet(A @ A.T)[1], b @ jnp.linalg.solve(A @ A.T, b)])

    reverse, forward, dense = (jax.jit(f)(A) for f in (jax.jacrev(by_tria), jax.jacfwd(by_tria), jax.jacrev(by_dense)))
    np.testing.assert_allclose(reverse, dense, atol=1e-13)
    np.testing.assert_allclose(forward, dense, atol=1e-13)


@dtypes
def test_tria_derivative_is_finite_at_zero_rows_and_columns(dtype):
    A = np.random.default_rng(4).normal(size=(3, 5))
    gradient = jax.jit(jax.grad(lambda A: jnp.sum(linalg.solve_lower(linalg.tria(A), jnp.ones(3, A.dtype)))))
    for zero in ((slice(None), 2), (1, slice(None)), (slice(None), slice(None))):
        B = A.copy()
        B[zero] = 0
        assert np.isfinite(gradient(jnp.asarray(B, dtype))).all()


@dtypes
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_nan_and_infinity_are_not_taken_for_a_zero_pivot(dtype, bad):
    """A filter would go on with a variance of 0 and say nothing."""
    for n in (1, 3):
        A = np.eye(n, n)
        for i in range(n):
            B = A.copy()
            B[i, i] = bad
            assert np.isnan(np.asarray(chol(jnp.asarray(B, dtype)))).any()
            assert np.isnan(np.asarray(tria(jnp.asarray(np.block([B, A]), dtype)))).any()


def test_scales_act_as_a_diagonal_on_both_sides():
    A = jnp.asarray(np.random.default_rng(5).normal(size=(3, 3)))
    A = linalg.sym(A @ A.T)
    s = jnp.array([0.5, 2.0, 3.0])
    D = jnp.diag(jnp.sqrt(s))
    np.testing.assert_allclose(linalg.scale_cov(A, s), D @ A @ D, rtol=1e-14)
    L = linalg.scale_factor(chol(A), s)
    np.testing.assert_allclose(L @ L.T, D @ A @ D, rtol=1e-13)
    np.testing.assert_allclose(linalg.scale_cov(A, jnp.asarray(3.0)), 3 * A)
    assert linalg.scale_cov(A, None) is A
    gradient = jax.grad(lambda s: jnp.sum(linalg.scale_cov(A, s)))(jnp.array([0.0, 1.0, 1.0]))
    assert np.isfinite(gradient).all()


def test_sym_is_symmetric_to_the_bit():
    A = linalg.sym(jnp.asarray(np.random.default_rng(6).normal(size=(5, 5))))
    assert (A == A.T).all()
