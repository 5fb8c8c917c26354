"""Parameters of a filter by maximum likelihood, from a recording."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from jaxfilt import tune
from jaxfilt.cli import filters
from jaxfilt.cli.filters import Choice, Scale, Start
from jaxfilt.cli.read import Recording

STEPS = 80
STARTS = 3
_OPTIMIZER = optax.adam(0.2)  # made once: an optimizer is compared by identity
_PIECES = 4  # a long recording is represented by as many stretches


class Data(NamedTuple):
    """Stretches of a recording of one length."""

    ys: Any  # (B, T, m)
    mask: Any  # (B, T, m)
    dt: Any  # (B, T); None where all intervals are the median
    scored: Any  # (B, T) bool: fixes after those with which a stretch starts
    start: Start  # leaves (B, ...)


class Learnt(NamedTuple):
    """What was learnt, and from what."""

    params: dict[str, float]
    free: tuple[str, ...]  # the names of what was learnt; the others were given
    rows: int
    result: tune.TuneResult | None  # None if all was given
    warnings: tuple[str, ...]


def learn(
    choice: Choice, rec: Recording, s: Scale, space: dict[str, Any], *,
    last: int | None = None, most: int = 1000, steps: int = STEPS, starts: int = STARTS,
) -> Learnt:  # fmt: skip
    """Maximizes the innovation likelihood over the parameters of ``space`` that are specs.

    Args:
        choice: the filter.
        rec: the recording.
        s: its orders of magnitude.
        space: of :func:`jaxfilt.cli.filters.space`.
        last: rows from here on are not looked at.
        most: rows that are used; of a longer recording four stretches, evenly spread.
        steps: of the gradient descent.
        starts: searches side by side.
    """
    last = len(rec.times) if last is None else last
    free = tuple(name for name, value in space.items() if isinstance(value, tune.Spec))
    if not free:
        return Learnt({name: float(value) for name, value in space.items()}, (), 0, None, ())
    data = pieces(rec, s, choice, last, most)
    found = tune.gradient(
        Partial(_loss, jf.Static(choice)), space, data,
        key=jax.random.key(0), optimizer=_OPTIMIZER, steps=steps, starts=starts, spread=0.4,
    )  # fmt: skip
    params = {name: float(value) for name, value in found.params.items()}
    return Learnt(params, free, int(data.ys.shape[0] * data.ys.shape[1]), found, _warnings(choice, space, found, data))


def pieces(rec: Recording, s: Scale, choice: Choice, last: int, most: int) -> Data:
    """One stretch, or four of a long recording."""
    count, length = (1, last) if last <= most else (_PIECES, most // _PIECES)
    firsts = np.linspace(0, last - length, count).astype(int)
    rows = [slice(k, k + length) for k in firsts]
    starts = [filters.start(rec, r, s) for r in rows]
    start = Start(*(np.stack(leaves) for leaves in zip(*starts, strict=True)))
    scored = np.stack([scored_rows(rec.present[r], choice) for r in rows])
    ys, mask, dt = (np.stack([x[r] for r in rows]) for x in (rec.ys, rec.mask, rec.dt))
    # What depends on the interval alone is computed once, not in every step, where the intervals are the model's own.
    return jax.tree.map(jnp.asarray, Data(ys, mask, None if rec.regular else dt, scored, start))


def scored_rows(present: np.ndarray, choice: Choice) -> np.ndarray:
    """The fixes that follow those from which the state is first found: twice as many as there are derivatives."""
    blocks = len({c[0] for c in filters.state_letters(choice)})
    return present & (np.cumsum(present) > min(2 * blocks, present.sum() // 3))


def _loss(choice: jf.Static, params: dict[str, Array], data: Data) -> Array:
    """Mean negative log-likelihood per scored fix."""

    def piece(one: Data) -> Array:
        filt = filters.make(choice.value, params, one.start)
        given = {"mask": one.mask, "dt": one.dt, "first_update_only": True}
        return jf.filter(filt, one.ys, **given, outputs=jf.log_lik)

    log_lik = jnp.where(data.scored, jax.vmap(piece)(data), 0.0)
    return -log_lik.sum() / jnp.maximum(data.scored.sum(), 1).astype(log_lik.dtype)


def _warnings(choice, space, found, data) -> tuple[str, ...]:
    texts = []
    low, high = (tune.constrain(space, z) for z in tune.bounds(space))
    for name, spec in space.items():
        if not isinstance(spec, tune.Spec):
            continue
        value = float(found.params[name])
        side = "lower" if value <= 1.02 * float(low[name]) else "upper" if value >= float(high[name]) / 1.02 else None
        if side:
            shown, unit = filters.described(name, value)
            texts.append(f"{name} ran to its {side} bound, {shown:.3g} {unit}: {_reason(name, side)}")
    if not np.isfinite(found.loss):
        texts.append("no parameters with a finite likelihood were found")
    scored = int(data.scored.sum())
    if scored < 10 * tune.size(space):
        texts.append(f"{tune.size(space)} parameters were learnt from few fixes, {scored}: take them as a guess")
    return tuple(texts)


def _reason(name: str, side: str) -> str:
    if name.startswith("life"):
        return "the mode is hardly ever " + ("kept" if side == "lower" else "left")
    if name.startswith("sigma") and not name.startswith("sigma_a"):
        return "the recording looks free of noise" if side == "lower" else "the model does not follow the recording"
    if name == "tau":
        return "the acceleration is white, as in cv" if side == "lower" else "the acceleration hardly decays, as in ca"
    return "the recording shows no such noise" if side == "lower" else "the model does not follow the recording"
