"""The problems that all libraries solve: models as NumPy arrays, data, and the functions of the nonlinear ones.

Every run has its own R (a factor exp(log_r) on R0), so that no library can share covariances between runs. The prior is
one step before the first sample.
"""

from __future__ import annotations

from math import factorial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

DT, OMEGA_WALK = 1.0, 1e-7
CV, CA = 2, 3  # derivatives in the state, position included


class Problem(NamedTuple):
    """One model; ``order`` is 0 where F is dense, ``q`` the noise by IMM mode (one elsewhere)."""

    name: str
    family: str  # kalman, ekf, ukf or imm
    order: int
    q: tuple[float, ...]
    F: np.ndarray  # (n, n); of the EKF its Jacobian at m0
    H: np.ndarray  # (m, n), linear sensors
    Q: np.ndarray  # (n, n)
    R0: np.ndarray  # (m, m), of log_r = 0
    m0: np.ndarray  # (n,)
    P0: np.ndarray  # (n, n)

    @property
    def n(self) -> int:
        """Components of the state."""
        return len(self.m0)

    @property
    def m(self) -> int:
        """Components of a measurement."""
        return len(self.R0)

    def astype(self, dtype: Any) -> Problem:
        """With arrays of this dtype."""
        return self._replace(**{key: getattr(self, key).astype(dtype) for key in ("F", "H", "Q", "R0", "m0", "P0")})


class Data(NamedTuple):
    """Input of a batch."""

    log_r: np.ndarray  # (B,)
    ys: np.ndarray  # (B, T, m)

    def first(self, runs: int) -> Data:
        """The first runs."""
        return Data(self.log_r[:runs], self.ys[:runs])


def motion(order: int, axes: int, q: float) -> tuple[np.ndarray, np.ndarray]:
    """F and Q of white noise on the derivative ``order``; state [positions, velocities, ...]."""
    lag = np.arange(order)[None, :] - np.arange(order)[:, None]
    F = np.where(lag >= 0, 1.0 / np.vectorize(factorial)(np.maximum(lag, 0)), 0.0) * DT ** np.maximum(lag, 0)
    e = np.arange(order - 1, -1, -1)
    f = np.vectorize(factorial)(e).astype(float)
    power = e[:, None] + e[None, :] + 1
    Q = q * DT**power / (np.outer(f, f) * power)
    return np.kron(F, np.eye(axes)), np.kron(Q, np.eye(axes))


def linear(n: int, m: int, order: int, *, dense: bool = False) -> Problem:
    """A Kalman filter's problem; ``dense`` turns the state's axes, which leaves the likelihood as it is."""
    F, Q = motion(order, m, 0.1)
    H, R0, m0 = np.eye(m, n), np.eye(m), np.repeat([0.0, 1.0, 0.1][:order], m)
    P0 = np.diag(np.repeat([4.0, 1.0, 0.25][:order], m))
    if dense:
        T = np.linalg.qr(np.random.default_rng(n).normal(size=(n, n)))[0]
        F, H, Q, m0, P0 = T @ F @ T.T, H @ T.T, T @ Q @ T.T, T @ m0, T @ P0 @ T.T
        Q, P0 = (Q + Q.T) / 2, (P0 + P0.T) / 2
    name = f"n = {n}, m = {m}, {'dense F' if dense else {CV: 'CV', CA: 'CA'}[order]}"
    return Problem(name, "kalman", 0 if dense else order, (0.1,), F, H, Q, R0, m0, P0)


def range_bearing(family: str) -> Problem:
    """Coordinated turn of unknown rate (EKF) or constant velocity (UKF), seen by range and bearing."""
    turn = family == "ekf"
    F, Q = motion(CV, 2, 0.1)
    m0, P0 = np.array([3000.0, 3000.0, 10.0, 5.0]), np.diag([100.0, 100.0, 4.0, 4.0])
    if turn:
        m0, P0 = np.append(m0, 0.02), _block(P0, 1e-4)
        Q = _block(Q, OMEGA_WALK * DT)
        F = turn_jacobian(m0)
    R0 = np.diag([25.0, 4e-4])
    name = "n = 5, coordinated turn" if turn else "n = 4, CV"
    return Problem(f"{name}, range and bearing", family, CV, (0.1,), F, np.zeros((2, len(m0))), Q, R0, m0, P0)


def modes() -> Problem:
    """Three models of constant velocity that differ in their noise."""
    base = linear(4, 2, CV)
    return base._replace(name="3 models CV, n = 4", family="imm", q=(0.01, 0.1, 1.0))


TRANSITION = np.array([[0.9, 0.05, 0.05], [0.05, 0.9, 0.05], [0.05, 0.05, 0.9]])


def turn(x: Any) -> Any:
    """One step of a coordinated turn, as a user of any library would write it."""
    w = jnp.where(jnp.abs(x[4]) < 1e-9, jnp.full_like(x[4], 1e-9), x[4])
    s, c = jnp.sin(w * DT), jnp.cos(w * DT)
    return jnp.stack([
        x[0] + s / w * x[2] - (1 - c) / w * x[3], x[1] + (1 - c) / w * x[2] + s / w * x[3],
        c * x[2] - s * x[3], s * x[2] + c * x[3], x[4],
    ])  # fmt: skip


def straight(x: Any) -> Any:
    """One step of constant velocity."""
    return jnp.stack([x[0] + DT * x[2], x[1] + DT * x[3], x[2], x[3]])


def polar(x: Any) -> Any:
    """Range and bearing. No target comes near the line where bearings jump: peers need no residual."""
    return jnp.stack([jnp.hypot(x[0], x[1]), jnp.arctan2(x[1], x[0])])


def turn_jacobian(m: np.ndarray) -> np.ndarray:
    """The derivative of :func:`turn` by central differences of complex size: exact to rounding."""
    h = 1e-30
    columns = []
    for i in range(5):
        x = m.astype(complex)
        x[i] += 1j * h
        w = x[4]
        s, c = np.sin(w * DT), np.cos(w * DT)
        y = [x[0] + s / w * x[2] - (1 - c) / w * x[3], x[1] + (1 - c) / w * x[2] + s / w * x[3],
             c * x[2] - s * x[3], s * x[2] + c * x[3], x[4]]  # fmt: skip
        columns.append(np.imag(y) / h)
    return np.stack(columns, axis=1)


def turned(m: np.ndarray) -> np.ndarray:
    """:func:`turn` in NumPy."""
    w = m[4]
    s, c = np.sin(w * DT), np.cos(w * DT)
    return np.array([m[0] + s / w * m[2] - (1 - c) / w * m[3], m[1] + (1 - c) / w * m[2] + s / w * m[3],
                     c * m[2] - s * m[3], s * m[2] + c * m[3], w])  # fmt: skip


def at_first_sample(p: Problem) -> tuple[np.ndarray, np.ndarray]:
    """The prior at the first sample, predicted by NumPy, for a library that takes it there."""
    m0 = turned(p.m0) if p.family == "ekf" else p.F @ p.m0
    P = p.F @ p.P0 @ p.F.T + p.Q
    return m0.astype(p.m0.dtype), ((P + P.T) / 2).astype(p.P0.dtype)


def simulate(p: Problem, runs: int, steps: int, seed: int = 0, distinct: int = 4096) -> Data:
    """Data from the model; beyond ``distinct`` runs they repeat, which costs a filter the same."""
    rng = np.random.default_rng(seed)
    B = min(runs, distinct)
    log_r = rng.uniform(-1, 1, B)
    root, noise = np.linalg.cholesky(p.P0), np.linalg.cholesky(p.Q + 1e-18 * np.eye(p.n))
    x = p.m0 + rng.normal(size=(B, p.n)) @ root.T
    if p.family == "ekf":
        x[:, 4] = p.m0[4] + 0.003 * rng.normal(size=B)
    scale = np.exp(log_r / 2)[:, None] * np.sqrt(np.diag(p.R0))
    ys = np.empty((B, steps, p.m))
    for k in range(steps):
        x = (turned(x.T).T if p.family == "ekf" else x @ p.F.T) + rng.normal(size=x.shape) @ noise.T
        seen = np.stack([np.hypot(x[:, 0], x[:, 1]), np.arctan2(x[:, 1], x[:, 0])], 1) if p.family in ("ekf", "ukf") \
            else x @ p.H.T  # fmt: skip
        ys[:, k] = seen + scale * rng.normal(size=seen.shape)
    repeat = -(-runs // B)
    log_r, ys = np.tile(log_r, repeat)[:runs], np.tile(ys, (repeat, 1, 1))[:runs]
    return Data(log_r.astype(p.m0.dtype), ys.astype(p.m0.dtype))


def _block(A, last):
    out = np.zeros((len(A) + 1, len(A) + 1))
    out[:-1, :-1], out[-1, -1] = A, last
    return out


KALMAN = (
    linear(2, 1, CV), linear(4, 2, CV), linear(4, 2, CV, dense=True), linear(6, 2, CA), linear(6, 2, CA, dense=True),
    linear(9, 3, CA),
)  # fmt: skip
NONLINEAR = {"ekf": range_bearing("ekf"), "ukf": range_bearing("ukf"), "imm": modes()}
