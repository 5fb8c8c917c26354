"""Every public filter and wrapper with one small example: the generic properties run over all of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf

T = 12


class Example(NamedTuple):
    """How to build a small filter of this kind, and the series it is run on."""

    factory: Callable  # the public factory
    make: Callable[[Any], jf.Filter]  # params (a pytree of float arrays) -> filter
    params: dict[str, Any]  # float64 values; cast to the dtype under test
    m: int = 2
    options: dict[str, Any] = {}  # further arguments of jf.filter  # noqa: RUF012
    exempt: dict[str, str] = {}  # property -> reason  # noqa: RUF012


def _model(p):
    return jf.models.linear_gaussian(**p)


def _kalman(p):
    return jf.kalman(_model(p))


def _sqrt_kalman(p):
    return jf.sqrt_kalman(_model(p))


_LINEAR = {
    "F": np.array([[0.9, 0.3, 0.1], [-0.2, 0.8, 0.4], [0.0, -0.3, 0.7]]),
    "H": np.array([[1.0, 0.2, 0.0], [0.3, -0.5, 1.0]]),
    "Q": np.array([[0.5, 0.1, 0.0], [0.1, 0.3, -0.05], [0.0, -0.05, 0.2]]),
    "R": np.array([[1.0, 0.3], [0.3, 2.0]]),
    "m0": np.array([0.5, -1.0, 0.2]),
    "P0": np.array([[2.0, 0.3, 0.1], [0.3, 1.5, -0.2], [0.1, -0.2, 1.0]]),
}

REGISTRY: dict[str, Example] = {
    "kalman": Example(jf.kalman, _kalman, _LINEAR),
    "sqrt_kalman": Example(jf.sqrt_kalman, _sqrt_kalman, _LINEAR),
}


def series(example: Example, dtype, runs: int | None = None):
    """Measurements (T, m), or (runs, T, m), of moderate size."""
    shape = (T, example.m) if runs is None else (runs, T, example.m)
    return jax.random.normal(jax.random.key(7), shape, dtype) + jnp.linspace(0, 2, T, dtype=dtype)[:, None].reshape(
        (1,) * (len(shape) - 2) + (T, 1)
    )


def params(example: Example, dtype):
    """The example's parameters in the dtype under test."""
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), example.params)
