"""A model's path without process noise, and how it depends on where it starts."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxfilt.core import StepInput, present
from jaxfilt.filters.common import decoupled, masked_rows
from jaxfilt.linalg import chol, solve_lower
from jaxfilt.models.nonlinear import Nonlinear, covariance, jacobian


class Path(NamedTuple):
    """What a start x0 leads to, and its derivatives with respect to x0."""

    states: Array  # (T, n)
    transition: Array  # (T, n, n) d x_k / d x0
    sensitivity: Array  # (T, m, n) L^-1 d h(x_k) / d x0, where R = L L'; rows of absent components are 0
    residual: Array  # (T, m) L^-1 (y_k - h(x_k)), wrapped as the model says; 0 where absent


def noise_free(model: Nonlinear, x0: Array, inputs: StepInput, *, first_update_only: bool = False) -> Path:
    """Follows ``x_k = f(x_{k-1})`` from x0 (n,) through the steps of ``inputs`` (from :func:`jaxfilt.inputs`).

    R may depend on the state: its value at x_k is taken, but not differentiated. A non-finite measurement is absent.
    """

    def body(carry, step):
        inp, is_first = step
        x, Phi = carry
        F = jacobian(model.f, model.f_jacobian, x, inp.u, inp.dt)
        new, Phi_new = model.f(x, inp.u, inp.dt), F @ Phi
        if is_first is not None:
            new, Phi_new = jnp.where(is_first, x, new), jnp.where(is_first, Phi, Phi_new)
        predicted = model.h(new, inp.u, inp.dt)
        there = present(inp) & jnp.isfinite(inp.y)
        y = jnp.where(there, inp.y, predicted)
        error = jnp.where(there, y - predicted if model.residual is None else model.residual(y, predicted), 0.0)
        L, H = weighted(model, new, inp, there)
        return (new, Phi_new), Path(new, Phi_new, solve_lower(L, H @ Phi_new), solve_lower(L, error))

    is_first = jnp.arange(inputs.y.shape[0]) == 0 if first_update_only else None
    eye = jnp.eye(x0.shape[0], dtype=x0.dtype)
    with jax.default_matmul_precision("highest"):
        return jax.lax.scan(body, (x0, eye), (inputs, is_first))[1]


def weighted(model: Nonlinear, x: Array, inp: StepInput, mask: Array | None) -> tuple[Array, Array]:
    """``(L, H)`` at a state: the factor of R, and the Jacobian of h with the rows of absent components 0."""
    H = jacobian(model.h, model.h_jacobian, x, inp.u, inp.dt)
    return chol(decoupled(mask, covariance(model.R, x, inp.u, inp.dt))), masked_rows(mask, H)
