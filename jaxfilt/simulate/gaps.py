"""Masks for lost measurements: True = present."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import check_count, check_key, is_concrete, number, numbers


def gap_mask(
    T: int, *gaps: tuple[int, int], m: int | None = None, components: Sequence[int] | None = None
) -> np.ndarray:
    """The mask of a series with given gaps.

    Args:
        T: number of samples.
        gaps: pairs ``(first, last)`` of lost samples, both included, counted from 0.
        m: number of components; None gives a mask (T,) for all of them.
        components: which of the m components are lost in the gaps; None = all.

    Returns:
        (T,) or, with ``m``, (T, m) bool, False in the gaps.

    Raises:
        ValueError: a gap outside 0..T-1 or with last < first, a component outside 0..m-1, components without m.
    """
    check_count("T", T, 1)
    if m is not None:
        check_count("m", m, 1)
    if components is not None and m is None:
        raise ValueError("components: given without m, the number of components")
    mask = np.ones((T, 1 if m is None else m), bool)
    lost = list(range(mask.shape[1])) if components is None else numbers("components", components).ravel().tolist()
    if any(not isinstance(c, int) for c in lost):
        raise TypeError(f"components: expected integers, got {lost}")
    if any(not 0 <= c < mask.shape[1] for c in lost):
        raise ValueError(f"components: expected values in 0..{mask.shape[1] - 1}, got {lost}")
    for first, last in gaps:
        if not 0 <= first <= last < T:
            raise ValueError(f"gaps: expected 0 <= first <= last < {T}, got ({first}, {last})")
        mask[first : last + 1, lost] = False
    return mask[:, 0] if m is None else mask


def random_loss(key: Array, T: int, probability: Any, *, m: int | None = None) -> Array:
    """A mask (T,), or (T, m) with ``m``, in which each entry is lost independently with ``probability`` (Bernoulli).

    Prefix-stable: sample k takes ``fold_in(key, k)``.

    Raises:
        ValueError: a (concrete) probability outside [0, 1].
    """
    check_key(key)
    check_count("T", T, 1)
    if m is not None:
        check_count("m", m, 1)
    if is_concrete(probability) and not 0 <= number("probability", probability) <= 1:
        raise ValueError(f"probability: expected a value in [0, 1], got {probability}")
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, np.arange(T, dtype=np.uint32))
    shape = () if m is None else (m,)
    return jax.vmap(lambda k: ~jax.random.bernoulli(k, probability, shape))(keys)


def random_gap(key: Array, T: int, *, length: tuple[int, int], first: tuple[int, int]) -> Array:
    """A mask (T,) with one gap whose length and first sample are drawn uniformly.

    Args:
        key: random key.
        T: number of samples.
        length: shortest and longest gap, both included [samples].
        first: earliest and latest first lost sample, both included. The gap ends with the series at the latest.

    Raises:
        ValueError: an empty or negative range, a first sample outside the series.
    """
    check_key(key)
    check_count("T", T, 1)
    for name, ends, least in (("length", length, 1), ("first", first, 0)):
        if not isinstance(ends, tuple | list) or len(ends) != 2:
            raise ValueError(f"{name}: expected (smallest, largest), got {ends!r}")
        for end in ends:
            check_count(name, end, least)
    if not 0 < length[0] <= length[1]:
        raise ValueError(f"length: expected 1 <= shortest <= longest, got {length}")
    if not 0 <= first[0] <= first[1] < T:
        raise ValueError(f"first: expected 0 <= earliest <= latest < {T}, got {first}")
    key_length, key_first = jax.random.split(key)
    size = jax.random.randint(key_length, (), length[0], length[1] + 1, jnp.int32)
    start = jax.random.randint(key_first, (), first[0], first[1] + 1, jnp.int32)
    k = np.arange(T, dtype=np.int32)
    return jnp.asarray((k < start) | (k >= start + size))
