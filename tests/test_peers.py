"""The Kalman filters against other libraries, each at the tolerance that its own regularization allows."""

from __future__ import annotations

import datetime

import jax
import numpy as np
import pytest

import jaxfilt as jf
from tests import reference

SIZES = [(2, 1), (4, 2), (6, 3)]
FORMS = {"kalman": jf.kalman, "sqrt_kalman": jf.sqrt_kalman}


def case(n, m, T=20, scale=1.0):
    rng = np.random.default_rng(100 * n + m)
    matrices = reference.random_model(rng, n, m, scale=scale)
    return matrices, np.sqrt(scale) * 2 * rng.normal(size=(T, m))


def relative(a, b):
    b = np.asarray(b)
    return np.abs(np.asarray(a) - b).max() / np.abs(b).max()


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("n", "m"), SIZES)
def test_equals_filterpy(form, n, m):
    filterpy = pytest.importorskip("filterpy.kalman")
    (F, H, Q, R, m0, P0), ys = case(n, m)
    peer = filterpy.KalmanFilter(dim_x=n, dim_z=m)
    peer.F, peer.H, peer.Q, peer.R, peer.x, peer.P = F, H, Q, R, m0.copy(), P0.copy()
    means, covs, log_lik, conditions = [], [], [], []
    for y in ys:
        peer.predict()
        peer.update(y)
        means.append(peer.x)
        covs.append(peer.P)
        conditions.append(np.linalg.cond(peer.S))
        log_lik.append(peer.log_likelihood)
    assert max(conditions) < 1e6
    out = jf.filter(FORMS[form](jf.models.linear_gaussian(F, H, Q, R, m0, P0)), ys)
    assert relative(out.mean, means) < 1e-10
    assert relative(out.cov, covs) < 1e-10
    assert relative(out.log_lik, log_lik) < 1e-10


def dynamax_filter(matrices, ys, first_update_only=True):
    """dynamax takes its prior on the first sample."""
    inference = pytest.importorskip("dynamax.linear_gaussian_ssm.inference")
    F, H, Q, R, m0, P0 = matrices
    n, m = len(m0), len(R)
    params = inference.ParamsLGSSM(
        initial=inference.ParamsLGSSMInitial(mean=m0, cov=P0),
        dynamics=inference.ParamsLGSSMDynamics(
            weights=F, bias=np.zeros(n), input_weights=np.zeros((n, 0)), cov=Q
        ),
        emissions=inference.ParamsLGSSMEmissions(
            weights=H, bias=np.zeros(m), input_weights=np.zeros((m, 0)), cov=R
        ),
    )  # fmt: skip
    return jax.jit(inference.lgssm_filter)(params, ys)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("n", "m"), SIZES)
def test_equals_dynamax_at_unit_scale(form, n, m, lenient):
    """To 1e-6 only: dynamax adds an absolute 1e-9 to the diagonal of the innovation covariance."""
    matrices, ys = case(n, m)
    with lenient():
        peer = dynamax_filter(matrices, ys)
    out = jf.filter(FORMS[form](jf.models.linear_gaussian(*matrices)), ys, first_update_only=True)
    assert relative(out.mean, peer.filtered_means) < 1e-6
    assert relative(out.cov, peer.filtered_covariances) < 1e-6
    assert relative(out.log_lik.sum(), peer.marginal_loglik) < 1e-6


@pytest.mark.parametrize("form", FORMS)
def test_units_move_dynamax_and_not_us(form, lenient):
    """State and sensor scaled by 1e-3: ours does not change beyond rounding, the absolute constant begins to show."""
    scale = 1e-3
    matrices, ys = case(4, 2)
    F, H, Q, R, m0, P0 = matrices
    small = (F, H, scale**2 * Q, scale**2 * R, scale * m0, scale**2 * P0)
    filt = FORMS[form]
    unit = jf.filter(filt(jf.models.linear_gaussian(*matrices)), ys, first_update_only=True)
    ours = jf.filter(filt(jf.models.linear_gaussian(*small)), scale * ys, first_update_only=True)
    assert relative(ours.mean / scale, unit.mean) < 1e-12
    assert relative(ours.cov / scale**2, unit.cov) < 1e-12
    with lenient():
        peer = dynamax_filter(small, scale * ys)
    assert relative(peer.filtered_covariances / scale**2, unit.cov) > 1e-6


# With statsmodels and Stone Soup in double precision the only differences are of rounding: both factor or invert the
# same S as we do, with no constant added. Stone Soup 1.9.1 installs beside the locked jax and numpy.


def local_level():
    return (np.eye(1), np.eye(1), np.array([[1469.1]]), np.array([[15099.0]]), np.array([1000.0]), np.array([[1e5]]))


def local_linear_trend():
    """From a proper prior that tells little; a wider one and statsmodels' smoother loses eps P0^2 / P."""
    F, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    return F, H, np.diag([0.5, 0.1]), np.array([[2.0]]), np.zeros(2), 1e3 * np.eye(2)


def arma():
    """ARMA(2, 1) in companion form, without measurement noise, from its stationary covariance."""
    F, g = np.array([[0.6, 1.0], [0.2, 0.0]]), np.array([1.0, 0.7])
    Q = np.outer(g, g)
    P0 = np.linalg.solve(np.eye(4) - np.kron(F, F), Q.ravel()).reshape(2, 2)
    return F, np.eye(1, 2), Q, np.zeros((1, 1)), np.zeros(2), P0


SERIES = {"local level": local_level, "trend": local_linear_trend, "arma": arma, "two sensors": lambda: case(4, 2)[0]}


def with_gaps(model, T=60):
    """A series of the model (T, m) and its mask: single components missing, and whole samples."""
    F, H, Q, R, m0, P0 = model
    rng = np.random.default_rng(5)

    def noise(cov):
        values, vectors = np.linalg.eigh(cov)
        return vectors @ (np.sqrt(np.maximum(values, 0)) * rng.normal(size=len(cov)))

    x, ys = m0 + noise(P0), []
    for _ in range(T):
        ys.append(H @ x + noise(R))
        x = F @ x + noise(Q)
    mask = rng.random((T, len(R))) > 0.2
    mask[20:25] = False
    return np.array(ys), mask


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", SERIES)
def test_equals_statsmodels_with_missing_data(name, form):
    """Filtered and smoothed moments and each step's likelihood to 1e-9 of the largest; statsmodels inverts S.

    Smoothed in another recursion than ours, P - P N P (Durbin and Koopman), which cancels where P is far above the
    smoothed covariance. Filtered moments agree to 1e-14.
    """
    kalman_smoother = pytest.importorskip("statsmodels.tsa.statespace.kalman_smoother")
    F, H, Q, R, m0, P0 = model = SERIES[name]()
    ys, mask = with_gaps(model)
    peer = kalman_smoother.KalmanSmoother(k_endog=len(R), k_states=len(m0), k_posdef=len(m0))
    peer["design"], peer["obs_cov"], peer["transition"] = H, R, F
    peer["selection"], peer["state_cov"] = np.eye(len(m0)), Q
    peer.bind(np.asfortranarray(np.where(mask, ys, np.nan).T))
    peer.initialize_known(m0, P0)
    peer.tolerance = 0.0  # its gain would else be frozen once it has converged
    want = peer.smooth()
    filt = FORMS[form](jf.models.linear_gaussian(F, H, Q, R, m0, P0))
    options = {"mask": mask, "first_update_only": True}
    out, smoothed = jf.filter(filt, ys, **options), jf.smooth(filt, ys, **options)
    assert relative(out.mean, want.filtered_state.T) < 1e-9
    assert relative(out.cov, np.moveaxis(want.filtered_state_cov, -1, 0)) < 1e-9
    assert relative(out.log_lik, want.llf_obs) < 1e-9
    assert relative(smoothed.mean, want.smoothed_state.T) < 1e-9
    assert relative(smoothed.cov, np.moveaxis(want.smoothed_state_cov, -1, 0)) < 1e-9


OBSERVER = np.array([-30.0, -20.0])


def tracked(T=15):
    """A crossing target: our motion model, and measured positions and ranges and bearings."""
    motion = jf.models.constant_velocity(
        dt=1.0, q=0.3, r=4.0, m0=np.array([5.0, 8.0, 2.0, -1.0]), P0=np.diag([9.0, 9.0, 4.0, 4.0])
    )
    rng = np.random.default_rng(6)
    positions = np.array([5.0, 8.0]) + np.arange(1, T + 1)[:, None] * np.array([2.0, -1.0]) + rng.normal(size=(T, 2))
    away = positions - OBSERVER
    polar = np.stack([np.hypot(*away.T), np.arctan2(away[:, 1], away[:, 0])], axis=1)
    return motion, positions + 2 * rng.normal(size=(T, 2)), polar + np.array([1.0, 0.02]) * rng.normal(size=(T, 2))


def run_stone_soup(motion, ys, measure, predictor, updater):
    """``(means, covs)`` of their filter, and its track.

    Their models take any order of the state: ours, since sigma points depend on which Cholesky root is taken.
    """
    linear = pytest.importorskip("stonesoup.models.transition.linear")
    types = {name: pytest.importorskip(f"stonesoup.types.{name}") for name in ("detection", "hypothesis", "state")}
    Detection, SingleHypothesis = types["detection"].Detection, types["hypothesis"].SingleHypothesis
    GaussianState = types["state"].GaussianState
    F, Q = (np.asarray(x(None, None) if callable(x) else x) for x in (motion.F, motion.Q))
    predictor = predictor(linear.LinearGaussianTimeInvariantTransitionModel(transition_matrix=F, covariance_matrix=Q))
    updater = updater(measure)
    start = datetime.datetime(2000, 1, 1)
    state = GaussianState(np.asarray(motion.m0)[:, None], np.asarray(motion.P0), start)
    track = pytest.importorskip("stonesoup.types.track").Track([])
    for k, y in enumerate(ys, 1):
        at = start + datetime.timedelta(seconds=k)
        predicted = predictor.predict(state, timestamp=at)
        state = updater.update(SingleHypothesis(predicted, Detection(y[:, None], at, measurement_model=measure)))
        track.append(state)
    return *moments_of(track), track


def moments_of(track):
    """Means (T, n) and covariances (T, n, n) of their states."""
    means = np.array([np.asarray(state.state_vector, float).ravel() for state in track])
    return means, np.array([np.asarray(state.covar, float) for state in track])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # theirs
@pytest.mark.parametrize("form", FORMS)
def test_equals_stone_soup_filter_and_smoother(form):
    """To 1e-10: the same products, with an inverse of S and of the predicted covariance in place of solves."""
    measurement = pytest.importorskip("stonesoup.models.measurement.linear")
    predictors, smoothers, updaters = (
        pytest.importorskip(f"stonesoup.{part}.kalman") for part in ("predictor", "smoother", "updater")
    )
    motion, ys, _ = tracked()
    measure = measurement.LinearGaussian(ndim_state=4, mapping=(0, 1), noise_covar=4.0 * np.eye(2))
    means, covs, track = run_stone_soup(motion, ys, measure, predictors.KalmanPredictor, updaters.KalmanUpdater)
    filt = FORMS[form](motion)
    out, smoothed = jf.filter(filt, ys), jf.smooth(filt, ys)
    assert relative(out.mean, means) < 1e-10
    assert relative(out.cov, covs) < 1e-10
    means, covs = moments_of(smoothers.KalmanSmoother(None).smooth(track))
    assert relative(smoothed.mean, means) < 1e-10
    assert relative(smoothed.cov, covs) < 1e-10


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # theirs
@pytest.mark.parametrize("array", [False, True], ids=["covariance", "array"])
@pytest.mark.parametrize("kind", ["extended", "unscented"])
def test_equals_stone_soup_on_ranges_and_bearings(kind, array, monkeypatch):
    """Unscented to 1e-10, with the same spread. Extended to 1e-5: their Jacobian is a difference, of step 1e-8.

    Their mean of bearings at sigma points is that of points on a circle, ours of deviations from the centre's bearing.
    They differ in third order, by 4e-5 here; so their mean is replaced by that of numbers.
    """
    nonlinear = pytest.importorskip("stonesoup.models.measurement.nonlinear")
    predictors, updaters = (pytest.importorskip(f"stonesoup.{part}.kalman") for part in ("predictor", "updater"))
    arrays = pytest.importorskip("stonesoup.types.array")

    def mean_of_numbers(points, axis=None, weights=None, returned=False):
        del axis, returned
        return arrays.StateVector(np.average(np.asarray(points, float), axis=1, weights=weights))

    monkeypatch.setattr(arrays.StateVectors, "_average", staticmethod(mean_of_numbers))
    motion, _, polar = tracked()
    R = np.diag([1.0, 0.02**2])
    model = jf.models.with_sensor(motion, jf.models.sensors.range_bearing(R, observer=OBSERVER))
    measure = nonlinear.CartesianToBearingRange(
        ndim_state=4, mapping=(0, 1), noise_covar=R[::-1, ::-1], translation_offset=OBSERVER[:, None]
    )
    spread = {"alpha": 0.9, "beta": 2.0, "kappa": 0.5}
    if kind == "extended":
        predictor, updater, options = predictors.ExtendedKalmanPredictor, updaters.ExtendedKalmanUpdater, {}
        filt = (jf.sqrt_extended if array else jf.extended)(model)
    else:
        predictor, updater, options = predictors.UnscentedKalmanPredictor, updaters.UnscentedKalmanUpdater, spread
        filt = (jf.sqrt_unscented if array else jf.unscented)(model, **spread)
    means, covs, _ = run_stone_soup(
        motion, polar[:, ::-1], measure, lambda m: predictor(m, **options), lambda m: updater(m, **options)
    )
    out = jf.filter(filt, polar)
    tolerance = 1e-5 if kind == "extended" else 1e-10
    assert relative(out.mean, means) < tolerance
    assert relative(out.cov, covs) < tolerance
