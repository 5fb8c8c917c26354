"""Targets in the plane by CV, CA, CT and IMM: the filters that the experiments on recorded tracks tune and compare."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from experiments.report import Cell, Entry, Table
from jaxfilt import tune
from jaxfilt.models.turn import arc

# The modes of each filter. An IMM of two or three modes, a bank of one otherwise.
MODES = {
    "CV": ("CV",),
    "CA": ("CA",),
    "CT": ("CT",),
    "IMM (CV, CT)": ("CV", "CT"),
    "IMM (CV, CA, CT)": ("CV", "CA", "CT"),
    "IMM (CV, CT in wind)": ("CV", "CTW"),
}
# Where each mode's state stands in [x, y, vx, vy, ax, ay, omega, wx, wy], or in its beginning without what no mode has.
_COMPONENTS = {"CV": "xyuv", "CA": "xyuvab", "CT": "xyuvo", "CTW": "xyuvowz"}


class Start(NamedTuple):
    """The prior of all modes."""

    mean: Any  # (4,) position and velocity
    cov: Any  # (4, 4)
    acceleration: Any = 1.0  # variance per axis, mean 0 [m^2/s^4]
    turn_rate: Any = 0.01  # variance, mean 0 [rad^2/s^2]
    wind: Any = 25.0  # variance per axis, mean 0 [m^2/s^2]


class Scale(NamedTuple):
    """Where the search for the noise begins: the same for every filter that has the parameter."""

    r: float  # measurement variance per axis [m^2]
    q: float = 1.0  # white acceleration of CV and CT [m^2/s^3]
    q_jerk: float = 0.1  # white jerk of CA [m^2/s^5]
    q_omega: float = 1e-3  # white turn acceleration of CT [rad^2/s^3]
    q_wind: float = 0.01  # random walk of the wind [m^2/s^3]
    stay: float = 0.95  # probability that a mode lasts from one sample to the next


class Data(NamedTuple):
    """Pieces of tracks of one length, each about its first position; what is padded is masked."""

    ys: Any  # (B, T, 2) m
    mask: Any  # (B, T, 2) bool, what is seen
    dt: Any  # (B, T) s


def space(name: str, scale: Scale) -> dict[str, Any]:
    """The parameters of a filter of :data:`MODES`, for :mod:`jaxfilt.tune`."""
    modes = MODES[name]
    specs: dict[str, Any] = {"r": _noise(scale.r)}
    if "CV" in modes:
        specs["cv_q"] = _noise(scale.q)
    if "CA" in modes:
        specs["ca_q"] = _noise(scale.q_jerk)
    if "CT" in modes or "CTW" in modes:
        specs["ct_q"] = _noise(scale.q)
        specs["ct_q_omega"] = _noise(scale.q_omega)
    if "CTW" in modes:
        specs["q_wind"] = _noise(scale.q_wind)
    if len(modes) > 1:
        specs["stay"] = tune.interval(jnp.full(len(modes), scale.stay), 0.5, 0.9999)
    return specs


def _noise(initial: float) -> tune.Spec:
    return tune.positive(initial, 1e-5 * initial, 1e5 * initial)


def make(name: str, params: Mapping[str, Any], start: Start, sensor: jf.models.Sensor | None = None) -> jf.Filter:
    """A filter of :data:`MODES` for its parameters; linear modes by the Kalman filter, the others by the EKF.

    Args:
        name: a key of :data:`MODES`.
        params: values for the specs of :func:`space`.
        start: the prior.
        sensor: instead of the position with variance ``params["r"]``.
    """
    modes = MODES[name]
    filters = [_mode(mode, params, start, sensor) for mode in modes]
    if len(filters) == 1:
        return filters[0]
    union = "".join(c for c in "xyuvabowz" if any(c in _COMPONENTS[mode] for mode in modes))
    index = [[union.index(c) for c in _COMPONENTS[mode]] for mode in modes]
    stay = jnp.asarray(params["stay"])
    r = len(modes)
    leave = ((1 - stay) / (r - 1))[:, None] * jnp.ones((r, r), stay.dtype)
    transition = jnp.where(jnp.eye(r, dtype=bool), stay[:, None], leave)
    return jf.imm(filters, transition, index=index)


def _mode(mode: str, params: Mapping[str, Any], start: Start, sensor: jf.models.Sensor | None) -> jf.Filter:
    mean, cov = jnp.asarray(start.mean), jnp.asarray(start.cov)
    r = params["r"]
    model: Any
    if mode == "CV":
        model = jf.models.constant_velocity(dt=1.0, q=params["cv_q"], r=r, m0=mean, P0=cov)
    elif mode == "CA":
        m0, P0 = _extend(mean, cov, 2, start.acceleration)
        model = jf.models.constant_acceleration(dt=1.0, q=params["ca_q"], r=r, m0=m0, P0=P0)
    else:
        m0, P0 = _extend(mean, cov, 1, start.turn_rate)
        model = jf.models.coordinated_turn(dt=1.0, q=params["ct_q"], q_omega=params["ct_q_omega"], r=r, m0=m0, P0=P0)
        if mode == "CTW":
            model = in_wind(model, params["q_wind"], start.wind)
    if sensor is not None:
        return jf.extended(jf.models.with_sensor(model, sensor))
    return jf.extended(model) if mode in ("CT", "CTW") else jf.kalman(model)


def _extend(mean: Array, cov: Array, count: int, variance: Any) -> tuple[Array, Array]:
    """The prior with further components of mean 0."""
    extra = jnp.asarray(variance, mean.dtype) * jnp.eye(count, dtype=mean.dtype)
    zeros = jnp.zeros((len(mean), count), mean.dtype)
    return jnp.pad(mean, (0, count)), jnp.block([[cov, zeros], [zeros.T, extra]])


def in_wind(turn: jf.models.Nonlinear, q_wind: Any, variance: Any) -> jf.models.Nonlinear:
    """A coordinated turn in moving air: the velocity less the wind turns. The wind follows the turn rate in the state.

    The velocity stays that over ground, so it means the same in all modes of an IMM.
    """
    m0, P0 = _extend(turn.m0, turn.P0, 2, variance)
    Q = Partial(_wind_noise, turn.Q, jnp.asarray(q_wind))
    return jf.models.nonlinear(_turn_in_wind, turn.h, Q, turn.R, m0, P0)


def _turn_in_wind(x, u, dt):
    del u
    s, c, cos, sin = arc(x[4], dt)
    wind = x[5:7]
    a, b = x[2] - wind[0], x[3] - wind[1]  # through the air
    position = x[:2] + wind * dt + jnp.stack([s * a + c * b, -c * a + s * b])
    velocity = wind + jnp.stack([cos * a - sin * b, sin * a + cos * b])
    return jnp.concatenate([position, velocity, x[4:]])


def _wind_noise(turn_noise, q_wind, x, u, dt):
    Q = jnp.pad(turn_noise(x[:5], u, dt), (0, 2))
    return Q + q_wind * dt * jnp.diag(jnp.asarray([0.0] * 5 + [1.0] * 2, Q.dtype))


# ------------------------------------------------------------------------------------------------------------- tuning

# One optimizer and one budget for every filter.
OPTIMIZER = optax.adam(0.2)
STARTS = 2
STEPS = 60


def loss(name: jf.Static, start: Start, warmup: jf.Static, params: dict[str, Array], data: Data) -> Array:
    """Innovation likelihood of what is seen, without the first ``warmup`` samples of each piece."""
    filt = make(name.value, params, start)
    return tune.innovation_nll(
        filt, data.ys, mask=data.mask, dt=data.dt, warmup=warmup.value, first_update_only=True
    )  # fmt: skip


def learn(
    name: str, scale: Scale, start: Start, data: Data, *, warmup: int, steps: int = STEPS, starts: int = STARTS
) -> tune.TuneResult:
    """The noise of a filter: the best of some starts, the first of which is the scale, the others half-way from it."""
    objective = Partial(loss, jf.Static(name), start, jf.Static(warmup))
    return tune.gradient(
        objective, space(name, scale), data,
        key=jax.random.key(0), optimizer=OPTIMIZER, steps=steps, starts=starts, spread=0.5, block=steps,
    )  # fmt: skip


_SCALARS = ("r", "cv_q", "ca_q", "ct_q", "ct_q_omega", "q_wind")


def tuning_table(table: str, learnt: Mapping[str, tune.TuneResult], note: str) -> Table:
    """What was learnt, and at which price. :func:`read_parameters` reads the parameters back."""
    found = {name: np_params(result.params) for name, result in learnt.items()}
    scalars = [key for key in _SCALARS if any(key in params for params in found.values())]
    stay = max(np.size(params.get("stay", ())) for params in found.values())
    rows: list[list[Entry]] = []
    for name, result in learnt.items():
        params = found[name]
        row: list[Entry] = [name, Cell(result.loss, digits=4)]
        row += [Cell(float(params[key])) if key in params else "-" for key in scalars]
        values = np.ravel(params.get("stay", ()))
        row += [Cell(float(values[i]), digits=4) if i < len(values) else "-" for i in range(stay)]
        rows.append([*row, result.evaluations, Cell(result.wall_time, digits=2), Cell(result.compile_time, digits=2)])
    header = ["filter", "loss [nats]", *scalars, *(f"stay {i + 1}" for i in range(stay)), "evaluations", "time [s]",
              "compilation [s]"]  # fmt: skip
    return Table(table, "Tuning by innovation likelihood", header, rows, note)


def read_parameters(table: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The parameters in the JSON form of a :func:`tuning_table`, by filter."""
    found = {}
    for name, *entries in table["rows"]:
        values = {h: e["value"] for h, e in zip(table["header"][1:], entries, strict=True) if not isinstance(e, str)}
        params: dict[str, Any] = {key: values[key] for key in _SCALARS if key in values}
        if stay := [values[key] for key in values if key.startswith("stay")]:
            params["stay"] = np.array(stay)
        found[name] = params
    return found


def np_params(params: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters as NumPy arrays."""
    return {key: np.asarray(value) for key, value in params.items()}


def in_parallel(function, jobs: Iterable):
    """``[function(job) for job in jobs]``. Nearly all the time goes into compiling, which two threads can share."""
    with ThreadPoolExecutor(max_workers=2) as pool:
        return list(pool.map(function, jobs))


# ------------------------------------------------------------------------------------------------------------- scores


def exact(entry: Entry) -> Entry:
    """A cell that depends on the parameters only, which a re-run reads: the same to 1e-6."""
    return replace(entry, exact=True) if isinstance(entry, Cell) else entry


def ratio(over: np.ndarray, under: np.ndarray) -> tuple[Cell, str]:
    """The ratio of two :meth:`Bootstrap.draw` of the same group with its standard error, and its interval of 95 %."""
    return contrast(over / under)


def contrast(draws: np.ndarray) -> tuple[Cell, str]:
    """What is first in the draws with its standard error, and the percentile interval of 95 % as text."""
    low, high = np.quantile(draws[1:], [0.025, 0.975])
    se = float(np.std(draws[1:], ddof=1))
    return Cell(float(draws[0]), se, exact=True), f"{Cell(float(low))} to {Cell(float(high))}"


def block_sums(block: np.ndarray, part: np.ndarray, x: Any = 1.0) -> np.ndarray:
    """Sums of x over the samples of a part, by block (an array of indices like ``part``)."""
    return np.bincount(block.ravel(), np.where(part, x, 0.0).ravel(), minlength=int(block.max()) + 1)


def pad(x: np.ndarray, T: int) -> np.ndarray:
    """x (t, ...) with zeros behind it, (T, ...)."""
    return np.pad(x, [(0, T - len(x))] + [(0, 0)] * (x.ndim - 1))
