"""What all pictures share: the figure, its colors, and the checks of what is drawn."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from jaxfilt.core import Status, is_concrete, numbers
from jaxfilt.smooth import Smoothed
from jaxfilt.smooth_particles import SmoothedParticles

# Okabe and Ito 2008: told apart with any kind of color vision. Black is the truth's, gray the measurements'.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
TRUTH = "black"
MEASURED = "0.45"
LOST = "#F5C77E"  # light orange, behind the lines
REGION = "0.9"


def plotting() -> Any:
    """``matplotlib.pyplot``, imported when something is drawn; ImportError if it is missing."""
    try:
        import matplotlib.pyplot as plt
    except ImportError:
        raise ImportError('jf.plots needs matplotlib: pip install "jaxfilt[plot]"') from None
    return plt


def axes_of(ax: Any, **figure: Any) -> Any:
    """The given Axes, or those of a new figure, with a light grid."""
    plt = plotting()
    if ax is None:
        _, ax = plt.subplots(layout="constrained", **figure)
    elif not hasattr(ax, "add_patch"):
        raise TypeError(f"ax: expected a matplotlib Axes, got {type(ax).__name__}")
    ax.grid(True, color="0.9", linewidth=0.8)
    ax.set_axisbelow(True)
    return ax


def color_at(i: int) -> str:
    """The i-th color, from the first again after the last."""
    return COLORS[i % len(COLORS)]


def next_color(ax: Any, gid: str) -> str:
    """The first color that no line of this kind in the Axes has."""
    return color_at(sum(line.get_gid() == gid for line in ax.lines))


def legend(ax: Any, *, beside: bool = False) -> None:
    """A legend that names everything once: beside the Axes, if the figure's layout makes room there, or inside."""
    once: dict[str, Any] = {}
    for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
        once.setdefault(label, handle)
    beside = beside and ax.figure.get_layout_engine() is not None
    place = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.02)} if beside else {"loc": "best"}
    ax.legend(once.values(), once.keys(), frameon=not beside, fontsize="small", **place)


def array(name: str, x: Any, shape: tuple[int | None, ...], *, nan: bool = False, of: str = "out") -> np.ndarray:
    """``x`` as float64 of this shape (None = any length > 0), or an error that names it.

    Args:
        name: the argument.
        x: real numbers.
        shape: what is expected.
        nan: NaN stands for what is not known; infinite values are refused all the same.
        of: the argument that sets the shape.
    """
    if not is_concrete(x):
        raise TypeError(f"{name}: is traced; draw outside of jit and vmap")
    a = numbers(name, x).astype(np.float64)
    if a.ndim != len(shape) or any(want not in (None, got) for want, got in zip(shape, a.shape, strict=True)):
        wanted = f"({', '.join('any' if n is None else str(n) for n in shape)}{',' if len(shape) == 1 else ''})"
        wanted += "" if None in shape else f" for this {of}"
        batch = "; a batch of runs? pick one of them" if a.ndim == len(shape) + 1 else ""
        raise ValueError(f"{name}: expected shape {wanted}, got {a.shape}{batch}")
    if a.size == 0:
        raise ValueError(f"{name}: is empty, of shape {a.shape}")
    if not (np.isfinite(a) | (np.isnan(a) & nan)).all():
        raise ValueError(f"{name}: expected finite numbers{' or NaN' if nan else ''}")
    return a


def moments(out: Any) -> tuple[np.ndarray, np.ndarray | None]:
    """Mean (T, n) and covariance (T, n, n) or None of one run's output."""
    mean, cov = (getattr(out, name, None) for name in ("mean", "cov"))
    if mean is None or callable(mean):
        raise TypeError(f"out: expected what jf.filter or jf.smooth returns, got {type(out).__name__}")
    if np.ndim(mean) != 2:
        raise ValueError(
            f"out: expected one run with mean (T, n), got mean {np.shape(mean)}; "
            "of a batch pick a run: jax.tree.map(lambda leaf: leaf[0], out)"
        )
    if not is_concrete((mean, cov)):
        raise TypeError("out: is traced; draw outside of jit and vmap")
    mean = numbers("out.mean", mean).astype(np.float64)
    T, n = mean.shape
    if T == 0:
        raise ValueError("out: has no sample")
    if cov is None:
        return mean, None
    cov = numbers("out.cov", cov).astype(np.float64)
    if cov.shape != (T, n, n):
        raise ValueError(f"out: expected cov ({T}, {n}, {n}) as mean {mean.shape}, got {cov.shape}")
    return mean, cov


def output_label(out: Any, label: Any) -> str:
    """The name of an estimate in the legend."""
    if label is None:
        return "smoothed" if isinstance(out, Smoothed | SmoothedParticles) else "estimate"
    return text("label", label)


def presence(mask: Any, out: Any, T: int) -> tuple[np.ndarray, np.ndarray]:
    """(T,) where a sample is complete and (T,) where nothing of it is there, from the mask or the output's status."""
    if mask is None:
        status = getattr(out, "status", None)
        if status is None or np.shape(status) != (T,):
            return np.ones(T, bool), np.zeros(T, bool)
        lost = (np.asarray(status) & int(Status.MISSED)) != 0
        return ~lost, lost
    a = numbers("mask", mask)
    if a.dtype != bool:
        raise TypeError(f"mask: expected bool, True = present, got {a.dtype}")
    if a.ndim not in (1, 2) or a.shape[0] != T or a.size == 0:
        raise ValueError(f"mask: expected shape ({T},) or ({T}, m), got {a.shape}")
    a = a.reshape(T, -1)
    return np.all(a, axis=1), ~np.any(a, axis=1)


def spans(t: np.ndarray, chosen: np.ndarray) -> list[tuple[float, float]]:
    """Where each run of chosen samples (T,) begins and ends on the abscissa: half-way to the samples beside it."""
    borders = np.concatenate([t[:1], 0.5 * (t[1:] + t[:-1]), t[-1:]])
    changes = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(int)))
    return [(float(borders[first]), float(borders[end])) for first, end in changes.reshape(-1, 2)]


def abscissa(times: Any, T: int, of: str = "out") -> np.ndarray:
    """Times (T,), or the sample numbers."""
    return np.arange(float(T)) if times is None else array("times", times, (T,), of=of)


def label_times(ax: Any, times: Any) -> None:
    """Says what the abscissa is."""
    ax.set_xlabel("sample" if times is None else "time [s]")


def text(name: str, value: Any) -> str:
    """A text, or a TypeError that names the argument."""
    if not isinstance(value, str):
        raise TypeError(f"{name}: expected text, got {value!r}")
    return value


def texts(name: str, values: Any, default: Iterable[str]) -> list[str]:
    """One text for each default, or the defaults."""
    default = list(default)
    if values is None:
        return default
    if isinstance(values, str) or not isinstance(values, Sequence) or not all(isinstance(v, str) for v in values):
        raise TypeError(f"{name}: expected a list of texts, got {values!r}")
    if len(values) != len(default):
        raise ValueError(f"{name}: expected {len(default)} texts, got {len(values)}")
    return list(values)


def percent(share: float, digits: int = 4) -> str:
    """A share or probability for legends and titles."""
    return f"{100 * share:.{digits}g} %"


def with_unit(name: str, unit: Any) -> str:
    """An axis label: ``name [unit]``, or the name alone."""
    return name if unit is None else f"{name} [{text('unit', unit)}]"
