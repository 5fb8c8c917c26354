"""Wrappers that adapt noise covariances: the printed fuzzy law, references, what they learn, what they cost, bursts."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt.models.linear import value

MODEL = jf.models.constant_velocity(
    dt=1.0, q=0.05, r=np.array([1.0, 2.0]), m0=np.zeros(4), P0=np.diag([1.0, 2.0, 0.5, 0.5])
)
F, Q, H, R = (np.asarray(value(x, None, None)) for x in (MODEL.F, MODEL.Q, MODEL.H, MODEL.R))
BOUND, MISSED, GATED, NONFINITE = (int(jf.Status[name]) for name in ("BOUND", "MISSED", "GATED", "NONFINITE"))
RUNS, T = 64, 300
SYSTEM = jf.fuzzy.mamdani([8.0, 10.0])
SMOOTH = jf.fuzzy_noise_parameters([8.0, 10.0])
# A head that lets R grow with the innovations, as tuning finds it.
ROBUST = SMOOTH._replace(log_alpha_r=jnp.array([0.3, -0.5, -2.0, -3.5]), log_alpha_q=jnp.zeros(4))
# Output always exactly 20: the strength of a symmetric triangle does not move its centroid.
CONSTANT = {"rules": np.zeros((4, 4), int), "outputs": [[0.0, 20.0, 40.0]]}


def simulate(r=1.0, q=1.0, runs=RUNS, steps=T, seed=0):
    """States and measurements of the model, R multiplied by r (scalar, or (T,) or (T, 2)) and Q by q."""
    rng = np.random.default_rng(seed)
    r = np.broadcast_to(np.reshape(r, (-1, 1)) if np.ndim(r) < 2 else r, (steps, 2))
    x, L = rng.multivariate_normal(np.zeros(4), np.asarray(MODEL.P0), size=runs), np.linalg.cholesky(q * Q)
    states, ys = [], []
    for k in range(steps):
        x = x @ F.T + rng.normal(size=(runs, 4)) @ L.T
        states.append(x)
        ys.append(x[:, :2] + rng.normal(size=(runs, 2)) * np.sqrt(np.diag(R) * r[k]))
    return np.stack(states, axis=1), jnp.asarray(np.stack(ys, axis=1))


def _outputs(state, info):
    del state
    return info.mean, info.cov, info.status, info.extra, info.innovation_cov


@jax.jit
def run(filt, ys):
    return jax.vmap(lambda y: jf.filter(filt, y, outputs=_outputs))(ys)


def position_rmse(mean, states, start=100):
    return float(np.sqrt(np.mean((np.asarray(mean) - states)[:, start:, :2] ** 2)))


def has(status, bit):
    return (np.asarray(status) & bit) != 0


ADAPTIVE = {
    "fuzzy_scaled": lambda filt: jf.fuzzy_scaled(filt, SYSTEM),
    "fuzzy_noise": lambda filt: jf.fuzzy_noise(filt, ROBUST),
    "sage_husa": lambda filt: jf.sage_husa(filt),
    "sage_husa_q": lambda filt: jf.sage_husa(filt, scale="q"),
    "covariance_matching": lambda filt: jf.covariance_matching(filt),
    "covariance_matching_q": lambda filt: jf.covariance_matching(filt, scale="q"),
}


# The published law


def balloon(name, P0_factor=1.0):
    """Three axes of the balloon at T = 0.8 s (specification, section 2.1), in km; ``name="x"``: its first axis."""
    dt = 0.8
    one = np.array([[1.0, dt, dt * dt / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    qx, qz = np.array([25e-6, 1e-8, 1e-10]), np.array([6.25e-6, 25e-10, 25e-12])
    px, pz = np.array([1e-4, 4e-6, 7e-9]), np.array([1e-4, 1e-6, 2e-9])
    axes = 1 if name == "x" else 3
    Q, P0 = (np.diag(np.concatenate(parts)[: 3 * axes]) for parts in ((qx, qx, qz), (px, px, pz)))
    eye = np.eye(axes)
    return jf.models.linear_gaussian(
        np.kron(eye, one), np.kron(eye, np.eye(1, 3)), Q, 1e-4 * eye, np.zeros(3 * axes), P0_factor * P0
    )


def drifting(model, runs, steps, seed):
    rng = np.random.default_rng(seed)
    F, H, Q, P0 = (np.asarray(x) for x in (model.F, model.H, model.Q, model.P0))
    x, states, ys = rng.normal(size=(runs, len(F))) * np.sqrt(np.diag(P0)), [], []
    for _ in range(steps):
        x = x @ F.T + rng.normal(size=x.shape) * np.sqrt(np.diag(Q))
        states.append(x)
        ys.append(x @ H.T + 0.01 * rng.normal(size=(runs, len(H))))
    return np.stack(states, axis=1), jnp.asarray(np.stack(ys, axis=1))


def test_read_as_percent_the_law_leaves_the_filter_infeasible_and_the_floor_prevents_it():
    model = balloon("xyz")
    system = jf.fuzzy.mamdani([40.0, 25.0, 23.0])
    theta, limit = 0.5 * 84.32797, jf.theta_max(model, steps=400)
    floor = (theta / (0.99 * limit)) ** 2
    _, ys = drifting(model, 12, 200, 21)
    make = partial(jf.fuzzy_scaled, jf.mixed_hinf(model, theta), system, unit=1000.0)
    for options, infeasible in (
        ({"reference": 100.0}, True),
        ({"reference": 100.0, "floor": floor}, False),
        ({}, False),  # as printed, alpha never falls below 11
    ):
        _, _, status, extra, _ = run(make(**{"floor": 1e-6, **options}), ys)
        assert (has(status, BOUND).any(axis=1) == infeasible).all()
        assert np.asarray(extra["floored"]).any() == ("floor" in options)
        assert (np.asarray(extra["margin"]) > 0).all() == (not infeasible)
        alpha = np.asarray(extra["alpha"])
        assert alpha.min() >= 100 / 9 - 1e-4
        assert alpha.max() <= 800 / 9 + 1e-4
        assert not np.asarray(extra["lowest"]).all(axis=1).any()
    # Kilometers taken for meters: every input is in its lowest set, and nothing adapts.
    wrong = run(make(unit=1.0, floor=1e-6), ys)[3]
    assert np.asarray(wrong["lowest"]).all()
    assert np.ptp(np.asarray(wrong["alpha"])) == 0


@pytest.mark.parametrize("stationary", [False, True], ids=["recursive", "stationary"])
def test_a_constant_alpha_is_another_theta(stationary):
    """The mixed filter at (theta / sqrt(alpha), alpha P0) with the nominal Q and R has the same gains."""
    alpha, theta = 20.0, 60.0
    system = jf.fuzzy.mamdani(40.0, rules=[0, 0, 0, 0], outputs=CONSTANT["outputs"])
    _, ys = drifting(balloon("x"), 1, 60, 3)
    adapted = jf.fuzzy_scaled(jf.mixed_hinf(balloon("x"), theta, stationary=stationary), system, unit=1000.0)
    out = jf.filter(adapted, ys[0])
    np.testing.assert_allclose(out.extra["alpha"], alpha, rtol=1e-13)
    plain = jf.filter(jf.mixed_hinf(balloon("x", alpha), theta / np.sqrt(alpha), stationary=stationary), ys[0])
    size = np.sqrt(np.asarray(plain.cov).diagonal(axis1=1, axis2=2))
    gains = [
        np.einsum("tab,cb,tcd->tad", np.asarray(o.cov), np.eye(1, 3), np.linalg.inv(np.asarray(o.noise_cov)))
        for o in (out, plain)
    ]
    scale = np.abs(gains[1]).max(axis=0)
    np.testing.assert_allclose(gains[0] / scale, gains[1] / scale, rtol=0, atol=1e-10)
    np.testing.assert_allclose(out.mean / size, plain.mean / size, rtol=0, atol=1e-8)
    if not stationary:
        np.testing.assert_allclose(alpha * np.asarray(out.cov), plain.cov, rtol=1e-10, atol=1e-18)


def test_without_theta_a_constant_alpha_does_nothing_in_the_long_run_and_the_law_nearly_nothing():
    """Specification, section 8 item 9: the fuzzy stationary filter is within 2 % of the Kalman filter."""
    model = balloon("x")
    system = jf.fuzzy.mamdani(40.0)
    states, ys = drifting(model, 32, 300, 22)
    # The bound is near: theta = 0.995 theta_max.
    mixed = jf.mixed_hinf(model, 0.995 * 84.32797, stationary=True)
    errors = [
        np.mean((np.asarray(run(filt, ys)[0]) - states)[:, 50:, 0] ** 2)
        for filt in (jf.kalman(model), jf.fuzzy_scaled(mixed, system, unit=1000.0), mixed)
    ]
    assert abs(errors[1] / errors[0] - 1) < 0.02
    assert errors[2] / errors[0] > 1.5


def law(ys, mask, *, r_exponent, q_exponent, difference):
    """The law around a Kalman filter, written apart: in step k the alpha of y_k, then R, then the next Q."""
    infer = jax.jit(partial(jf.fuzzy.infer, SYSTEM))
    mean, P = np.zeros(4), np.asarray(MODEL.P0)
    inputs, last = np.zeros(2), [None, None]
    alpha = float(infer(jnp.zeros(2)).value)
    means, alphas = [], []
    for y, keep in zip(np.asarray(ys), mask, strict=True):
        mean, P = F @ mean, F @ P @ F.T + Q * (alpha / 30) ** q_exponent
        if keep.any():
            for i in np.flatnonzero(keep):
                if difference:
                    inputs[i] = 0.0 if last[i] is None else abs(y[i] - last[i])
                    last[i] = y[i]
                else:
                    inputs[i] = abs(y[i] - mean[i])
            alpha = float(infer(jnp.asarray(inputs)).value)
            R_k = (R * (alpha / 30) ** r_exponent)[np.ix_(keep, keep)]
            S = P[:2, :2][np.ix_(keep, keep)] + R_k
            K = P[:, :2][:, keep] @ np.linalg.inv(S)
            mean, P = mean + K @ (y[keep] - mean[:2][keep]), P - K @ S @ K.T
        means.append(mean)
        alphas.append(alpha)
    return np.array(means), np.array(alphas)


@pytest.mark.parametrize("kind", ["innovation", "difference"])
def test_the_order_of_a_step_and_what_gaps_hold(kind):
    ys = np.asarray(simulate(r=9.0, runs=1, steps=40, seed=4)[1][0])
    mask = np.random.default_rng(5).random((40, 2)) < 0.7
    mask[10:14] = False
    options: dict[str, Any] = {"r_exponent": 0.7, "q_exponent": -1.2, "reference": 30.0}
    filt = jf.fuzzy_scaled(jf.kalman(MODEL), SYSTEM, input=kind, **options)
    out = jf.filter(filt, np.where(mask, ys, np.nan), mask=mask)
    exponents = {name: options[name] for name in ("r_exponent", "q_exponent")}
    means, alphas = law(ys, mask, difference=kind == "difference", **exponents)
    np.testing.assert_allclose(out.extra["alpha"], alphas, rtol=1e-9)
    np.testing.assert_allclose(out.mean, means, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(out.extra["r_scale"], (alphas / 30) ** 0.7, rtol=1e-9)
    np.testing.assert_allclose(out.extra["q_scale"], (alphas / 30) ** -1.2, rtol=1e-9)
    assert np.ptp(alphas) > 20
    assert len(np.unique(alphas[9:14])) == 1
    # One of the two alone; and units.
    only = jf.filter(jf.fuzzy_scaled(jf.kalman(MODEL), SYSTEM, scale="r", input=kind), ys)
    assert "q_scale" not in only.extra
    both = jf.filter(jf.fuzzy_scaled(jf.kalman(MODEL), SYSTEM, q_exponent=0.0, input=kind), ys)
    np.testing.assert_allclose(only.mean, both.mean, rtol=1e-12)
    small = jf.fuzzy.mamdani([0.08, 0.1])
    scaled = jf.filter(jf.fuzzy_scaled(jf.kalman(MODEL), small, scale="r", input=kind, unit=0.01), ys)
    np.testing.assert_allclose(scaled.mean, only.mean, rtol=1e-9)


def test_an_alpha_of_zero_meets_the_floor_and_a_scale_its_bounds():
    ys = simulate(runs=1, steps=10)[1][0]
    nothing = jf.fuzzy.mamdani(
        [8.0, 10.0], rules=np.zeros((4, 4), int), outputs=[[-1.0, -1.0, 0.0]], output_range=(-1, 0)
    )
    out = jf.filter(jf.fuzzy_scaled(jf.kalman(MODEL), nothing, floor=0.5), ys)
    assert np.asarray(out.extra["floored"]).all()
    assert (np.asarray(out.extra["r_scale"]) == 2).all()
    assert not has(out.status, BOUND).any()
    out = jf.filter(jf.fuzzy_scaled(jf.kalman(MODEL), nothing, floor=1e-3), ys)
    assert (np.asarray(out.extra["r_scale"]) == 100).all()
    np.testing.assert_allclose(out.extra["q_scale"], 1000, rtol=1e-12)
    assert has(out.status, BOUND).all()
    assert np.isfinite(out.mean).all()


# The smooth form


def test_smooth_form_starts_at_the_printed_law_and_its_two_paths_agree():
    ys = simulate(r=np.where(np.arange(40) < 20, 1.0, 40.0), runs=1, steps=40)[1][0]
    default = jf.filter(jf.fuzzy_noise(jf.kalman(MODEL), SMOOTH), ys)
    table = jf.filter(jf.fuzzy_noise(jf.kalman(MODEL), SMOOTH, rules=jf.fuzzy.minimum_rules(4, 2)), ys)
    np.testing.assert_allclose(default.mean, table.mean, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(default.extra["r_scale"], table.extra["r_scale"], rtol=1e-12)
    scale = np.asarray(default.extra["r_scale"])
    assert (scale == np.asarray(default.extra["q_scale"])).all()
    assert scale.min() > 1 / 88.93
    assert scale.max() < 1 / 11
    assert scale.max() / scale.min() > 2
    # The crossing points stand in the middle of the partition's slopes.
    slopes = np.asarray(jf.fuzzy.partition(8.0))[:-1, 2:].mean(axis=1)
    np.testing.assert_allclose(np.cumsum(SMOOTH.gaps[0]), slopes, rtol=1e-12)
    # Mean squares by hand, with forgetting 0 the present innovation alone.
    now = jf.fuzzy_noise(jf.kalman(MODEL), SMOOTH._replace(forgetting=jnp.asarray(0.0)), unit=2.0)
    out = jf.filter(now, ys)
    d = 2 * np.sqrt(np.asarray(out.innovation) ** 2 + 1e-8 * np.diag(R))
    mu = jf.fuzzy.stick_breaking(jnp.asarray(d), jnp.cumsum(SMOOTH.gaps, axis=1)[None], SMOOTH.widths[None])
    weights = jax.vmap(jf.fuzzy.minimum_weights)(mu)
    np.testing.assert_allclose(out.extra["r_scale"], np.exp(-weights @ SMOOTH.log_alpha_r), rtol=1e-10)


def test_tuned_on_the_likelihood_of_bursts_it_lets_r_grow_with_the_innovations():
    """The reverse of the printed law. Started at alpha = 1, which is the filter inside; judged on other runs."""
    bursts = np.arange(60) // 15 % 2 == 1
    r = np.where(bursts, 25.0, 1.0)
    p = jf.fuzzy_noise_parameters([8.0, 10.0], alpha=np.ones(4))
    space = jf.FuzzyNoise(
        jf.tune.unit(p.forgetting), jf.tune.positive(p.gaps), jf.tune.positive(p.widths),
        jf.tune.real(p.log_alpha_r, -5.0, 5.0), jf.tune.real(p.log_alpha_q, -5.0, 5.0),
    )  # fmt: skip
    _, ys = simulate(r=r, runs=8, steps=60, seed=6)
    found = jf.tune.gradient(_burst_loss, space, ys, key=jax.random.key(0), steps=60)
    assert found.loss < 0.5 * float(_burst_loss(p, ys))
    head = np.asarray(found.params.log_alpha_r)
    assert (head[1:] < head[:-1]).all()
    states, ys = simulate(r=r, steps=60, seed=7)
    plain = run(jf.kalman(MODEL), ys)[0]
    start, _, _, extra, _ = run(jf.fuzzy_noise(jf.kalman(MODEL), p), ys)
    np.testing.assert_allclose(start, plain, rtol=1e-12, atol=1e-12)
    assert (np.asarray(extra["r_scale"]) == 1).all()
    mean, _, _, extra, _ = run(jf.fuzzy_noise(jf.kalman(MODEL), found.params), ys)
    scale = np.asarray(extra["r_scale"])
    assert scale[:, bursts].mean() > 2 * scale[:, ~bursts].mean()
    assert position_rmse(mean, states, 0) < 0.95 * position_rmse(plain, states, 0)


def _burst_loss(parameters, ys):
    return jf.tune.innovation_nll(jf.fuzzy_noise(jf.kalman(MODEL), parameters), ys)


# Statistics: references


def naive(ys, mask, *, kind, scale, forgetting=0.9, prior=3.0, window=5):
    """Sage-Husa and covariance matching around a Kalman filter with textbook formulas, one channel dropped or not."""
    mean, P = np.zeros(4), np.asarray(MODEL.P0)
    r, q = np.ones(2), 1.0
    count = np.full(2, prior)
    past = [[1.0] * window for _ in range(4)]  # two channels, observed and expected
    means, scales = [], []
    for y, keep in zip(np.asarray(ys), mask, strict=True):
        mean, P = F @ mean, F @ P @ F.T + q * Q
        at = np.flatnonzero(keep)
        if at.size:
            Hk, Rk = H[at], np.diag(r[at] * np.diag(R)[at])
            before = Hk @ P @ Hk.T
            S = before + Rk
            K = P @ Hk.T @ np.linalg.inv(S)
            nu = y[at] - Hk @ mean
            mean, P = mean + K @ nu, P - K @ S @ K.T
            eps, after = y[at] - Hk @ mean, np.diag(Hk @ P @ Hk.T)
            nominal, used = np.diag(R)[at], np.diag(Rk)
            if (kind, scale) == ("sage", "r"):
                count[at] = forgetting * count[at] + 1
                r[at] += (eps**2 + after - used) / nominal / count[at]
            elif kind == "sage":
                count = forgetting * count + 1  # both channels are counted together here
                ratio = np.sum(((nu - eps) ** 2 + after) / used) / np.sum(np.diag(before) / used)
                q *= 1 + (ratio - 1) / count[0]
            else:
                for i, n, h, v in zip(at, nu, np.diag(before), nominal, strict=True):
                    if scale == "r":
                        past[i] = [(n * n - h) / v, *past[i][:-1]]
                        r[i] = np.clip(np.mean(past[i]), 0.01, 100)
                    else:
                        past[i], past[2 + i] = [(n * n - v) / v, *past[i][:-1]], [h / v, *past[2 + i][:-1]]
                if scale == "q":
                    ratio = np.sum(past[:2]) / np.sum(past[2:])
                    q *= np.clip(ratio, 1e-4, 1e4) ** (1 / window)
        means.append(mean)
        scales.append(r.copy() if scale == "r" else q)
    return np.array(means), np.array(scales)


@pytest.mark.parametrize("scale", ["r", "q"])
@pytest.mark.parametrize("kind", ["sage", "matching"])
def test_against_textbook_formulas_with_partly_missing_samples(kind, scale):
    ys = np.asarray(simulate(r=4.0, q=4.0, runs=1, steps=40, seed=7)[1][0])
    mask = np.random.default_rng(8).random((40, 2)) < 0.7
    mask[10:13] = False
    if kind == "sage":
        filt = jf.sage_husa(jf.kalman(MODEL), scale=scale, forgetting=0.9, prior=3.0)
    else:
        filt = jf.covariance_matching(jf.kalman(MODEL), scale=scale, window=5)
    out = jf.filter(filt, np.where(mask, ys, np.nan), mask=mask)
    means, scales = naive(ys, mask, kind=kind, scale=scale)
    np.testing.assert_allclose(out.extra[f"{scale}_scale"], scales, rtol=1e-9)
    np.testing.assert_allclose(out.mean, means, rtol=1e-8, atol=1e-9)


def test_without_prior_the_weights_are_sage_and_husas():
    ys = simulate(runs=1, steps=2)[1][0]
    out = jf.filter(jf.sage_husa(jf.kalman(MODEL), prior=0.0), ys[:1])
    S, nu = np.diag(np.asarray(out.innovation_cov[0])), np.asarray(out.innovation[0])
    r = np.diag(R)
    np.testing.assert_allclose(out.extra["r_scale"][0], ((r / S * nu) ** 2 + r - r * r / S) / r, rtol=1e-12)


def test_fading_memory_is_more_process_noise_and_smooths():
    """P- = factor F P F' + Q: the Kalman filter with Q + (factor - 1) F P F', whose smoother it also has."""
    factor = 1.3
    ys = simulate(runs=1, steps=15)[1][0]
    mask = np.ones((15, 2), bool)
    mask[6:8] = False
    out = jf.filter(jf.fading_memory(jf.kalman(MODEL), factor), ys, mask=mask, outputs=jf.everything)
    mean, P, added = np.zeros(4), np.asarray(MODEL.P0), []
    for k, y in enumerate(np.asarray(ys)):
        fade = factor if mask[k].any() else 1.0
        added.append(Q + (fade - 1) * F @ P @ F.T)
        mean, P = F @ mean, F @ P @ F.T + added[-1]
        np.testing.assert_allclose(out.prediction.cov[k], P, rtol=1e-10, atol=1e-12)
        if mask[k].any():
            K = P[:, :2] @ np.linalg.inv(P[:2, :2] + R)
            mean, P = mean + K @ (y - mean[:2]), P - K @ P[:2]
        np.testing.assert_allclose(out.mean[k], mean, rtol=1e-9, atol=1e-9)
    noisy = jf.models.linear_gaussian(F, H, _given, R, MODEL.m0, MODEL.P0)
    expected = jf.smooth(jf.kalman(noisy), ys, mask=mask, u=jnp.asarray(np.array(added)))
    smoothed = jf.rts(out)
    np.testing.assert_allclose(smoothed.mean, expected.mean, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(smoothed.cov, expected.cov, rtol=1e-8, atol=1e-9)


def _given(u, dt):
    del dt
    return u


# What they learn, and what they cost

# name, RMSE ratio to the plain filter that each may have where the model is right (measured 1.002 to 1.03)
HARM = {"sage_husa": 1.01, "sage_husa_q": 1.01, "covariance_matching": 1.04, "covariance_matching_q": 1.07}


@pytest.mark.parametrize("name", list(HARM))
def test_finds_what_is_wrong_and_does_little_harm_where_nothing_is(name):
    right, wrong = ({}, {"q": 25.0}) if name.endswith("_q") else ({}, {"r": np.full((T, 2), [9.0, 0.25])})
    filt, plain = ADAPTIVE[name](jf.kalman(MODEL)), jf.kalman(MODEL)
    key = "q_scale" if name.endswith("_q") else "r_scale"
    truth = np.array([25.0]) if key == "q_scale" else np.array([9.0, 0.25])
    for options, target in ((right, np.ones_like(truth)), (wrong, truth)):
        states, ys = simulate(**options, seed=9)
        mean, _, status, extra, _ = run(filt, ys)
        per_run = np.asarray(extra[key])[:, 200:].mean(axis=1).reshape(RUNS, -1)
        error = per_run.std(axis=0, ddof=1) / np.sqrt(RUNS)
        # Within sampling error and a tenth: what is left of the start, and a small bias, as estimates are fed back.
        assert (np.abs(per_run.mean(axis=0) - target) < 4 * error + 0.1 * target).all(), (per_run.mean(axis=0), error)
        ratio = position_rmse(mean, states) / position_rmse(run(plain, ys)[0], states)
        assert ratio < (HARM[name] if options is right else 0.95)
        assert has(status, BOUND).mean() < 0.02


def test_what_is_wrong_is_put_down_to_what_is_adapted():
    """As documented: a wrong Q spoils an adapted R, and the reverse."""
    states, ys = simulate(q=25.0, seed=9)
    plain = position_rmse(run(jf.kalman(MODEL), ys)[0], states)
    assert position_rmse(run(ADAPTIVE["sage_husa"](jf.kalman(MODEL)), ys)[0], states) > 2 * plain
    states, ys = simulate(r=np.full((T, 2), [9.0, 0.25]), seed=9)
    plain = position_rmse(run(jf.kalman(MODEL), ys)[0], states)
    assert position_rmse(run(ADAPTIVE["sage_husa_q"](jf.kalman(MODEL)), ys)[0], states) > 1.2 * plain


@pytest.mark.parametrize("name", list(ADAPTIVE))
def test_covariances_and_scales_stay_in_bounds_under_bursts(name):
    k = np.arange(T)
    _, ys = simulate(r=np.where(k // 40 % 2 == 1, 1e4, 1.0), seed=10)
    mean, cov, status, extra, S = run(ADAPTIVE[name](jf.kalman(MODEL)), ys)
    assert np.isfinite(mean).all()
    for matrix in (cov, S):
        values = np.linalg.eigvalsh(np.asarray(matrix))
        assert (values[..., 0] >= -1e-12 * values[..., -1]).all()
    for key, (low, high) in (("r_scale", (0.01, 100.0)), ("q_scale", (1e-4, 1e4))):
        if key in extra:
            scale = np.asarray(extra[key])
            assert scale.min() >= low
            assert scale.max() <= high
    if name in ("sage_husa", "covariance_matching"):
        assert has(status, BOUND).any()


def test_bursts_about_as_long_as_the_window():
    """As documented: the sums of squares of Sage and Husa help, a difference of squares harms, bounds cure that."""
    states, ys = simulate(r=np.where(np.arange(T) // 40 % 2 == 1, 25.0, 1.0), seed=9)
    plain = position_rmse(run(jf.kalman(MODEL), ys)[0], states)
    filters = {
        "sage": ADAPTIVE["sage_husa"](jf.kalman(MODEL)),
        "matching": ADAPTIVE["covariance_matching"](jf.kalman(MODEL)),
        "bounded": jf.covariance_matching(jf.kalman(MODEL), bounds=(1.0, 100.0)),
        "printed": ADAPTIVE["fuzzy_scaled"](jf.kalman(MODEL)),
        "reversed": ADAPTIVE["fuzzy_noise"](jf.kalman(MODEL)),
    }
    ratio = {name: position_rmse(run(filt, ys)[0], states) / plain for name, filt in filters.items()}
    assert ratio["sage"] < 0.9
    assert ratio["matching"] > 2
    assert ratio["bounded"] < 1
    assert ratio["printed"] > 1.1
    assert ratio["reversed"] < 0.95


# Protocol


def nested(inner):
    return jf.sage_husa(jf.covariance_matching(jf.fuzzy_noise(inner, ROBUST), scale="q", window=4), forgetting=0.9)


LINEAR = jf.models.linear_gaussian(F, H, Q, R, MODEL.m0, MODEL.P0)


@pytest.mark.parametrize(
    "inner",
    [
        jf.sqrt_kalman(LINEAR),
        pytest.param(jf.extended(jf.models.as_nonlinear(LINEAR)), marks=pytest.mark.slow),
        pytest.param(jf.unscented(jf.models.as_nonlinear(LINEAR)), marks=pytest.mark.slow),
        pytest.param(jf.mixed_hinf(LINEAR, 0.0), marks=pytest.mark.slow),
    ],
    ids=["sqrt_kalman", "extended", "unscented", "mixed_hinf"],
)
def test_the_wrappers_nest_and_go_around_any_filter(inner):
    """Three of them around different filters of one linear model."""
    ys = simulate(r=4.0, runs=1, steps=20, seed=11)[1][0]
    expected = jf.filter(nested(jf.kalman(LINEAR)), ys)
    assert {"r_scale", "q_scale"} <= expected.extra.keys()
    assert np.ptp(np.asarray(expected.extra["q_scale"])) > 0.1
    out = jf.filter(nested(inner), ys)
    np.testing.assert_allclose(out.mean, expected.mean, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(out.extra["r_scale"], expected.extra["r_scale"], rtol=1e-6)


def test_into_an_imm_and_around_one():
    """An IMM of equals is one of them."""
    ys = simulate(r=4.0, runs=1, steps=20, seed=11)[1][0]
    transition = [[0.9, 0.1], [0.2, 0.8]]
    plain = jf.kalman(LINEAR)
    wrapped = jf.sage_husa(plain)
    alone = jf.filter(wrapped, ys)
    out = jf.filter(jf.imm([wrapped] * 2, transition), ys)
    np.testing.assert_allclose(out.mean, alone.mean, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(out.extra["models"][0]["r_scale"], alone.extra["r_scale"], rtol=1e-9)
    around = jf.filter(jf.sage_husa(jf.imm([plain] * 2, transition)), ys)
    np.testing.assert_allclose(around.mean, alone.mean, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("name", list(ADAPTIVE))
def test_scales_of_the_caller_are_multiplied(name):
    """With ``r_scale`` and ``q_scale`` given it is the filter of a model that has the scaled R and Q."""
    ys = simulate(runs=1, steps=20)[1][0]
    other = jf.models.linear_gaussian(F, H, 3.0 * Q, R * np.array([2.0, 5.0])[:, None], MODEL.m0, MODEL.P0)
    expected = jf.filter(ADAPTIVE[name](jf.kalman(other)), ys)
    given = {"q_scale": 3.0, "r_scale": np.tile([2.0, 5.0], (20, 1))}
    out = jf.filter(ADAPTIVE[name](jf.kalman(MODEL)), ys, **given)
    np.testing.assert_allclose(out.mean, expected.mean, rtol=1e-9, atol=1e-10)
    for key in ADAPTIVE_KEYS & out.extra.keys():
        np.testing.assert_allclose(out.extra[key], expected.extra[key], rtol=1e-9)


ADAPTIVE_KEYS = {"r_scale", "q_scale", "alpha"}


@pytest.mark.parametrize("name", list(ADAPTIVE))
def test_what_was_refused_or_not_finite_teaches_nothing(name):
    """A gate inside, a missed sample and a NaN in one component: the scales stay as they were."""
    ys = np.asarray(simulate(runs=1, steps=20, seed=12)[1][0]).copy()
    ys[5] += 1e4
    ys[9, 0] = np.nan
    mask = np.ones((20, 2), bool)
    mask[13] = False
    filt = ADAPTIVE[name](jf.gated(jf.kalman(MODEL), 1e-6))
    out = jax.jit(partial(jf.filter, filt))(ys, mask=mask)
    assert np.isfinite(out.mean).all()
    for k, bit in ((5, GATED), (9, NONFINITE), (13, MISSED)):
        assert has(out.status, bit)[k]
        for key in ADAPTIVE_KEYS & out.extra.keys():
            assert (out.extra[key][k] == out.extra[key][k - 1]).all(), (key, k)
    moved = [np.diff(np.asarray(out.extra[key]), axis=0) for key in ADAPTIVE_KEYS & out.extra.keys()]
    assert any((np.delete(step, [4, 8, 12], axis=0) != 0).any() for step in moved)


def test_a_perfect_channel_is_left_alone():
    """R_ii = 0: nothing to scale, and no NaN in values or gradients."""
    ys = simulate(runs=1, steps=12)[1][0]
    perfect = jf.models.linear_gaussian(F, H, Q, np.diag([0.0, 2.0]), MODEL.m0, MODEL.P0)

    def total(q_scale, filt):
        out = jf.filter(filt, ys, q_scale=q_scale)
        return jnp.sum(out.mean) + jnp.sum(out.log_lik), out

    for name in ("fuzzy_noise", "sage_husa"):
        slope, out = jax.jit(jax.grad(total, has_aux=True))(jnp.ones(12), ADAPTIVE[name](jf.kalman(perfect)))
        assert np.isfinite(slope).all()
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(out))
        if name == "sage_husa":
            assert (np.asarray(out.extra["r_scale"])[:, 0] == 1).all()


def test_bad_arguments_are_refused():
    filt, ys = jf.kalman(MODEL), np.zeros((3, 2))
    fixed = jf.alpha_beta(0.5, 0.2, dt=1.0)
    for make, message in (
        (lambda: jf.fuzzy_scaled(filt, SYSTEM, input="speed"), "input: expected"),
        (lambda: jf.fuzzy_scaled(filt, SYSTEM, scale="R"), "scale: expected"),
        (lambda: jf.fuzzy_scaled(filt, SYSTEM, unit=0.0), "unit"),
        (lambda: jf.fuzzy_scaled(filt, SYSTEM, reference=-1.0), "reference"),
        (lambda: jf.fuzzy_scaled(filt, SYSTEM, floor=0.0), "floor"),
        (lambda: jf.fuzzy_scaled(filt, SYSTEM, r_exponent=np.nan), "r_exponent"),
        (lambda: jf.fuzzy_scaled(filt, SYSTEM, r_bounds=(2.0, 1.0)), "r_bounds"),
        (lambda: jf.fuzzy_scaled(filt, SYSTEM, q_bounds=(0.0, 1.0)), "q_bounds"),
        (lambda: jf.filter(jf.fuzzy_scaled(filt, jf.fuzzy.mamdani(1.0)), ys), "system: expected one input per channel"),
        (lambda: jf.fuzzy_noise(filt, SMOOTH._replace(widths=-SMOOTH.widths)), "widths"),
        (lambda: jf.fuzzy_noise(filt, SMOOTH._replace(gaps=SMOOTH.gaps[0])), "gaps: expected shape"),
        (
            lambda: jf.fuzzy_noise(filt, SMOOTH._replace(log_alpha_q=jnp.zeros(3))),
            r"log_alpha_q: expected shape \(4,\)",
        ),
        (lambda: jf.fuzzy_noise(filt, SMOOTH._replace(forgetting=1.0)), "forgetting"),
        (lambda: jf.fuzzy_noise(filt, SMOOTH, rules=np.full((4, 4), 4)), "rules: expected levels"),
        (
            lambda: jf.filter(jf.fuzzy_noise(filt, jf.fuzzy_noise_parameters([1.0])), ys),
            "parameters: are for 1 channels",
        ),
        (
            lambda: jf.filter(jf.fuzzy_noise(fixed, SMOOTH), ys),
            "fuzzy_noise needs a filter that reports innovation_cov",
        ),
        (lambda: jf.fuzzy_noise_parameters([0.0, 1.0]), "universe"),
        (lambda: jf.fuzzy_noise_parameters([1.0], alpha=[1.0]), "alpha: expected shape"),
        (lambda: jf.fuzzy_noise_parameters([1.0], forgetting=1.0), "forgetting"),
        (lambda: jf.sage_husa(filt, scale="both"), 'scale: expected "r" or "q"'),
        (lambda: jf.sage_husa(filt, forgetting=1.0), "forgetting"),
        (lambda: jf.sage_husa(filt, prior=-1.0), "prior"),
        (lambda: jf.sage_husa(filt, bounds=(1.0,)), "bounds"),
        (lambda: jf.filter(jf.sage_husa(fixed), ys), "r_scale: the filter was made without r"),
        (lambda: jf.covariance_matching(filt, window=1), "window: expected an int >= 2"),
        (lambda: jf.covariance_matching(filt, bounds=(1.0, 0.5)), "bounds"),
        (lambda: jf.fading_memory(filt, 0.9), "factor: expected a value >= 1"),
        (lambda: jf.fading_memory(fixed), "fading_memory needs a filter with moments"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
