"""The paper's rules as printed: a baseline, with and without guards."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

import jaxfilt as jf
from jaxfilt.core import Wrapped, multiply

WINDOW = 25
GUARDED = (25, (0.25, 25.0), (1e-4, 1e2))  # first step, and the bounds of the factors on R and Q
UNGUARDED = (1, (0.0, np.inf), (0.0, np.inf))


class _Params(NamedTuple):
    inner: jf.Filter
    begin: Any  # () the step from which the rules act
    r_bounds: Any  # (2,)
    q_bounds: Any  # (2,)
    adapt: Any  # (2,) 0 or 1, of R and of Q


class _Memory(NamedTuple):
    r: Array  # () factor on R
    q: Array  # () factor on Q
    recent: Array  # (N, m) innovations
    step: Array  # ()


def adaptive(filt: jf.Filter, adapt: tuple[float, float], guards: tuple = GUARDED) -> jf.Filter:
    """``R <- R tr C / tr S`` with C over a window, and ``Q <- Q |x+ - x-|^2 / n``: eqs. (14) to (21) as printed.

    The traces add rad^2 to Hz^2, and Q's factor is no ratio but m^2: faults of the rules that are kept.
    """
    begin, r_bounds, q_bounds = guards
    params = _Params(filt, float(begin), jnp.asarray(r_bounds), jnp.asarray(q_bounds), jnp.asarray(adapt, float))
    return jf.wrap(params, init=_init, predict=_predict, update=_update)


def _init(p, inp):
    one, zero = jnp.ones((), inp.y.dtype), jnp.zeros((), inp.y.dtype)
    return Wrapped(p.inner.init(inp), _Memory(one, one, jnp.zeros((WINDOW, *inp.y.shape), inp.y.dtype), zero))


def _scaled(inp, memory):
    return inp._replace(r_scale=multiply(inp.r_scale, memory.r), q_scale=multiply(inp.q_scale, memory.q))


def _predict(p, s, inp):
    inner, prediction = p.inner.predict(s.inner, _scaled(inp, s.memory))
    return s._replace(inner=inner), prediction


def _update(p, s, inp):
    memory = s.memory
    before, _ = p.inner.moments(s.inner)
    inner, info = p.inner.update(s.inner, _scaled(inp, memory))
    recent = jnp.concatenate([info.innovation[None], memory.recent[:-1]])
    step = memory.step + 1
    alpha = jnp.sum(recent**2) / WINDOW / jnp.trace(info.innovation_cov)
    lam = jnp.mean((info.mean - before) ** 2)
    acts = step >= p.begin
    r = jnp.where(acts & (p.adapt[0] > 0), jnp.clip(memory.r * alpha, *p.r_bounds), memory.r)
    q = jnp.where(acts & (p.adapt[1] > 0), jnp.clip(memory.q * lam, *p.q_bounds), memory.q)
    extra = {**info.extra, "r_scale": jnp.broadcast_to(r, inp.y.shape), "q_scale": q}
    return Wrapped(inner, _Memory(r, q, recent, step)), info._replace(extra=extra)


def second_order(model: jf.models.Nonlinear) -> jf.models.Nonlinear:
    """The model with the printed "second-order" Jacobian ``H_ij + h_i,jj / 2``, eqs. (12) and (13).

    It adds 1/m^2 to 1/m, so it depends on the unit of length; in metres it is 1e-4 of H.
    """
    return model._replace(h_jacobian=Partial(_printed_jacobian, model.h))


def _printed_jacobian(h, x, u, dt):
    curvature = jax.hessian(h)(x, u, dt)
    return jax.jacfwd(h)(x, u, dt) + 0.5 * jnp.diagonal(curvature, axis1=1, axis2=2)
