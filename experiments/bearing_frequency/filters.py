"""The filters, and the runs of all of them: scenarios and runs are batched, histories are reduced as they are made."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxfilt as jf
from experiments.bearing_frequency import printed
from experiments.bearing_frequency.scenarios import (
    CONVERGED,
    NOISE,
    SIGMA,
    STEPS,
    Geometry,
    Runs,
    covariance_r,
    model,
    squared_errors,
)

CHUNK = 100  # runs at once: histories of more would fill the memory
LOST = 500.0  # m: a run whose position RMSE after convergence is above this has lost its target
ADAPTIVE = ("MC-EKF + residual R", "MC-EKF + innovation R", "MC-EKF + sage_husa")
QUANTITIES = ("position", "speed", "course", "base frequency", "bearing", "received frequency")


def ekf(m: jf.models.Nonlinear) -> jf.Filter:
    return jf.extended(m)


def mc_ekf(m: jf.models.Nonlinear) -> jf.Filter:
    return jf.extended(m, relinearize=True)


def mc_printed_second(m: jf.models.Nonlinear) -> jf.Filter:
    return jf.extended(printed.second_order(m), relinearize=True)


def soekf(m: jf.models.Nonlinear) -> jf.Filter:
    return jf.extended(m, order=2)


def ukf(m: jf.models.Nonlinear) -> jf.Filter:
    return jf.unscented(m, alpha=1.0, beta=2.0, kappa=0.0)


def iterated(m: jf.models.Nonlinear) -> jf.Filter:
    return jf.extended(m, iterations=3)


def residual_r(m: jf.models.Nonlinear) -> jf.Filter:
    return jf.residual_r(mc_ekf(m), rate=0.02, largest=100.0)


def innovation_r(m: jf.models.Nonlinear) -> jf.Filter:
    return jf.covariance_matching(mc_ekf(m), window=25, rate=0.02, bounds=(0.01, 100.0))


def sage_husa(m: jf.models.Nonlinear) -> jf.Filter:
    return jf.sage_husa(mc_ekf(m), forgetting=0.98, prior=50.0, bounds=(0.01, 100.0))


def nis_q(m: jf.models.Nonlinear) -> jf.Filter:
    return jf.nis_q(mc_ekf(m), window=25, largest=100.0)


def printed_r(m: jf.models.Nonlinear) -> jf.Filter:
    return printed.adaptive(mc_printed_second(m), (1.0, 0.0))


def printed_rq(m: jf.models.Nonlinear) -> jf.Filter:
    return printed.adaptive(mc_printed_second(m), (1.0, 1.0))


def printed_q(m: jf.models.Nonlinear) -> jf.Filter:
    return printed.adaptive(mc_printed_second(m), (0.0, 1.0))


def unguarded_r(m: jf.models.Nonlinear) -> jf.Filter:
    return printed.adaptive(mc_printed_second(m), (1.0, 0.0), printed.UNGUARDED)


def unguarded_q(m: jf.models.Nonlinear) -> jf.Filter:
    return printed.adaptive(mc_printed_second(m), (0.0, 1.0), printed.UNGUARDED)


def unguarded_rq(m: jf.models.Nonlinear) -> jf.Filter:
    return printed.adaptive(mc_printed_second(m), (1.0, 1.0), printed.UNGUARDED)


MAKERS = {
    "EKF": ekf,
    "MC-EKF": mc_ekf,
    "MC-EKF + printed 2nd order": mc_printed_second,
    "SOEKF (trace)": soekf,
    "UKF": ukf,
    "iterated EKF (3)": iterated,
    "MC-EKF + residual R": residual_r,
    "MC-EKF + innovation R": innovation_r,
    "MC-EKF + sage_husa": sage_husa,
    "MC-EKF + NIS Q": nis_q,
    "printed R, guarded": printed_r,
    "printed R and Q, guarded": printed_rq,
    "printed Q, guarded": printed_q,
    "printed R, unguarded": unguarded_r,
    "printed Q, unguarded": unguarded_q,
    "printed R and Q, unguarded": unguarded_rq,
}


class Scores(NamedTuple):
    """What is kept of each run; leading axes (scenario, run)."""

    mse: dict[str, Array]  # after convergence
    late: dict[str, Array]  # over the window given to `simulate`
    nis: Array  # mean after convergence
    finite: Array  # bool: every mean was
    flagged: Array  # bool: NONFINITE or SINGULAR in some step
    noise: Array  # (2,) the square roots of R's diagonal in force at the end
    at_500: Array  # squared position error at 500 s


class Outcome(NamedTuple):
    """Scores of the runs, and mean squares over them at each time."""

    scores: Scores
    curves: dict[str, Array]  # (scenario, T) mean squares over the runs


class History(NamedTuple):
    """What the filters say, before it is reduced to scores."""

    mean: Array  # (..., T, 5)
    nis: Array  # (..., T)
    status: Array  # (..., T)
    r_scale: Array  # (..., T, 2) factor on R; ones where it is not adapted


def _outputs(state: Any, info: jf.Info) -> History:
    del state
    assert info.nis is not None
    return History(info.mean, info.nis, info.status, info.extra.get("r_scale", jnp.ones((2,))))


def _one(make, observer, run: Runs, noise, sigma):
    filt = MAKERS[make](model(run.m0, run.P0, covariance_r(noise), sigma))
    return jf.filter(filt, run.ys, u=observer, outputs=_outputs)


@partial(jax.jit, static_argnames="make")
def _histories(make, observer, runs, noise, sigma):
    one = partial(_one, make)
    return jax.vmap(jax.vmap(one, (None, 0, None, None)), (0, 0, None, None))(observer, runs, noise, sigma)


def _score(paths: Geometry, history: History, noise, window):
    errors = squared_errors(history.mean, paths)
    t = jnp.arange(1.0, STEPS + 1)
    converged, late = t >= CONVERGED, (t >= window[0]) & (t <= window[1])

    def over(which, x):
        return jnp.sum(jnp.where(which, x, 0.0)) / which.sum().astype(x.dtype)

    trouble = int(jf.Status.NONFINITE | jf.Status.SINGULAR)
    return Scores(
        {name: over(converged, e) for name, e in errors.items()},
        {name: over(late, e) for name, e in errors.items()},
        over(converged, history.nis),
        jnp.isfinite(history.mean).all(),
        ((history.status & trouble) != 0).any(),
        jnp.sqrt(history.r_scale[-1]) * noise,
        errors["position"][499],
    ), errors


@jax.jit
def _scores(paths, histories, noise, window):
    """Scores (S, N), and mean squares over the runs (S, T)."""
    one = jax.vmap(jax.vmap(_score, (None, 0, None, None)), (0, 0, None, None))
    scores, errors = one(paths, histories, noise, window)
    return scores, jax.tree.map(lambda e: e.mean(axis=1), errors)


def simulate(
    name: str,
    paths: Geometry,
    runs: Runs,
    *,
    noise: Any = NOISE,
    sigma: Any = SIGMA,
    window: Any = (1200.0, float(STEPS)),
) -> Outcome:
    """One filter on all runs of all scenarios given (leading axes: scenario, run).

    Args:
        name: of MAKERS.
        paths: (S, T + 1, ...).
        runs: (S, N, ...), N at most CHUNK or a multiple of it.
        noise: (2,) the standard deviations that the filter is told [rad, Hz].
        sigma: (2,) its process noise [m/s^2, Hz].
        window: s, of the scores ``late``.
    """
    noise, sigma, window = (jnp.asarray(x) for x in (noise, sigma, window))
    parts = []
    for first in range(0, runs.ys.shape[1], CHUNK):
        some = jax.tree.map(lambda x: x[:, first : first + CHUNK], runs)  # noqa: B023
        history = _histories(name, paths.observer[:, 1:], some, noise, sigma)
        parts.append(jax.tree.map(np.asarray, _scores(paths, history, noise, window)))
    scores = jax.tree.map(lambda *x: np.concatenate(x, axis=1), *(scores for scores, _ in parts))
    curves = jax.tree.map(lambda *x: np.mean(x, axis=0), *(curves for _, curves in parts))
    return Outcome(scores, curves)


def rmse(outcome: Outcome, quantity: str = "position", *, late: bool = False) -> np.ndarray:
    """(S,) root over the runs."""
    return np.sqrt(np.asarray((outcome.scores.late if late else outcome.scores.mse)[quantity]).mean(axis=1))


def lost(outcome: Outcome) -> np.ndarray:
    """(S, N) bool."""
    return ~(np.sqrt(outcome.scores.mse["position"]) < LOST)  # NaN is lost
