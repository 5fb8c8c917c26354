"""R16, R17, R23 to R27, R29, R30: what every filter promises, and what single families do."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from jaxfilt.wrappers.noise import Q_BOUNDS, R_BOUNDS
from tests import test_properties as properties
from tests.examples import LINEAR
from tests.filters import test_hinf as hinf
from tests.registry import REGISTRY, params, series
from tests.robustness import problems
from tests.robustness.problems import Linear, asymmetric, having, indefiniteness, not_finite, relative, without
from tests.robustness.row import F32, F64, Goal, cast, count, row

NONFINITE, BOUND = jf.Status.NONFINITE, jf.Status.BOUND
NAMES = sorted(REGISTRY)


@row(
    16,
    "covariances of every registered filter",
    {"not symmetric to the bit": count(), "−λmin / (n ε λmax)": Goal(10, 10), "not finite": count()},
    peers="(I − KH) P fails; Joseph holds if symmetrised",
    also=["tests/test_properties.py::test_shapes_dtypes_and_covariances"],
    slow=(F32, F64),
)
def r16(dtype, full):
    figures = {"not symmetric to the bit": 0, "−λmin / (n ε λmax)": -np.inf, "not finite": 0}
    for name in NAMES if full else properties.CORE:
        out = properties.batch(name, dtype)
        figures["not finite"] += not_finite(out)
        for cov in (out.cov, out.innovation_cov, None if out.prediction is None else out.prediction.cov):
            if cov is not None:
                figures["not symmetric to the bit"] += asymmetric(cov)
                figures["−λmin / (n ε λmax)"] = max(figures["−λmin / (n ε λmax)"], indefiniteness(cov))
    return figures


@row(
    17,
    "NaN and infinity in y that no mask covers, every registered filter",
    {"not told": count(), "told where nothing was": count(), "not finite": count()},
    peers="dynamax, filterpy: NaN from there on",
    also=["tests/test_properties.py::test_a_bad_value_is_flagged_and_other_runs_are_untouched"],
    slow=(F32, F64),
)
def r17(dtype, full):
    figures = {"not told": 0, "told where nothing was": 0, "not finite": 0}
    for name in NAMES if full else properties.CORE:
        ys = series(REGISTRY[name], dtype, runs=3).at[1, 4, 0].set(jnp.nan).at[1, 7, 0].set(jnp.inf)
        out = properties.batch(name, dtype, ys)
        told = (np.asarray(out.status) & int(NONFINITE)) != 0
        figures["not told"] += int((~told[1, [4, 7]]).sum())
        figures["told where nothing was"] += int(told.sum() - told[1, [4, 7]].sum())
        figures["not finite"] += not_finite(out)
    return figures


# R23: a target that crosses in front of a range-bearing sensor, the scene turned by an angle.
ANGLES = np.linspace(-np.pi, np.pi, 9)
_ROOT = (
    "turned axes give P another Cholesky root, and sigma points along other directions: their fourth-order terms differ"
)


@functools.partial(jax.jit, static_argnames=("make",))
def _flights(make, angles, xs, ys, P0, R):
    """Position errors (angles, runs, T) with the whole scene turned; xs (runs, T, 4), ys (runs, T, 2) unturned."""
    dtype = ys.dtype

    def one(angle, x, y):
        turn = jnp.stack([jnp.stack([jnp.cos(angle), -jnp.sin(angle)]), jnp.stack([jnp.sin(angle), jnp.cos(angle)])])
        G = jnp.kron(jnp.eye(2, dtype=dtype), turn)
        m0 = G @ jnp.asarray([6.0, -4.0, -0.5, 0.9], dtype)
        cov = G @ P0 @ G.T
        model = jf.models.constant_velocity(dt=1.0, q=0.05, r=1.0, m0=m0, P0=0.5 * (cov + cov.T))
        sensor = jf.models.sensors.range_bearing(R, observer=turn @ jnp.asarray([-3.0, 2.0], dtype))
        bearing = jf.models.sensors.wrap(y[:, 1] + angle)
        out = jf.filter(make(jf.models.with_sensor(model, sensor)), jnp.stack([y[:, 0], bearing], axis=1))
        return jnp.linalg.norm(out.mean[:, :2] - (x @ G.T)[:, :2], axis=1)

    return jax.vmap(jax.vmap(one, (None, 0, 0)), (0, None, None))(angles, xs, ys)


def _crossing(runs=32, steps=12):
    rng = np.random.default_rng(11)
    motion = problems.velocity(q=0.05, dt=1.0)
    F, Q = np.kron(motion.F, np.eye(2)), np.kron(motion.Q, np.eye(2))
    P0, R = np.diag([4.0, 2.0, 0.3, 0.5]), np.diag([0.2, 0.003])
    x = np.array([6.0, -4.0, -0.5, 0.9]) + rng.normal(size=(runs, 4)) @ np.sqrt(P0)
    xs, ys = [], []
    for _ in range(steps):
        x = x @ F.T + rng.normal(size=(runs, 4)) @ np.linalg.cholesky(Q).T
        seen, noise = x[:, :2] - [-3.0, 2.0], rng.normal(size=(runs, 2)) @ np.sqrt(R)
        xs.append(x)
        ys.append(np.stack([np.hypot(*seen.T), np.arctan2(seen[:, 1], seen[:, 0])], axis=1) + noise)
    return np.stack(xs, 1), np.stack(ys, 1), P0, R


@functools.partial(jax.jit, static_argnames=("make",))
def _over_the_sensor(make, model, ys):
    def total(model):
        out = jf.filter(
            make(jf.models.with_sensor(model, jf.models.sensors.range_bearing(0.1 * jnp.eye(2, dtype=ys.dtype)))), ys
        )
        return out.log_lik.sum() + out.mean.sum(), out

    return jax.value_and_grad(total, has_aux=True)(model)


@row(
    23,
    "bearings over ±π: the scene turned by 9 angles, 32 runs; a target at the sensor (range 0)",
    {
        "extended: relative change of the RMSE": Goal(1e-3, 1e-3),
        "sigma points: relative change of the RMSE": Goal(2e-2, 2e-2, "1e-3", _ROOT),
        "range 0: not finite, gradients too": count(),
    },
    also=[
        "tests/filters/test_unscented.py::test_turning_the_scene_changes_nothing",
        "tests/models/test_sensors.py::test_derivatives_are_finite_at_the_observer",
    ],
    slow=(F32, F64),
)
def r23(dtype, full):
    data = [jnp.asarray(a, dtype) for a in (ANGLES, *_crossing())]
    filters = {"extended": [jf.extended], "sigma points": [jf.unscented]}
    if full:
        filters = {"extended": [jf.extended, jf.sqrt_extended],
                   "sigma points": [jf.unscented, jf.sqrt_unscented, jf.cubature, jf.sqrt_cubature]}  # fmt: skip
    figures = {}
    for family, makes in filters.items():
        for make in makes:
            squares = np.square(np.asarray(_flights(make, *data), np.float64))
            rmse = np.sqrt(squares.mean(axis=(1, 2)))
            key = f"{family}: relative change of the RMSE"
            figures[key] = max(figures.get(key, 0.0), float(np.abs(rmse / rmse[4] - 1).max()))
    bad = 0
    m0, P0 = jnp.zeros(4, dtype), jnp.eye(4, dtype=dtype)
    model = jf.models.constant_velocity(dt=1.0, q=0.1, r=1.0, m0=m0, P0=P0)
    for make in (jf.extended, jf.unscented) if full else (jf.extended,):
        bad += not_finite(_over_the_sensor(make, model, jnp.zeros((6, 2), dtype)))
    return {**figures, "range 0: not finite, gradients too": bad}


@row(
    24,
    "mixed Kalman/H∞: θ → 0, θ below and above its bound, the worst case over 400 steps",
    {
        "θ = 1e-4 θmax against the Kalman filter": Goal(1e-6, 1e-6),
        "infeasible and not told": count(),
        "not finite": count(),
        "worst case × θ² at 0.5, 0.9, 0.99 θmax": Goal(None, 1.0),
        "shortfall of the worst case from the bound at 0.99 θmax": Goal(None, 0.05),
        "bound at 0.9 θmax over the Kalman filter's worst case": Goal(None, 1.0),
    },
    also=["tests/filters/test_hinf.py::test_worst_case_gain_is_bounded_and_nearly_reached"],
    slow=(F64,),
)
def r24(dtype, full):
    """The worst case is a property of the gains, found by singular values in float64."""
    model = hinf.axis(0.8)
    largest = jf.theta_max(model, steps=400)
    single = jax.tree.map(lambda x: jnp.asarray(x, dtype), model)
    ys = hinf.walk(60).astype(dtype)
    near = jf.filter(jf.mixed_hinf(single, dtype(1e-4 * largest)), ys)
    plain = jf.filter(jf.kalman(single), ys)
    beyond = jf.filter(jf.mixed_hinf(single, dtype(1.1 * largest)), ys)
    figures = {
        "θ = 1e-4 θmax against the Kalman filter": max(
            relative(near.mean, plain.mean, axes=0), relative(near.cov, plain.cov, axes=0)
        ),
        "infeasible and not told": int(not having(beyond.status, BOUND)),
        "not finite": not_finite(beyond),
    }  # fmt: skip
    if dtype == np.float64:
        shares = []
        for part in (0.5, 0.9, 0.99):
            theta = part * largest
            shares.append(float(hinf.worst_case(model, jf.mixed_hinf(model, theta), theta) * theta**2))
        kalman = float(hinf.worst_case(model, jf.kalman(model)) * (0.9 * largest) ** 2)
        figures |= {
            "worst case × θ² at 0.5, 0.9, 0.99 θmax": max(shares),
            "shortfall of the worst case from the bound at 0.99 θmax": 1 - shares[-1],
            "bound at 0.9 θmax over the Kalman filter's worst case": 1 / kalman,
        }
    return figures


@functools.partial(jax.jit)
def _two_modes(model, scale, transition, ys):
    """An IMM of a model and the same with ``scale`` times R; the first alone."""
    other = model._replace(R=scale * model.R)
    first, second = (jf.kalman(jf.models.linear_gaussian(*m)) for m in (model, other))
    out = jf.filter(jf.imm((first, second), transition), ys)
    return out, jf.filter(first, ys)


@row(
    25,
    "IMM: equal models; a mode whose probability goes to 0 for 1e5 steps (1e4 by default); underflow",
    {
        "equal models against one filter": Goal(1e-6, 1e-6),
        "sum of probabilities less 1": Goal(1e-6, 1e-6),
        "not finite": count(),
        "underflow: sum of probabilities less 1": Goal(1e-6, 1e-6),
    },
    peers="probabilities as numbers: log 0, NaN",
    also=[
        "tests/filters/test_imm.py::test_underflowing_likelihoods",
        "tests/filters/test_imm.py::test_long_runs_with_a_dead_mode",
    ],
)
def r25(dtype, full):
    steps = 100_000 if full else 10_000
    model = cast(Linear(*(LINEAR[k] for k in ("F", "H", "Q", "R", "m0", "P0"))), dtype)
    Pi, eye = jnp.asarray([[0.95, 0.05], [0.1, 0.9]], dtype), jnp.eye(2, dtype=dtype)
    ys = np.random.default_rng(0).normal(size=(steps, 2))
    equal, one = _two_modes(model, dtype(1), Pi, jnp.asarray(ys, dtype))
    dead, _ = _two_modes(model, dtype(1e4), eye, jnp.asarray(ys, dtype))
    far = ys.copy()
    far[3:], far[6] = 1e3, 1e5
    under, _ = _two_modes(model, dtype(1e4), Pi, jnp.asarray(far, dtype))
    mu = [np.asarray(out.extra["mode_probabilities"], np.float64) for out in (equal, dead, under)]
    return {
        "equal models against one filter": max(
            relative(getattr(equal, field), getattr(one, field)) for field in ("mean", "cov", "log_lik")
        ),
        "sum of probabilities less 1": max(float(np.abs(m.sum(axis=1) - 1).max()) for m in mu[:2]),
        "not finite": not_finite((equal, dead, under)),
        "underflow: sum of probabilities less 1": float(np.abs(mu[2].sum(axis=1) - 1).max()),
    }


@row(
    26,
    "fixed gains: Kalata's against the Kalman filter in its steady state; tracking index there and back",
    {
        "α-β against the steady Kalman filter": Goal(1e-5, 1e-5),
        "steady_state against the steady Kalman filter": Goal(1e-5, 1e-5),
        "index there and back, 1e-3 … 10": Goal(1e-5, 1e-5),
    },
    also=["tests/filters/test_alpha_beta.py", "tests/filters/test_gains.py", "tests/filters/test_steady_state.py"],
)
def r26(dtype, full):
    from jaxfilt.filters import gains

    q, r, dt = 0.1, 25.0, 0.5
    model = problems.velocity(q=q, r=r, dt=dt, noise="piecewise")
    ys = jnp.asarray(problems.draw(model._replace(P0=np.eye(2)), 400, seed=0), dtype)
    lg = jf.models.linear_gaussian(*cast(model, dtype))
    kalman = jf.filter(jf.kalman(lg), ys)
    alpha, beta = gains.kalata(gains.tracking_index(dtype(q), dtype(r), dt=dtype(dt)))
    fixed = jf.filter(jf.alpha_beta(alpha, beta, dt=dtype(dt), m0=cast(model.m0, dtype)), ys)
    steady = jf.filter(jf.steady_state(lg), ys)
    index = np.logspace(-3, 1, 33)
    a, b = (np.asarray(x, np.float64) for x in gains.kalata(jnp.asarray(index, dtype)))
    return {
        "α-β against the steady Kalman filter": relative(fixed.mean[-50:], kalman.mean[-50:]),
        "steady_state against the steady Kalman filter": relative(steady.mean[-50:], kalman.mean[-50:]),
        "index there and back, 1e-3 … 10": float(np.abs(b / np.sqrt(1 - a) / index - 1).max()),
    }


@functools.partial(jax.jit, static_argnames=("count",))
def _particles(count, model, ys, keys):
    filt = jf.particle(jf.models.linear_gaussian(*model), count)
    return jax.vmap(lambda key: jf.filter(filt, ys, key=key))(keys)


@row(
    27,
    "particle filter: all weights underflow, one particle dominates, N = 1; mean likelihood, 400 runs of 300",
    {
        "not finite": count(),
        "no finite likelihood and not told": count(),
        "log of the mean likelihood ratio to the Kalman filter [s.e.]": Goal(3, 3),
    },
    peers="weights as numbers: NaN",
    also=["tests/filters/test_particle.py::test_survives_underflow_domination_and_a_single_particle"],
    slow=(F64,),
)
def r27(dtype, full):
    model = cast(Linear(*(LINEAR[k] for k in ("F", "H", "Q", "R", "m0", "P0"))), dtype)
    ys = np.random.default_rng(7).normal(size=(10, 2)) + np.linspace(0, 2, 10)[:, None]
    exact = jf.filter(jf.kalman(jf.models.linear_gaussian(*model)), jnp.asarray(ys, dtype))
    keys = jax.random.split(jax.random.key(0), 400)
    usual = _particles(300, model, jnp.asarray(ys, dtype), keys)
    ratio = np.exp(np.asarray(usual.log_lik, np.float64).sum(axis=1) - float(exact.log_lik.sum()))
    far = ys.copy()
    far[4], far[6] = 1e4, float(np.finfo(dtype).max) / 8
    hard = [_particles(300, model, jnp.asarray(far, dtype), keys), _particles(1, model, jnp.asarray(far, dtype), keys)]
    return {
        "not finite": sum(not_finite((out.mean, out.cov, out.log_lik, out.extra)) for out in [usual, *hard]),
        "no finite likelihood and not told": sum(without(out.status[:, 6], NONFINITE) for out in hard),
        "log of the mean likelihood ratio to the Kalman filter [s.e.]": abs(
            (ratio.mean() - 1) / (ratio.std(ddof=1) / np.sqrt(len(ratio)))
        ),
    }


# R29: how many runs for each filter at full size; a smaller number by default.
RUNS = {
    "kalman": 100_000, "sqrt_kalman": 100_000, "extended": 100_000, "alpha_beta": 100_000, "steady_state": 100_000,
    "imm": 10_000, "unscented": 10_000, "particle": 100,
}  # fmt: skip
SMALL = {"kalman": 2000, "alpha_beta": 2000, "imm": 500}
BAD = {"NaN": np.nan, "infinity": np.inf, "huge": None}


def _particle_1000(p):
    return jf.particle(jf.models.linear_gaussian(**p["model"]), 1000, threshold=p["threshold"])


def one_run(filt, y, key):
    """Everything of one run; without a history, so that 1e5 of them fit."""
    return jf.filter(filt, y, key=key, keep="sum")


@functools.partial(jax.jit, static_argnames=("keyed",))
def _vmapped(filt, ys, keys, keyed):
    return jax.vmap(one_run, (None, 0, 0 if keyed else None))(filt, ys, keys)


def _batched(filt, ys, keys, axis):
    return jf.batch(one_run, (None, 0, axis))(filt, ys, keys)


@row(
    29,
    "one bad run (NaN, infinity, huge) among 1e5 (Kalman family, fixed gains), 1e4 (IMM, UKF), 100 of 1000 particles",
    {
        "jax.vmap: other runs changed in a bit": count(),
        "jf.batch: other runs changed in a bit": count(),
        "not told": count(),
    },
    peers="spreads where anything is shared over the batch",
    also=["tests/test_properties.py::test_a_bad_value_is_flagged_and_other_runs_are_untouched"],
    slow=(F64,),
)
def r29(dtype, full):
    figures = {"jax.vmap: other runs changed in a bit": 0, "jf.batch: other runs changed in a bit": 0, "not told": 0}
    for name, runs in (RUNS if full else SMALL).items():
        example = REGISTRY[name]
        make = _particle_1000 if name == "particle" else example.make
        filt = make(params(example, dtype))
        keys = jax.random.split(jax.random.key(0), runs) if "key" in example.options else None
        ys, at = series(example, dtype, runs=runs), runs // 3
        others = np.arange(runs) != at
        axis = None if keys is None else 0
        ways = {
            "jax.vmap": functools.partial(_vmapped, filt, keys=keys, keyed=axis == 0),
            "jf.batch": functools.partial(_batched, filt, keys=keys, axis=axis),
        }
        for way, run in ways.items():
            clean = jax.tree.map(np.asarray, run(ys))
            for what, value in BAD.items():
                value = float(np.finfo(dtype).max) / 4 if value is None else value
                dirty = jax.tree.map(np.asarray, run(ys.at[at, 3:6].set(value)))
                pairs = zip(jax.tree.leaves(clean), jax.tree.leaves(dirty), strict=True)
                changed = sum((a[others] != b[others]).reshape(others.sum(), -1).any(axis=1) for a, b in pairs)
                figures[f"{way}: other runs changed in a bit"] += int((np.asarray(changed) > 0).sum())
                broken = not_finite(jax.tree.map(lambda x, at=at: x[at], dirty))
                if (what != "huge" or broken) and not having(dirty.status[at], NONFINITE):
                    figures["not told"] += 1
    return figures


def _fuzzy_noise(filt, dtype):
    return jf.fuzzy_noise(filt, jf.fuzzy_noise_parameters(np.array([3.0, 4.0]), dtype=dtype))


ADAPTIVE = {
    "sage_husa": lambda filt, dtype: jf.sage_husa(filt),
    "covariance_matching": lambda filt, dtype: jf.covariance_matching(filt),
    "fuzzy_noise": _fuzzy_noise,
}


@functools.partial(jax.jit, static_argnames=("name",))
def _adapted(name, model, ys):
    def one(y):
        return jf.filter(ADAPTIVE[name](jf.kalman(jf.models.linear_gaussian(*model)), y.dtype), y)

    return jax.vmap(one)(ys)


@row(
    30,
    "adapted R: innovations of exactly 0 for 400 steps, bursts of 1e3 σ, both in turn",
    {
        "R not PSD": count(),
        "scale outside its stated bounds": count(),
        "not finite": count(),
        "bound reached and not told": count(),
    },
    peers="Sage and Husa's difference: negative R",
    also=["tests/wrappers/test_noise.py::test_covariances_and_scales_stay_in_bounds_under_bursts"],
    slow=(F64,),
)
def r30(dtype, full):
    model = cast(Linear(*(LINEAR[k] for k in ("F", "H", "Q", "R", "P0", "P0")))._replace(m0=np.zeros(3)), dtype)
    rng = np.random.default_rng(4)
    bursts = 1e3 * rng.normal(size=(400, 2))
    ys = np.stack([np.zeros((400, 2)), bursts, np.where((np.arange(400) // 50 % 2 == 1)[:, None], bursts, 0.0)])
    figures = {"R not PSD": 0, "scale outside its stated bounds": 0, "not finite": 0, "bound reached and not told": 0}
    for name in ADAPTIVE if full else ("sage_husa", "fuzzy_noise"):
        out = _adapted(name, model, jnp.asarray(ys, dtype))
        figures["not finite"] += not_finite(out)
        figures["R not PSD"] += int(not np.linalg.eigvalsh(np.asarray(out.noise_cov, np.float64)).min() > 0)
        for key, (low, high) in (("r_scale", R_BOUNDS), ("q_scale", Q_BOUNDS)):
            if key in out.extra:
                scale = np.asarray(out.extra[key], np.float64)
                slack = 1 + 4 * float(np.finfo(dtype).eps)  # the bounds themselves are rounded to the precision
                figures["scale outside its stated bounds"] += int(
                    ((scale < low / slack) | (scale > high * slack)).sum()
                )
                at = ((scale <= low * slack) | (scale >= high / slack)).reshape(*scale.shape[:2], -1).any(axis=2)
                told = (np.asarray(out.status) & int(BOUND)) != 0
                # Reached in a run: told in it at least once (an estimate may touch its bound without being cut).
                figures["bound reached and not told"] += int((at.any(axis=1) & ~told.any(axis=1)).sum())
    return figures
