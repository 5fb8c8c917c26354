"""Inertial recordings as inputs of the attitude filters, checked where they can still be refused."""

from __future__ import annotations

import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import check_flag, is_concrete, real_array
from jaxfilt.models.linear import check_positive, common_dtype


def imu_inputs(
    gyr: Any,
    acc: Any,
    *,
    mask: Any = None,
    at_rest: bool = True,
    gyr_hold: bool = False,
    gravity: float = 9.81,
) -> dict[str, Array]:
    """A recording as the arguments ``ys``, ``u`` (and ``mask``) of :func:`jaxfilt.filter` for an attitude filter.

    Under a transformation nothing can be refused: the filters then hold the last finite gyro reading and flag it.

    Args:
        gyr: (..., T, 3) [rad/s], the mean rate since the last sample, as sensors store it.
        acc: (..., T, 3) [m/s^2] specific force.
        mask: (..., T, 3) or (..., T) bool, True = the accelerometer's sample is present.
        at_rest: the filter takes its start from the first sample; False where it was given ``z0``.
        gyr_hold: repeats the last reading where the gyro's is not finite.
        gravity: [m/s^2].

    Returns:
        ``{"ys": acc, "u": gyr}``, and ``"mask"`` where one was given.

    Raises:
        ValueError: shapes that differ or do not end in 3; a gyro reading that is not finite (without ``gyr_hold``, or
            the first); a first sample that is missing or not within 0.5 to 1.5 g (with ``at_rest``).

    Warns:
        UserWarning: an accelerometer that seems to give multiples of g, a gyro that seems to give degrees per second.
    """
    common_dtype({"gyr": gyr, "acc": acc})
    for name, x in (("gyr", gyr), ("acc", acc)):
        if np.ndim(x) < 2 or np.shape(x)[-1] != 3:
            raise ValueError(f"{name}: expected shape (..., T, 3), got {np.shape(x)}")
    if np.shape(gyr) != np.shape(acc):
        raise ValueError(f"gyr: expected the shape of acc {np.shape(acc)}, got {np.shape(gyr)}")
    if mask is not None and np.shape(mask) not in (np.shape(acc), np.shape(acc)[:-1]):
        raise ValueError(f"mask: expected shape {np.shape(acc)} or {np.shape(acc)[:-1]}, got {np.shape(mask)}")
    check_positive("gravity", gravity)
    check_flag("at_rest", at_rest)
    check_flag("gyr_hold", gyr_hold)
    if mask is not None and real_array("mask", mask).dtype != np.dtype(bool):
        raise TypeError(f"mask: expected bool, got {np.asarray(mask).dtype}")
    if is_concrete((gyr, acc, mask)):
        gyr = _checked_gyro(np.asarray(gyr), gyr_hold)
        _check_accelerometer(np.asarray(acc), None if mask is None else np.asarray(mask), at_rest, gravity)
    given = {"ys": jnp.asarray(acc), "u": jnp.asarray(gyr)}
    return given if mask is None else {**given, "mask": jnp.asarray(mask)}


def _checked_gyro(gyr, gyr_hold):
    finite = np.isfinite(gyr)
    if not finite.all():
        where = [int(i) for i in np.argwhere(~finite)[0]]
        if not gyr_hold:
            raise ValueError(f"gyr: gyr{where} is not finite; gyr_hold=True repeats the last reading")
        if not finite[..., 0, :].all():
            raise ValueError("gyr: the first reading is not finite: there is none to hold")
        last = np.where(finite, np.arange(gyr.shape[-2])[:, None], 0)
        gyr = np.take_along_axis(gyr, np.maximum.accumulate(last, axis=-2), axis=-2)
    largest = np.abs(gyr).max()
    if largest > 50:
        warnings.warn(f"gyr: up to {largest:.3g}; expected rad/s, is it in deg/s?", stacklevel=3)
    return gyr


def _check_accelerometer(acc, mask, at_rest, gravity):
    length = np.linalg.norm(acc, axis=-1)
    shown = np.isfinite(length)
    if mask is not None:
        shown &= mask if mask.ndim == length.ndim else mask.all(axis=-1)
    if shown.any() and 0.8 <= np.median(length[shown]) <= 1.2:
        middle = np.median(length[shown])
        warnings.warn(f"acc: its length is {middle:.3g} in the median; expected m/s^2, is it in g?", stacklevel=3)
    first = np.where(shown, length, np.nan)[..., 0] / gravity
    if at_rest and not ((first >= 0.5) & (first <= 1.5)).all():
        raise ValueError(
            f"acc: the first sample has a length of {np.ravel(first)[0]:.3g} g, so its direction is no start; begin at "
            "rest, or give the filter z0 and at_rest=False"
        )
