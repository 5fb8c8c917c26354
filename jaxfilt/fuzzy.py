"""A small fuzzy-inference toolbox: memberships, rule tables, Mamdani and Takagi-Sugeno inference.

Pure functions of arrays, fit for ``jit``, ``vmap`` and ``grad``, and of use to any adaptive filter. Sets are counted
from 0, the lowest. A rule table is an integer array with one axis per input: entry ``[i, j, ...]`` is the output level
where input 0 is in set i, input 1 in set j, and so on.

    system = jf.fuzzy.mamdani([40.0, 25.0, 23.0])            # three inputs, four sets each, min rules, output 0..100
    jf.fuzzy.infer(system, jnp.array([20.0, 12.5, 11.5])).value      # 50

Max-min inference has flat stretches and kinks, where gradients are zero or one-sided. For training use smooth
memberships (:func:`stick_breaking`) with Takagi-Sugeno weights (:func:`rule_weights`, :func:`minimum_weights`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import Static, check_count, check_flag, check_float, is_concrete, numbers
from jaxfilt.models.linear import check_finite, check_positive

_POINTS = 1001  # of the output's universe, over which the centroid is taken
_NOTHING = 1e-12  # area below which no output set is held to be active


# Memberships


def trapezoid(x: Array, corners: Array) -> Array:
    """Membership 0 up to the first corner, 1 between the second and the third, 0 from the fourth on, linear between.

    Args:
        x: any shape that broadcasts with the corners' leading axes.
        corners: (..., 4), ordered. Equal corners make a step, which belongs to the set.
    """
    a, b, c, d = (corners[..., i] for i in range(4))
    return jnp.minimum(_ramp(x, a, b), _ramp(-x, -d, -c))


def triangle(x: Array, corners: Array) -> Array:
    """Membership of a triangle with ``corners (..., 3)``: foot, peak, foot; see :func:`trapezoid`."""
    return trapezoid(x, corners[..., np.array([0, 1, 1, 2])])


def gaussian(x: Array, center: Array, width: Array) -> Array:
    """Membership ``exp(-((x - center) / width)^2 / 2)``."""
    return jnp.exp(-0.5 * ((x - center) / width) ** 2)


def _ramp(x, low, high):
    """0 below low, 1 above high; a step at ``high`` where both are equal."""
    steep = ~(high > low)
    slope = (x - low) / jnp.where(steep, jnp.ones_like(high), high - low)
    step = jnp.where(x >= high, jnp.ones_like(slope), jnp.zeros_like(slope))
    return jnp.where(steep, step, jnp.clip(slope, 0.0, 1.0))


def partition(universe: Any, sets: int = 4, logits: Any = None) -> Array:
    """Corners of trapezoids that share ``[0, universe]``: at every point their memberships sum to 1.

    The ``2 sets - 1`` segments between corners are shoulders and slopes in turn, the first and the last set being cut
    by the universe. ``corners = universe cumsum(softmax(logits))``: ordered and inside the universe whatever the logits
    are, so that these can be tuned.

    Args:
        universe: () or (d,) upper end for each of d inputs, > 0.
        sets: number of sets, >= 2.
        logits: (2 sets - 1,) or (d, 2 sets - 1); None = segments of equal length.

    Returns:
        (sets, 4), or (d, sets, 4).

    Raises:
        ValueError: universe <= 0, fewer than 2 sets, logits of another shape or (concrete) not finite.
    """
    check_positive("universe", universe)
    check_count("sets", sets, 2)
    segments = 2 * sets - 1
    universe = jnp.asarray(universe)
    if not jnp.issubdtype(universe.dtype, jnp.floating):
        universe = universe.astype(float)
    if logits is None:
        ends = jnp.asarray(np.linspace(0.0, 1.0, segments + 1), universe.dtype)
    else:
        check_finite("logits", logits)
        logits = jnp.asarray(logits, universe.dtype)
        if logits.shape not in {(segments,), (*universe.shape, segments)}:
            raise ValueError(f"logits: expected shape ({segments},) or one row per input, got {logits.shape}")
        ends = jnp.cumsum(jax.nn.softmax(logits, axis=-1), axis=-1)
        # The last sum is 1 up to rounding.
        ends = jnp.concatenate([jnp.zeros_like(ends[..., :1]), ends[..., :-1], jnp.ones_like(ends[..., :1])], axis=-1)
    ends = jnp.broadcast_to(ends, (*universe.shape, segments + 1))
    first = 2 * np.arange(sets)
    index = np.stack([np.maximum(first - 1, 0), first, first + 1, np.minimum(first + 2, segments)], axis=1)
    return universe[..., None, None] * ends[..., index]


def ordered(raw: Array) -> Array:
    """Increasing positive points ``cumsum(softplus(raw))`` along the last axis, for any real ``raw``."""
    return jnp.cumsum(jax.nn.softplus(raw), axis=-1)


def unordered(points: Array) -> Array:
    """The inverse of :func:`ordered`, for increasing positive points."""
    gaps = jnp.diff(points, axis=-1, prepend=jnp.zeros_like(points[..., :1]))
    return gaps + jnp.log(-jnp.expm1(-gaps))


def stick_breaking(x: Array, centers: Array, widths: Array) -> Array:
    """Smooth memberships of L sets with L - 1 crossing points: positive, with sum 1, for any widths.

    With ``s_j = sigmoid((x - centers_j) / widths_j)`` they are ``1 - s_1, s_1 (1 - s_2), ..., s_1 ... s_{L-1}``.
    (Differences ``s_j - s_{j+1}`` may be negative where widths differ.)

    Args:
        x: (...).
        centers: (..., L - 1), increasing.
        widths: (..., L - 1), positive.

    Returns:
        (..., L).
    """
    z = (x[..., None] - centers) / widths
    passed = jnp.cumprod(jax.nn.sigmoid(z), axis=-1)
    reached = jnp.concatenate([jnp.ones_like(passed[..., :1]), passed[..., :-1]], axis=-1)
    return jnp.concatenate([reached * jax.nn.sigmoid(-z), passed[..., -1:]], axis=-1)


# Rules


def minimum_rules(levels: int, inputs: int) -> np.ndarray:
    """The rule table (levels,) * inputs whose output level is the lowest of the inputs' sets."""
    check_count("levels", levels, 1)
    check_count("inputs", inputs, 1)
    return np.indices((levels,) * inputs).min(axis=0)


def check_rules(rules: Any, sets: int, inputs: int, levels: int) -> np.ndarray:
    """The rule table as an integer array, checked.

    Raises:
        ValueError: another shape than ``(sets,) * inputs``, or an entry outside 0..levels - 1.
        TypeError: no integers.
    """
    for name, count in (("sets", sets), ("inputs", inputs), ("levels", levels)):
        check_count(name, count, 1)
    rules = numbers("rules", rules)
    if not np.issubdtype(rules.dtype, np.integer):
        raise TypeError(f"rules: expected integers, got {rules.dtype}")
    if rules.shape != (sets,) * inputs:
        raise ValueError(f"rules: expected shape {(sets,) * inputs}, one axis per input, got {rules.shape}")
    if rules.min() < 0 or rules.max() >= levels:
        raise ValueError(f"rules: expected levels 0 to {levels - 1}, got {rules.min()} to {rules.max()}")
    return rules


def freeze_rules(rules: np.ndarray) -> Static:
    """A rule table as a static option, compared by value."""
    return Static((rules.shape, tuple(rules.ravel().tolist())))


def thaw_rules(rules: Static) -> np.ndarray:
    """The inverse of :func:`freeze_rules`."""
    shape, entries = rules.value
    return np.array(entries).reshape(shape)


def rule_weights(memberships: Array, rules: np.ndarray, levels: int) -> Array:
    """How much each output level counts, by the product of memberships summed over the rules that name it.

    Args:
        memberships: (d, L) of d inputs in L sets.
        rules: (L,) * d, from :func:`check_rules`. Concrete.
        levels: number of output levels.

    Returns:
        (levels,). It sums to 1 where every input's memberships do.
    """
    table = _table(memberships, jnp.multiply).ravel()
    return jnp.stack([jnp.sum(table[np.flatnonzero(rules == level)]) for level in range(levels)])


def minimum_weights(memberships: Array) -> Array:
    """:func:`rule_weights` of :func:`minimum_rules` without the table.

    The level is at least l where every input is: ``T_l = prod_i sum_{j >= l} memberships_ij``, and level l has the
    weight ``T_l - T_{l+1}``. That holds where every input's memberships sum to 1.

    Args:
        memberships: (d, L).

    Returns:
        (L,).
    """
    tails = jnp.prod(jnp.cumsum(memberships[:, ::-1], axis=1)[:, ::-1], axis=0)
    return tails - jnp.concatenate([tails[1:], jnp.zeros_like(tails[:1])])


def takagi_sugeno(weights: Array, values: Array) -> Array:
    """The weighted mean of the levels' ``values (levels, ...)``, for ``weights (levels,)`` that sum to 1."""
    return jnp.tensordot(weights, values, axes=1)


def _table(memberships, combine):
    """The t-norm of one membership of each input, for all combinations: (L,) * d."""
    table = memberships[0]
    for i in range(1, memberships.shape[0]):
        table = combine(table[..., None], memberships[i].reshape((1,) * i + (-1,)))
    return table


# Mamdani


class Mamdani(NamedTuple):
    """A max-min inference system. Build it with :func:`mamdani`."""

    universe: Any  # (d,) upper end of each input
    corners: Any  # (d, L, 4) input sets
    rules: Static
    outputs: Any  # (K, 3) output sets
    output_range: Any  # (2,)


class Inference(NamedTuple):
    """What :func:`infer` returns."""

    value: Array  # () centroid; 0 where nothing fired
    strength: Array  # (K,) of each output level
    fired: Array  # () bool; False where no set is active or an input is NaN: hold what you had
    lowest: Array  # () bool, all inputs fully in their lowest sets


def triangles(levels: int = 4, output_range: tuple[float, float] = (0.0, 100.0), *, inner: bool = False) -> np.ndarray:
    """Output sets (levels, 3): evenly spaced triangles that cross at 1/2.

    Args:
        levels: number of sets, >= 2.
        output_range: ends of the output's universe. The first and the last triangle peak there and are cut by it.
        inner: peaks inside instead, at ``1 / (levels + 1), 2 / (levels + 1), ...`` of the range: nothing is cut.
    """
    check_count("levels", levels, 2)
    check_flag("inner", inner)
    low, high = _check_range(output_range)
    place = np.arange(levels)
    if inner:
        corners = (place[:, None] + np.arange(3)) / (levels + 1)
    else:
        corners = np.clip((place[:, None] + np.arange(-1, 2)) / (levels - 1), 0.0, 1.0)
    return low + (high - low) * corners


def _check_range(output_range: Any) -> tuple[float, float]:
    """The ends of the output's universe, or an error that names ``output_range``."""
    ends = numbers("output_range", output_range)
    if ends.shape != (2,) or not (np.isfinite(ends).all() and ends[0] < ends[1]):
        raise ValueError(f"output_range: expected finite ends low < high, got {output_range}")
    return float(ends[0]), float(ends[1])


def mamdani(
    universe: Any,
    *,
    sets: int = 4,
    corners: Any = None,
    rules: Any = None,
    outputs: Any = None,
    output_range: tuple[float, float] = (0.0, 100.0),
) -> Mamdani:
    """A max-min inference system with d inputs and one output, checked.

    Args:
        universe: (d,) upper end of each input, > 0, in the inputs' own units; a number for one input.
        sets: L, for each input, where ``corners`` are not given.
        corners: (L, 4) or (d, L, 4) trapezoids; None = :func:`partition`. May be traced, to be tuned.
        rules: integers (L,) * d; None = :func:`minimum_rules`.
        outputs: (K, 3) triangles, foot, peak, foot; None = :func:`triangles` with K = L. May be traced.
        output_range: ends of the output's universe.

    Raises:
        ValueError: (concrete values) universe <= 0; corners not ordered, or sets that leave a gap in the universe;
            output sets not ordered or outside the output's universe; a rule level out of range; wrong shapes.
        TypeError: rules that are no integers.

    Source: Mamdani and Assilian 1975. Table, universes and ranges are those of Kazemi, Masoumnezhad and Askari 2021.
    """
    check_positive("universe", universe)
    universe = universe if hasattr(universe, "dtype") else np.asarray(universe, float)
    if universe.size == 0:
        raise ValueError(f"universe: expected shape (d,) with d >= 1, got {universe.shape}")
    universe = universe.reshape(-1) if np.ndim(universe) < 2 else universe
    if universe.ndim != 1:
        raise ValueError(f"universe: expected shape (d,), got {universe.shape}")
    d = universe.shape[0]
    if corners is None:
        corners = partition(universe, sets)
    else:
        corners = corners if hasattr(corners, "dtype") else numbers("corners", corners).astype(float)
        if corners.ndim not in (2, 3) or corners.shape[-1] != 4 or (corners.ndim == 3 and corners.shape[0] != d):
            raise ValueError(f"corners: expected shape (L, 4) or ({d}, L, 4), got {corners.shape}")
        corners = corners if corners.ndim == 3 else jnp.broadcast_to(corners, (d, *corners.shape))
    _check_inputs(universe, corners)
    output_range = _check_range(output_range)
    L = corners.shape[1]
    if outputs is None:
        outputs = triangles(L, output_range)
    outputs = outputs if hasattr(outputs, "dtype") else numbers("outputs", outputs).astype(float)
    if outputs.ndim != 2 or outputs.shape[1] != 3:
        raise ValueError(f"outputs: expected shape (K, 3), got {outputs.shape}")
    _check_outputs(outputs, output_range)
    rules = minimum_rules(L, d) if rules is None else rules
    rules = check_rules(rules, L, d, outputs.shape[0])
    return Mamdani(universe, corners, freeze_rules(rules), outputs, output_range)


def infer(system: Mamdani, x: Array) -> Inference:
    """Max-min inference with the centroid by the trapezoid rule on 1001 points of the output's universe.

    A rule is as strong as the least of its memberships, a level as strong as the strongest of its rules; the output set
    is the maximum over the levels of the output sets cut off at these strengths.

    Args:
        system: from :func:`mamdani`.
        x: (d,) inputs. Their absolute value counts, and beyond the universe its end does.
    """
    if not isinstance(system, Mamdani):
        raise TypeError(f"system: expected a jf.fuzzy.Mamdani, got {type(system).__name__}")
    check_float("x", x)
    x = jnp.asarray(x)
    universe, corners, outputs, ends = (
        jnp.asarray(part, x.dtype) for part in (system.universe, system.corners, system.outputs, system.output_range)
    )
    if x.shape != universe.shape:
        raise ValueError(f"x: expected shape {universe.shape}, one value per input, got {x.shape}")
    known = ~jnp.isnan(x).any()
    x = jnp.where(known, jnp.minimum(jnp.abs(x), universe), jnp.zeros_like(x))
    memberships = trapezoid(x[:, None], corners)
    table = _table(memberships, jnp.minimum).ravel()
    rules = thaw_rules(system.rules).ravel()
    zero = jnp.zeros((), x.dtype)
    which = [np.flatnonzero(rules == level) for level in range(outputs.shape[0])]
    strength = jnp.stack([jnp.max(table[i]) if i.size else zero for i in which])
    points = ends[0] + (ends[1] - ends[0]) * jnp.asarray(np.linspace(0.0, 1.0, _POINTS), x.dtype)
    area = jnp.minimum(strength[:, None], triangle(points[None, :], outputs[:, None, :])).max(axis=0)
    area = area * jnp.asarray(_trapezoid_rule(), x.dtype) * (ends[1] - ends[0])
    total = jnp.sum(area)
    fired = (total > _NOTHING) & known
    value = jnp.where(fired, jnp.sum(points * area) / jnp.where(fired, total, jnp.ones_like(total)), zero)
    return Inference(value, strength, fired, known & (memberships[:, 0] >= 1).all())


def _trapezoid_rule():
    weights = np.full(_POINTS, 1.0 / (_POINTS - 1))
    weights[[0, -1]] *= 0.5
    return weights


def _check_inputs(universe, corners):
    if not is_concrete((universe, corners)):
        return
    check_finite("corners", corners)
    corners, universe = np.asarray(corners, float), np.asarray(universe, float)
    if (np.diff(corners, axis=-1) < 0).any():
        i, j = np.argwhere((np.diff(corners, axis=-1) < 0).any(axis=-1))[0]
        raise ValueError(f"corners: must be ordered, but set {j} of input {i} has {corners[i, j].tolist()}")
    for i, (end, sets) in enumerate(zip(universe, corners, strict=True)):
        # Memberships are linear between corners: a gap shows at one of them or halfway between two.
        ends = np.unique(np.clip(np.concatenate([sets.ravel(), [0.0, end]]), 0.0, end))
        points = np.sort(np.concatenate([ends, 0.5 * (ends[1:] + ends[:-1])]))[:, None]
        a, b, c, d = sets.T
        covered = (((a < points) & (points < d)) | ((b <= points) & (points <= c))).any(axis=1)
        if not covered.all():
            raise ValueError(f"corners: no set of input {i} holds {points[~covered][0, 0]:.6g}; they must leave no gap")


def _check_outputs(outputs, output_range):
    if not is_concrete(outputs):
        return
    check_finite("outputs", outputs)
    outputs = np.asarray(outputs, float)
    if (np.diff(outputs, axis=1) < 0).any() or (outputs[:, 0] >= outputs[:, 2]).any():
        raise ValueError(f"outputs: expected foot <= peak <= foot and some width, got {outputs.tolist()}")
    slack = 1e-9 * (output_range[1] - output_range[0])
    if outputs.min() < output_range[0] - slack or outputs.max() > output_range[1] + slack:
        raise ValueError(f"outputs: outside the output's universe {tuple(output_range)}: {outputs.tolist()}")
