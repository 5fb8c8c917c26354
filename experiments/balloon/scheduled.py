"""The stationary fuzzy mixed filter without a Riccati equation in every step.

Q and R divided by the same alpha are, in the stationary filter, exactly theta divided by the root of alpha: the gain
depends on ``theta^2 / alpha`` alone. It is tabulated once and interpolated.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxfilt as jf
from jaxfilt import fuzzy
from jaxfilt.core import Filter, Info, Prediction, Status, bind, flag

NODES = 33
SMALLEST = 100 / 9  # alpha that the printed fuzzy system gives at the least


class _Params(NamedTuple):
    F: Array  # (axes, n, n)
    H: Array  # (axes, n)
    m0: Array  # (axes, n)
    gains: Array  # (nodes, axes, n)
    system: fuzzy.Mamdani
    unit: Array  # ()
    options: jf.Static  # input


class _State(NamedTuple):
    mean: Array  # (axes, n)
    last: Array  # (axes,) the last measurement


def tabulated(
    models: Sequence[jf.models.LinearGaussian], theta: Any, system: fuzzy.Mamdani, *, unit: float, input: str | None
) -> Filter:
    """``fuzzy_scaled(mixed_hinf(model, theta, stationary=True), system)`` for independent axes, by interpolation.

    Linear in ``theta^2 / alpha`` between 33 nodes. Every sample must be there; no covariance is reported.
    ``extra["alpha"]`` () is the fuzzy system's output. Without an input it is the mixed filter alone, whose gain is
    constant, and there is no alpha.

    Args:
        models: one per axis, with one measurement each.
        theta: as in :func:`jaxfilt.mixed_hinf`.
        system: whose output is nowhere below 100/9.
        unit: as in :func:`jaxfilt.fuzzy_scaled`.
        input: likewise, or None.
    """
    F, H, m0 = (jnp.stack([getattr(model, name) for model in models]) for name in ("F", "H", "m0"))
    theta2 = jnp.asarray(theta) ** 2
    nodes = theta2[None] if input is None else theta2 / SMALLEST * np.linspace(0.0, 1.0, NODES)
    gains = jnp.stack([jax.vmap(gain, (None, 0))(model, nodes) for model in models], axis=1)
    params = _Params(
        F, H[:, 0], m0, gains, system, jnp.asarray(unit), jf.Static(input)
    )  # fmt: skip
    return bind(params, _init, _predict, _update)


def gain(model: jf.models.LinearGaussian, theta2: Array) -> Array:
    """The stationary gain of the correction (n,), for one measurement; F times it is the predictor's."""
    P = jf.riccati(model, jnp.sqrt(theta2))
    n = P.shape[0]
    inflated = jnp.linalg.solve(jnp.eye(n, dtype=P.dtype) - theta2 * P, P)
    H: Any = model.H
    return (inflated @ H[0]) / (H[0] @ inflated @ H[0] + model.R[0, 0])  # pyright: ignore[reportIndexIssue]


def _init(p, inp):
    return _State(p.m0, inp.y)


def _predict(p, state, inp):
    del inp
    mean = jnp.einsum("aij,aj->ai", p.F, state.mean)
    return state._replace(mean=mean), Prediction(mean.ravel())


def _update(p, state, inp):
    innovation = inp.y - jnp.sum(p.H * state.mean, axis=1)
    gains, extra = p.gains[0], {}
    if p.options.value is not None:
        inputs = innovation if p.options.value == "innovation" else inp.y - state.last
        extra["alpha"] = fuzzy.infer(p.system, p.unit * jnp.abs(inputs)).value
        place = SMALLEST / extra["alpha"] * (NODES - 1)
        low = jnp.clip(jnp.floor(place).astype(np.int32), 0, NODES - 2)
        share = place - low.astype(place.dtype)
        gains = (1 - share) * p.gains[low] + share * p.gains[low + 1]
    mean = state.mean + gains * innovation[:, None]
    status = flag(~jnp.isfinite(inp.y).all(), Status.NONFINITE)
    info = Info(mean.ravel(), None, innovation, None, None, None, status, extra=extra)
    return _State(mean, inp.y), info
