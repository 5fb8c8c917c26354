"""Packets that arrive late or never: their probabilities, and a linear model that has past measurements too."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from jaxfilt.core import Static, check_count, is_concrete, real_array
from jaxfilt.models.linear import LinearGaussian, check_linear, common_dtype


def delay_probabilities(alpha: Any) -> Array:
    """Probabilities of a packet's delay for the Bernoulli channel: on time, 1..d samples late, lost.

    A packet tries again in each sample until it succeeds: ``p_l = alpha_l prod_{i<l} (1 - alpha_i)``, and it is lost
    with the rest, ``prod_i (1 - alpha_i)``.

    Args:
        alpha: (..., d+1) probability of success in sample 0..d after sending, in [0, 1].

    Returns:
        (..., d+2), non-negative with sum 1.

    Raises:
        ValueError: no last axis, or a (concrete) probability outside [0, 1].

    Source: Sun 2013, eq. (2).
    """
    alpha = jnp.asarray(alpha, common_dtype({"alpha": alpha}))
    if alpha.ndim == 0 or alpha.shape[-1] == 0:
        raise ValueError(f"alpha: expected shape (..., d+1), got {alpha.shape}")
    if is_concrete(alpha) and not ((np.asarray(alpha) >= 0) & (np.asarray(alpha) <= 1)).all():
        raise ValueError(f"alpha: expected probabilities in [0, 1], got {np.asarray(alpha).tolist()}")
    kept = jnp.cumprod(1 - alpha, axis=-1)
    before = jnp.concatenate([jnp.ones_like(alpha[..., :1]), kept[..., :-1]], axis=-1)
    return jnp.concatenate([alpha * before, kept[..., -1:]], axis=-1)


def success_probabilities(probabilities: Any) -> Array:
    """The inverse of :func:`delay_probabilities`: (..., d+2) -> alpha (..., d+1); 0 where nothing is left to arrive."""
    p = jnp.asarray(probabilities, common_dtype({"probabilities": probabilities}))
    check_probabilities("probabilities", p)
    left = jnp.flip(jnp.cumsum(jnp.flip(p, -1), axis=-1), -1)[..., :-1]
    some = left > 0
    return jnp.where(some, p[..., :-1] / jnp.where(some, left, jnp.ones_like(left)), jnp.zeros_like(left))


def check_probabilities(name: str, p: Array) -> None:
    """Raises a ValueError that names ``p`` (..., d+2) if it is concrete and no probabilities of delays."""
    if jnp.ndim(p) == 0 or p.shape[-1] < 2:
        raise ValueError(f"{name}: expected shape (..., d+2) with d >= 0: on time, late, lost; got {jnp.shape(p)}")
    if not is_concrete(p):
        return
    a = np.asarray(p, np.float64)
    eps = float(jnp.finfo(p.dtype).eps)
    if not (np.isfinite(a) & (a >= 0)).all() or (np.abs(a.sum(axis=-1) - 1) > max(1e-9, 16 * eps)).any():
        raise ValueError(f"{name}: expected probabilities that sum to 1, got {a.tolist()}")


def with_lags(model: LinearGaussian, max_delay: int) -> LinearGaussian:
    """The model with its d last states: a late measurement with a time stamp is then a measurement like any other.

    State ``[x_k, x_{k-1}, .., x_{k-d}]``, measurement ``[y_k, y_{k-1}, .., y_{k-d}]`` with mask: what arrives at step
    k. Any linear filter of it is the exact filter for out-of-sequence measurements; the state's last block is the
    fixed-lag smoother. Arrange the data with :func:`jaxfilt.lag_inputs`, or take ``packets`` and ``arrived`` of
    :func:`jaxfilt.simulate.deliver`, where several packets may arrive at once. Where the channels of one packet arrive
    at different steps R must be diagonal, since the noise they share would be forgotten in between.

    Args:
        model: F, Q and B may vary with ``(u, dt)``; H and R may not, since a late packet was made earlier.
        max_delay: d >= 0.

    Raises:
        ValueError: d < 0, H or R that are functions, a model with D, or with correlated noise S (not covered).
    """
    check_linear(model)
    check_count("max_delay", max_delay, 0)
    H, R = model.H, model.R
    if callable(H) or callable(R):
        raise ValueError("model: H and R must be matrices, since a late packet was made at an earlier step")
    if model.S is not None:
        raise ValueError("model: noise correlated between process and measurement (S) is not covered with lags")
    if model.D is not None:
        raise ValueError("model: an input of the measurement (D) is not covered with lags")
    n, d = model.m0.shape[0], max_delay
    static = Static(d)
    identity = jnp.eye(d + 1, dtype=model.m0.dtype)
    return LinearGaussian(
        F=_lifted(_shift, static, model.F),
        H=jnp.kron(identity, H),
        Q=_lifted(_pad_square, static, model.Q),
        R=jnp.kron(identity, R),
        m0=jnp.pad(model.m0, (0, n * d)),
        P0=_pad_square(d, model.P0),
        B=None if model.B is None else _lifted(_pad_rows, static, model.B),
    )


def lag_inputs(ys: Any, lag: Any, max_delay: int) -> dict[str, Array]:
    """Measurements with known delays as the arguments ``ys`` and ``mask`` of a filter of :func:`with_lags`.

    Args:
        ys: (T, m) what arrived at each step; where nothing did, anything.
        lag: (T,) or (T, m) int, how many samples ago it was measured; -1 = nothing arrived.
        max_delay: d of the model; what is older counts as nothing.

    Returns:
        ``{"ys": (T, (d+1) m), "mask": (T, (d+1) m)}``.

    Raises:
        ValueError: wrong shapes.
        TypeError: a lag that is not an integer.
    """
    common_dtype({"ys": ys})
    check_count("max_delay", max_delay, 0)
    ys, lag = jnp.asarray(ys), real_array("lag", lag)
    if ys.ndim != 2 or ys.size == 0:
        raise ValueError(f"ys: expected shape (T, m), got {ys.shape}")
    if not jnp.issubdtype(lag.dtype, jnp.integer):
        raise TypeError(f"lag: expected integers, got {lag.dtype}")
    if lag.shape not in (ys.shape[:1], ys.shape):
        raise ValueError(f"lag: expected shape {ys.shape[:1]} or {ys.shape}, got {lag.shape}")
    lag = jnp.broadcast_to(lag.reshape(len(ys), -1), ys.shape)
    mask = lag[:, None, :] == jnp.arange(max_delay + 1, dtype=lag.dtype)[None, :, None]
    stacked = jnp.where(mask, ys[:, None, :], jnp.zeros((), ys.dtype))
    return {"ys": stacked.reshape(len(ys), -1), "mask": mask.reshape(len(ys), -1)}


def _lifted(fn, static, matrix):
    """``fn(d, matrix)``, at each step where the matrix is a function."""
    return Partial(_each_step, Partial(fn), static, matrix) if callable(matrix) else fn(static.value, matrix)


def _each_step(fn, static, matrix, u, dt):
    return fn(static.value, matrix(u, dt))


def _shift(d, F):
    n = F.shape[0]
    top = jnp.pad(F, ((0, 0), (0, n * d)))
    return jnp.concatenate([top, jnp.eye(n * d, n * (d + 1), dtype=F.dtype)])


def _pad_square(d, A):
    return jnp.pad(A, (0, A.shape[0] * d))


def _pad_rows(d, B):
    return jnp.pad(B, [(0, B.shape[0] * d)] + [(0, 0)] * (B.ndim - 1))
