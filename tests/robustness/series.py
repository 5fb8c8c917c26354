"""R5 to R8, R18, R20 to R22, R28: short series, beside 80-bit arithmetic, reduced problems and dense solves."""

from __future__ import annotations

import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from tests import reference
from tests.examples import LINEAR
from tests.registry import REGISTRY, params, series
from tests.robustness import problems
from tests.robustness.problems import Linear, asymmetric, having, indefiniteness, not_finite, relative, without
from tests.robustness.row import F32, F64, Goal, cast, count, row

MISSED, SINGULAR, BOUND, NONFINITE = jf.Status.MISSED, jf.Status.SINGULAR, jf.Status.BOUND, jf.Status.NONFINITE
T = 50


def sequential(make, form, model, ys, mask=None):
    """One series in sequence; ``make`` is a factory of a linear model."""
    return jf.filter(make(model), ys, mask=mask, form=form)


def parallel(make, form, model, ys, mask=None):
    """The Kalman filter in parallel over time."""
    del make, form
    return jf.filter_parallel(model, ys, mask=mask)


RUNNERS = {
    "Joseph": (sequential, jf.kalman, "dense"), "array": (sequential, jf.sqrt_kalman, "dense"),
    "parallel": (parallel, jf.kalman, "dense"), "Joseph, scalar": (sequential, jf.kalman, "scalar"),
    "array, scalar": (sequential, jf.sqrt_kalman, "scalar"),
}  # fmt: skip


@functools.partial(jax.jit, static_argnames=("runner",))
def likelihoods(runner, models: Linear, ys):
    """Info of each model on the same series, and the gradient of its log-likelihood by every entry of the model."""
    run, make, form = RUNNERS[runner]

    def one(model):
        out = run(make, form, jf.models.linear_gaussian(*model), ys)
        return out.log_lik.sum(), out

    return jax.vmap(jax.value_and_grad(one, has_aux=True))(models)


# The rows' cases: one constant-velocity target with other covariances in the filter than in the data.
CASES = {
    "R6": {
        "P0 = 0": problems.velocity(P0=np.zeros((2, 2))),
        "P0 of rank 1": problems.velocity(P0=np.outer([10.0, 5.0], [10.0, 5.0])),
        "P0 = 1e8 I": problems.velocity(P0=1e8 * np.eye(2)),
        "P0 = diag(1e-8, 1e8)": problems.velocity(P0=np.diag([1e-8, 1e8])),
        "P0 = diag(1e8, 1e-8)": problems.velocity(P0=np.diag([1e8, 1e-8])),
    },
    "R7": {
        "Q = 0": problems.velocity(q=0.0),
        "Q of rank 1": problems.velocity(noise="piecewise"),
        "P0 = Q = 0": problems.velocity(q=0.0, P0=np.zeros((2, 2))),
    },
    "R8": {"R = 2.5e-9": problems.velocity(r=2.5e-9)},
    # With a perfect sensor no float32 likelihood can be compared: the posterior's rank is what rounding makes of it.
    "R = 0": {
        "R = 0": problems.velocity(r=0.0),
        "R = P0 = Q = 0": problems.velocity(q=0.0, r=0.0, P0=np.zeros((2, 2))),
    },
}
NAMES = [(row, case) for row, cases in CASES.items() for case in cases]


@functools.cache
def singular_cases(dtype, full):
    """``{runner: {(row, case): (error of the log-likelihood, gradient, Info)}}``."""
    ys = problems.draw(problems.velocity(), T, seed=1).astype(dtype)
    models = [CASES[r][case].cast(dtype) for r, case in NAMES]
    exact = [None if r == "R = 0" else problems.filter_80_bit(model, ys)[2].sum()
             for (r, _), model in zip(NAMES, models, strict=True)]  # fmt: skip
    found = {}
    for runner in list(RUNNERS)[: 5 if full else 3]:
        (totals, out), gradients = likelihoods(runner, cast(problems.stack(models), dtype), jnp.asarray(ys))
        # Summed as a user would, per step and in the filter's precision.
        found[runner] = {
            name: (
                np.nan if exact[i] is None else abs(float(totals[i]) - float(exact[i])),
                jax.tree.map(lambda x, i=i: x[i], gradients),
                jax.tree.map(lambda x, i=i: np.asarray(x[i]), out),
            )
            for i, name in enumerate(NAMES)
        }
    return found


def _likelihood_figures(number, dtype, full):
    figures = {}
    for runner, cases in singular_cases(dtype, full).items():
        errors = {case: found[0] for (r, case), found in cases.items() if r == number}
        bad = sum(not_finite(found[1:]) for (r, _), found in cases.items() if r == number)
        figures[f"{runner}: error of ℓ [nat]"] = max(errors.values(), key=lambda x: np.inf if np.isnan(x) else x)
        figures[f"{runner}: not finite, gradients too"] = bad
    return figures


def _likelihood_goals(covariance_forms=1e-2):
    """1e-2 nat in float32; the file asks nothing of float64, where we ask for 1e-6."""
    goals = {}
    for i, (runner, (_, make, _)) in enumerate(RUNNERS.items()):
        f32 = covariance_forms if make is jf.kalman else 1e-2
        goals[f"{runner}: error of ℓ [nat]"] = Goal(f32, 1e-6, f"{f32:g}, –", slow=i >= 3)
        goals[f"{runner}: not finite, gradients too"] = Goal(0, 0, slow=i >= 3)
    return goals


@row(
    6,
    "P0 = 0, of rank 1, 1e8 I, mixed 1e-8 and 1e8; T = 50",
    _likelihood_goals(covariance_forms=0.5),
    peers="1e8 I: Joseph −0.52, cuthbert −0.74, dynamax −11.7 (f32); 0 or rank 1: cuthbert NaN in f64 too",
    also=["tests/filters/test_kalman.py::test_gradients_at_singular_covariances"],
    group="singular",
)
def r6(dtype, full):
    return _likelihood_figures("R6", dtype, full)


@row(
    7,
    "Q = 0, of rank 1, P0 = Q = 0; in sequence and in parallel; T = 50",
    _likelihood_goals(),
    peers="cuthbert in parallel NaN; kalman-py's array form NaN at P0 = Q = 0",
    group="singular",
)
def r7(dtype, full):
    return _likelihood_figures("R7", dtype, full)


@row(
    8,
    "R = 2.5e-9; a perfect sensor (R = 0); T = 50",
    {
        **_likelihood_goals(),
        "R = 0: not finite": count(),
        "R = 0: −λmin / (n ε λmax)": Goal(10, 10),
        "R = 0 with P0 = Q = 0 (S = 0): not told": count(),
    },
    peers="cuthbert +5611 in sequence, +2566 in parallel, dynamax 1e-4 (f32)",
    group="singular",
)
def r8(dtype, full):
    figures = _likelihood_figures("R8", dtype, full)
    figures |= {
        "R = 0: not finite": 0,
        "R = 0: −λmin / (n ε λmax)": -np.inf,
        "R = 0 with P0 = Q = 0 (S = 0): not told": 0,
    }
    for cases in singular_cases(dtype, full).values():
        for case in ("R = 0", "R = P0 = Q = 0"):
            info = cases["R = 0", case][2]
            figures["R = 0: not finite"] += not_finite(info)
            figures["R = 0: −λmin / (n ε λmax)"] = max(
                figures["R = 0: −λmin / (n ε λmax)"], indefiniteness(info.cov), indefiniteness(info.innovation_cov)
            )
        figures["R = 0 with P0 = Q = 0 (S = 0): not told"] += without(
            cases["R = 0", "R = P0 = Q = 0"][2].status, SINGULAR
        )
    return figures


# R5: what each parameter of the registry's examples becomes in a state and a sensor of another unit: its power of it.
POWERS = {
    "F": 0, "H": 0, "Q": 2, "R": 2, "m0": 1, "P0": 2, "r": 2, "q": 2, "theta": -1, "weight": 0, "alpha": 0, "beta": 0,
    "gamma": 0, "dt": 0, "factor": 0, "forgetting": 0, "exponent": 0, "floor": 0, "stay": 0, "prior": 0, "p_false": 0,
}  # fmt: skip
# The bound of the pure H-infinity filter is that of a ratio of weighted squares, not of its root.
SQUARED = {"hinf": ("theta",)}
# Examples with something in them that has another unit: a state that is an angular rate, detections at fixed distances.
OTHER_UNITS = ("sinusoid_fit", "nearest_neighbor")
UNITS_SMALL = ("kalman", "sqrt_kalman", "imm")


def _power(name, path):
    key = path[-1].key
    return POWERS[key] * (2 if key in SQUARED.get(name, ()) else 1)


def scalable(name):
    """Whether all parameters of an example have a known power of the unit; random ones are not compared to the bit."""
    example = REGISTRY[name]
    paths = jax.tree_util.tree_flatten_with_path(example.params)[0]
    known = all(getattr(path[-1], "key", None) in POWERS for path, _ in paths)
    return (
        known
        and name not in OTHER_UNITS
        and "key" not in example.options
        and example.params.keys() & {"model", "F", "alpha", "large", "ca"} != set()
    )


@functools.partial(jax.jit, static_argnames=("name",))
def _in_units(name, p, ys, scales):
    example = REGISTRY[name]

    def one(s):
        scaled = jax.tree_util.tree_map_with_path(lambda path, x: x * s ** _power(name, path), p)
        out = jf.filter(example.make(scaled), ys * s, form="dense", **example.options)
        cov = None if out.cov is None else out.cov / s / s
        return out.mean / s, cov, out.nis, out.log_lik, out.status

    return jax.vmap(one)(scales)


def _without_unit(log_lik, scales):
    """A sample with a density adds log s, one that a start or a gate uses up nothing: so n log s, n a whole number."""
    s, log_lik = np.log(np.asarray(scales, np.float64)), np.asarray(log_lik, np.float64)
    base, far = int(np.argmin(np.abs(s))), int(np.argmax(s))
    return log_lik + s[:, None] * np.round((log_lik[base] - log_lik[far]) / s[far])


@row(
    5,
    "state and sensor in other units, 10^k, k = −12 … 12",
    {
        "relative change": Goal(1e-4, 1e-10),
        "changed status": count(),
    },
    peers="dynamax: 0.001 instead of 0.5 with k = −6 (f64); others invariant",
    also=["tests/filters/test_kalman.py::test_units_do_not_matter", "tests/linalg/test_dense.py"],
)
def r5(dtype, full):
    scales = jnp.asarray(10.0 ** np.array(range(-12, 13) if full else (0, -12, -6, 6, 12)), dtype)
    base = 12 if full else 0
    figures = {"relative change": 0.0, "changed status": 0}
    for name in [n for n in sorted(REGISTRY) if scalable(n)] if full else UNITS_SMALL:
        example = REGISTRY[name]
        *numbers, log_lik, status = _in_units(name, params(example, dtype), series(example, dtype), scales)
        if log_lik is not None:
            numbers.append(_without_unit(log_lik, scales))
        for x in jax.tree.leaves(numbers):
            figures["relative change"] = max(figures["relative change"], relative(x, np.asarray(x)[base][None]))
        figures["changed status"] += int((np.asarray(status) != np.asarray(status)[base]).sum())
    return figures


def _dropping(dtype):
    rng = np.random.default_rng(11)
    model = Linear(*reference.random_model(rng, 3, 3)).cast(dtype)
    ys = (2 * rng.normal(size=(T, 3))).astype(dtype)
    keep = np.array([[1, 2], [0, 2], [0, 1]])
    return model, ys, keep


@functools.partial(jax.jit, static_argnames=("make", "masked"))
def _partial(make, model, ys, masks, masked=True):
    """Log-likelihood, its gradient by scales of Q and R, means and covariances, for each mask."""

    def one(model, ys, mask):
        def f(scale):
            m = model._replace(Q=scale[0] * model.Q, R=scale[1] * model.R)
            out = jf.filter(make(jf.models.linear_gaussian(*m)), ys, mask=mask if masked else None, form="dense")
            return out.log_lik.sum(), out

        return jax.value_and_grad(f, has_aux=True)(jnp.ones((2,), ys.dtype))

    return jax.vmap(one)(model, ys, masks)


@row(
    18,
    "masks: none present, all present, some present",
    {
        "some present against rows dropped": Goal(
            2e-6,
            1e-12,
            "1e-6, 1e-12",
            "fifty steps sum over three rows in place of two, in another order: 9 ε",
        ),
        "gradient against the reduced problem's": Goal(1e-5, 1e-11, "equal"),
        "all present against no mask": Goal(1e-5, 1e-13),
        "none present against prediction": Goal(0, 0, "equal"),
    },
    peers="dynamax all NaN on masked rows",
    also=[
        "tests/test_properties.py::test_all_true_mask_is_no_mask",
        "tests/test_properties.py::test_all_false_mask_is_prediction",
        "tests/filters/test_kalman.py::test_masking_rows_equals_dropping_them_gradient_included",
    ],
    slow=(F32, F64),
)
def r18(dtype, full):
    """Three sensors of which one is always away, beside the two that remain; then all, and none."""
    model, ys, keep = _dropping(dtype)
    masks = np.ones((5, T, 3), bool)
    for i, rows in enumerate(keep):
        masks[i, :, np.setdiff1d(range(3), rows)] = False
    masks[4] = False
    several = cast(problems.stack([model] * 5), dtype)
    reduced = problems.stack([model._replace(H=model.H[rows], R=model.R[np.ix_(rows, rows)]) for rows in keep])
    ys_kept = jnp.asarray(np.stack([ys[:, rows] for rows in keep]))
    figures = dict.fromkeys(("some present against rows dropped", "gradient against the reduced problem's",
                             "all present against no mask", "none present against prediction"), 0.0)  # fmt: skip

    def worst(key, got, want):
        figures[key] = max(figures[key], relative(got, want))

    for make in (jf.kalman, jf.sqrt_kalman, jf.extended, jf.unscented) if full else (jf.kalman,):
        (ll, out), gradient = _partial(make, several, jnp.asarray(np.stack([ys] * 5)), jnp.asarray(masks))
        (ll2, out2), gradient2 = _partial(make, cast(reduced, dtype), ys_kept, jnp.ones((3, T, 2), bool), masked=False)
        for got, want in ((out.mean[:3], out2.mean), (out.cov[:3], out2.cov), (ll[:3], ll2)):
            worst("some present against rows dropped", got, want)
        worst("gradient against the reduced problem's", gradient[:3], gradient2)
        whole = jf.filter(make(jf.models.linear_gaussian(*cast(model, dtype))), jnp.asarray(ys))
        for got, want in ((out.mean[3], whole.mean), (out.cov[3], whole.cov), (out.log_lik[3], whole.log_lik)):
            worst("all present against no mask", got, want)
        figures["none present against prediction"] += float(np.abs(out.log_lik[4]).max()) + without(
            out.status[4], MISSED
        )
    return figures


@row(
    20,
    "delays of 0 … 3 samples with time stamps",
    {"against the filter on data in order": Goal(1e-5, 1e-10)},
    also=["tests/models/test_lags.py", "tests/filters/test_delayed.py::test_pure_delay_is_the_filter_with_time_stamps"],
    slow=(F64,),
)
def r20(dtype, full):
    """Wherever all packets so far have come, the state of the lagged filter is that of the filter in order."""
    model = jf.models.linear_gaussian(*cast([LINEAR[k] for k in ("F", "H", "Q", "R", "m0", "P0")], dtype))
    rng, d, worst = np.random.default_rng(2), 3, 0.0
    zs = rng.normal(size=(T, 2)) + np.linspace(0, 2, T)[:, None]
    delays = rng.integers(0, d + 1, T)
    delays = np.minimum(delays, -np.arange(T) % 6)  # all are there at each sixth step
    received = jf.simulate.deliver(jnp.asarray(zs, dtype), jnp.asarray(delays, jnp.int32), d)
    complete = np.arange(T) % 6 == 0
    lagged = jf.models.with_lags(model, d)
    for make in (jf.kalman, jf.sqrt_kalman) if full else (jf.kalman,):
        out = jf.filter(make(lagged), received.packets, mask=received.arrived)
        want = jf.filter(make(model), jnp.asarray(zs, dtype))
        worst = max(
            worst,
            relative(out.mean[complete, :3], want.mean[complete]),
            relative(out.cov[complete, :3, :3], want.cov[complete]),
            relative(jnp.cumsum(out.log_lik)[complete], jnp.cumsum(want.log_lik)[complete]),
        )
    return {"against the filter on data in order": worst}


MOTIONS = {
    "cv": lambda **options: jf.models.constant_velocity(q=0.3, r=4.0, **options),
    "ca": lambda **options: jf.models.constant_acceleration(q=0.3, r=4.0, **options),
    "cj": lambda **options: jf.models.constant_jerk(q=0.3, r=4.0, **options),
}


@row(
    21,
    "dt = 0, tiny, huge, negative",
    {
        "dt = 0 is no prediction, largest difference": Goal(0, 0),
        "dt = 0, array form, relative difference": Goal(1e-6, 1e-15, "0", "P = L L' of the factor of P rounds"),
        "tiny, huge: not finite and not told": count(),
        "negative: not refused or not told": count(),
    },
    also=["tests/filters/test_kalman.py::test_a_traced_negative_interval_is_flagged_and_the_estimate_stays_finite"],
    slow=(F64,),
)
def r21(dtype, full):
    figures = {
        "dt = 0 is no prediction, largest difference": 0.0, "dt = 0, array form, relative difference": 0.0,
        "tiny, huge: not finite and not told": 0, "negative: not refused or not told": 0,
    }  # fmt: skip
    rng = np.random.default_rng(0)
    for name, order in (("cv", 2), ("ca", 3), ("cj", 4)) if full else (("ca", 3),):
        A = rng.normal(size=(order, order))
        start = {"m0": jnp.asarray(rng.normal(size=order), dtype), "P0": jnp.asarray(A @ A.T, dtype)}
        model = MOTIONS[name](dt=1.0, **start)
        dts = [0.0, float(np.finfo(dtype).tiny), 1e-12, 1e6, 1e12]
        for make in (jf.kalman, jf.sqrt_kalman):
            out = _intervals(make, model, jnp.asarray(dts, dtype))
            P0 = np.asarray(start["P0"])
            if make is jf.kalman:
                figures["dt = 0 is no prediction, largest difference"] = max(
                    figures["dt = 0 is no prediction, largest difference"],
                    float(np.abs(out.prediction.mean[0, 0] - start["m0"]).max()),
                    float(np.abs(np.asarray(out.prediction.cov[0, 0]) - 0.5 * (P0 + P0.T)).max()),
                )
            else:
                figures["dt = 0, array form, relative difference"] = max(
                    figures["dt = 0, array form, relative difference"], relative(out.prediction.cov[0, 0], P0)
                )
            for i in range(1, len(dts)):
                if not_finite((out.mean[i], out.cov[i])) and not having(out.status[i], NONFINITE):
                    figures["tiny, huge: not finite and not told"] += 1
        try:
            jf.filter(jf.kalman(model), jnp.zeros((1, 1), dtype), dt=jnp.asarray([-1.0], dtype))
            figures["negative: not refused or not told"] += 1
        except ValueError:
            pass
        negative = _intervals(jf.kalman, model, jnp.asarray([-1.0, -1e-6, np.nan, -1e6, -np.inf], dtype))
        figures["negative: not refused or not told"] += without(negative.status[:, 0], BOUND)
    return figures


@functools.partial(jax.jit, static_argnames=("make",))
def _intervals(make, model, dts):
    def one(dt):
        ys = jnp.zeros((1, 1), dts.dtype)
        return jf.filter(make(model), ys, dt=dt[None], outputs=jf.everything, form="dense")

    return jax.vmap(one)(dts)


ALPHAS = (1e-3, 1e-2, 0.1, 0.5, 1.0)
_FAR = (
    "f at points α √n σ apart is a difference of values of size 100 to 200: ε |f| / (α √n σ) is lost in any form, "
    "σ = 0.3 here"
)


@functools.partial(jax.jit, static_argnames=("make",))
def _alphas(make, models, ys, alphas):
    def one(model, y, alpha):
        return jf.filter(make(jf.models.linear_gaussian(*model), alpha=alpha), y, form="dense")

    return jax.vmap(jax.vmap(one, (None, None, 0)), (0, 0, None))(models, ys, alphas)


@functools.partial(jax.jit)
def _kalman(models, ys):
    return jax.vmap(lambda m, y: jf.filter(jf.kalman(jf.models.linear_gaussian(*m)), y, form="dense"))(models, ys)


@row(
    22,
    "unscented on a linear model, α = 1e-3 … 1, beside the Kalman filter",
    {
        "error, α ≥ 0.1": Goal(1e-4, 1e-9),
        "error, α < 0.1": Goal(None, 1e-9),
        "α < 0.1 without a warning": Goal(0, None),
        "mean of 100 to 200: error, α ≥ 0.1": Goal(1e-3, 1e-9, "1e-4, 1e-9", _FAR),
        "mean of 100 to 200: error, α < 0.1": Goal(None, 5e-8, "–, 1e-9", _FAR),
    },
    peers="textbook form, mean 100, α = 1e-3: 640 % of the covariance (f32), 1e-12 (f64)",
    also=["tests/filters/test_unscented.py::test_float32_keeps_the_covariance_of_a_linear_map_far_from_the_origin"],
)
def r22(dtype, full):
    near = Linear(*reference.random_model(np.random.default_rng(6), 4, 2))
    models = [near.cast(dtype), near._replace(m0=100 + near.m0).cast(dtype)]
    ys = jnp.asarray(np.stack([problems.draw(model, 12, seed=3) for model in models]), dtype)
    models = cast(problems.stack(models), dtype)
    want = _kalman(models, ys)
    errors, quiet = np.zeros((2, len(ALPHAS))), 0
    for make in (jf.unscented, jf.sqrt_unscented) if full else (jf.unscented,):
        out = _alphas(make, models, ys, jnp.asarray(ALPHAS, dtype))
        for field in ("mean", "cov", "log_lik"):
            for at in np.ndindex(errors.shape):
                errors[at] = max(errors[at], relative(getattr(out, field)[at], getattr(want, field)[at[0]]))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            make(jf.models.linear_gaussian(*near.cast(dtype)), alpha=0.01)
        quiet += not any("alpha" in str(w.message) for w in caught)
    return {
        "error, α ≥ 0.1": errors[0, 2:].max(),
        "error, α < 0.1": errors[0, :2].max(),
        "α < 0.1 without a warning": quiet,
        "mean of 100 to 200: error, α ≥ 0.1": errors[1, 2:].max(),
        "mean of 100 to 200: error, α < 0.1": errors[1, :2].max(),
    }


def two_filter(model: Linear, ys):
    """Smoothed moments by a forward filter and a backward information filter (Fraser and Potter 1969), float64."""
    F, H, Q, R, _, _ = model
    means, covs, _ = reference.kalman(*model, ys)
    n, Ri = len(F), np.linalg.inv(R)
    Y, z = np.zeros((n, n)), np.zeros(n)  # information about x_k in y_{k+1..T}
    out = []
    for k in range(len(ys) - 1, -1, -1):
        P = np.linalg.inv(np.linalg.inv(covs[k]) + Y)
        out.append((P @ (np.linalg.solve(covs[k], means[k]) + z), P))
        Y, z = Y + H.T @ Ri @ H, z + H.T @ Ri @ ys[k]
        J = np.linalg.solve(np.eye(n) + Y @ Q, np.eye(n))  # (I + Y Q)^-1
        Y, z = F.T @ J @ Y @ F, F.T @ J @ z
    return tuple(np.array(x[::-1]) for x in zip(*out, strict=True))


@row(
    28,
    "smoother against a dense joint Gaussian and a two-filter smoother",
    {
        "RTS against dense": Goal(1e-3, 1e-9),
        "RTS against two filters": Goal(1e-3, 1e-9),
        "RTS in parallel against dense": Goal(1e-3, 1e-9),
        "smoothed above filtered, −λmin / λmax": Goal(1e-6, 1e-12, "1e-6"),
        "not symmetric": count(),
    },
    also=["tests/filters/test_kalman.py::test_equals_the_dense_joint_gaussian"],
    slow=(F64,),
)
def r28(dtype, full):
    figures = dict.fromkeys(("RTS against dense", "RTS against two filters", "RTS in parallel against dense",
                             "smoothed above filtered, −λmin / λmax", "not symmetric"), 0.0)  # fmt: skip
    model = Linear(*reference.random_model(np.random.default_rng(5), 3, 2)).cast(dtype)
    ys = (2 * np.random.default_rng(6).normal(size=(20, 2))).astype(dtype)
    exact = Linear(*(x.astype(np.float64) for x in model))
    _, dense, _ = reference.joint_gaussian(*exact, ys)
    two = two_filter(exact, ys.astype(np.float64))
    lg, data = jf.models.linear_gaussian(*cast(model, dtype)), jnp.asarray(ys)
    for make in (jf.kalman, jf.sqrt_kalman, jf.extended, jf.unscented) if full else (jf.kalman,):
        out = jf.filter(make(lg), data, outputs=jf.everything)
        smoothed = jf.rts(out)
        for key, want in (("RTS against dense", dense), ("RTS against two filters", two)):
            figures[key] = max(figures[key], relative(smoothed.mean, want[0]), relative(smoothed.cov, want[1]))
        gap = np.asarray(out.cov, float) - np.asarray(smoothed.cov, float)
        largest = np.linalg.eigvalsh(np.asarray(out.cov, float))[:, -1]
        key = "smoothed above filtered, −λmin / λmax"
        figures[key] = max(figures[key], float((-np.linalg.eigvalsh(gap)[:, 0] / largest).max()))
        figures["not symmetric"] += asymmetric(smoothed.cov)
    smoothed = jf.smooth_parallel(lg, data)
    figures["RTS in parallel against dense"] = max(relative(smoothed.mean, dense[0]), relative(smoothed.cov, dense[1]))
    return figures
