"""The gate, and the choice of the nearest detection."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilt as jf
from jaxfilt.models.linear import value

MODEL = jf.models.constant_velocity(dt=1.0, q=0.1, r=np.array([4.0, 1.0]), m0=np.zeros(4), P0=np.eye(4))
F, Q = value(MODEL.F, None, None), value(MODEL.Q, None, None)
GATED, MISSED, NONFINITE = (int(bit) for bit in (jf.Status.GATED, jf.Status.MISSED, jf.Status.NONFINITE))
T = 30


def scene(runs=1, T=T, seed=0):
    """Measurements of the model itself (runs, T, 2)."""
    rng = np.random.default_rng(seed)
    R = np.asarray(MODEL.R)
    x, ys = rng.normal(size=(runs, 4)), []
    for _ in range(T):
        x = x @ np.asarray(F).T + rng.multivariate_normal(np.zeros(4), np.asarray(Q), size=runs)
        ys.append(x[:, :2] + rng.multivariate_normal(np.zeros(2), R, size=runs))
    return np.stack(ys, axis=1)


def has(status, bit):
    return (np.asarray(status) & bit) != 0


def assert_same(a, b):
    for field in ("mean", "cov", "nis", "log_lik", "innovation", "status"):
        np.testing.assert_allclose(getattr(a, field), getattr(b, field), rtol=1e-12, atol=1e-12, err_msg=field)


# The gate


@pytest.mark.parametrize("present", [[True, True], [True, False]], ids=["both", "one component"])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
def test_accepts_up_to_the_quantile_of_the_present_components(present, dtype):
    model = jax.tree.map(lambda x: jnp.asarray(x, dtype), MODEL)
    p_false, mask = 0.01, np.array([present])
    plain, filt = jf.kalman(model), jf.gated(jf.kalman(model), p_false)
    limit = jf.metrics.chi2_quantile(1 - p_false, sum(present))
    direction = jnp.asarray([[1.0, 0.5]], dtype)
    unit = jf.filter(plain, direction, mask=mask).nis[0]
    for factor, refused in ((0.999, False), (1.001, True)):
        ys = direction * jnp.sqrt(factor * limit / unit).astype(dtype)
        out, expected = (jf.filter(f, ys, mask=mask) for f in (filt, plain))
        assert has(out.status, GATED)[0] == refused
        assert has(out.status, MISSED)[0] == refused
        np.testing.assert_allclose(out.nis, expected.nis)  # what came, refused or not
        np.testing.assert_allclose(out.innovation, expected.innovation)
        if refused:
            missed = jf.filter(plain, ys, mask=np.zeros((1, 2), bool))
            assert (out.mean == missed.mean).all()
            assert (out.cov == missed.cov).all()
            assert out.log_lik[0] == 0
        else:
            assert_same(out, expected)


def test_refuses_as_many_good_samples_as_it_says():
    """The first sample of 20000 runs, within 4 standard deviations. Later ones depend on what was refused before."""
    ys = jnp.asarray(scene(20_000, 1))
    filt = jf.gated(jf.kalman(MODEL), 0.02)
    rate = has(jax.vmap(lambda y: jf.filter(filt, y).status)(ys), GATED).mean()
    assert abs(rate - 0.02) < 4 * np.sqrt(0.02 * 0.98 / len(ys))


def test_refuses_an_outlier_and_nothing_else():
    ys = scene(seed=1)[0]
    spoiled = ys.copy()
    spoiled[15] += 100
    out = jf.filter(jf.gated(jf.kalman(MODEL), 1e-6), spoiled)
    assert np.flatnonzero(has(out.status, GATED)).tolist() == [15]
    mask = np.ones((T, 2), bool)
    mask[15] = False
    expected = jf.filter(jf.kalman(MODEL), ys, mask=mask)
    np.testing.assert_allclose(out.mean, expected.mean, rtol=1e-12)
    np.testing.assert_allclose(out.log_lik, expected.log_lik, rtol=1e-12)


def test_a_missed_step_passes_and_a_nonfinite_value_keeps_its_flag():
    ys, mask = scene()[0], np.ones((T, 2), bool)
    mask[4:6] = False
    out = jf.filter(jf.gated(jf.kalman(MODEL), 1e-6), np.where(mask, ys, np.nan), mask=mask)
    assert (np.asarray(out.status)[4:6] == MISSED).all()
    assert not has(out.status, GATED).any()
    # NaN in one component, and an outlier in the other.
    ys[8] = np.nan, 1000.0
    out = jax.jit(lambda y: jf.filter(jf.gated(jf.kalman(MODEL)), y))(ys)
    assert out.status[8] == GATED | MISSED | NONFINITE
    assert np.isfinite(out.mean).all()


def test_gradients_are_finite_and_the_gate_cuts_what_it_refuses():
    ys = jnp.asarray(scene()[0]).at[15].add(100.0)

    def total(p_false, y):
        out = jf.filter(jf.gated(jf.kalman(MODEL), p_false), y)
        return jnp.sum(out.log_lik) + jnp.sum(out.mean)

    by_gate, by_data = jax.jit(jax.grad(total, (0, 1)))(0.001, ys)
    assert by_gate == 0
    assert np.isfinite(by_data).all()
    assert (by_data[15] == 0).all()
    assert (by_data[14] != 0).all()


# The nearest of several detections


def scans(ys, D=4, seed=3, far=60.0):
    """The target's detection at a random place among far clutter; unused slots hold NaN."""
    rng = np.random.default_rng(seed)
    n = len(ys)
    detections = ys[:, None, :] + far * rng.choice([-1.0, 1.0], size=(n, D, 2)) * rng.uniform(1, 2, size=(n, D, 2))
    valid = rng.random((n, D)) < 0.6
    place = rng.integers(0, D, n)
    detections[np.arange(n), place], valid[np.arange(n), place] = ys, True
    return np.where(valid[..., None], detections, np.nan), valid, place


def test_picks_the_targets_detection_among_clutter():
    ys = scene(seed=2)[0]
    detections, valid, place = scans(ys)
    filt = jf.nearest_neighbor(jf.kalman(MODEL), 1e-6)
    out = jf.filter(filt, **jf.scan_inputs(detections, valid))
    assert (np.asarray(out.extra["choice"]) == place).all()
    assert out.extra["choice"].dtype == jnp.int32
    assert (np.asarray(out.extra["detections_in_gate"]) == 1).all()
    assert_same(out, jf.filter(jf.kalman(MODEL), ys))


def test_takes_the_smallest_nis_not_the_smallest_distance():
    """The second component is measured better, so the same distance there is less probable."""
    detections = np.array([[[0.0, 2.0], [2.3, 0.0], [9.0, 9.0]]])
    out = jf.filter(jf.nearest_neighbor(jf.kalman(MODEL), 0.01), **jf.scan_inputs(detections))
    assert out.extra["choice"][0] == 1
    assert out.extra["detections_in_gate"][0] == 2


def test_no_detection_clutter_only_and_no_scan_are_missed():
    ys = scene(seed=2)[0]
    detections, valid, place = scans(ys)
    valid[10] = False
    valid[12, place[12]] = False  # clutter only
    valid[12, (place[12] + 1) % 4] = True
    detections = np.where(np.isnan(detections), 1e3, detections)
    mask = np.ones((T, 2), bool)
    mask[14] = False
    filt = jf.nearest_neighbor(jf.kalman(MODEL), 1e-6)
    out = jf.filter(filt, **jf.scan_inputs(detections, valid), mask=mask)
    missing = np.isin(np.arange(T), [10, 12, 14])
    assert (np.flatnonzero(np.asarray(out.extra["choice"]) < 0) == [10, 12, 14]).all()
    assert (np.asarray(out.extra["detections_in_gate"])[missing] == 0).all()
    assert np.asarray(out.status)[missing].tolist() == [MISSED, MISSED | GATED, MISSED]
    expected = jf.filter(jf.kalman(MODEL), ys, mask=np.tile(~missing[:, None], 2))
    np.testing.assert_allclose(out.mean, expected.mean, rtol=1e-10)
    np.testing.assert_allclose(out.log_lik, expected.log_lik, rtol=1e-10, atol=1e-12)
    assert (np.asarray(out.innovation)[missing] == 0).all()


def test_one_detection_is_the_gate():
    ys = scene(seed=4)[0]
    ys[7] += 50
    mask = np.ones((T, 2), bool)
    mask[3, 1] = False  # this scan measures the first component only
    one = jf.filter(jf.nearest_neighbor(jf.kalman(MODEL)), **jf.scan_inputs(ys[:, None]), mask=mask)
    gate = jf.filter(jf.gated(jf.kalman(MODEL)), ys, mask=mask)
    for field in ("mean", "cov", "log_lik", "status"):
        np.testing.assert_allclose(getattr(one, field), getattr(gate, field), rtol=1e-12, err_msg=field)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["f32", "f64"])
def test_nan_is_harmless_where_invalid_and_flagged_where_valid(dtype):
    model = jax.tree.map(lambda x: jnp.asarray(x, dtype), MODEL)
    detections, valid, place = scans(scene(seed=2)[0])
    detections[5, place[5], 0] = np.nan

    def total(d, q_scale):
        scanned = jf.scan_inputs(d, valid)
        out = jf.filter(jf.nearest_neighbor(jf.kalman(model), 1e-6), **scanned, q_scale=q_scale)
        return jnp.sum(out.mean) + jnp.sum(out.log_lik), out

    gradient, out = jax.jit(jax.grad(total, (0, 1), has_aux=True))(
        jnp.asarray(detections, dtype), jnp.ones((T,), dtype)
    )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((gradient, out)))
    assert np.flatnonzero(has(out.status, NONFINITE)).tolist() == [5]
    assert out.extra["choice"][5] == -1
    assert (gradient[1] != 0).any()
    assert out.mean.dtype == dtype
    with pytest.raises(ValueError, match=rf"detections\[5, {place[5]}\] is valid but not finite"):
        jf.scan_inputs(detections, valid)


def _driven(u, dt):
    del dt
    return jnp.concatenate([jnp.zeros_like(u), u])


def test_u_of_the_filter_inside_passes_through_and_wrappers_go_around():
    ys = scene(seed=2)[0]
    detections, valid, place = scans(ys)
    driven = jf.models.linear_gaussian(F, MODEL.H, Q, MODEL.R, MODEL.m0, MODEL.P0, B=_driven)
    u = np.full((T, 2), 0.01)
    filt = jf.detected(jf.nearest_neighbor(jf.kalman(driven), 1e-6))
    out = jf.filter(filt, **jf.scan_inputs(detections, valid, u=u))
    assert (np.asarray(out.extra["choice"]) == place).all()
    np.testing.assert_allclose(out.mean, jf.filter(jf.kalman(driven), ys, u=u).mean, rtol=1e-12)


def test_bad_arguments_are_refused():
    filt, ys = jf.kalman(MODEL), np.zeros((3, 2))
    for make in (jf.gated, jf.nearest_neighbor):
        for p_false in (0.0, 1.0, np.nan):
            with pytest.raises(ValueError, match="p_false"):
                make(filt, p_false)
    with pytest.raises(ValueError, match="reports nis"):
        jf.filter(jf.gated(jf.alpha_beta(0.5, 0.2, dt=1.0)), ys)
    with pytest.raises(ValueError, match=r"jf\.scan_inputs"):
        jf.filter(jf.nearest_neighbor(filt), ys)
    with pytest.raises(ValueError, match=r"detections \(D, 2\)"):
        jf.filter(jf.nearest_neighbor(filt), ys, u={"detections": np.zeros((3, 4, 1)), "valid": np.ones((3, 4), bool)})
    with pytest.raises(ValueError, match=r"\(T, D, m\)"):
        jf.scan_inputs(ys)
    with pytest.raises(ValueError, match="at least one detection"):
        jf.scan_inputs(np.zeros((3, 0, 2)))
    with pytest.raises(ValueError, match="valid: expected shape"):
        jf.scan_inputs(np.zeros((3, 4, 2)), np.ones((4, 3), bool))
    with pytest.raises(TypeError, match="valid: expected bool"):
        jf.scan_inputs(np.zeros((3, 4, 2)), np.ones((3, 4)))
    with pytest.raises(TypeError, match="detections: expected a float array"):
        jf.scan_inputs(np.zeros((3, 4, 2), int))
