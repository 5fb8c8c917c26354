"""State estimates for the uncertain loop: the interval observer beside the Kalman filter, both fed to the controller.

The noise is bounded: w uniform in [0.05, 0.1], v uniform within +-bound; A is drawn anew at every step.
"""

from __future__ import annotations

from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxfilt as jf
from experiments.positive_control.system import A_HIGH, A_LOW, B, C

Source = Literal["y", "filter", "middle"]

W_LOW, W_HIGH = 0.05, 0.1
X_LOW, X_HIGH = 0.5, 2.0
STEPS, SETTLED = 200, 50
GAIN = np.array([[-1.0], [-1.5]])  # L of the observer's linear program


class Run(NamedTuple):
    """One closed loop, (runs, steps, ...) in front."""

    x: Array  # (2,) truth
    u: Array  # (2,)
    clipped: Array  # () bool
    lower: Array  # (2,) of the interval
    upper: Array  # (2,)
    possible: Array  # () bool: the sample agrees with the interval
    prior: Array  # (2,) the Kalman filter's mean before the sample
    deviation: Array  # (2,) its standard deviation
    mean: Array  # (2,) after it


def observer(v_bound: float) -> jf.Filter:
    """The interval observer."""
    return jf.interval_observer(
        A_LOW, A_HIGH, C, GAIN, w_low=W_LOW, w_high=W_HIGH, v_bound=v_bound, x_low=X_LOW, x_high=X_HIGH, B=B,
        nonnegative=True,
    )  # fmt: skip


def kalman(v_bound: float, q: float = 1.0) -> jf.Filter:
    """The Kalman filter for the middle of the box; the mean of w comes in by the input's last component."""
    with_mean = np.hstack([B, np.ones((2, 1))])
    Q = q * (W_HIGH - W_LOW) ** 2 / 12 * np.eye(2)
    P0 = (X_HIGH - X_LOW) ** 2 / 12 * np.eye(2)
    m0 = np.full(2, 0.5 * (X_LOW + X_HIGH))
    return jf.kalman(
        jf.models.linear_gaussian(0.5 * (A_LOW + A_HIGH), C, Q, v_bound**2 / 3 * np.eye(1), m0, P0, B=with_mean)
    )


@partial(jax.jit, static_argnames="source")
def simulate(
    keys: Array,
    K: Array,
    bounds: jf.Filter,
    filt: jf.Filter,
    v_bound: Array,
    mask: Array | None = None,
    *,
    source: Source = "y",
) -> Run:
    """u = max(K y~, 0) with y~ the sample, C times the Kalman filter's posterior mean, or C times the middle.

    Args:
        keys: (runs,).
        K: (2, 1).
        bounds: :func:`observer`.
        filt: :func:`kalman`.
        v_bound: of the measurement noise.
        mask: (steps,) bool, False where the sample is missing: the input is then held; None = all present.
        source: what the controller is given.
    """  # fmt: skip

    def one(key):
        k = [jax.random.fold_in(key, i) for i in range(4)]
        x0 = jax.random.uniform(k[0], (2,), float, X_LOW, X_HIGH)
        A = jax.vmap(lambda part: A_LOW + part * (A_HIGH - A_LOW))(jax.random.uniform(k[1], (STEPS, 2, 2)))
        w = jax.random.uniform(k[2], (STEPS, 2), float, W_LOW, W_HIGH)
        v = v_bound * jax.random.uniform(k[3], (STEPS, 1), float, -1.0, 1.0)
        seen = None if mask is None else jnp.broadcast_to(mask[:, None], (STEPS, 1))
        average = jnp.full(1, 0.5 * (W_LOW + W_HIGH))

        def advance(carry, noise):
            x, interval, state, last = carry
            A, w, v, present = noise
            y = C @ x + v
            assert filt.moments is not None
            prior, cov = filt.moments(state)
            deviation = jnp.sqrt(jnp.diagonal(cov))
            interval, between = bounds.update(interval, jf.StepInput(y, present))
            state, info = filt.update(state, jf.StepInput(y, present))
            given = {"y": y, "filter": C @ info.mean, "middle": C @ between.mean}[source]
            wanted = K @ given
            u = jnp.maximum(wanted, 0.0)
            if present is not None:
                u = jnp.where(present, u, last)
            lower, upper = between.extra["lower"], between.extra["upper"]
            possible = (between.status & int(jf.Status.BOUND)) == 0
            out = Run(x, u, (wanted < 0).any(), lower, upper, possible, prior, deviation, info.mean)
            interval, _ = bounds.predict(interval, jf.StepInput(y, present, u=u))
            state, _ = filt.predict(state, jf.StepInput(y, present, u=jnp.concatenate([u, average])))
            return (A @ x + B @ u + w, interval, state, u), out

        first = jf.StepInput(v[0])
        start = (x0, bounds.init(first), filt.init(first._replace(u=jnp.zeros(3))), jnp.zeros(2))
        return jax.lax.scan(advance, start, (A, w, v, seen))[1]

    return jax.vmap(one)(keys)


class Scores(NamedTuple):
    """Per run and component after the first 50 steps; counts over all steps."""

    width: np.ndarray  # (runs, 2) of the interval
    middle: np.ndarray  # (runs, 2) mean squared error of its middle
    prior: np.ndarray  # (runs, 2) of the Kalman filter before the sample
    covered: np.ndarray  # (runs, 2) share of steps within its 3 sigma
    sigmas: np.ndarray  # (runs, 2) width of that band
    mean: np.ndarray  # (runs, 2) of x
    square: np.ndarray  # (runs, 2) of x
    clipped: np.ndarray  # (runs,) share of steps
    wiggle: np.ndarray  # (runs, 2) standard deviation of the upper bound over time
    outside: int  # components outside their interval
    least: float


def score(run: Run) -> Scores:
    """Scores of a batch."""
    every = {name: np.asarray(part) for name, part in run._asdict().items()}
    x, lower, upper = every["x"], every["lower"], every["upper"]
    outside = (x > upper + 1e-12) | (x < lower - 1e-12)
    least = float(x.min())
    late = {name: part[:, SETTLED:] for name, part in every.items()}
    x, lower, upper, deviation = late["x"], late["lower"], late["upper"], late["deviation"]
    error = x - late["prior"]
    return Scores(
        (upper - lower).mean(axis=1),
        ((x - 0.5 * (upper + lower)) ** 2).mean(axis=1),
        (error**2).mean(axis=1),
        (np.abs(error) <= 3 * deviation).mean(axis=1),
        (6 * deviation).mean(axis=1),
        x.mean(axis=1),
        (x**2).mean(axis=1),
        late["clipped"].mean(axis=1),
        upper.std(axis=1),
        int(outside.sum()),
        least,
    )


def width_in_closed_form(mean_x: np.ndarray, v_bound: float) -> np.ndarray:
    """(2,) stationary mean width, for the mean of x: both errors are scalar recursions, the lower clip at rest."""
    LC = GAIN @ C
    numerator = 0.1 * mean_x + np.abs(GAIN[:, 0]) * v_bound + 0.5 * (W_HIGH - W_LOW)
    return numerator / (1 - np.diag(A_HIGH - LC)) + numerator / (1 - np.diag(A_LOW - LC))
