"""Scenarios G1 and G2 of the specification: their truths, filters, strategies and scores."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf

Strategy = Callable[[jf.Filter], jf.Filter]


class Gap(NamedTuple):
    """A scenario's sampling and its gap."""

    name: str
    T: int  # samples
    dt: float  # s
    first: int  # first lost sample
    last: int  # last lost sample
    after: int  # samples scored after the gap
    strategies: dict[str, Strategy]

    @property
    def mask(self) -> np.ndarray:
        """(T,) bool, False in the gap."""
        return jf.simulate.gap_mask(self.T, (self.first, self.last))


def _coast(filt: jf.Filter) -> jf.Filter:
    return filt


def _fit(window: int, degree: int, weighted: bool = False) -> Strategy:
    return lambda filt: jf.polynomial_fit(filt, window=window, degree=degree, weighted=weighted)


G1 = Gap(
    "G1", T=41, dt=1.0, first=20, last=25, after=5,
    strategies={
        "coast": _coast,
        "coast_inflated x10": lambda filt: jf.coast_inflated(filt, 10.0),
        "coast_inflated x100": lambda filt: jf.coast_inflated(filt, 100.0),
        "hold": jf.hold_last,
        "mean 5": jf.mean_of_recent,
        "fit N10 p1": _fit(10, 1),
        "fit N5 p1": _fit(5, 1),
        "fit N20 p2": _fit(20, 2),
        "fit_weighted N10 p1": _fit(10, 1, weighted=True),
        "fit_ci N10 p1": jf.covariance_intersection,
        "blend": jf.blend,
    },
)  # fmt: skip

G2 = Gap(
    "G2", T=81, dt=0.1, first=20, last=50, after=10,
    strategies={
        "coast": _coast,
        "coast_inflated x10": lambda filt: jf.coast_inflated(filt, 10.0),
        "hold": jf.hold_last,
        "mean 5": jf.mean_of_recent,
        "fit N20 p1": _fit(20, 1),
        "fit N20 p2": _fit(20, 2),
        "fit N20 p3": _fit(20, 3),
        "fit_weighted N20 p2": _fit(20, 2, weighted=True),
        "fit_ci N20 p2": lambda filt: jf.covariance_intersection(filt, window=20, degree=2),
        "blend": lambda filt: jf.blend(filt, candidates=((20, 1), (20, 2)), horizon=8, origins=5),
    },
)  # fmt: skip


def g1_model(q: Any = 0.1) -> jf.models.LinearGaussian:
    """The constant-velocity model of G1, [m, m/s]; q [m^2/s^3]."""
    return jf.models.constant_velocity(dt=1.0, q=q, r=25.0, m0=[0.0, 10.0], P0=[[100.0, 0.0], [0.0, 25.0]])


def g1_acceleration_model(q: Any = 0.01) -> jf.models.LinearGaussian:
    """The constant-acceleration filter for the accelerating target of G1; q [m^2/s^5]."""
    P0 = np.diag([100.0, 25.0, 1.0]).tolist()
    return jf.models.constant_acceleration(dt=1.0, q=q, r=25.0, m0=[0.0, 10.0, 0.0], P0=P0)


def g2_model(q: Any = 0.05) -> jf.models.LinearGaussian:
    """The constant-acceleration model of G2; q [m^2/s^5]."""
    return jf.models.constant_acceleration(dt=0.1, q=q, r=0.01, m0=[0.0, 0.0, 2.0], P0=np.eye(3).tolist())


def g2_velocity_model(q: Any = 1.0) -> jf.models.LinearGaussian:
    """The constant-velocity filter on the truth of G2, structurally wrong; q [m^2/s^3]."""
    return jf.models.constant_velocity(dt=0.1, q=q, r=0.01, m0=[0.0, 0.0], P0=np.eye(2).tolist())


def matched(gap: Gap, model: jf.models.LinearGaussian) -> jf.Scenario:
    """Runs drawn from the model itself; the prior is that of the first sample."""
    return jf.scenario(model, gap.T, mask=gap.mask, first_update_only=True)


def accelerating(gap: Gap, model: jf.models.LinearGaussian, acceleration: float) -> jf.Scenario:
    """Runs drawn from the model with a constant acceleration [m/s^2] added that the filter does not know of.

    The tables have a model without process noise here, as the specification's prototype had.
    """
    t = gap.dt * np.arange(gap.T)
    path = np.stack([0.5 * acceleration * t**2, acceleration * t], axis=1)
    return jf.Scenario(Partial(_draw_accelerating, model, path), gap.mask, first_update_only=True)


def _draw_accelerating(model: jf.models.LinearGaussian, path: Array, key: Array) -> jf.simulate.Simulated:
    states, ys = jf.simulate.simulate(model, path.shape[0], key, first_update_only=True)
    return jf.simulate.Simulated(states + path, ys + path[:, :1])


class Reported(NamedTuple):
    """What a strategy reports per step."""

    position: Array  # () of the state, or the blend's in the gap
    own: Array  # () the filter's own position
    variance: Array  # () of that
    status: Array


def reported(state: Any, info: jf.Info) -> Reported:
    """``outputs`` of the filter."""
    del state
    assert info.cov is not None
    return Reported(info.extra.get("reported", info.mean)[0], info.mean[0], info.cov[0, 0], info.status)


def scorer(gap: Gap, *, course: bool = False) -> Partial:
    """The score of a run: mean squared position errors over the gap, at its last sample and after it; NEES there.

    With ``course`` also the squared error at every sample, for the figure.
    """
    return Partial(_score, jf.Static((gap.first, gap.last, gap.after, course)))


def _score(static: jf.Static, truth: Array, ys: Array, out: Reported) -> dict[str, Array]:
    del ys
    first, last, after, course = static.value
    squared = (out.position - truth[:, 0]) ** 2
    scores = {
        "gap": jnp.mean(squared[first : last + 1]),
        "end": squared[last],
        "after": jnp.mean(squared[last + 1 : last + 1 + after]),
        "nees": (out.own[last] - truth[last, 0]) ** 2 / out.variance[last],  # the blend reports no variance of its own
    }
    return {**scores, "course": squared} if course else scores


def wiener_model() -> jf.models.LinearGaussian:
    """The thesis's two-dimensional Wiener-acceleration target, its eqs. (2-61) to (2-67)."""
    P0 = np.diag([0.1, 0.1, 0.1, 0.1, 0.5, 0.5]).tolist()
    return jf.models.constant_acceleration(dt=0.5, q=0.2, r=10.0, m0=[0.0] * 6, P0=P0)


def wiener_scenario() -> jf.Scenario:
    """50 samples from a start at the origin at rest; the prior is one step earlier."""
    return jf.Scenario(Partial(_draw_wiener, wiener_model()))


def _draw_wiener(model: jf.models.LinearGaussian, key: Array) -> jf.simulate.Simulated:
    return jf.simulate.simulate(model, 50, key, x0=model.m0)


def wiener_score(truth: Array, ys: Array, out: jf.Info) -> dict[str, Array]:
    """Position MSE per axis of the measurements, the filter and the smoother."""
    position = truth[:, :2]
    return {
        "raw": jnp.mean((ys - position) ** 2),
        "filtered": jnp.mean((out.mean[:, :2] - position) ** 2),
        "smoothed": jnp.mean((jf.rts(out).mean[:, :2] - position) ** 2),
    }
