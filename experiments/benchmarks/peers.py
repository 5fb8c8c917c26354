"""The other libraries on the same problems, each the fastest way that its public functions offer.

JAX libraries are compiled as ``jax.jit(jax.vmap(f))``; what a quantity does not need, XLA drops. Each function gives a
function of one run ``(log_r, ys) -> likelihood`` or ``-> (means, covariances)``, or is called in a loop over runs
(filterpy). An ImportError means that the library is left out.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxfilt as jf
from experiments.benchmarks import cases
from experiments.benchmarks.cases import Data, Problem

Run = Callable[[Array, Array], Any]
FUNCTIONS = {"ekf": (cases.turn, cases.polar), "ukf": (cases.straight, cases.polar)}


class NotOffered(Exception):
    """The library does not have this."""


def dynamax(p: Problem) -> Run:
    """``(log_r, ys) -> (log-likelihood, means, covariances)``; its prior is at the first sample."""
    m0, P0 = cases.at_first_sample(p)
    if p.family == "kalman":
        from dynamax.linear_gaussian_ssm import inference

        lgssm: Any = inference  # its annotations know JAX arrays only

        def run(log_r, ys):
            params = lgssm.make_lgssm_params(m0, P0, p.F, p.Q, p.H, jnp.exp(log_r) * p.R0)
            out = lgssm.lgssm_filter(params, ys)
            return out.marginal_loglik, out.filtered_means, out.filtered_covariances

        return run
    if p.family not in FUNCTIONS:
        raise NotOffered
    from dynamax.nonlinear_gaussian_ssm import inference_ekf, inference_ukf
    from dynamax.nonlinear_gaussian_ssm.models import ParamsNLGSSM

    make: Any = ParamsNLGSSM
    hyper = inference_ukf.UKFHyperParams(1.0, 2, 0)
    f, h = FUNCTIONS[p.family]

    def run_nonlinear(log_r, ys):
        params = make(m0, P0, f, jnp.asarray(p.Q), h, jnp.exp(log_r) * p.R0)
        fields = ["filtered_means", "filtered_covariances"]
        if p.family == "ekf":
            out = inference_ekf.extended_kalman_filter(params, ys, output_fields=fields)
        else:
            out = inference_ukf.unscented_kalman_filter(params, ys, hyper, output_fields=fields)
        return out.marginal_loglik, out.filtered_means, out.filtered_covariances

    return run_nonlinear


def cuthbert(p: Problem) -> Run:
    """As :func:`dynamax`; square-root filters, of which covariances are formed at the end."""
    import cuthbert as peer
    from cuthbert.gaussian import kalman, moments

    build_linear: Any = kalman.build_filter
    build: Any = moments.build_filter

    if p.family not in ("kalman", "ekf"):
        raise NotOffered
    noise = np.linalg.cholesky(p.Q.astype(float)).astype(p.Q.dtype)
    root, start = np.sqrt(p.R0), np.linalg.cholesky(p.P0)

    def run(log_r, ys):
        chol_R = jnp.exp(log_r / 2) * root
        if p.family == "kalman":
            built = build_linear(
                p.m0, start, lambda y: (jnp.asarray(p.F), jnp.zeros_like(p.m0), jnp.asarray(noise)),
                lambda y: (jnp.asarray(p.H), jnp.zeros(p.m, p.m0.dtype), chol_R, y),
            )  # fmt: skip
        else:
            f, h = FUNCTIONS[p.family]
            built = build(
                p.m0, start, lambda state, y: (lambda x: (f(x), jnp.asarray(noise)), state.mean),
                lambda state, y: (lambda x: (h(x), chol_R), state.mean, y),
            )  # fmt: skip
        states = peer.filter(built, ys, built.init_prepare())
        covs = states.chol_cov @ states.chol_cov.mT
        return states.log_normalizing_constant[-1], states.mean[1:], covs[1:]

    return run


def kalman_py(p: Problem) -> Run:
    """As :func:`dynamax`: the functions of its JAX backend, since its classes take one run at a time."""
    from kalman_py.backends import jax_backend  # pyright: ignore[reportMissingImports]

    if p.family == "ukf":
        raise NotOffered  # its function waits for a check of each result: no vmap
    if p.family not in ("kalman", "ekf"):
        raise NotOffered

    def run(log_r, ys):
        R = jnp.exp(log_r) * p.R0
        if p.family == "kalman":
            out = jax_backend.kalman_filter(p.F, p.H, p.Q, R, p.m0, p.P0, ys)
        else:
            dts = jnp.full(ys.shape[:1], cases.DT, ys.dtype)
            out = jax_backend.ekf_filter(p.Q, R, p.m0, p.P0, ys, dts, _turn_dt, cases.polar, None, None, None)
        return out.log_likelihood, out.means, out.covs

    return run


def _turn_dt(x, dt):
    del dt
    return cases.turn(x)


JAX = {"dynamax": dynamax, "cuthbert": cuthbert, "kalman-py": kalman_py}


def prepare(name: str, p: Problem, quantity: str, data: Data) -> tuple[Callable, tuple[Array, Array]]:
    """The compiled, vmapped function of a JAX library and its arguments."""
    return jax.jit(jax.vmap(one_run(name, p, quantity))), (jnp.asarray(data.log_r), jnp.asarray(data.ys))


def prepare_split(name: str, p: Problem, quantity: str, data: Data) -> tuple[Callable, tuple[Array, Array]]:
    """The same through ``jaxfilt.batch``: what a peer gains by the split over cores alone."""
    return jf.batch(one_run(name, p, quantity)), (jnp.asarray(data.log_r), jnp.asarray(data.ys))


def one_run(name: str, p: Problem, quantity: str) -> Callable[[Array, Array], Any]:
    """The function of one run that gives the quantity."""
    one = JAX[name](p)
    return {
        "likelihood": lambda log_r, ys: one(log_r, ys)[0],
        "history": lambda log_r, ys: one(log_r, ys)[1:],
        "gradient": jax.grad(lambda log_r, ys: one(log_r, ys)[0]),
    }[quantity]


def filterpy(p: Problem, quantity: str, data: Data) -> Callable[[], Any]:
    """A call that loops over the runs; the result as of a batch."""
    from filterpy import kalman

    if p.m0.dtype != np.float64 or quantity == "gradient":
        raise NotOffered
    if p.family not in ("kalman", "ukf", "imm"):
        raise NotOffered

    def linear(log_r, Q):
        filt = kalman.KalmanFilter(dim_x=p.n, dim_z=p.m)
        filt.F, filt.H, filt.Q, filt.R = p.F, p.H, Q, np.exp(log_r) * p.R0
        filt.x, filt.P = p.m0.copy(), p.P0.copy()
        return filt

    def build(log_r):
        if p.family == "kalman":
            return linear(log_r, p.Q)
        if p.family == "imm":
            filters = [linear(log_r, p.Q * (q / p.q[1])) for q in p.q]
            return kalman.IMMEstimator(filters, np.full(len(p.q), 1 / len(p.q)), cases.TRANSITION)
        points = kalman.MerweScaledSigmaPoints(p.n, alpha=1.0, beta=2.0, kappa=0.0)
        filt = kalman.UnscentedKalmanFilter(p.n, p.m, cases.DT, _polar, lambda x, dt: p.F @ x, points)
        filt.Q, filt.R, filt.x, filt.P = p.Q, np.exp(log_r) * p.R0, p.m0.copy(), p.P0.copy()
        return filt

    def call():
        likelihoods, means, covs = [], [], []
        for log_r, ys in zip(data.log_r, data.ys, strict=True):
            filt: Any = build(log_r)
            total = 0.0
            for y in ys:
                filt.predict()
                before = getattr(filt, "cbar", None)
                filt.update(y)
                if quantity == "history":
                    means.append(filt.x.copy())
                    covs.append(filt.P.copy())
                elif before is None:
                    total += filt.log_likelihood
                else:
                    total += np.log(before @ filt.likelihood)
            likelihoods.append(total)
        if quantity == "likelihood":
            return np.array(likelihoods)
        shape = data.ys.shape[:2]
        return np.reshape(means, (*shape, p.n)), np.reshape(covs, (*shape, p.n, p.n))

    return call


def _polar(x):
    return np.array([np.hypot(x[0], x[1]), np.arctan2(x[1], x[0])])


def missing() -> dict[str, str]:
    """Libraries that are not installed, and why."""
    out = {}
    for name in (*JAX, "filterpy"):
        try:
            importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            out[name] = "not installed"
    return out
