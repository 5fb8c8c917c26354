"""Fixed-gain filters against a naive loop, least squares, the Kalman filter and exact error propagation (float64)."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxfilt as jf
from jaxfilt.filters import gains
from jaxfilt.filters.alpha_beta import alpha_beta, alpha_beta_gamma

DT = 0.7
CV = (0.5, 0.21)  # not 0.2: the fifth growing gain, where the floor has a kink
CA = (0.5, 0.25, 0.06)
STARTS = ["growing", "two_point", "none"]
# Every start and both orders, in three compilations instead of six.
cases = pytest.mark.parametrize(("gain", "start"), [(CV, "growing"), (CA, "two_point"), (CV, "none")])
both_orders = pytest.mark.parametrize("gain", [CV, CA], ids=["alpha_beta", "alpha_beta_gamma"])


def make(gain, **options):
    return (alpha_beta if len(gain) == 2 else alpha_beta_gamma)(*gain, **options)


def options_of(start, blocks, m):
    return {"start": start, "m0": np.linspace(1.0, 2.0, blocks * m)} if start == "none" else {"start": start}


def series(T=25, m=2, seed=0):
    rng = np.random.default_rng(seed)
    ys = rng.normal(size=(T, m)).cumsum(0)
    mask = rng.random((T, m)) > 0.3
    mask[9:13] = False
    return ys, mask, rng.uniform(0.3, 1.5, T)


def reference(gain, ys, mask, dts, start, m0=None):
    """One axis, as the equations are written; two_point keeps its measurements and times."""
    n = len(gain)
    x = np.zeros(n) if m0 is None else m0.copy()
    seen, now, last, out = [], 0.0, 0.0, []
    for y, here, dt in zip(ys, mask, dts, strict=True):
        now += dt
        x = np.array([[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, 1]])[:n, :n] @ x
        if here:
            seen.append((now, y))
            k, h = len(seen), now - last
            last = now
            e = y - x[0]
            g = [float(a) for a in gain]
            if start == "growing":
                g_k = [float(a) for a in gains.growing_memory(k, order=n - 1)]
                g = g_k if k < n else [max(a, b) for a, b in zip(g, g_k, strict=True)]
            x = x + np.array([a / h**i for i, a in enumerate(g)]) * e
            if start == "two_point":
                if k == 1:
                    x = np.array([y, 0.0, 0.0])[:n]
                elif k == 2:
                    x[1] = (seen[1][1] - seen[0][1]) / h
                    x[2:] = 0.0
                elif k == 3 and n == 3:  # second divided difference; (z2 + z0 - 2 z1) / T^2 for equal intervals
                    (t0, z0), (t1, z1), (t2, z2) = seen
                    x[2] = 2 * ((z2 - z1) / (t2 - t1) - (z1 - z0) / (t1 - t0)) / (t2 - t0)
        out.append(x)
    return np.array(out)


@both_orders
@pytest.mark.parametrize("start", STARTS)
def test_equals_a_naive_loop(gain, start):
    ys, mask, dts = series()
    options = options_of(start, len(gain), 2)
    out = jf.filter(make(gain, dt=DT, r=2.0, **options), ys, mask=mask, dt=dts)
    for axis in range(2):
        m0 = options["m0"][axis::2] if start == "none" else None
        expected = reference(gain, ys[:, axis], mask[:, axis], dts, start, m0)
        np.testing.assert_allclose(out.mean[:, axis::2], expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def test_without_r_nothing_is_claimed_about_the_noise():
    ys, _, _ = series()
    out = jf.filter(alpha_beta(*CV, dt=DT), ys, outputs=jf.everything)
    absent = (
        out.cov,
        out.innovation_cov,
        out.nis,
        out.log_lik,
        out.noise_cov,
        out.prediction.cov,
        out.prediction.cross,
    )
    assert all(x is None for x in absent)
    np.testing.assert_allclose(out.mean, jf.filter(alpha_beta(*CV, dt=DT, r=3.0), ys).mean, rtol=1e-13)


def test_two_point_start_is_the_published_one():
    z = np.array([[3.0], [4.5], [7.0]])
    out = jf.filter(alpha_beta(*CV, dt=DT, start="two_point"), z).mean
    np.testing.assert_allclose(out[:2, 1], [0, (z[1, 0] - z[0, 0]) / DT], rtol=1e-14)
    out = jf.filter(alpha_beta_gamma(*CA, dt=DT, start="two_point"), z).mean
    np.testing.assert_allclose(out[:, 2], [0, 0, (z[2, 0] + z[0, 0] - 2 * z[1, 0]) / DT**2], rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(out[0], [3, 0, 0], rtol=0, atol=0)


@both_orders
def test_growing_start_is_the_running_least_squares_fit(gain):
    order = len(gain) - 1
    z = np.random.default_rng(0).normal(size=(20, 1)).cumsum(0)
    tiny = gains.fading_memory(1 - 1e-4, order=order)  # the floor is never reached
    means = jf.filter(make(tiny, dt=DT), z).mean
    per_step = jf.filter(
        make(gains.growing_memory(np.arange(1, 21), order=order), dt=DT, m0=np.full(order + 1, 5.0)), z
    ).mean
    for k in range(order + 1, 21):
        t = (np.arange(k) - k + 1) * DT
        fit = np.polynomial.Polynomial.fit(t, z[:k, 0], order, domain=[-1, 1])
        expected = [fit(0.0), *(fit.deriv(i)(0.0) for i in range(1, order + 1))]
        np.testing.assert_allclose(means[k - 1], expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    # The same gains given per measurement, from any m0: position and slope of m0 are forgotten.
    np.testing.assert_allclose(per_step[order:, : min(2, order + 1)], means[order:, :2], rtol=0, atol=1e-10)


def test_growing_start_ends_in_the_constant_gains():
    filt = alpha_beta(*CV, dt=DT)
    ys, _, _ = series(40, 1)
    out = jf.filter(filt, ys)
    step = (out.mean[1:, 0] - (out.mean[:-1, 0] + DT * out.mean[:-1, 1])) / out.innovation[1:, 0]
    k = np.arange(2, 41)
    np.testing.assert_allclose(step, np.maximum(CV[0], 2 * (2 * k - 1) / (k * (k + 1))), rtol=1e-9)


@cases
def test_masked_samples_equal_dropped_samples_with_their_intervals_summed(gain, start):
    ys, mask, dts = series()
    rows = mask[:, 0]
    keep = np.flatnonzero(rows)
    summed = np.diff(np.concatenate([[0.0], np.cumsum(dts)[keep]]))
    filt = make(gain, dt=DT, r=2.0, **options_of(start, len(gain), 2))
    masked = jf.filter(filt, ys, mask=rows, dt=dts)
    dropped = jf.filter(filt, ys[keep], dt=summed)
    for field in ("mean", "cov", "innovation", "innovation_cov", "nis", "log_lik"):
        a, b = getattr(masked, field)[keep], getattr(dropped, field)
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-11 * np.abs(b).max())
    gaps = np.flatnonzero(~rows)
    assert (masked.log_lik[gaps] == 0).all()
    assert (masked.innovation[gaps] == 0).all()
    assert (np.asarray(masked.status)[gaps] == jf.Status.MISSED).all()
    assert (np.asarray(masked.status)[keep] == 0).all()


def test_gain_with_the_elapsed_time_survives_rare_samples():
    # One sample in 20: with beta / dt the closed loop over 20 intervals would have the spectral radius 1.51.
    T = 2000
    mask = (np.arange(T) % 20 == 0)[:, None]
    ys = np.random.default_rng(0).normal(size=(T, 1))
    out = jf.filter(alpha_beta(*gains.cohen(), dt=1.0), ys, mask=mask)
    assert np.abs(out.mean[20::20, 0]).max() < 5


@cases
def test_axes_are_independent_and_count_their_own_measurements(gain, start):
    ys, mask, dts = series(m=3)
    blocks = len(gain)
    options = options_of(start, blocks, 3)
    whole = jf.filter(make(gain, dt=DT, r=np.array([1.0, 2.0, 3.0]), **options), ys, mask=mask, dt=dts)
    log_lik = 0.0
    for axis in range(3):
        if start == "none":
            options = {"start": start, "m0": np.linspace(1.0, 2.0, 3 * blocks)[axis::3]}
        filt = make(gain, dt=DT, r=axis + 1.0, **options)
        one = jf.filter(filt, ys[:, axis : axis + 1], mask=mask[:, axis : axis + 1], dt=dts)
        np.testing.assert_allclose(whole.mean[:, axis::3], one.mean, rtol=0, atol=1e-11 * np.abs(one.mean).max())
        np.testing.assert_allclose(whole.cov[:, axis::3, axis::3], one.cov, rtol=0, atol=1e-11 * np.abs(one.cov).max())
        log_lik = log_lik + one.log_lik
    np.testing.assert_allclose(whole.log_lik, log_lik, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(("gain", "start"), [(CV, "growing"), (CA, "growing"), (CA, "two_point"), (CV, "none")])
def test_cov_is_exactly_what_the_measurement_noise_does(gain, start):
    # The mean is affine in ys: Cov(mean_k) = J Cov(ys) J', and the unit vectors give J. Correlated axes, gaps,
    # irregular dt.
    T = 14
    _, mask, dts = series(T)
    r = np.array([[2.0, 0.7], [0.7, 1.0]])
    scale = np.random.default_rng(1).uniform(0.5, 2.0, (T, 2))
    filt = make(gain, dt=DT, r=r, **options_of(start, len(gain), 2))
    units = jnp.asarray(np.concatenate([np.zeros((1, 2 * T)), np.eye(2 * T)]).reshape(-1, T, 2))
    run = partial(jf.filter, filt, mask=jnp.asarray(mask), dt=dts, r_scale=scale, outputs=jf.everything)
    batch = jax.vmap(run)(units)
    out = jax.tree.map(lambda x: x[0], batch)
    R = r * np.sqrt(scale[:, :, None] * scale[:, None, :])
    for means, cov in ((batch.mean, out.cov), (batch.prediction.mean, out.prediction.cov)):
        J = np.asarray(means[1:] - means[:1]).reshape(T, 2, T, -1)  # of step k: [s, c, k, a]
        expected = np.einsum("scka,scd,sdkb->kab", J, R, J)
        np.testing.assert_allclose(cov, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    np.testing.assert_allclose(out.noise_cov, R, rtol=1e-13)
    np.testing.assert_allclose(out.innovation_cov, out.prediction.cov[:, :2, :2] + R, rtol=1e-12)
    with pytest.raises(ValueError, match="cannot be smoothed"):
        jf.rts(out)


def transition(blocks, dt, m=2):
    F = np.array([[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, 1]])[:blocks, :blocks]
    return np.kron(F, np.eye(m))


@both_orders
def test_cov_converges_to_the_steady_covariance(gain):
    out = jf.filter(make(gain, dt=DT, r=3.0), np.zeros((400, 1)))
    expected = gains.steady_covariance(*gain, dt=DT, r=3.0)
    np.testing.assert_allclose(out.cov[-1], expected, rtol=1e-10)
    np.testing.assert_allclose(out.innovation_cov[-1, 0, 0], 3.0 + (transition(len(gain), DT, 1) @ expected
                               @ transition(len(gain), DT, 1).T)[0, 0], rtol=1e-10)  # fmt: skip


def test_nis_and_log_lik_are_those_of_the_present_components():
    ys, mask, _ = series()
    r = np.array([[2.0, 0.7], [0.7, 1.0]])
    out = jf.filter(alpha_beta(*CV, dt=DT, r=r, m0=np.zeros(4)), ys, mask=mask)
    for k in range(len(ys)):
        on = mask[k]
        nu, S = np.asarray(out.innovation[k])[on], np.asarray(out.innovation_cov[k])[np.ix_(on, on)]
        nis = nu @ np.linalg.solve(S, nu) if on.any() else 0.0
        log_lik = -0.5 * (nis + np.linalg.slogdet(2 * np.pi * S)[1]) if on.any() else 0.0
        np.testing.assert_allclose(out.nis[k], nis, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(out.log_lik[k], log_lik, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("gain", "start"), [(CV, "growing"), (CA, "two_point")])
def test_measurements_that_determine_the_state_are_not_scored(gain, start):
    ys, _, _ = series()
    out = jf.filter(make(gain, dt=DT, r=2.0, start=start), 1e3 + ys)
    assert (out.log_lik[: len(gain)] == 0).all()
    assert (out.nis[: len(gain)] == 0).all()
    assert (out.log_lik[len(gain) :] != 0).all()


def test_published_variance_reduction_by_monte_carlo():
    # Thesis 5.2, T = .7, Cohen's gains: C_xx = .4119, C_vv = .0804. The scatter of a variance over N runs is sqrt(2/N).
    runs = 2000
    expected = gains.variance_reduction(*gains.cohen(), dt=DT)
    np.testing.assert_allclose(expected, [0.4119, 0.0804], atol=5e-5)
    filt = alpha_beta(*gains.cohen(), dt=DT, m0=np.zeros(2))
    for seed in (1, 2, 3):
        ys = jax.random.normal(jax.random.key(seed), (runs, 100, 1), jnp.float64)
        last = jax.vmap(lambda y: jf.filter(filt, y).mean[-1])(ys)
        np.testing.assert_allclose(np.var(last, axis=0), expected, rtol=4 * np.sqrt(2 / runs))


@pytest.mark.parametrize("noise", ["piecewise", "continuous"])
def test_kalata_gains_are_those_of_the_steady_kalman_filter(noise):
    q, r = 0.1, 25.0
    model = jf.models.constant_velocity(dt=DT, q=q, r=r, m0=np.array([0.0, 1.0]), P0=np.eye(2), noise=noise)
    ys, _, _ = series(600, 1)
    kalman = jf.filter(jf.kalman(model), ys)
    gain = kalman.cov[-1, :, 0] / r
    alpha, beta = gains.kalata(gains.tracking_index(q, r, dt=DT, noise=noise), noise=noise)
    np.testing.assert_allclose(gain, [alpha, beta / DT], rtol=1e-10)
    fixed = jf.filter(alpha_beta(alpha, beta, dt=DT, m0=np.array([0.0, 1.0])), ys)
    np.testing.assert_allclose(fixed.mean[-50:], kalman.mean[-50:], rtol=0, atol=1e-8 * np.abs(ys).max())


def test_kalata_gains_of_order_two_are_those_of_the_steady_kalman_filter():
    q, r = 0.5, 4.0
    model = jf.models.constant_acceleration(dt=DT, q=q, r=r, m0=np.zeros(3), P0=np.eye(3), noise="piecewise")
    kalman = jf.filter(jf.kalman(model), np.zeros((300, 1)))
    alpha, beta, kappa = gains.kalata(gains.tracking_index(q, r, dt=DT), order=2)
    np.testing.assert_allclose(kalman.cov[-1, :, 0] / r, [alpha, beta / DT, kappa / DT**2], rtol=1e-10)


def test_per_step_gains_of_the_kalman_filter_reproduce_it_from_the_first_step():
    ys, _, _ = series(30)
    m0 = np.array([0.3, -0.2, 1.0, 2.0])
    model = jf.models.constant_velocity(dt=DT, q=0.3, r=2.0, m0=m0, P0=np.kron(np.diag([5.0, 3.0]), np.eye(2)))
    kalman = jf.filter(jf.kalman(model), ys)
    K = kalman.cov[:, ::2, 0] / 2.0  # P+ H' R^-1 of axis 0
    filt = alpha_beta(K[:, 0], K[:, 1] * DT, dt=DT, m0=m0)
    np.testing.assert_allclose(jf.filter(filt, ys).mean, kalman.mean, rtol=0, atol=1e-10)


def test_per_step_gains_are_indexed_by_real_measurements_and_the_last_is_held():
    ys, mask, _ = series()
    per_step = alpha_beta(np.array([0.9, 0.7, 0.5]), np.array([0.6, 0.4, CV[1]]), dt=DT, m0=np.zeros(4))
    rows = mask[:, 0]
    held = alpha_beta(*CV, dt=DT, m0=np.zeros(4))
    whole = jf.filter(per_step, ys, mask=rows)
    third = np.flatnonzero(rows)[2] - 1  # everything before the third measurement
    inputs = jf.inputs(ys[: third + 1], mask=rows[: third + 1])
    state, _ = jf.scan(per_step, per_step.init(jax.tree.map(lambda x: x[0], inputs)), inputs)
    _, rest = jf.scan(held, state, jf.inputs(ys[third + 1 :], mask=rows[third + 1 :]))
    np.testing.assert_allclose(whole.mean[third + 1 :], rest.mean, rtol=1e-13)


def test_conventions_of_gamma_are_the_same_filter():
    ys, _, _ = series()
    expected = jf.filter(alpha_beta_gamma(*CA, dt=DT), ys).mean
    for convention, gamma in (("double", CA[2] / 2), ("kalata", 2 * CA[2]), ("kappa", CA[2])):
        got = jf.filter(alpha_beta_gamma(CA[0], CA[1], gamma, dt=DT, convention=convention), ys).mean
        np.testing.assert_allclose(got, expected, rtol=1e-13)


def test_lag_behind_a_constant_acceleration():
    a, t = 3.0, DT * np.arange(1, 301)
    out = jf.filter(alpha_beta(*CV, dt=DT), (a * t**2 / 2)[:, None], outputs=jf.everything)
    truth = np.stack([a * t**2 / 2, a * t], axis=1)
    position, predicted, velocity = gains.steady_lag(*CV, dt=DT, rate=a)
    np.testing.assert_allclose((truth - out.mean)[-1], [position, velocity], rtol=1e-8)
    np.testing.assert_allclose((truth - out.prediction.mean)[-1, 0], predicted, rtol=1e-8)


@cases
def test_float32_follows_float64(gain, start):
    ys, mask, dts = series(60)
    options = options_of(start, len(gain), 2)
    exact = jf.filter(make(gain, dt=DT, r=2.0, **options), ys, mask=mask, dt=dts)
    if start == "none":
        options["m0"] = options["m0"].astype(np.float32)
    filt = make(gain, dt=DT, r=2.0, **options)  # Python numbers take the dtype of ys
    single = jf.filter(filt, ys.astype(np.float32), mask=mask, dt=dts.astype(np.float32))
    for a, b in zip(jax.tree.leaves(single), jax.tree.leaves(exact), strict=True):
        if jnp.issubdtype(b.dtype, jnp.floating):
            assert a.dtype == jnp.float32
            np.testing.assert_allclose(a, b, rtol=0, atol=2e-5 * np.abs(b).max())
        else:
            assert (a == b).all()
    assert (np.linalg.eigvalsh(np.asarray(single.cov, np.float64)) > -1e-6 * np.abs(exact.cov).max()).all()


def test_python_numbers_and_lists_take_the_dtype_of_the_measurements():
    ys = np.zeros((5, 2), np.float32)
    for filt in (
        alpha_beta(1, 1, dt=1, r=[1, 2], m0=[0, 0, 1, 1]),
        alpha_beta([0.9, 0.5], (0.4, 0.2), dt=1, r=[[1, 0], [0, 2.0]]),
        alpha_beta(*gains.kalata(0.3), dt=1),
        alpha_beta_gamma(*gains.kalata(0.3, order=2), dt=1),
        alpha_beta_gamma(0.5, 0.25, [0.1, 0.06], dt=1, convention="double"),
    ):
        assert jf.filter(filt, ys).mean.dtype == jnp.float32


@both_orders
@pytest.mark.parametrize("mask", [None, "shared"])
def test_covariance_is_shared_by_the_runs_of_a_batch(gain, mask):
    ys, shared, dts = series()
    filt = make(gain, dt=DT, r=2.0)
    options = {} if mask is None else {"mask": jnp.asarray(shared), "dt": dts}

    def run(y):
        out = jf.filter(filt, y, **options)
        return out.mean, (out.cov, out.innovation_cov, out.noise_cov)

    batch = jnp.stack([jnp.asarray(ys), 2 * jnp.asarray(ys)])
    means, covs = jax.vmap(run, out_axes=(0, None))(batch)  # None: raises if anything there is batched
    alone = run(batch[1])
    for got, want in ((means[1], alone[0]), (covs[0], alone[1][0])):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-12 * np.abs(want).max())


def test_filters_are_pytrees_that_vmap_over_gains():
    ys, _, _ = series()
    alphas, betas = jnp.array([0.5, 0.8]), jnp.array([0.2, 0.5])
    population = jax.vmap(lambda a, b: alpha_beta(a, b, dt=DT, r=1.0))(alphas, betas)
    out = jax.vmap(lambda f: jf.filter(f, ys))(population)
    for i in range(2):
        one = jf.filter(alpha_beta(float(alphas[i]), float(betas[i]), dt=DT, r=1.0), ys)
        np.testing.assert_allclose(out.mean[i], one.mean, rtol=1e-12)
        np.testing.assert_allclose(out.log_lik[i], one.log_lik, rtol=1e-12)


@cases
def test_gradients_of_every_parameter(gain, start):
    ys, mask, dts = series(12)
    mask = jnp.asarray(mask)

    def loss(p):
        filt = make(p["gain"], dt=DT, r=p["r"], start=start, m0=p.get("m0"))
        out = jf.filter(filt, p["ys"], mask=mask, dt=p["dt"])
        return (out.innovation**2).sum() + out.log_lik.sum()

    at = {"gain": gain, "r": np.array([2.0, 3.0]), "dt": dts, "ys": ys}
    if start == "none":
        at["m0"] = np.linspace(1.0, 2.0, 2 * len(gain))
    x, unravel = ravel_pytree(jax.tree.map(jnp.asarray, at))
    h = 1e-6
    steps = h * jnp.eye(x.size)
    nearby = jnp.concatenate([x[None, :] + steps, x[None, :] - steps])
    plus, minus = jnp.split(jax.jit(jax.vmap(lambda x: loss(unravel(x))))(nearby), 2)
    central = (plus - minus) / (2 * h)
    gradient = jax.jit(jax.grad(lambda x: loss(unravel(x))))(x)
    np.testing.assert_allclose(gradient, central, rtol=1e-6, atol=1e-7 * float(jnp.abs(gradient).max()))


def test_gradients_survive_missing_and_unusable_values():
    ys = np.zeros((8, 2))
    ys[3], ys[5, 0], ys[6, 1] = np.nan, np.inf, np.nan
    mask = np.ones((8, 2), bool)
    mask[3] = False

    @jax.jit
    def gradients(x, y):
        def loss(x, y):
            out = jf.filter(alpha_beta(x[0], x[1], dt=x[2], r=x[3]), y, mask=jnp.asarray(mask))
            return out.mean.sum() + out.log_lik.sum()

        return jax.grad(loss, argnums=(0, 1))(x, y), jax.jacfwd(loss)(x, y)

    out = gradients(jnp.array([0.5, 0.21, DT, 2.0]), ys)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(out))


def test_tuning_by_gradient_reaches_the_loss_of_kalatas_gains():
    # Section 6: from Cohen's gains, one-step prediction error, index .3; the optimum is flat, so compare losses.
    runs, T, index = 64, 100, 0.3
    k1, k2 = jax.random.split(jax.random.key(0))
    a = index * jax.random.normal(k1, (runs, T), jnp.float64)
    v = jnp.cumsum(a, axis=1)
    p = jnp.cumsum(v - 0.5 * a, axis=1)
    ys = (p + jax.random.normal(k2, (runs, T), jnp.float64))[:, :, None]

    def loss(x):
        filt = alpha_beta(*gains.from_unconstrained(*x), dt=1.0)
        return (jax.vmap(lambda y: jf.filter(filt, y).innovation)(ys)[:, 10:] ** 2).mean()

    @jax.jit
    def descend(x):
        return jax.lax.scan(lambda x, _: (x - jax.jacfwd(loss)(x), None), x, None, length=40)[0]

    x0 = jnp.stack(gains.to_unconstrained(*gains.cohen()))
    x = descend(x0)
    best = loss(jnp.stack(gains.to_unconstrained(*gains.kalata(index))))
    assert loss(x0) > 1.005 * best
    assert loss(x) < 1.005 * best


def test_starting_anew_after_a_maneuver():
    ys, _, _ = series(20, 1)
    filt = alpha_beta(*CV, dt=DT)
    inputs = jf.inputs(ys)
    state, _ = jf.scan(filt, filt.init(jax.tree.map(lambda x: x[0], inputs)), inputs)
    _, again = jf.scan(filt, state._replace(count=jnp.zeros_like(state.count)), inputs)
    np.testing.assert_allclose(again.mean[1:], jf.filter(filt, ys).mean[1:], rtol=0, atol=1e-11)


def test_moments_can_be_read_and_replaced():
    filt = alpha_beta(*CV, dt=DT, r=1.0)
    state = filt.init(jf.StepInput(jnp.zeros(1)))
    assert filt.moments is not None
    assert filt.with_moments is not None
    state = filt.with_moments(state, jnp.ones(2), 2 * jnp.eye(2))
    mean, cov = filt.moments(state)
    assert (mean == 1).all()
    assert (cov == 2 * jnp.eye(2)).all()
    plain = alpha_beta(*CV, dt=DT)
    assert plain.moments is None
    assert plain.with_moments is None


def test_update_first_takes_the_nominal_interval():
    ys, _, _ = series(5, 1)
    out = jf.filter(alpha_beta(*CV, dt=DT, m0=np.array([1.0, 2.0])), ys, first_update_only=True)
    e = ys[0, 0] - 1.0
    np.testing.assert_allclose(out.mean[0], [1 + CV[0] * e, 2 + CV[1] / DT * e], rtol=1e-14)
    assert (out.status == 0).all()


# Bad input: the rows of the specification's section 7 that concern fixed gains, then the other arguments.


def _unstable(*gain):
    return lambda: make(gain, dt=DT, m0=np.zeros(len(gain)))


ROWS = {
    "alpha outside the stable region": (_unstable(2.0, 0.1), "alpha, beta"),
    "alpha = 0": (_unstable(0.0, 0.1), "alpha, beta"),
    "beta outside the stable region": (_unstable(0.5, 3.0), "alpha, beta"),
    "beta = 0": (_unstable(0.5, 0.0), "alpha, beta"),
    "kappa outside the stable region": (_unstable(0.5, 0.2, 0.14), "alpha, beta, kappa"),
    "kappa < 0": (_unstable(0.5, 0.2, -0.01), "alpha, beta, kappa"),
    "gain in the wrong convention": (
        lambda: alpha_beta_gamma(0.5, 0.2, 0.1, dt=1.0, convention="double"),
        "alpha, beta",
    ),
    "last of the gains per measurement": (lambda: alpha_beta(np.array([0.5, 2.5]), 0.2, dt=DT), "alpha, beta"),
    "NaN gain": (_unstable(np.nan, 0.1), "alpha"),
    "NaN among the gains per measurement": (lambda: alpha_beta(np.array([np.nan, 0.5]), 0.2, dt=DT), "alpha"),
    "gains of rank 2": (lambda: alpha_beta(np.full((2, 2), 0.5), 0.2, dt=DT), "alpha"),
    "T = 0": (lambda: alpha_beta(*CV, dt=0.0), "dt"),
    "T < 0": (lambda: alpha_beta(*CV, dt=-1.0), "dt"),
    "T NaN": (lambda: alpha_beta(*CV, dt=np.nan), "dt"),
    "T per step": (lambda: alpha_beta(*CV, dt=np.ones(3)), "dt"),
    "R = 0": (lambda: alpha_beta(*CV, dt=DT, r=0.0), "r"),
    "R < 0 on one axis": (lambda: alpha_beta(*CV, dt=DT, r=np.array([1.0, -1.0])), "r"),
    "R indefinite": (lambda: alpha_beta(*CV, dt=DT, r=np.array([[1.0, 2.0], [2.0, 1.0]])), "r"),
    "R asymmetric": (lambda: alpha_beta(*CV, dt=DT, r=np.array([[1.0, 0.1], [0.0, 1.0]])), "r"),
    "R of another size": (
        lambda: jf.filter(alpha_beta(*CV, dt=DT, r=np.ones(3)), np.zeros((4, 2))),
        "ys: expected 3 .* as r",
    ),
    "R not square": (lambda: alpha_beta(*CV, dt=DT, r=np.ones((2, 3))), "r"),
    "m0 of odd length": (lambda: alpha_beta(*CV, dt=DT, m0=np.zeros(3)), "m0"),
    "m0 of another size": (
        lambda: jf.filter(alpha_beta(*CV, dt=DT, m0=np.zeros(2)), np.zeros((4, 2))),
        "ys: expected 1 .* as m0",
    ),
    "m0 NaN": (lambda: alpha_beta(*CV, dt=DT, m0=np.array([0.0, np.nan])), "m0"),
    "no m0 to start from": (lambda: alpha_beta(*CV, dt=DT, start="none"), "m0"),
    "m0 and two_point": (lambda: alpha_beta(*CV, dt=DT, start="two_point", m0=np.zeros(2)), "m0"),
    "unknown start": (lambda: alpha_beta(*CV, dt=DT, start="cold"), "start"),
    "unknown convention": (lambda: alpha_beta_gamma(*CA, dt=DT, convention="gamma"), "convention"),
    "q_scale": (lambda: jf.filter(alpha_beta(*CV, dt=DT, r=1.0), np.zeros((4, 1)), q_scale=2.0), "q_scale"),
    "r_scale without r": (lambda: jf.filter(alpha_beta(*CV, dt=DT), np.zeros((4, 1)), r_scale=2.0), "r_scale"),
    "negative dt": (lambda: jf.filter(alpha_beta(*CV, dt=DT), np.zeros((4, 1)), dt=-1.0), "dt"),
    "z NaN": (lambda: jf.filter(alpha_beta(*CV, dt=DT), np.array([[0.0], [np.nan]])), "ys"),
}


@pytest.mark.parametrize("row", ROWS)
def test_bad_input_is_refused_by_name(row):
    call, argument = ROWS[row]
    with pytest.raises(ValueError, match=f"^{argument}"):
        call()


@pytest.mark.parametrize(
    ("call", "argument"),
    [
        (lambda: alpha_beta(np.array([1, 1]), 0.2, dt=DT), "alpha"),
        (lambda: alpha_beta(np.float32(0.5), np.ones(2), dt=DT), "alpha is float32, beta is float64"),
        (
            lambda: jf.filter(alpha_beta(*CV, dt=DT, r=np.float64(1)), np.zeros((4, 1), np.float32)),
            "ys: is float32, but the filter's model is float64",
        ),
        (lambda: jf.filter(alpha_beta(*CV, dt=DT), np.zeros((4, 1), int)), "ys"),
    ],
)
def test_bad_dtypes_are_refused_by_name(call, argument):
    with pytest.raises(TypeError, match=argument):
        call()


def test_row_gains_outside_the_stable_region_under_jit():
    @jax.jit
    def run(alpha, beta):
        return jf.filter(alpha_beta(alpha, beta, dt=DT), jnp.ones((4, 1))).extra["stable"]

    assert run(0.5, 0.2).all()
    assert not run(0.5, 3.1).any()
    assert not run(jnp.array([0.5, 2.5]), 0.2).any()
    with pytest.raises(ValueError, match=r"^alpha, beta"):  # concrete gains are refused there too
        jax.jit(lambda y: jf.filter(alpha_beta(0.5, 3.1, dt=DT), y).mean)(jnp.ones((4, 1)))


@both_orders
def test_row_unmasked_nan_or_infinity(gain):
    ys, _, _ = series()
    clean = jnp.asarray(np.stack([ys, ys, ys]))
    dirty = clean.at[1, 7, 0].set(jnp.nan).at[1, 9].set(jnp.inf)
    filt = make(gain, dt=DT, r=1.0)
    run = jax.jit(jax.vmap(lambda y: jf.filter(filt, y)))
    good, bad = run(clean), run(dirty)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(bad))
    np.testing.assert_array_equal(bad.cov, good.cov)
    for a, b in zip(jax.tree.leaves(good), jax.tree.leaves(bad), strict=True):
        np.testing.assert_array_equal(a[0::2], b[0::2])  # the other runs: to the bit
    flags = np.asarray(bad.status[1])
    assert flags[7] == jf.Status.NONFINITE
    assert flags[9] == jf.Status.NONFINITE
    assert (np.delete(flags, [7, 9]) == 0).all()
    assert bad.innovation[1, 7, 0] == 0
    assert (bad.innovation[1, 9] == 0).all()


@cases
def test_row_all_samples_missing(gain, start):
    ys, mask = jf.mask_nan(np.full((10, 1), np.nan))
    out = jf.filter(make(gain, dt=DT, r=1.0, **options_of(start, len(gain), 1)), ys, mask=mask)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(out))
    assert (out.status == jf.Status.MISSED).all()
    assert (out.log_lik == 0).all()
    if start == "none":
        m0 = np.linspace(1.0, 2.0, len(gain))
        expected = [transition(len(gain), DT * k, 1) @ m0 for k in range(1, 11)]
        np.testing.assert_allclose(out.mean, expected, rtol=1e-12)


def test_row_no_time_between_two_measurements():
    ys, _, _ = series(6, 1)
    out = jf.filter(alpha_beta(*CV, dt=DT, r=1.0), ys, dt=np.array([1.0, 1.0, 1.0, 0.0, 1.0, 1.0]))
    assert np.isfinite(out.mean).all()
    assert np.asarray(out.status).tolist() == [0, 0, 0, int(jf.Status.BOUND), 0, 0]
    gained = (out.mean[3, 1] - out.mean[2, 1]) / out.innovation[3, 0]
    np.testing.assert_allclose(gained, 0.3 / DT, rtol=1e-12)  # the fourth growing gain, at the nominal interval
