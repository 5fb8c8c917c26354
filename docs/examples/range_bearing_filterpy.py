"""A target tracked by radar with lost scans: extended and unscented Kalman filter with filterpy."""

import numpy as np
import range_bearing_data as data
from filterpy.common import Q_continuous_white_noise
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

F = np.eye(4) + data.DT * np.eye(4, k=2)


def fx(x, dt):
    """The state one interval later."""
    return F @ x


def hx(x):
    """Range and bearing of the state."""
    return np.array([np.hypot(x[0], x[1]), np.arctan2(x[1], x[0])])


def h_jacobian(x):
    """Derivative of range and bearing."""
    r = np.hypot(x[0], x[1])
    return np.array([[x[0] / r, x[1] / r, 0, 0], [-x[1] / r**2, x[0] / r**2, 0, 0]])


def residual(a, b):
    """Difference of two measurements, the bearing's in [-π, π)."""
    y = a - b
    y[1] = (y[1] + np.pi) % (2 * np.pi) - np.pi
    return y


def mean_of_sigmas(sigmas, weights):
    """Mean of measured sigma points, which may lie on both sides of the line where bearings jump."""
    return sigmas[0] + sum(w * residual(s, sigmas[0]) for s, w in zip(sigmas, weights, strict=True))


def started(kf):
    """The filter with prior and noise."""
    kf.x, kf.P, kf.R = data.M0.copy(), data.P0.copy(), data.R
    kf.Q = Q_continuous_white_noise(2, data.DT, data.Q, block_size=2, order_by_dim=False)
    return kf


def make_ekf():
    """An extended Kalman filter and how it is updated."""
    kf = started(ExtendedKalmanFilter(4, 2))
    kf.F = F
    return kf, dict(HJacobian=h_jacobian, Hx=hx, residual=residual)


def make_ukf():
    """An unscented Kalman filter and how it is updated."""
    points = MerweScaledSigmaPoints(4, alpha=1.0, beta=2.0, kappa=0.0)
    kf = UnscentedKalmanFilter(4, 2, data.DT, hx, fx, points, z_mean_fn=mean_of_sigmas, residual_z=residual)
    return started(kf), {}


def track(make, ys, mask):
    """One run: estimates (T, 4), their covariances (T, 4, 4), log-likelihood ()."""
    kf, options = make()
    means, covs, log_lik = [], [], 0.0
    for y, present in zip(ys, mask, strict=True):
        kf.predict()
        if present:
            kf.update(y, **options)
            log_lik += kf.log_likelihood
        means.append(kf.x)
        covs.append(kf.P)
    return means, covs, log_lik


def all_runs(make, ys, mask):
    """The runs one after the other."""
    return [np.array(part) for part in zip(*(track(make, *run) for run in zip(ys, mask, strict=True)), strict=True)]


def ekf(ys, mask):
    """The extended Kalman filter of all runs."""
    return all_runs(make_ekf, ys, mask)


def ukf(ys, mask):
    """The unscented Kalman filter of all runs."""
    return all_runs(make_ukf, ys, mask)


if __name__ == "__main__":
    truth, ys, mask = data.simulate(runs=20)
    for name, run in (("EKF", ekf), ("UKF", ukf)):
        means, covs, log_lik = run(ys, mask)
        rmse = np.sqrt(np.mean(np.sum((means - truth)[..., :2] ** 2, axis=-1)))
        print(f"{name}: position RMSE {rmse:.2f} m, log-likelihood {log_lik.sum():.2f}")
