"""The public border: one valid call of every public function, by name, and what is put wrongly in an argument's place.

``CALLS`` maps a name below ``jaxfilt`` to a function that makes the arguments of a valid call; ``EXEMPT`` says why a
name has none. :func:`wrong` makes the bad values of an argument from its valid value.
"""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

import jaxfilt as jf
from tests.examples import LINEAR
from tests.examples.interval import _A, _BOUNDS, _C, _L

MODULES = {
    "": jf,
    "models.": jf.models,
    "models.sensors.": jf.models.sensors,
    "tune.": jf.tune,
    "metrics.": jf.metrics,
    "simulate.": jf.simulate,
    "gains.": jf.gains,
    "initial.": jf.initial,
    "fuzzy.": jf.fuzzy,
    "maneuver.": jf.maneuver,
    "sincos.": jf.sincos,
    "plots.": jf.plots,
    "frames.": jf.frames,
}

_CALLBACK = "an output function or constructor that the library calls with its own values, inside a step"
_IN_STEP = "a formula on arrays that filters evaluate inside a compiled step, where shapes are the filter's own"
_NESTED = "takes any pytree or function: what is wrong shows where it is used"

EXEMPT = {
    **dict.fromkeys(("summary", "everything", "log_lik", "packed", "bind", "wrap"), _CALLBACK),
    **dict.fromkeys(("aspartial", "tune.frozen"), _NESTED),
    "use_cores": "changes the process",
    **dict.fromkeys(("models.sensors.apart", "models.sensors.wrap", "models.sensors.wrap_at"), _IN_STEP),
    **dict.fromkeys(
        (
            "fuzzy.trapezoid", "fuzzy.triangle", "fuzzy.gaussian", "fuzzy.ordered", "fuzzy.unordered",
            "fuzzy.stick_breaking", "fuzzy.rule_weights", "fuzzy.minimum_weights", "fuzzy.takagi_sugeno",
            "fuzzy.freeze_rules", "fuzzy.thaw_rules",
        ),
        _IN_STEP,
    ),
    **dict.fromkeys(
        ("maneuver.advance", "maneuver.evaluate", "maneuver.restart", "maneuver.significance", "maneuver.start",
         "maneuver.threshold"),
        _IN_STEP,
    ),
    "maneuver.static_number": "is itself a check of an argument, whose name it is given",
    **dict.fromkeys(("sincos.signals", "sincos.correct", "sincos.reacquire"), _IN_STEP),
    **dict.fromkeys(
        ("sincos.radius_loss", "sincos.smoothness_loss", "sincos.supervised_loss"), "a loss that a tuner traces"
    ),
    "gains.check_stable": "is itself a check, of gains together",
    "sincos.both_present": "is itself a check, of a mask",
    **dict.fromkeys(("plots.pareto", "plots.tuning"), "takes results by position: test_plots.py has the bad ones"),
}  # fmt: skip


def public() -> dict[str, Callable]:
    """Every public function by its name below ``jaxfilt``; classes are not called by users but for their fields."""
    found = {}
    for prefix, module in MODULES.items():
        for name, x in vars(module).items():
            own = getattr(x, "__module__", None)
            package = hasattr(module, "__path__")
            if name.startswith("_") or not inspect.isfunction(x) or not str(own).startswith("jaxfilt"):
                continue
            if package or own == module.__name__:
                found[prefix + name] = x
    return found


Z2, Z4, Z6, Z8 = np.zeros(2), np.zeros(4), np.zeros(6), np.zeros(8)
YS = np.array([[0.3, 0.1], [0.2, -0.4], [1.0, 0.5], [0.7, 0.2]])
YS3 = np.stack([YS, YS[::-1], 0.5 * YS])
STATES3 = np.linspace(-1.0, 1.0, 12).reshape(4, 3)
CIRCLE = np.stack([np.cos(np.linspace(0, 6, 40)), np.sin(np.linspace(0, 6, 40))], axis=1)
MASK = np.array([True, True, False, True])
STAY = np.array([[0.9, 0.1], [0.2, 0.8]])
KEY = jax.random.key(0)
COV = np.diag([1.0, 2.0, 3.0])


def _linear(matrix, x, u, dt):
    del u, dt
    return matrix @ x


def _all(mean, y, u, dt):
    del mean, u, dt
    return jnp.ones(y.shape, bool)


def _loss(params, data):
    del data
    return (params["q"] - 2.0) ** 2


def _losses(params, data):
    loss = _loss(params, data)
    return jnp.stack([loss, 1.0 + params["q"]])


def _one(x):
    return 2.0 * x


def _score(truth, ys, out):
    del ys
    return {"rmse": jf.metrics.rmse(out.mean, truth)}


@functools.cache
def model():
    return jf.models.linear_gaussian(**LINEAR)


@functools.cache
def filt():
    return jf.kalman(model())


@functools.cache
def planar(n=4):
    build = jf.models.constant_velocity if n == 4 else jf.models.constant_acceleration
    return build(dt=1.0, q=0.1, r=0.5, m0=np.zeros(n), P0=np.eye(n))


@functools.cache
def seen():
    sensor = jf.models.sensors.range_bearing(np.eye(2), observer=np.array([-7.0, -5.0]))
    return jf.models.with_sensor(planar(), sensor)


@functools.cache
def info():
    """The outputs of a filter, with what smoothing needs."""
    return jf.filter(filt(), YS, outputs=jf.everything)


@functools.cache
def particles():
    return jf.filter(jf.particle(model(), 8, keep=True), YS, key=KEY, outputs=jf.everything)


@functools.cache
def axes():
    """One for all calls: a figure takes longer than what is drawn."""
    return Figure().subplots()


def space():
    return {"q": jf.tune.positive(0.5)}


def _motion(n, **more):
    return {"dt": 1.0, "q": 0.1, "r": 0.5, "m0": np.zeros(n), "P0": np.eye(n), **more}


_ATTITUDE = {"dt": 0.1, "frame": "up", "gravity": 9.81, "z0": np.array([0.0, 0.0, 1.0])}
_GYRO = {**_ATTITUDE, "gyro_var": 1e-6, "acc_var": 1e-4, "bias_var": 1e-8, "bias_q": 1e-9, "prop": "exact",
         "P0": np.eye(6), "bias_limit": 0.1}  # fmt: skip
_GAINS = {"alpha": 0.5, "beta": 0.2}
_TRIPLE = {**_GAINS, "kappa": 0.05, "dt": 1.0}

CALLS: dict[str, Callable[[], dict[str, Any]]] = {
    # running
    "filter": lambda: {"filt": filt(), "ys": YS, "mask": MASK, "dt": None, "u": None, "key": KEY,
                       "q_scale": np.ones(4), "r_scale": np.ones(4), "outputs": jf.summary, "keep": "stack",
                       "segment": 2, "form": "auto"},
    "inputs": lambda: {"ys": YS, "mask": MASK, "dt": np.ones(4), "u": YS, "key": KEY, "q_scale": np.ones(4),
                       "r_scale": np.ones(4)},
    "scan": lambda: {"filt": filt(), "state": filt().init(_inp()), "inputs": jf.inputs(YS), "outputs": jf.summary,
                     "keep": "stack", "segment": 2},
    "step": lambda: {"filt": filt(), "state": filt().init(_inp()), "inp": _inp()},
    "intervals": lambda: {"times": np.array([0.0, 1.0, 2.5]), "first": 1.0},
    "mask_nan": lambda: {"ys": YS},
    "unpack": lambda: {"triangle": np.arange(6.0)},
    "batch": lambda: {"fn": _one, "in_axes": 0, "chunk": 4},
    "check": lambda: {"out": info(), "error": jf.Status.NONFINITE, "warn": jf.Status.SINGULAR},
    "rts": lambda: {"out": info()},
    "smooth": lambda: {"filt": filt(), "ys": YS},
    "filter_parallel": lambda: {"model": model(), "ys": YS, "mask": MASK, "dt": None, "u": None,
                                "q_scale": np.ones(4), "r_scale": np.ones(4), "outputs": jf.summary, "block": 2},
    "rts_parallel": lambda: {"out": info(), "block": 2},
    "smooth_parallel": lambda: {"model": model(), "ys": YS, "block": 2},
    "smooth_particles": lambda: {"model": model(), "out": particles(), "paths": 4, "proposals": 2, "key": KEY,
                                 "dt": None, "u": None, "q_scale": None},
    "scenario": lambda: {"model": model(), "T": 4, "mask": MASK, "dt": None, "u": None},
    "monte_carlo": lambda: {"scenario": jf.scenario(model(), 4), "filters": {"kalman": filt()}, "score": _score,
                            "runs": 4, "key": KEY, "chunk": 2, "outputs": jf.everything, "memory_limit": 2**20},
    # filters
    "kalman": lambda: {"model": model()},
    "sqrt_kalman": lambda: {"model": model()},
    "steady_state": lambda: {"model": model()},
    "cubature": lambda: {"model": seen()},
    "sqrt_cubature": lambda: {"model": seen()},
    "extended": lambda: {"model": seen(), "order": 1, "iterations": 2},
    "sqrt_extended": lambda: {"model": seen(), "order": 1, "iterations": 2},
    "unscented": lambda: {"model": seen(), "alpha": 1.0, "beta": 2.0, "kappa": 0.0},
    "sqrt_unscented": lambda: {"model": seen(), "alpha": 1.0, "beta": 2.0, "kappa": 0.0},
    "alpha_beta": lambda: {**_GAINS, "dt": 1.0, "r": np.ones(2), "m0": np.zeros(4), "start": None},
    "alpha_beta_gamma": lambda: {**_GAINS, "gamma": 0.05, "dt": 1.0, "r": np.ones(2), "m0": np.zeros(6),
                                 "start": None, "convention": "kappa"},
    "attitude": lambda: {**_GYRO, "kappa": 0.1, "c": 0.3},
    "attitude_peak": lambda: {**_GYRO, "kappa": 0.0, "rho": 1.0, "decay": 0.9},
    "attitude_switched": lambda: {**_GYRO, "threshold": 0.3, "width": 0.1, "moving_var": 1e3},
    "attitude_velocity": lambda: {**_GYRO, "P0": np.eye(9), "velocity_var": 0.1},
    "complementary": lambda: {**_ATTITUDE, "tau": 2.0},
    "madgwick": lambda: {**_ATTITUDE, "beta": 0.1},
    "mahony": lambda: {**_ATTITUDE, "proportional": 0.7, "integral": 0.001},
    "bank": lambda: {"filters": (filt(), filt()), "prior": np.array([0.5, 0.5]), "score": None},
    "delayed_kalman": lambda: {"model": model(), "probabilities": np.array([0.6, 0.4]), "second_moment": "exact"},
    "adaptive_delayed_kalman": lambda: {"model": model(), "probabilities": np.array([0.6, 0.4]), "window": 5,
                                        "forgetting": 0.9, "bounds": (1.0, 10.0), "covariance": "nominal",
                                        "second_moment": "exact"},
    "hinf": lambda: {"model": model(), "theta": 0.1, "weight": np.eye(3), "output": "corrected",
                     "on_infeasible": "cap"},
    "mixed_hinf": lambda: {"model": model(), "theta": 0.1, "weight": np.eye(3), "output": "corrected",
                           "on_infeasible": "cap"},
    "sqrt_mixed_hinf": lambda: {"model": model(), "theta": 0.1, "weight": np.eye(3), "output": "corrected",
                                "on_infeasible": "cap"},
    "riccati": lambda: {"model": model(), "theta": 0.1, "weight": np.eye(3), "doublings": 4},
    "theta_max": lambda: {"model": model(), "weight": np.eye(3), "steps": 3},
    "imm": lambda: {"filters": (filt(), filt()), "transition": STAY, "mu0": np.array([0.5, 0.5]), "index": None,
                    "mixing": "own", "missed": "mix"},
    "rao_blackwellized": lambda: {"filters": (filt(), filt()), "transition": STAY, "count": 8,
                                  "mu0": np.array([0.5, 0.5]), "index": None, "mixing": "own",
                                  "proposal": "optimal", "resampling": "systematic", "threshold": 0.5},
    "interval_observer": lambda: {"A_low": _A - 0.02, "A_high": _A + 0.03, "C": _C, "L": _L, **_BOUNDS, "B": None,
                                  "nonnegative": True},
    "particle": lambda: {"model": model(), "count": 8, "guide": None, "resampling": "systematic",
                         "threshold": 0.5, "gradient": "score", "alpha": 0.5, "epsilon": 0.25, "sweeps": 5},
    "joint_particle": lambda: {"models": ((model(), model()),), "transition": STAY, "count": 8,
                               "prior": np.array([1.0]), "mode_prior": np.array([0.5, 0.5]), "floor": 0.5,
                               "score": None, "score_at": "particle", "start": None, "resampling": "systematic",
                               "threshold": 0.5, "noise_rank": 3},
    "multi_mode_particle": lambda: {"models": (model(), model()), "transition": STAY, "count": 8},
    "variable_dimension": lambda: {"model_cv": planar(), "model_ca": planar(6), "statistic": "fading",
                                   "p_false": 0.01, "forgetting": 0.8, "window": 5, "lookback": 2,
                                   "end_probability": 0.95},
    # wrappers
    "blend": lambda: {"filt": filt(), "candidates": ((4, 1),), "horizon": 2, "origins": 3, "exponent": 2.0,
                      "floor": 0.25},
    "coast_inflated": lambda: {"filt": filt(), "factor": 10.0},
    "covariance_intersection": lambda: {"filt": filt(), "window": 4, "degree": 1, "forgetting": 0.9, "max_age": 5},
    "covariance_matching": lambda: {"filt": filt(), "scale": "r", "window": 5, "rate": 1.0, "bounds": (0.1, 10.0)},
    "detected": lambda: {"filt": filt(), "statistic": "fading", "p_false": 0.01, "forgetting": 0.8, "window": 5},
    "fading_memory": lambda: {"filt": filt(), "factor": 1.02},
    "fuzzy_noise": lambda: {"filt": filt(), "parameters": jf.fuzzy_noise_parameters(np.array([3.0, 4.0])), "unit": 1.0,
                            "scale": "both", "rules": None, "r_bounds": (0.01, 100.0), "q_bounds": (0.01, 100.0)},
    "fuzzy_noise_parameters": lambda: {"universe": np.array([3.0, 4.0]), "alpha": (11.08, 33.33, 66.67, 88.92),
                                       "forgetting": 0.8, "dtype": None},
    "fuzzy_scaled": lambda: {"filt": filt(), "system": jf.fuzzy.mamdani(np.array([3.0, 4.0])), "input": "innovation",
                             "unit": 1.0, "scale": "both", "reference": 1.0, "r_exponent": -1.0,
                             "q_exponent": -1.0, "floor": 1e-6, "r_bounds": (0.01, 100.0),
                             "q_bounds": (0.01, 100.0)},
    "gain_floor": lambda: {"filt": jf.detected(jf.kalman(planar())), "alpha": 0.9, "beta": 0.6, "dt": 1.0},
    "gated": lambda: {"filt": filt(), "p_false": 0.01},
    "hold_last": lambda: {"filt": filt()},
    "mean_of_recent": lambda: {"filt": filt(), "n": 3},
    "nearest_neighbor": lambda: {"filt": filt(), "p_false": 0.01},
    "nis_q": lambda: {"filt": filt(), "window": 5, "largest": 100.0},
    "p_inflated": lambda: {"filt": jf.detected(filt()), "factor": 5.0},
    "phase_locked": lambda: {"filt": jf.alpha_beta(0.4, 0.1, dt=0.5, r=0.1), "amplitude": 1.0, "floor": 0.2},
    "polynomial_fit": lambda: {"filt": filt(), "window": 4, "degree": 1, "forgetting": 0.9, "max_age": 5},
    "q_inflated": lambda: {"filt": jf.detected(filt()), "factor": 20.0},
    "residual_r": lambda: {"filt": filt(), "rate": 0.1, "largest": 100.0},
    "sage_husa": lambda: {"filt": filt(), "scale": "r", "forgetting": 0.9, "prior": 10.0, "bounds": (0.1, 10.0)},
    "sinusoid_fit": lambda: {"filt": filt(), "omega": 2, "window": 6, "interval": 1.0, "max_age": 5},
    "usable_where": lambda: {"filt": filt(), "condition": _all},
    "watched": lambda: {"filt": filt(), "limit": 5.0, "count": 20},
    # inputs
    "imu_inputs": lambda: {"gyr": STATES3, "acc": STATES3 + np.array([0.0, 0.0, 10.0]), "mask": MASK, "gravity": 9.81},
    "lag_inputs": lambda: {"ys": YS, "lag": np.array([0, 1, 0, 1]), "max_delay": 1},
    "scan_inputs": lambda: {"detections": YS3, "valid": np.ones((3, 4), bool), "u": None},
    "fit_ellipse": lambda: {"ys": CIRCLE, "mask": np.ones(40, bool), "block": 1, "limit": 0.1,
                            "least_coverage": 0.75},
    # models
    "models.linear_gaussian": lambda: {**LINEAR, "B": np.ones((3, 1)), "D": np.ones((2, 1)), "S": np.zeros((3, 2))},
    "models.nonlinear": lambda: {
        **{name: LINEAR[name] for name in ("Q", "R", "m0", "P0")}, "f": jax.tree_util.Partial(_linear, LINEAR["F"]),
        "h": jax.tree_util.Partial(_linear, LINEAR["H"]), "residual": None, "f_jacobian": None, "h_jacobian": None,
    },
    "models.as_nonlinear": lambda: {"model": model()},
    "models.constant_velocity": lambda: _motion(4, noise="continuous"),
    "models.constant_acceleration": lambda: _motion(6, noise="continuous"),
    "models.constant_jerk": lambda: _motion(8, noise="continuous"),
    "models.coordinated_turn": lambda: _motion(5, q_omega=0.01),
    "models.known_turn": lambda: _motion(4, omega=0.1),
    "models.singer": lambda: {"dt": 1.0, "tau": 5.0, "variance": 2.0, "r": 0.5, "m0": Z6, "P0": np.eye(6)},
    "models.maneuver_variance": lambda: {"largest": 3.0, "p_largest": 0.1, "p_zero": 0.5},
    "models.sine_cosine": lambda: {"dt": 0.5, "q": 0.02, "r": 0.3, "m0": Z2, "P0": np.eye(2), "parameters": None,
                                   "drift": None},
    "models.delay_probabilities": lambda: {"alpha": np.array([0.6, 0.5])},
    "models.success_probabilities": lambda: {"probabilities": np.array([0.6, 0.4])},
    "models.with_lags": lambda: {"model": model(), "max_delay": 2},
    "models.with_sensor": lambda: {"motion": planar(), "sensor": jf.models.sensors.position(np.eye(2))},
    "models.van_loan": lambda: {"A": np.array([[0.0, 1.0], [0.0, -0.5]]), "Qc": np.diag([0.0, 1.0]), "dt": 0.1},
    "models.imu_inputs": lambda: CALLS["imu_inputs"](),
    "models.sensors.position": lambda: {"R": np.eye(2)},
    "models.sensors.position_velocity": lambda: {"R": np.eye(4)},
    "models.sensors.range_bearing": lambda: {"R": np.eye(2), "observer": np.zeros(2)},
    "models.sensors.bearing": lambda: {"R": np.eye(1), "observer": np.zeros(2)},
    "models.sensors.range_rate": lambda: {"R": np.eye(3), "observer": np.zeros(4)},
    "models.sensors.bearing_doppler": lambda: {"R": np.eye(2), "speed": 1500.0, "observer": np.zeros(4),
                                               "doppler": "first"},
    # tuning
    "tune.bounds": lambda: {"space": space()},
    "tune.constrain": lambda: {"space": space(), "z": np.array([0.1])},
    "tune.unconstrain": lambda: {"space": space(), "params": {"q": np.array(0.3)}},
    "tune.initial": lambda: {"space": space()},
    "tune.to_vector": lambda: {"space": space()},
    "tune.size": lambda: {"space": space()},
    "tune.sample": lambda: {"space": space(), "key": KEY, "n": 3},
    "tune.positive": lambda: {"init": np.array([0.5, 1.0]), "low": 0.1, "high": 10.0},
    "tune.unit": lambda: {"init": np.array([0.5, 0.7])},
    "tune.interval": lambda: {"init": np.array([0.5, 0.7]), "low": 0.0, "high": 2.0},
    "tune.real": lambda: {"init": np.array([0.5, 0.7]), "low": -1.0, "high": 2.0},
    "tune.ordered": lambda: {"init": np.array([0.5, 0.7]), "low": 0.0, "high": 2.0},
    "tune.covariance": lambda: {"init": COV, "factor": 1e3},
    "tune.random_gap": lambda: {"key": KEY, "T": 10, "length": (2, 4), "warmup": 1},
    "tune.innovation_nll": lambda: {"filt": filt(), "ys": YS3, "warmup": 1, "key": None},
    "tune.prediction_mse": lambda: {"filt": filt(), "ys": YS3, "warmup": 1, "key": None},
    "tune.masked_nll": lambda: {"filt": filt(), "ys": YS3, "key": KEY, "length": (1, 1), "warmup": 1},
    "tune.rmse": lambda: {"filt": filt(), "ys": YS3, "truth": np.zeros((3, 4, 3)), "components": (0, 1),
                          "window": np.ones(4, bool), "key": None},
    "tune.consistency": lambda: {"filt": filt(), "ys": YS3, "truth": np.zeros((3, 4, 3)), "components": (0, 1),
                                 "window": np.ones(4, bool), "key": None},
    "tune.gradient": lambda: {"loss": _loss, "space": space(), "data": None, "key": KEY, "optimizer": None,
                              "steps": 2, "starts": 1, "spread": 1.0, "block": 2, "time_limit": 10.0},
    "tune.genetic": lambda: {"loss": _loss, "space": space(), "data": None, "key": KEY, "population": 4,
                             "generations": 2, "time_limit": 10.0},
    "tune.nsga2": lambda: {"losses": _losses, "space": space(), "data": None, "key": KEY, "population": 4,
                           "generations": 2, "weights": (1.0, 1.0), "time_limit": 10.0},
    # metrics
    "metrics.chi2_quantile": lambda: {"probability": 0.9, "dof": 3.0},
    "metrics.chi2_region": lambda: {"dof": 3.0, "runs": 10, "probability": 0.99},
    "metrics.consistency": lambda: {"values": np.full((5, 4), 2.0), "dof": 2.0, "probability": 0.99},
    "metrics.mean": lambda: {"values": np.array([1.0, 2.0, 4.0])},
    "metrics.root_mean": lambda: {"squares": np.array([1.0, 2.0, 4.0])},
    "metrics.ratio": lambda: {"numerator": np.array([1.0, 2.0, 4.0]), "denominator": np.array([1.0, 2.0, 3.0])},
    "metrics.squared_error": lambda: {"estimate": STATES3, "truth": STATES3[::-1], "components": (0, 1)},
    "metrics.mse": lambda: {"estimate": STATES3, "truth": STATES3[::-1], "components": (0, 1),
                            "window": np.ones(4, bool)},
    "metrics.rmse": lambda: {"estimate": STATES3, "truth": STATES3[::-1], "components": (0, 1),
                             "window": np.ones(4, bool)},
    "metrics.nees": lambda: {"mean": STATES3, "cov": np.stack([COV] * 4), "truth": STATES3[::-1],
                             "components": (0, 1)},
    "metrics.tilt_error": lambda: {"estimate": STATES3, "truth": STATES3[::-1]},
    "metrics.whiteness": lambda: {"innovations": np.sin(np.arange(40.0)).reshape(20, 2),
                                  "innovation_cov": np.stack([np.eye(2)] * 20), "mask": np.ones((20, 2), bool),
                                  "lags": 3},
    "metrics.posterior_bound": lambda: {"model": model(), "states": np.stack([STATES3] * 2), "P0": COV, "u": None,
                                        "dt": None, "mask": None},
    "metrics.start_bound": lambda: {"model": model(), "x0": np.zeros(3), "steps": 4, "prior": COV, "u": None,
                                    "dt": None, "mask": None},
    "metrics.predictor_gains": lambda: {**{name: LINEAR[name] for name in ("F", "H", "Q", "R")},
                                        "K": 0.1 * np.ones((3, 2)), "weight": np.eye(3), "frequencies": 20},
    # simulation
    "simulate.simulate": lambda: {"model": model(), "T": 4, "key": KEY, "x0": np.zeros(3), "dt": None, "u": None},
    "simulate.measure": lambda: {"model": model(), "states": STATES3, "key": KEY, "dt": None, "u": None},
    "simulate.deliver": lambda: {"zs": YS, "delays": np.array([0, 1, 0, 1]), "max_delay": 1},
    "simulate.draw_delays": lambda: {"probabilities": np.array([0.6, 0.4]), "shape": (3, 4), "key": KEY},
    "simulate.gap_mask": lambda: {"T": 10, "m": 2, "components": (0,)},
    "simulate.random_gap": lambda: {"key": KEY, "T": 10, "length": (2, 3), "first": (1, 4)},
    "simulate.random_loss": lambda: {"key": KEY, "T": 10, "probability": 0.3, "m": 2},
    "simulate.axis_of_quaternion": lambda: {"q": np.array([[1.0, 0.0, 0.0, 0.0]] * 2)},
    "simulate.euler_attitude": lambda: {"roll": np.zeros(3), "pitch": np.zeros(3), "yaw": np.zeros(3)},
    "simulate.imu": lambda: {"attitude": np.stack([np.eye(3)] * 4), "acceleration": np.zeros((4, 3)), "key": KEY,
                             "dt": 0.1, "lever": Z3(), "gyr_std": 0.001, "acc_std": 0.01, "bias0": Z3(),
                             "bias_walk": 1e-4, "acc_bias": Z3(), "gyr_matrix": np.eye(3), "acc_matrix": np.eye(3),
                             "frame": "up", "gravity": 9.81},
    # gains
    "gains.benedict_bordner": lambda: {"alpha": 0.5},
    "gains.simpson": lambda: _GAINS.copy(),
    "gains.cohen": dict,
    "gains.fading_memory": lambda: {"xi": 0.5, "order": 1},
    "gains.growing_memory": lambda: {"k": 3.0, "order": 1},
    "gains.tracking_index": lambda: {"q": 0.1, "r": 1.0, "dt": 1.0, "noise": "piecewise"},
    "gains.kalata": lambda: {"index": 0.3, "order": 1, "noise": "piecewise"},
    "gains.from_kappa": lambda: {"kappa": 0.1, "convention": "double"},
    "gains.to_kappa": lambda: {"gamma": 0.1, "convention": "double"},
    "gains.is_stable": lambda: {**_GAINS, "kappa": 0.05},
    "gains.variance_reduction": lambda: _TRIPLE.copy(),
    "gains.steady_covariance": lambda: {**_TRIPLE, "r": 1.0},
    "gains.steady_lag": lambda: {**_TRIPLE, "rate": 1.0},
    "gains.from_unconstrained": lambda: {"a": 0.1, "b": 0.2, "c": 0.3},
    "gains.to_unconstrained": lambda: {**_GAINS, "kappa": 0.05},
    # others
    "initial.batch_ml": lambda: {"model": model(), "ys": YS, "starts": np.zeros((2, 3)), "prior": (np.zeros(3), COV),
                                 "scale": np.ones(3), "iterations": 2, "damping": 0.01, "u": None, "dt": None,
                                 "mask": MASK},
    "initial.cost": lambda: {"model": jf.models.as_nonlinear(model()), "x0": np.zeros(3), "stacked": jf.inputs(YS),
                             "prior": None},
    "fuzzy.check_rules": lambda: {"rules": np.zeros((2, 2), int), "sets": 2, "inputs": 2, "levels": 3},
    "fuzzy.minimum_rules": lambda: {"levels": 3, "inputs": 2},
    "fuzzy.partition": lambda: {"universe": np.array([3.0, 4.0]), "sets": 3, "logits": np.zeros(5)},
    "fuzzy.triangles": lambda: {"levels": 4, "output_range": (0.0, 100.0)},
    "fuzzy.mamdani": lambda: {"universe": np.array([3.0, 4.0]), "sets": 4, "corners": None, "rules": None,
                              "outputs": None, "output_range": (0.0, 100.0)},
    "fuzzy.infer": lambda: {"system": jf.fuzzy.mamdani(np.array([3.0, 4.0])), "x": np.array([0.5, 1.0])},
    "maneuver.detector": lambda: {"statistic": "fading", "p_false": 0.01, "forgetting": 0.8, "window": 5},
    "maneuver.cumulative": lambda: {"nis": np.ones(5), "mask": np.ones((5, 2), bool), "m": 2},
    "sincos.arctan": lambda: {"ys": CIRCLE, "parameters": None, "mask": np.ones(40, bool), "counts": 64,
                              "floor": 0.2},
    "sincos.calibrated": lambda: {"mean": np.ones((4, 8)), "cov": np.stack([np.eye(8)] * 4), "prior": np.eye(8),
                                  "share": 0.1},
    "sincos.check_parameters": lambda: {"parameters": jf.sincos.Parameters()},
    "sincos.mask_clipped": lambda: {"ys": CIRCLE, "low": -0.9, "high": 0.9},
    "frames.from_frame": lambda: {"df": pd.DataFrame({"t": np.arange(4.0), "x": np.ones(4)}), "columns": ("x",),
                                  "time": "t", "first": 1.0},
    "frames.to_frame": lambda: {"out": info(), "index": None, "names": ("a", "b", "c")},
    "frames.to_xarray": lambda: {"out": info(), "times": None, "names": ("a", "b", "c")},
    "frames.status_text": lambda: {"status": np.zeros(4, np.int32)},
    "plots.track": lambda: {"out": info(), "truth": STATES3, "measurements": YS, "mask": MASK, "components": (0, 1),
                            "probability": 0.9, "ellipses": 3, "label": "a", "unit": "m", "ax": axes()},
    "plots.estimate": lambda: {"out": info(), "component": 1, "truth": STATES3, "measurements": YS[:, 0],
                               "mask": MASK, "times": np.arange(4.0), "sigmas": 2.0, "label": "a", "unit": "m",
                               "ax": axes()},
    "plots.errors": lambda: {"out": info(), "truth": STATES3, "components": (2,), "times": np.arange(4.0),
                             "sigmas": 2.0, "names": None, "axes": axes()},
    "plots.consistency": lambda: {"values": np.ones((3, 4)), "dof": 2.0, "probability": 0.9, "times": np.arange(4.0),
                                  "label": "NIS", "ax": axes()},
    "plots.mode_probabilities": lambda: {"probabilities": np.full((4, 2), 0.5), "names": None,
                                         "truth": np.array([0, 1, 1, 0]), "times": np.arange(4.0), "ax": axes()},
    "plots.memberships": lambda: {"before": np.array([[0.0, 0.0, 1.0, 2.0], [1.0, 2.0, 3.0, 3.0]]), "after": None,
                                  "universe": 4.0, "names": None, "unit": "m", "ax": axes()},
    "plots.monte_carlo": lambda: {"curves": {"a": np.ones((3, 4))}, "times": np.arange(4.0), "probability": 0.9,
                                  "unit": "m", "ax": axes()},
    "sincos.mechanical": lambda: {"theta": np.zeros(4), "cycles": 2},
}  # fmt: skip


def flags(function: Callable) -> dict[str, bool]:
    """The options of a function that are True or False (or None), with a valid value; no case need name them."""
    options = inspect.signature(function).parameters.values()
    found = (p for p in options if isinstance(p.default, bool) or re.match(r"bool\b", str(p.annotation)))
    return {p.name: p.default if isinstance(p.default, bool) else True for p in found}


def Z3() -> np.ndarray:
    return np.zeros(3)


def _inp():
    return jax.tree.map(lambda leaf: leaf[0], jf.inputs(YS))


class Odd:
    """An object of a type that nothing expects."""

    def __repr__(self):
        return "Odd()"


def wrong(value: Any) -> Iterator[tuple[str, Any]]:
    """``(kind, bad value)`` in the place of a valid one."""
    yield "text", "no such"
    yield "object", Odd()
    if value is None:
        return
    yield "none", None
    if isinstance(value, bool):
        yield from (("number", 1), ("fraction", 0.5), ("array", np.array([True])))
        return
    if isinstance(value, str):
        yield "number", 3
        return
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        yield "number", 3.5
        yield "floats", np.zeros(2)
        return
    if isinstance(value, int):
        yield from (("negative", -1), ("fraction", 1.5), ("nan", np.nan), ("array", np.array([1.0, 2.0])))
        return
    if callable(value) or (isinstance(value, tuple) and hasattr(value, "_fields")) or isinstance(value, dict):
        yield from (("number", 3.5), ("array", np.ones((3, 3))))
        return
    if isinstance(value, tuple) and not all(isinstance(x, int | float) for x in value):
        yield from (("number", 3.5), ("array", np.ones((3, 3))), ("empty", ()), ("shorter", (value[0], Odd())))
        return
    a = np.asarray(value)
    if a.dtype == object:
        yield from (("number", 3.5), ("array", np.ones((3, 3))))
        return
    yield from (("complex", a + 1j), ("empty", np.zeros((0,) * max(a.ndim, 1))), ("rank", a[None].repeat(2, 0)[None]))
    if a.ndim:
        yield "length", np.concatenate([a, a[..., -1:], a[..., -1:], a[..., -1:]], axis=-1)
    if a.dtype == bool:
        yield "floats", a.astype(float)
        return
    if np.issubdtype(a.dtype, np.integer):
        yield from (("fraction", a + 0.5), ("negative", -1 - a), ("nan", np.full(a.shape, np.nan)))
        return
    yield "integer", np.rint(a).astype(int)
    yield "single", a.astype(np.float32)
    yield "negative", -np.abs(a) - 0.25 * (a == 0)
    for kind, bad in (("nan", np.nan), ("inf", np.inf)):
        spoilt = a.copy()
        spoilt[(0,) * a.ndim] = bad
        yield kind, spoilt if a.ndim else float(spoilt)
