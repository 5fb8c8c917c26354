"""Bearing and Doppler shift: hand values, derivatives, limits, and what is refused."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxfilt as jf
from jaxfilt.models import sensors

KNOT = 1852 / 3600
R = np.diag([np.radians(2.0) ** 2, 0.3**2])
OBSERVER = 5 * KNOT * np.array([0, 0, np.cos(np.radians(20)), np.sin(np.radians(20))])
TARGET = np.array([6000, 6000, 15 * KNOT * np.cos(np.radians(260)), 15 * KNOT * np.sin(np.radians(260)), 500.0])


def sensor(**options):
    return sensors.bearing_doppler(R, **{"observer": OBSERVER, "compass": True, **options})


def h(x, **options):
    return sensor(**options).h(jnp.asarray(x), None, None)


def test_hand_values_of_the_first_scenario():
    assert pytest.approx(0.5144444, abs=1e-7) == KNOT
    np.testing.assert_allclose(h(TARGET), [np.pi / 4, 502.884116], rtol=1e-9)
    H = jax.jacfwd(lambda x: h(x))(jnp.asarray(TARGET))
    np.testing.assert_allclose(H[0], [8.3333333e-5, -8.3333333e-5, 0, 0, 0], rtol=1e-7)
    expected = [-9.2750836e-5, 9.2750836e-5, -0.23570226, -0.23570226, 1.00576823]
    np.testing.assert_allclose(H[1], expected, rtol=1e-7)


def test_jacobian_is_the_closed_form():
    dx, dy, du, dv = TARGET[:4] - OBSERVER
    r = np.hypot(dx, dy)
    rate, f = (dx * du + dy * dv) / r, TARGET[4] / 1500
    bearing = [dy / r**2, -dx / r**2, 0, 0, 0]
    place = [-f * (du / r - rate * dx / r**2), -f * (dv / r - rate * dy / r**2)]
    tone = [*place, -f * dx / r, -f * dy / r, 1 - rate / 1500]
    np.testing.assert_allclose(jax.jacfwd(lambda x: h(x))(jnp.asarray(TARGET)), [bearing, tone], rtol=1e-10, atol=1e-20)


@pytest.mark.parametrize("doppler", ["first", "exact"])
def test_derivatives_are_those_of_differences(doppler):
    scale = np.array([1e3, 1e3, 1.0, 1.0, 1.0])

    def fn(z):
        return h(jnp.asarray(TARGET) + z * scale, doppler=doppler)

    step = 1e-3 * np.eye(5)
    zero = jnp.zeros(5)
    H = np.stack([(fn(e) - fn(-e)) / 2e-3 for e in step], axis=1)
    size = np.abs(H).max(axis=1, keepdims=True)
    np.testing.assert_allclose(jax.jacfwd(fn)(zero) / size, H / size, rtol=0, atol=1e-6)
    J = jax.jacfwd(fn)
    curvature = np.stack([(J(e) - J(-e)) / 2e-3 for e in step], axis=2)
    size = np.abs(curvature).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(jax.hessian(fn)(zero) / size, curvature / size, rtol=0, atol=1e-6)


def test_the_exact_shift_differs_by_the_second_order():
    away = np.array([1, 1]) / np.sqrt(2)
    second = 500 * (TARGET[2:4] @ away) * ((TARGET - np.append(OBSERVER, 0))[2:4] @ away) / 1500**2
    np.testing.assert_allclose(h(TARGET, doppler="exact")[1] - h(TARGET)[1], second, rtol=0.01)
    assert 0.01 < second < 0.02
    # a common velocity leaves the frequency as it is only in the exact form to second order, and at rest both agree
    rest = TARGET * [1, 1, 0, 0, 1]
    np.testing.assert_allclose(h(rest, doppler="exact")[1], h(rest)[1], rtol=1e-12)


def test_compass_and_mathematical_bearing_are_mirror_images():
    np.testing.assert_allclose(h(TARGET)[0], np.pi / 2 - h(TARGET, compass=False)[0], rtol=1e-12)
    mirrored = TARGET[[1, 0, 3, 2, 4]]
    np.testing.assert_allclose(h(mirrored, observer=OBSERVER[[1, 0, 3, 2]], compass=False), h(TARGET), rtol=1e-12)


def test_innovations_wrap_and_any_bearing_is_taken():
    residual = sensor().residual
    assert residual is not None
    given, expected = jnp.array([np.radians(-179), 500.0]), jnp.array([np.radians(179), 499.0])
    np.testing.assert_allclose(residual(given, expected), [np.radians(2), 1], rtol=1e-12)
    np.testing.assert_allclose(residual(given.at[0].add(4 * np.pi), expected), [np.radians(2), 1], rtol=1e-12)


def model(m0=TARGET, **options):
    F = jnp.eye(5).at[0, 2].set(1.0).at[1, 3].set(1.0)
    motion = jf.models.linear_gaussian(F, jnp.eye(2, 5), 1e-8 * jnp.eye(5), R, m0, np.diag([1e6, 1e6, 64, 64, 9.0]))
    return jf.models.with_sensor(motion, sensor(**options))


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: sensor(speed=0.0), "speed"),
        (lambda: sensor(speed=-1500.0), "speed"),
        (lambda: sensor(doppler="second"), "doppler"),
        (lambda: sensors.bearing_doppler(np.eye(3)), "R"),
        (lambda: sensors.bearing_doppler(np.diag([1.0, 0.0])), "positive definite"),
        (lambda: sensors.bearing_doppler(np.array([[1.0, 2.0], [2.0, 1.0]])), "R"),
        (lambda: h(np.zeros(4)), "f_B"),
        (lambda: model(np.zeros(5))._replace and jf.models.linear_gaussian(
            np.eye(5), np.eye(2, 5), np.eye(5), R, np.zeros(5), -np.eye(5)), "P0"),
        (lambda: jf.filter(jf.extended(model(observer=_own)), np.ones((5, 2)), u=np.zeros((4, 4))), "leading T"),
        (lambda: jf.filter(jf.extended(model(observer=_own)), np.ones((5, 2)), u=np.zeros((5, 3))), "observer"),
        (lambda: jf.filter(jf.extended(model()), np.full((5, 2), np.nan)), "no mask covers it"),
    ],
)  # fmt: skip
def test_bad_input_is_refused(call, named):
    with pytest.raises(ValueError, match=named):
        call()


def _own(u, dt):
    return u


def heard(mean, y, u, dt):
    """Frequencies are positive, and nobody opens faster than sound."""
    dx = mean[:4] - jnp.asarray(OBSERVER)
    slow = jnp.abs(dx[:2] @ dx[2:]) < 1500 * jnp.linalg.norm(dx[:2])
    return jnp.stack([jnp.asarray(True), slow & (y[1] > 0)])


def test_a_target_on_the_observer_has_no_bearing_and_finite_derivatives():
    near = np.array([OBSERVER[0] + 0.2, OBSERVER[1] + 0.3, 3.0, 1.0, 500.0])
    still = model(near)
    still = still._replace(f=Partial(_same), f_jacobian=None)
    ys = np.array([[0.3, 501.0]] * 3)
    guarded = jf.usable_where(jf.extended(still), Partial(sensors.apart, 1.0, OBSERVER))
    out = jf.filter(guarded, ys)
    assert (np.asarray(out.status) & int(jf.Status.BOUND)).tolist()[0] == int(jf.Status.BOUND)
    only_tone = jf.filter(jf.extended(still), ys, mask=np.array([[False, True]] * 3))
    np.testing.assert_allclose(out.mean[0], only_tone.mean[0], rtol=1e-12)
    there = jnp.asarray(np.array([*OBSERVER[:2], 3.0, 1.0, 500.0]))
    assert np.isfinite(jax.jacfwd(lambda x: h(x))(there)).all()


def test_impossible_frequencies_are_left_out_and_flagged():
    out = jf.filter(jf.usable_where(jf.extended(model()), heard), np.array([[0.78, 502.9], [0.78, -1.0]]))
    assert [bool(s & int(jf.Status.BOUND)) for s in np.asarray(out.status)] == [False, True]
    np.testing.assert_array_equal(np.asarray(out.innovation)[1, 1], 0)


def _same(x, u, dt):
    return x


def test_usable_where_needs_a_mask_of_the_measurement():
    with pytest.raises(ValueError, match="condition"):
        jf.filter(jf.usable_where(jf.extended(model()), lambda x, y, u, dt: jnp.asarray(True)), np.ones((2, 2)))
    with pytest.raises(ValueError, match="moments"):
        jf.usable_where(jf.kalman(jf.models.constant_velocity(
            dt=1.0, q=1.0, r=1.0, m0=np.zeros(2), P0=np.eye(2)))._replace(moments=None), heard)  # fmt: skip
