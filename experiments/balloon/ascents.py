"""Recorded radiosonde ascents: wind and rate of ascent from positions, a part of them hidden.

The noise of each filter is learnt on one ascent by its innovation likelihood and scored on the other, both ways round.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.balloon.system import AXES, side_by_side
from experiments.bootstrap import Bootstrap
from jaxfilt import tune
from jaxfilt.models.linear import value

DATA = Path(__file__).parents[1] / "data" / "radiosonde_arm"
ASCENTS = ("sgp_20190101_0532", "bnf_20250619_0530")
LENGTH = 400  # samples of a piece, 1 s apart
PIECES = 10  # of each ascent, from the launch on
GAPS = ((50, 5), (90, 15), (140, 40), (220, 5), (260, 15), (310, 40))  # first hidden sample of a piece, and how many
LENGTHS = (5, 15, 40)
WARMUP = 30  # samples of a piece that are not scored
BLOCK = 50  # samples that stay together in the bootstrap where nothing is hidden
SHARE = 0.9  # of theta_max
UNIVERSE = (7.0,) * AXES  # of the fuzzy inputs, in standard deviations of the innovation
OPTIMIZER = optax.adam(0.1)
STEPS = 100
VELOCITY = 900.0  # m^2/s^2, prior variance

Params = dict[str, Any]


class Ascent(NamedTuple):
    """One ascent in pieces, each about its first position."""

    ys: np.ndarray  # (B, T, 3) m east, north, up
    velocity: np.ndarray  # (B, T, 3) m/s, the vendor's filtered wind and its rate of ascent


@functools.cache
def load(name: str) -> Ascent:
    """The first pieces of an ascent."""
    rows = np.loadtxt(DATA / f"{name}.csv", delimiter=",", skiprows=1)[: PIECES * LENGTH]
    pieces = rows.reshape(PIECES, LENGTH, -1)
    return Ascent(pieces[:, :, 1:4] - pieces[:, :1, 1:4], pieces[:, :, 4:7])


def shown() -> np.ndarray:
    """(T,) bool: what the filters are shown of a piece."""
    mask = np.ones(LENGTH, bool)
    for first, length in GAPS:
        mask[first : first + length] = False
    return mask


# ----------------------------------------------------------------------------------------------------------- filters


def models(order: int, params: Params) -> list[jf.models.LinearGaussian]:
    """One model per axis of constant velocity (2) or acceleration (3); q and r: horizontal, vertical."""
    make = jf.models.constant_velocity if order == 2 else jf.models.constant_acceleration
    found = []
    for axis in (0, 0, 1):
        q, r = params["q"][axis], params["r"][axis]
        P0 = jnp.diag(jnp.concatenate([r[None], jnp.asarray([VELOCITY, 1.0])[: order - 1]]))
        model = make(dt=1.0, q=q, r=r, m0=jnp.zeros(order), P0=P0)
        # Samples are 1 s apart: matrices, as the Riccati equation asks for.
        found.append(model._replace(F=value(model.F, None, None), Q=value(model.Q, None, None)))
    return found


def kalman(order: jf.Static, params: Params) -> jf.Filter:
    return side_by_side([jf.kalman(model) for model in models(order.value, params)])


def fuzzy(params: Params) -> jf.Filter:
    """Takagi-Sugeno scaling of a CV filter, its inputs in standard deviations that the CV filter expects."""
    return jf.fuzzy_noise(
        kalman(jf.Static(2), params), jf.FuzzyNoise(**params["fuzzy"]), unit=params["unit"], scale="both"
    )  # fmt: skip


def mixed(params: Params) -> jf.Filter:
    return side_by_side([jf.mixed_hinf(model, params["theta"]) for model in models(2, params)])


def sage_husa(params: Params) -> jf.Filter:
    return jf.sage_husa(kalman(jf.Static(2), params))


def covariance_matching(params: Params) -> jf.Filter:
    return jf.covariance_matching(kalman(jf.Static(2), params))


MIXED = f"CV, mixed {SHARE:g}"
FUZZY = "CV, fuzzy, tuned"
FILTERS = {
    "CV": Partial(kalman, jf.Static(2)),
    "CA": Partial(kalman, jf.Static(3)),
    MIXED: Partial(mixed),
    "CV, Sage-Husa": Partial(sage_husa),
    "CV, covariance matching": Partial(covariance_matching),
    FUZZY: Partial(fuzzy),
}
LEARNT = ("CV", "CA", FUZZY)
QUICK = ("CV", "CV, Sage-Husa")
NAIVE = ("last fix", "last two fixes", "fixes 10 s apart")


def likelihood(make: Partial, params: Params, data: Array) -> Array:
    """The sum over both ascents of the innovation likelihoods [nats per sample], each with parameters of its own."""
    one = lambda p, ys: tune.innovation_nll(make(p), ys, warmup=WARMUP, first_update_only=True)  # noqa: E731
    return jnp.sum(jax.vmap(one)(params, data))


def learn(names: tuple[str, ...] = LEARNT, steps: int = STEPS) -> dict[str, Params]:
    """The parameters of each filter, leaves with a leading axis over the ascents that they were learnt on."""
    data = jnp.asarray(np.stack([load(name).ys for name in ASCENTS]))
    noise = {
        "q": tune.positive(np.full((2, 2), 0.1), 1e-5, 1e3),
        "r": tune.positive(np.full((2, 2), 1.0), 1e-4, 1e4),
    }
    found: dict[str, Params] = {}
    for name in names:
        space: Params = noise
        if name == FUZZY:
            p = jf.fuzzy_noise_parameters(UNIVERSE, alpha=np.ones(4))
            p = jax.tree.map(lambda x: np.stack([np.asarray(x)] * 2), p)
            space = {**found["CV"], "unit": _units(found["CV"]), "fuzzy": {
                "forgetting": tune.unit(p.forgetting), "gaps": tune.positive(p.gaps, p.gaps / 20, 20 * p.gaps),
                "widths": tune.positive(p.widths, p.widths / 20, 20 * p.widths),
                "log_alpha_r": tune.real(p.log_alpha_r, -4.0, 4.0), "log_alpha_q": tune.real(p.log_alpha_q, -4.0, 4.0),
            }}  # fmt: skip
        result = tune.gradient(
            Partial(likelihood, FILTERS[name]), space, data, key=jax.random.key(0), optimizer=OPTIMIZER, steps=steps
        )  # fmt: skip
        found[name] = result.params
    return found


def complete(learnt: dict[str, Params]) -> dict[str, Params]:
    """The parameters of all filters that those learnt give."""
    cv = learnt["CV"]
    largest = [
        min(jf.theta_max(model) for model in models(2, jax.tree.map(lambda x, i=i: x[i], cv))[1:]) for i in range(2)
    ]
    found = {name: learnt.get(name, cv) for name in FILTERS if name in learnt or name not in LEARNT}
    found[MIXED] = {**cv, "theta": SHARE * jnp.asarray(largest)}
    return found


def _units(params: Params) -> Array:
    """(2, axes) one over the standard deviation of the innovation that the CV filters expect."""
    units = []
    for i in range(2):
        variances = []
        for model in models(2, jax.tree.map(lambda x, i=i: x[i], params)):
            P = jf.riccati(model)
            variances.append(P[0, 0] + model.R[0, 0])  # pyright: ignore[reportIndexIssue]
        units.append(1 / jnp.sqrt(jnp.stack(variances)))
    return jnp.stack(units)


# ------------------------------------------------------------------------------------------------------------ scores


def _outputs(state: Any, info: jf.Info) -> tuple[Array, Array, Array]:
    del state
    mean = info.mean.reshape(AXES, -1)
    log_lik = jnp.zeros(()) if info.log_lik is None else info.log_lik
    return mean[:, :2], log_lik, info.status


@jax.jit
def estimate(make: Partial, params: Params, ys: Array, mask: Array) -> tuple[Array, Array, Array]:
    """Positions and velocities (B, T, 3, 2), log-likelihoods and status (B, T); parameters of one ascent."""
    filt = make(params)
    run = lambda y: jf.filter(filt, y, mask=mask, outputs=_outputs, first_update_only=True)  # noqa: E731
    return jax.vmap(run)(ys)


def naive(name: str, ys: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The same (B, T, 3, 2) without a filter: what is held, or continued at the speed of two fixes."""
    seen = np.flatnonzero(mask)
    last = seen[np.maximum(np.searchsorted(seen, np.arange(len(mask)), side="right") - 1, 0)]
    back = {"last fix": 1, "last two fixes": 1, "fixes 10 s apart": 10}[name]
    earlier = seen[np.maximum(np.searchsorted(seen, last - back, side="right") - 1, 0)]
    span = np.maximum(last - earlier, 1)[:, None]
    velocity = (ys[:, last] - ys[:, earlier]) / span
    position = ys[:, last].astype(float)
    if name == "last fix":
        velocity = np.full_like(position, np.nan)
    else:
        position = position + velocity * (np.arange(len(mask)) - last)[:, None]
    return np.stack([position, velocity], axis=-1)


class Scores(NamedTuple):
    """Squared errors of one filter on one ascent."""

    horizontal: np.ndarray  # (B, T) m^2
    height: np.ndarray  # (B, T) m^2
    wind: np.ndarray  # (B, T) m^2/s^2, against the vendor's
    ascent: np.ndarray  # (B, T) m^2/s^2, likewise
    log_lik: np.ndarray | None  # (B, T)
    capped: float  # share of the samples with Status.BOUND


def compute(params: dict[str, Params]) -> dict[str, dict[str, Scores]]:
    """Scores by ascent and filter, the noise learnt on the other ascent."""
    mask = shown()
    found: dict[str, dict[str, Scores]] = {}
    for i, ascent in enumerate(ASCENTS):
        data = load(ascent)
        ys = np.where(mask[None, :, None], data.ys, 0.0)  # what is hidden is not even there
        found[ascent] = {}
        for name, learnt in params.items():
            own = jax.tree.map(lambda x, i=i: x[1 - i], learnt)
            state, log_lik, status = map(np.asarray, estimate(FILTERS[name], own, jnp.asarray(ys), jnp.asarray(mask)))
            capped = float(((status & int(jf.Status.BOUND)) != 0)[:, WARMUP:].mean())
            found[ascent][name] = _score(data, state, None if name == MIXED else log_lik, capped)
        for name in NAIVE:
            found[ascent][name] = _score(data, naive(name, ys, mask), None, 0.0)
    return found


def _score(data: Ascent, state: np.ndarray, log_lik: np.ndarray | None, capped: float) -> Scores:
    position = (state[..., 0] - data.ys) ** 2
    velocity = (state[..., 1] - data.velocity) ** 2
    horizontal, wind = position[..., :2].sum(axis=-1), velocity[..., :2].sum(axis=-1)
    return Scores(horizontal, position[..., 2], wind, velocity[..., 2], log_lik, capped)


class Groups(NamedTuple):
    """What is drawn again in the bootstrap, the same for all filters and scores of an ascent."""

    gaps: dict[int, Bootstrap]  # by length
    blocks: Bootstrap  # of what is shown


def groups(seed: int) -> Groups:
    """Gaps of each length, and blocks of shown samples."""
    rng = np.random.default_rng(seed)
    length = np.tile([n for _, n in GAPS], PIECES)
    blocks = np.ones(PIECES * LENGTH // BLOCK, bool)
    return Groups({n: Bootstrap(length == n, rng) for n in LENGTHS}, Bootstrap(blocks, rng))


def in_gaps(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums and counts (B * gaps,) over each gap."""
    totals = np.stack([x[:, first : first + length].sum(axis=1) for first, length in GAPS], axis=1)
    return totals.ravel(), np.tile([length for _, length in GAPS], PIECES)


def in_blocks(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums and counts over the shown samples of each block, the warm-up left out."""
    scored = shown()
    scored[:WARMUP] = False
    split = lambda a: a.reshape(PIECES, LENGTH // BLOCK, BLOCK).sum(axis=2).ravel()  # noqa: E731
    return split(np.where(scored, x, 0.0)), split(np.broadcast_to(scored, x.shape).astype(float))
