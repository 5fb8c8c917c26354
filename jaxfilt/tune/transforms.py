"""The transformations between constrained parameters and coordinates without constraints; see :mod:`.params`."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt.linalg import chol, sym

REACH = 7.0  # half the width of the box: sigmoid(7) = 0.9991, exp(7) = 1100


def _positive(z, shape):
    return jnp.exp(z).reshape(shape)


def _interval(z, shape, low, high):
    return low + (high - low) * jax.nn.sigmoid(z).reshape(shape)


def _interval_inverse(x, low, high):
    return jnp.log(x - low) - jnp.log(high - x)


def _real(z, shape, low, high):
    return low + (high - low) * ((z.reshape(shape) + REACH) / (2.0 * REACH))


def _real_inverse(x, low, high):
    return 2.0 * REACH * (x - low) / (high - low) - REACH


def _ordered(z, shape, low, high):
    del shape
    gaps = jax.nn.softplus(z)
    return low + (high - low) * (jnp.cumsum(gaps) / (1.0 + jnp.sum(gaps)))


def _ordered_inverse(x, low, high):
    gaps = jnp.diff(x, prepend=low) / (high - x[-1])
    return gaps + jnp.log(-jnp.expm1(-gaps))


def _covariance(z, shape):
    n = shape[0]
    C = jnp.eye(n, dtype=z.dtype).at[np.tril_indices(n, -1)].set(z[n:])
    L = jnp.exp(z[:n])[:, None] * C
    return sym(jnp.matmul(L, L.T, precision="highest"))


def _covariance_inverse(x):
    L = chol(x)
    d = jnp.diagonal(L)
    return jnp.concatenate([jnp.log(d), (L / d[:, None])[np.tril_indices(x.shape[0], -1)]])


# kind -> (z, shape, *args) -> x, and (x, *args) -> z
TRANSFORMS: dict[str, tuple[Callable, Callable]] = {
    "positive": (_positive, jnp.log),
    "interval": (_interval, _interval_inverse),
    "real": (_real, _real_inverse),
    "ordered": (_ordered, _ordered_inverse),
    "covariance": (_covariance, _covariance_inverse),
}
