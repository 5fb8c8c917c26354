"""The two-point boundary value: the costate alpha at the start that meets the terminal condition."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array


class Solved(NamedTuple):
    """A root."""

    value: Array
    residual: Array  # () largest component left


def solve_affine(residual: Callable[[Array], Array], size: int, dtype=float) -> Array:
    """The root of an affine residual: one linear solve."""
    zero = jnp.zeros(size, dtype)
    return -jnp.linalg.solve(jax.jacfwd(residual)(zero), residual(zero))


def newton(residual: Callable[[Array], Array], start: Array, steps: int) -> Solved:
    """A fixed number of Newton steps; the derivative of the root is that of the implicit function.

    Unrolled derivatives would cost as much as all steps together, and be those of an iterate.
    """

    def iterate(f, value):
        def advance(value, _):
            return value - jnp.linalg.solve(jax.jacfwd(f)(value), f(value)), None

        return jax.lax.scan(advance, value, length=steps)[0]

    value = jax.lax.custom_root(residual, start, iterate, _solve_linear)
    return Solved(value, jnp.abs(jax.lax.stop_gradient(residual(value))).max())


def _solve_linear(linear, y):
    return jnp.linalg.solve(jax.jacfwd(linear)(jnp.zeros_like(y)), y)


def multiple_shooting(
    stage: Callable[[Array], Array],
    first: Callable[[Array], Array],
    last: Callable[[Array], Array],
    guess: Array,
    steps: int,
) -> Solved:
    """Newton on the values z (K + 1, N) at all nodes, which keeps long horizons from blowing up.

    Args:
        stage: ``z_j -> z_{j+1}``, one stage of the horizon.
        first: what must vanish at the first node, (N / 2,).
        last: what must vanish at the last, (N / 2,).
        guess: (K + 1, N).
        steps: Newton steps.
    """
    shape = guess.shape

    def residual(flat):
        z = flat.reshape(shape)
        defects = z[1:] - jax.vmap(stage)(z[:-1])
        return jnp.concatenate([first(z[0]), defects.ravel(), last(z[-1])])

    found = newton(residual, guess.ravel(), steps)
    return Solved(found.value.reshape(shape), found.residual)


def care(A: Any, B: Any, Q: Any, R: Any) -> np.ndarray:
    """The stabilising solution of the continuous Riccati equation, by SciPy, at design time.

    Raises:
        ValueError: there is none, or a matrix has the wrong shape or is not (semi)definite.
    """
    import scipy.linalg

    A, B, Q, R = (np.asarray(x, float) for x in (A, B, Q, R))
    n, m = B.shape
    if A.shape != (n, n) or Q.shape != (n, n) or R.shape != (m, m):
        raise ValueError(f"care: shapes A {A.shape}, B {B.shape}, Q {Q.shape}, R {R.shape} do not fit")
    if np.linalg.eigvalsh(Q).min() < -1e-12 * max(np.abs(Q).max(), 1e-300):
        raise ValueError("Q: expected a positive semidefinite matrix")
    if np.linalg.eigvalsh(R).min() <= 0:
        raise ValueError("R: expected a positive definite matrix")
    try:
        S = scipy.linalg.solve_continuous_are(A, B, Q, R)
    except np.linalg.LinAlgError as error:
        raise ValueError("care: no stabilising solution") from error
    if np.linalg.eigvals(A - B @ np.linalg.solve(R, B.T @ S)).real.max() >= 0:
        raise ValueError("care: no stabilising solution")
    return S


def care_by_sign(A: Array, B: Array, Q: Array, R: Array, steps: int = 30) -> Array:
    """The same, traceable: from the sign of the Hamiltonian matrix by Newton's iteration (Roberts 1980)."""
    n = A.shape[0]
    G = B @ jnp.linalg.solve(R, B.T)
    W = jnp.block([[A, -G], [-Q, -A.T]])

    def advance(W, _):
        inverse = jnp.linalg.inv(W)
        scale = jnp.sqrt(jnp.linalg.norm(inverse) / jnp.linalg.norm(W))
        return 0.5 * (scale * W + inverse / scale), None

    W = jax.lax.scan(advance, W, length=steps)[0]
    eye = jnp.eye(n, dtype=A.dtype)
    # the stable subspace [I; S] is in the kernel of sign(W) + I
    left = jnp.concatenate([W[:n, n:], W[n:, n:] + eye])
    right = -jnp.concatenate([W[:n, :n] + eye, W[n:, :n]])
    S = jnp.linalg.solve(left.T @ left, left.T @ right)
    return 0.5 * (S + S.T)
