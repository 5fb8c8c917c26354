"""The balloon of the paper: three independent axes, its scenarios, and the noise that the runs meet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.linalg import block_diag
from jax.tree_util import Partial

import jaxfilt as jf
from jaxfilt.core import Filter, Info, Prediction, StepInput, bind

STEPS = 400
AXES = 3
UNIVERSE = (40.0, 25.0, 23.0)  # m, what the fuzzy system's inputs reach on each axis
METRES = 1000.0  # the state is in km
R = 1e-4  # km^2, per axis
# Standard deviations by axis (x, y alike), corrected as the README says: km, km/s, km/s^2.
_Q = (((5e-3, 1e-4, 1e-5),) * 2) + ((2.5e-3, 5e-5, 5e-6),)
_P0 = (((1e-2, 2e-3, np.sqrt(7e-9)),) * 2) + ((1e-2, 1e-3, np.sqrt(2e-9)),)
_START = ((2.1298, -0.0083, -0.0525e-3), (3.2520, 0.0281, -0.2036e-3), (0.1430, 0.0292, -0.0376e-3))


class Scenario(NamedTuple):
    """A reading of the paper's contradictory sampling interval."""

    name: str
    dt: float  # s


SAMPLED = Scenario("sampled", 0.8)  # as the text has it
PRINTED = Scenario("printed", 0.1)  # as the matrix has it


def axis_model(scenario: Scenario, axis: int) -> jf.models.LinearGaussian:
    """One axis: position, velocity, acceleration [km, km/s, km/s^2], of which the position is measured."""
    dt = scenario.dt
    F = np.array([[1.0, dt, 0.5 * dt**2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    Q, P0 = np.diag(np.square(_Q[axis])), np.diag(np.square(_P0[axis]))
    return jf.models.linear_gaussian(F, np.eye(1, 3), Q, R * np.eye(1), np.array(_START[axis]), P0)


def axis_models(scenario: Scenario) -> list[jf.models.LinearGaussian]:
    """The three axes."""
    return [axis_model(scenario, axis) for axis in range(AXES)]


def joint_model(scenario: Scenario) -> jf.models.LinearGaussian:
    """The same as one model of nine states, axis by axis."""
    axes = axis_models(scenario)
    F, H, Q, R, P0 = (block_diag(*(getattr(axis, name) for axis in axes)) for name in ("F", "H", "Q", "R", "P0"))
    return jf.models.linear_gaussian(F, H, Q, R, jnp.concatenate([axis.m0 for axis in axes]), P0)


# ------------------------------------------------------------------------------------------- three axes as one filter


def side_by_side(filters: Sequence[Filter]) -> Filter:
    """Filters of independent axes, alike in structure and with one measurement each, as one filter of all.

    It has the moments of the filter of the joint model, whose matrices are block diagonal, at a third of the size: what
    couples the axes stands outside, as a wrapper that scales the noise of all of them. ``r_scale`` is () or one per
    axis, ``q_scale`` is (). No cross-covariance is reported.
    """
    stacked = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *filters)
    return bind(stacked, _init, _predict, _update)


def _split(inp: StepInput) -> tuple[StepInput, StepInput]:
    """The input of each axis, and the axes to map over."""
    scale = inp.r_scale
    per_axis = scale is not None and jnp.ndim(scale) > 0
    given = inp._replace(
        y=inp.y[:, None],
        mask=None if inp.mask is None else inp.mask[:, None],
        r_scale=scale[:, None] if per_axis else scale,  # pyright: ignore[reportOptionalSubscript]
    )
    over: Any = StepInput(y=0, mask=None if inp.mask is None else 0, r_scale=0 if per_axis else None)  # pyright: ignore[reportArgumentType]
    return given, over


def _init(filters, inp):
    given, over = _split(inp)
    return jax.vmap(lambda f, i: f.init(i), (0, over))(filters, given)


def _predict(filters, state, inp):
    given, over = _split(inp)
    state, prediction = jax.vmap(lambda f, s, i: f.predict(s, i), (0, 0, over))(filters, state, given)
    return state, Prediction(prediction.mean.ravel(), _blocks(prediction.cov))


def _update(filters, state, inp):
    given, over = _split(inp)
    state, info = jax.vmap(lambda f, s, i: f.update(s, i), (0, 0, over))(filters, state, given)
    total = lambda x: None if x is None else jnp.sum(x)  # noqa: E731
    joint = Info(
        info.mean.ravel(), _blocks(info.cov), info.innovation.ravel(), _blocks(info.innovation_cov), total(info.nis),
        total(info.log_lik), _status(info.status),
        noise_cov=_blocks(info.noise_cov), extra=info.extra,
    )  # fmt: skip
    return state, joint


def _status(words: Array) -> Array:
    """The bits of any axis; MISSED only where all of them missed."""
    missed = jnp.int32(int(jf.Status.MISSED))
    bits = jax.lax.reduce(words, np.int32(0), jax.lax.bitwise_or, (0,))
    return jnp.where(((words & missed) != 0).all(), bits, bits & ~missed)


def _blocks(x: Array | None) -> Array | None:
    """(axes, k, k) as a block-diagonal matrix."""
    return None if x is None else block_diag(*x)


# ------------------------------------------------------------------------------------------------------------- truth


def mismatched(model: jf.models.LinearGaussian, w: Array, static: jf.Static, key: Array) -> tuple[Array, Array]:
    """A run (T, 9), (T, 3) whose Q and R are w^u1 and w^u2 times those of the model, u uniform in [-1, 1]."""
    scale_key, run_key = jax.random.split(key)
    Q: Any = model.Q
    q, r = w ** jax.random.uniform(scale_key, (2,), Q.dtype, -1.0, 1.0)
    true = model._replace(Q=q * Q, R=r * model.R)
    return jf.simulate.simulate(true, static.value, run_key, first_update_only=True)


def mismatch(scenario: Scenario, w: float, steps: int = STEPS) -> jf.Scenario:
    """Runs of :func:`mismatched`; w = 1 is none."""
    draw = Partial(mismatched, joint_model(scenario), jnp.asarray(float(w)), jf.Static(steps))
    return jf.Scenario(draw, first_update_only=True)


def score(truth: Array, ys: Array, out: Any) -> dict[str, Array]:
    """Mean squared errors over time of all states, of the predictor and of the corrected estimate [km^2 and so on]."""
    del ys
    scores = {} if "alpha" not in out.extra else {"alpha": jnp.mean(out.extra["alpha"])}
    for name, mean in (("pred", out.prediction.mean), ("corrected", out.mean)):
        squared = jnp.mean((mean - truth) ** 2, axis=0).reshape(AXES, 3).sum(axis=0)
        scores |= {name: jnp.sum(squared), f"{name} position": squared[0], f"{name} velocity": squared[1]}
    return scores


def eq21(mse: np.ndarray, steps: int = STEPS) -> np.ndarray:
    """The paper's error measure as it is printed: the root of the norm of all errors of a run, over their number."""
    return np.sqrt(np.sqrt(steps * mse)) / steps
