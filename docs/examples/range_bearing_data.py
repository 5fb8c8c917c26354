"""The problem that both trackers solve: a target that passes a radar, with lost scans. NumPy only."""

import numpy as np

DT = 1.0  # s between scans
Q = 0.1  # m²/s³, spectral density of the white acceleration, per axis
R = np.diag([20.0**2, np.deg2rad(1.0) ** 2])  # m², rad²
M0 = np.array([-2000.0, -600.0, 4.0, 12.0])  # x, y [m], vx, vy [m/s], one scan before the first
P0 = np.diag([200.0**2, 200.0**2, 10.0**2, 10.0**2])
SCANS = 100


def simulate(runs, seed=0):
    """Truth (runs, T, 4), measurements (runs, T, 2) in m and rad, mask (runs, T): False where a scan is lost."""
    rng = np.random.default_rng(seed)
    block = np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]])
    root = np.linalg.cholesky(Q * np.kron(block, np.eye(2)))
    F = np.eye(4) + DT * np.eye(4, k=2)
    x = rng.multivariate_normal(M0, P0, size=runs)
    truth = np.empty((runs, SCANS, 4))
    for k in range(SCANS):
        x = x @ F.T + rng.standard_normal((runs, 4)) @ root.T
        truth[:, k] = x
    ys = np.stack([np.hypot(truth[..., 0], truth[..., 1]), np.arctan2(truth[..., 1], truth[..., 0])], axis=-1)
    ys = ys + rng.standard_normal(ys.shape) * np.sqrt(np.diag(R))
    ys[..., 1] = (ys[..., 1] + np.pi) % (2 * np.pi) - np.pi  # the target crosses the line where bearings jump
    mask = rng.random((runs, SCANS)) > 0.1
    mask[:, 40:50] = False  # and is not seen at all for ten scans
    return truth, ys, mask
