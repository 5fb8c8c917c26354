"""Sine/cosine sensors: exact checks and bad inputs of specification S4f, sections 2.3, 3, 6 and 8."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt import sincos
from jaxfilt.models.sensors import wrap
from jaxfilt.sincos import Parameters

DT = 1e-3
P0 = np.diag([1e-2, 30.0**2, 0.03**2, 0.03**2, 0.05**2, 0.06**2, 0.05**2, 0.02**2])


def noisy_turn(T, amplitude=1.0, noise=1e-3, seed=0):
    """A shaft that speeds up and slows down: angles (T,) and signals (T, 2)."""
    t = DT * np.arange(T)
    theta = 0.4 + 12.0 * t + 3.0 * np.sin(5.0 * t)
    rng = np.random.default_rng(seed)
    return theta, amplitude * np.stack([np.cos(theta), np.sin(theta)], 1) + noise * rng.normal(size=(T, 2))


def fixed(q=200.0**2, r=1e-6, amplitude=1.0, theta=0.4):
    return jf.models.sine_cosine(
        dt=DT, q=q, r=r, m0=np.array([theta, 0.0]), P0=P0[:2, :2], parameters=Parameters(amplitude=amplitude)
    )


# ------------------------------------------------------------------------------------------------- signals and inverse


@pytest.mark.parametrize(
    ("cause", "expected"),
    [
        ("offset_a", lambda t: -np.sin(t)),
        ("offset_b", lambda t: np.cos(t)),
        ("gain", lambda t: -0.5 * np.sin(2 * t)),
        ("quadrature", lambda t: 0.5 * (1 + np.cos(2 * t))),
        ("h3", lambda t: -np.sin(4 * t)),
        ("h5", lambda t: np.sin(4 * t)),
        ("h2_a", lambda t: -np.sin(t) * np.cos(2 * t)),
        ("h2_b", lambda t: np.cos(t) * np.cos(2 * t)),
    ],
)
def test_angle_error_of_each_cause_to_first_order(cause, expected):
    t, size = np.linspace(-3.1, 3.1, 400), 1e-3
    ys = np.asarray(sincos.signals(jnp.asarray(t), Parameters()._replace(**{cause: size})))
    error = np.arctan2(*ys.T[::-1]) - t
    # second order: with the constant that the expansion of each cause has at most
    assert np.abs(error - size * expected(t)).max() <= size**2 * (4.0 if cause.startswith("h") else 1.0)
    assert np.abs(error).max() > 0.4 * size


@pytest.mark.parametrize(("cause", "sign"), [("h3", 1.0), ("h5", 1.0)])
def test_radius_of_harmonics(cause, sign):
    t, size = np.linspace(-3.1, 3.1, 400), 1e-3
    ys = np.asarray(sincos.signals(jnp.asarray(t), Parameters()._replace(**{cause: size})))
    assert np.abs(np.hypot(*ys.T) - 1 - sign * size * np.cos(4 * t)).max() <= 4 * size**2


def test_correction_inverts_the_signals():
    t = jnp.linspace(-3.1, 3.1, 400)
    ellipse = Parameters(0.1, -0.2, 1.3, 0.1, 0.15)
    angle, radius = sincos.correct(sincos.signals(t, ellipse), ellipse)
    np.testing.assert_allclose(angle, t, atol=1e-12)
    np.testing.assert_allclose(radius, 1.0, atol=1e-12)
    both = Parameters(0.1, -0.2, 1.3, 0.1, 2e-3, 3e-3, 2e-3)
    angle, radius = sincos.correct(sincos.signals(t, both), both)
    second_order = (2e-3 + 3e-3 + 2e-3) ** 2
    assert np.abs(angle - t).max() < 3 * second_order
    assert np.abs(radius - 1).max() < 6 * second_order


def test_correction_has_finite_derivatives_at_the_centre():
    grads = jax.grad(lambda y: sum(x.sum() for x in sincos.correct(y, Parameters())))(jnp.zeros((3, 2)))
    assert (grads == 0).all()


def test_jacobian_of_the_self_calibrating_model():
    """The table of the specification, section 3 (d), against the automatic Jacobian."""
    model = jf.models.sine_cosine(dt=DT, q=1.0, r=1e-6, m0=np.zeros(8), P0=np.eye(8))
    x = np.array([0.7, 3.0, 0.02, -0.03, 1.2, 0.05, 0.04, 0.01])
    theta, _, _, _, A, gain, delta, h3 = x
    s, c, s3, c3 = np.sin, np.cos, np.sin(3 * theta), np.cos(3 * theta)
    d, gA, gB = theta + delta, 1 + gain / 2, 1 - gain / 2
    fA, fB = c(theta) + h3 * c3, s(d) - h3 * s(3 * d)
    slope = A * gB * (c(d) - 3 * h3 * c(3 * d))
    expected = np.array([
        [A * gA * (-s(theta) - 3 * h3 * s3), 0, 1, 0, gA * fA, A * fA / 2, 0, A * gA * c3],
        [slope, 0, 0, 1, gB * fB, -A * fB / 2, slope, -A * gB * s(3 * d)],
    ])  # fmt: skip
    np.testing.assert_allclose(jax.jacfwd(model.h)(jnp.asarray(x), None, None), expected, atol=1e-14)


# ---------------------------------------------------------------------------------------- the loop, alpha-beta and EKF


@functools.cache
def ekf_series(T=3000, amplitude=1.3):
    _, ys = noisy_turn(T, amplitude)
    model = fixed(amplitude=amplitude)
    return model, ys, jf.filter(jf.extended(model), ys, outputs=jf.everything)


def test_the_ekf_is_the_loop_with_its_gains():
    model, ys, out = ekf_series()
    A2, r = 1.3**2, 1e-6
    P = np.asarray(out.prediction.cov)
    alpha = A2 * P[:, 0, 0] / (A2 * P[:, 0, 0] + r)
    beta = DT * A2 * P[:, 0, 1] / (A2 * P[:, 0, 0] + r)
    inner = jf.alpha_beta(alpha, beta, dt=DT, m0=np.asarray(model.m0))
    loop = jf.filter(jf.phase_locked(inner, amplitude=1.3, normalize=False), ys)
    np.testing.assert_allclose(loop.mean[:, 0], out.mean[:, 0], rtol=0, atol=1e-10)
    np.testing.assert_allclose(loop.mean[:, 1], out.mean[:, 1], rtol=0, atol=1e-10 * np.abs(out.mean[:, 1]).max())
    assert float(np.abs(loop.mean[-1, 0] - noisy_turn(3000)[0][-1])) < 5e-3  # and both track


@pytest.mark.parametrize(
    ("q", "amplitude", "index"), [(200.0**2, 1.0, 0.2), (35.0**2, 2.0, 0.07), (9.0**2, 1.0, 0.009)]
)
def test_steady_gains_are_kalata_s_and_the_riccati_equation_s(q, amplitude, index):
    """The filter's own setting, that of the quoted gains (.31, .058), and that of the specification's criterion."""
    alpha, beta = (float(x) for x in jf.gains.kalata(index))
    linear = jf.models.linear_gaussian(
        F=np.array([[1.0, DT], [0.0, 1.0]]), H=np.array([[1.0, 0.0]]), R=np.array([[1e-6 / amplitude**2]]),
        m0=np.zeros(2), Q=q * np.outer([DT**2 / 2, DT], [DT**2 / 2, DT]), P0=P0[:2, :2],
    )  # fmt: skip
    P = np.asarray(jf.riccati(linear))
    steady = P[:, 0] / (P[0, 0] + 1e-6 / amplitude**2) * np.array([1.0, DT])
    np.testing.assert_allclose(steady, [alpha, beta], rtol=0, atol=1e-9)
    _, ys = noisy_turn(3000, amplitude)
    model = fixed(q=q, amplitude=amplitude)
    P = np.asarray(jf.filter(jf.extended(model), ys, outputs=jf.everything).prediction.cov)[-1]
    np.testing.assert_allclose(
        P[0] / (P[0, 0] + 1e-6 / amplitude**2) * np.array([1.0, DT]), [alpha, beta], rtol=0, atol=1e-9
    )
    if index == 0.009:
        np.testing.assert_allclose([alpha, beta], [0.12553144, 0.00841617], atol=5e-9)
    if index == 0.07:
        np.testing.assert_array_equal([round(alpha, 2), round(beta, 3)], [0.31, 0.058])


def test_impulse_response_of_the_loop():
    """From the error to the predicted angle: two integrators and a lead."""
    alpha, beta, T = 0.31, 0.058, 40
    filt = jf.alpha_beta(alpha, beta, dt=DT, m0=[0.0, 0.0])
    ys = jnp.zeros((T, 1)).at[0, 0].set(1.0)  # the first error is 1, and no further one is seen
    out = jf.filter(filt, ys, mask=jnp.arange(T) == 0, outputs=jf.everything)
    K, a = alpha + beta, alpha / (alpha + beta)
    response = np.zeros(T)
    for k in range(1, T):  # the difference equation of z^-1 K (1 - a z^-1) / (1 - z^-1)^2
        impulse = K * (k == 1) - K * a * (k == 2)
        response[k] = 2 * response[k - 1] - (response[k - 2] if k > 1 else 0.0) + impulse
    np.testing.assert_allclose(out.prediction.mean[:, 0], response, rtol=0, atol=1e-12 * response.max())


def test_lag_under_constant_acceleration():
    t = DT * np.arange(3000)
    theta = 0.5 * 50.0 * t**2
    ys = np.stack([np.cos(theta), np.sin(theta)], 1)
    filt = jf.phase_locked(jf.alpha_beta(0.31, 0.058, dt=DT, m0=np.zeros(2)))
    lag = theta[-1] - float(jf.filter(filt, ys, first_update_only=True).mean[-1, 0])
    # the lag of the estimate after the sample, alpha-beta's own; sin(e) is e to 1e-7 here
    np.testing.assert_allclose(lag, DT**2 * 50.0 * (1 - 0.31) / 0.058, rtol=1e-4)
    np.testing.assert_allclose(lag, 5.9483e-4, rtol=1e-4)
    np.testing.assert_allclose(float(jf.gains.steady_lag(0.31, 0.058, dt=DT, rate=50.0)[0]), lag, rtol=1e-4)


def test_converter_like_loop_gain_scales_with_the_amplitude():
    _, ys = noisy_turn(60, noise=0.0)
    m0 = np.array([0.3, 0.0])

    def run(ys, gains, normalize):
        filt = jf.phase_locked(jf.alpha_beta(*gains, dt=DT, m0=m0), normalize=normalize)
        return jf.filter(filt, ys, first_update_only=True).mean

    np.testing.assert_allclose(run(0.8 * ys, (0.31, 0.058), True), run(ys, (0.31, 0.058), True), rtol=1e-12)
    np.testing.assert_allclose(
        run(0.8 * ys, (0.31, 0.058), False), run(ys, (0.8 * 0.31, 0.8 * 0.058), False), rtol=0, atol=1e-10
    )


def test_self_calibration_without_variance_is_the_fixed_filter():
    _, ys = noisy_turn(3000)
    P = np.zeros((8, 8))
    P[:2, :2] = P0[:2, :2]
    own = jf.models.sine_cosine(dt=DT, q=200.0**2, r=1e-6, m0=np.array([0.4, 0, 0, 0, 1.0, 0, 0, 0]), P0=P)
    out = jf.filter(jf.extended(own), ys)
    ref = jf.filter(jf.extended(fixed()), ys)
    np.testing.assert_allclose(out.mean[:, :2], ref.mean, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(out.mean[:, 2:], np.broadcast_to([0, 0, 1, 0, 0, 0], (3000, 6)))


# ------------------------------------------------------------------------------------------------------------- ellipse


def ellipse(T=400, turns=1.0, noise=0.0, seed=0):
    values = np.array([0.12, -0.2, 1.3, 1.1, 0.1])
    t = np.linspace(0.3, 0.3 + 2 * np.pi * turns, T, endpoint=False)
    ys = np.stack([values[0] + values[2] * np.cos(t), values[1] + values[3] * np.sin(t + values[4])], 1)
    return values, ys + noise * np.random.default_rng(seed).normal(size=ys.shape)


@pytest.mark.parametrize("turns", [1.0, 0.8, 3.0])
@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e4])
def test_the_ellipse_is_recovered(turns, unit):
    values, ys = ellipse(turns=turns)
    fit = jf.fit_ellipse(unit * ys)
    length = np.array([unit] * 4 + [1.0])
    np.testing.assert_allclose(fit.values / length, values, rtol=0, atol=1e-9)
    assert fit.accepted
    assert fit.status == 0
    p = Parameters(*(jnp.asarray(x) for x in fit.parameters))
    _, radius = sincos.correct(jnp.asarray(unit * ys), p)
    np.testing.assert_allclose(radius, 1.0, atol=1e-9)


def test_standard_deviations_of_the_ellipse_are_those_of_repeated_fits():
    series = np.stack([ellipse(noise=0.01, seed=seed)[1] for seed in range(400)])
    fit = jax.vmap(jf.fit_ellipse)(series)
    np.testing.assert_allclose(np.std(fit.values, axis=0) / np.mean(fit.std, axis=0), 1.0, atol=0.15)
    bias = np.mean(fit.values, axis=0) - ellipse()[0]
    assert (np.abs(bias) < 5 * np.std(fit.values, axis=0) / 20 + 0.01**2 * 2).all()


def test_blocks_of_the_ellipse_see_slow_disturbances():
    _, ys = ellipse(turns=4.0, T=800)
    wander = np.repeat(np.random.default_rng(0).normal(size=(40, 2)), 20, axis=0)
    alone, together = jf.fit_ellipse(ys + 0.02 * wander), jf.fit_ellipse(ys + 0.02 * wander, block=20)
    assert (together.std[:2] > 2 * alone.std[:2]).all()


def test_a_missing_sample_is_left_out_of_the_ellipse():
    values, ys = ellipse()
    ys, mask = jf.mask_nan(np.where(np.arange(400)[:, None] % 7 == [[0, 3]], np.nan, ys))
    np.testing.assert_allclose(jf.fit_ellipse(ys, mask=mask).values, values, atol=1e-9)


# ---------------------------------------------------------------------------------------------------------- bad inputs


@pytest.mark.parametrize("missing", [(True, False), (False, True), (True, True)])
@pytest.mark.parametrize("which", ["loop", "EKF"])
def test_missing_channels_are_predicted(which, missing):
    """A missing channel: the loop needs both; the EKF uses what is left, and only coasts without either."""
    _, ys = noisy_turn(30)
    hole = ys.copy()
    hole[20][list(missing)] = np.nan
    inner = jf.alpha_beta(0.31, 0.058, dt=DT, m0=np.array([0.4, 12.0]))
    filt = jf.phase_locked(inner) if which == "loop" else jf.extended(fixed())
    with pytest.raises(ValueError, match=r"ys: ys\[20, \d\] is nan"):
        jf.filter(filt, hole)
    ys, mask = jf.mask_nan(hole)
    out = jf.filter(filt, ys, mask=mask, outputs=jf.everything)
    missed = bool(out.status[20] & int(jf.Status.MISSED))
    assert missed == (which == "loop" or all(missing))
    if missed:
        np.testing.assert_array_equal(out.mean[20], out.prediction.mean[20])
        assert out.mean[20, 1] == out.mean[19, 1]  # the rate is held


def test_the_pair_can_be_required_of_an_ekf_too():
    """`usable_where` with both: then one channel alone is not used."""
    _, ys = noisy_turn(30)
    ys[20, 0] = np.nan
    ys[25] *= 0.1
    ys, mask = jf.mask_nan(ys)
    filt = jf.usable_where(jf.extended(fixed()), strong)
    out = jf.filter(filt, ys, mask=mask.all(axis=1), outputs=jf.everything)
    for k in (20, 25):
        np.testing.assert_array_equal(out.mean[k], out.prediction.mean[k])
    assert out.status[25] & int(jf.Status.BOUND)


def strong(mean, y, u, dt):
    return jnp.broadcast_to(jnp.hypot(y[0], y[1]) >= 0.2, y.shape)


def test_arctan_holds_and_flags_missing_and_weak_samples():
    theta, ys = noisy_turn(60, noise=0.0)
    ys[10, 0], ys[0, 1], ys[20] = np.nan, np.nan, 0.1 * ys[20]
    out = sincos.arctan(ys)
    assert set(np.flatnonzero(~out.usable)) == {0, 10, 20}
    assert out.angle[10] == out.angle[9]
    assert out.angle[20] == out.angle[19]
    ok = np.asarray(out.usable)
    np.testing.assert_allclose(np.asarray(out.angle)[ok], theta[ok], atol=1e-12)
    assert np.isfinite(out.angle).all()


def test_a_lost_signal_is_flagged_and_predicted_by_the_loop():
    _, ys = noisy_turn(40)
    ys[20:25] *= 0.1
    out = jf.filter(jf.phase_locked(jf.alpha_beta(0.31, 0.058, dt=DT, m0=np.array([0.4, 12.0]))), ys,
                    outputs=jf.everything)  # fmt: skip
    assert set(np.flatnonzero(np.asarray(out.status) & int(jf.Status.BOUND))) == set(range(20, 25))
    np.testing.assert_array_equal(out.mean[20:25], out.prediction.mean[20:25])
    assert (out.extra["radius"][20:25] < 0.2).all()


def spinning(rate, T=40):
    theta = rate * np.arange(T)
    return theta, np.stack([np.cos(theta), np.sin(theta)], 1)


def test_a_rate_above_a_quarter_cycle_per_sample_is_flagged_by_the_loop():
    for rate, fast in ((1.4, False), (1.8, True)):
        _, ys = spinning(rate)
        filt = jf.phase_locked(jf.alpha_beta(0.31, 0.058, dt=DT, m0=np.array([-rate, rate / DT])))
        out = jf.filter(filt, ys)
        assert bool(out.extra["fast"][1:].all()) is fast
        assert bool((out.status[1:] & int(jf.Status.BOUND)).all()) is fast


def test_unwrapping_warns_above_a_quarter_and_raises_at_half_a_cycle_per_sample():
    sincos.arctan(spinning(1.5)[1])
    with pytest.warns(UserWarning, match="more than a quarter of a cycle per sample in 39 steps"):
        np.testing.assert_allclose(sincos.arctan(spinning(1.7)[1]).angle, spinning(1.7)[0], atol=1e-12)
    theta = np.cumsum(np.linspace(0, 4.0, 80))
    with pytest.raises(ValueError, match="half a cycle or more per sample"):
        sincos.arctan(np.stack([np.cos(theta), np.sin(theta)], 1))


def test_a_lost_track_is_flagged_and_can_be_taken_up_again():
    T = 120
    _, ys = noisy_turn(T)
    model = fixed(q=9.0**2)
    filt = jf.watched(jf.extended(model), limit=5.0, count=20)
    _, late = noisy_turn(T, seed=1)
    late[40:] = np.stack([np.cos(300.0 * DT * np.arange(80)), np.sin(300.0 * DT * np.arange(80))], 1)
    assert not jf.filter(filt, ys).extra["lost"][20:].any()
    out = jf.filter(filt, late)
    first = int(np.argmax(out.extra["lost"]))
    assert first >= 59  # not before twenty such samples
    assert out.extra["lost"].any()
    assert out.status[first] & int(jf.Status.BOUND)
    restarted = sincos.reacquire(jnp.asarray(late[first]), out.mean[first, 0])
    assert float(jnp.abs(restarted - out.mean[first, 0])) <= np.pi
    assert float(jnp.abs(wrap(restarted - jnp.arctan2(late[first, 1], late[first, 0])))) < 1e-12


def test_clipped_samples_are_masked():
    ys = np.array([[0.5, 0.2], [1.0, 0.1], [0.3, -1.0], [np.nan, 0.4]])
    out, mask = sincos.mask_clipped(ys, -1.0, 1.0)
    np.testing.assert_array_equal(mask, [[True, True], [False, True], [True, False], [False, True]])
    assert np.isfinite(out).all()
    with pytest.raises(ValueError, match="low: expected low < high"):
        sincos.mask_clipped(ys, 1.0, 1.0)


def test_calibrated_only_after_a_cycle():
    """At rest the standard deviations fall too; a cycle of motion is what makes them right."""
    P = P0.copy()

    def run(theta):
        ys = np.stack([0.02 + np.cos(theta), -0.01 + np.sin(theta)], 1)
        ys = ys + 1e-3 * np.random.default_rng(0).normal(size=ys.shape)
        m0 = np.array([theta[0], 0, 0, 0, 1.0, 0, 0, 0])
        model = jf.models.sine_cosine(
            dt=DT, q=200.0**2, r=1e-6, m0=m0, P0=P, drift=np.array([1e-9, 1e-9, 1e-5, 1e-9, 1e-9, 1e-9])
        )
        out = jf.filter(jf.extended(model), ys)
        return out, np.asarray(sincos.calibrated(out.mean, out.cov, P))

    t = DT * np.arange(2000)
    out, done = run(0.3 + 0.0 * t)
    assert not done.any()
    share = np.sqrt(np.diagonal(np.asarray(out.cov)[-1]) / np.diagonal(P))[[2, 3, 5, 6]]
    assert (share < 0.95).any()  # they moved along the prior
    out, done = run(0.3 + 2 * np.pi * t)  # two cycles
    assert done[-1]
    assert not done[:990].any()
    np.testing.assert_allclose(out.mean[-1, 2:4], [0.02, -0.01], atol=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"r": 0.0}, "r: expected a finite value > 0"),
        ({"r": -1e-6}, "r: expected a finite value > 0"),
        ({"r": np.diag([1e-6, 0.0])}, "r: expected a finite value > 0"),
        ({"dt": 0.0}, "dt: expected a finite value > 0"),
        ({"dt": -DT}, "dt: expected a finite value > 0"),
        ({"q": -1.0}, "q: expected a finite value >= 0"),
        ({"drift": 1e-9}, "drift: expected None with 2 states"),
        ({"m0": np.zeros(3)}, "m0: expected shape"),
        ({"parameters": Parameters(amplitude=0.0)}, "amplitude: expected a finite value > 0"),
        ({"m0": np.zeros(8), "P0": P0, "drift": -1.0}, "drift: expected a finite value >= 0"),
        ({"m0": np.zeros(8), "P0": P0, "drift": np.ones(5)}, "drift: expected a scalar or shape"),
    ],
)
def test_bad_models_are_refused(change, message):
    given = {"dt": DT, "q": 1.0, "r": 1e-6, "m0": np.zeros(2), "P0": P0[:2, :2]}
    with pytest.raises(ValueError, match=message):
        jf.models.sine_cosine(**{**given, **change})


@pytest.mark.parametrize("cycles", [0, -4, 2.5, True])
def test_cycles_must_be_a_positive_integer(cycles):
    with pytest.raises(ValueError, match="cycles: expected a positive integer"):
        sincos.mechanical(1.0, cycles)


@pytest.mark.parametrize("gains", [(0.0, 0.1), (2.1, 0.1), (0.5, 0.0), (0.5, 3.1)])
def test_unstable_gains_are_refused(gains):
    with pytest.raises(ValueError, match=r"alpha|beta"):
        jf.phase_locked(jf.alpha_beta(*gains, dt=DT, m0=[0.0, 0.0]))


@pytest.mark.parametrize(("change", "name"), [({"amplitude": 0.0}, "amplitude"), ({"floor": -0.1}, "floor")])
def test_bad_options_of_the_loop_are_refused(change, name):
    with pytest.raises(ValueError, match=f"{name}: expected"):
        jf.phase_locked(jf.alpha_beta(0.3, 0.05, dt=DT, m0=[0.0, 0.0]), **change)


@pytest.mark.parametrize(("limit", "count"), [(0.0, 20), (5.0, 0), (5.0, 1.5)])
def test_bad_options_of_the_watch_are_refused(limit, count):
    with pytest.raises(ValueError, match=r"limit|count"):
        jf.watched(jf.extended(fixed()), limit=limit, count=count)
    bare = jf.watched(jf.alpha_beta(0.3, 0.05, dt=DT, m0=[0.0] * 2))
    with pytest.raises(ValueError, match="innovation_cov"):
        jf.filter(bare, np.zeros((3, 1)))


@pytest.mark.parametrize(
    ("ys", "message"),
    [
        (ellipse(turns=0.6)[1], "got 0.586"),
        (
            np.stack([np.cosh(np.linspace(-2, 2, 50)), np.sinh(np.linspace(-2, 2, 50))], 1),
            "not an ellipse|of the cycle",
        ),
        (np.ones((30, 2)), "not an ellipse|of the cycle"),
        (np.zeros((30, 2)), "not an ellipse|of the cycle"),
        (ellipse(T=5)[1], "at least 6 samples"),
        (np.full((30, 2), np.nan), "expected finite values"),
        (np.zeros((30, 3)), "expected shape"),
    ],
)
def test_bad_ellipses_are_refused(ys, message):
    with pytest.raises(ValueError, match=message):
        jf.fit_ellipse(ys)


def test_an_uncertain_ellipse_is_flagged():
    fit = jf.fit_ellipse(ellipse(T=12, noise=0.4, seed=3)[1])
    assert not fit.accepted
    assert fit.status == int(jf.Status.BOUND)
    assert (fit.relative_std > 0.1).any()


def test_under_a_transformation_a_bad_ellipse_is_flagged_and_finite():
    bad = np.stack([ellipse(turns=0.5, T=30)[1], np.zeros((30, 2)), ellipse(T=30)[1]])
    fit = jax.vmap(jf.fit_ellipse)(bad)
    np.testing.assert_array_equal(fit.accepted, [False, False, True])
    assert ((fit.status & int(jf.Status.SINGULAR)) != 0).tolist() == [True, True, False]
    assert np.isfinite(fit.values).all()


def test_losses_refuse_short_series():
    ys = jnp.ones((15, 2))
    with pytest.raises(ValueError, match="block"):
        sincos.radius_loss(Parameters(), ys)
    with pytest.raises(ValueError, match="stride"):
        sincos.smoothness_loss(Parameters(), ys, block=10)


# ----------------------------------------------------------------------------------------------------------- gradients


@pytest.mark.parametrize("loss", ["supervised", "radius", "smoothness"])
def test_gradients_of_the_losses(loss):
    theta, ys = noisy_turn(600)
    ys = jnp.asarray(ys).at[:, 0].add(0.02)

    def value(v):
        p = Parameters(v[0], v[1], 1.0, v[2], v[3], v[4], v[5])
        if loss == "supervised":
            return sincos.supervised_loss(p, ys, jnp.asarray(theta))
        return sincos.radius_loss(p, ys) if loss == "radius" else sincos.smoothness_loss(p, ys)

    at = jnp.array([0.01, -0.01, 0.02, 0.01, 0.004, -0.003])
    check_gradient(value, at, 1e-5)


def check_gradient(f, at, h):
    """One compiled function gives both, the gradient and the values for central differences."""
    both = jax.jit(jax.value_and_grad(f))
    numeric = jnp.stack([(both(at + h * e)[0] - both(at - h * e)[0]) / (2 * h) for e in jnp.eye(len(at))])
    assert (jnp.abs(numeric) > 0).all()
    np.testing.assert_allclose(both(at)[1], numeric, rtol=1e-5, atol=1e-6 * float(jnp.abs(numeric).max()))


def test_gradients_of_gains_and_noise_through_the_filters():
    """Angle error with respect to (alpha, beta), and likelihood with respect to (log q, log r, log drift)."""
    theta, ys = noisy_turn(80)
    ys = jnp.asarray(ys)

    def error(v):
        alpha = jax.nn.sigmoid(v[0])
        beta = (4 - 2 * alpha) * jax.nn.sigmoid(v[1])
        filt = jf.phase_locked(jf.alpha_beta(alpha, beta, dt=DT, m0=jnp.array([0.4, 0.0])))
        return jnp.mean(jnp.sin(jf.filter(filt, ys).mean[:, 0] - theta) ** 2)

    def nll(v):
        m0 = jnp.zeros(8).at[0].set(0.4).at[4].set(1.0)
        model = jf.models.sine_cosine(
            dt=DT, q=jnp.exp(v[0]), r=jnp.exp(v[1]), m0=m0, P0=jnp.asarray(P0), drift=jnp.exp(v[2])
        )
        return -jf.filter(jf.extended(model), ys).log_lik.sum()

    check_gradient(error, jnp.array([-0.8, -4.0]), 1e-4)
    check_gradient(nll, jnp.array([10.0, -13.0, -18.0]), 1e-4)
