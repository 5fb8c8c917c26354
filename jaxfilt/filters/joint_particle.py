"""Particle filters over modes of motion, and over classes that each have their own modes."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxfilt.core import (
    Filter,
    Info,
    Prediction,
    Static,
    Status,
    aspartial,
    bind,
    check_flag,
    flag,
    is_concrete,
    number,
    real_array,
)
from jaxfilt.core import check_count as core_check_count
from jaxfilt.filters.common import check_dtype, check_measurement, decoupled, likelihood, stack, step_key
from jaxfilt.filters.imm import _check_probabilities, _log_probabilities
from jaxfilt.filters.particle import check_count, check_share
from jaxfilt.filters.resampling import is_low, score_correction
from jaxfilt.linalg import chol, scale_cov, solve_lower, sym
from jaxfilt.models.linear import LinearGaussian
from jaxfilt.models.nonlinear import Nonlinear, as_nonlinear, covariance

SCHEMES = ("systematic", "stratified", "multinomial")
_FLOOR = -1e6  # of a class's and of a particle's log-probability: finite, and beyond what any data take back


class JointState(NamedTuple):
    """Particles sorted by class. Weights are within the class, so that no class is lost in the rounding of another."""

    particles: Array  # (n, N): a column each, so that loops over them run along memory
    modes: Array  # (N,) int32
    log_weights: Array  # (N,) within the particle's class; normalized after update
    log_classes: Array  # (s,) log-probabilities of the classes
    counts: Array  # (s,) int32 particles of each class
    means: Array  # (s, n) of each class after the last update


class _Options(NamedTuple):
    count: int
    classes: int
    modes: int
    scheme: str
    score_at: str
    noise_rank: int | None
    score_gradient: bool
    keep: bool


class _Params(NamedTuple):
    models: tuple[tuple[Nonlinear, ...], ...]  # [class][mode]
    transition: Any  # (M, M) or (s, M, M)
    prior: Any  # (s,)
    mode_prior: Any  # (M,)
    floor: Any  # ()
    threshold: Any  # ()
    score: Callable | None
    start: Callable | None
    options: Static


def joint_particle(
    models: Sequence[Sequence[Nonlinear | LinearGaussian]],
    transition: Any,
    count: int,
    *,
    prior: Any = None,
    mode_prior: Any = None,
    floor: Any = 0.5,
    score: Callable[[Array, Array], Array] | None = None,
    score_at: str = "particle",
    start: Callable[..., Array] | None = None,
    resampling: str = "systematic",
    threshold: Any = 0.5,
    noise_rank: int | None = None,
    score_gradient: bool = True,
    keep: bool = False,
) -> Filter:
    """Joint tracking and classification: one particle filter over the state, an unknown class and a mode of motion.

    The class never changes; within it the mode is a Markov chain. ``count`` particles are shared among the classes in
    proportion to their probabilities, but each class keeps at least ``floor`` of an equal share, so that a wrong early
    decision can be undone. Each step draws modes and states with the parameters of the particle's own class and mode
    (one evaluation per particle, however many modes there are), weighs, and resamples within the classes if the least
    effective sample size of a class falls below ``threshold`` of its particles.

    The split changes how well a class is represented, never how probable it is: ``exp(sum of log_lik)`` stays an
    unbiased estimate of the likelihood for every floor. With ``floor=1`` the classes share equally and the filter is a
    bank of independent ones (:func:`jaxfilt.bank` of :func:`jaxfilt.multi_mode_particle`) of ``count / s`` each.

    Gradients: the forward pass is the plain filter; ancestors and modes that are drawn leave a factor of value 1 in the
    weights whose derivative is their score, so that slopes of ``log_lik`` and of the class probabilities are
    consistent, also for the transition probabilities. Their variance grows with the number of steps: differentiate
    windows of 20 to 50. It is exact for multinomial resampling and the usual approximation for the other schemes.

    Random: ``jf.filter(..., key=)`` is needed; under ``vmap`` over series give each its own. Info: moments before
    resampling; ``innovation``, ``innovation_cov`` and ``nis`` of the predicted measurement's moments. ``extra``:
    ``log_probabilities`` (s,) of the classes, ``means`` (s, n) within them, ``mode_probabilities`` (M,), ``ess`` (s,)
    and ``counts`` (s,); with ``keep`` also ``particles`` (N, n), ``classes`` (N,), ``modes`` (N,) and ``log_weights``
    (N,) over all particles.

    Status: LOW_ESS where a class's effective sample size is below the threshold or below 2; MISSED; NONFINITE also
    where no particle has a finite likelihood (the predicted particles then keep their weights); SINGULAR. A sample
    without a usable component is a prediction: neither weights nor ``score`` count.

    Args:
        models: for each class its models, one per mode, the same number in each. All are built alike: one function
            with other parameters, so that the parameters can be stacked. The sensor (h, R, residual) is the first's.
        transition: (M, M) or (s, M, M) probability of mode j after mode i, rows sum to 1.
        count: number of particles N of all classes together, static; divisible by the number of classes.
        prior: (s,) class probabilities; None = equal.
        mode_prior: (M,) probabilities of the modes before the first step; None = equal.
        floor: least share of a class as a fraction of N / s, in (0, 1]. May be traced.
        score: ``(x (n,), class ()) -> ()`` log of a class's potential, added to the log-likelihood in each step with a
            measurement. It is no density of the data: ``log_lik`` then is that of the weighted model.
        score_at: ``"particle"``: at each particle. ``"class_mean"``: at the class's mean of the step before.
        start: ``(key, classes (N,), inp) -> (N, n)`` draws from the prior; ``inp`` is the first input. None = the
            Gaussian prior of each class's first model.
        resampling: ``"systematic"``, ``"stratified"`` or ``"multinomial"``, each within the classes.
        threshold: in [0, 1]; 1 resamples in every step, 0 never.
        noise_rank: how many numbers drive a step's noise, where Q has a lower rank than the state: only the first
            columns of its Cholesky factor are used, the others must be zero. Drawing is what costs most.
        score_gradient: False: gradients pass through the draws only and are biased as soon as there is resampling.
        keep: report the particles.

    Warns:
        UserWarning: a (concrete) Q without any noise: resampled particles then stay copies of each other.

    Raises:
        ValueError: models that differ in structure or number, (concrete) probabilities that are negative or do not sum
            to 1, N not divisible by the number of classes, a floor outside (0, 1] or that leaves a class no particle,
            an unknown option; at trace time, no key.

    Source: Angelova and Mihaylova 2006; Hosseini, Haeri and Khaloozadeh 2019; importance correction by class in place
    of theirs; gradients: Scibior and Wood 2021.
    """
    models = _as_models(models)
    s, M = len(models), len(models[0])
    check_count("count", count, "particles")
    if count % s:
        raise ValueError(f"count: expected a multiple of the {s} classes, got {count}")
    for name, option, known in (
        ("resampling", resampling, SCHEMES),
        ("score_at", score_at, ("particle", "class_mean")),
    ):
        if option not in known:
            raise ValueError(f"{name}: expected one of {', '.join(known)}, got {option!r}")
    if is_concrete(floor) and not 0 < number("floor", floor) <= 1:
        raise ValueError(f"floor: expected 0 < floor <= 1, got {floor}; a class without particles never comes back")
    if is_concrete(floor) and np.floor(float(floor) * count / s) < 1:
        raise ValueError(f"floor: {floor} of {count} particles leaves a class without any")
    check_share("threshold", threshold)
    check_flag("score_gradient", score_gradient)
    check_flag("keep", keep)
    transition_shape = (s, M, M) if real_array("transition", transition).ndim == 3 else (M, M)
    prior = (1 / s,) * s if prior is None else prior
    mode_prior = (1 / M,) * M if mode_prior is None else mode_prior
    _check_probabilities("transition", transition, transition_shape)
    _check_probabilities("prior", prior, (s,))
    _check_probabilities("mode_prior", mode_prior, (M,))
    _check_noise(models, noise_rank)
    options = _Options(count, s, M, resampling, score_at, noise_rank, score_gradient, keep)
    params = _Params(
        models, transition, prior, mode_prior, floor, threshold,
        None if score is None else aspartial(score, "score"),
        None if start is None else aspartial(start, "start"), Static(options),
    )  # fmt: skip
    return bind(params, _init, _predict, _update, _moments)


def multi_mode_particle(
    models: Sequence[Nonlinear | LinearGaussian], transition: Any, count: int, **options: Any
) -> Filter:
    """A particle filter whose particles carry a mode of motion, a Markov chain: the model is drawn before the state.

    :func:`jaxfilt.joint_particle` with one class. For an unknown class, run one of these for each in
    :func:`jaxfilt.bank`.

    Args:
        models: one per mode, built alike.
        transition: (M, M) probability of mode j after mode i.
        count: number of particles.
        **options: as in :func:`jaxfilt.joint_particle`, without ``prior`` and ``floor``.

    Raises:
        ValueError: as there.

    Source: McGinnity and Irwin 2000.
    """
    return joint_particle([models], transition, count, floor=1.0, **options)


def _as_models(models) -> tuple[tuple[Nonlinear, ...], ...]:
    if not isinstance(models, tuple | list) or not all(isinstance(row, tuple | list) for row in models):
        raise TypeError("models: expected a sequence of models for each class")
    rows = tuple(tuple(as_nonlinear(m, "models") for m in row) for row in models)
    if not rows or not rows[0] or len({len(row) for row in rows}) > 1:
        raise ValueError("models: expected the same number of models, one or more, for each class")
    first, structure = rows[0][0], jax.tree.structure(rows[0][0])
    for c, row in enumerate(rows):
        for i, model in enumerate(row):
            shapes = [jnp.shape(a) == jnp.shape(b) for a, b in zip(jax.tree.leaves(model), jax.tree.leaves(first))]  # noqa: B905
            if jax.tree.structure(model) != structure or not all(shapes):
                raise ValueError(
                    f"models[{c}][{i}]: is built otherwise than the first; write one function and bind its parameters"
                )
    return rows


def _check_noise(models, rank):
    n = models[0][0].m0.shape[0]
    if rank is not None:
        core_check_count("noise_rank", rank, 1)
        if rank > n:
            raise ValueError(f"noise_rank: expected 1 to {n}, got {rank}")
    for row in models:
        for model in row:
            if callable(model.Q) or not is_concrete(model.Q):
                continue
            if not np.asarray(model.Q).any():
                warnings.warn("Q: is zero, so particles that are drawn again stay copies of each other", stacklevel=3)
            elif rank is not None and np.asarray(chol(model.Q))[:, rank:].any():
                raise ValueError(f"noise_rank: Q needs more than {rank} numbers")


def _classes(counts, N):
    """The class (N,) of each place, for particles sorted by class."""
    ends = jnp.cumsum(counts)[:-1]
    return jnp.sum(jnp.arange(N, dtype=jnp.int32)[None, :] >= ends[:, None], axis=0, dtype=jnp.int32)


def _members(classes, s):
    return classes[None, :] == jnp.arange(s, dtype=jnp.int32)[:, None]


def _tables(p):
    """The models' own parts (f, Q) with their leaves stacked over all classes and modes, (s * M, ...)."""
    parts = [(model.f, model.Q) for row in p.models for model in row]
    return stack(parts, p.models[0][0].m0.dtype)


def _init(p, inp):
    options = p.options.value
    N, s, M = options.count, options.classes, options.modes
    m0 = p.models[0][0].m0
    dtype = m0.dtype
    counts = jnp.full((s,), N // s, jnp.int32)
    classes = _classes(counts, N)
    if p.start is None:
        mean = jnp.stack([row[0].m0 for row in p.models])
        factor = jnp.stack([chol(row[0].P0) for row in p.models])
        noise = jax.random.normal(step_key(inp, 0), (N, len(m0)), dtype)
        blocks = jnp.einsum("cij,clj->cli", factor, noise.reshape(s, N // s, -1)) + mean[:, None, :]
        particles = blocks.reshape(N, -1)
    else:
        particles = p.start(step_key(inp, 0), classes, inp)
        if particles.shape != (N, len(m0)):
            raise ValueError(f"start: expected draws of shape {(N, len(m0))}, got {particles.shape}")
    check_measurement(inp, p.models[0][0].h(particles[0], inp.u, inp.dt).shape[0], "the model's h")
    modes = jnp.zeros((N,), jnp.int32)
    if M > 1:
        cumulated = jnp.cumsum(jnp.exp(_log_probabilities(p.mode_prior, dtype)))
        u = jax.random.uniform(step_key(inp, 1), (N,), dtype)
        modes = jnp.sum(u[None, :] >= cumulated[:-1, None], axis=0, dtype=jnp.int32)
    log_weights = jnp.full((N,), -np.log(N // s), dtype)
    means = particles.reshape(s, N // s, -1).mean(axis=1)
    return JointState(particles.T, modes, log_weights, _log_probabilities(p.prior, dtype), counts, means)


def allocate(log_classes: Array, count: int, floor: Any) -> Array:
    """Particles (s,) int32 of each class: in proportion, at least ``floor`` of an equal share, ``count`` in all.

    Classes below the least share get it; the others share the rest by largest remainder.
    """
    log_classes = jax.lax.stop_gradient(log_classes)
    s, dtype = log_classes.shape[0], log_classes.dtype
    if s == 1:
        return jnp.full((1,), count, jnp.int32)
    p = jnp.exp(log_classes - log_classes.max())
    least = jnp.floor(jnp.asarray(floor, dtype) * (count / s) * (1 + 1e-6))
    pinned = jnp.zeros((s,), bool)
    share, rest = p, jnp.asarray(count, dtype)
    for _ in range(s):
        free = jnp.where(pinned, 0.0, p)
        rest = count - least * pinned.sum(dtype=dtype)
        share = rest * (free / free.sum())
        pinned = pinned | ((share < least) & (p < 1))  # the most probable class, where p = 1, is never pinned
    free = jnp.where(pinned, 0.0, p)
    rest = count - least * pinned.sum(dtype=dtype)
    share = jnp.where(pinned, 0.0, rest * (free / free.sum()))
    whole = jnp.floor(share)
    part = jnp.where(pinned, -1.0, share - whole)
    order = jnp.arange(s)
    before = (part[None, :] > part[:, None]) | ((part[None, :] == part[:, None]) & (order[None, :] < order[:, None]))
    more = before.sum(axis=1, dtype=dtype) < rest - whole.sum()
    return (jnp.where(pinned, least, whole) + more.astype(dtype)).astype(jnp.int32)


def class_ancestors(weights: Array, counts: Array, wanted: Array, u: Array, scheme: str) -> Array:
    """Indices (N,) int32 of the particles drawn within each class, for particles sorted by class; ascending by class.

    Args:
        weights: (N,) normalized within each class.
        counts: (s,) how many particles each class has.
        wanted: (s,) how many it gets.
        u: uniform numbers in [0, 1), (s,) for ``"systematic"``, else (N,).
        scheme: ``"systematic"``, ``"stratified"`` or ``"multinomial"``.
    """
    N, dtype = weights.shape[0], weights.dtype
    classes = _classes(counts, N)
    cumulated = jax.lax.associative_scan(jnp.add, weights)
    ends = cumulated[jnp.cumsum(counts) - 1]
    begins = jnp.concatenate([jnp.zeros((1,), dtype), ends[:-1]])
    # Each class runs from 0 to exactly 1, so that rounding carries nobody across the border.
    within = jnp.clip((cumulated - begins[classes]) / (ends - begins)[classes], 0, 1)
    if scheme == "multinomial":
        new = _classes(wanted, N)
        points = new.astype(dtype) + u
        at = jnp.searchsorted(within + classes.astype(dtype), points, side="right").astype(jnp.int32)
        last = jnp.cumsum(counts)
        return jnp.clip(at, (last - counts)[new], (last - 1)[new])
    # Points are sorted: instead of seeking each point's particle, count the points before each particle's end.
    share = wanted.astype(dtype)[classes]
    first = (jnp.cumsum(wanted) - wanted)[classes]
    place = share * within
    if scheme == "systematic":
        before = jnp.ceil(place - u[classes])
    else:
        whole = jnp.floor(place)
        slot = jnp.minimum(first + whole.astype(jnp.int32), N - 1)
        before = whole + (u[slot] < place - whole).astype(dtype)
    before = first + jnp.clip(before, 0, share).astype(jnp.int32)
    ended = jnp.zeros((N + 1,), jnp.int32).at[before].add(1, mode="promise_in_bounds", indices_are_sorted=True)
    return jax.lax.associative_scan(jnp.add, ended)[:N]


class _Draws(NamedTuple):
    """All that is random in a step."""

    ancestors: Array  # (s,) or (N,) uniform
    modes: Array | None  # (N,) uniform
    noise: Array  # (N, r) normal


def _draws(p, inp):
    options, m0 = p.options.value, p.models[0][0].m0
    N, rank = options.count, options.noise_rank or len(m0)
    modes = jax.random.uniform(step_key(inp, 2), (N,), m0.dtype) if options.modes > 1 else None
    which = options.classes if options.scheme == "systematic" else N
    ancestors = jax.random.uniform(step_key(inp, 0), (which,), m0.dtype)
    return _Draws(ancestors, modes, jax.random.normal(step_key(inp, 1), (N, rank), m0.dtype))


def _predict(p, state, inp):
    state = _move(p, state, inp, _draws(p, inp))
    return state, Prediction(*_moments(p, state))


def _low(p, ess, counts):
    """Whether a class's effective sample size calls for resampling."""
    return is_low(ess, p.threshold, counts.astype(ess.dtype)).any()


def _ess(weights, members):
    return 1 / jnp.sum(jnp.where(members, (weights * weights)[None, :], 0.0), axis=1)


def _resample(p, state, u):
    options = p.options.value
    N, s = options.count, options.classes
    weights = jnp.exp(jax.lax.stop_gradient(state.log_weights))
    low = _low(p, _ess(weights, _members(_classes(state.counts, N), s)), state.counts)
    wanted = allocate(state.log_classes, N, p.floor)
    index = class_ancestors(weights, state.counts, wanted, u, options.scheme)
    index = jnp.where(low, index, jnp.arange(N, dtype=jnp.int32))
    counts = jnp.where(low, wanted, state.counts)
    equal = -jnp.log(wanted.astype(weights.dtype))[_classes(wanted, N)]
    if options.score_gradient:
        equal = equal + score_correction(state.log_weights, index)
    log_weights = jnp.where(low, equal, state.log_weights)
    return state._replace(
        particles=state.particles[:, index], modes=state.modes[index], log_weights=log_weights, counts=counts
    )


def _move(p, state, inp, draws):
    """Resampling if due, then modes and states of the next step."""
    options = p.options.value
    N, s, M = options.count, options.classes, options.modes
    state = _resample(p, state, draws.ancestors)
    classes = _classes(state.counts, N)
    modes, log_weights = state.modes, state.log_weights
    if M > 1:
        modes, log_weights = _switch(p, classes, modes, log_weights, draws.modes)
    (f, Q), at, axis = _tables(p), classes * M + modes, -1
    if s * M == 1:
        (f, Q), axis = jax.tree.map(lambda leaf: leaf[0], (f, Q)), None
        f_own, Q_own = f, Q
    else:
        f_own, Q_own = _own((f, Q if callable(Q) else None), at)
    moved = jax.vmap(lambda f, x: f(x, inp.u, inp.dt), (axis, -1), -1)(f_own, state.particles)
    rank = draws.noise.shape[1]

    def factor(Q, x=None):
        return chol(scale_cov(covariance(Q, x, inp.u, inp.dt), inp.q_scale))[:, :rank]  # pyright: ignore[reportArgumentType]

    if callable(Q):
        spread = jax.vmap(factor, (axis, -1), -1)(Q_own, state.particles)
    elif axis is None:
        spread = factor(Q)
    else:
        spread = _own(jax.vmap(factor)(Q), at)
    noise = draws.noise.T
    noise = spread @ noise if spread.ndim == 2 else jnp.sum(spread * noise[None, :, :], axis=1)
    return state._replace(particles=moved + noise, modes=modes, log_weights=log_weights)


def _own(tables, at):
    """Each particle's entry of tables (s * M, ...), along the last axis (..., N)."""
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1)[..., at], tables)


def _switch(p, classes, modes, log_weights, u):
    """Draws the next modes; their score goes into the weights with value 0."""
    options = p.options.value
    s, M, dtype = options.classes, options.modes, log_weights.dtype
    log_pi = jnp.broadcast_to(_log_probabilities(p.transition, dtype), (s, M, M)).reshape(s * M, M)
    cumulated = jnp.cumsum(jnp.exp(jax.lax.stop_gradient(log_pi)), axis=1)
    at = classes * M + modes
    drawn = sum((u >= cumulated[:, j][at]).astype(jnp.int32) for j in range(M - 1))
    if options.score_gradient:
        log_weights = log_weights + score_correction(log_pi.reshape(-1), at * M + drawn)
    return drawn, log_weights


def _update(p, state, inp):
    options, first = p.options.value, p.models[0][0]
    N, s, M = options.count, options.classes, options.modes
    check_dtype(inp, state.particles)
    dtype = state.particles.dtype
    classes = _classes(state.counts, N)
    members = _members(classes, s)
    finite = jnp.isfinite(inp.y)
    usable = finite if inp.mask is None else inp.mask & finite
    told = usable.any()

    predicted, log_lik, singular = _log_likelihood(first, state.particles, inp, usable)
    if p.score is not None and options.score_at == "particle":
        log_lik = log_lik + jax.vmap(p.score, (-1, 0))(state.particles, classes)
    elif p.score is not None:
        log_lik = log_lik + jax.vmap(p.score)(state.means, jnp.arange(s, dtype=jnp.int32))[classes]
    joint = state.log_weights + log_lik
    good = jnp.isfinite(joint) & told
    alive = good.any() & told
    # Class by class, less the largest first: another class may be beyond the range of exp.
    largest = jnp.where(members & good[None, :], jax.lax.stop_gradient(joint)[None, :], -np.inf).max(axis=1)
    met = jnp.isfinite(largest)
    shift = jnp.where(met, largest, 0.0)
    relative = jnp.where(good, joint - shift[classes], _FLOOR)
    weights = jnp.where(good, jnp.exp(relative), 0.0)
    total = jnp.sum(jnp.where(members, weights[None, :], 0.0), axis=1)
    log_total = jnp.log(jnp.where(met, total, 1.0))
    # A class without a finite likelihood keeps its weights, and falls as low as a class can.
    log_weights = jnp.maximum(relative - log_total[classes], _FLOOR)
    log_weights = jnp.where(met[classes], log_weights, state.log_weights)
    evidence = jnp.where(met, shift + log_total, 0.0)
    evidence = state.log_classes + jnp.where(met, evidence, jnp.where(met, evidence, np.inf).min() + _FLOOR)
    total_log_lik = jax.nn.logsumexp(jnp.where(alive, evidence, state.log_classes))
    log_classes = jnp.where(alive, jnp.maximum(evidence - total_log_lik, _FLOOR), state.log_classes)
    # As of the plain particle filter: a step that no particle explains.
    lost = told & ~alive
    total_log_lik = jnp.where(alive, total_log_lik, jnp.where(lost, float(jnp.finfo(dtype).min) / 8, 0.0))

    weights = jnp.exp(log_weights)
    ess = _ess(weights, members)
    status = (
        singular | flag(lost, Status.NONFINITE) | flag(_low(p, ess, state.counts) | (ess < 2).any(), Status.LOW_ESS)
    )
    bad = ~finite if inp.mask is None else ~finite & inp.mask
    status = status | flag(bad.any(), Status.NONFINITE)
    if inp.mask is not None:
        status = status | flag(~inp.mask.any(), Status.MISSED)
    own = jnp.where(members, weights[None, :], 0.0)  # (s, N)
    means = own @ state.particles.T
    after = state._replace(log_weights=log_weights, log_classes=log_classes, means=means)
    mean, cov = _moments(p, after)
    share = weights * jnp.exp(log_classes)[classes]
    of_mode = state.modes[None, :] == jnp.arange(M, dtype=jnp.int32)[:, None]
    extra: dict[str, Any] = {
        "log_probabilities": log_classes,
        "means": means,
        "mode_probabilities": jnp.sum(jnp.where(of_mode, share[None, :], 0.0), axis=1),
        "ess": ess,
        "counts": state.counts,
    }
    if options.keep:
        joint = log_weights + log_classes[classes]
        extra |= {"particles": state.particles.T, "classes": classes, "modes": state.modes, "log_weights": joint}
    nu, S, nis, R = _innovation(first, state, predicted, classes, inp, usable)
    return after, Info(mean, cov, nu, S, nis, total_log_lik, status, noise_cov=R, extra=extra)


def _log_likelihood(model, particles, inp, usable):
    """Predicted measurements (m, N), log p(y | x) (N,) over the usable components, and the status."""
    predicted = jax.vmap(lambda x: model.h(x, inp.u, inp.dt), -1, -1)(particles)
    difference = jax.vmap(_difference, (None, None, -1, None), -1)(model, inp.y, predicted, usable)

    def one(x, nu):
        R = scale_cov(covariance(model.R, x, inp.u, inp.dt), inp.r_scale)
        L = chol(decoupled(usable, R))
        _, log_lik, status = likelihood(usable, L, solve_lower(L, nu))
        return log_lik, status

    log_lik, status = jax.vmap(one, -1)(particles, difference)
    return predicted, log_lik, status.max()


def _difference(model, y, at, usable):
    y = jnp.where(usable, y, at)
    return jnp.where(usable, y - at if model.residual is None else model.residual(y, at), jnp.zeros_like(at))


def _innovation(model, state, predicted, classes, inp, usable):
    """Innovation, its covariance and NIS by the moments of the predicted measurement; R at the predicted mean."""
    log_weights = state.log_weights + state.log_classes[classes]
    log_weights = log_weights - jax.nn.logsumexp(log_weights)
    centre = predicted[:, 0]  # about one of them, since angles are not averaged as they are
    apart = predicted - centre[:, None]
    if model.residual is not None:
        apart = jax.vmap(model.residual, (-1, None), -1)(predicted, centre)
    shift, spread = _weighted(jnp.exp(log_weights), apart)
    mean = state.particles @ jnp.exp(log_weights)
    R = scale_cov(covariance(model.R, mean, inp.u, inp.dt), inp.r_scale)
    S = sym(spread + R)
    nu = _difference(model, inp.y, centre + shift, usable)
    L = chol(decoupled(usable, S))
    nis, _, _ = likelihood(usable, L, solve_lower(L, nu))
    return nu, S, nis, R


def _weighted(weights, x):
    """Mean and covariance of columns x (n, N)."""
    mean = x @ weights
    apart = x - mean[:, None]
    return mean, sym((weights[None, :] * apart) @ apart.T)


def _moments(p, state):
    N = p.options.value.count
    joint = state.log_weights + state.log_classes[_classes(state.counts, N)]
    return _weighted(jnp.exp(joint - jax.nn.logsumexp(joint)), state.particles)
