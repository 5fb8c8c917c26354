"""Linear-Gaussian state-space models as pytrees."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt import describe
from jaxfilt.core import PyTree, aspartial, is_concrete, numbers
from jaxfilt.linalg.structure import array, diagonal, repeat

Matrix = Array | Callable[[PyTree, Array | None], Array]


class LinearGaussian(NamedTuple):
    """x_k = F x_{k-1} + B u_k + w, y_k = H x_k + D u_k + v. Build it with :func:`linear_gaussian`.

    Each matrix is an array or a function ``(u, dt)`` of what is in force on the interval that ends at k.
    """

    F: Matrix  # (n, n)
    H: Matrix  # (m, n)
    Q: Matrix  # (n, n)
    R: Matrix  # (m, m)
    m0: Array  # (n,)
    P0: Array  # (n, n)
    B: Matrix | None = None  # (n, p), or a function that gives the whole input term (n,)
    D: Matrix | None = None  # (m, p), or a function that gives the whole input term (m,)
    S: Matrix | None = None  # (n, m) Cov(w_{k+1}, v_k)

    def __repr__(self) -> str:
        """Matrices by shape, small ones and functions by their numbers."""
        return describe.fields(self)


def linear_gaussian(
    F: Any, H: Any, Q: Any, R: Any, m0: Any, P0: Any, *, B: Any = None, D: Any = None, S: Any = None
) -> LinearGaussian:
    """A linear-Gaussian model, checked.

    ``x_k = F x_{k-1} + B u_k + w_k``, ``y_k = H x_k + D u_k + v_k``, ``w ~ N(0, Q)``, ``v ~ N(0, R)``,
    ``x_0 ~ N(m0, P0)`` one step before the first sample (or at it, with ``first_update_only=True``).

    Args:
        F: (n, n) transition matrix, or a function ``(u, dt) -> (n, n)``. What varies with time travels in ``u``.
        H: (m, n) measurement matrix, or a function.
        Q: (n, n) process noise covariance, or a function. May be singular.
        R: (m, m) measurement noise covariance, or a function. May be singular (a perfect sensor).
        m0: (n,) prior mean.
        P0: (n, n) prior covariance. May be singular.
        B: (n, p) input matrix, multiplied by ``u``; or a function ``(u, dt)`` that gives the whole input term (n,).
        D: (m, p) likewise for the measurement.
        S: (n, m) covariance of v_k with the process noise of the interval that begins at k (Anderson and Moore 1979,
            section 5.5), or a function of the ``(u, dt)`` in force at k.

    Arrays must agree in their float dtype; Python numbers and lists of them take it. Write model functions with ``def``
    at module level and bind traced values with ``jax.tree_util.Partial(f, value)``.

    Raises:
        ValueError: wrong shapes, or (concrete arrays) non-finite values or a Q, R, P0 that is asymmetric by more than
            1e-8 relative or indefinite, or an S that no joint noise of this Q and R has.
        TypeError: integer arrays, or arrays of different float dtypes.
    """
    given = {"F": F, "H": H, "Q": Q, "R": R, "m0": m0, "P0": P0, "B": B, "D": D, "S": S}
    optional = {name for name in ("B", "D", "S") if given[name] is None}
    dtype = common_dtype({name: x for name, x in given.items() if not callable(x) and name not in optional})
    a: dict[str, Any] = {}
    for name, x in given.items():
        a[name] = aspartial(x) if callable(x) else None if x is None else array(x, dtype)
    if a["m0"].ndim != 1 or a["m0"].size == 0:
        raise ValueError(f"m0: expected shape (n,) with n >= 1, got {a['m0'].shape}")
    n = a["m0"].shape[0]
    m = next((a[name].shape[0] for name in ("H", "R", "D") if not callable(a[name]) and jnp.ndim(a[name]) == 2), None)
    for name, shape in {
        "F": (n, n), "H": (m, n), "Q": (n, n), "R": (m, m), "P0": (n, n), "B": (n, None), "D": (m, None), "S": (n, m),
    }.items():  # fmt: skip
        if a[name] is not None and not callable(a[name]):
            check_shape(name, a[name], shape, f" with m0 of {n} components")
            if name in ("Q", "R", "P0"):
                check_covariance(name, a[name])
            else:
                check_finite(name, a[name])
    check_finite("m0", a["m0"])
    if a["S"] is not None and not any(callable(a[name]) for name in ("Q", "R", "S")):
        check_covariance("S, with Q and R", jnp.block([[a["Q"], a["S"]], [a["S"].T, a["R"]]]))
    return LinearGaussian(**a)


def value(matrix: Matrix, u: PyTree, dt: Array | None) -> Array:
    """A model matrix on the interval that ends at k."""
    return matrix(u, dt) if callable(matrix) else matrix


def measurement_covariance(r: Array, d: int) -> Array:
    """R (d, d) of d measured axes from variances: a scalar, one per axis, or R itself.

    Raises:
        ValueError: another shape.
    """
    if r.shape not in ((), (d,), (d, d)):
        raise ValueError(f"r: expected a scalar, shape ({d},) or ({d}, {d}), got {r.shape}")
    if r.ndim == 2:
        check_covariance("r", r)
    else:
        check_positive("r", r, zero=True)
    return r if r.ndim == 2 else diagonal(repeat(r, d))


def common_dtype(arrays: dict[str, Any]) -> np.dtype:
    """The one float dtype of the arrays in a dict; Python numbers and lists of them have none of their own.

    Raises:
        TypeError: for integer arrays, or different float dtypes; names the argument.
    """
    dtypes = {}
    for name, x in arrays.items():
        if x is None:
            raise TypeError(f"{name}: expected an array or numbers, got None")
        for leaf in jax.tree.leaves(x):
            if hasattr(leaf, "dtype"):
                if not jnp.issubdtype(leaf.dtype, jnp.floating):
                    raise TypeError(f"{name}: expected a float array, got {leaf.dtype}")
                if not getattr(leaf, "weak_type", False):
                    dtypes[name] = jax.dtypes.canonicalize_dtype(leaf.dtype)
            elif not isinstance(leaf, int | float):
                raise TypeError(f"{name}: expected an array or numbers, got {type(leaf).__name__}")
    if len(set(dtypes.values())) > 1:
        listed = ", ".join(f"{name} is {dtype}" for name, dtype in dtypes.items())
        raise TypeError(f"expected one float dtype, but {listed}")
    return next(iter(dtypes.values()), jnp.zeros(()).dtype)


def check_linear(model: Any, name: str = "model") -> None:
    """Raises a TypeError that names the argument if it is no linear-Gaussian model."""
    if not isinstance(model, LinearGaussian):
        raise TypeError(f"{name}: expected a linear-Gaussian model, got {type(model).__name__}")


def check_shape(name: str, x: Any, shape: tuple[int | None, ...], why: str = "") -> None:
    """Raises a ValueError that names ``x`` if its shape is not as expected (``why``); None matches any size."""
    try:
        chex.assert_shape(x, shape)
    except AssertionError:
        wanted = (
            "(" + ", ".join("any" if size is None else str(size) for size in shape) + ("," * (len(shape) == 1)) + ")"
        )
        raise ValueError(f"{name}: expected shape {wanted}, got {jnp.shape(x)}{why}") from None


def check_finite(name: str, x: Any) -> None:
    """Raises a ValueError that names ``x`` if it is concrete and has a NaN or infinite entry."""
    if is_concrete(x) and not np.isfinite(a := numbers(name, x)).all():
        raise ValueError(f"{name}: expected finite values, got {a}")


def check_covariance(name: str, x: Any) -> None:
    """Raises a ValueError that names ``x`` (n, n) if it is concrete and no covariance.

    Asymmetric by more than 1e-8 relative (or 10 eps in lower precision), or with an eigenvalue below -10 n eps times
    the largest.
    """
    if not is_concrete(x):
        return
    check_finite(name, x)
    eps = float(jnp.finfo(jnp.asarray(x).dtype).eps)
    A = np.asarray(x, np.float64)
    if A.ndim != 2 or A.shape[0] != A.shape[1] or A.size == 0:
        raise ValueError(f"{name}: expected shape (n, n), got {A.shape}")
    size = np.abs(A).max()
    if np.abs(A - A.T).max() > max(1e-8, 10 * eps) * size:
        raise ValueError(f"{name}: expected a symmetric matrix, got {A.tolist()}")
    eigenvalues = np.linalg.eigvalsh(A)
    if eigenvalues[0] < -10 * len(A) * eps * size:
        raise ValueError(
            f"{name}: expected a positive semidefinite matrix, "
            f"got smallest eigenvalue {eigenvalues[0]:.3g} of {A.tolist()}"
        )


def check_positive(name: str, x: Any, *, zero: bool = False, scalar: bool = False) -> None:
    """Raises a ValueError that names ``x`` if it is concrete and not positive (or, with ``zero``, negative).

    With ``scalar`` also if its shape is not ().
    """
    if scalar and jnp.shape(numbers(name, x) if is_concrete(x) else x) != ():
        raise ValueError(f"{name}: expected a scalar, got shape {jnp.shape(x)}")
    if is_concrete(x):
        a = numbers(name, x)
        if not (np.isfinite(a) & ((a >= 0) if zero else (a > 0))).all():
            raise ValueError(f"{name}: expected a finite value {'>= 0' if zero else '> 0'}, got {a}")
