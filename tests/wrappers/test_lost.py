"""Strategies for lost measurements: what they must equal exactly, and what they do with difficult gaps."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf

M0, P0 = np.array([0.0, 10.0]), np.diag([100.0, 25.0])
G1 = jf.models.constant_velocity(dt=1.0, q=0.1, r=25.0, m0=M0, P0=P0)
GAP = np.ones((41, 1), bool)
GAP[20:26] = False


def _slow(mean):
    return jnp.full((), 0.3, mean.dtype)


FED_BACK = {
    "hold_last": jf.hold_last,
    "mean_of_recent": jf.mean_of_recent,
    "polynomial_fit": jf.polynomial_fit,
    "weighted": partial(jf.polynomial_fit, weighted=True, forgetting=0.95),
    "sinusoid_fit": partial(jf.sinusoid_fit, omega=_slow, window=8),
    "covariance_intersection": jf.covariance_intersection,
}
ALL = {"coast_inflated": jf.coast_inflated, **FED_BACK, "blend": jf.blend}
every = pytest.mark.parametrize("name", sorted(ALL))


def series(seed=0, T=41, m=1):
    """Positions of about constant velocity, noisy; the same for every channel but for noise."""
    rng = np.random.default_rng(seed)
    x = np.cumsum(10 + np.cumsum(0.3 * rng.normal(size=(T, m)), axis=0), axis=0)
    return x + 5 * rng.normal(size=(T, m))


def run(filt, ys, mask=None, **options):
    """Filtered from the first sample on; what is absent is NaN, which must not matter."""
    ys = ys if mask is None else np.where(np.broadcast_to(mask.reshape(len(mask), -1), ys.shape), ys, np.nan)
    return jf.filter(filt, ys, mask=mask, first_update_only=True, outputs=jf.everything, **options)


def has(status, bit):
    return (np.asarray(status) & int(bit)) != 0


def assert_same(a, b, rtol=1e-10):
    for field in ("mean", "cov", "log_lik", "nis", "innovation", "innovation_cov"):
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=rtol, atol=1e-10, err_msg=field)


# What the strategies must equal


@every
def test_without_a_gap_every_strategy_is_the_filter(name):
    ys, base = series(), jf.kalman(G1)
    expected = run(base, ys)
    for mask in (None, np.ones(41, bool)):
        out = run(ALL[name](base), ys, mask)
        assert_same(out, expected, rtol=1e-13)
        assert (out.status == 0).all()


def test_inflation_by_one_is_coasting_and_by_ten_is_ten_times_the_noise():
    ys, base = series(), jf.kalman(G1)
    assert_same(run(jf.coast_inflated(base, 1.0), ys, GAP), run(base, ys, GAP), rtol=1e-13)
    scaled = run(base, ys, GAP, q_scale=np.where(GAP[:, 0], 1.0, 10.0))
    assert_same(run(jf.coast_inflated(base, 10.0), ys, GAP), scaled, rtol=1e-13)


def test_coast_standard_deviations_of_the_specification():
    out = run(jf.kalman(G1), series(), GAP)
    std = np.sqrt(out.cov[20:26, 0, 0])
    np.testing.assert_allclose(std, [3.2692, 3.8886, 4.5813, 5.3377, 6.1504, 7.0141], atol=1e-4)
    np.testing.assert_allclose(np.sqrt(np.mean(std**2)), 5.2012, atol=1e-4)


@pytest.mark.parametrize("make", [jf.kalman, jf.sqrt_kalman])
def test_coasting_without_process_noise_is_the_line_through_all_past_data(make):
    """The bridge between the two families: mean of the fit, and variance R times its leverage."""
    model = jf.models.constant_velocity(dt=1.0, q=0.0, r=2.0, m0=np.zeros(2), P0=1e9 * np.eye(2))
    ys = series(1, T=14)
    mask = np.arange(14) < 10
    out = run(make(model), ys, mask)
    k = np.arange(10)
    for now in range(10, 14):
        line = np.polyval(np.polyfit(k, ys[:10, 0], 1), now)
        leverage = 1 / 10 + 12 * (now - 4.5) ** 2 / (10 * 99)
        np.testing.assert_allclose(out.mean[now, 0], line, rtol=1e-7)
        np.testing.assert_allclose(out.cov[now, 0, 0], 2.0 * leverage, rtol=1e-7)


@pytest.mark.parametrize(
    ("wrapper", "N", "p"),
    [
        (jf.hold_last, 1, 0),
        (jf.mean_of_recent, 5, 0),
        (jf.polynomial_fit, 10, 1),
        (partial(jf.polynomial_fit, window=20, degree=2), 20, 2),
    ],
)
def test_feeding_back_is_filtering_the_filled_series(wrapper, N, p):
    ys, base = series(), jf.kalman(G1)
    k = np.arange(20 - N, 20)
    filled = ys.copy()
    filled[20:26, 0] = np.polyval(np.polyfit(k - 20, ys[k, 0], p), np.arange(6))
    expected = run(base, filled)
    out = run(wrapper(base), ys, GAP)
    np.testing.assert_allclose(out.mean, expected.mean, rtol=1e-9)
    np.testing.assert_allclose(out.cov, expected.cov, rtol=1e-10)
    np.testing.assert_allclose(out.extra["measurement"], filled, rtol=1e-9)
    gap = ~GAP[:, 0]
    assert (has(out.status, jf.Status.PSEUDO) == gap).all()
    assert (has(out.status, jf.Status.MISSED) == gap).all()
    assert (out.log_lik[gap] == 0).all()  # nothing real was seen
    assert (out.innovation[gap] == 0).all()
    np.testing.assert_allclose(out.log_lik[~gap], expected.log_lik[~gap], rtol=1e-9)


def test_mean_is_a_fit_of_degree_zero_and_hold_one_of_a_single_sample():
    ys, base = series(), jf.kalman(G1)
    pairs = [
        (jf.mean_of_recent(base, 4), jf.polynomial_fit(base, window=4, degree=0)),
        (jf.hold_last(base), jf.polynomial_fit(base, window=1, degree=0)),
    ]
    for a, b in pairs:
        assert_same(run(a, ys, GAP), run(b, ys, GAP), rtol=0)


def test_weighted_fit_scales_the_noise_by_the_leverage_and_vanishes_with_it():
    ys, base = series(), jf.kalman(G1)
    wrapped = jf.polynomial_fit(base, weighted=True)
    filled = ys.copy()
    filled[20:26, 0] = np.polyval(np.polyfit(np.arange(10), ys[10:20, 0], 1), np.arange(10, 16))
    leverage = 1 / 10 + 12 * (4.5 + np.arange(1, 7)) ** 2 / (10 * 99)
    expected = run(base, filled, r_scale=np.concatenate([np.ones(20), 1 + leverage, np.ones(15)]))
    out = run(wrapped, ys, GAP)
    np.testing.assert_allclose(out.mean, expected.mean, rtol=1e-9)
    np.testing.assert_allclose(out.cov, expected.cov, rtol=1e-9)
    useless = run(wrapped, ys, GAP, r_scale=np.where(GAP[:, 0], 1.0, 1e12))
    coast = run(base, ys, GAP)
    np.testing.assert_allclose(useless.mean, coast.mean, rtol=1e-6)
    np.testing.assert_allclose(useless.cov, coast.cov, rtol=1e-6)


@pytest.mark.parametrize("q", [0.1, 10.0])
def test_covariance_intersection_is_its_formula(q):
    """With explicit inverses, on the 20-point grid; the filter with too large a q has use for the fit."""
    ys = series()
    model = jf.models.constant_velocity(dt=1.0, q=q, r=25.0, m0=M0, P0=P0)
    out = run(jf.covariance_intersection(jf.kalman(model)), ys, GAP)
    F, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    Q = q * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    mean, cov = np.asarray(out.mean[19]), np.asarray(out.cov[19])
    line = np.polyfit(np.arange(10), ys[10:20, 0], 1)
    for h in range(1, 7):
        mean, cov = F @ mean, F @ cov @ F.T + Q
        z, R = np.polyval(line, 9 + h), 25 * (1 / 10 + 12 * (4.5 + h) ** 2 / (10 * 99))
        fused = []
        for w in np.arange(20, 0, -1) / 20:
            P = np.linalg.inv(w * np.linalg.inv(cov) + (1 - w) * H.T @ H / R)
            m = P @ (w * np.linalg.solve(cov, mean) + (1 - w) * H[0] * z / R)
            fused.append((np.log(np.linalg.det(P)), w, m, P))
        _, w, mean, cov = min(fused, key=lambda x: x[0])
        np.testing.assert_allclose(out.extra["weight"][19 + h], w, rtol=1e-12)
        np.testing.assert_allclose(out.mean[19 + h], mean, rtol=1e-9)
        np.testing.assert_allclose(out.cov[19 + h], cov, rtol=1e-9)
        assert has(out.status[19 + h], jf.Status.PSEUDO) == (w < 1)
    assert (out.extra["weight"][20:26] < 1).any() == (q == 10.0)


@pytest.mark.parametrize("irregular", [False, True])
def test_blend_is_its_formula(irregular):
    """Against a naive version that propagates every origin anew."""
    rng = np.random.default_rng(5)
    ys, T, h, J = series(3) + 0.4 * np.arange(41.0)[:, None] ** 2, 41, 4, 5
    dt = rng.uniform(0.5, 1.5, T) if irregular else np.ones(T)
    t = np.cumsum(dt)
    mask = GAP.copy()
    mask[8] = False  # an earlier gap, inside the windows and among the backtests
    candidates = ((6, 1), (9, 2))
    out = run(
        jf.blend(jf.kalman(G1), candidates=candidates, horizon=h, origins=J),
        ys, mask, dt=dt if irregular else None,
    )  # fmt: skip

    def transition(dt):
        return np.array([[1, dt], [0, 1]]), 0.1 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])

    def fit(now, origin, N, p):
        k = np.flatnonzero(mask[: origin + 1, 0])[-N:]
        return np.polyval(np.polyfit(t[k] - t[now], ys[k, 0], min(p, len(k) - 1)), 0.0)

    squares, ratios = [], []
    for j in range(J):
        k = np.flatnonzero(mask[:20, 0])[-1 - j]
        m, P = np.asarray(out.mean[k - h]), np.asarray(out.cov[k - h])
        for i in range(k - h + 1, k + 1):
            F, Q = transition(dt[i])
            m, P = F @ m, F @ P @ F.T + Q
        guesses = np.array([m[0], *(fit(k, k - h, *c) for c in candidates)])
        squares.append((ys[k, 0] - guesses) ** 2)
        ratios.append(squares[-1][0] / (P[0, 0] + 25))
    w = np.maximum(np.mean(squares, axis=0), 25 / 4) ** -2.0
    w /= w.sum()
    s = max(1.0, np.mean(ratios))
    assert s > 1.5  # else this would not test it

    m, P = np.asarray(out.mean[19]), np.asarray(out.cov[19])
    for k in range(20, 26):
        F, Q = transition(dt[k])
        m, P = F @ m, F @ P @ F.T + s**2 * Q
        np.testing.assert_allclose(out.extra["weights"][k, :, 0], w, rtol=1e-8)
        np.testing.assert_allclose(out.cov[k], P, rtol=1e-9)
        np.testing.assert_allclose(out.mean[k], m, rtol=1e-9)
        reported = w @ [m[0], *(fit(k, k, *c) for c in candidates)]
        np.testing.assert_allclose(out.extra["reported"][k, 0], reported, rtol=1e-8)
    present = mask[:, 0]
    np.testing.assert_allclose(out.extra["reported"][present, 0], out.mean[present, 0], rtol=1e-12)
    assert not has(out.status, jf.Status.PSEUDO).any()


@pytest.mark.parametrize("dt", [None, 0.2])
def test_sinusoid_is_the_best_of_the_grid(dt):
    """Against least squares at each rate of the grid; without noise and at the true rate it is exact."""
    T, period = 70, 0.2
    eye = np.eye(3)
    model = jf.models.linear_gaussian(
        eye if dt is None else _identity, np.array([[1.0, 0.0, 0.0]]), 0.1 * eye if dt is None else _small, [[0.5]],
        np.array([0.0, 0.0, 2.0]), np.diag([1.0, 1.0, 0.0]),
    )  # fmt: skip
    omega = 2 if dt is None else _rate  # the third component stays at 2
    filt = jf.sinusoid_fit(jf.kalman(model), omega=omega, window=30, interval=period)
    t = period * np.arange(T)
    mask = np.arange(T) < 55
    mask[40] = False
    clean = 3 * np.sin(2.0 * t + 0.4)[:, None]
    for ys in (clean, clean + 0.3 * np.random.default_rng(0).normal(size=(T, 1))):
        out = run(filt, ys, mask, dt=dt)
        k = np.flatnonzero(mask)[-30:]
        fits = []
        for rate in 2.0 * np.linspace(0.6, 1.4, 33):
            basis = np.stack([np.sin(rate * t), np.cos(rate * t)], axis=1)
            b, residual, *_ = np.linalg.lstsq(basis[k], ys[k, 0])
            fits.append((residual[0], basis[55:] @ b))
        expected = min(fits, key=lambda x: x[0])[1]
        np.testing.assert_allclose(out.extra["measurement"][55:, 0], expected, rtol=1e-7, atol=1e-9)
        if ys is clean:
            np.testing.assert_allclose(expected, clean[55:, 0], atol=1e-9)


def _identity(u, dt):
    return jnp.eye(3)


def _small(u, dt):
    return 0.1 * jnp.eye(3)


def _rate(mean):
    return jnp.full((), -2.0, mean.dtype)  # the sign does not matter


@every
def test_square_root_form_and_nesting_change_nothing(name):
    ys = series(4)
    expected = run(ALL[name](jf.kalman(G1)), ys, GAP)
    nested = jf.coast_inflated(ALL[name](jf.coast_inflated(jf.sqrt_kalman(G1), 0.5)), 2.0)
    out = run(nested, ys, GAP)
    assert_same(out, expected, rtol=1e-8)
    assert (out.status == expected.status).all()


@every
def test_channels_are_treated_one_by_one(name):
    """Two independent axes with their own gaps: as two filters of one axis each."""
    two = jf.models.constant_velocity(dt=1.0, q=0.1, r=25.0, m0=np.repeat(M0, 2), P0=np.kron(P0, np.eye(2)))
    ys = series(6, m=2)
    mask = np.ones((41, 2), bool)
    mask[20:26, 0] = mask[30:33, 1] = False
    out = run(ALL[name](jf.kalman(two)), ys, mask)
    for axis in range(2):
        wrapper = (lambda f: f) if name in ("coast_inflated", "blend") else ALL[name]  # these act when all is missing
        one = run(wrapper(jf.kalman(G1)), ys[:, [axis]], mask[:, [axis]])
        if name not in ("sinusoid_fit", "covariance_intersection"):  # one weight, one rate for both
            np.testing.assert_allclose(out.mean[:, axis::2], one.mean, rtol=1e-9)
        np.testing.assert_allclose(out.innovation[~mask[:, axis], axis], 0)
        if name == "blend":
            # Up to the end of the first gap: there the single axis, all missing, is inflated too.
            single = run(jf.blend(jf.kalman(G1)), ys[:, [axis]], mask[:, [axis]]).extra
            np.testing.assert_allclose(out.extra["weights"][:26, :, axis], single["weights"][:26, :, 0], rtol=1e-8)
            np.testing.assert_allclose(out.extra["reported"][:26, axis], single["reported"][:26, 0], rtol=1e-8)
    partly = ~mask.all(axis=1)
    assert not has(out.status, jf.Status.MISSED).any()
    if name in FED_BACK and name != "covariance_intersection":
        assert (has(out.status, jf.Status.PSEUDO) == partly).all()
        # The likelihood of a step counts what was really seen, given the state before it.
        k = 20
        nu, S = out.innovation[k, 1], out.innovation_cov[k, 1, 1]
        np.testing.assert_allclose(out.log_lik[k], -0.5 * (nu**2 / S + np.log(2 * np.pi * S)), rtol=1e-12)


@pytest.mark.parametrize("name", ["coast_inflated", "polynomial_fit", "covariance_intersection", "blend"])
def test_smoothing_works_through_wrappers(name):
    ys = series(7)
    smoothed = jf.rts(out := run(ALL[name](jf.kalman(G1)), ys, GAP))
    assert np.isfinite(smoothed.cov).all()
    assert (np.diagonal(smoothed.cov, axis1=1, axis2=2) <= np.diagonal(out.cov, axis1=1, axis2=2) * (1 + 1e-9)).all()
    if name == "coast_inflated":
        plain = jf.rts(run(jf.kalman(G1), ys, GAP, q_scale=np.where(GAP[:, 0], 1.0, 10.0)))
        np.testing.assert_allclose(smoothed.mean, plain.mean, rtol=1e-10)
    if name == "polynomial_fit":
        plain = jf.rts(run(jf.kalman(G1), np.asarray(out.extra["measurement"])))
        np.testing.assert_allclose(smoothed.mean, plain.mean, rtol=1e-9)


# Difficult gaps


def _all_missing():
    return np.zeros((41, 1), bool)


def _first_missing():
    return (np.arange(41) >= 3)[:, None]


def _single_sample():
    return (np.arange(41) == 2)[:, None]


def _three_samples():
    return ((np.arange(41) < 3) | (np.arange(41) > 12))[:, None]


def _repeated():
    return (np.arange(41) % 9 < 5)[:, None]


def _long_gap():
    return ((np.arange(41) < 6) | (np.arange(41) > 38))[:, None]


@every
@pytest.mark.parametrize("make", [_all_missing, _first_missing, _single_sample, _three_samples, _repeated, _long_gap])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_difficult_gaps(name, make, dtype):
    """Finite whatever the gaps; a coast where there is nothing to fit; covariances stay covariances."""
    mask = make()
    filt, out = _compiled(name, dtype)(series(8).astype(dtype), mask)
    coast_mean, coast_cov = filt
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(out))
    assert all(leaf.dtype in (dtype, np.int32) for leaf in jax.tree.leaves(out))
    assert (np.linalg.eigvalsh(np.asarray(out.cov, float))[:, 0] >= -1e-5).all()
    start = int(np.argmax(mask)) if mask.any() else 41
    rtol = 8 * np.finfo(dtype).eps  # the last bits differ with how a machine contracts products and sums
    if name != "coast_inflated":
        np.testing.assert_allclose(out.mean[:start], coast_mean[:start], rtol=rtol)
        np.testing.assert_allclose(out.cov[:start], coast_cov[:start], rtol=rtol)
    assert (out.log_lik[~mask[:, 0]] == 0).all()
    assert not has(out.status[:start], jf.Status.PSEUDO).any()
    if name == "blend" and make in (_all_missing, _single_sample, _three_samples, _long_gap):
        # Too few backtests before the first gap: all weight on the filter, and no inflation.
        stop = 38 if make is _long_gap else 12
        np.testing.assert_array_equal(out.extra["weights"][:stop, 0], 1.0)
        np.testing.assert_allclose(out.cov[:stop], coast_cov[:stop], rtol=rtol)
    if name == "polynomial_fit" and make is _single_sample:
        np.testing.assert_array_equal(out.extra["measurement"][3:], out.extra["measurement"][2:3].repeat(38, 0))
    if name == "sinusoid_fit" and make is _single_sample:
        np.testing.assert_allclose(out.mean, coast_mean, rtol=rtol)


@jax.jit
def _both(filters, ys, mask):
    base, wrapped = filters
    plain = jf.filter(base, ys, mask=mask, first_update_only=True)
    return (plain.mean, plain.cov), jf.filter(wrapped, ys, mask=mask, first_update_only=True)


def _compiled(name, dtype):
    model = jf.models.constant_velocity(dt=1.0, q=0.1, r=25.0, m0=M0.astype(dtype), P0=P0.astype(dtype))
    base = jf.kalman(model)
    return lambda ys, mask: _both((base, ALL[name](base)), np.where(mask, ys, np.nan).astype(dtype), mask)


def test_window_does_not_reach_far_across_an_earlier_gap():
    """Ten samples before, four after: with ``max_age`` the line goes through the four only."""
    ys = series(9)
    mask = ((np.arange(41) < 10) | ((np.arange(41) >= 18) & (np.arange(41) < 22)))[:, None]

    def line(samples):
        return np.polyval(np.polyfit(samples - 22, ys[samples, 0], 1), np.arange(19))

    base = jf.kalman(G1)
    for max_age, samples in ((5, np.arange(18, 22)), (None, np.r_[4:10, 18:22])):
        out = run(jf.polynomial_fit(base, max_age=max_age), ys, mask)
        np.testing.assert_allclose(out.extra["measurement"][22:, 0], line(samples), rtol=1e-9)


def test_unmasked_nan_is_flagged_and_is_no_news():
    """Under a transformation nothing can raise: the filter's own prediction takes the bad value's place."""
    ys = series(10)
    base = jf.kalman(G1)
    bad = ys.copy()
    bad[15] = np.nan
    replaced = ys.copy()
    replaced[15] = run(base, ys).prediction.mean[15, 0]
    for wrapper in (jf.polynomial_fit, jf.covariance_intersection):
        f = jax.jit(lambda y, w=wrapper: jf.filter(w(base), y, mask=GAP, first_update_only=True))
        out, expected = f(bad), f(replaced)
        np.testing.assert_allclose(out.mean, expected.mean, rtol=1e-10)
        assert np.flatnonzero(has(out.status, jf.Status.NONFINITE)).tolist() == [15]


# Batches and gradients


@pytest.mark.parametrize("name", sorted(set(ALL) - {"blend"}))
def test_covariances_stay_shared_when_runs_share_their_mask(name):
    """With out_axes=None vmap raises for whatever depends on the run, so the batch computes it once."""
    filt = ALL[name](jf.kalman(G1))

    def shared(ys):
        out = jf.filter(filt, ys, mask=GAP, first_update_only=True)
        return out.mean, (out.cov, out.innovation_cov, out.extra.get("weight"))

    if name == "sinusoid_fit":  # its rate is the run's own, its leverage too; unweighted it does not enter
        assert not filt.update.args[0].options.value.weighted
    mean, (cov, *_) = jax.vmap(shared, out_axes=(0, None))(jnp.stack([series(i) for i in range(3)]))
    assert mean.shape == (3, 41, 2)
    assert cov.shape == (41, 2, 2)


@pytest.mark.parametrize(
    ("wrapper", "options", "read"),
    [
        (partial(jf.polynomial_fit, weighted=True), {"forgetting": 0.9}, "log_lik"),
        (jf.coast_inflated, {"factor": 5.0}, "log_lik"),
        (jf.covariance_intersection, {"forgetting": 0.9}, "log_lik"),
        # The floor is above the best candidate's risk and below the worst's, so that it matters.
        (jf.blend, {"exponent": 2.0, "floor": 20.0}, "reported"),
    ],
)
def test_gradients_with_respect_to_the_strategies_own_parameters(wrapper, options, read):
    ys = series(11) + 0.3 * np.arange(41.0)[:, None] ** 2
    base = jf.kalman(jf.models.constant_velocity(dt=1.0, q=20.0, r=25.0, m0=M0, P0=P0))

    def loss(v):
        out = run(wrapper(base, **dict(zip(options, v, strict=True))), ys, GAP)
        return jnp.sum(out.log_lik if read == "log_lik" else out.extra[read][20:26])

    v, h = jnp.array(list(options.values())), 1e-6
    gradient = jax.jit(jax.grad(loss))(v)
    numeric = jax.jit(jax.vmap(lambda e: (loss(v + e) - loss(v - e)) / (2 * h)))(h * jnp.eye(len(v)))
    assert (np.abs(numeric) > 1e-6).all()
    np.testing.assert_allclose(gradient, numeric, rtol=1e-5)


# Bad options


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda f: jf.coast_inflated(f, 0.0), ValueError, "factor"),
        (lambda f: jf.coast_inflated(f, np.nan), ValueError, "factor"),
        (lambda f: jf.mean_of_recent(f, 0), ValueError, "n"),
        (lambda f: jf.polynomial_fit(f, window=0), ValueError, "window"),
        (lambda f: jf.polynomial_fit(f, window=2.5), ValueError, "window"),
        (lambda f: jf.polynomial_fit(f, window=3, degree=3), ValueError, "degree"),
        (lambda f: jf.polynomial_fit(f, forgetting=1.5), ValueError, "forgetting"),
        (lambda f: jf.polynomial_fit(f, max_age=0), ValueError, "max_age"),
        (lambda f: jf.sinusoid_fit(f, omega=1, window=2), ValueError, "window"),
        (lambda f: jf.sinusoid_fit(f, omega=1, interval=0.0), ValueError, "interval"),
        (lambda f: jf.sinusoid_fit(f, omega=1.5), TypeError, "omega"),
        (lambda f: jf.covariance_intersection(f, degree=-1), ValueError, "degree"),
        (lambda f: jf.covariance_intersection(f._replace(with_moments=None)), ValueError, "filt"),
        (lambda f: jf.blend(f, candidates=()), ValueError, "candidates"),
        (lambda f: jf.blend(f, candidates=((3, 3),)), ValueError, "candidates"),
        (lambda f: jf.blend(f, candidates=(3, 1)), ValueError, "candidates"),
        (lambda f: jf.blend(f, horizon=0), ValueError, "horizon"),
        (lambda f: jf.blend(f, origins=0), ValueError, "origins"),
        (lambda f: jf.blend(f, exponent=0.0), ValueError, "exponent"),
        (lambda f: jf.blend(f, floor=-1.0), ValueError, "floor"),
    ],
)
def test_bad_options_are_refused_by_name(make, error, message):
    with pytest.raises(error, match=f"^{message}: "):
        make(jf.kalman(G1))


class _Only(NamedTuple):
    inner: jf.Filter


def _without_covariances(p, s, inp):
    inner, info = p.inner.update(s.inner, inp)
    return s._replace(inner=inner), info._replace(innovation_cov=None, noise_cov=None)


@pytest.mark.parametrize("wrapper", [jf.blend, jf.covariance_intersection])
def test_filter_that_reports_no_covariances_is_refused(wrapper):
    silent = jf.wrap(_Only(jf.kalman(G1)), update=_without_covariances)
    with pytest.raises(ValueError, match=r"^filt: .* needs a filter that reports innovation_cov and noise_cov"):
        run(wrapper(silent), series(), GAP)
