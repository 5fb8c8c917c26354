"""Trajectories and measurements drawn from a model."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxfilt import core
from jaxfilt.core import PyTree, StepInput, is_concrete, numbers
from jaxfilt.filters.kalman import input_term
from jaxfilt.linalg import chol, solve_chol, sym
from jaxfilt.models.linear import LinearGaussian, check_finite, check_linear, check_shape, value


class Simulated(NamedTuple):
    """A drawn trajectory and what its sensor measured."""

    states: Array  # (T, n)
    ys: Array  # (T, m)


def simulate(
    model: LinearGaussian,
    T: int,
    key: Array,
    *,
    x0: Any = None,
    dt: Any = None,
    u: PyTree = None,
    first_update_only: bool = False,
) -> Simulated:
    """Draws a trajectory and its measurements from a linear-Gaussian model. Batch it with ``jax.vmap`` over keys.

    The convention is that of :func:`jaxfilt.filter`: the start is one step before the first sample, unless
    ``first_update_only`` says that it is at the first sample. Singular Q, R and P0 are fine; correlated noise (the
    model's S) is honored.

    Random numbers: the start takes ``fold_in(key, 0)``, step k (from 0) takes ``fold_in(key, k + 1)``. A longer
    simulation with the same key therefore begins with the shorter one.

    Args:
        model: from :func:`jaxfilt.models.linear_gaussian` or a motion builder.
        T: number of samples.
        key: random key.
        x0: (n,) the true start. None = drawn from N(m0, P0).
        dt: (T,) or scalar intervals; None = the model's own.
        u: pytree with leading T for the model functions and the input matrices.
        first_update_only: takes the start as the state at the first sample.

    Returns:
        ``Simulated(states (T, n), ys (T, m))`` in the model's units and dtype.

    Raises:
        ValueError: T < 1, wrong shapes, negative dt, a non-finite x0.
        TypeError: integer arrays or another float dtype than the model's.
    """
    check_linear(model)
    core.check_flag("first_update_only", first_update_only)
    stacked = _inputs(T, model.m0.dtype, dt, u, key)
    if x0 is not None:
        x0 = _state("x0", x0, model, ())
    return _simulate(model, stacked, key, x0, first_update_only)


def measure(model: LinearGaussian, states: Any, key: Array, *, dt: Any = None, u: PyTree = None) -> Array:
    """Measurements ``ys (T, m)`` of given states (T, n), a planned or recorded path: ``y = H x + D u + v``.

    Step k takes ``fold_in(key, k + 1)``. The other arguments and errors are as in :func:`simulate`; the model's S plays
    no part, since the process noise is not known.
    """
    check_linear(model)
    states = _state("states", states, model, (None,))
    return _measure(model, states, _inputs(states.shape[0], model.m0.dtype, dt, u, key))


def _inputs(T, dtype, dt, u, key) -> StepInput:
    core.check_count("T", T, 1)
    # The filter's own checks and keys; the measurement here only carries the length and the dtype.
    return core.inputs(jnp.zeros((T, 1), dtype), dt=dt, u=u, key=key)


def _state(name, x, model, leading):
    if is_concrete(x):
        numbers(name, x)
    dtype = getattr(x, "dtype", model.m0.dtype)
    if dtype != model.m0.dtype:
        raise TypeError(f"{name}: is {dtype}, but the model is {model.m0.dtype}; convert one of them")
    x = jnp.asarray(x, model.m0.dtype)
    check_shape(name, x, (*leading, model.m0.shape[0]))
    check_finite(name, x)
    return x


@partial(jax.jit, static_argnames="first_update_only")
def _simulate(model, stacked, key, x0, first_update_only):
    n, dtype = model.m0.shape[0], model.m0.dtype
    if x0 is None:
        x0 = model.m0 + chol(model.P0) @ jax.random.normal(jax.random.fold_in(key, 0), (n,), dtype)
    # Factors of what is fixed are taken once, outside the scan.
    fixed_Q = None if callable(model.Q) or model.S is not None else chol(model.Q)
    fixed_R = None if callable(model.R) else chol(model.R)

    def body(carry, step):
        x, kick, JS = carry
        inp, is_first = step
        F, H = value(model.F, inp.u, inp.dt), value(model.H, inp.u, inp.dt)
        noise = jax.random.normal(inp.key, (n + H.shape[0],), dtype)
        L_Q = chol(sym(value(model.Q, inp.u, inp.dt) - JS)) if fixed_Q is None else fixed_Q
        moved = F @ x + kick + L_Q @ noise[:n]
        shift = input_term(model.B, inp)
        if shift is not None:
            moved = moved + shift
        x = moved if is_first is None else jnp.where(is_first, x, moved)
        y, v = _sense(model, H, x, inp, fixed_R, noise[n:])
        if model.S is not None:
            # Cov(w', v) = S splits into w' = J v + an independent part, J = S R^-1, Cov = Q - J S'.
            S = value(model.S, inp.u, inp.dt)
            J = solve_chol(chol(value(model.R, inp.u, inp.dt)), S.T).T
            kick, JS = J @ v, J @ S.T
        return (x, kick, JS), (x, y)

    with jax.default_matmul_precision("highest"):
        zeros = jnp.zeros((n, n), dtype)
        is_first = jnp.arange(stacked.y.shape[0]) == 0 if first_update_only else None
        _, (states, ys) = jax.lax.scan(body, (x0, zeros[0], zeros), (stacked, is_first))
    return Simulated(states, ys)


@jax.jit
def _measure(model, states, stacked):
    fixed_R = None if callable(model.R) else chol(model.R)

    def body(carry, step):
        x, inp = step
        H = value(model.H, inp.u, inp.dt)
        noise = jax.random.normal(inp.key, (H.shape[0],), x.dtype)
        return carry, _sense(model, H, x, inp, fixed_R, noise)[0]

    with jax.default_matmul_precision("highest"):
        return jax.lax.scan(body, None, (states, stacked))[1]


def _sense(model, H, x, inp, fixed_R, noise):
    L_R = chol(value(model.R, inp.u, inp.dt)) if fixed_R is None else fixed_R
    v = L_R @ noise
    y = H @ x + v
    shift = input_term(model.D, inp)
    return (y if shift is None else y + shift), v
