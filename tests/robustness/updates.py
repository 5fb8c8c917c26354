"""R1 to R4, R9, R10: one update of an ill-conditioned covariance, beside rational arithmetic."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from tests.robustness import problems
from tests.robustness.problems import Linear, having, indefiniteness, norm_error, not_finite, without
from tests.robustness.row import F64, Goal, cast, count, row

SINGULAR = jf.Status.SINGULAR


def mixed(model):
    """The array form of the mixed filter without theta."""
    return jf.sqrt_mixed_hinf(model, 0.0)


JOSEPH = {"kalman": jf.kalman, "extended": jf.extended, "unscented": jf.unscented, "cubature": jf.cubature}
ARRAY = {
    "sqrt_kalman": jf.sqrt_kalman, "sqrt_extended": jf.sqrt_extended, "sqrt_unscented": jf.sqrt_unscented,
    "sqrt_cubature": jf.sqrt_cubature, "sqrt_mixed_hinf": mixed,
}  # fmt: skip
SWEEP = 30
EXPONENTS = np.concatenate([np.linspace(0.3, 0.95, SWEEP), [0.5, 2 / 3]])  # of eps; the last two are R1 to R3


@functools.partial(jax.jit, static_argnames=("make", "form"))
def update(make, form, models: Linear, ys):
    """Info of one update for each of several problems; ys (problems, 1, m)."""

    def one(model, y):
        filt = make(jf.models.linear_gaussian(*model))
        return jax.tree.map(lambda x: x[0], jf.filter(filt, y, first_update_only=True, form=form))

    return jax.vmap(one)(models, ys)


def forms(full):
    """``(family, factory, form)``: in the small form one filter of each family."""
    for family, members in (("joseph", JOSEPH), ("array", ARRAY)):
        for make in members.values() if full else list(members.values())[:1]:
            for form in ("dense", "scalar") if full or family == "array" else ("dense",):
                yield family, make, form


@functools.cache
def sweep(dtype, full):
    """Both problems over 30 values and the printed ones: ``{family: [(errors, infos), ..]}`` for each problem."""
    eps = float(np.finfo(dtype).eps)
    dmcr = [problems.dyer_mcreynolds(eps**x, dtype) for x in EXPONENTS]
    bierman = [problems.bierman(eps**x, dtype) for x in EXPONENTS]
    exact = np.array([problems.exact_posterior(p) for p in dmcr + bierman])
    models = cast(problems.stack(dmcr + bierman), dtype)
    ys = jnp.ones((len(exact), 1, 2), dtype)
    K = len(EXPONENTS)
    found = {"dmcr": {"joseph": [], "array": []}, "bierman": {"joseph": [], "array": []}}
    for family, make, form in forms(full):
        out = update(make, form, models, ys)
        for name, part, block in (("dmcr", slice(0, K), 3), ("bierman", slice(K, None), 2)):
            info = jax.tree.map(lambda x, part=part: np.asarray(x)[part], out)
            errors = norm_error(info.cov[:, :block, :block], exact[part][:, :block, :block])
            found[name][family].append((np.where(np.isfinite(errors), errors, np.inf), info))
    return found


def _worst(runs, at):
    return max(float(errors[at]) for errors, _ in runs)


@functools.partial(jax.jit, static_argnames=("make",))
def _slopes(make, models):
    def one(model):
        def log_lik(theta):
            scaled = model._replace(P0=theta * model.P0, R=theta * model.R)
            filt = make(jf.models.linear_gaussian(*scaled))
            return jf.filter(filt, jnp.ones((1, 2), theta.dtype), first_update_only=True, form="dense").log_lik[0]

        return jax.grad(log_lik)(jnp.ones((), model.P0.dtype))

    return jax.vmap(one)(models)


@row(
    1,
    "Dyer and McReynolds, δ = √ε",
    {
        "array forms: error of P": Goal(1e-3, 1e-8),
        "array forms: −λmin / (n ε λmax)": Goal(10, 10),
        "array forms: status not 0": count(),
        "array form: relative error of dℓ/dθ": Goal(1e-2, 1e-6, "1e-2, –"),
        "Joseph forms: singular S not told": count(),
        "Joseph forms: not finite": count(),
    },
    peers="cuthbert 1e-4, 1e-9; filterpy and Stone Soup QR –, 9e-10; dynamax NaN, 0.2; Joseph with inverse raises",
    also=["tests/filters/test_kalman.py::test_square_root_survives_dyer_mcreynolds"],
    group="updates",
)
def r1(dtype, full):
    found, at = sweep(dtype, full)["dmcr"], -2
    delta = float(np.finfo(dtype).eps) ** 0.5
    exact = problems.exact_slope(delta, dtype)
    model = cast(problems.stack([problems.dyer_mcreynolds(delta, dtype)]), dtype)
    return {
        "array forms: error of P": _worst(found["array"], at),
        "array forms: −λmin / (n ε λmax)": max(indefiniteness(info.cov[at]) for _, info in found["array"]),
        "array forms: status not 0": sum(int(info.status[at] != 0) for _, info in found["array"]),
        "array form: relative error of dℓ/dθ": abs(float(_slopes(jf.sqrt_kalman, model)[0]) / exact - 1),
        "Joseph forms: singular S not told": sum(without(info.status[at], SINGULAR) for _, info in found["joseph"]),
        "Joseph forms: not finite": sum(not_finite(info) for _, info in found["joseph"]),
    }


@row(
    2,
    "Dyer and McReynolds, δ = ε^(2/3)",
    {
        "array forms: error of P": Goal(1e-2, 1e-5),
        "array forms: −λmin / (n ε λmax)": Goal(10, 10),
        "array forms: not finite": count(),
    },
    peers="cuthbert 5e-4, 1e-7; filterpy and Stone Soup QR –, 1e-6; Bierman UD 7e-6, 1e-11; dynamax NaN, 0.2",
    group="updates",
)
def r2(dtype, full):
    found, at = sweep(dtype, full)["dmcr"]["array"], -1
    return {
        "array forms: error of P": _worst(found, at),
        "array forms: −λmin / (n ε λmax)": max(indefiniteness(info.cov[at]) for _, info in found),
        "array forms: not finite": sum(not_finite(info) for _, info in found),
    }


@row(
    3,
    "Bierman, e = ε^0.5 and ε^(2/3)",
    {
        "array forms: error of P": Goal(1e-6, 1e-14),
        "Joseph forms: error of P": Goal(1e-4, 1e-10),
    },
    peers="cuthbert 1e-7, 2e-16; filterpy Joseph –, 2e-11; filterpy and Stone Soup QR –, 5e-6; dynamax 1e2, 2e5 NEG",
    group="updates",
)
def r3(dtype, full):
    found = sweep(dtype, full)["bierman"]
    return {
        "array forms: error of P": max(_worst(found["array"], at) for at in (-2, -1)),
        "Joseph forms: error of P": max(_worst(found["joseph"], at) for at in (-2, -1)),
    }


@row(
    4,
    "both over 30 values of δ and e from ε^0.3 to ε^0.95 (figure)",
    {
        "Dyer and McReynolds, array forms: error / (ε / δ)": Goal(4, 4, "monotone"),
        "Bierman, array forms: error / ε": Goal(16, 16, "monotone"),
        "Bierman, array forms: largest e / ε at which a variance is lost": Goal(1, 1),
        "not finite": count(),
    },
    peers="no NaN: cuthbert; others NaN or raise from δ = √ε on",
    group="updates",
)
def r4(dtype, full):
    found = sweep(dtype, full)
    eps = float(np.finfo(dtype).eps)
    grows = eps ** (1 - EXPONENTS)  # a bound that rises as δ falls
    e = eps**EXPONENTS
    array = found["bierman"]["array"]
    return {
        "Dyer and McReynolds, array forms: error / (ε / δ)": max(
            float((errors / grows).max()) for errors, _ in found["dmcr"]["array"]
        ),
        "Bierman, array forms: error / ε": max(float(errors.max()) for errors, _ in array) / eps,
        "Bierman, array forms: largest e / ε at which a variance is lost": max(
            float(np.where(errors > 0.1, e, 0.0).max()) / eps for errors, _ in array
        ),
        "not finite": sum(not_finite(info) for p in found.values() for runs in p.values() for _, info in runs),
    }


@row(
    9,
    "two equal sensors with R = 0",
    {"error against one sensor": Goal(1e-6, 1e-6), "singular S not told": count(), "not finite": count()},
    peers="Cholesky forms NaN; statsmodels' univariate form skips the second",
    also=["tests/filters/test_kalman.py::test_singular_innovation_uses_one_of_two_equal_sensors"],
    slow=(F64,),
)
def r9(dtype, full):
    """The second sensor is the first again; with one sensor the other is masked, so that one shape serves."""
    rng = np.random.default_rng(0)
    models, ys = [], []
    for _ in range(8):
        A, h = rng.normal(size=(3, 3)), rng.normal(size=3)
        P0 = A @ A.T + 0.1 * np.eye(3)
        models.append(Linear(np.eye(3), np.stack([h, h]), np.zeros((3, 3)), np.zeros((2, 2)), np.zeros(3), P0))
        ys.append(np.full((1, 2), rng.normal()))
    models, ys = problems.stack(models), np.array(ys)
    # One sensor, in 80 bits.
    exact = [problems.filter_80_bit(Linear(*m).cast(dtype), y.astype(dtype)[:, :1], [[True, False]])
             for m, y in zip(zip(*models, strict=True), ys, strict=True)]  # fmt: skip
    means, covs = (np.stack([e[i][0] for e in exact]).astype(float) for i in (0, 1))
    figures = {"error against one sensor": 0.0, "singular S not told": 0, "not finite": 0}
    for _, make, form in forms(full):
        out = update(make, form, cast(models, dtype), jnp.asarray(ys, dtype))
        error = max(float(norm_error(out.cov, covs).max()), problems.relative(out.mean, means))
        figures["error against one sensor"] = max(figures["error against one sensor"], error)
        figures["singular S not told"] += without(out.status, SINGULAR)
        figures["not finite"] += not_finite(out)
    return figures


@row(
    10,
    "Hilbert matrix as P, n = 4 … 12, one sensor of small noise",
    {
        "error of the gain / (√cond ε), array forms": Goal(10, 10),
        "error of the gain / (√cond ε), Joseph forms": Goal(10, 10, slow=True),
        "−λmin / (n ε λmax)": Goal(10, 10),
        "false alarms": count(),
    },
    slow=(F64,),
)
def r10(dtype, full):
    """All in n = 12: what is left over is an independent identity that the sensor does not see."""
    n, rng = 12, np.random.default_rng(3)
    models, cond = [], []
    for k in range(4, n + 1):
        P0, h = np.eye(n), np.zeros(n)
        P0[:k, :k] = 1 / (np.arange(k)[:, None] + np.arange(k)[None, :] + 1)
        h[:k] = rng.normal(size=k)
        models.append(Linear(np.eye(n), h[None], np.zeros((n, n)), np.full((1, 1), 1e-6), np.zeros(n), P0).cast(dtype))
        cond.append(np.linalg.cond(P0[:k, :k]))
    exact = np.array([problems.exact_gain(model) for model in models])
    eps = float(np.finfo(dtype).eps)
    figures = {"false alarms": 0, "−λmin / (n ε λmax)": -np.inf}
    for family, make, form in forms(full):
        if form == "scalar" or (not full and family == "joseph"):
            continue  # twelve states unrolled; small systems are what that form is for
        out = update(make, form, cast(problems.stack(models), dtype), jnp.ones((len(models), 1, 1), dtype))
        errors = np.linalg.norm(np.asarray(out.mean, float) - exact, axis=1) / np.linalg.norm(exact, axis=1)
        key = f"error of the gain / (√cond ε), {'array' if family == 'array' else 'Joseph'} forms"
        figures[key] = max(figures.get(key, 0.0), float((errors / (np.sqrt(cond) * eps)).max()))
        figures["−λmin / (n ε λmax)"] = max(figures["−λmin / (n ε λmax)"], indefiniteness(out.cov))
        figures["false alarms"] += having(out.status, SINGULAR)
    return figures
