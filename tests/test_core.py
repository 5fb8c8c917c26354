"""The border of jf.filter, and the parts of the protocol that belong to no filter."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxfilt as jf

MODEL = jf.models.constant_velocity(dt=1.0, q=0.1, r=25.0, m0=np.zeros(2), P0=np.eye(2))
KALMAN = jf.kalman(MODEL)
YS = np.ones((5, 1))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ys": np.ones(5)}, r"ys: expected shape \(T, m\), got \(5,\)"),
        ({"ys": np.ones((0, 1))}, "ys: expected at least one sample"),
        ({"ys": np.ones((5, 0))}, "ys: expected at least one sample"),
        ({"ys": np.ones((5, 2))}, "ys: expected 1 components per sample as the model's H, got 2"),
        ({"ys": np.full((5, 1), np.nan)}, r"ys: ys\[0, 0\] is nan and no mask covers it \(5 such values\)"),
        ({"ys": np.array([[1.0], [np.inf]])}, r"ys: ys\[1, 0\] is inf"),
        ({"mask": np.ones(4, bool)}, r"mask: expected shape \(5,\) or \(5, 1\), got \(4,\)"),
        ({"dt": -1.0}, r"dt: expected finite intervals >= 0, got dt\[0\] = -1"),
        ({"dt": np.array([1.0, 1.0, np.nan, 1.0, 1.0])}, r"dt: expected finite intervals >= 0, got dt\[2\] = nan"),
        ({"dt": np.ones(4)}, "dt: expected a scalar or leading T = 5"),
        ({"u": np.ones((4, 1))}, "u: expected leaves with leading T = 5"),
        ({"q_scale": np.ones(4)}, "q_scale: expected a scalar or leading T = 5"),
        ({"r_scale": np.ones((2, 2, 2))}, "r_scale: expected a scalar or leading T = 5"),
    ],
)
def test_bad_values_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        jf.filter(KALMAN, **{"ys": YS, **options})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ys": np.ones((5, 1), int)}, "ys: expected a float array, got int64"),
        ({"ys": np.ones((5, 1), np.float32)}, "ys: is float32, but the filter's model is float64"),
        ({"mask": np.ones((5, 1))}, "mask: expected bool, got float64"),
        ({"dt": np.ones(5, np.float32)}, "dt: is float32, but ys is float64"),
        ({"u": np.ones((5, 1), np.float32)}, "u: is float32, but ys is float64"),
        ({"dt": np.ones(5, int)}, "dt: expected a float array, got int64"),
    ],
)
def test_wrong_dtypes_are_type_errors(options, message):
    with pytest.raises(TypeError, match=message):
        jf.filter(KALMAN, **{"ys": YS, **options})


def test_mask_nan_is_an_explicit_choice():
    ys = np.array([[1.0, np.nan], [np.inf, 2.0]])
    filled, mask = jf.mask_nan(ys)
    np.testing.assert_array_equal(mask, [[True, False], [True, True]])
    np.testing.assert_array_equal(filled, [[1.0, 0.0], [np.inf, 2.0]])  # infinite is not missing


def test_intervals_of_time_stamps():
    np.testing.assert_allclose(jf.intervals(np.array([3.0, 4.0, 6.5]), first=0.5), [0.5, 1.0, 2.5])
    whole = jf.intervals([3, 4, 6], first=1)
    assert whole.dtype == np.float64  # jf.filter takes floats
    np.testing.assert_array_equal(whole, [1, 1, 2])
    np.testing.assert_array_equal(jax.jit(jf.intervals)(jnp.array([3, 4, 6]), first=1.0), whole)
    with jax.enable_x64(False):  # float32 holds no date to the second
        np.testing.assert_array_equal(jf.intervals(1.7e9 + np.array([0.0, 1.0, 3.5]), first=1.0), [1.0, 1.0, 2.5])
    for times in ([0.0, 1.0, 1.0], [0.0, 1.0, 0.5]):
        with pytest.raises(ValueError, match=r"times: must increase, but times\[2\] <= times\[1\]"):
            jf.intervals(np.array(times), first=1.0)


def test_one_mask_entry_per_sample_covers_all_components():
    a = jf.filter(KALMAN, YS, mask=np.array([True, False, True, True, False]))
    b = jf.filter(KALMAN, YS, mask=np.array([True, False, True, True, False])[:, None])
    np.testing.assert_array_equal(a.mean, b.mean)


@pytest.mark.parametrize("flag", [True, np.True_])
def test_first_update_only_takes_the_prior_on_the_first_sample(flag):
    out = jf.filter(KALMAN, YS, first_update_only=flag, outputs=jf.everything)
    np.testing.assert_array_equal(out.prediction.mean[0], MODEL.m0)
    np.testing.assert_array_equal(out.prediction.cov[0], MODEL.P0)
    np.testing.assert_allclose(out.cov[0, 0, 0], 1 / (1 + 1 / 25.0), rtol=1e-14)


def _with_keys(state, info):
    return info.mean


def test_outputs_choose_what_comes_back():
    np.testing.assert_array_equal(jf.filter(KALMAN, YS, outputs=_with_keys), jf.filter(KALMAN, YS).mean)
    assert jf.filter(KALMAN, YS).prediction is None
    assert jf.filter(KALMAN, YS, outputs=jf.everything).prediction is not None


def _noise_init(p, inp):
    return inp.y + 0 * jax.random.normal(inp.key, inp.y.shape, inp.y.dtype)


def _noise_predict(p, state, inp):
    return state, jf.Prediction(state)


def _noise_update(p, state, inp):
    draw = jax.random.normal(inp.key, state.shape, state.dtype)
    return draw, jf.Info(draw, None, inp.y, None, None, None, jnp.int32(0))


def test_a_traced_python_number_takes_the_models_dtype():
    P0 = np.eye(2, dtype=np.float32)
    filt = jf.kalman(jf.models.constant_velocity(dt=1.0, q=0.1, r=25.0, m0=np.zeros(2, np.float32), P0=P0))
    ys = np.ones((3, 1), np.float32)
    traced = jax.jit(lambda dt, r: jf.filter(filt, ys, dt=dt, r_scale=r).mean)(0.5, 2.0)
    assert traced.dtype == jnp.float32
    np.testing.assert_allclose(traced, jf.filter(filt, ys, dt=0.5, r_scale=2.0).mean, rtol=1e-6)


def test_keys_are_prefix_stable():
    """Step k draws from fold_in(key, k + 1): a longer series starts with the same draws."""
    filt = jf.bind((), _noise_init, _noise_predict, _noise_update)
    key = jax.random.key(3)
    short = jf.filter(filt, np.ones((3, 1)), key=key)
    long = jf.filter(filt, np.ones((6, 1)), key=key)
    np.testing.assert_array_equal(short.mean, long.mean[:3])
    np.testing.assert_array_equal(long.mean[2], jax.random.normal(jax.random.fold_in(key, 3), (1,)))


def test_smoothing_needs_the_prediction_and_a_covariance():
    with pytest.raises(ValueError, match=r"outputs=jf\.everything"):
        jf.rts(jf.filter(KALMAN, YS))
    filt = jf.bind((), _noise_init, _noise_predict, _noise_update)
    with pytest.raises(ValueError, match="cannot be smoothed"):
        jf.smooth(filt, YS, key=jax.random.key(0))


def test_smoothed_variance_is_never_larger():
    ys = np.random.default_rng(0).normal(size=(40, 1))
    mask = np.random.default_rng(1).random(40) < 0.6
    out = jf.filter(KALMAN, ys, mask=mask, outputs=jf.everything)
    eigenvalues = np.linalg.eigvalsh(np.asarray(out.cov - jf.rts(out).cov))
    assert eigenvalues.min() > -1e-10


def test_static_options_compare_by_value():
    assert jf.Static((1, "a")) == jf.Static((1, "a"))
    assert hash(jf.Static(3)) == hash(jf.Static(3))
    assert jax.tree.leaves(jf.Static(3)) == []


def test_aspartial_keeps_a_partial():
    bound = Partial(_with_keys, 1)
    assert jf.aspartial(bound) is bound
    assert isinstance(jf.aspartial(_with_keys), Partial)


def test_a_one_sample_series_works():
    assert jf.filter(KALMAN, YS[:1]).mean.shape == (1, 2)
    assert jf.smooth(KALMAN, YS[:1]).mean.shape == (1, 2)


def test_a_non_finite_estimate_is_never_silent():
    """An unstable, unobserved state overflows after some time: the status says when."""
    model = jf.models.linear_gaussian(
        np.diag([1e30, 0.5]), np.array([[0.0, 1.0]]), np.eye(2), np.eye(1), np.ones(2), np.eye(2)
    )
    out = jf.filter(jf.kalman(model), np.ones((12, 1)))
    bad = ~np.isfinite(np.asarray(out.mean)).all(axis=1) | ~np.isfinite(np.asarray(out.cov)).all(axis=(1, 2))
    assert bad.any()
    assert (((np.asarray(out.status) & int(jf.Status.NONFINITE)) != 0)[bad]).all()


def _status_and_mean(state, info):
    return info.mean, info.status, info.log_lik


@pytest.mark.parametrize("form", ["dense", "scalar"])
def test_sum_and_last_of_the_outputs(form):
    """Without a history; in a sum the bits of the status are united."""
    mask = np.array([True, True, False, True, True])
    means, status, log_lik = jf.filter(KALMAN, YS, mask=mask, form=form, outputs=_status_and_mean)
    total = jf.filter(KALMAN, YS, mask=mask, form=form, outputs=_status_and_mean, keep="sum")
    last = jf.filter(KALMAN, YS, mask=mask, form=form, outputs=_status_and_mean, keep="last")
    np.testing.assert_allclose(total[0], means.sum(axis=0), rtol=1e-13)
    np.testing.assert_allclose(total[2], log_lik.sum(), rtol=1e-13)
    assert int(total[1]) == int(jf.Status.MISSED)
    np.testing.assert_array_equal(last[0], means[-1])
    assert int(last[1]) == int(status[-1])


def test_unpack_needs_a_triangle():
    assert jf.unpack(jnp.arange(6.0)).tolist() == [[0.0, 1.0, 3.0], [1.0, 2.0, 4.0], [3.0, 4.0, 5.0]]
    with pytest.raises(ValueError, match="triangle: expected n"):
        jf.unpack(jnp.zeros(5))
    with pytest.raises(ValueError, match="outputs: the filter reports no covariance"):
        jf.filter(jf.alpha_beta(0.5, 0.3, dt=1.0), YS, outputs=jf.packed)
    with pytest.raises(ValueError, match="keep: expected"):
        jf.filter(KALMAN, YS, keep="all")


@pytest.mark.parametrize("form", ["dense", "scalar"])
def test_a_sum_in_float32_does_not_lose_small_terms(form):
    """20000 steps: a plain float32 sum would be off by some 1e-5 of itself, a thousand times as much."""
    model = jf.models.constant_velocity(
        dt=1.0, q=0.1, r=25.0, m0=np.zeros(2, np.float32), P0=np.eye(2, dtype=np.float32)
    )
    ys = np.random.default_rng(0).normal(0, 5, (20000, 1)).astype(np.float32)
    each = np.asarray(jf.filter(jf.kalman(model), ys, outputs=jf.log_lik, form=form), np.float64)
    total = jf.filter(jf.kalman(model), ys, outputs=jf.log_lik, keep="sum", form=form)
    assert total.dtype == np.float32
    np.testing.assert_allclose(total, each.sum(), rtol=2e-7)
