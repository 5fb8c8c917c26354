"""Maneuver detection, the adaptive answers, and the variable-dimension filter."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt import maneuver

M0, P0 = np.array([0.0, 10.0]), np.diag([100.0, 25.0])
M0_CA, P0_CA = np.zeros(3), np.diag([100.0, 25.0, 1.0])
ONSET = 60
DETECTORS = {
    "nis": {"statistic": "nis"},
    "fading": {"statistic": "fading", "forgetting": 0.8},
    "fading slow": {"statistic": "fading", "forgetting": 0.9},
    "window": {"statistic": "window", "window": 5},
    "sum": {"statistic": "sum", "window": 5},
    "sum long": {"statistic": "sum", "window": 10},
}


def cv(q=0.1, r=25.0, d=1):
    m0, P = np.repeat(M0, d).tolist(), np.kron(P0, np.eye(d)).tolist()  # lists take the dtype of q and r
    return jf.models.constant_velocity(dt=1.0, q=q, r=r, m0=m0, P0=P)


def ca(q=0.01, r=25.0, d=1):
    m0, P = np.repeat(M0_CA, d).tolist(), np.kron(P0_CA, np.eye(d)).tolist()
    return jf.models.constant_acceleration(dt=1.0, q=q, r=r, m0=m0, P0=P)


def scene(runs, T, q, accelerations, seed, length):
    """Constant velocity with a step of acceleration at ONSET: positions and measurements (sizes, runs, T)."""
    rng = np.random.default_rng(seed)
    F, L = np.array([[1.0, 1.0], [0.0, 1.0]]), np.linalg.cholesky(q * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]))
    x = M0 + rng.normal(size=(runs, 2)) * np.sqrt(np.diag(P0))
    positions = np.empty((runs, T))
    for k in range(T):
        x = x if k == 0 else x @ F.T + rng.normal(size=(runs, 2)) @ L.T
        positions[:, k] = x[:, 0]
    elapsed = np.arange(T) - ONSET + 1.0
    moved = np.where(elapsed <= length, 0.5 * np.maximum(elapsed, 0) ** 2, length * (elapsed - 0.5 * length))
    positions = positions + np.reshape(accelerations, (-1, 1, 1)) * moved
    return positions, positions + 5.0 * rng.normal(size=(runs, T))


def position_and_alarm(state, info):
    del state
    return info.mean[0], info.extra["alarm"]


@jax.jit
def runs_of(filters, ys):
    """Every filter over every run (..., runs, T), in one compiled function."""
    ys = ys[..., None]

    def one(filt, y):
        return jf.filter(filt, y, outputs=position_and_alarm, first_update_only=True)

    return {name: jax.vmap(jax.vmap(lambda y, f=f: one(f, y)))(ys) for name, f in filters.items()}


def test_detectors_alarm_as_often_as_they_say_and_soon_enough():
    filters = {name: jf.detected(jf.kalman(cv()), p_false=0.01, **options) for name, options in DETECTORS.items()}
    _, ys = scene(1000, 110, 0.1, [0.5, 1.0, 2.0], seed=3, length=60)
    out = runs_of(filters, ys)
    delays = {}
    for name, (_, alarm) in out.items():
        alarm = np.asarray(alarm)
        assert 0.007 <= alarm[0, :, 20:ONSET].mean() <= 0.015, name
        after = alarm[:, :, ONSET:]
        assert after.any(axis=2).all(), name
        delays[name] = after.argmax(axis=2).mean(axis=1) + 1  # 1: at the first accelerated sample
        assert delays[name][1] <= 9, name
    assert delays["sum"][0] < min(delay[0] for name, delay in delays.items() if name != "sum")


def test_adaptive_answers_follow_a_maneuver():
    """One seed, 1000 runs; the variable-dimension filter is the best of them, and costs little on a quiet target."""
    plain = jf.detected(jf.kalman(cv(0.05)), p_false=1e-3)
    filters = {
        "none": plain,
        "gain": jf.gain_floor(plain, alpha=0.75, beta=0.5, dt=1.0),
        "Q": jf.q_inflated(plain, 200.0),
        "P": jf.p_inflated(plain, 5.0),
        "VD": jf.variable_dimension(cv(0.05), ca(), p_false=1e-3),
    }
    truth, ys = scene(1000, 100, 0.05, [1.0, 3.0], seed=5, length=20)
    quiet, weak, strong, end = {}, {}, {}, {}
    for name, (position, _) in runs_of(filters, ys).items():
        squares = (np.asarray(position) - truth) ** 2
        quiet[name] = np.sqrt(squares[0, :, 20:ONSET].mean())
        weak[name], strong[name] = np.sqrt(squares[:, :, ONSET : ONSET + 20].mean(axis=(1, 2)))
        end[name] = np.sqrt(squares[1, :, 95:].mean())
    assert strong["VD"] <= 0.2 * strong["none"]
    assert strong["VD"] < min(strong["gain"], strong["Q"], strong["P"])
    assert weak["VD"] < min(weak["gain"], weak["Q"], weak["P"]) < 0.5 * weak["none"]
    assert quiet["VD"] <= 1.05 * quiet["none"]
    assert max(quiet.values()) <= 1.05 * quiet["none"]
    assert end["VD"] < 1.3 * quiet["none"]  # it has found back to constant velocity
    for table, figures in (  # ours at the time of writing: none, gain, Q, P, VD
        (quiet, [2.55, 2.56, 2.55, 2.55, 2.59]),
        (weak, [14.8, 5.9, 6.4, 6.1, 4.7]),
        (strong, [43.8, 6.8, 8.5, 7.4, 5.1]),
    ):
        np.testing.assert_allclose([table[name] for name in filters], figures, rtol=0.05)


# The statistics


def reference(name, nu, S, mask, forgetting, window):
    """The statistic and its degrees of freedom by the definition, over the samples that are not wholly missed."""
    values, terms = [], []
    for k in range(len(nu)):
        at = np.flatnonzero(mask[k])
        if at.size:
            inverse = np.linalg.inv(np.linalg.cholesky(S[k][np.ix_(at, at)]))
            white = np.zeros(nu.shape[1])
            white[at] = inverse @ nu[k, at]
            terms.append((white, mask[k]))
        recent = terms[-window:]
        if name == "sum":
            D, counts = np.sum([w for w, _ in recent], axis=0), np.sum([c for _, c in recent], axis=0)
            values.append((sum(D[i] ** 2 / counts[i] for i in range(len(D)) if counts[i]), (counts > 0).sum()))
        elif name == "fading":
            rho = sum(forgetting ** (len(terms) - 1 - i) * (w @ w) for i, (w, _) in enumerate(terms))
            values.append((rho, nu.shape[1]))
        else:
            values.append((sum(w @ w for w, _ in recent), sum(c.sum() for _, c in recent)))
    return values


@pytest.mark.parametrize("name", maneuver.STATISTICS)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
def test_statistics_equal_their_definition_with_missing_components(name, dtype):
    rng = np.random.default_rng(0)
    mask = rng.random((25, 2)) < 0.7
    mask[0], mask[10:13] = True, False
    ys = jnp.asarray(np.where(mask, 8 * np.cumsum(rng.normal(size=(25, 2)), axis=0), np.nan), dtype)
    model = jax.tree.map(lambda x: jnp.asarray(x, dtype), cv(d=2, r=np.array([[25.0, 8.0], [8.0, 9.0]])))
    filt = jf.detected(jf.kalman(model), name, p_false=0.3, forgetting=0.7, window=4)
    out = jf.filter(filt, ys, mask=mask)
    window = {"nis": 1, "fading": 25}.get(name, 4)
    nu, S = np.asarray(out.innovation, float), np.asarray(out.innovation_cov, float)
    expected = reference(name, nu, S, mask, 0.7, window)
    value, dof = (np.array(x) for x in zip(*expected, strict=True))
    np.testing.assert_allclose(out.extra["statistic"], value, rtol=1e-10 if dtype == jnp.float64 else 1e-3)
    detector = maneuver.detector(name, p_false=0.3, forgetting=0.7, window=4)
    limit = np.array([maneuver.threshold(detector, int(d)) for d in dof])
    assert (np.asarray(out.extra["alarm"]) == (value > limit)).all()
    assert 0 < (value > limit).sum() < 25
    assert len(set(np.asarray(out.extra["statistic"])[9:13].tolist())) == 1, "a missed sample must change nothing"
    assert out.extra["statistic"].dtype == dtype


def test_thresholds():
    chi2 = jf.metrics.chi2_quantile
    assert maneuver.threshold(maneuver.detector("nis", p_false=0.01), 2) == chi2(0.99, 2)
    assert maneuver.threshold(maneuver.detector("window", p_false=0.01, window=5), 10) == chi2(0.99, 10)
    np.testing.assert_allclose(
        maneuver.threshold(maneuver.detector("fading", p_false=0.01, forgetting=0.8), 1), chi2(0.99, 9.0) / 1.8
    )


def test_no_memory_makes_all_statistics_the_nis():
    ys = scene(1, 80, 0.1, [2.0], seed=1, length=20)[1][0, 0][:, None]
    single = jf.filter(jf.detected(jf.kalman(cv()), "nis"), ys)
    for options in ({"statistic": "fading", "forgetting": 0.0}, {"statistic": "window", "window": 1}):
        out = jf.filter(jf.detected(jf.kalman(cv()), **options), ys)
        np.testing.assert_allclose(out.extra["statistic"], single.nis, rtol=1e-12)
        assert (out.extra["alarm"] == single.extra["alarm"]).all()


def test_cumulative_nis_accepts_a_right_model_and_rejects_a_wrong_one():
    ys = scene(1, 100, 0.1, [0.0], seed=2, length=20)[1][0, 0][:, None]
    mask = np.arange(100)[:, None] % 7 > 0
    out = jf.filter(jf.kalman(cv()), ys, mask=mask, first_update_only=True)
    total = maneuver.cumulative(out.nis, mask)
    np.testing.assert_allclose(total.statistic, np.cumsum(out.nis))
    assert (total.dof == np.cumsum(mask)).all()
    assert total.p_value[0] == 1
    assert 0.01 < total.p_value[-1] < 0.99
    wrong = jf.filter(jf.kalman(cv(r=12.0)), ys, first_update_only=True)
    assert maneuver.cumulative(wrong.nis).p_value[-1] < 1e-3


# The answers


@pytest.fixture(scope="module")
def turning():
    """Two axes, one maneuver, a gap and a half-missing sample."""
    one = scene(2, 100, 0.05, [2.0], seed=4, length=20)[1][0].T
    mask = np.ones((100, 2), bool)
    mask[30:33], mask[70, 0] = False, False
    return one, mask


RESPONSES = {
    "gain": lambda f, x: jf.gain_floor(f, alpha=0.75 * x, beta=0.5 * x, dt=1.0),
    "Q": lambda f, x: jf.q_inflated(f, 1.0 + 199.0 * x),
    "P": lambda f, x: jf.p_inflated(f, 1.0 + 4.0 * x),
}


@pytest.mark.parametrize("name", sorted(RESPONSES))
def test_a_neutral_answer_changes_nothing_and_a_real_one_only_after_an_alarm(name, turning):
    ys, mask = turning
    plain = jf.detected(jf.sqrt_kalman(cv(0.05, d=2)), p_false=1e-3)
    expected = jf.filter(plain, ys, mask=mask)
    neutral = jf.filter(RESPONSES[name](plain, 0.0), ys, mask=mask)
    np.testing.assert_allclose(neutral.mean, expected.mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(neutral.cov, expected.cov, rtol=1e-9, atol=1e-9)
    real = jf.filter(RESPONSES[name](plain, 1.0), ys, mask=mask)
    first = int(np.argmax(expected.extra["alarm"]))
    assert ONSET <= first <= ONSET + 6
    assert (real.mean[: first + 1] == expected.mean[: first + 1]).all()
    assert not np.allclose(real.mean[first + 1], expected.mean[first + 1])
    assert np.trace(real.cov[first + 1]) > np.trace(expected.cov[first + 1])


def test_gain_floor_is_an_alpha_beta_step():
    """Where the Kalman gain is far below the floor, the step after an alarm is that of the alpha-beta filter."""
    ys = np.concatenate([np.arange(40.0), np.arange(40.0, 44.0) + 200])[:, None]
    model = jf.models.constant_velocity(dt=1.0, q=1e-6, r=1.0, m0=np.array([0.0, 1.0]), P0=np.eye(2))
    filt = jf.gain_floor(jf.detected(jf.kalman(model), "nis"), alpha=0.7, beta=0.4, dt=1.0)
    out = jf.filter(filt, ys, outputs=jf.everything)
    assert out.extra["alarm"][40]
    nu = out.innovation[41, 0]
    np.testing.assert_allclose(out.mean[41], out.prediction.mean[41] + np.array([0.7, 0.4]) * nu, rtol=1e-12)
    A = np.eye(2) - np.outer([0.7, 0.4], [1.0, 0.0])
    expected = A @ out.prediction.cov[41] @ A.T + np.outer([0.7, 0.4], [0.7, 0.4])
    np.testing.assert_allclose(out.cov[41], expected, rtol=1e-12)


# The variable-dimension filter


def test_restart_covariance_is_the_errors_covariance():
    """2e5 draws, two axes that are correlated; and the closed form of one axis."""
    rng = np.random.default_rng(0)
    A, B = rng.normal(size=(4, 4)), rng.normal(size=(2, 2))
    cov, R, T, truth = A @ A.T, B @ B.T + np.eye(2), 0.7, rng.normal(size=6)
    mean = truth[:4] + rng.multivariate_normal(np.zeros(4), cov, size=200_000)
    now = np.kron([[1, T, T**2 / 2], [0, 1, T], [0, 0, 1]], np.eye(2)) @ truth
    y = now[:2] + rng.multivariate_normal(np.zeros(2), R, size=200_000)
    means, covs = jax.vmap(maneuver.restart, (0, None, 0, None, None))(mean, cov, y, R, jnp.asarray(T))
    errors = np.asarray(means) - now
    sample = errors.T @ errors / len(errors)
    scale = np.sqrt(np.outer(np.diag(covs[0]), np.diag(covs[0])))
    assert np.abs((sample - covs[0]) / scale).max() < 0.02
    assert np.abs(errors.mean(axis=0) / np.sqrt(np.diag(covs[0]))).max() < 0.02

    (p11, p12), (_, p22), r = *cov[np.ix_([0, 2], [0, 2])], 25.0
    one = maneuver.restart(jnp.zeros(2), cov[np.ix_([0, 2], [0, 2])], jnp.ones(1), jnp.full((1, 1), r), jnp.asarray(T))
    vv, va = 4 / T**2 * (r + p11) + p22 + 4 / T * p12, 4 / T**3 * (r + p11) + 2 / T * p22 + 6 / T**2 * p12
    aa = 4 / T**4 * (r + p11 + 2 * T * p12 + T**2 * p22)
    expected = [[r, 2 * r / T, 2 * r / T**2], [2 * r / T, vv, va], [2 * r / T**2, va, aa]]
    np.testing.assert_allclose(one[1], expected, rtol=1e-12)
    np.testing.assert_allclose(one[0], [1, 2 / T, 2 / T**2], rtol=1e-12)


def test_restart_is_a_diffuse_acceleration():
    """It equals a constant-acceleration filter without process noise and with an infinite prior variance."""
    mean, cov = jnp.array([1.0, 2.0]), jnp.array([[4.0, 1.0], [1.0, 3.0]])
    P = np.zeros((3, 3))
    P[:2, :2], P[2, 2] = cov, 1e8
    model = jf.models.constant_acceleration(dt=0.7, q=0.0, r=25.0, m0=np.append(mean, 0.0), P0=P)
    out = jf.filter(jf.kalman(model), np.full((1, 1), 5.0))
    expected = maneuver.restart(mean, cov, jnp.full(1, 5.0), jnp.full((1, 1), 25.0), jnp.asarray(0.7))
    np.testing.assert_allclose(out.mean[0], expected[0], rtol=1e-4)
    np.testing.assert_allclose(out.cov[0], expected[1], rtol=1e-4)


def test_variable_dimension_by_hand(turning):
    """Quiet it is the constant-velocity filter; at the alarm, the restart and the samples since filtered once more."""
    ys, mask = turning
    filt = jf.variable_dimension(cv(0.05, d=2), ca(d=2), lookback=4)
    out = jf.filter(filt, ys, mask=mask, first_update_only=True)
    quiet = jf.filter(jf.kalman(cv(0.05, d=2)), ys, mask=mask, first_update_only=True)
    k = int(np.argmax(out.extra["alarm"]))
    assert ONSET <= k <= ONSET + 6
    np.testing.assert_allclose(out.mean[:k, :4], quiet.mean[:k], rtol=1e-12)
    np.testing.assert_allclose(out.log_lik[: k + 1], quiet.log_lik[: k + 1], rtol=1e-10)
    assert (out.mean[:k, 4:] == 0).all()
    assert (out.cov[:k, 4:] == 0).all()

    begin = k - 4
    mean, cov = maneuver.restart(
        quiet.mean[begin - 1], quiet.cov[begin - 1], jnp.asarray(ys[begin]), 25 * jnp.eye(2), jnp.asarray(1.0)
    )
    model = ca(d=2)._replace(m0=mean, P0=cov)
    after = jf.filter(jf.kalman(model), ys[begin + 1 : 80], mask=mask[begin + 1 : 80])
    np.testing.assert_allclose(out.mean[k], after.mean[3], rtol=1e-9)
    np.testing.assert_allclose(out.cov[k], after.cov[3], rtol=1e-9, atol=1e-9)
    on = np.asarray(out.extra["maneuvering"])
    assert on[k:80].all()  # and so on, with the half-missing sample, while the target accelerates
    np.testing.assert_allclose(out.mean[k + 1 : 80], after.mean[4:], rtol=1e-9)
    np.testing.assert_allclose(out.log_lik[k + 1 : 80], after.log_lik[4:], rtol=1e-9)
    end = int(np.flatnonzero(on)[-1]) + 1
    assert 80 <= end < 100
    assert not on[end:].any()
    assert (out.mean[end, 4:] == 0).all()
    # Constant velocity goes on from the position and velocity block.
    rest = cv(0.05, d=2)._replace(m0=out.mean[end, :4], P0=out.cov[end, :4, :4])
    np.testing.assert_allclose(
        out.mean[end + 1 :, :4], jf.filter(jf.kalman(rest), ys[end + 1 :]).mean, rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
def test_variable_dimension_with_a_gap_at_the_onset_stays_finite_and_differentiable(dtype):
    ys = scene(1, 90, 0.05, [3.0], seed=6, length=20)[1][0, 0][:, None]
    mask = np.ones((90, 1), bool)
    mask[:3] = mask[ONSET - 4 : ONSET + 3] = False  # samples missed at the start, and where the restart would begin
    ys = jnp.asarray(np.where(mask, ys, np.nan), dtype)
    dt = jnp.ones((90,), dtype).at[5].set(0.0)

    def total(p):
        models = cv(p["q"], p["r"]), ca(p["qa"], p["r"])
        out = jf.filter(jf.variable_dimension(*models), ys, mask=mask, dt=dt)
        return jnp.sum(out.log_lik) + jnp.sum(jnp.sin(out.mean)), out

    parameters = {"q": jnp.asarray(0.05, dtype), "r": jnp.asarray(25.0, dtype), "qa": jnp.asarray(0.01, dtype)}
    gradient, out = jax.jit(jax.grad(total, has_aux=True))(parameters)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((gradient, out)))
    assert out.mean.dtype == dtype
    assert all(float(g) != 0 for g in gradient.values())
    on = np.asarray(out.extra["maneuvering"])
    assert on[ONSET + 3 : ONSET + 10].any()
    eigenvalues = np.linalg.eigvalsh(np.asarray(out.cov, float))
    assert (eigenvalues[:, 0] >= -1e-5 * eigenvalues[:, -1]).all()


def test_nested_in_a_gate_a_refused_sample_is_no_evidence():
    """Gate outside: the detector inside sees a missed sample, and holds its statistic."""
    ys = np.arange(30.0)[:, None] + np.random.default_rng(0).normal(size=(30, 1))
    ys[20] += 500
    model = jf.models.constant_velocity(dt=1.0, q=0.01, r=1.0, m0=np.array([0.0, 1.0]), P0=np.eye(2))
    out = jf.filter(jf.gated(jf.q_inflated(jf.detected(jf.kalman(model)))), ys)
    assert out.status[20] == int(jf.Status.GATED | jf.Status.MISSED)
    assert out.extra["statistic"][20] == out.extra["statistic"][19]
    assert not out.extra["alarm"].any()
    outside = jf.filter(jf.detected(jf.gated(jf.kalman(model))), ys)
    assert outside.extra["statistic"][20] == outside.extra["statistic"][19]


# What is refused


def test_bad_options_are_refused():
    filt = jf.kalman(cv())
    for options, error, match in [
        ({"statistic": "nees"}, ValueError, "statistic: expected one of"),
        ({"p_false": 0.0}, ValueError, "p_false"),
        ({"p_false": 1.0}, ValueError, "p_false"),
        ({"forgetting": 1.0}, ValueError, "forgetting"),
        ({"window": 0}, ValueError, "window"),
    ]:
        with pytest.raises(error, match=match):
            jf.detected(filt, **options)
    with pytest.raises(TypeError, match=r"p_false: expected a plain number \(it is static\)"):
        jax.jit(lambda p: jf.filter(jf.detected(filt, p_false=p), np.ones((3, 1))))(0.01)
    for make, name in [(jf.q_inflated, "factor"), (jf.p_inflated, "factor")]:
        with pytest.raises(ValueError, match=name):
            make(filt, 0.0)
        with pytest.raises(ValueError, match=r"wrap it in jf\.detected"):
            jf.filter(make(filt), np.ones((3, 1)))
    with pytest.raises(ValueError, match="alpha"):
        jf.gain_floor(filt, alpha=-0.1, beta=0.1, dt=1.0)
    alpha_beta = jf.alpha_beta(0.5, 0.2, dt=1.0)
    with pytest.raises(ValueError, match="with_moments"):
        jf.gain_floor(alpha_beta, alpha=0.5, beta=0.1, dt=1.0)
    with pytest.raises(ValueError, match="reports nis"):
        jf.filter(jf.detected(alpha_beta), np.ones((3, 1)))
    for bad, options, match in [
        ((cv(), ca(d=2)), {}, "model_ca: expected 3 d states"),
        ((cv(), ca()), {"lookback": 0}, "lookback"),
        ((cv(), ca()), {"end_probability": 1.0}, "end_probability"),
        ((cv()._replace(H=jnp.array([[2.0, 0.0]])), ca()), {}, r"model_cv: expected H = \[I 0\]"),
        ((cv()._replace(S=jnp.zeros((2, 1))), ca()), {}, "model_cv: expected a motion model"),
    ]:
        with pytest.raises(ValueError, match=match):
            jf.variable_dimension(*bad, **options)
    with pytest.raises(ValueError, match="cross"):
        jf.smooth(jf.variable_dimension(cv(), ca()), np.ones((5, 1)))
