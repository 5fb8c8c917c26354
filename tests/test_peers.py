"""The Kalman filters against other libraries, each at the tolerance that its own regularization allows."""

from __future__ import annotations

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
