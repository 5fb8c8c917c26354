"""What every filter's update does with a sample before and after its own algebra."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import PyTree, Status, StepInput, flag


class Innovation(NamedTuple):
    """A sanitised innovation: no NaN of an absent or unusable component is left in it."""

    value: Array  # (m,), 0 where absent or not finite
    mask: Array | None  # (m,) bool, as given
    status: Array  # MISSED and NONFINITE


def innovate(inp: StepInput, predicted: Array, residual: Callable[[Array, Array], Array] | None = None) -> Innovation:
    """The innovation ``residual(y, predicted)`` (m,) with absent and non-finite components exactly 0.

    An unmasked NaN or infinite value touches the mean only (its innovation is 0) and sets NONFINITE, so that
    covariances stay shared between the runs of a batch.
    """
    check_dtype(inp, predicted)
    bad = ~jnp.isfinite(inp.y)
    usable = ~bad if inp.mask is None else inp.mask & ~bad
    y = jnp.where(usable, inp.y, predicted)
    value = jnp.where(usable, y - predicted if residual is None else residual(y, predicted), jnp.zeros((), y.dtype))
    if inp.mask is None:
        return Innovation(value, None, flag(bad.any(), Status.NONFINITE))
    status = flag((bad & inp.mask).any(), Status.NONFINITE) | flag(~inp.mask.any(), Status.MISSED)
    return Innovation(value, inp.mask, status)


def masked_rows(mask: Array | None, H: Array) -> Array:
    """H (m, n) with the rows of absent components 0."""
    return H if mask is None else jnp.where(mask[:, None], H, jnp.zeros((), H.dtype))


def decoupled(mask: Array | None, S: Array) -> Array:
    """S (m, m) with absent components decoupled. They keep their own variance: a 1 would spoil relative tolerances."""
    if mask is None:
        return S
    keep = (mask[:, None] & mask[None, :]) | np.eye(S.shape[0], dtype=bool)
    return jnp.where(keep, S, jnp.zeros((), S.dtype))


def likelihood(mask: Array | None, L: Array, whitened: Array) -> tuple[Array, Array, Array]:
    """``(nis, log_lik, status)`` of a Gaussian innovation over its present components.

    Args:
        mask: (m,) bool or None.
        L: (m, m) lower factor of the decoupled innovation covariance.
        whitened: (m,) L^-1 nu.

    A zero pivot adds nothing to the determinant and sets SINGULAR.
    """
    diagonal = jnp.diagonal(L)
    singular = diagonal == 0
    if mask is None:
        count = jnp.asarray(float(L.shape[0]), L.dtype)
        counted = ~singular
    else:
        count = mask.sum().astype(L.dtype)
        counted = ~singular & mask
        singular = singular & mask
    nis = jnp.sum(whitened * whitened)
    log_det = jnp.sum(jnp.where(counted, jnp.log(jnp.where(counted, diagonal, jnp.ones((), L.dtype))), 0.0))
    log_lik = -0.5 * (nis + count * float(np.log(2 * np.pi))) - log_det
    return nis, log_lik, flag(singular.any(), Status.SINGULAR)


def check_measurement(inp: StepInput, m: int, what: str = "the model's H") -> None:
    """Raises a ValueError if the measurement has not m components."""
    if inp.y.shape != (m,):
        raise ValueError(f"ys: expected {m} components per sample as {what}, got {inp.y.shape[0]}")


def check_dtype(inp: StepInput, reference: Array) -> None:
    """Raises a TypeError if the measurement's float dtype is not the model's."""
    if inp.y.dtype != reference.dtype:
        raise TypeError(f"ys: is {inp.y.dtype}, but the filter's model is {reference.dtype}; convert one of them")


def step_key(inp: StepInput, number: int) -> Array:
    """Random key ``number`` of a step, or a ValueError at trace time if it has none."""
    if inp.key is None:
        raise ValueError("key: a particle filter draws random numbers; give jf.filter a key")
    return jax.random.fold_in(inp.key, number)


def stack(trees: Sequence[PyTree], dtype: Any) -> PyTree:
    """Filters or models of equal structure as one with a leading axis; Python numbers in them take the dtype."""

    def together(*leaves):
        own = getattr(leaves[0], "dtype", None)
        weak = own is None or getattr(leaves[0], "weak_type", False)
        floats = jnp.issubdtype(jnp.result_type(leaves[0]), jnp.floating)
        return jnp.stack([jnp.asarray(leaf, dtype if floats and weak else own) for leaf in leaves])

    return jax.tree.map(together, *trees)
