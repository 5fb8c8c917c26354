"""A scan over a long series whose gradient needs little memory.

The reverse pass of ``lax.scan`` keeps what every step computed. Here it keeps the carry at the start of every segment,
and computes a segment again when it gets there: memory for T / segment carries and for the steps of one segment, least
at a segment of about sqrt(T), for one more forward pass.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

PyTree = Any


def scan(
    body: Callable[[PyTree, PyTree], tuple[PyTree, PyTree]], init: PyTree, xs: PyTree, segment: int | None = None
) -> tuple[PyTree, PyTree]:
    """``lax.scan(body, init, xs)``, checkpointed; the same values and derivatives up to rounding.

    Args:
        body: ``(carry, x) -> (carry, out)``.
        init: the carry before the first step.
        xs: pytree with leading T.
        segment: steps in a segment; None = about sqrt(T).

    Returns:
        The carry after the last step, and the stacked outputs.

    Raises:
        ValueError: a segment that is no int >= 1.
    """
    T = jax.tree.leaves(xs)[0].shape[0]
    segment = check_segment(segment, T)
    number = T // segment

    def run(carry, x):
        return jax.lax.scan(body, carry, x)

    whole = jax.tree.map(lambda leaf: leaf[: number * segment].reshape(number, segment, *leaf.shape[1:]), xs)
    # A scan does not let the compiler merge the second computation of a segment with the first.
    carry, out = jax.lax.scan(jax.checkpoint(run, prevent_cse=False), init, whole)
    out = jax.tree.map(lambda leaf: leaf.reshape(number * segment, *leaf.shape[2:]), out)
    if number * segment == T:
        return carry, out
    carry, rest = run(carry, jax.tree.map(lambda leaf: leaf[number * segment :], xs))
    return carry, jax.tree.map(lambda a, b: jax.numpy.concatenate([a, b]), out, rest)


def check_segment(segment: Any, T: int) -> int:
    """The steps of a segment, at most T; raises a ValueError if it is no int >= 1."""
    if segment is None:
        return max(1, round(T**0.5))
    if isinstance(segment, bool) or not isinstance(segment, int | np.integer) or segment < 1:
        raise ValueError(f"segment: expected an int >= 1, got {segment!r}")
    return min(int(segment), T)
