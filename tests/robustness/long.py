"""R11 to R15, R19: long series, and all patterns of loss."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from tests.examples import LINEAR
from tests.robustness import problems
from tests.robustness.problems import Linear, indefiniteness, relative
from tests.robustness.row import F32, F64, Goal, cast, row

FORMS = {"Joseph": (jf.kalman, "dense"), "array": (jf.sqrt_kalman, "dense")}
SCALAR = {"Joseph, scalar": (jf.kalman, "scalar"), "array, scalar": (jf.sqrt_kalman, "scalar")}


def covariance(state, info):
    """What the covariance rows look at."""
    del state
    return info.cov, info.status


def factor(state, info):
    """The factor that the array form carries; its product in single precision would not have the factor's digits."""
    return getattr(state, "chol", info.cov), info.status


@functools.partial(jax.jit, static_argnames=("make", "form", "steps", "keep", "outputs"))
def covariances(make, form, models: Linear, steps, keep="stack", outputs=covariance):
    """``(cov, status)`` over a series of each model; covariances do not depend on the data, which are zeros."""

    def one(model):
        filt = make(jf.models.linear_gaussian(*model))
        ys = jnp.zeros((steps, model.H.shape[0]), model.m0.dtype)
        return jf.filter(filt, ys, form=form, outputs=outputs, keep=keep)

    return jax.vmap(one)(models)


def forms(full):
    return {**FORMS, **SCALAR} if full else FORMS


def _goals(figure, goals, *others):
    """The same figures for each form; the scalar forms in the full measurement only."""
    out = {}
    for i, name in enumerate([*FORMS, *SCALAR]):
        joseph, array = goals
        goal = joseph if name.startswith("Joseph") else array
        f64 = None if name == "array" else goal.f64
        out[f"{name}: {figure}"] = Goal(goal.f32, f64, goal.proposed, goal.why, slow=i >= 2)
        for key, limit in others:
            out[f"{name}: {key}"] = Goal(limit, limit, slow=i >= 2)
    return out


MODELS = {
    "CA": [problems.acceleration(P0=P0) for P0 in (1e4, 1e5, 1e6)],
    "CA, Q = 0": [problems.acceleration(P0=P0, q=0.0) for P0 in (1e4, 1e5, 1e6)],
}


@row(
    13,
    "constant acceleration, P0 = 1e4 … 1e6, 1e6 steps (2e4 by default)",
    {
        **_goals("relative error of σ", (Goal(1e-3, 1e-9, "1e-3, –"), Goal(1e-3, 1e-9, "1e-3, –")),
                 ("−λmin / (n ε λmax)", 10)),
        **_goals("Q = 0: relative error of σ", (Goal(2e-2, 1e-9, "2e-2, –"), Goal(2e-2, 1e-9, "2e-2, –")),
                 ("Q = 0: −λmin / (n ε λmax)", 10)),
    },
    peers="(I − KH) P: negative variances at first; R block first 3e-4; array form with Q = 0: 1.3 % (f32)",
)  # fmt: skip
def r13(dtype, full):
    """The reference is the array form in float64; in float64 the forms are compared with each other."""
    steps, figures = 1_000_000 if full else 20_000, {}
    both = MODELS["CA"] + MODELS["CA, Q = 0"]
    exact = _deviations(covariances(jf.sqrt_kalman, "dense", cast(problems.stack(both), np.float64), steps)[0])
    for name, (make, form) in forms(full).items():
        cov = np.asarray(covariances(make, form, cast(problems.stack(both), dtype), steps)[0])
        errors = np.abs(_deviations(cov) / exact - 1).max(axis=(1, 2))
        for prefix, part in (("", slice(0, 3)), ("Q = 0: ", slice(3, 6))):
            if dtype == F32 or name != "array":  # which in float64 is the reference itself
                figures[f"{name}: {prefix}relative error of σ"] = float(errors[part].max())
            figures[f"{name}: {prefix}−λmin / (n ε λmax)"] = indefiniteness(cov[part][:, _looked_at(steps)])
    return figures


def _looked_at(steps):
    """The steps whose eigenvalues are computed: all of the transient, then one in fifty."""
    k = np.arange(steps)
    return (k < 20_000) | (k % 50 == 0)


def _deviations(cov):
    return np.sqrt(np.maximum(np.diagonal(np.asarray(cov), axis1=-2, axis2=-1).astype(np.float64), 0))


@row(
    14,
    "S4 of kalman-py, cond(P) = 2e7, 1e6 steps (2e4 by default)",
    {
        "array: factor's variance in the weakest direction, relative error": Goal(1e-3, 1e-3),
        "array: first step not PSD (0: none)": Goal(0, 0),
        "Joseph: variance in the weakest direction, relative error": Goal(None, 1e-3),
        "Joseph: first step not PSD (0: none)": Goal(0, 0),
    },
    peers="(I − KH) P not PSD from step 28 056, Joseph in NumPy from 2 753; symmetrised 0.76, R block first 0.9997",
    slow=(F64,),
)  # fmt: skip
def r14(dtype, full):
    steps, figures = 1_000_000 if full else 20_000, {}
    model = problems.kalman_py_s4()
    exact = covariances(jf.sqrt_kalman, "dense", cast(problems.stack([model.cast(np.float32)]), np.float64), 5000)[0]
    values, vectors = np.linalg.eigh(np.asarray(exact)[0, -1])
    weakest = vectors[:, 0]
    start = cast(problems.stack([model.cast(np.float32)]), dtype)
    for name, (make, form) in FORMS.items():
        cov = np.asarray(covariances(make, form, start, steps, outputs=factor)[0])[0].astype(np.float64)
        if name == "array":
            got = np.square(weakest @ cov[5000:]).sum(axis=1)
            key = "array: factor's variance in the weakest direction, relative error"
            cov = np.asarray(np.asarray(cov, dtype) @ np.swapaxes(np.asarray(cov, dtype), 1, 2), np.float64)
        else:
            got = np.einsum("i,tij,j->t", weakest, cov[5000:], weakest)
            key = "Joseph: variance in the weakest direction, relative error"
        figures[key] = float(np.abs(got / values[0] - 1).max())
        eigenvalues = np.linalg.eigvalsh(cov if dtype == F32 else cov[::10])
        smallest, largest = eigenvalues[:, 0], eigenvalues[:, -1]
        bad = ~(smallest >= -10 * 4 * float(np.finfo(dtype).eps) * largest)
        figures[f"{name}: first step not PSD (0: none)"] = int(np.argmax(bad)) + 1 if bad.any() else 0
    return figures


@functools.partial(jax.jit, static_argnames=("make", "keep"))
def _likelihood(make, model, ys, keep):
    return jf.filter(make(jf.models.linear_gaussian(*model)), ys, outputs=jf.log_lik, keep=keep, form="dense")


@row(
    15,
    "log-likelihood of 1e6 steps (1e5 by default)",
    {
        "sum of the outputs: error [nat]": Goal(0.1, 1e-6, "0.1, –"),
        'keep="sum": error [nat]': Goal(0.1, 1e-6, "0.1, –"),
        "in parallel, sum of the outputs: error [nat]": Goal(0.1, 1e-6, "0.1, –"),
    },
    peers="a carried float32 sum: −384 nat",
    slow=(F64,),
)
def r15(dtype, full):
    steps = 1_000_000 if full else 100_000
    model = Linear(*(LINEAR[k] for k in ("F", "H", "Q", "R", "m0", "P0"))).cast(np.float32)
    lg = jf.models.linear_gaussian(*cast(model, np.float64))
    _, ys = jf.simulate.simulate(lg, steps, jax.random.key(1))
    ys = np.asarray(ys, np.float32)  # both precisions filter the same numbers
    exact = np.asarray(_likelihood(jf.sqrt_kalman, cast(model, np.float64), jnp.asarray(ys, np.float64), "stack"))
    exact = exact.astype(np.longdouble).sum()
    model, ys = cast(model, dtype), jnp.asarray(ys, dtype)
    lg = jf.models.linear_gaussian(*model)
    totals = {
        "sum of the outputs: error [nat]": jnp.sum(_likelihood(jf.kalman, model, ys, "stack")),
        'keep="sum": error [nat]': _likelihood(jf.kalman, model, ys, "sum"),
        "in parallel, sum of the outputs: error [nat]": jnp.sum(jf.filter_parallel(lg, ys, outputs=jf.log_lik)),
    }
    return {key: float(abs(np.longdouble(float(total)) - exact)) for key, total in totals.items()}


def _unobservable(growth):
    """Constant velocity, and a third state that H never sees; correlated with the others at first."""
    two = problems.velocity(q=0.1)
    F = np.block([[two.F, np.zeros((2, 1))], [np.zeros((1, 2)), np.array([[growth]])]])
    Q = np.block([[two.Q, np.zeros((2, 1))], [np.zeros((1, 2)), np.array([[0.1]])]])
    P0 = np.array([[100.0, 10, 20], [10, 25, 5], [20, 5, 30]])
    return two._replace(F=F, H=np.eye(1, 3), Q=Q, m0=np.zeros(3), P0=P0)


@row(
    11,
    "a state that H never sees, 1e5 steps (4e4 by default), constant or growing",
    {
        "observed block against the reduced filter": Goal(1e-5, 1e-5),
        "not finite before P33 = 1e30": Goal(0, 0),
    },
    slow=(F64,),
)
def r11(dtype, full):
    steps, figures = 100_000 if full else 40_000, {"observed block against the reduced filter": 0.0}
    three = [_unobservable(growth) for growth in (1.0, 1.001)]
    two = [problems.velocity(q=0.1)._replace(P0=m.P0[:2, :2]) for m in three]
    bad = 0
    for make, form in forms(full).values():
        cov = np.asarray(covariances(make, form, cast(problems.stack(three), dtype), steps)[0])
        want = np.asarray(covariances(make, form, cast(problems.stack(two), dtype), steps)[0])
        small = ~(np.abs(cov[..., 2, 2]) > 1e30)
        small = np.cumprod(small, axis=1).astype(bool)
        bad += int((~np.isfinite(cov).all(axis=(2, 3)) & small).sum())
        error = np.abs(cov[..., :2, :2] - want).max(axis=(2, 3)) / np.abs(want).max(axis=(2, 3))
        figures["observed block against the reduced filter"] = max(
            figures["observed block against the reduced filter"], float(error[small].max())
        )
    return {**figures, "not finite before P33 = 1e30": bad}


@row(
    12,
    "an unstable mode (1.05) that is observed, 1e4 steps, against the Riccati equation",
    {
        "relative error of P at the end": Goal(1e-4, 1e-10, "1e-4, –"),
        "and of the steady-state filter": Goal(1e-4, 1e-10, "1e-4, –"),
    },
    slow=(F64,),
)
def r12(dtype, full):
    from scipy.linalg import solve_discrete_are

    F, H = np.array([[1.05, 0.1, 0.0], [0.0, 0.9, 0.3], [0.0, -0.3, 0.8]]), np.array([[1.0, 0.2, 0.0]])
    Q = np.diag([0.1, 0.2, 0.3])
    model = Linear(F, H, Q, np.array([[2.0]]), np.zeros(3), np.eye(3)).cast(dtype)
    F, H, Q, R, _, _ = (np.asarray(x, np.float64) for x in model)
    prior = solve_discrete_are(F.T, H.T, Q, R)
    posterior = prior - prior @ H.T @ np.linalg.solve(H @ prior @ H.T + R, H @ prior)
    worst = 0.0
    for make, form in forms(full).values():
        cov, _ = covariances(make, form, cast(problems.stack([model]), dtype), 10_000, keep="last")
        worst = max(worst, relative(cov[0], posterior))
    steady = jf.filter(jf.steady_state(jf.models.linear_gaussian(*cast(model, dtype))), jnp.zeros((1, 1), dtype))
    return {
        "relative error of P at the end": worst,
        "and of the steady-state filter": relative(steady.cov[-1], posterior),
    }


@functools.partial(jax.jit, static_argnames=("make",))
def _losses(make, model, masks):
    ys = jnp.zeros((masks.shape[1], 1), model.m0.dtype)
    filt = make(jf.models.linear_gaussian(*model))
    return jax.vmap(lambda mask: jf.filter(filt, ys, mask=mask, outputs=covariance)[0].trace(axis1=1, axis2=2))(masks)


@row(
    19,
    "random loss beside the critical rate 1 − 1/ρ² = 0.75 of arrivals, ρ = 2, exact over all 2^12 patterns",
    {
        "arrivals 0.5: growth of E‖P‖ per step against ρ² (1 − λ) = 2, relative": Goal(1e-2, 1e-2, "grows"),
        "arrivals 0.95: last change of E‖P‖ per step, relative": Goal(1e-3, 1e-3, "bounded"),
    },
)
def r19(dtype, full):
    steps = 12
    patterns = (np.arange(2**steps)[:, None] >> np.arange(steps)) & 1
    model = Linear(np.array([[2.0, 0.3], [0.0, 0.5]]), np.array([[1.0, 0.1]]), 0.1 * np.eye(2), np.eye(1), np.zeros(2),
                   np.eye(2))  # fmt: skip
    figures = {}
    for make in (jf.kalman, jf.sqrt_kalman) if full else (jf.kalman,):
        traces = np.asarray(_losses(make, cast(model, dtype), jnp.asarray(patterns, bool)[:, :, None]), np.float64)
        for arrivals, key, expected in (
            (0.5, "arrivals 0.5: growth of E‖P‖ per step against ρ² (1 − λ) = 2, relative", 2.0),
            (0.95, "arrivals 0.95: last change of E‖P‖ per step, relative", 1.0),
        ):
            weights = np.prod(np.where(patterns, arrivals, 1 - arrivals), axis=1)
            mean = weights @ traces
            figures[key] = max(figures.get(key, 0.0), abs(mean[-1] / mean[-2] / expected - 1))
    return figures
