"""The filters that the command line can make: their parameters with units and search boxes, and how they are built."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxfilt as jf
from jaxfilt import tune
from jaxfilt.cli.read import Recording
from jaxfilt.cli.units import BadInput, quantity

MODELS = {
    "cv": "nearly constant velocity",
    "ca": "nearly constant acceleration",
    "cj": "nearly constant jerk",
    "singer": "Singer's, exponentially correlated acceleration",
    "ct": "coordinated turn at unknown rate, planar",
}
_LINEAR = {"kalman": jf.kalman, "sqrt_kalman": jf.sqrt_kalman}
_GENERAL = {
    "extended": jf.extended,
    "sqrt_extended": jf.sqrt_extended,
    "unscented": jf.unscented,
    "sqrt_unscented": jf.sqrt_unscented,
    "cubature": jf.cubature,
    "sqrt_cubature": jf.sqrt_cubature,
}
FILTERS = (*_LINEAR, *_GENERAL, "alpha_beta", "alpha_beta_gamma", "imm")
_LETTERS = {"cv": "pv", "ca": "pva", "cj": "pvaj", "singer": "pva", "ct": "pvw"}  # blocks of a mode's state

# Kind of unit and meaning of every parameter.
PARAMETERS = {
    "sigma": ("length", "standard deviation of the measured positions"),
    "sigma_z": ("length", "standard deviation of the measured third axis"),
    "sigma_range": ("length", "standard deviation of the range"),
    "sigma_bearing": ("angle", "standard deviation of the bearing"),
    "q": ("m^2/s^3", "cv: white acceleration, spectral density"),
    "q_maneuver": ("m^2/s^3", "cv, the second of an IMM: white acceleration"),
    "q_jerk": ("m^2/s^5", "ca: white jerk"),
    "q_snap": ("m^2/s^7", "cj: white derivative of jerk"),
    "tau": ("time", "singer: correlation time of the acceleration"),
    "sigma_a": ("m/s^2", "singer: standard deviation of the acceleration"),
    "q_ct": ("m^2/s^3", "ct: white acceleration"),
    "q_omega": ("rad^2/s^3", "ct: noise on the turn rate"),
    "index": ("1", "alpha_beta, alpha_beta_gamma: tracking index, which sets the gains"),
    "life": ("time", "imm: mean life of a mode, as life_cv, life_ct"),
}
for _name in ("q", "q_maneuver", "q_jerk", "q_snap", "sigma_a"):
    PARAMETERS[f"{_name}_z"] = (PARAMETERS[_name][0], f"{_name} of the third axis")
UNITS = {"length": "m", "time": "s", "angle": "rad", "1": ""}
_POINTS = {"q": ("cv",), "q_maneuver": ("cv2",), "q_jerk": ("ca",), "q_snap": ("cj",), "sigma_a": ("singer",)}


class Choice(NamedTuple):
    """Which filter; hashable, so that it can be a static argument."""

    text: str  # as the user wrote it, or what it was completed to
    modes: tuple[str, ...]  # of MODELS; "cv2" is the second cv of an IMM
    filter: str
    d: int  # axes
    polar: bool
    dt: float  # s, the median interval


class Start(NamedTuple):
    """Where a piece of a track starts; leaves may have a leading axis of pieces."""

    position: Any  # (d,) m
    velocity: Any  # (d,) m/s
    variances: Any  # (5,) of position, velocity, acceleration, jerk and turn rate, wide


class Scale(NamedTuple):
    """Orders of magnitude of a recording, from which the search starts."""

    sigma: np.ndarray  # (m,) of the measured components
    dt: float  # s
    size: float  # m, how far it reaches
    speed: float  # m/s


def parse(text: str, rec: Recording, filt: str | None = None) -> Choice:
    """A filter from ``MODEL[:FILTER]``, e.g. ``cv``, ``ct:unscented``, ``cv+ca+ct:imm``."""
    model, _, after = text.partition(":")
    filt = after or filt
    modes = tuple(model.split("+"))
    d, polar = rec.fixes.shape[1], rec.kind == "polar"
    for mode in modes:
        if mode not in MODELS:
            raise BadInput(f"--model: expected {', '.join(MODELS)} or several with + for an IMM, got {mode!r}")
    if filt is None:
        filt = "imm" if len(modes) > 1 else "extended" if polar or modes == ("ct",) else "kalman"
    if filt not in FILTERS:
        raise BadInput(f"--filter: expected one of {', '.join(FILTERS)}, got {filt!r}")
    if filt == "imm" and len(modes) == 1:
        modes = ("cv", modes[0])
    if len(modes) > 1 and filt != "imm":
        raise BadInput(f"--filter: {filt} takes one model; several are an imm")
    if len(modes) == 2 and modes == ("cv", "cv"):
        modes = ("cv", "cv2")
    if len(set(modes)) < len(modes):
        raise BadInput(f"--model: {model!r} has a model twice")
    if "ct" in modes and d != 2:
        raise BadInput(f"--model: ct is planar and needs two columns of positions, not {d}")
    if filt in _LINEAR and ("ct" in modes or polar):
        what = "ct is a nonlinear model" if "ct" in modes else "range and bearing are a nonlinear sensor"
        raise BadInput(f"--filter: {what}, {filt} is for linear ones; take one of {', '.join(_GENERAL)}")
    needs = {"alpha_beta": "cv", "alpha_beta_gamma": "ca"}.get(filt)
    if needs and (modes != (needs,) or polar):
        raise BadInput(f"--filter: {filt} is a filter of positions with the model {needs}")
    label = f"{'+'.join('cv' if m == 'cv2' else m for m in modes)}:{filt}"
    return Choice(label, modes, filt, d, polar, float(rec.dt[0]))


def scale(rec: Recording, last: int | None = None) -> Scale:
    """Orders of magnitude, from second differences of the measurements and first ones of the positions.

    Rows from ``last`` on are not looked at.
    """
    fixes, times, mask = rec.fixes[:last], rec.times[:last], rec.mask[:last]
    ys = np.where(mask, rec.ys[:last], np.nan)
    if rec.kind == "polar":
        seen = mask[:, 1]
        ys[seen, 1] = np.unwrap(ys[seen, 1])
    second = np.abs(np.diff(ys, 2, axis=0))
    size = float(np.nanmax(np.nanmax(fixes, axis=0) - np.nanmin(fixes, axis=0)))
    size = max(size, 1e-6 * float(np.nanmax(np.abs(fixes))), 1e-9)
    sigma = np.empty(ys.shape[1])
    for i in range(len(sigma)):
        here = second[np.isfinite(second[:, i]), i]
        # Of white noise the median of |second difference| is 0.674 sqrt(6) sigma. Targets at rest, with rounded
        # positions, have a median of 0.
        typical = np.median(here) / 1.652 if here.size else 0.0
        spread = np.sqrt(np.mean(here**2) / 6) if here.size else 0.0
        floor = 1e-6 * (size if i == 0 or rec.kind == "position" else 1.0)
        sigma[i] = max(typical if typical > 0 else spread, floor)
    rows = np.flatnonzero(np.isfinite(fixes).all(axis=1))
    steps = np.diff(times[rows])
    moved = np.linalg.norm(np.diff(fixes[rows], axis=0), axis=1)[steps > 0] / steps[steps > 0]
    speed = float(np.sqrt(np.mean(moved**2))) if moved.size else 0.0
    return Scale(sigma, float(rec.dt[0]), size, max(speed, 1e-6 * size / float(rec.dt[0])))


def start(rec: Recording, rows: slice, s: Scale) -> Start:
    """Begins at the first fix of the rows, with the speed of the first few, and wide variances."""
    fixes, times = rec.fixes[rows], rec.times[rows]
    whole = np.flatnonzero(np.isfinite(fixes).all(axis=1))[:5]
    d = fixes.shape[1]
    position, velocity = np.zeros(d), np.zeros(d)
    if whole.size:
        position = fixes[whole[0]]
        t = times[whole] - times[whole].mean()
        if (t**2).sum() > 0:
            velocity = t @ fixes[whole] / (t**2).sum()
    wide = 10 * s.sigma[0] if rec.kind == "position" else 10 * (s.sigma[0] + s.sigma[1] * s.size)
    acceleration = (s.speed / (5 * s.dt)) ** 2
    variances = [wide**2, s.speed**2, acceleration, acceleration / s.dt**2, min(0.1, 0.3 / s.dt) ** 2]
    return Start(position, velocity, np.array(variances))


def space(choice: Choice, s: Scale, given: Mapping[str, float]) -> dict[str, Any]:
    """The parameters: specs for :mod:`jaxfilt.tune`, or plain values of those that are given."""
    dt, found = s.dt, {}
    level = float(s.sigma[0]) if not choice.polar else float(s.sigma[0] + s.sigma[1] * s.size)
    if choice.polar:
        found["sigma_range"] = _wide(float(s.sigma[0]), 1e3)
        found["sigma_bearing"] = tune.positive(float(s.sigma[1]), 1e-3 * float(s.sigma[1]), max(1.0, float(s.sigma[1])))
    else:
        found["sigma"] = _wide(float(s.sigma[:2].max()), 1e3)
        if choice.d == 3:
            found["sigma_z"] = _wide(float(s.sigma[2]), 1e3)
    if choice.filter.startswith("alpha"):
        found["index"] = tune.positive(0.3, 1e-4, 1e3)
    else:
        for name, values in _processes(choice, dt, level).items():
            found[name] = values
            if choice.d == 3 and name in _POINTS:
                found[f"{name}_z"] = values
    if choice.filter == "imm":
        for mode in choice.modes:
            found[f"life_{mode}"] = tune.positive(30 * dt, 2 * dt, 1e5 * dt)
    for name in given:
        if name in found:
            found[name] = float(given[name])
    return found


def _processes(choice, dt, level) -> dict[str, tune.Spec]:
    # A tracking index of 1 is where motion and noise are of the same size in one interval: nowhere is far from there.
    specs: dict[str, tune.Spec] = {}
    for mode in choice.modes:
        if mode == "cv":
            specs["q"] = _wide((0.01 if "cv2" in choice.modes else 0.3) * level**2 / dt**3, 1e7)
        elif mode == "cv2":
            specs["q_maneuver"] = _wide(10 * level**2 / dt**3, 1e7)
        elif mode == "ca":
            specs["q_jerk"] = _wide(0.1 * level**2 / dt**5, 1e7)
        elif mode == "cj":
            specs["q_snap"] = _wide(0.03 * level**2 / dt**7, 1e7)
        elif mode == "singer":
            specs["tau"] = tune.positive(10 * dt, 0.1 * dt, 1e4 * dt)
            specs["sigma_a"] = _wide(0.5 * level / dt**2, 1e4)
        else:
            specs["q_ct"] = _wide(0.1 * level**2 / dt**3, 1e7)
            specs["q_omega"] = tune.positive(1e-3 / dt**3, 1e-9 / dt**3, 1.0 / dt**3)
    return specs


def _wide(initial: float, factor: float) -> tune.Spec:
    return tune.positive(initial, initial / factor, initial * factor)


def check_given(given: Mapping[str, float], spaces: list[dict[str, Any]]) -> None:
    """Raises an error for a parameter that none of the filters has."""
    for name in given:
        if not any(name in one for one in spaces):
            known = sorted({key for one in spaces for key in one})
            raise BadInput(f"--set: the filter has no parameter {name!r}; it has {', '.join(known)}")


def parse_given(texts: list[str]) -> dict[str, float]:
    """``NAME=VALUE[UNIT]`` in SI."""
    found = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals:
            raise BadInput(f"--set: expected NAME=VALUE, got {text!r}")
        key = "life" if name.startswith("life_") else name
        if key not in PARAMETERS:
            raise BadInput(f"--set: there is no parameter {name!r}; known are {', '.join(PARAMETERS)}")
        found[name] = quantity(value, PARAMETERS[key][0], f"--set {name}")
        if not found[name] > 0:
            raise BadInput(f"--set {name}: expected a value above 0, got {value}")
    return found


def described(name: str, value: float) -> tuple[float, str]:
    """A parameter's value and unit as shown."""
    kind = PARAMETERS["life" if name.startswith("life_") else name][0]
    return (float(np.degrees(value)), "deg") if kind == "angle" else (value, UNITS.get(kind, kind))


# ----------------------------------------------------------------------------------------------------------- building


def make(choice: Choice, params: Mapping[str, Any], begin: Start) -> jf.Filter:
    """The filter for its parameters, which may be traced."""
    if choice.filter.startswith("alpha"):
        order = 1 if choice.filter == "alpha_beta" else 2
        gains = jf.gains.kalata(_array(params["index"]), order=order)
        factory = jf.alpha_beta if order == 1 else jf.alpha_beta_gamma
        return factory(*gains, dt=choice.dt, r=_measured(choice, params))
    filters = [_mode(choice, mode, params, begin) for mode in choice.modes]
    if choice.filter != "imm":
        return filters[0]
    union = [c for c in _components("pvajw", choice.d) if any(c in components(choice, m) for m in choice.modes)]
    index = [[union.index(c) for c in components(choice, mode)] for mode in choice.modes]
    lives = jnp.stack([_array(params[f"life_{mode}"]) for mode in choice.modes])
    r = len(choice.modes)
    leave = -jnp.expm1(-choice.dt / lives)
    off = (1 - np.eye(r)) / (r - 1)
    transition = jnp.diag(1 - leave) + leave[:, None] * jnp.asarray(off, lives.dtype)
    return jf.imm(filters, transition, index=index)


def components(choice: Choice, mode: str) -> list[str]:
    """A mode's state: a letter for position, velocity, acceleration, jerk with the axis, and w."""
    return _components(_LETTERS[mode.rstrip("2")], choice.d)


def state_letters(choice: Choice) -> list[str]:
    """The filter's state, of an IMM the union of its modes."""
    if choice.filter.startswith("alpha"):
        return _components("pv" if choice.filter == "alpha_beta" else "pva", choice.d)
    return [c for c in _components("pvajw", choice.d) if any(c in components(choice, m) for m in choice.modes)]


def _components(letters: str, d: int) -> list[str]:
    return [c for letter in letters for c in (["w"] if letter == "w" else [f"{letter}{i}" for i in range(d)])]


def _mode(choice: Choice, mode: str, params: Mapping[str, Any], begin: Start) -> jf.Filter:
    m0, P0 = _prior(choice, mode, begin)
    common: dict[str, Any] = {"dt": choice.dt, "m0": m0, "P0": P0, "r": _measured(choice, params)}
    models = jf.models
    if mode in ("cv", "cv2"):
        model = models.constant_velocity(q=_axes(choice, params, "q" if mode == "cv" else "q_maneuver"), **common)
    elif mode == "ca":
        model = models.constant_acceleration(q=_axes(choice, params, "q_jerk"), **common)
    elif mode == "cj":
        model = models.constant_jerk(q=_axes(choice, params, "q_snap"), **common)
    elif mode == "singer":
        variance = _axes(choice, params, "sigma_a") ** 2
        model = models.singer(tau=_array(params["tau"]), variance=variance, **common)
    else:
        model = models.coordinated_turn(q=_array(params["q_ct"]), q_omega=_array(params["q_omega"]), **common)
    if choice.polar:
        variances = jnp.stack([_array(params["sigma_range"]), _array(params["sigma_bearing"])]) ** 2
        model = models.with_sensor(model, models.sensors.range_bearing(jnp.diag(variances)))
    if choice.filter == "imm":
        return jf.extended(model) if choice.polar or mode == "ct" else jf.kalman(model)  # pyright: ignore[reportArgumentType]
    return {**_LINEAR, **_GENERAL}[choice.filter](model)  # pyright: ignore[reportArgumentType]


def _prior(choice, mode, begin) -> tuple[Array, Array]:
    of = {letter: i for i, letter in enumerate("pvajw")}
    names = components(choice, mode)
    zero = jnp.zeros(())
    means = {"p": begin.position, "v": begin.velocity}
    m0 = jnp.stack([means[c[0]][int(c[1])] if c[0] in means else zero for c in names])
    return m0, jnp.diag(jnp.stack([jnp.asarray(begin.variances)[of[c[0]]] for c in names]))


def _measured(choice, params) -> Array:
    """Variances (d,) of measured positions; a stand-in where the sensor is replaced."""
    if choice.polar:
        return jnp.ones((2,))
    return _axes(choice, params, "sigma") ** 2


def _axes(choice, params, name) -> Array:
    values = [_array(params[name])] * choice.d
    if choice.d == 3:
        values[2] = _array(params[f"{name}_z"])
    return jnp.stack(values)


def _array(x) -> Array:
    return jnp.asarray(x, jnp.zeros(()).dtype)
