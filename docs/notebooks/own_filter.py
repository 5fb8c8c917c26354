# %% [markdown]
# # Your own filter, tested by the registry
#
# A filter in `jaxfilt` is five pure functions bound to their parameters, nothing more. Write them, and everything works
# with it: masks, irregular intervals, batches, gradients, smoothing, tuning, Monte Carlo. This notebook writes one that
# the library does not have, the *consider* filter (Schmidt 1966), and has it tested by the properties that every filter
# of the library must have.
#
# A sensor has a bias that nobody knows exactly. One can ignore it, which makes the filter overconfident; one can put it
# into the state and estimate it, which trusts a model of the bias; or one can *consider* it: reckon with its
# uncertainty without ever estimating it.

# %% tags=["parameters"]
runs = 20_000
thorough = True  # also the properties whose compilation takes long

# %% [markdown]
# The property tests compare to 1e-10, so double precision is on here, and JAX is as strict as in the library's tests.

# %%
import time
import traceback
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from jax import Array

import jaxfilt as jf
from jaxfilt.core import Prediction, bind
from jaxfilt.filters.common import check_measurement, decoupled, innovate, likelihood, masked_rows
from jaxfilt.linalg import chol, mirror, scale_cov, solve_chol, solve_lower, sym

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# %% [markdown]
# ## Parameters and state
#
# Both are NamedTuples. What is static (here: which components are only considered) goes into `jf.Static`, everything
# else is a leaf, so it can be tuned by gradient and stacked by `jax.vmap`.


# %%
class Params(NamedTuple):
    """A linear-Gaussian model of matrices, and the components that are not estimated."""

    model: jf.models.LinearGaussian
    considered: jf.Static  # indices


class State(NamedTuple):
    """Posterior moments."""

    mean: Array  # (n,)
    cov: Array  # (n, n)


# %% [markdown]
# ## Five functions
#
# `init` sees the first input (shapes, dtype, key). `predict` returns the state and a `Prediction`: with the
# cross-covariance in it, `jf.smooth` works. `update` returns the state and an `Info`. Rules that the functions of
# `jaxfilt.filters.common` keep for you: what is absent never enters the arithmetic, a value that is not finite is
# flagged and ignored, nothing raises.
#
# The gain of a considered component is 0. A gain that is not the optimal one needs the covariance in Joseph's form,
# `(I - K H) P (I - K H)' + K R K'`, which holds for any K.


# %%
def _init(p, inp):
    check_measurement(inp, p.model.H.shape[0])
    if inp.dt is not None:
        raise ValueError("dt: the model's matrices are fixed")
    return State(p.model.m0, sym(p.model.P0))


def _predict(p, s, inp):
    F, Q = p.model.F, sym(scale_cov(p.model.Q, inp.q_scale))
    mean, cross = F @ s.mean, s.cov @ F.T
    cov = mirror(F @ cross) + Q  # `mirror` makes a product symmetric to the bit
    return State(mean, cov), Prediction(mean, cov, cross)


def _gain(p, L, Hm, P):
    K = solve_chol(L, Hm @ P).T
    return K.at[jnp.array(p.considered.value)].set(jnp.zeros((), K.dtype))


def _update(p, s, inp):
    H, R = p.model.H, sym(scale_cov(p.model.R, inp.r_scale))
    nu, mask, status = innovate(inp, H @ s.mean)
    S = mirror(H @ s.cov @ H.T) + R
    L, Hm = chol(decoupled(mask, S)), masked_rows(mask, H)
    nis, log_lik, singular = likelihood(mask, L, solve_lower(L, nu))
    K = _gain(p, L, Hm, s.cov)
    A = jnp.eye(s.mean.shape[0], dtype=K.dtype) - K @ Hm
    new = State(s.mean + K @ nu, mirror(A @ s.cov @ A.T + K @ R @ K.T))
    return new, jf.Info(new.mean, new.cov, nu, S, nis, log_lik, status | singular, noise_cov=R)


def _moments(p, s):
    return s.mean, s.cov


def _with_moments(p, s, mean, cov):
    return State(mean, cov)


def consider(model: jf.models.LinearGaussian, components: tuple[int, ...]) -> jf.Filter:
    """The Schmidt-Kalman filter: the ``components`` of the state are reckoned with and never estimated."""
    if any(callable(matrix) for matrix in (model.F, model.H, model.Q, model.R)):
        raise ValueError("model: expected matrices, not functions")
    return bind(Params(model, jf.Static(tuple(components))), _init, _predict, _update, _moments, _with_moments)


# %% [markdown]
# ## Register it
#
# One entry in `tests/examples/`, collected by `tests/registry.py`: how to make a small one from float parameters. A
# test walks the public factories of the library and fails for one that has no entry. An exemption from a property is
# part of the entry, with its reason. Here the entry is made in the notebook.

# %%
from tests import test_properties
from tests.examples import GAP, LINEAR, Example
from tests.registry import REGISTRY


def _consider(p):
    return consider(jf.models.linear_gaussian(**p), (2,))


REGISTRY["consider"] = Example(consider, _consider, LINEAR, options=GAP)

# %% [markdown]
# ## Run the properties
#
# They are ordinary pytest functions of a filter's name; `pytest tests/test_properties.py -k consider` runs them all.

# %%
quick = {
    "test_shapes_dtypes_and_covariances": jnp.float64,
    "test_all_false_mask_is_prediction": jnp.float64,
    "test_a_bad_value_is_flagged_and_other_runs_are_untouched": jnp.float64,
    "test_wrong_dtype_or_shape_is_refused": None,
}
slower = {
    "test_all_true_mask_is_no_mask": None,
    "test_vmap_equals_loop": None,
    "test_scan_equals_single_steps_and_streams": None,
    "test_population_of_filters_is_a_vmap": None,
    "test_no_retrace_with_new_parameters_and_data": None,
    "test_gradient_equals_central_differences": None,
}


def run_properties(name, chosen):
    """A row per property: passed, or what the test says."""
    rows = {}
    for test, dtype in chosen.items():
        begun = time.perf_counter()
        try:
            getattr(test_properties, test)(name, *([] if dtype is None else [dtype]))
            verdict = "passed"
        except AssertionError as error:
            verdict = "FAILED: " + str(traceback.extract_tb(error.__traceback__)[-1].line)
        rows[test] = {"verdict": verdict, "seconds": round(time.perf_counter() - begun, 1)}
    return pd.DataFrame(rows).T


properties = quick | slower if thorough else quick
verdicts = run_properties("consider", properties)
verdicts

# %% [markdown]
# A test that cannot fail is worth nothing. The textbook's short form `(I - K H) P` holds for the optimal gain only;
# with the gain of a consider filter it gives a matrix that is no covariance. Do the properties notice?


# %%
def _short_update(p, s, inp):
    new, info = _update(p, s, inp)
    S_factor = chol(decoupled(inp.mask, info.innovation_cov))
    Hm = masked_rows(inp.mask, p.model.H)
    cov = (jnp.eye(3, dtype=new.cov.dtype) - _gain(p, S_factor, Hm, s.cov) @ Hm) @ s.cov
    return State(new.mean, cov), info._replace(cov=cov)


def _broken(p):
    return bind(_consider(p).init.args[0], _init, _predict, _short_update, _moments, _with_moments)


REGISTRY["broken"] = Example(consider, _broken, LINEAR, options=GAP)
broken = run_properties("broken", {"test_shapes_dtypes_and_covariances": jnp.float64})
broken

# %% [markdown]
# ## And is it any good?
#
# A target on a line, a precise sensor with a bias and a rough one without. The bias has a standard deviation of 5 m.
# Both filters that know of it believe it constant; in truth it swings slowly, as a bias that depends on temperature or
# on the direction may. `jf.monte_carlo` compares three filters by their errors and by NEES of position and velocity.

# %%
T, bias_std, period = 200, 5.0, 120.0
F = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
H = np.array([[1.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
Q = np.zeros((3, 3))
Q[:2, :2] = 0.1 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
R, m0 = np.diag([1.0, 400.0]), np.zeros(3)
model = jf.models.linear_gaussian(F, H, Q, R, m0, np.diag([100.0, 25.0, bias_std**2]))
ignorant = jf.models.linear_gaussian(
    F[:2, :2], np.tile(H[:1, :2], (2, 1)), Q[:2, :2], R, m0[:2], np.diag([100.0, 25.0])
)
filters = {
    "bias ignored": jf.kalman(ignorant),
    "bias estimated": jf.kalman(model),
    "bias considered": consider(model, (2,)),
}


def draw(key):
    motion_key, bias_key = jax.random.split(key)
    truth, ys = jf.simulate.simulate(ignorant, T, motion_key)
    swing = bias_std * jax.random.normal(bias_key, (2,))  # the variance is the same at all times
    angle = 2 * np.pi / period * jnp.arange(T, dtype=ys.dtype)
    bias = swing[0] * jnp.cos(angle) + swing[1] * jnp.sin(angle)
    return jf.Draw(truth, ys.at[:, 0].add(bias))


def score(truth, ys, out):
    return {"squared": (out.mean[:, 0] - truth[:, 0]) ** 2,
            "nees": jf.metrics.nees(out.mean[:, :2], out.cov[:, :2, :2], truth)}  # fmt: skip


result = jf.monte_carlo(jf.Scenario(jax.tree_util.Partial(draw)), filters, score, runs, jax.random.key(0))
figure, axes = plt.subplots(1, 2, figsize=(13, 4.5), layout="constrained")
jf.plots.monte_carlo({name: s["squared"] for name, s in result.scores.items()}, root=True, unit="m", ax=axes[0])
axes[0].set_ylabel("position RMSE [m]")
for name, scores in result.scores.items():
    axes[1].semilogy(scores["nees"].mean(axis=0), label=name)
axes[1].axhline(2, color="k", lw=1, ls="--", label="honest")
axes[1].set(xlabel="sample", title="mean NEES of position and velocity")
axes[1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
plt.show()

# %%
late = slice(T // 2, T)
rows = {}
for name, scores in result.scores.items():
    rmse = jf.metrics.root_mean(scores["squared"][:, late].mean(axis=1))
    rows[name] = {"RMSE, second half [m]": float(rmse.value), "± s.e.": float(rmse.standard_error),
                  "NEES / 2": scores["nees"][:, late].mean() / 2}  # fmt: skip
table = pd.DataFrame(rows).T
passed = (verdicts.verdict == "passed").sum()
print(f"{passed} of {len(verdicts)} properties passed; the broken one: {broken.verdict.iloc[0]}")
print(f"lowest error: {table.iloc[:, 0].idxmin()}; most honest: {np.log(table['NEES / 2']).abs().idxmin()}")
table.round(3)

# %% [markdown]
# ## What to take away
#
# * Five functions, `bind`, one entry in the registry: then the library's properties are yours too, gradients included.
# * If what you have in mind can be had by changing another filter's inputs or outputs, write a wrapper (`jf.wrap`)
#   instead: it works around any filter. `jaxfilt/wrappers/gate.py` is a short one.
# * A contribution is: the filter's file with its source in the docstring, its name in `jaxfilt/filters/__init__.py` and
#   `jaxfilt/__init__.py`, its example in `tests/examples/`, and tests of what is particular to it (limits in which it
#   must equal another filter, a naive reference).
#
# Next: `CONTRIBUTING.md` for the ways of the house; `tests/robustness` for the problems on which filters break.
