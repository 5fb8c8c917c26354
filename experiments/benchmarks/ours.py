"""jaxfilt as a user would call it: a function of one run, through the public batch entry point."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

import jaxfilt as jf
from experiments.benchmarks import cases
from experiments.benchmarks.cases import Data, Problem

GRADIENT_CHUNK = 128


def build(p: Problem, log_r: Array) -> jf.Filter:
    """The filter of one run."""
    r = jnp.exp(log_r)
    if p.family == "kalman" and not p.order:
        return jf.kalman(jf.models.linear_gaussian(p.F, p.H, p.Q, r * p.R0, p.m0, p.P0))
    if p.family == "kalman":
        return jf.kalman(_motion(p, p.q[0], r))
    if p.family == "imm":
        return jf.imm([jf.kalman(_motion(p, q, r)) for q in p.q], cases.TRANSITION.astype(p.m0.dtype))
    sensor = jf.models.sensors.range_bearing(r * p.R0)
    if p.family == "ekf":
        options = {"dt": cases.DT, "q_omega": cases.OMEGA_WALK, "q": p.q[0], "r": 1.0, "m0": p.m0, "P0": p.P0}
        return jf.extended(jf.models.with_sensor(jf.models.coordinated_turn(**options), sensor))
    return jf.unscented(jf.models.with_sensor(_motion(p, p.q[0], 1.0), sensor))


def _motion(p, q, r):
    model = {cases.CV: jf.models.constant_velocity, cases.CA: jf.models.constant_acceleration}[p.order]
    return model(dt=cases.DT, q=q, r=r, m0=p.m0, P0=p.P0)


def log_lik(p: Problem, form: str, log_r: Array, ys: Array) -> Array:
    """Log-likelihood of one run, without a history."""
    return jf.filter(build(p, log_r), ys, outputs=jf.log_lik, keep="sum", form=form)


def packed(p: Problem, form: str, log_r: Array, ys: Array) -> Any:
    """Means (T, n) and lower triangles of the covariances (T, n (n + 1) / 2)."""
    return jf.filter(build(p, log_r), ys, outputs=jf.packed, form=form)


def moments(state: Any, info: jf.Info) -> tuple[Array, Any]:
    """Outputs: mean and full covariance."""
    del state
    return info.mean, info.cov


def full(p: Problem, form: str, log_r: Array, ys: Array) -> tuple[Array, Array]:
    """Means (T, n) and covariances (T, n, n)."""
    return jf.filter(build(p, log_r), ys, outputs=moments, form=form)


def prepare(p: Problem, quantity: str, data: Data, form: str = "auto") -> tuple[Callable, tuple[Array, Array]]:
    """The batched function and its arguments; quantity is likelihood, history, full or gradient."""
    functions = {"likelihood": log_lik, "history": packed, "full": full, "gradient": log_lik}
    fn = partial(functions[quantity], p, form)
    batched = jf.batch(jax.grad(fn), chunk=GRADIENT_CHUNK) if quantity == "gradient" else jf.batch(fn)
    return batched, (jnp.asarray(data.log_r), jnp.asarray(data.ys))


def prepare_one(p: Problem, quantity: str, data: Data) -> tuple[Callable, tuple[Array, Array]]:
    """The first run alone, under ``jit``, as one long series is filtered."""
    fn = partial({"likelihood": log_lik, "history": full}[quantity], p, "auto")
    return jax.jit(fn), (jnp.asarray(data.log_r[0]), jnp.asarray(data.ys[0]))
