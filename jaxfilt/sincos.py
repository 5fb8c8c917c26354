"""Sensors that give the sine and cosine of an angle: encoders, resolvers, a field seen by two magnetometers.

The two signals, with ``t' = t + quadrature``::

    a = amplitude (1 + gain/2) (cos t  + h2_a cos 2t  + h3 cos 3t  + h5 cos 5t ) + offset_a
    b = amplitude (1 - gain/2) (sin t' + h2_b cos 2t' - h3 sin 3t' + h5 sin 5t') + offset_b

The signs of h3 and h5 follow from b being a, shifted by a quarter of a cycle. ``t`` is the angle within the sensor's
cycles (the electrical angle); a sensor of N cycles per turn measures ``t / N``.

Here is what needs no recursion: the signals, their inverse, the arc tangent with unwrapping, losses by which the
parameters are found, and when to trust what a filter has found. The model for filters that estimate the parameters
along with the angle is :func:`jaxfilt.models.sine_cosine`; the tracking loop of converters is
:func:`jaxfilt.phase_locked` around :func:`jaxfilt.alpha_beta`; the ellipse of the two signals fits
:func:`jaxfilt.fit_ellipse`.
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import check_count, check_float, is_concrete, mask_nan, number, numbers, real_array
from jaxfilt.models.linear import check_finite, check_positive, check_shape
from jaxfilt.models.sensors import wrap


class Parameters(NamedTuple):
    """What distinguishes a sensor from an ideal one; each () or broadcastable to the angle."""

    offset_a: Any = 0.0  # in units of the signal
    offset_b: Any = 0.0
    amplitude: Any = 1.0
    gain: Any = 0.0  # imbalance
    quadrature: Any = 0.0  # [rad]
    h3: Any = 0.0  # harmonics relative to the fundamental
    h5: Any = 0.0
    h2_a: Any = 0.0
    h2_b: Any = 0.0


class Angle(NamedTuple):
    """Angles of a series of samples."""

    angle: Array  # (T,) unwrapped [rad], held where not usable
    usable: Array  # (T,) bool: both signals present, and not too weak
    radius: Array  # (T,)


def signals(theta: Array, parameters: Parameters) -> Array:
    """The two signals (..., 2) at an angle (...) [rad]."""
    p = parameters
    shifted = theta + p.quadrature
    a = jnp.cos(theta) + p.h2_a * jnp.cos(2 * theta) + p.h3 * jnp.cos(3 * theta) + p.h5 * jnp.cos(5 * theta)
    b = jnp.sin(shifted) + p.h2_b * jnp.cos(2 * shifted) - p.h3 * jnp.sin(3 * shifted) + p.h5 * jnp.sin(5 * shifted)
    a = p.amplitude * (1 + 0.5 * p.gain) * a + p.offset_a
    return jnp.stack([a, p.amplitude * (1 - 0.5 * p.gain) * b + p.offset_b], axis=-1)


def correct(ys: Array, parameters: Parameters) -> tuple[Array, Array]:
    """The angle in [-pi, pi] [rad] and the radius relative to ``amplitude``, each (...), of signals (..., 2).

    The inverse of :func:`signals` for the ellipse (exact) and for h3 and h5 (to first order in them, two fixed-point
    steps); h2 is not corrected. A sample at the centre has angle 0, radius 0 and zero derivatives.
    """
    p = parameters
    x = (ys[..., 0] - p.offset_a) / (p.amplitude * (1 + 0.5 * p.gain))
    y = (ys[..., 1] - p.offset_b) / (p.amplitude * (1 - 0.5 * p.gain))
    y = (y - x * jnp.sin(p.quadrature)) / jnp.cos(p.quadrature)
    first, radius = _polar(x, y)
    theta = first
    for _ in range(2):
        theta = first + (p.h3 - p.h5) * jnp.sin(4 * theta)
    return wrap(theta), radius / (1 + (p.h3 + p.h5) * jnp.cos(4 * theta))


def _polar(x, y):
    square = x * x + y * y
    off = square > 0
    radius = jnp.where(off, jnp.sqrt(jnp.where(off, square, 1.0)), 0.0)
    return jnp.arctan2(jnp.where(off, y, 0.0), jnp.where(off, x, 1.0)), radius


def arctan(
    ys: Any, parameters: Parameters | None = None, *, mask: Any = None, counts: int | None = None, floor: float = 0.2
) -> Angle:
    """The unwrapped angle of each sample by itself: correction, arc tangent, quantization.

    Args:
        ys: (T, 2) signals in order of time.
        parameters: of the correction (:func:`correct`); None = an ideal sensor of amplitude 1.
        mask: (T,) or (T, 2) bool, True = present; an angle needs both signals. None = NaN is missing.
        counts: resolution per cycle, as of a converter; None = not quantized.
        floor: a sample whose radius is below this part of the amplitude is a lost signal. Such samples hold the last
            angle and are not ``usable``.

    Unwrapping assumes steps below half a cycle. With concrete arrays, steps beyond a quarter of a cycle warn (a loop's
    phase detector turns there), and steps that change sign between two such samples, which is what a rate does that
    passes half a cycle per sample, raise. A constant rate beyond that cannot be told from a slower one.

    Raises:
        ValueError: shape, ``counts`` below 1, or a rate that passes half a cycle per sample.
    """
    check_float("ys", ys)
    ys = jnp.asarray(ys)
    if ys.ndim != 2 or ys.shape[1] != 2:
        raise ValueError(f"ys: expected shape (T, 2), got {ys.shape}; batch with jax.vmap")
    if counts is not None:
        check_count("counts", counts, 1)
    check_finite("floor", floor)
    check_shape("floor", floor, ())
    if parameters is not None:
        check_parameters(parameters)
    here = jnp.isfinite(ys) & both_present(ys, mask)[:, None]
    out, steps = _arctan(
        ys, here, Parameters() if parameters is None else parameters, jnp.asarray(floor, ys.dtype), counts
    )
    if is_concrete((steps, out.usable)):
        _check_rate(np.asarray(steps), np.asarray(out.usable))
    return out


def both_present(ys: Array, mask: Any) -> Array:
    """(T,) bool: where both signals (T, 2) are present; the mask, (T,) or (T, 2) bool or None, is checked."""
    T = ys.shape[0]
    if mask is None:
        return jnp.ones((T,), bool)
    mask = mask if hasattr(mask, "dtype") else numbers("mask", mask)
    if mask.dtype != np.dtype(bool):
        raise TypeError(f"mask: expected bool, got {mask.dtype}")
    if mask.shape not in {(T,), (T, 2)}:
        raise ValueError(f"mask: expected shape ({T},) or ({T}, 2), got {mask.shape}")
    return jnp.asarray(mask).reshape(T, -1).all(axis=1)


@partial(jax.jit, static_argnames=("counts",))
def _arctan(ys, here, parameters, floor, counts):
    wrapped, radius = correct(jnp.where(here, ys, 0.0), parameters)
    usable = here.all(axis=1) & (radius >= floor)
    last = jax.lax.cummax(jnp.where(usable, jnp.arange(ys.shape[0]), -1))
    held = jnp.where(last >= 0, wrapped[jnp.maximum(last, 0)], 0.0)
    steps = wrap(jnp.diff(held))
    angle = jnp.concatenate([held[:1], held[0] + jnp.cumsum(steps)])
    if counts is not None:
        unit = 2 * np.pi / counts
        angle = unit * jnp.round(angle / unit)
    return Angle(angle, usable, radius), steps


def _check_rate(steps, usable):
    fast = (np.abs(steps) > np.pi / 2) & usable[1:] & usable[:-1]
    turned = fast[1:] & fast[:-1] & (steps[1:] * steps[:-1] < 0)
    if turned.any():
        k = int(np.argmax(turned)) + 2
        raise ValueError(
            f"ys: the angle moves by half a cycle or more per sample near ys[{k}]; the cycles cannot be counted"
        )
    if fast.any():
        k = int(np.argmax(fast)) + 1
        warnings.warn(
            f"ys: the angle moves by more than a quarter of a cycle per sample in {int(fast.sum())} steps, "
            f"first to ys[{k}]",
            stacklevel=3,
        )


def mask_clipped(ys: Any, low: float, high: float) -> tuple[Array, Array]:
    """``(ys, mask)`` with samples (T, 2) at or beyond a converter's rails masked, and NaN too.

    Raises:
        ValueError: unless ``low < high``.
    """
    check_float("ys", ys)
    low, high = number("low", low), number("high", high)
    if not low < high:
        raise ValueError(f"low: expected low < high, got {low} and {high}")
    ys, mask = mask_nan(ys)
    return ys, mask & (ys > low) & (ys < high)


def reacquire(y: Array, theta: Array, parameters: Parameters | None = None) -> Array:
    """The angle of a sample y (..., 2) in the cycle nearest to ``theta`` (...) [rad]: where to start a lost filter."""
    angle, _ = correct(y, Parameters() if parameters is None else parameters)
    return theta + wrap(angle - theta)


def mechanical(theta: Any, cycles: int) -> Any:
    """The angle of the shaft, ``theta / cycles``, of a sensor with that many cycles per turn.

    Raises:
        ValueError: ``cycles`` is no positive integer.
    """
    real_array("theta", theta)
    if isinstance(cycles, bool) or not isinstance(cycles, int) or cycles < 1:
        raise ValueError(f"cycles: expected a positive integer, got {cycles!r}")
    return theta / cycles


def calibrated(mean: Array, cov: Array, prior: Any, *, share: float = 0.1) -> Array:
    """(T,) bool: whether a self-calibrating filter's parameters may be trusted yet.

    At rest two signals cannot fix seven unknowns: the parameters then move along the prior without being right. So the
    estimated angle must have covered a whole cycle, and the standard deviations of offsets, gain and quadrature must be
    below ``share`` of the prior's.

    Args:
        mean: (T, 8) of a filter over :func:`jaxfilt.models.sine_cosine` with 8 states.
        cov: (T, 8, 8).
        prior: (8, 8) the model's P0.
        share: as above.
    """
    for name, x, shape in (("mean", mean, (None, 8)), ("cov", cov, (None, 8, 8)), ("prior", prior, (8, 8))):
        check_float(name, x)
        check_shape(name, x, shape)
    check_positive("share", share, scalar=True)
    check_finite("prior", prior)
    covered = jax.lax.cummax(mean[:, 0]) - jax.lax.cummin(mean[:, 0]) >= 2 * np.pi
    index = np.array([2, 3, 5, 6])
    before = jnp.diagonal(jnp.asarray(prior, cov.dtype))[index]
    now = jnp.diagonal(cov, axis1=1, axis2=2)[:, index]
    return (
        covered
        & jnp.isfinite(mean).all(axis=1)
        & (now < jnp.asarray(share, cov.dtype) ** 2 * before[None, :]).all(axis=1)
    )


# ------------------------------------------------------------------------------------------ losses, for any optimizer


def supervised_loss(parameters: Parameters, ys: Array, reference: Array) -> Array:
    """Variance of the angle's error [rad^2] against a reference (T,) [rad]; a constant difference does not count."""
    angle, _ = correct(ys, parameters)
    difference = angle - reference
    centre = jnp.arctan2(jnp.sin(difference).mean(), jnp.cos(difference).mean())
    return jnp.var(wrap(difference - centre))


def radius_loss(parameters: Parameters, ys: Array, *, block: int = 200) -> Array:
    """Variance of the radius over its mean in blocks of samples, which takes out a slowly changing amplitude.

    It sees ``h3 + h5``, whereas the angle needs ``h3 - h5``: find the ellipse with it, not both harmonics.

    Raises:
        ValueError: fewer samples than one block.
    """
    _, radius = correct(ys, parameters)
    count = radius.shape[0] // block
    if count < 1:
        raise ValueError(f"block: expected at most the {radius.shape[0]} samples, got {block}")
    blocks = radius[: count * block].reshape(count, block)
    return jnp.var(blocks / blocks.mean(axis=1, keepdims=True))


def smoothness_loss(
    parameters: Parameters, ys: Array, *, stride: int = 10, radius: float = 0.1, block: int = 200
) -> Array:
    """Mean square second difference of the angle [rad^2] over ``stride`` samples, plus ``radius`` times that loss.

    For motion that is smoother than the errors, which repeat within a cycle. Needs no reference.

    Raises:
        ValueError: fewer samples than ``2 stride + 1`` or one block.
    """
    angle, _ = correct(ys, parameters)
    if angle.shape[0] <= 2 * stride:
        raise ValueError(f"stride: expected less than half of the {angle.shape[0]} samples, got {stride}")
    first = wrap(angle[stride:] - angle[:-stride])
    second = wrap(first[stride:] - first[:-stride])
    return jnp.mean(second * second) + radius * radius_loss(parameters, ys, block=block)


def check_parameters(parameters: Parameters) -> None:
    """Raises a ValueError if a concrete amplitude is not positive, a TypeError for what are no parameters."""
    if not isinstance(parameters, Parameters):
        raise TypeError(f"parameters: expected jf.sincos.Parameters, got {type(parameters).__name__}")
    check_positive("amplitude", parameters.amplitude)
