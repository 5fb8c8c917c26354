"""The filter protocol: one shape for all filters, one way to run them.

A filter is a pytree of pure functions bound to their parameters (:class:`Filter`). It crosses ``jit``, ``vmap`` and
``grad`` as an ordinary argument, and nothing recompiles when its parameters change.

Step ``k`` predicts from ``k-1`` to ``k`` with ``dt[k]`` and ``u[k]``, then updates with ``y[k]``. The state holds the
posterior; ``init`` gives the state before the first prediction.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from jaxfilt import checkpointed, describe
from jaxfilt.linalg import entries, scalar_scan, structure

PyTree = Any
_FEW = 8  # runs below which matrices are as fast as scalars


class Status(enum.IntFlag):
    """What happened in a step, as bits of ``Info.status``. Nothing can raise under ``jit``: trouble travels as data."""

    MISSED = 1  # no component of the sample was present
    GATED = 2  # the sample was refused by a gate
    SINGULAR = 4  # the innovation covariance is singular to working precision
    NONFINITE = 8  # an unmasked NaN or infinite input (its innovation is ignored), or a non-finite estimate
    BOUND = 16  # a bound was violated and the value capped (negative dt, infeasible theta, ...)
    LOW_ESS = 32  # the effective sample size fell below its threshold
    PSEUDO = 64  # a pseudo-measurement stood in for a missing one


class StepInput(NamedTuple):
    """Everything a step may look at. ``None`` is static absence; in :func:`scan` every leaf has a leading T."""

    y: Array  # (m,) measurement
    mask: Array | None = None  # (m,) bool, True = present; None = all present
    dt: Array | None = None  # () interval from k-1 to k; None = the model's own
    u: PyTree = None  # whatever the model functions need on the interval that ends at k
    key: Array | None = None  # one random key per step
    q_scale: Array | None = None  # () or (n,): Q -> D Q D with D = diag(sqrt(q_scale))
    r_scale: Array | None = None  # () or (m,): R alike


class Prediction(NamedTuple):
    """Moments of p(x_k | y_1..k-1), and the cross-covariance that a smoother needs."""

    mean: Array  # (n,)
    cov: Array | None = None  # (n, n)
    cross: Array | None = None  # (n, n) Cov(x_{k-1}, x_k | y_1..k-1)

    def __repr__(self) -> str:
        """Shapes."""
        return describe.fields(self)


class Info(NamedTuple):
    """What one may want to look at after a step. A quantity that a filter does not define is None, never NaN or 0."""

    mean: Array  # (n,) posterior mean
    cov: Array | None  # (n, n) posterior covariance
    innovation: Array  # (m,), exactly 0 where absent
    innovation_cov: Array | None  # (m, m) full S, absent components included
    nis: Array | None  # () normalised innovation squared over the present components
    log_lik: Array | None  # () over the present components; exactly 0 for a missed step
    status: Array  # () int32, bits of Status
    noise_cov: Array | None = None  # (m, m) the R really used (scaled)
    prediction: Prediction | None = None  # filled in by step, never by a filter
    extra: dict[str, PyTree] = {}  # the filter's own outputs; wrappers add keys  # noqa: RUF012

    def __repr__(self) -> str:
        """Shapes, how often each status bit is set, and the sum of the log-likelihood."""
        return describe.info(self, Status)


class Filter(NamedTuple):
    """A recursive estimator; each field is a ``jax.tree_util.Partial`` of a module-level function (:func:`bind`)."""

    init: Callable[[StepInput], PyTree]  # first input (shapes, dtype, key) -> state before the first prediction
    predict: Callable[[PyTree, StepInput], tuple[PyTree, Prediction]]
    update: Callable[[PyTree, StepInput], tuple[PyTree, Info]]
    moments: Callable[[PyTree], tuple[Array, Array]] | None = None  # state -> (mean, cov)
    with_moments: Callable[[PyTree, Array, Array], PyTree] | None = None  # state with its moments replaced

    def __repr__(self) -> str:
        """Where it is defined, and its parameters: numbers, or shapes."""
        return describe.filter_fields(self)


@jax.tree_util.register_static
@dataclass(frozen=True)
class Static:
    """A static option in a filter's parameters: no leaf, and compared by value so that a rebuild does not retrace."""

    value: Any


def aspartial(fn: Callable, name: str = "fn") -> Partial:
    """Makes a function a valid pytree; a ``Partial`` stays as it is, so that its bound values remain leaves.

    Raises:
        TypeError: for what is no function; it names the argument.
    """
    check_callable(name, fn)
    return fn if isinstance(fn, Partial) else Partial(fn)


def bind(
    params: PyTree,
    init: Callable,
    predict: Callable,
    update: Callable,
    moments: Callable | None = None,
    with_moments: Callable | None = None,
) -> Filter:
    """Makes a :class:`Filter` of module-level functions whose first argument is ``params``."""
    functions = (init, predict, update, moments, with_moments)
    return Filter(*(None if fn is None else Partial(fn, params) for fn in functions))  # pyright: ignore[reportArgumentType]


class Wrapped(NamedTuple):
    """State of a wrapper: the inner filter's state and the wrapper's own memory."""

    inner: PyTree
    memory: PyTree = ()


def wrap(
    params: PyTree,
    *,
    init: Callable | None = None,
    predict: Callable | None = None,
    update: Callable | None = None,
) -> Filter:
    """Makes a wrapper ``Filter -> Filter``; what is not given passes through to ``params.inner``.

    Args:
        params: a NamedTuple with a field ``inner`` (the wrapped filter) and the wrapper's own parameters.
        init: ``(params, inp) -> Wrapped``.
        predict: ``(params, Wrapped, inp) -> (Wrapped, Prediction)``.
        update: ``(params, Wrapped, inp) -> (Wrapped, Info)``.
    """
    inner: Filter = params.inner
    check_filter(inner)
    return bind(
        params,
        init or _wrapped_init,
        predict or _wrapped_predict,
        update or _wrapped_update,
        None if inner.moments is None else _wrapped_moments,
        None if inner.with_moments is None else _wrapped_with_moments,
    )


def _wrapped_init(p, inp):
    return Wrapped(p.inner.init(inp))


def _wrapped_predict(p, s, inp):
    inner, prediction = p.inner.predict(s.inner, inp)
    return s._replace(inner=inner), prediction


def _wrapped_update(p, s, inp):
    inner, info = p.inner.update(s.inner, inp)
    return s._replace(inner=inner), info


def _wrapped_moments(p, s):
    return p.inner.moments(s.inner)


def _wrapped_with_moments(p, s, mean, cov):
    return s._replace(inner=p.inner.with_moments(s.inner, mean, cov))


def flag(condition: Array, bit: Status) -> Array:
    """The status word () int32 with ``bit`` set where ``condition`` holds; combine words with ``|``."""
    return jnp.where(condition, jnp.int32(int(bit)), jnp.int32(0))


def present(inp: StepInput) -> Array:
    """The mask (m,) bool of a step, all true where none was given."""
    return jnp.ones(inp.y.shape, bool) if inp.mask is None else inp.mask


def multiply(scale: Array | None, factor: Any) -> Array:
    """Multiplies a noise scale of a :class:`StepInput` (never replaces it, so that wrappers nest)."""
    return factor if scale is None else scale * factor


def summary(state: PyTree, info: Info) -> Info:
    """The default ``outputs`` of :func:`filter`: all of Info but the prediction."""
    del state
    return info._replace(prediction=None)


def everything(state: PyTree, info: Info) -> Info:
    """``outputs`` for smoothing: Info with the prediction kept."""
    del state
    return info


def log_lik(state: PyTree, info: Info) -> Array | None:
    """``outputs`` that are the log-likelihood alone."""
    del state
    return info.log_lik


def packed(state: PyTree, info: Info) -> tuple[Array, Array]:
    """``outputs`` for large batches: the mean (n,) and the covariance's lower triangle (n (n + 1) / 2,) row by row.

    :func:`unpack` makes it a matrix again.
    """
    del state
    if info.cov is None:
        raise ValueError("outputs: the filter reports no covariance that could be packed")
    return info.mean, info.cov[np.tril_indices(info.cov.shape[0])]


def unpack(triangle: Array) -> Array:
    """Symmetric matrices (..., n, n) from their lower triangles (..., n (n + 1) / 2)."""
    triangle = real_array("triangle", triangle)
    n = int(np.sqrt(2 * triangle.shape[-1]))
    if n * (n + 1) // 2 != triangle.shape[-1]:
        raise ValueError(f"triangle: expected n (n + 1) / 2 entries, got {triangle.shape[-1]}")
    index = np.zeros((n, n), int)
    index[np.tril_indices(n)] = np.arange(triangle.shape[-1])
    return triangle[..., np.maximum(index, index.T)]


def step(filt: Filter, state: PyTree, inp: StepInput) -> tuple[PyTree, Info]:
    """One predict-update step: ``(state, inp) -> (state, info)``, with the prediction filled into ``info``."""
    check_filter(filt)
    if not isinstance(inp, StepInput):
        raise TypeError(f"inp: expected a StepInput, got {type(inp).__name__}")
    return _step(filt, state, inp, None)


def scan(
    filt: Filter,
    state: PyTree,
    inputs: StepInput,
    *,
    outputs: Callable[[PyTree, Info], PyTree] = summary,
    keep: str = "stack",
    segment: int | None = None,
    first_update_only: bool = False,
) -> tuple[PyTree, PyTree]:
    """Runs a filter over stacked inputs from a given state and returns the final state too (streaming, chunks).

    Args:
        filt: the filter.
        state: from ``filt.init(inp)`` or from an earlier ``scan``.
        inputs: as made by :func:`inputs`; every leaf has a leading T. Keys, if needed, are one per step.
        outputs: ``(state, info) -> pytree``. Give it a name: a lambda made anew retraces.
        keep: as in :func:`filter`.
        segment: as in :func:`filter`.
        first_update_only: takes ``state`` as the prior on the first sample (no prediction before it).

    Returns:
        The state after the last step, and the outputs.
    """
    check_filter(filt)
    if not isinstance(inputs, StepInput):
        raise TypeError(f"inputs: expected a stacked StepInput, got {type(inputs).__name__}")
    segment = _check_options(outputs, keep, segment, first_update_only, inputs)
    return _scan(filt, state, inputs, outputs, keep, segment, first_update_only)


def filter(
    filt: Filter,
    ys: Any,
    *,
    mask: Any = None,
    dt: Any = None,
    u: PyTree = None,
    key: Array | None = None,
    q_scale: Any = None,
    r_scale: Any = None,
    outputs: Callable[[PyTree, Info], PyTree] = summary,
    keep: str = "stack",
    segment: int | None = None,
    first_update_only: bool = False,
    form: str = "auto",
) -> Any:
    """Filters one series: ``init``, then a ``lax.scan`` over time. Batch it with ``jax.vmap``.

    Compiled inside, once per filter structure and shape: new parameters or data do not recompile.

    Args:
        filt: the filter.
        ys: (T, m) measurements, in the model's float dtype.
        mask: (T, m) or (T,) bool, True = present. None = all present. NaN means missing only when you say so, with
            ``ys, mask = jf.mask_nan(ys)``.
        dt: (T,) or scalar intervals, ``dt[k]`` from sample k-1 to k. None = the model's own.
        u: pytree with leading T for the model functions; ``u[k]`` belongs to the interval that ends at k.
        key: random key, for filters that draw. Under ``vmap`` over ``ys`` give each run its own.
        q_scale: factor on Q, scalar, (T,) or (T, n).
        r_scale: factor on R, scalar, (T,) or (T, m).
        outputs: ``(state, info) -> pytree`` inside the scan: :func:`summary`, :func:`everything`, :func:`log_lik`,
            :func:`packed`, or your own. What it does not use is not computed.
        keep: of the outputs over time, ``"stack"`` all, their ``"sum"`` (of a status the union of the bits), or the
            ``"last"``: a likelihood or a final state then costs no history.
        segment: for gradients over long series: the reverse pass keeps the state every ``segment`` steps only and
            computes those between again. About sqrt(T) needs the least memory (T = 1e5: 3 in place of 126 MB, for 1.3
            times the time).
        first_update_only: takes the model's m0, P0 as the prior on the first sample.
        form: ``"dense"`` computes with matrices; ``"scalar"`` with their entries one by one, which for small systems
            in large batches is many times faster on CPUs (:mod:`jaxfilt.linalg.scalarize`). ``"auto"``: scalar under a
            ``vmap`` over 8 or more runs, if the step is small enough and has a scalar form. Matrix entries that are 0
            or equal cost nothing if that can be seen: by value where the filter is built outside ``jit``, and of what
            the motion models build inside; :func:`jaxfilt.batch` sees it of the filters and models it is given.

    Returns:
        The outputs, stacked; with :func:`summary` an :class:`Info` with leading T: ``mean (T, n)``, ``cov (T, n, n)``,
        ``innovation (T, m)``, ``innovation_cov (T, m, m)``, ``nis (T,)``, ``log_lik (T,)``, ``status (T,)``.

    Raises:
        ValueError: wrong shapes, T = 0, negative dt, or (concrete arrays only) a NaN or infinite value that no mask
            covers. Under a transformation such a value sets ``Status.NONFINITE`` and its innovation is ignored.
        ValueError: ``form="scalar"`` for a step that has none; says why.
        TypeError: integer arrays, or another float dtype than the model's.
    """
    check_filter(filt)
    stacked = inputs(ys, mask=mask, dt=dt, u=u, key=key, q_scale=q_scale, r_scale=r_scale)
    if form not in ("auto", "dense", "scalar"):
        raise ValueError(f'form: expected "auto", "dense" or "scalar", got {form!r}')
    scalar = form == "scalar" or (form == "auto" and _runs((filt, stacked)) >= _FEW)
    segment = _check_options(outputs, keep, segment, first_update_only, stacked)
    labels = structure.of(filt) if scalar else None
    return _filter(filt, stacked, key, outputs, keep, segment, first_update_only, form, labels)


def mask_nan(ys: Any) -> tuple[Array, Array]:
    """Turns NaN into masked samples: returns ``ys`` with zeros in their place, and the mask (True = present)."""
    if is_concrete(ys):
        numbers("ys", ys)
    ys = jnp.asarray(ys)
    mask = ~jnp.isnan(ys)
    return jnp.where(mask, ys, jnp.zeros((), ys.dtype)), mask


def intervals(times: Any, *, first: float) -> Array:
    """Intervals ``dt (T,)`` of increasing time stamps (T,); ``first`` is the one before the first sample.

    Whole numbers give floats of JAX's default dtype. Concrete time stamps are subtracted in float64: in float32 seconds
    since 1970 come in steps of 128.

    Raises:
        ValueError: if the (concrete) time stamps do not increase.
    """
    for name, x, shape in (("times", times, "(T,)"), ("first", first, "()")):
        if is_concrete(x) and numbers(name, x).ndim != len(shape) // 4:
            raise ValueError(f"{name}: expected shape {shape}, got {np.shape(x)}")
    if is_concrete(times):
        times = np.asarray(times)
        stamps = times.astype(np.float64)
        increases = stamps[1:] > stamps[:-1]  # false for NaN too
        if not increases.all():
            k = int(np.argmin(increases)) + 1
            raise ValueError(f"times: must increase, but times[{k}] <= times[{k - 1}]")
        differences = np.diff(stamps)
    else:
        differences = jnp.diff(times)
    dtype = jax.dtypes.canonicalize_dtype(times.dtype if jnp.issubdtype(times.dtype, jnp.floating) else float)
    return jnp.concatenate([jnp.full((1,), first, dtype), jnp.asarray(differences, dtype)])


def inputs(
    ys: Any,
    *,
    mask: Any = None,
    dt: Any = None,
    u: PyTree = None,
    key: Array | None = None,
    q_scale: Any = None,
    r_scale: Any = None,
) -> StepInput:
    """Checks a series and stacks it as the :class:`StepInput` that :func:`scan` takes; arguments as in :func:`filter`.

    With a ``key``, step k gets ``fold_in(key, k + 1)``; ``fold_in(key, 0)`` is left for ``init``.
    """
    check_float("ys", ys)
    concrete = ys
    ys = jnp.asarray(ys)
    if ys.ndim != 2:
        raise ValueError(f"ys: expected shape (T, m), got {ys.shape}; batch with jax.vmap")
    T, m = ys.shape
    if T == 0 or m == 0:
        raise ValueError(f"ys: expected at least one sample of at least one component, got shape {ys.shape}")
    if mask is not None:
        if getattr(mask, "dtype", np.asarray(mask).dtype if is_concrete(mask) else None) != np.dtype(bool):
            raise TypeError(f"mask: expected bool, got {getattr(mask, 'dtype', type(mask).__name__)}")
        mask = jnp.asarray(mask)
        if mask.shape not in {(T,), (T, m)}:
            raise ValueError(f"mask: expected shape ({T},) or ({T}, {m}), got {mask.shape}")
        mask = jnp.broadcast_to(mask.reshape(T, -1), (T, m))
    _check_finite(concrete, mask)
    if dt is not None:
        dt = _per_step("dt", dt, T, ys.dtype, ranks=(1,))
        if is_concrete(dt) and not (good := np.isfinite(dt) & (np.asarray(dt) >= 0)).all():
            k = int(np.argmin(good))
            raise ValueError(f"dt: expected finite intervals >= 0, got dt[{k}] = {float(dt[k])}")
    for leaf in jax.tree.leaves(u):
        if not hasattr(leaf, "dtype"):
            numbers("u", leaf)
        _check_same_dtype("u", leaf, ys.dtype)
        if jnp.shape(leaf)[:1] != (T,):
            raise ValueError(f"u: expected leaves with leading T = {T}, got shape {jnp.shape(leaf)}")
    if q_scale is not None:
        q_scale = _per_step("q_scale", q_scale, T, ys.dtype, ranks=(1, 2))
    if r_scale is not None:
        r_scale = _per_step("r_scale", r_scale, T, ys.dtype, ranks=(1, 2))
    if key is not None:
        check_key(key)
    for name, scale in (("q_scale", q_scale), ("r_scale", r_scale)):
        if scale is not None and is_concrete(scale) and not (np.isfinite(scale) & (np.asarray(scale) >= 0)).all():
            raise ValueError(f"{name}: expected finite factors >= 0, got {np.asarray(scale)}")
    keys = None if key is None else jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(1, T + 1))
    return StepInput(ys, mask, dt, jax.tree.map(jnp.asarray, u), keys, q_scale, r_scale)


@partial(jax.jit, static_argnames=("outputs", "keep", "segment", "first_update_only", "form", "labels"))
def _filter(filt, stacked, key, outputs, keep, segment, first_update_only, form, labels):
    if labels is not None and key is None:
        step = partial(_step_of, outputs=outputs)
        xs = stacked, _is_first(stacked, first_update_only)
        try:
            limit = scalar_scan.MOST if form == "scalar" else scalar_scan.WORTHWHILE
            return scalar_scan.scan(_checked_init, step, filt, xs, labels, keep=keep, limit=limit, segment=segment)
        except entries.NoScalarForm as reason:
            if form == "scalar":
                raise ValueError(f'form: "scalar" is not possible here: {reason}') from None
    elif form == "scalar":
        raise ValueError('form: "scalar" is not possible for a filter that draws random numbers')
    first = jax.tree.map(lambda leaf: leaf[0], stacked)
    if key is not None:
        first = first._replace(key=jax.random.fold_in(key, 0))
    state = _checked_init(filt, (first, None))
    return _scan(filt, state, stacked, outputs, keep, segment, first_update_only)[1]


def _checked_init(filt, x):
    first, _ = x
    state = filt.init(first)
    for leaf in jax.tree.leaves(state):
        if jnp.issubdtype(leaf.dtype, jnp.floating) and leaf.dtype != first.y.dtype:
            raise TypeError(f"ys: is {first.y.dtype}, but the filter's model is {leaf.dtype}; convert one of them")
    return state


@partial(jax.jit, static_argnames=("outputs", "keep", "segment", "first_update_only"))
def _scan(filt, state, stacked, outputs, keep, segment, first_update_only):
    body = partial(_step_of, filt, outputs=outputs)
    return scalar_scan.collect(body, state, (stacked, _is_first(stacked, first_update_only)), keep, segment)


def _step_of(filt, state, x, outputs):
    inp, is_first = x
    state, info = _step(filt, state, inp, is_first)
    return state, outputs(state, info)


def _is_first(stacked, first_update_only):
    # The step's index is shared by all runs of a batch, so the `where` it decides costs nothing under vmap.
    return jnp.arange(stacked.y.shape[0]) == 0 if first_update_only else None


def _check_options(outputs, keep, segment, first_update_only, stacked):
    check_callable("outputs", outputs)
    check_flag("first_update_only", first_update_only)
    if keep not in ("stack", "sum", "last"):
        raise ValueError(f'keep: expected "stack", "sum" or "last", got {keep!r}')
    return None if segment is None else checkpointed.check_segment(segment, stacked.y.shape[0])


def _runs(tree):
    """How many runs ``vmap`` computes at once here."""
    return max((size for leaf in jax.tree.leaves(tree) for size in entries.batch_sizes(leaf)), default=1)


def _step(filt, state, inp, skip_prediction):
    with jax.default_matmul_precision("highest"):  # accelerators would otherwise round covariances to TF32 or bfloat16
        status = jnp.int32(0)
        if inp.dt is not None:  # refused at the border when concrete; here it can only be flagged
            valid = inp.dt >= 0  # false for NaN too
            inp = inp._replace(dt=jnp.where(valid, inp.dt, jnp.zeros((), inp.dt.dtype)))
            status = flag(~valid, Status.BOUND)
        predicted, prediction = filt.predict(state, inp)
        if skip_prediction is not None:
            predicted = jax.tree.map(lambda a, b: jnp.where(skip_prediction, a, b), state, predicted)
            if filt.moments is not None:
                mean, cov = filt.moments(state)
                prior = Prediction(mean, cov, prediction.cross)
                prediction = jax.tree.map(lambda a, b: jnp.where(skip_prediction, a, b), prior, prediction)
        state, info = filt.update(predicted, inp)
        numbers = (info.mean, info.log_lik, None if info.cov is None else jnp.diagonal(info.cov))
        finite = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(numbers)]).all()
        status = info.status | status | flag(~finite, Status.NONFINITE)
        return state, info._replace(prediction=prediction, status=status)


def is_concrete(x: Any) -> bool:
    """Whether the value of ``x`` can be looked at: false for what a transformation traces."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(x))


def check_filter(filt: Any, name: str = "filt") -> None:
    """Raises a TypeError that names the argument if it is no filter."""
    if not isinstance(filt, Filter):
        raise TypeError(f"{name}: expected a filter, got {type(filt).__name__}")


def check_callable(name: str, fn: Any) -> None:
    """Raises a TypeError that names the argument if it is no function."""
    if not callable(fn):
        raise TypeError(f"{name}: expected a function, got {type(fn).__name__}")


def check_key(key: Any, name: str = "key") -> None:
    """Raises a TypeError that names the argument if it is no random key."""
    dtype = getattr(key, "dtype", None)
    if dtype is None or not (jnp.issubdtype(dtype, jax.dtypes.prng_key) or dtype == np.uint32):
        raise TypeError(f"{name}: expected a random key, got {type(key).__name__}")


def check_count(name: str, value: Any, least: int) -> None:
    """Raises a ValueError that names an option if it is no integer of at least ``least``."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{name}: expected an int >= {least}, got {value!r}")


def check_flag(name: str, value: Any) -> None:
    """Raises a TypeError that names a static option if it is neither True nor False: text and numbers are true, too."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name}: expected True or False, got {value!r}")


def numbers(name: str, x: Any) -> np.ndarray:
    """A concrete ``x`` as an array of real numbers, or a TypeError that names it."""
    try:
        a = np.asarray(x)
    except (TypeError, ValueError):  # a random key, a ragged list
        a = np.asarray(None)
    if not any(jnp.issubdtype(a.dtype, kind) for kind in (np.floating, np.integer, np.bool_)):
        raise TypeError(f"{name}: expected real numbers, got {x!r}")
    return a


def real_array(name: str, x: Any) -> Array:
    """``x`` as an array of real numbers, or a TypeError that names it; what is traced is looked at by its dtype."""
    if not hasattr(x, "dtype") and is_concrete(x):
        numbers(name, x)
    x = jnp.asarray(x)
    if jnp.issubdtype(x.dtype, jnp.complexfloating) or jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        raise TypeError(f"{name}: expected real numbers, got {x.dtype}")
    return x


def number(name: str, x: Any) -> float:
    """A concrete ``x`` as one real number, or a TypeError that names it."""
    a = numbers(name, x)
    if a.ndim:
        raise TypeError(f"{name}: expected a number, got shape {a.shape}")
    return float(a)


def check_float(name: str, x: Any) -> None:
    """Raises a TypeError that names ``x`` if it is no float array."""
    dtype = x.dtype if hasattr(x, "dtype") else np.asarray(x).dtype
    if not jnp.issubdtype(dtype, jnp.floating):
        raise TypeError(f"{name}: expected a float array, got {dtype}")


def _check_same_dtype(name, x, dtype):
    # A weakly typed tracer was a Python number: it takes the other's dtype.
    if hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jnp.floating) and not getattr(x, "weak_type", False):
        got = jax.dtypes.canonicalize_dtype(x.dtype)
        if got != dtype:
            raise TypeError(f"{name}: is {got}, but ys is {dtype}; convert one of them")


def _check_finite(ys, mask):
    if not is_concrete((ys, mask)):
        return
    bad = ~np.isfinite(np.asarray(ys))
    if mask is not None:
        bad &= np.asarray(mask)
    if bad.any():
        k, i = (int(index) for index in np.argwhere(bad)[0])
        value = float(np.asarray(ys)[k, i])
        raise ValueError(
            f"ys: ys[{k}, {i}] is {value} and no mask covers it ({int(bad.sum())} such values); "
            "if NaN means missing, use ys, mask = jf.mask_nan(ys)"
        )


def _per_step(name, x, T, dtype, ranks):
    if hasattr(x, "dtype"):
        if not jnp.issubdtype(x.dtype, jnp.floating):
            raise TypeError(f"{name}: expected a float array, got {x.dtype}")
        _check_same_dtype(name, x, dtype)
    elif is_concrete(x):
        numbers(name, x)
    x = jnp.asarray(x, dtype)
    if x.ndim == 0:
        x = jnp.broadcast_to(x, (T,))
    if x.ndim not in ranks or x.shape[0] != T:
        raise ValueError(f"{name}: expected a scalar or leading T = {T}, got shape {x.shape}")
    return x
