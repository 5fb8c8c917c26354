"""The attitude filters: naive references, limits, symmetry, gradients, bad inputs (specification S4d)."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import jaxfilt as jf
from experiments.attitude import scenarios
from experiments.benchmarks.attitude import numpy_run
from jaxfilt.filters.attitude import angles
from jaxfilt.linalg import rotation, skew

pytestmark = pytest.mark.xdist_group("attitude")

DT, G, STEPS = 0.01, 9.81, 500
FACTORIES = (
    jf.attitude, jf.attitude_peak, jf.attitude_switched, jf.attitude_velocity, jf.complementary, jf.mahony, jf.madgwick,
)  # fmt: skip
EKFS = FACTORIES[:4]


@functools.cache
def recording(test="A"):
    """Some seconds of a simulated test: gyro, accelerometer, vertical axis; rest first, then motion."""
    run = scenarios.draw(jax.random.key(5), test)[0]
    begin = round({"A": 1.0, "B": 9.0}[test] / scenarios.DT)
    return tuple(np.asarray(x[begin : begin + STEPS]) for x in (run.gyr, run.acc, run.axis))


def estimate(filt, gyr, acc, **options):
    return jf.filter(filt, jnp.asarray(acc), u=jnp.asarray(gyr), **options)


def cross(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def naive_peak(gyr, acc, rho, decay, kappa):
    """Variant E, literally."""
    H = np.hstack([G * np.eye(3), np.zeros((3, 3))])
    x, P, a, m = np.r_[acc[0] / np.linalg.norm(acc[0]), np.zeros(3)], np.diag([1e-2] * 3 + [1e-4] * 3), np.zeros(3), 0.0
    means = []
    for w, y in zip(gyr, acc, strict=True):
        Z, b = x[:3], x[3:]
        Phi, Q = np.eye(6), 1e-12 * np.eye(6)
        Phi[:3, :3], Phi[:3, 3:] = scipy.linalg.expm(-DT * cross(w - b)), -DT * cross(Z)
        Q[:3, :3] = 1e-6 * Phi[:3, 3:] @ Phi[:3, 3:].T
        Z, P = Phi[:3, :3] @ Z, Phi @ P @ Phi.T + Q
        seen = y - G * Z
        m = max(a @ a, seen @ seen, decay**2 * m)
        R = (1e-4 + rho * m) * np.eye(3)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x = np.r_[Z, b] + K @ (seen - kappa * a)
        P = (np.eye(6) - K @ H) @ P
        x[:3] /= np.linalg.norm(x[:3])
        a = y - G * x[:3]
        means.append(x.copy())
    return np.array(means)


def naive_velocity(gyr, acc, velocity_var):
    """Variant V with the transition matrix of the specification, in one piece."""
    H = np.eye(9)[6:]
    x = np.r_[acc[0] / np.linalg.norm(acc[0]), np.zeros(6)]
    P = np.diag([1e-3] * 3 + [1e-4] * 3 + [1e-2] * 3)
    means = []
    for w, y in zip(gyr, acc, strict=True):
        Z, b, v = x[:3], x[3:6], x[6:]
        F, SZ, Sv = scipy.linalg.expm(-DT * cross(w - b)), cross(Z), cross(v)
        Phi, Q = np.eye(9), np.zeros((9, 9))
        Phi[:3, :3], Phi[:3, 3:6] = F, -DT * SZ
        Phi[6:, :3], Phi[6:, 3:6], Phi[6:, 6:] = -G * DT * F, G * DT**2 * SZ - DT * Sv, F
        # The gyro's noise moves Z, v and, through Z, v again, all by one draw: the columns of its bias.
        by_gyro = Phi[:, 3:6] - np.eye(9)[:, 3:6]
        Q = 1e-6 * by_gyro @ by_gyro.T
        Q[3:6, 3:6] += 1e-12 * np.eye(3)
        Q[6:, 6:] += DT**2 * 1e-4 * np.eye(3)
        Z = F @ Z
        x, P = np.r_[Z, b, F @ v + DT * (y - G * Z)], Phi @ P @ Phi.T + Q
        S = H @ P @ H.T + velocity_var * np.eye(3)
        K = P @ H.T @ np.linalg.inv(S)
        x, P = x - K @ x[6:], (np.eye(9) - K @ H) @ P
        length = np.linalg.norm(x[:3])
        x[:3] /= length
        M = np.eye(9)
        M[:3, :3] = (np.eye(3) - np.outer(x[:3], x[:3])) / length
        P = M @ P @ M.T
        means.append(x.copy())
    return np.array(means)


@functools.cache
def estimated(factory, test="B"):
    """With the factory's own parameters (E: kappa = 0.2)."""
    gyr, acc, _ = recording(test)
    options = {"kappa": 0.2, "rho": 0.03, "decay": 0.9} if factory is jf.attitude_peak else {}
    return estimate(factory(dt=DT, **options), gyr, acc)


def test_the_scan_equals_plain_numpy():
    """Criterion 1, against implementations that share no code."""
    gyr, acc, _ = recording("B")
    np.testing.assert_allclose(estimated(jf.attitude).mean, numpy_run(gyr, acc, DT)[0], atol=1e-12)
    np.testing.assert_allclose(estimated(jf.attitude).cov[-1], numpy_run(gyr, acc, DT)[1], atol=1e-14)


def test_the_variants_equal_plain_numpy():
    gyr, acc, _ = recording("B")
    np.testing.assert_allclose(estimated(jf.attitude_peak).mean, naive_peak(gyr, acc, 0.03, 0.9, 0.2), atol=1e-11)
    np.testing.assert_allclose(estimated(jf.attitude_velocity).mean, naive_velocity(gyr, acc, 0.1), atol=1e-11)


@pytest.mark.parametrize("factory", EKFS, ids=lambda f: f.__name__)
def test_axis_is_a_unit_vector_and_what_is_left_is_acceleration(factory):
    """Criterion 3."""
    _, acc, axis = recording("B")
    out = estimated(factory)
    np.testing.assert_allclose(np.linalg.norm(out.mean[:, :3], axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(out.extra["a_ext"], acc - G * out.mean[:, :3], atol=1e-12)
    np.testing.assert_allclose(np.sin(out.extra["pitch"]), -out.mean[:, 0], atol=1e-12)
    assert not out.status.any()
    assert np.rad2deg(jf.metrics.tilt_error(out.mean, axis)).max() < 12


@pytest.mark.parametrize("factory", FACTORIES, ids=lambda f: f.__name__)
def test_turned_sensors_turn_the_estimates(factory):
    """Criterion 2: by any fixed rotation. And the frames: axes that point down with the same reading reversed.

    Madgwick's gradient is divided by its length in four dimensions, of which the part along the quaternion depends on
    the axes: only that filter is not turned.
    """
    gyr, acc, _ = recording("B")
    R = np.asarray(rotation(jnp.array([0.7, -1.1, 0.4])))
    out, turned = estimated(factory), None
    options = {"kappa": 0.2, "rho": 0.03, "decay": 0.9} if factory is jf.attitude_peak else {}
    turned = estimate(factory(dt=DT, **options), gyr @ R.T, acc @ R.T)
    for part in range(0 if factory is jf.madgwick else out.mean.shape[1] // 3):
        k = slice(3 * part, 3 * part + 3)
        np.testing.assert_allclose(turned.mean[:, k], out.mean[:, k] @ R.T, atol=1e-10)
    if factory is not jf.madgwick:
        np.testing.assert_allclose(turned.extra["a_ext"], out.extra["a_ext"] @ R.T, atol=1e-9)
    down = estimate(factory(dt=DT, frame="down", **options), gyr, -acc)
    np.testing.assert_allclose(down.mean[:, :6], out.mean[:, :6], atol=1e-12)
    np.testing.assert_allclose(down.extra["a_ext"], -out.extra["a_ext"], atol=1e-11)


@pytest.mark.parametrize(
    ("bias_q", "expected"),
    [
        (1e-8, (4.60904537e-8, 9.96504214e-8, 4.62521412e-7)),
        (1e-12, (1.1124607e-8, 1.0138967e-9, 1.0972131e-9)),
    ],
)
def test_at_rest_the_covariance_is_that_of_the_riccati_equation(bias_q, expected):
    """Criterion 4, with SciPy's solution beside the figures of the specification."""
    F, H, R = np.array([[1, DT], [0, 1]]), np.array([[G, 0.0]]), np.array([[1e-4]])
    P = scipy.linalg.solve_discrete_are(F.T, H.T, np.diag([DT**2 * 1e-6, bias_q]), R)
    P = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)
    np.testing.assert_allclose([P[0, 0], abs(P[0, 1]), P[1, 1]], expected, rtol=1e-6)
    filt = jf.attitude(dt=DT, kappa=0.0, bias_q=bias_q)
    out = at_rest(filt, 20_000)
    found = (out[0, 0], abs(out[0, 4]), out[4, 4])
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def _final(state, info):
    return state.mean, state.a_ext


@functools.partial(jax.jit, static_argnums=1)
def at_rest(filt, steps):
    """The covariance after a rest."""
    acc = jnp.broadcast_to(jnp.array([0.0, 0.0, G]), (steps, 3))
    inputs = jf.inputs(acc, u=jnp.zeros_like(acc))
    state = filt.init(jax.tree.map(lambda x: x[0], inputs))
    return jf.scan(filt, state, inputs, outputs=_final)[0].cov


@functools.cache
def noise_free():
    options = (("gyr_std", 0.0), ("acc_std", 0.0), ("bias0", (0.0, 0.0, 0.0)), ("bias_walk", 0.0))
    return scenarios.draw(jax.random.key(1), "A", options)[0]


def _axis(state, info):
    del state
    return info.mean[:3]


def tilt(filt, run):
    return np.rad2deg(
        jf.metrics.tilt_error(estimate(filt, run.gyr, run.acc, outputs=_axis, first_update_only=True), run.axis)
    )


def test_the_exact_step_integrates_a_perfect_gyro():
    """Criteria 5 and 7: over the 50 s of test A, without the accelerometer; Euler's step drifts.

    R = 1e16, since at 1e12 the uncertainty of the bias still lets 2e-9 degrees in.
    """
    run = noise_free()
    start = {"dt": DT, "z0": run.axis[0], "bias_q": 1e-12}
    blind = {"acc_var": 1e16, "kappa": 0.0, **start}
    assert tilt(jf.attitude(**blind), run).max() < 1e-10
    assert tilt(jf.attitude(prop="euler", **blind), run).max() > 0.1
    assert tilt(jf.attitude_velocity(velocity_var=1e16, **start), run).max() < 1e-10


def test_a_tilt_error_stays_only_if_all_acceleration_does():
    """Criterion 6: kappa = 1 and c = 0 at rest. The first update still sees gravity."""
    acc = np.tile([0.0, 0.0, G], (STEPS, 1))
    z0 = [np.sin(0.1), 0.0, np.cos(0.1)]
    level = np.tile([0.0, 0.0, 1.0], (STEPS, 1))
    left = {}
    for kappa in (1.0, 0.5):
        filt = jf.attitude(dt=DT, kappa=kappa, c=0.0, z0=z0, P0=np.diag([1e-7] * 3 + [1e-12] * 3))
        left[kappa] = np.asarray(jf.metrics.tilt_error(estimate(filt, 0.0 * acc, acc).mean, level))
    assert left[1.0][0] > 1e-3
    assert abs(left[1.0][-1] - left[1.0][0]) < 1e-6
    assert left[0.5][-1] < 0.1 * left[0.5][0]


GRADIENTS = {
    jf.attitude: ({"kappa": 0.1, "c": 0.3, "acc_var": 1e-3, "bias_q": 1e-11}, 1e-5, 1e-8),
    jf.attitude_peak: ({"kappa": 0.2, "rho": 0.05, "decay": 0.9, "acc_var": 1e-3, "bias_q": 1e-11}, 1e-5, 1e-6),
    jf.attitude_velocity: ({"gyro_var": 1e-6, "velocity_var": 0.1, "bias_q": 1e-9}, 1e-4, 2e-5),
}


@pytest.mark.parametrize(
    "factory", [jf.attitude, pytest.param(jf.attitude_peak, marks=pytest.mark.slow), jf.attitude_velocity]
)
def test_gradients_of_the_tilt_error_are_those_of_differences(factory):
    """Section 6: the loss is on the axis, parameters on a log scale. Relative to the largest component."""
    start, h, tolerance = GRADIENTS[factory]
    gyr, acc, axis = map(jnp.asarray, recording("B"))
    z = jnp.log(jnp.array(list(start.values())))

    def loss(z):
        filt = factory(dt=DT, **dict(zip(start, jnp.exp(z), strict=True)))
        return jnp.mean((jf.filter(filt, acc, u=gyr, outputs=_axis) - axis)[100:] ** 2)

    reverse = jax.jit(jax.grad(loss))(z)
    shifts = h * jnp.concatenate([jnp.eye(len(z)), -jnp.eye(len(z))])
    values = jax.jit(jax.vmap(loss))(z[None, :] + shifts)
    numeric = (values[: len(z)] - values[len(z) :]) / (2 * h)
    assert np.abs(reverse - numeric).max() <= tolerance * np.abs(numeric).max()


@pytest.mark.parametrize("factory", [jf.attitude, *(pytest.param(f, marks=pytest.mark.slow) for f in EKFS[1:])])
def test_gradients_are_finite_upright_and_at_no_acceleration(factory):
    """arcsin, atan2 and the norm have no derivative there, and the angles are carried along."""
    acc = jnp.tile(jnp.array([[-G, 0.0, 0.0]]), (20, 1))

    def loss(acc_var):
        out = jf.filter(factory(dt=DT, acc_var=acc_var), acc, u=jnp.zeros_like(acc))
        return out.mean.sum() + out.extra["roll"].sum() + out.extra["pitch"].sum() + out.extra["a_ext"].sum()

    assert np.isfinite(jax.jit(jax.grad(loss))(1e-4))


@pytest.mark.parametrize("factory", [jf.attitude, pytest.param(jf.attitude_velocity, marks=pytest.mark.slow)])
def test_single_precision_is_finite_and_close(factory):
    """float32, for which P reaches 1e-9: within 0.02 degrees of float64 over these seconds."""
    gyr, acc, _ = recording("A")
    out = estimate(factory(dt=DT), np.float32(gyr), np.float32(acc))
    assert out.mean.dtype == jnp.float32
    assert np.isfinite(out.cov).all()
    eigenvalues = np.linalg.eigvalsh(np.asarray(out.cov, float))
    assert (eigenvalues[:, 0] >= -1e-6 * eigenvalues[:, -1]).all()
    close = jf.metrics.tilt_error(np.asarray(out.mean, float), estimated(factory, "A").mean)
    assert np.rad2deg(close).max() < 0.02


# --- bad inputs -------------------------------------------------------------------------------------------------------


def test_a_missed_sample_is_predicted_only():
    """Masked: the axis turns with the gyro, and of the acceleration kappa times is left. Unmasked NaN: refused."""
    gyr, acc, _ = recording("B")
    holes = acc.copy()
    holes[200] = np.nan
    with pytest.raises(ValueError, match=r"ys\[200, 0\] is nan"):
        estimate(jf.attitude(dt=DT), gyr, holes)
    mask = np.isfinite(holes)
    out = estimate(jf.attitude(dt=DT), gyr, holes, mask=mask)
    expected = np.asarray(rotation(-DT * (jnp.asarray(gyr[200]) - out.mean[199, 3:]))) @ np.asarray(out.mean[199, :3])
    np.testing.assert_allclose(out.mean[200, :3], expected, atol=1e-12)
    np.testing.assert_allclose(out.extra["a_ext"][200], 0.1 * np.asarray(out.extra["a_ext"][199]), atol=1e-12)
    assert out.status[200] == int(jf.Status.MISSED)
    traced = jax.jit(lambda y: jf.filter(jf.attitude(dt=DT), y, u=jnp.asarray(gyr)))(holes)
    assert traced.status[200] == int(jf.Status.NONFINITE)
    assert np.isfinite(traced.mean).all()


def test_a_gyro_reading_that_is_not_finite():
    gyr, acc, _ = recording("A")
    gyr = gyr.copy()
    gyr[[7, 8], 1] = np.nan
    with pytest.raises(ValueError, match=r"gyr: gyr\[7, 1\] is not finite"):
        jf.imu_inputs(gyr, acc)
    held = jf.imu_inputs(gyr, acc, gyr_hold=True)
    np.testing.assert_array_equal(held["u"][8, 1], gyr[6, 1])
    with pytest.raises(ValueError, match="first reading"):
        jf.imu_inputs(gyr[7:], acc[7:], gyr_hold=True)
    out, direct = jf.filter(jf.attitude(dt=DT), **held), estimate(jf.attitude(dt=DT), gyr, acc)
    np.testing.assert_array_equal(out.mean, direct.mean)  # the filter holds too, and says so
    assert np.flatnonzero(direct.status & int(jf.Status.NONFINITE)).tolist() == [7, 8]


@pytest.mark.parametrize("length", [0.4, 1.6])
def test_a_first_sample_that_is_not_at_rest(length):
    gyr, acc, _ = recording("A")
    acc = acc.copy()
    acc[0] *= length
    with pytest.raises(ValueError, match="the first sample has a length of"):
        jf.imu_inputs(gyr, acc)
    out = estimate(jf.attitude(dt=DT), gyr, acc)
    assert np.flatnonzero(out.status & int(jf.Status.BOUND)).tolist() == [0]
    given = jf.filter(jf.attitude(dt=DT, z0=[0.0, 0.0, 2.0]), **jf.imu_inputs(gyr, acc, at_rest=False))
    assert not given.status.any()


def test_a_first_sample_that_is_missing():
    gyr, acc, _ = recording("A")
    mask = np.arange(len(acc)) > 0
    with pytest.raises(ValueError, match="the first sample has a length of nan g"):
        jf.imu_inputs(gyr, acc, mask=mask)
    out = estimate(jf.attitude(dt=DT), gyr, acc, mask=mask)
    assert out.status[0] == int(jf.Status.MISSED | jf.Status.BOUND)
    assert np.isfinite(out.mean).all()


@pytest.mark.parametrize(
    ("factory", "options", "message"),
    [
        (jf.attitude, {"kappa": 1.1}, r"kappa: expected a value in \[0, 1\]"),
        (jf.attitude, {"kappa": -0.1}, r"kappa: expected a value in \[0, 1\]"),
        (jf.attitude, {"c": -1.0}, "c: expected a finite value >= 0"),
        (jf.attitude, {"gyro_var": 0.0}, "gyro_var: expected a finite value > 0"),
        (jf.attitude, {"acc_var": -1e-4}, "acc_var: expected a finite value > 0"),
        (jf.attitude, {"bias_var": 0.0}, "bias_var: expected a finite value > 0"),
        (jf.attitude, {"bias_q": np.nan}, "bias_q: expected a finite value > 0"),
        (jf.attitude, {"dt": 0.0}, "dt: expected a finite value > 0"),
        (jf.attitude, {"gravity": -9.81}, "gravity: expected a finite value > 0"),
        (jf.attitude, {"bias_limit": 0.0}, "bias_limit: expected a finite value > 0"),
        (jf.attitude, {"frame": "NED"}, 'frame: expected "up" or "down"'),
        (jf.attitude, {"prop": "rk4"}, 'prop: expected "exact" or "euler"'),
        (jf.attitude, {"z0": [0.0, 0.0, 0.0]}, "z0: expected a direction"),
        (jf.attitude, {"z0": [0.0, 1.0]}, r"z0: expected shape \(3,\)"),
        (jf.attitude, {"P0": -np.eye(6)}, "P0: expected a positive semidefinite matrix"),
        (jf.attitude_velocity, {"P0": np.eye(6)}, r"P0: expected shape \(9, 9\)"),
        (jf.attitude_velocity, {"velocity_var": 0.0}, "velocity_var: expected a finite value > 0"),
        (jf.attitude_peak, {"rho": -1.0}, "rho: expected a finite value >= 0"),
        (jf.attitude_peak, {"decay": 1.5}, r"decay: expected a value in \[0, 1\]"),
        (jf.attitude_switched, {"threshold": 0.0}, "threshold: expected a finite value > 0"),
        (jf.attitude_switched, {"width": -1.0}, "width: expected a finite value > 0"),
        (jf.complementary, {"tau": 0.0}, "tau: expected a finite value > 0"),
        (jf.mahony, {"proportional": 0.0}, "proportional: expected a finite value > 0"),
        (jf.madgwick, {"beta": 0.0}, "beta: expected a finite value > 0"),
        (jf.madgwick, {"dt": -1.0}, "dt: expected a finite value > 0"),
    ],
)
def test_bad_parameters_are_refused(factory, options, message):
    with pytest.raises(ValueError, match=message):
        factory(**{"dt": DT, **options})


def test_bad_shapes_and_scales_are_refused():
    gyr, acc, _ = recording("A")
    for bad in ((gyr[:, :2], acc), (gyr[:9], acc), (gyr[0], acc[0])):
        with pytest.raises(ValueError, match=r"gyr: expected"):
            jf.imu_inputs(*bad)
    with pytest.raises(ValueError, match="mask: expected shape"):
        jf.imu_inputs(gyr, acc, mask=np.ones(4, bool))
    with pytest.raises(ValueError, match="ys: expected 3 components"):
        jf.filter(jf.attitude(dt=DT), acc[:, :2], u=gyr)
    with pytest.raises(ValueError, match=r"u: expected the gyro's reading \(3,\)"):
        jf.filter(jf.attitude(dt=DT), acc)
    with pytest.raises(ValueError, match="r_scale: a filter with fixed gains has no noise"):
        estimate(jf.mahony(dt=DT), gyr, acc, r_scale=2.0)


def test_wrong_units_are_warned_of():
    gyr, acc, _ = recording("A")
    with pytest.warns(UserWarning, match="is it in g"):
        jf.imu_inputs(gyr, acc / G, at_rest=False)
    with pytest.warns(UserWarning, match="is it in deg/s"):
        jf.imu_inputs(gyr * 1e4, acc)


def test_an_axis_that_vanishes_is_kept():
    """An update that all but cancels Z: a reading of opposite direction with full weight."""
    filt = jf.attitude(dt=DT, z0=[0.0, 0.0, 1.0], P0=np.diag([1.0] * 3 + [1e-4] * 3), acc_var=G**2, kappa=0.0)
    acc = np.tile([0.0, 0.0, -G], (1, 1))
    out = estimate(filt, 0 * acc, acc)
    np.testing.assert_array_equal(out.mean[0, :3], [0.0, 0.0, 1.0])
    assert out.status[0] == int(jf.Status.BOUND)


def test_upright_the_last_roll_is_kept():
    """Pitched to within 1e-6 of a right angle, and not quite so far; and the step says so."""
    for off, expected, flagged in ((5e-7, 0.7, True), (5e-6, 0.3, False)):
        Z = jnp.array([-np.cos(off), np.sin(off) * np.sin(0.3), np.sin(off) * np.cos(0.3)])
        roll, pitch, undefined = angles(Z, jnp.asarray(0.7))
        np.testing.assert_allclose((roll, pitch), (expected, np.pi / 2), atol=1e-5)
        assert undefined == flagged
    out = estimate(jf.attitude(dt=DT), np.zeros((1, 3)), np.array([[-G, 0.0, 0.0]]))
    assert out.status[0] == int(jf.Status.BOUND)
    assert (out.extra["roll"][0], out.extra["pitch"][0]) == (0.0, np.pi / 2)


def test_a_bias_limit_clips():
    gyr, acc, _ = recording("A")
    out = estimate(jf.attitude(dt=DT, bias_limit=0.005), gyr + 0.1, acc)
    assert np.abs(out.mean[:, 3:]).max() == 0.005
    assert (out.status & int(jf.Status.BOUND)).any()


# --- fixed gains and the generator ------------------------------------------------------------------------------------


def test_fixed_gains_by_hand():
    """One step from a known axis at rest, tilted by 0.1 rad."""
    z0, acc = [np.sin(0.1), 0.0, np.cos(0.1)], np.array([[0.0, 0.0, G]])
    expected = {
        "complementary": np.arctan2(np.sin(0.1) * (1 - DT / 2.01), np.cos(0.1) + DT / 2.01 * (1 - np.cos(0.1))),
        "mahony": 0.1 - DT * 0.74 * np.sin(0.1),
        # To the second order of the step. In four dimensions the gradient has 2 tan(0.05) of its tangential part along
        # the quaternion, without effect.
        "madgwick": 0.1 - 2 * DT * 0.12 / np.sqrt(1 + 4 * np.tan(0.05) ** 2),
    }
    for factory, tolerance in ((jf.complementary, 1e-12), (jf.mahony, 1e-12), (jf.madgwick, (0.12 * DT) ** 2)):
        out = estimate(factory(dt=DT, z0=z0), 0 * acc, acc)
        angle = np.arctan2(out.mean[0, 0], out.mean[0, 2])
        np.testing.assert_allclose(angle, expected[factory.__name__], atol=tolerance)
    bias = estimate(jf.mahony(dt=DT, z0=z0, integral=0.5), 0 * acc, acc).mean[0, 3:]
    np.testing.assert_allclose(bias, [0.0, -0.5 * DT * np.sin(0.1), 0.0], atol=1e-12)


def test_generator_measures_what_happens():
    """A steady turn about the vertical on a lever: rate, centripetal acceleration, gravity; and the sensor's errors."""
    T, K, dt, rate, arm = 50, 10, 0.01, 2.0, 0.3
    t = np.arange((T - 1) * K + 1) * dt / K
    zero = np.zeros_like(t)
    C = jf.simulate.euler_attitude(zero, zero, rate * t)
    quiet = {"gyr_std": 0.0, "acc_std": 0.0, "bias0": (0.0, 0.0, 0.0), "bias_walk": 0.0}
    still = np.zeros((T, 3))
    run = jf.simulate.imu(C, still, jax.random.key(0), dt=dt, lever=(arm, 0.0, 0.0), **quiet)
    np.testing.assert_allclose(run.gyr, np.tile([0, 0, rate], (T, 1)), atol=1e-9)
    np.testing.assert_allclose(run.acc[1:-1], np.tile([-(rate**2) * arm, 0, G], (T - 2, 1)), atol=1e-5)
    given = {**quiet, "acc_bias": (0.1, 0.0, 0.0), "acc_matrix": 2 * np.eye(3), "gyr_matrix": 3 * np.eye(3)}
    off = jf.simulate.imu(C, still, jax.random.key(0), dt=dt, frame="down", **given)
    np.testing.assert_allclose(off.acc, np.tile([0.1, 0, -2 * G], (T, 1)), atol=1e-12)
    np.testing.assert_allclose(off.gyr, 3 * run.gyr, atol=1e-12)
    noisy = jf.simulate.imu(C, still, jax.random.key(0), dt=dt, bias_walk=0.1)
    assert 0.05 < np.std(np.diff(noisy.bias, axis=0)) < 0.2
    np.testing.assert_array_equal(noisy.bias[0], [0.01, -0.007, 0.004])
    with pytest.raises(ValueError, match="attitude: expected"):
        jf.simulate.imu(C[:-1], still, jax.random.key(0), dt=dt)


def test_axes_of_quaternions_and_angles():
    roll, pitch, yaw = (np.array([x]) for x in (0.3, -0.5, 1.1))
    C = np.asarray(jf.simulate.euler_attitude(roll, pitch, yaw))[0]
    half = [
        np.cos(yaw / 2) * np.cos(pitch / 2) * np.cos(roll / 2) + np.sin(yaw / 2) * np.sin(pitch / 2) * np.sin(roll / 2),
        np.cos(yaw / 2) * np.cos(pitch / 2) * np.sin(roll / 2) - np.sin(yaw / 2) * np.sin(pitch / 2) * np.cos(roll / 2),
        np.cos(yaw / 2) * np.sin(pitch / 2) * np.cos(roll / 2) + np.sin(yaw / 2) * np.cos(pitch / 2) * np.sin(roll / 2),
        np.sin(yaw / 2) * np.cos(pitch / 2) * np.cos(roll / 2) - np.cos(yaw / 2) * np.sin(pitch / 2) * np.sin(roll / 2),
    ]
    np.testing.assert_allclose(jf.simulate.axis_of_quaternion(np.concatenate(half)), C[2], atol=1e-15)
    turned = np.asarray(rotation(jnp.array([0.0, 1e-6, 0.0]))) @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(jf.metrics.tilt_error(turned, np.array([0.0, 0.0, 2.0])), 1e-6, rtol=1e-9)
    np.testing.assert_allclose(
        rotation(jnp.array([0.2, -0.1, 0.4])), scipy.linalg.expm(skew(jnp.array([0.2, -0.1, 0.4])))
    )
