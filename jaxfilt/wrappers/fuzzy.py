"""Noise covariances scaled by fuzzy rules on the size of the innovations."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt import fuzzy
from jaxfilt.core import Filter, Static, Wrapped, multiply, number, present, wrap
from jaxfilt.models.linear import check_finite, check_positive, check_shape
from jaxfilt.wrappers.common import covariances
from jaxfilt.wrappers.noise import Q_BOUNDS, R_BOUNDS, check_bounds, check_forgetting, clip, usable

_LEVELS = (11.08, 33.33, 66.67, 88.92)  # what the printed law divides by, at its four levels


class FuzzyNoise(NamedTuple):
    """All parameters of :func:`fuzzy_noise`, for m channels and L sets. Start from :func:`fuzzy_noise_parameters`."""

    forgetting: Any  # () of the mean of squared innovations, in [0, 1)
    gaps: Any  # (m, L - 1) > 0, from 0 to the first crossing point of two sets, and from each to the next
    widths: Any  # (m, L - 1) > 0, of the crossings
    log_alpha_r: Any  # (L,) R is divided by exp of it, at the L levels
    log_alpha_q: Any  # (L,) Q likewise


class _Scaled(NamedTuple):
    inner: Filter
    system: fuzzy.Mamdani
    unit: Any  # () or (m,)
    reference: Any  # ()
    exponents: Any  # (r, q)
    floor: Any  # ()
    r_bounds: Any  # (2,)
    q_bounds: Any  # (2,)
    options: Static  # (input, scale)


class _Smooth(NamedTuple):
    inner: Filter
    parameters: FuzzyNoise
    unit: Any  # () or (m,)
    r_bounds: Any  # (2,)
    q_bounds: Any  # (2,)
    options: Static  # (rules or None, scale)


class _Scales(NamedTuple):
    """What one step has found, and the next prediction uses."""

    r: Array | None  # (); None where R is not adapted
    q: Array | None


class _ScaledMemory(NamedTuple):
    scales: _Scales
    alpha: Array  # ()
    inputs: Array  # (m,) the last known inputs, in the universe's unit
    last: Array  # (m,) the last valid measurements
    seen: Array  # (m,) bool, whether there was one


class _SmoothMemory(NamedTuple):
    scales: _Scales
    squares: Array  # (m,) fading mean of squared innovations


def fuzzy_scaled(
    filt: Filter,
    system: fuzzy.Mamdani,
    *,
    input: str = "innovation",
    unit: Any = 1.0,
    scale: str = "both",
    reference: Any = 1.0,
    r_exponent: Any = -1.0,
    q_exponent: Any = -1.0,
    floor: Any = 1e-6,
    r_bounds: tuple[Any, Any] = R_BOUNDS,
    q_bounds: tuple[Any, Any] = Q_BOUNDS,
) -> Filter:
    """Scales R and Q by a Mamdani system's output alpha of the present measurement: ``R / alpha`` and ``Q / alpha``.

    In step k the input d is formed of y_k, ``alpha = infer(system, d)``, and with ``a = max(alpha / reference, floor)``
    the update uses ``R a^r_exponent`` and the next prediction ``Q a^q_exponent`` (a stationary filter uses both in the
    update). The matrices scaled are always the model's own: nothing accumulates. Before the first sample alpha is that
    of the input 0. Channels that are missing keep their last input; alpha is held over a missed sample, one that a gate
    refused or that is not finite, and where no rule fires.

    With the printed exponents (both -1) the ratio of Q to R stays as it is. Alpha that does not change then cancels
    in a Kalman filter, and in a stationary mixed filter is the same as ``theta / sqrt(alpha)``. Alpha that does change
    makes the filter trust a measurement the more the larger its innovation: right for a maneuver, wrong for a burst of
    noise, and a loss where the model is right. It harms in most cases that were measured;
    :func:`fuzzy_noise`, tuned, is the useful version.

    Info: ``extra["alpha"]`` () the system's output, ``extra["r_scale"]`` and ``extra["q_scale"]`` () (those adapted),
    ``extra["floored"]`` () bool, ``extra["lowest"]`` () bool: all inputs are fully in their lowest sets, or there is no
    sample. If that holds in every step of a run, nothing adapts, and ``unit`` is probably wrong.

    Status: BOUND where a scale ran into its bounds. The floor is part of the law: it sets ``extra["floored"]`` only.

    Args:
        filt: the filter; must honor the scales.
        system: from :func:`jaxfilt.fuzzy.mamdani`, with one input per channel.
        input: ``"innovation"``, or ``"difference"``: the step from the channel's last valid measurement (0 at the
            first), which includes the target's own motion. Differences of angles are not wrapped.
        unit: factor from the measurement's unit to the universe's, () or (m,): 1000 for km and m.
        scale: what is adapted: ``"both"``, ``"r"`` or ``"q"``.
        reference: the alpha that means the model's own covariances, > 0.
        r_exponent: of R; +1 makes R grow with the input. Traceable, as ``unit`` and what follows.
        q_exponent: of Q.
        floor: smallest a, > 0. With exponents -1 and ``(theta / (0.99 theta_max))^2`` a mixed filter stays feasible.
        r_bounds: smallest and largest factor on R.
        q_bounds: smallest and largest factor on Q.

    Raises:
        ValueError: an unknown input or scale, a unit, reference or floor <= 0, bounds not in order; at trace time, a
            system with another number of inputs than there are channels.

    Source: Kazemi, Masoumnezhad and Askari 2021, eqs. (18) to (20); Yadaiah, Srikanth and Rao 2011.
    """
    if input not in ("innovation", "difference"):
        raise ValueError(f'input: expected "innovation" or "difference", got {input!r}')
    _check_which(scale)
    if not isinstance(system, fuzzy.Mamdani):
        raise TypeError(f"system: expected a jf.fuzzy.Mamdani, got {type(system).__name__}")
    for name, x in (("unit", unit), ("reference", reference), ("floor", floor)):
        check_positive(name, x, scalar=name != "unit")
    _check_unit(unit)
    for name, x in (("r_exponent", r_exponent), ("q_exponent", q_exponent)):
        check_finite(name, x)
        check_shape(name, x, ())
    return wrap(
        _Scaled(
            filt, system, unit, reference, (r_exponent, q_exponent), floor,
            check_bounds("r_bounds", r_bounds), check_bounds("q_bounds", q_bounds), Static((input, scale)),
        ),
        init=_scaled_init, predict=_predict, update=_scaled_update,
    )  # fmt: skip


def fuzzy_noise_parameters(
    universe: Any, *, alpha: Any = _LEVELS, forgetting: Any = 0.8, dtype: Any = None
) -> FuzzyNoise:
    """Parameters of :func:`fuzzy_noise` that come near the printed law: the same alpha for R and Q.

    The sets cross where the trapezoids of :func:`jaxfilt.fuzzy.partition` do, with a quarter of a segment for width.

    Args:
        universe: (m,) upper end of each channel's input, > 0.
        alpha: (L,) what R and Q are divided by at the L levels, > 0.
        forgetting: in [0, 1); 0 takes the present innovation alone.
        dtype: of the arrays; None = JAX's default.

    Raises:
        ValueError: universe or alpha <= 0, fewer than 2 levels, forgetting outside [0, 1).
    """
    check_positive("universe", universe)
    check_positive("alpha", alpha)
    if np.ndim(alpha) != 1 or np.size(alpha) < 2:
        raise ValueError(f"alpha: expected shape (L,) with L >= 2, got {np.shape(alpha)}")
    check_shape("forgetting", forgetting, ())
    if number("forgetting", forgetting) != 0:
        check_forgetting(forgetting)
    L = np.size(alpha)
    segment = np.asarray(universe, np.float64).reshape(-1, 1) / (2 * L - 1)
    gaps = segment * np.where(np.arange(L - 1) == 0, 1.5, 2.0)
    widths = np.broadcast_to(segment / 4, gaps.shape)
    log_alpha = np.log(np.asarray(alpha, np.float64))
    try:
        dtype = np.dtype(jnp.result_type(float) if dtype is None else dtype)
    except TypeError:
        raise TypeError(f"dtype: expected a float dtype, got {dtype!r}") from None
    if not jnp.issubdtype(dtype, jnp.floating):
        raise TypeError(f"dtype: expected a float dtype, got {dtype}")
    return FuzzyNoise(*(jnp.asarray(x, dtype) for x in (forgetting, gaps, widths, log_alpha, log_alpha)))


def fuzzy_noise(
    filt: Filter,
    parameters: FuzzyNoise,
    *,
    unit: Any = 1.0,
    scale: str = "both",
    rules: Any = None,
    r_bounds: tuple[Any, Any] = R_BOUNDS,
    q_bounds: tuple[Any, Any] = Q_BOUNDS,
) -> Filter:
    """Scales R and Q by two smooth fuzzy functions (Takagi-Sugeno) of the recent innovations, fit for tuning.

    Per channel ``s <- forgetting s + (1 - forgetting) nu^2``, from ``s = 1.6 R_ii``, and ``d = unit sqrt(s + 1e-8 R)``.
    Memberships of d by :func:`jaxfilt.fuzzy.stick_breaking` around the crossing points ``cumsum(gaps)``, weights w of
    the levels by products over the rules, then ``R exp(-w . log_alpha_r)`` in this update and
    ``Q exp(-w . log_alpha_q)`` from the next prediction on (a stationary filter uses both in the update).

    Everything is differentiable in ``parameters``, which go into a space of :mod:`jaxfilt.tune` as they are::

        p = jf.fuzzy_noise_parameters([40.0, 25.0, 23.0])
        space = jf.FuzzyNoise(
            jf.tune.unit(p.forgetting), jf.tune.positive(p.gaps), jf.tune.positive(p.widths),
            jf.tune.real(p.log_alpha_r, -5.0, 5.0), jf.tune.real(p.log_alpha_q, -5.0, 5.0),
        )

    Untuned it follows the printed law and harms (see :func:`fuzzy_scaled`); with ``alpha=np.ones(4)`` it is the filter
    inside, which is the better start where that one is sound. Tuned on data with bursts of measurement noise it makes R
    grow with the innovations and helps; the innovation likelihood is a loss that needs no truth. Where the noise never
    changes it can only learn constant factors.

    Info: ``extra["r_scale"]`` and ``extra["q_scale"]`` () (those adapted).

    Status: BOUND where a scale ran into its bounds; no gradient flows through it there.

    Args:
        filt: reports innovation_cov and noise_cov, and honors the scales.
        parameters: :class:`FuzzyNoise`.
        unit: factor from the measurement's unit to the universe's, () or (m,).
        scale: what is adapted: ``"both"``, ``"r"`` or ``"q"``.
        rules: integers (L,) * m; None = the lowest of the channels' sets, which needs no table. Static.
        r_bounds: smallest and largest factor on R.
        q_bounds: smallest and largest factor on Q.

    Raises:
        ValueError: (concrete values) forgetting outside [0, 1), gaps or widths <= 0, unit <= 0, an unknown scale, wrong
            shapes, a rule level out of range, bounds not in order; at trace time, another number of channels, a filter
            without innovation_cov or noise_cov.

    Source: after Kazemi, Masoumnezhad and Askari 2021; Takagi and Sugeno 1985.
    """
    _check_which(scale)
    check_positive("unit", unit)
    _check_unit(unit)
    if not isinstance(parameters, FuzzyNoise):
        raise TypeError(f"parameters: expected a FuzzyNoise, got {type(parameters).__name__}")
    if np.ndim(parameters.gaps) != 2:
        raise ValueError(f"gaps: expected shape (m, L - 1), got {np.shape(parameters.gaps)}")
    m, crossings = np.shape(parameters.gaps)
    L = crossings + 1
    shapes = {"widths": (m, crossings), "log_alpha_r": (L,), "log_alpha_q": (L,), "forgetting": ()}
    for name, shape in shapes.items():
        if np.shape(getattr(parameters, name)) != shape:
            raise ValueError(f"{name}: expected shape {shape}, got {np.shape(getattr(parameters, name))}")
    for name in ("gaps", "widths"):
        check_positive(name, getattr(parameters, name))
    for name in ("log_alpha_r", "log_alpha_q"):
        check_finite(name, getattr(parameters, name))
    check_positive("forgetting", parameters.forgetting, zero=True)
    check_positive("1 - forgetting", 1 - parameters.forgetting)
    table = None if rules is None else fuzzy.freeze_rules(fuzzy.check_rules(rules, L, m, L))
    return wrap(
        _Smooth(
            filt, parameters, unit, check_bounds("r_bounds", r_bounds), check_bounds("q_bounds", q_bounds),
            Static((table, scale)),
        ),
        init=_smooth_init, predict=_predict, update=_smooth_update,
    )  # fmt: skip


def _check_unit(unit):
    if jnp.ndim(unit) > 1 or jnp.size(unit) == 0:
        raise ValueError(f"unit: expected shape () or (m,), got {jnp.shape(unit)}")


def _check_which(scale):
    if scale not in ("both", "r", "q"):
        raise ValueError(f'scale: expected "both", "r" or "q", got {scale!r}')


def _scales(p, r, q):
    """Those of the two that are adapted, within their bounds, and the status."""
    which = p.options.value[1]
    status, scales = jnp.int32(0), []
    for name, x, bounds in (("r", r, p.r_bounds), ("q", q, p.q_bounds)):
        if which not in (name, "both"):
            scales.append(None)
            continue
        x, clipped = clip(x, bounds)
        scales.append(x)
        status = status | clipped
    return _Scales(*scales), status


def _apply(inp, scales):
    """Q is scaled at the update too: a stationary filter solves for its covariance there."""
    if scales.r is not None:
        inp = inp._replace(r_scale=multiply(inp.r_scale, scales.r))
    if scales.q is not None:
        inp = inp._replace(q_scale=multiply(inp.q_scale, scales.q))
    return inp


def _predict(p, s, inp):
    inner, prediction = p.inner.predict(s.inner, _apply(inp, s.memory.scales))
    return s._replace(inner=inner), prediction


def _finish(inner, info, memory, status, **extra):
    named = {"r_scale": memory.scales.r, "q_scale": memory.scales.q, **extra}
    known = {name: x for name, x in named.items() if x is not None}
    return Wrapped(inner, memory), info._replace(status=info.status | status, extra={**info.extra, **known})


def _hold(condition, new, old):
    """A memory leaf by leaf: new where the condition holds, () or (m,) as the leaf."""
    return None if new is None else jnp.where(condition, new, old)


def _divisor(p, alpha):
    a = alpha / jnp.asarray(p.reference, alpha.dtype)
    floor = jnp.asarray(p.floor, alpha.dtype)
    return jnp.maximum(a, floor), a < floor


def _powers(p, a):
    r, q = (jnp.asarray(x, a.dtype) for x in p.exponents)
    return _scales(p, a**r, a**q)


def _scaled_init(p, inp):
    inner = p.inner.init(inp)
    if np.shape(p.system.universe) != inp.y.shape:
        raise ValueError(
            f"system: expected one input per channel, {inp.y.shape[0]}, got {np.shape(p.system.universe)[0]}"
        )
    zeros = jnp.zeros_like(inp.y)
    found = fuzzy.infer(p.system, zeros)
    alpha = jnp.where(found.fired, found.value, jnp.asarray(p.reference, inp.y.dtype))
    scales, _ = _powers(p, _divisor(p, alpha)[0])
    memory = _ScaledMemory(scales, alpha, zeros, zeros, jnp.zeros(inp.y.shape, bool))
    return Wrapped(inner, memory)


def _scaled_update(p, s, inp):
    memory: _ScaledMemory = s.memory
    here = present(inp) & jnp.isfinite(inp.y)
    if p.options.value[0] == "innovation":
        size = p.inner.update(s.inner, inp)[1].innovation  # a dry run: only what the innovation needs is computed
    else:
        size = jnp.where(here & memory.seen, inp.y - memory.last, jnp.zeros_like(inp.y))
    unit = jnp.asarray(p.unit, inp.y.dtype)
    inputs = jnp.where(here, unit * jnp.abs(size), memory.inputs)
    found = fuzzy.infer(p.system, inputs)
    alpha = jnp.where(found.fired, found.value, memory.alpha)
    a, floored = _divisor(p, alpha)
    scales, status = _powers(p, a)
    inner, info = p.inner.update(s.inner, _apply(inp, scales))
    # A filter inside may have refused the sample: its alpha then was of no effect, and is forgotten.
    used = usable(inp, info)
    taught = used.any()
    new = _ScaledMemory(
        _Scales(*(_hold(taught, x, old) for x, old in zip(scales, memory.scales, strict=True))),
        jnp.where(taught, alpha, memory.alpha),
        jnp.where(used, inputs, memory.inputs),
        jnp.where(used, inp.y, memory.last),
        memory.seen | used,
    )
    status = jnp.where(taught, status, jnp.int32(0))
    return _finish(
        inner, info, new, status, alpha=new.alpha, floored=floored & taught, lowest=found.lowest | ~taught
    )  # fmt: skip


def _heads(p, squares, variance):
    """The scales that the mean squares (m,) of innovations call for."""
    dtype = squares.dtype
    parameters = FuzzyNoise(*(jnp.asarray(x, dtype) for x in p.parameters))
    square = squares + 1e-8 * variance
    positive = square > 0
    root = jnp.where(positive, jnp.sqrt(jnp.where(positive, square, jnp.ones_like(square))), jnp.zeros_like(square))
    centers = jnp.cumsum(parameters.gaps, axis=1)
    memberships = fuzzy.stick_breaking(jnp.asarray(p.unit, dtype) * root, centers, parameters.widths)
    rules = p.options.value[0]
    if rules is None:
        weights = fuzzy.minimum_weights(memberships)
    else:
        weights = fuzzy.rule_weights(memberships, fuzzy.thaw_rules(rules), memberships.shape[1])
    log_r, log_q = (fuzzy.takagi_sugeno(weights, x) for x in (parameters.log_alpha_r, parameters.log_alpha_q))
    return _scales(p, jnp.exp(-log_r), jnp.exp(-log_q))


def _smooth_init(p, inp):
    inner = p.inner.init(inp)
    channels = np.shape(p.parameters.gaps)[0]
    if inp.y.shape != (channels,):
        raise ValueError(f"parameters: are for {channels} channels, but a sample has {inp.y.shape[0]}")
    _, R = covariances(p.inner.update(inner, inp)[1], "fuzzy_noise")
    variance = jnp.diagonal(R)
    squares = 1.6 * variance
    return Wrapped(inner, _SmoothMemory(_heads(p, squares, variance)[0], squares))


def _smooth_update(p, s, inp):
    memory: _SmoothMemory = s.memory
    here = present(inp) & jnp.isfinite(inp.y)
    _, dry = p.inner.update(s.inner, inp)
    _, R = covariances(dry, "fuzzy_noise")
    forgetting = jnp.asarray(p.parameters.forgetting, inp.y.dtype)
    squares = forgetting * memory.squares + (1 - forgetting) * dry.innovation**2
    squares = jnp.where(here, squares, memory.squares)
    scales, status = _heads(p, squares, jnp.diagonal(R))
    inner, info = p.inner.update(s.inner, _apply(inp, scales))
    used = usable(inp, info)
    taught = used.any()
    new = _SmoothMemory(
        _Scales(*(_hold(taught, x, old) for x, old in zip(scales, memory.scales, strict=True))),
        jnp.where(used, squares, memory.squares),
    )
    return _finish(inner, info, new, jnp.where(taught, status, jnp.int32(0)))
