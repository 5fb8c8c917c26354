"""A target tracked by radar with lost scans: extended and unscented Kalman filter with jaxfilt."""

import jax
import numpy as np
import range_bearing_data as data

import jaxfilt as jf

jax.config.update("jax_enable_x64", True)

motion = jf.models.constant_velocity(dt=data.DT, q=data.Q, r=1.0, m0=data.M0, P0=data.P0)
# the radar in place of the sensor that the motion model brings along
model = jf.models.with_sensor(motion, jf.models.sensors.range_bearing(data.R))


def track(filt, ys, mask):
    """One run: estimates (T, 4), their covariances (T, 4, 4), log-likelihood ()."""
    out = jf.filter(filt, ys, mask=mask)
    return out.mean, out.cov, out.log_lik.sum()


def ekf(ys, mask):
    """The extended Kalman filter of all runs."""
    return jf.batch(track, (None, 0, 0))(jf.extended(model), ys, mask)


def ukf(ys, mask):
    """The unscented Kalman filter of all runs."""
    return jf.batch(track, (None, 0, 0))(jf.unscented(model), ys, mask)


if __name__ == "__main__":
    truth, ys, mask = data.simulate(runs=20)
    for name, run in (("EKF", ekf), ("UKF", ukf)):
        means, covs, log_lik = run(ys, mask)
        rmse = np.sqrt(np.mean(np.sum((means - truth)[..., :2] ** 2, axis=-1)))
        print(f"{name}: position RMSE {rmse:.2f} m, log-likelihood {log_lik.sum():.2f}")
