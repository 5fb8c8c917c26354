"""The files that ``track`` writes: a table, a picture, and an interactive page that works offline."""

from __future__ import annotations

import html
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import jaxfilt as jf
from jaxfilt.chi2 import chi2_quantile
from jaxfilt.cli import filters, text
from jaxfilt.cli.learn import Learnt
from jaxfilt.cli.read import Recording
from jaxfilt.cli.run import Run, Verdict
from jaxfilt.cli.units import BadInput
from jaxfilt.frames import status_text

_KNOWN = (".csv", ".png", ".html")


def check_paths(paths: Sequence[str], source: str) -> None:
    """Raises an error for a file that could not be written, before anything is computed."""
    for path in paths:
        if Path(path).suffix.lower() not in _KNOWN:
            raise BadInput(f"--out: expected a file name that ends in {', '.join(_KNOWN)}, got {path!r}")
        if Path(path).resolve() == Path(source).resolve():
            raise BadInput(f"--out: {path!r} is the recording itself, which would be lost")
        if path.lower().endswith(".html"):
            plotly()
        elif path.lower().endswith(".png"):
            figure()
        if not Path(path).absolute().parent.is_dir():
            raise BadInput(f"--out: there is no folder {str(Path(path).parent)!r}")


def write(path: str, rec: Recording, done: Run, learnt: Learnt, verdict: Verdict | None, lines: list[str]) -> None:
    """Writes one file, as its name's ending says."""
    suffix = Path(path).suffix.lower()
    if suffix == ".csv":
        table(rec, done).to_csv(path, index=False)
    elif suffix == ".png":
        picture(path, rec, done)
    else:
        Path(path).write_text(page(rec, done, learnt, verdict, lines), encoding="utf-8")


def table(rec: Recording, done: Run) -> Any:
    """A row per row of the file, in its order and units: measurement as it stood there, estimate, deviation, velocity.

    Longitudes and latitudes are estimated in meters east and north, and written in both.
    """
    import pandas as pd

    d = len(rec.axes)
    mean, cov = np.asarray(done.shown.mean), np.asarray(done.shown.cov)
    deviation = np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0))
    cells = rec.cells.reset_index(drop=True)
    columns: dict[str, Any] = {}
    if rec.time is None:
        columns["time [s]"] = rec.times
    else:
        columns[rec.time] = cells[rec.time]
    columns |= {column.name: cells[column.name] for column in rec.columns}
    for i, (name, axis) in enumerate(zip(rec.axes, rec.axis_units, strict=True)):
        columns[f"{name}_est [{axis.unit}]"] = mean[:, i] / axis.factor
        columns[f"{name}_std [{axis.unit}]"] = deviation[:, i] / axis.factor
    if rec.place is not None:
        lat, lon = rec.place.to_globe(mean[:, 0], mean[:, 1])
        columns |= {"lat_est [deg]": lat, "lon_est [deg]": lon}
    for i, (name, axis) in enumerate(zip(rec.axes, rec.axis_units, strict=True)):
        columns[f"{name}_velocity [{axis.unit}/s]"] = mean[:, d + i] / axis.factor
        columns[f"{name}_velocity_std [{axis.unit}/s]"] = deviation[:, d + i] / axis.factor
    letters = filters.state_letters(done.choice)
    if "w" in letters:
        columns["turn_rate [rad/s]"] = mean[:, letters.index("w")]
    if done.out.nis is not None:
        columns["nis"] = np.where(rec.present, np.asarray(done.out.nis), np.nan)
    if done.modes is not None:
        columns |= {f"p_{mode}": done.modes[:, j] for j, mode in enumerate(done.choice.modes)}
    columns["status"] = status_text(done.out.status)
    return pd.DataFrame(columns)


def picture(path: str, rec: Recording, done: Run) -> None:
    """Track, positions over time, NIS and, of an IMM, the mode probabilities."""
    d, seen = len(rec.axes), rec.present
    panels = d + (done.out.nis is not None) + (done.modes is not None)
    label = _label(done)
    east, north = (np.ptp(np.asarray(done.shown.mean)[:, i]) for i in (0, min(1, d - 1)))
    wide = d > 1 and east > 1.2 * north  # then the track stands above the other panels, else beside them
    height = 1.5 + 8.5 * min(1.0, float(north / east)) if wide else 0.0
    size = (11, height + 2.3 * panels) if wide or d == 1 else (15, max(6.0, 2.4 * panels))
    fig = figure(figsize=size, layout="constrained")
    left: Any = fig
    right: Any = fig
    parts: Any
    if wide:
        parts = fig.subfigures(2, 1, height_ratios=(height, 2.3 * panels))
        left, right = parts
    elif d > 1:
        parts = fig.subfigures(1, 2)
        left, right = parts
    if d > 1:
        ax = left.subplots()
        jf.plots.track(
            done.shown, measurements=np.where(rec.mask, rec.fixes, np.nan)[:, :2], mask=seen, label=label, ax=ax
        )
        ax.set(xlabel=f"{rec.axes[0]} [m]", ylabel=f"{rec.axes[1]} [m]")
    fig.suptitle(f"{Path(rec.path).name}: {done.choice.text}")
    axes = list(np.atleast_1d(right.subplots(panels, 1, sharex=True)))
    for i in range(d):
        jf.plots.estimate(
            done.shown, component=i, measurements=np.where(np.isfinite(rec.fixes[:, i]), rec.fixes[:, i], 0.0),
            mask=np.isfinite(rec.fixes[:, i]), times=rec.times, label=label, unit="m", ax=axes[i],
        )  # fmt: skip
        axes[i].set_ylabel(f"{rec.axes[i]} [m]")
    rest = axes[d:]
    if done.out.nis is not None:
        k = np.flatnonzero(done.scored)
        whole = rec.mask.shape[1]
        jf.plots.consistency(np.asarray(done.out.nis)[k], whole, probability=0.95, times=rec.times[k], label="NIS",
                             ax=rest[0])  # fmt: skip
    if done.modes is not None:
        jf.plots.mode_probabilities(done.modes, names=list(done.choice.modes), times=rec.times, ax=rest[-1])
    for ax in axes:
        ax.set(xlim=(rec.times[0], rec.times[-1]), xlabel="")
    axes[-1].set_xlabel(_time_title(rec))
    fig.savefig(path, dpi=130)


# --------------------------------------------------------------------------------------------------------------- page

_BLUE, _GREY, _RED = "#1f5fa8", "rgba(90, 90, 90, 0.55)", "#c2452d"
_COLORS = (_BLUE, "#d08a1e", "#3b8f5a", "#8a4f9e")


def page(rec: Recording, done: Run, learnt: Learnt, verdict: Verdict | None, lines: list[str]) -> str:
    """One self-contained page of HTML."""
    figures = [*([_track(rec, done)] if len(rec.axes) > 1 else []), _courses(rec, done)]
    if done.out.nis is not None:
        figures.append(_nis(rec, done, verdict))
    if done.modes is not None:
        figures.append(_modes(rec, done))
    rows = "".join(
        f"<tr><td>{html.escape(name)}</td><td class=n>{value:.4g}</td><td>{html.escape(unit)}</td>"
        f"<td>{html.escape(meaning)}</td><td>{'learnt' if name in learnt.free else 'given'}</td></tr>"
        for name, value, unit, meaning in text.parameter_rows(learnt)
    )
    head = f"{Path(rec.path).name}: {done.choice.text}"
    table = f"<table><tr><th>parameter<th>value<th>unit<th>meaning<th></tr>{rows}</table>"
    return document(head, [table, f"<pre>{html.escape(chr(10).join(lines))}</pre>"], figures)


def document(title: str, before: Sequence[str], figures: Sequence[Any]) -> str:
    """A page with its own copy of plotly, so that it works offline."""
    plots = [
        fig.to_html(full_html=False, include_plotlyjs=i == 0, config={"responsive": True, "displaylogo": False})
        for i, fig in enumerate(figures)
    ]
    style = (
        "body{font:15px/1.45 system-ui,sans-serif;max-width:1180px;margin:1.5em auto;padding:0 1em;color:#222}"
        "h1{font-size:1.35em}table{border-collapse:collapse}th,td{text-align:left;padding:.2em .9em .2em 0;"
        "border-bottom:1px solid #ddd}td.n{text-align:right}pre{background:#f5f5f3;padding:.8em;overflow-x:auto;"
        "font-size:12.5px;white-space:pre-wrap}"
    )
    body = "\n".join([f"<h1>{html.escape(title)}</h1>", *before, *plots])
    return (
        f"<!doctype html><html lang=en><head><meta charset=utf-8><title>{html.escape(title)}</title>"
        f"<style>{style}</style></head><body>{body}</body></html>"
    )


def figure(**options: Any) -> Any:
    """A figure of matplotlib, or an ImportError with the command that installs it."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('a picture needs matplotlib: pip install "jaxfilt[plot]"') from error
    return Figure(**options)


def plotly() -> Any:
    """plotly.graph_objects, or an ImportError with the command that installs it."""
    try:
        import plotly.graph_objects as go
    except ImportError as error:
        raise ImportError('a page needs plotly: pip install "jaxfilt[cli]"') from error
    return go


def _track(rec: Recording, done: Run) -> Any:
    go = plotly()
    mean, cov = np.asarray(done.shown.mean)[:, :2], np.asarray(done.shown.cov)[:, :2, :2]
    seen, fixes = rec.present, rec.fixes[:, :2]
    when = [f"{t:.6g} s" for t in rec.times]
    fig = go.Figure()
    outline = _ellipses(mean, cov, min(60, len(mean)))
    fig.add_scatter(x=outline[:, 0], y=outline[:, 1], mode="lines", name="95 % ellipses", hoverinfo="skip",
                    line={"width": 1, "color": "rgba(31, 95, 168, 0.45)"})  # fmt: skip
    fig.add_scatter(x=fixes[:, 0], y=fixes[:, 1], mode="markers", name="measurements", text=when,
                    marker={"size": 4, "color": _GREY}, hovertemplate="%{text}<br>%{x:.1f}, %{y:.1f}")  # fmt: skip
    fig.add_scatter(x=mean[:, 0], y=mean[:, 1], mode="lines", name=_label(done), text=when,
                    line={"color": _BLUE, "width": 2}, hovertemplate="%{text}<br>%{x:.1f}, %{y:.1f}")  # fmt: skip
    lost = _stretches(rec, seen)
    if lost.any():
        gap = np.where(lost[:, None], mean, np.nan)
        fig.add_scatter(x=gap[:, 0], y=gap[:, 1], mode="lines+markers", name="without measurement", text=when,
                        line={"color": _RED, "width": 3}, marker={"size": 3},
                        hovertemplate="%{text}<br>%{x:.1f}, %{y:.1f}")  # fmt: skip
    fig.add_scatter(x=mean[:1, 0], y=mean[:1, 1], mode="markers", name="start", hoverinfo="skip",
                    marker={"size": 10, "color": _BLUE, "symbol": "circle-open"})  # fmt: skip
    fig.update_layout(**_layout(640, f"track, {_label(done)} with 95 % ellipses"))
    fig.update_xaxes(title=f"{rec.axes[0]} [m]")
    fig.update_yaxes(title=f"{rec.axes[1]} [m]", scaleanchor="x")
    return fig


def _courses(rec: Recording, done: Run) -> Any:
    from plotly.subplots import make_subplots

    plotly()
    d = len(rec.axes)
    fig = make_subplots(rows=d, cols=1, shared_xaxes=True, vertical_spacing=0.05)
    mean = np.asarray(done.shown.mean)
    deviation = np.sqrt(np.maximum(np.diagonal(np.asarray(done.shown.cov), axis1=1, axis2=2), 0))
    for i, name in enumerate(rec.axes):
        at: dict[str, Any] = {"row": i + 1, "col": 1}
        first: dict[str, Any] = {"showlegend": i == 0}
        there = np.isfinite(rec.fixes[:, i])
        low, high = mean[:, i] - 2 * deviation[:, i], mean[:, i] + 2 * deviation[:, i]
        fig.add_scatter(x=rec.times, y=low, mode="lines", line={"width": 0}, hoverinfo="skip", showlegend=False, **at)
        fig.add_scatter(x=rec.times, y=high, mode="lines", line={"width": 0}, fill="tonexty", name="2 sigma",
                        fillcolor="rgba(31, 95, 168, 0.22)", hoverinfo="skip", **first, **at)  # fmt: skip
        fig.add_scatter(x=rec.times[there], y=rec.fixes[there, i], mode="markers", name="measurements",
                        marker={"size": 4, "color": _GREY}, **first, **at)  # fmt: skip
        fig.add_scatter(x=rec.times, y=mean[:, i], mode="lines", name=_label(done), line={"color": _BLUE, "width": 1.6},
                        **first, **at)  # fmt: skip
        for begin, end in _spans(rec, there):
            fig.add_vrect(x0=begin, x1=end, fillcolor=_RED, opacity=0.12, line_width=0, **at)
        fig.update_yaxes(title=f"{name} [m]", **at)
    fig.update_xaxes(title=_time_title(rec), row=d, col=1)
    fig.update_layout(**_layout(180 + 210 * d, "positions over time; stretches without measurement are shaded"))
    return fig


def _nis(rec: Recording, done: Run, verdict: Verdict | None) -> Any:
    go = plotly()
    fig = go.Figure()
    k = np.flatnonzero(done.scored)
    nis, dof = np.asarray(done.out.nis)[k], rec.mask[k].sum(axis=1)
    low, high = jf.metrics.chi2_region(float(dof.max(initial=1)), 1, 0.95)
    fig.add_scatter(x=rec.times[k], y=np.maximum(nis, 1e-2), mode="markers", name="NIS",
                    marker={"size": 4, "color": _BLUE})  # fmt: skip
    width = max(5, len(k) // 40)
    if len(k) > 3 * width:
        smooth = np.convolve(nis, np.ones(width) / width, "valid")
        fig.add_scatter(x=rec.times[k][width // 2 : width // 2 + len(smooth)], y=np.maximum(smooth, 1e-2), mode="lines",
                        name=f"mean of {width}", line={"color": _COLORS[1]})  # fmt: skip
    ends = [rec.times[0], rec.times[-1]]
    for y, name, dash in ((low, "95 % region", "dash"), (high, "", "dash"), (dof.mean(), "expected mean", "solid")):
        fig.add_scatter(x=ends, y=[y, y], mode="lines", name=name, showlegend=bool(name), hoverinfo="y",
                        line={"color": _RED, "dash": dash, "width": 1.4})  # fmt: skip
    said = "" if verdict is None else f": mean {verdict.nis:.3g}, region {verdict.low:.3g} to {verdict.high:.3g}"
    fig.update_layout(**_layout(380, f"normalized innovation squared{said}"))
    fig.update_yaxes(title="NIS", type="log")
    fig.update_xaxes(title=_time_title(rec))
    return fig


def _modes(rec: Recording, done: Run) -> Any:
    go = plotly()
    fig = go.Figure()
    assert done.modes is not None
    for j, mode in enumerate(done.choice.modes):
        fig.add_scatter(x=rec.times, y=done.modes[:, j], mode="lines", stackgroup="p", name=mode, line={"width": 0.5},
                        fillcolor=_COLORS[j % len(_COLORS)])  # fmt: skip
    fig.update_layout(**_layout(330, "mode probabilities"))
    fig.update_yaxes(title="probability", range=[0, 1])
    fig.update_xaxes(title=_time_title(rec))
    return fig


def _layout(height: int, title: str) -> dict[str, Any]:
    return {
        "height": height, "title": {"text": title, "font": {"size": 15}}, "template": "plotly_white",
        "margin": {"l": 70, "r": 20, "t": 60, "b": 50}, "legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom",
        "x": 1.0, "xanchor": "right"},
    }  # fmt: skip


def _label(done: Run) -> str:
    return "smoothed" if isinstance(done.shown, jf.Smoothed) else "estimate"


def _time_title(rec: Recording) -> str:
    dated = not rec.start.replace(".", "").isdigit()
    return f"time [s] since {rec.start}" if dated else "time [s]"


def _ellipses(mean, cov, count) -> np.ndarray:
    """Outlines (.., 2) of 95 %, NaN between them."""
    angle = np.linspace(0, 2 * np.pi, 33)
    circle = np.sqrt(chi2_quantile(0.95, 2)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    parts = []
    for k in np.unique(np.linspace(0, len(mean) - 1, count).astype(int)):
        values, vectors = np.linalg.eigh(cov[k])
        parts += [mean[k] + circle @ (vectors * np.sqrt(np.maximum(values, 0))).T, np.full((1, 2), np.nan)]
    return np.concatenate(parts)


def _stretches(rec: Recording, seen: np.ndarray) -> np.ndarray:
    """(T,) bool: rows without measurement, and the rows beside a gap in time, so that a line bridges it."""
    lost = ~seen
    late = np.flatnonzero(rec.dt > 3 * rec.dt[0])
    lost[late] = True
    near = lost.copy()
    near[:-1] |= lost[1:]
    near[1:] |= ~seen[:-1]
    return near


def _spans(rec: Recording, there: np.ndarray) -> list[tuple[float, float]]:
    """Stretches of time between measurements that are more than three median intervals apart."""
    k = np.flatnonzero(there)
    t = rec.times[k]
    return [(float(a), float(b)) for a, b in itertools.pairwise(t) if b - a > 3 * rec.dt[0]]
