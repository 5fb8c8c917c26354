"""Short texts for ``repr``: what models, filters and results hold, in a few lines.

They never raise and never wait long: of an array that is traced, deleted or elsewhere only the shape is shown.
"""

from __future__ import annotations

import enum
import functools
import reprlib
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

_WIDTH = 110
_LINES = 10
_LONGEST = _WIDTH - 2  # one part
_MOST = 10_000_000  # entries that are looked at: milliseconds
_FEW = 4  # entries of a vector whose values are shown, items of a container, names of a list


def brief(x: Any) -> str:
    """Anything in part of a line: small numbers by value, arrays by shape, functions by name and what they hold."""
    if isinstance(x, str | bool | int | float | complex | enum.Enum):
        return f"{x:.4g}" if isinstance(x, float) else reprlib.repr(x)
    if isinstance(x, Partial):
        return _call(_name(x.func), [*map(brief, x.args), *_pairs(x.keywords)])
    if is_filter(x):
        return _call(filter_name(x), _parts(_params(x)))
    if hasattr(x, "_fields"):
        return _call(type(x).__name__.strip("_"), _parts(x))
    if isinstance(x, Mapping):
        return "{" + _few(_pairs(x)) + "}"
    if isinstance(x, tuple | list):
        return "(" + _few(map(brief, x)) + ")"
    if hasattr(x, "shape") and hasattr(x, "dtype"):
        return _array(x)
    if type(x).__name__ == "Static":
        return brief(x.value) if isinstance(x.value, str | int | float | tuple) else reprlib.repr(x.value)
    return "None" if x is None else _name(x) if callable(x) else reprlib.repr(x)


def _never_fails(text):
    """JAX shows trees of anything in its own error messages: a repr must not raise another error there."""

    @functools.wraps(text)
    def safe(x, *args):
        try:
            return text(x, *args)
        except Exception:
            return f"{type(x).__name__}({_few(f'{name}: {type(value).__name__}' for name, value in _items(x))})"

    return safe


@_never_fails
def fields(x: Any) -> str:
    """A NamedTuple: its name, dtype, and fields; those that are None are left out."""
    return fill(f"{type(x).__name__}{_dtype(x)}:", _parts(x))


@_never_fails
def filter_fields(filt: Any) -> str:
    """A filter: where it is defined, the dtype, and the parameters."""
    params = _params(filt)
    return fill(f"Filter {filter_name(filt)}{_dtype(params)}:", _parts(params))


def is_filter(x: Any) -> bool:
    """Whether x looks like a filter (whose class imports this module)."""
    return getattr(x, "_fields", ())[:3] == ("init", "predict", "update")


def filter_name(filt: Any) -> str:
    """The file that defines a filter and, where it has several, its name there: ``kalman``, ``residual.nis``."""
    for step in (filt.update, filt.predict, filt.init):
        function = getattr(step, "func", step)
        defined = str(getattr(function, "__module__", ""))
        if defined and defined != "jaxfilt.core":  # where what a wrapper passes on is defined
            module, own = defined.rpartition(".")[2], _name(function)
            for verb in ("update", "predict", "init"):
                own = own.removesuffix(verb)
            own = own.strip("_")
            return f"{module}.{own}" if own and own != module else module
    return "filter"


@_never_fails
def info(x: Any, bits: Iterable[Any]) -> str:
    """Shapes of an Info, how often each status bit is set, and the sum of the log-likelihood."""
    shape = _shape(x.mean)
    of = "one step" if len(shape) < 2 else f"{' x '.join(map(str, shape[:-1]))} samples"
    shown = {name: value for name, value in _items(x) if name != "extra"}
    parts = [f"{name}={_array(value)}" for name, value in shown.items() if hasattr(value, "shape")]
    if x.prediction is not None:
        parts.append("prediction")
    if isinstance(x.extra, Mapping) and x.extra:
        parts.append("extra: " + _few(map(str, x.extra)))
    text = fill(f"{type(x).__name__} of {of}{_dtype(x)}:", parts)
    facts = []
    words = _values(x.status)
    if words is not None and words.size and np.issubdtype(words.dtype, np.integer):
        facts.append(f"status: {status_counts(words, bits) or 'no bit set'} of {words.size}")
    log_lik = _values(x.log_lik)
    if log_lik is not None and log_lik.size and np.issubdtype(log_lik.dtype, np.floating):
        total = log_lik.astype(np.float64).sum(axis=-1) if log_lik.ndim else log_lik
        each = f"{float(np.mean(total)):.5g}"
        facts.append(f"sum of log_lik: {each}" if total.ndim == 0 else f"sum of log_lik: {each} on average of runs")
    return text + ("\n  " + "; ".join(facts) if facts else "")


@_never_fails
def monte_carlo(x: Any, bits: Iterable[Any]) -> str:
    """A line for each filter: every score as mean and standard error over runs, and the status bits of runs."""
    lines = [
        f"{type(x).__name__}: {x.runs} runs in chunks of {x.chunk}, {x.runs_per_second:.4g} runs/s "
        f"({x.wall_seconds:.3g} s; compilation {x.compile_seconds:.3g} s)"
    ]
    for name, found in list(x.scores.items())[:_LINES]:
        scores = _few(f"{score} {_mean(values)}" for score, values in found.items())
        words = _values(x.status.get(name))
        counts = "" if words is None else status_counts(words, bits)
        lines.append(f"  {name}: {scores}" + (f"; runs with {counts}" if counts else ""))
    if len(x.scores) > _LINES:
        lines.append(f"  ... {len(x.scores)} filters in all")
    return "\n".join(lines)


@_never_fails
def history(x: Any) -> str:
    """The course of a tuner by its first and last row."""
    return (
        f"{type(x).__name__} of {len(x.best_loss)} rows: best_loss {x.best_loss[0]:.6g} -> {x.best_loss[-1]:.6g}, "
        f"{x.evaluations[-1]} evaluations in {x.wall_time[-1]:.3g} s"
    )


@_never_fails
def front(x: Any) -> str:
    """How many solutions, the range of each loss, and the parameters."""
    low, high = x.losses.min(axis=0), x.losses.max(axis=0)
    ranges = _few(f"{a:.5g} to {b:.5g}" for a, b in zip(low, high, strict=True))
    return f"{type(x).__name__} of {len(x.losses)} solutions: losses {ranges}; params={brief(x.params)}"


def _mean(values):
    """The mean over runs with its standard error, of an array of scores averaged within each run."""
    values = np.asarray(values)
    if not values.size or not (np.issubdtype(values.dtype, np.number) or values.dtype == bool):
        return brief(values)
    with np.errstate(all="ignore"):  # a score may be infinite
        of_runs = values.reshape(len(values), -1).mean(axis=1, dtype=np.float64)
        error = f" ± {of_runs.std(ddof=1) / np.sqrt(len(of_runs)):.2g}" if len(of_runs) > 1 else ""
        within = f" (over {_shape_text(values.shape[1:])})" if values.ndim > 1 else ""
        return f"{of_runs.mean():.4g}{error}{within}"


def status_counts(words: np.ndarray, bits: Iterable[Any]) -> str:
    """How many words have each bit: ``MISSED 23, GATED 2``."""
    counts = {bit.name: int(((words & int(bit)) != 0).sum()) for bit in bits}
    return ", ".join(f"{name} {count}" for name, count in counts.items() if count)


def fill(head: str, parts: Iterable[str]) -> str:
    """Head and parts, separated by commas, in a few lines."""
    lines = [head]
    for i, part in enumerate(parts):
        part = part if len(part) <= _LONGEST else part[: _LONGEST - 3] + "..."
        glue = ", " if i else " "
        if len(lines[-1]) + len(glue) + len(part) <= _WIDTH:
            lines[-1] += glue + part
        else:
            lines.append(f"  {part}")
    return "\n".join(lines[:_LINES] + (["  ..."] if len(lines) > _LINES else []))


def _params(filt):
    """What the functions of a filter are bound to."""
    args = getattr(filt.update, "args", ())
    return args[0] if args else getattr(filt.update, "keywords", {})


def _parts(x):
    if hasattr(x, "_fields"):
        return _pairs({name: value for name, value in _items(x) if value is not None})
    return _pairs(x) if isinstance(x, Mapping) else [brief(x)]


def _items(x):
    return zip(x._fields, x, strict=True)


def _pairs(x):
    parts = []
    for name, value in x.items():
        if isinstance(value, tuple) and value and all(map(is_filter, value)):
            parts += [f"{name}[{i}]={brief(filt)}" for i, filt in enumerate(value)]
        else:
            parts.append(f"{name}={brief(value)}")
    return parts


def _call(name, parts):
    inside = ", ".join(parts)
    return f"{name}({inside})" if inside else name


def _few(parts):
    parts = list(parts)
    return ", ".join(parts[:_FEW] + ([f"... {len(parts)} in all"] if len(parts) > _FEW else []))


def _name(function):
    return str(getattr(function, "__name__", type(function).__name__)).strip("_")


def _shape(x):
    shape = getattr(x, "shape", ())
    return shape if isinstance(shape, tuple) else ()


def _array(x):
    shape = _shape(x)
    values = _values(x) if len(shape) < 2 and (not shape or shape[0] <= _FEW) else None
    if values is None or values.dtype == object:
        return _shape_text(shape)
    texts = [f"{value:.4g}" if isinstance(value, float) else str(value) for value in np.ravel(values).tolist()]
    return f"[{', '.join(texts)}]" if shape else texts[0]


def _shape_text(shape):
    return f"({shape[0]},)" if len(shape) == 1 else f"({', '.join(map(str, shape))})"


def _values(x):
    """The values of a concrete array of moderate size, else None."""
    if isinstance(x, jax.core.Tracer) or not isinstance(x, np.ndarray | np.generic | jax.Array) or x.size > _MOST:
        return None
    try:
        return np.asarray(x)
    except Exception:  # deleted, on another machine, a random key: a repr never fails
        return None


def _dtype(x):
    """``, float32`` of the first float array in x."""
    for leaf in jax.tree.leaves(x):
        dtype = getattr(leaf, "dtype", None)
        if isinstance(dtype, np.dtype) and jnp.issubdtype(dtype, np.floating):
            return f", {dtype}"
    return ""
