"""The same estimators on a recorded sine/cosine pair: two magnetometer axes turned in a room's field."""

from __future__ import annotations

import json
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.bootstrap import Bootstrap
from experiments.encoder import estimators
from experiments.encoder.estimators import DRIFT, P0, RADIUS, SMOOTH, as_parameters, mean, search, weights_of
from experiments.planar import contrast
from experiments.report import Cell, Entry, Table
from jaxfilt import sincos, tune
from jaxfilt.sincos import Parameters

DATA = Path(__file__).parents[1] / "data" / "sincos_magnetic_angle"
DT = 3.5e-3  # [s]
NOISE = {"q": "q [rad²/s⁴]", "r": "r", "drift": "drift / that of the simulation"}
CALIBRATION, SCORED = "angle_trial02_b", ("angle_trial02_a", "angle_trial03")
TILT = 0.3  # [rad]; rows beyond are masked
ROWS = 4200  # of the longest record
BLOCK = 286  # rows of one second, which belong together

ATAN2, LOOP, FIXED = "atan2", "tracking loop (alpha-beta)", "EKF, fixed parameters"
ELLIPSE, SUPERVISED = "ellipse + atan2", "supervised + atan2"
CALIBRATED = "EKF, supervised parameters"
OWN, OWN_WARM, OWN_LEARNT = (
    "self-calibrating EKF, cold", "self-calibrating EKF, after the calibration record",
    "self-calibrating EKF, cold, drift learnt",
)  # fmt: skip


OWNS = (OWN, OWN_WARM, OWN_LEARNT)


class Record(NamedTuple):
    ys: np.ndarray  # (T, 2) [uT]
    angle: np.ndarray  # (T,) [rad]
    usable: np.ndarray  # (T,) bool


@cache
def load(name: str) -> Record:
    """One record, with unusable rows behind it: all have the same length, so that nothing is compiled for each."""
    with np.load(DATA / f"{name}.npz") as d:
        x = {key: np.pad(d[key].astype(np.float64), (0, ROWS - len(d[key])), mode="edge") for key in d.files}
        x["axis_tilt_rad"][len(d["cos_ut"]) :] = np.inf
    return Record(np.stack([x["cos_ut"], x["sin_ut"]], axis=1), x["angle_ref_rad"], x["axis_tilt_rad"] <= TILT)


def aligned(record: Record, delay: float) -> Record:
    """The record with the reference as it was ``delay`` [s] before each sample."""
    t = DT * np.arange(len(record.angle))
    return record._replace(angle=np.interp(t - delay, t, record.angle))


@cache
def delay() -> tuple[float, float]:
    """By how much the signals of the calibration record lag behind the reference [s], and its standard error.

    The slope of atan2's error over the reference's rate; seconds are resampled.
    """
    record = load(CALIBRATION)
    rate = np.gradient(record.angle) / DT
    e = np.deg2rad(error(np.arctan2(record.ys[:, 1], record.ys[:, 0]), record))
    rate = np.where(record.usable, rate - rate[record.usable].mean(), np.nan)
    product, square = (_seconds(x) for x in (-e * rate, rate**2))
    draws = Bootstrap(square > 0, np.random.default_rng(0)).draw(product, square, root=False)
    return float(draws[0]), float(np.std(draws[1:], ddof=1))


def _seconds(x: np.ndarray) -> np.ndarray:
    return np.nansum(np.pad(x, (0, -len(x) % BLOCK), constant_values=np.nan).reshape(-1, BLOCK), axis=1)


def ellipse_of(record: Record, **options: Any) -> jf.EllipseFit:
    """The ellipse of a record's usable rows, seconds taken together."""
    return jf.fit_ellipse(jnp.asarray(record.ys), mask=jnp.asarray(record.usable), block=BLOCK, **options)


def amplitude() -> float:
    """Of the calibration record, by which all signals are scaled: its median radius [uT]."""
    record = load(CALIBRATION)
    return float(np.median(np.hypot(*record.ys[record.usable].T)))


def scaled(record: Record) -> tuple[Array, Array]:
    """``(ys, mask)`` for the filters."""
    mask = jnp.broadcast_to(jnp.asarray(record.usable)[:, None], record.ys.shape)
    return jnp.asarray(record.ys / amplitude()), mask


def calibrate(name: str, ys: Array, angle: Array) -> Parameters:
    """The minimum of a named loss from an ideal sensor."""
    return as_parameters(search(*weights_of(name), ys[None], angle[None]).z[0])


def parameters(lag: float = 0.0) -> dict[str, Parameters]:
    """What each way of calibration finds on the calibration record; of signals scaled by :func:`amplitude`.

    Only the supervised one sees the reference, ``lag`` [s] before each sample.
    """
    record = aligned(load(CALIBRATION), lag)
    ys, angle = jnp.asarray(record.ys[record.usable] / amplitude()), jnp.asarray(record.angle[record.usable])
    fit, unit = ellipse_of(record).parameters, amplitude()
    ellipse = fit._replace(**{name: getattr(fit, name) / unit for name in ("offset_a", "offset_b", "amplitude")})
    found = {
        ATAN2: Parameters(),
        ELLIPSE: ellipse,
        f"{RADIUS.split(',')[0]} + atan2": calibrate(RADIUS, ys, angle),
        f"{SMOOTH} + atan2": calibrate(SMOOTH, ys, angle),
        SUPERVISED: calibrate(estimators.SUPERVISED, ys, angle),
    }
    return {name: Parameters(*(jnp.asarray(x, float) for x in p)) for name, p in found.items()}


# ------------------------------------------------------------------------------------------------------------ filters


def ekf(params: dict[str, Any], y0: Array, known: Parameters) -> jf.Filter:
    """[theta, omega] with given parameters."""
    m0 = jnp.stack([sincos.correct(y0, known)[0], jnp.zeros(())])
    return jf.extended(
        jf.models.sine_cosine(dt=DT, q=params["q"], r=params["r"], m0=m0, P0=jnp.asarray(P0[:2, :2]), parameters=known)
    )


def own(params: dict[str, Any], y0: Array, known: Parameters) -> jf.Filter:
    """With the six parameters as states, whose drift is scaled."""
    m0 = jnp.zeros((8,)).at[0].set(sincos.correct(y0, known)[0]).at[4].set(1.0)
    drift = params["drift"] * jnp.asarray(DRIFT)
    return jf.extended(
        jf.models.sine_cosine(dt=DT, q=params["q"], r=params["r"], m0=m0, P0=jnp.asarray(P0), drift=drift)
    )


def _nll(make, params, data):
    known, ys, mask = data
    return tune.innovation_nll(make(params, ys[0], known), ys[None], mask=mask[None], first_update_only=True)


def _learn(make: Any, known: Parameters, names: tuple[str, ...]) -> tune.TuneResult:
    space = {"q": tune.positive(1e4), "r": tune.positive(2e-4), "drift": tune.positive(1.0)}
    space = {name: space[name] for name in names}
    return tune.gradient(
        Partial(_nll, Partial(make)), space, (known, *scaled(load(CALIBRATION))),
        key=jax.random.key(0), optimizer=optax.adam(0.3), steps=40, block=40,
    )  # fmt: skip


def learn() -> dict[str, dict[str, float]]:
    """The noise of the filters by innovation likelihood on the calibration record."""
    known = parameters()
    found = {FIXED: _learn(ekf, known[SUPERVISED], ("q", "r")), OWN_LEARNT: _learn(own, known[ATAN2], tuple(NOISE))}
    return {name: {key: float(x) for key, x in result.params.items()} for name, result in found.items()}


def published() -> dict[str, dict[str, float]]:
    """What was learnt, as published."""
    table = json.loads((Path(__file__).parent / "published.json").read_text(encoding="utf-8"))["tables"][
        "encoder_noise"
    ]
    return {
        row[0]: {k: float(e["value"]) for k, e in zip(NOISE, row[1:], strict=True) if not isinstance(e, str)}
        for row in table["rows"]
    }


@partial(jax.jit, static_argnames=("make",))
def _run(make, params, known, ys, mask):
    return jf.filter(make(params, ys[0], known), ys, mask=mask, outputs=mean, first_update_only=True)


@jax.jit
def _run_warm(params, mean_before, cov_before, ys, mask):
    """From what the calibration record left of the parameters; angle and rate start anew."""
    filt = own(params, ys[0], Parameters())
    first = jf.StepInput(ys[0], mask[0])
    start = filt.init(first)
    m0 = start.mean.at[2:].set(mean_before[2:])
    P = jnp.zeros_like(start.cov).at[:2, :2].set(start.cov[:2, :2]).at[2:, 2:].set(cov_before[2:, 2:])
    state = start._replace(mean=m0, cov=P)
    return jf.scan(filt, state, jf.inputs(ys, mask=mask), outputs=mean, first_update_only=True)[1]


@jax.jit
def _last(params, ys, mask):
    out = jf.filter(own(params, ys[0], Parameters()), ys, mask=mask, first_update_only=True)
    return out.mean[-1], out.cov[-1]


@jax.jit
def _loop(ys, mask):
    m0 = jnp.stack([sincos.correct(ys[0], Parameters())[0], jnp.zeros(())])
    filt = jf.phase_locked(jf.alpha_beta(0.31, 0.058, dt=DT, m0=m0))
    return jf.filter(filt, ys, mask=mask, outputs=mean, first_update_only=True)


class Result(NamedTuple):
    errors: dict[str, dict[str, np.ndarray]]  # by record and estimator: (T,) [deg], NaN where masked
    parameters: dict[str, Parameters]
    noise: dict[str, dict[str, float]]


def run(noise: dict[str, dict[str, float]], lag: float = 0.0) -> Result:
    """Calibrates on one record and estimates all, with noise from :func:`learn`; the reference is ``lag`` before."""
    known = parameters(lag)
    fixed = {key: jnp.asarray(x) for key, x in noise[FIXED].items()}
    learnt = {key: jnp.asarray(x) for key, x in noise[OWN_LEARNT].items()}
    slow = {**fixed, "drift": jnp.ones(())}
    left = _last(slow, *scaled(load(CALIBRATION)))
    errors = {}
    for name in (CALIBRATION, *SCORED):
        record = aligned(load(name), lag)
        ys, mask = scaled(record)
        found = {key: sincos.correct(ys, p)[0] for key, p in known.items()}
        found[LOOP] = _loop(ys, mask)[:, 0]
        found[FIXED] = _run(ekf, fixed, known[ATAN2], ys, mask)[:, 0]
        found[CALIBRATED] = _run(ekf, fixed, known[SUPERVISED], ys, mask)[:, 0]
        found[OWN] = _run(own, slow, known[ATAN2], ys, mask)[:, 0]
        found[OWN_WARM] = _run_warm(slow, *left, ys, mask)[:, 0]
        found[OWN_LEARNT] = _run(own, learnt, known[ATAN2], ys, mask)[:, 0]
        errors[name] = {key: error(x, record) for key, x in found.items()}
    return Result(errors, known, noise)


def error(theta: Any, record: Record) -> np.ndarray:
    """(T,) [deg] within half a turn, the record's mean deducted, NaN where masked."""
    difference = np.rad2deg(np.angle(np.exp(1j * (np.asarray(theta) - record.angle))))
    return np.where(record.usable, difference - difference[record.usable].mean(), np.nan)


# ------------------------------------------------------------------------------------------------------------- tables


def _sums(errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums of squares and counts by second."""
    return _seconds(errors**2), _seconds(np.where(np.isfinite(errors), 1.0, np.nan))


def _bootstrap(count: np.ndarray) -> Bootstrap:
    return Bootstrap(count > 0, np.random.default_rng(0))


def table(result: Result, name: str = "encoder_recorded", what: str = "against the reference as recorded") -> Table:
    """Errors of all estimators."""
    rows: list[list[Entry]] = []
    order = [ATAN2, LOOP, FIXED, *[n for n in result.parameters if n != ATAN2], CALIBRATED, *OWNS]
    for label in order:
        row: list[Entry] = [label]
        for record in (CALIBRATION, *SCORED):
            e = result.errors[record][label]
            total, count = _sums(e)
            row += [_bootstrap(count).cell(total, count), Cell(float(np.nanmax(np.abs(e))))]
        row.append("-" if label == ATAN2 else "{} ({})".format(*over_atan2(result, label)))
        rows.append(row)
    header = ["estimator"]
    for record in (CALIBRATION, *SCORED):
        header += [f"{record}: RMS [deg]", f"{record}: max [deg]"]
    usable = {record: int(load(record).usable.sum()) for record in (CALIBRATION, *SCORED)}
    note = (
        f"Calibrated on {CALIBRATION}, scored on the other two; rows scored: "
        + ", ".join(f"{record} {n}" for record, n in usable.items())
        + f"; rows tilted by more than {TILT} rad are left out. Each record's mean error is deducted: no "
        "calibration without a reference can know it. Standard errors and the 95 % interval of the ratio: bootstrap of "
        "seconds."
    )
    return Table(name, f"A recorded sine/cosine pair, {what}", [*header, "both: RMS / atan2's"], rows, note)


def aligned_table(late: Result) -> Table:
    """Errors of all estimators once the delay between signals and reference is known."""
    lag, se = delay()
    what = f"against the reference {1e3 * lag:.1f} ± {1e3 * se:.1f} ms before"
    return table(late, "encoder_aligned", what)


def over_atan2(result: Result, name: str) -> tuple[Cell, str]:
    """RMS over both scored records relative to that of atan2, with its interval."""
    return contrast(_over_atan2(result, name))


def _over_atan2(result: Result, name: str) -> np.ndarray:
    draws = {}
    for key in (name, ATAN2):
        parts = [_sums(result.errors[record][key]) for record in SCORED]
        total, count = (np.concatenate(x) for x in zip(*parts, strict=True))
        draws[key] = _bootstrap(count).draw(total, count)
    return draws[name] / draws[ATAN2]


def own_ellipse(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Errors (T,) of atan2 without and with the record's own ellipse, which needs no reference."""
    p = ellipse_of(record, least_coverage=0.0).parameters
    found = [sincos.correct(jnp.asarray(record.ys), q)[0] for q in (Parameters(), p)]
    return error(found[0], record), error(found[1], record)


def noise_table(noise: dict[str, dict[str, float]]) -> Table:
    """What was learnt; :func:`published` reads it back."""
    rows: list[list[Entry]] = [
        [name, *(Cell(values[key], digits=6, exact=True) if key in values else "-" for key in NOISE)]
        for name, values in noise.items()
    ]  # fmt: skip
    note = (
        f"Innovation likelihood on {CALIBRATION}, Adam, 40 steps; q and r of the first row serve all filters but the "
        "one of the second. 1000 is the end of the box that the drift was searched in."
    )
    return Table("encoder_noise", "Noise learnt on the calibration record", ["filter", *NOISE.values()], rows, note)


def ellipse_table() -> Table:
    """Which records determine their ellipse."""
    rows: list[list[Entry]] = []
    for name in (CALIBRATION, *SCORED):
        record = load(name)
        fit = ellipse_of(record, least_coverage=0.0)
        verdict = "accepted" if fit.accepted and fit.coverage >= 0.75 else "refused: too little of a cycle"
        if fit.coverage >= 0.75 and not fit.accepted:
            verdict = "flagged"
        row: list[Entry] = [name, Cell(float(fit.coverage), exact=True)]
        row += [
            Cell(float(v), float(s)) for v, s in zip(fit.values[:4], fit.std[:4], strict=True)
        ]  # fmt: skip
        row.append(Cell(float(np.rad2deg(fit.values[4])), float(np.rad2deg(fit.std[4]))))
        row += [Cell(100 * float(fit.relative_std.max()), digits=2), verdict]
        plain, corrected = own_ellipse(aligned(record, delay()[0]))
        rows.append([*row, *(_bootstrap(count).cell(total, count) for total, count in map(_sums, (plain, corrected)))])
    header = ["record", "cycle covered", "offset, cos [uT]", "offset, sin [uT]", "radius, cos [uT]", "radius, sin [uT]",
              "quadrature [deg]", "largest deviation [%]", "verdict",
              "atan2: RMS [deg]", "own ellipse + atan2: RMS [deg]"]  # fmt: skip
    note = (
        "± is one standard deviation, seconds taken as independent. Accepted: at least 0.75 of a cycle and every "
        "deviation below 10 % (of the radius, or 0.1 rad). Errors: delay removed."
    )
    return Table("encoder_ellipse", "The ellipse of each record", header, rows, note)


def findings(result: Result, late: Result) -> list[str]:
    """What the records say, against the reference as recorded and shifted by the delay."""

    def rms(result, record, name):
        return f"{np.sqrt(np.nanmean(result.errors[record][name] ** 2)):.2f}°"

    def text(result, name):
        cell, interval = over_atan2(result, name)
        return f"{name} {float(cell.value):.2f} ({interval})"

    names = [n for n in result.parameters if n != ATAN2] + [CALIBRATED, *OWNS]

    def lower(result):
        return ", ".join(n for n in names if np.quantile(_over_atan2(result, n)[1:], 0.975) < 1) or "none"

    fits = {name: ellipse_of(load(name), least_coverage=0.0) for name in (CALIBRATION, SCORED[1])}
    a, b = (np.asarray(fit.values[:2]) for fit in fits.values())
    u = np.hypot(*(np.asarray(fit.std[:2]) for fit in fits.values()))
    lag, se = delay()
    better, worse = (float(np.sqrt(np.nanmean(e**2))) for e in own_ellipse(aligned(load(SCORED[1]), lag)))
    gone = [
        1 - np.nanmean(late.errors[record][ATAN2] ** 2) / np.nanmean(result.errors[record][ATAN2] ** 2)
        for record in SCORED
    ]
    return [
        f"Recorded pair: atan2 alone is off by {rms(result, SCORED[0], ATAN2)} and {rms(result, SCORED[1], ATAN2)} "
        "(RMS). Relative to it on both (95 % interval of resampled seconds): "
        + ", ".join(text(result, name) for name in (LOOP, FIXED, *names))
        + f". Calibrations whose whole interval lies below 1: {lower(result)}.",
        f"A part of {gone[0]:.2f} and {gone[1]:.2f} of that error's square is no imperfection of the pair: the signals "
        f"lag {1e3 * lag:.1f} ± {1e3 * se:.1f} ms behind the reference (found on {CALIBRATION}). Against the reference "
        f"shifted by that, atan2 is at {rms(late, SCORED[0], ATAN2)} and {rms(late, SCORED[1], ATAN2)}, and relative "
        "to it "
        + ", ".join(text(late, name) for name in names)
        + f". Calibrations whose whole interval lies below 1: {lower(late)}.",
        f"The ellipse is not the sensor's alone: between {CALIBRATION} and {SCORED[1]} its centre moves by "
        f"({b[0] - a[0]:.2f}, {b[1] - a[1]:.2f}) uT, {abs(b[0] - a[0]) / u[0]:.1f} and {abs(b[1] - a[1]) / u[1]:.1f} "
        f"standard deviations, and {SCORED[1]}'s own ellipse takes atan2 from {better:.2f}° to {worse:.2f}° (delay "
        "removed). The reference takes the field as the same all over the room and the axis as fixed: a gradient "
        "of the field and a tilt count as errors, which no calibration of the sensor removes.",
    ]
