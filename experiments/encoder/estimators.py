"""The estimators that are compared on the simulated encoder, and how their errors are measured."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxfilt as jf
from experiments.encoder.lbfgs import Minimum, minimize
from experiments.encoder.system import CYCLES, DT, HOLDS, MOVES, SETTLED, TURN, Data
from jaxfilt import sincos
from jaxfilt.sincos import Parameters

COUNTS = 1024  # of the converter, per cycle
Q, R = 200.0**2, 1e-6  # acceleration [rad^2/s^4], signals
LOOP = (0.31, 0.058)  # alpha, beta
P0 = np.diag(np.array([1e-1, 30.0, 0.03, 0.03, 0.05, 0.06, 0.05, 0.02]) ** 2)
DRIFT = np.array([1e-12, 1e-12, 1e-8, 1e-12, 1e-12, 1e-12]) / DT  # per second

ARCTAN, PLAIN = "arctan, 10 bits", "arctan"
ALPHA_BETA, FIXED = "tracking loop (alpha-beta)", "EKF, fixed parameters"
ELLIPSE = "ellipse of the turn + arctan"
OWN, OWN_NO_H3, OWN_COLD = "self-calibrating EKF", "self-calibrating EKF, no h3", "self-calibrating EKF, cold start"


def fixed_ekf(y0: Array) -> jf.Filter:
    """[theta, omega] with the parameters of an ideal sensor, from the first sample."""
    m0 = jnp.stack([sincos.correct(y0, Parameters())[0], jnp.zeros(())])
    return jf.extended(jf.models.sine_cosine(dt=DT, q=Q, r=R, m0=m0, P0=P0[:2, :2]))


class Own(NamedTuple):
    """What a self-calibrating filter starts from."""

    P0: Any = P0
    drift: Any = DRIFT


_NO_H3 = np.arange(8) != 7
WITH_H3 = Own()
WITHOUT_H3 = Own(P0 * np.outer(_NO_H3, _NO_H3), DRIFT * _NO_H3[2:])  # it stays 0


def own_ekf(y0: Array, own: Own) -> jf.Filter:
    """With the sensor's parameters as states."""
    theta = sincos.correct(y0, Parameters())[0]
    m0 = jnp.zeros((8,)).at[0].set(theta).at[4].set(1.0)
    return jf.extended(jf.models.sine_cosine(dt=DT, q=Q, r=R, m0=m0, P0=own.P0, drift=own.drift))


def loop(y0: Array, gains: Any = LOOP, dt: float = DT) -> jf.Filter:
    """The type-II loop from the first sample."""
    m0 = jnp.stack([sincos.correct(y0, Parameters())[0], jnp.zeros(())])
    return jf.phase_locked(jf.alpha_beta(*gains, dt=dt, m0=m0))


def mean(state: Any, info: jf.Info) -> Array:
    """The estimate alone, for :func:`jf.filter`."""
    del state
    return info.mean


@partial(jax.jit, static_argnames=("make",))
def track(make: Callable, ys: Array, *options: Any) -> Array:
    """(D, T, n) states of the filter that ``make(y[0], *options)`` gives for each run."""

    def one(y):
        return jf.filter(make(y[0], *options), y, outputs=mean, first_update_only=True)

    return jax.vmap(one)(ys)


@partial(jax.jit, static_argnames=("counts",))
def angles(ys: Array, parameters: Parameters, counts: int | None = None) -> Array:
    """(D, T) arc tangents of corrected signals, unwrapped [rad]; parameters (D,) each."""
    return jax.vmap(lambda y, p: sincos.arctan(y, p, counts=counts).angle)(ys, parameters)


def ideal(count: int) -> Parameters:
    """(count,) each of an ideal sensor's parameters."""
    return Parameters(*(jnp.full((count,), x) for x in Parameters()))


@jax.jit
def ellipses(ys: Array) -> jf.EllipseFit:
    """The ellipse of each run's turn."""
    return jax.vmap(lambda y: jf.fit_ellipse(y[:TURN]))(ys)


# -------------------------------------------------------------------------------------------- calibration by gradient

SUPERVISED, POINTS, RADIUS, SMOOTH = "supervised, turn", "supervised, 22 points", "radius, turn", "smoothness + radius"
TUNED = {
    SUPERVISED: ("offset_a", "offset_b", "gain", "quadrature", "h3", "h5"),
    POINTS: ("offset_a", "offset_b", "gain", "quadrature"),
    RADIUS: ("offset_a", "offset_b", "gain", "quadrature"),
    SMOOTH: ("offset_a", "offset_b", "gain", "quadrature", "h3", "h5"),
}
ALL = TUNED[SUPERVISED]
WEIGHTS = {SUPERVISED: (1.0, 0.0, 0.0), POINTS: (1.0, 0.0, 0.0), RADIUS: (0.0, 1.0, 0.0), SMOOTH: (0.0, 0.0, 1.0)}
SCALE = 0.02  # of one unit of the search, near the size of the imperfections
POINTS_AT = np.concatenate(list(HOLDS.values()))


def as_parameters(z: Array) -> Parameters:
    return Parameters()._replace(**{name: SCALE * z[i] for i, name in enumerate(ALL)})


@partial(jax.jit, static_argnames=("reference_only",))
def search(weights: Array, keep: Array, ys: Array, reference: Array, reference_only: bool = False) -> Minimum:
    """The minimum (D, ...) of the weighted losses: supervised, radius, smoothness. ``keep`` (6,): what is not frozen.

    One program for all losses, as compiling it is what costs. One run after the other, each until its gradient
    vanishes: side by side all would wait for the slowest line search.
    """

    def one(run):
        y, angle = run

        def value(z):
            p = as_parameters(keep * z)
            # in units in which the loss is near 1, which is where L-BFGS begins its first step
            if reference_only:
                return 1e4 * sincos.supervised_loss(p, y, angle)
            losses = sincos.supervised_loss(p, y, angle), sincos.radius_loss(p, y), sincos.smoothness_loss(p, y)
            return 1e4 * (weights * jnp.stack(losses)).sum()

        found = minimize(value, jnp.zeros((len(ALL),)))
        return found._replace(z=keep * found.z)

    return jax.lax.map(one, (ys, reference))


def weights_of(name: str) -> tuple[Array, Array]:
    """The weights and the parameters kept of a named loss, for :func:`search`."""
    return jnp.asarray(WEIGHTS[name]), jnp.asarray([float(x in TUNED[name]) for x in ALL])


class Calibration(NamedTuple):
    """What was found; (D,) each."""

    parameters: Parameters
    loss: Array
    slope: Array  # norm of the gradient where the search ended
    evaluations: Array  # of a value and a gradient


def calibrate(name: str, ys: Array, angle: Array) -> Calibration:
    """Calibrates runs by L-BFGS from an ideal sensor; angle (D, T) [deg]."""
    seen = POINTS_AT if name == POINTS else np.arange(TURN)
    found = search(*weights_of(name), ys[:, seen], jnp.deg2rad(CYCLES * angle[:, seen]), name == POINTS)
    return Calibration(as_parameters(found.z.T), found.loss, found.slope, found.evaluations)


# ------------------------------------------------------------------------------------------------------------- scores


def scores(theta: Array, angle: Array, start: int = 0) -> dict[str, np.ndarray]:
    """Errors of estimates (D, T) [rad, electrical] against the shaft's angle (D, T) [deg], by part and measure: (D,).

    A move: at its ten reference points, the error at its first one deducted; "moves": the RMS over both. The turn, and
    its second half: all samples, the mean deducted. ``start``: first sample of the estimates; parts before it are left
    out.
    """
    error = np.rad2deg(sincos.mechanical(np.asarray(theta), CYCLES)) - np.asarray(angle)[:, start:]
    found = {}

    def add(part, e):
        found[part, "max"] = np.abs(e).max(axis=1)
        found[part, "rms"] = np.sqrt((e**2).mean(axis=1))

    for move, points in HOLDS.items():
        at = error[:, points - start]
        add(f"{move:g}° move", at[:, 1:] - at[:, :1])
    found["moves", "rms"] = np.sqrt(np.mean([found[f"{move:g}° move", "rms"] ** 2 for move in MOVES], axis=0))
    if start == 0:
        for part, first in (("turn", SETTLED), ("second half", TURN // 2)):
            e = error[:, first:TURN]
            add(part, e - e.mean(axis=1, keepdims=True))
    return {f"{part} {measure}": x for (part, measure), x in found.items()}


PARTS = (*(f"{move:g}° move" for move in MOVES), "turn", "second half")
Scores = dict[str, dict[str, np.ndarray]]


def compare(data: Data) -> tuple[Scores, Array]:
    """All estimators on the same runs, and the self-calibrating filter's states (D, 8) after the turn."""
    ys, count = data.ys, len(data.ys)
    fit, own = ellipses(ys), track(own_ekf, ys, WITH_H3)
    found = {
        ARCTAN: angles(ys, ideal(count), COUNTS),
        PLAIN: angles(ys, ideal(count)),
        ALPHA_BETA: track(loop, ys)[..., 0],
        FIXED: track(fixed_ekf, ys)[..., 0],
        ELLIPSE: angles(ys, ideal(count)._replace(**ellipse_parameters(fit))),
        OWN: own[..., 0],
        OWN_NO_H3: track(own_ekf, ys, WITHOUT_H3)[..., 0],
    }
    result = {name: scores(theta, data.angle) for name, theta in found.items()}
    # of the same length, so that nothing more is compiled; what is past the end is not looked at
    late = jnp.pad(ys[:, TURN:], ((0, 0), (0, TURN), (0, 0)), mode="edge")
    cold = track(own_ekf, late, WITH_H3)[:, : ys.shape[1] - TURN, 0]
    result[OWN_COLD] = scores(cold, data.angle, TURN)
    return result, own[:, TURN - 1]


def ellipse_parameters(fit: jf.EllipseFit) -> dict[str, Any]:
    """What a correction takes from a fit."""
    return {name: getattr(fit.parameters, name) for name in ("offset_a", "offset_b", "amplitude", "gain", "quadrature")}


def calibrations(data: Data, names: tuple[str, ...]) -> tuple[Scores, dict[str, Calibration]]:
    """All losses on the same runs: errors of the corrected arc tangent, and what was found."""
    found = {name: calibrate(name, data.ys, data.angle) for name in names}
    count = len(data.ys)
    result = {"none": scores(angles(data.ys, ideal(count)), data.angle)}
    for name, calibration in found.items():
        result[name] = scores(angles(data.ys, full(calibration.parameters, count)), data.angle)
    return result, found


def full(parameters: Parameters, count: int) -> Parameters:
    """Parameters (count,) each."""
    return Parameters(*(jnp.broadcast_to(jnp.asarray(x), (count,)) for x in parameters))
