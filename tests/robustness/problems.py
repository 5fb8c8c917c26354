"""The hard problems themselves, and references that share no code with the library: rational or 80-bit arithmetic."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Linear(NamedTuple):
    """A linear-Gaussian model as plain arrays, in the order of ``jf.models.linear_gaussian``."""

    F: np.ndarray
    H: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    m0: np.ndarray
    P0: np.ndarray

    def cast(self, dtype):
        return Linear(*(np.asarray(x, dtype) for x in self))


def dyer_mcreynolds(delta, dtype) -> Linear:
    """One update of P = I with H = [1 1 1; 1 1 1+delta], R = delta^2 I (Grewal and Andrews 2001, chapter 6)."""
    delta = dtype(delta)
    H = np.array([[1, 1, 1], [1, 1, dtype(1) + delta]], dtype)
    eye = np.eye(3, dtype=dtype)
    return Linear(eye, H, 0 * eye, delta * delta * np.eye(2, dtype=dtype), np.zeros(3, dtype), eye)


def bierman(e, dtype) -> Linear:
    """One update of P = I / e^2 with H = [1 e; 1 1], R = I (Bierman 1977): the posterior tends to [1 -1; -1 2].

    A third state that is not measured gives it the shape of the problem above, so that one program serves both.
    """
    e = dtype(e)
    eye = np.eye(3, dtype=dtype)
    P0 = np.diag(np.array([1, 1, 0], dtype)) / (e * e) + np.diag(np.array([0, 0, 1], dtype))
    return Linear(eye, np.array([[1, e, 0], [1, 1, 0]], dtype), 0 * eye, eye[:2, :2], np.zeros(3, dtype), P0)


def stack(problems) -> Linear:
    """Problems of equal shape with a leading axis."""
    return Linear(*(np.stack(x) for x in zip(*problems, strict=True)))


def exact_posterior(model: Linear):
    """The posterior covariance (n, n) of one update of P0, in rational arithmetic from the numbers as they are."""
    P, H, R = (_rational(x) for x in (model.P0, model.H, model.R))
    n, m = len(P), len(H)
    PH = [[sum(P[i][k] * H[a][k] for k in range(n)) for a in range(m)] for i in range(n)]
    S = [[sum(H[a][i] * PH[i][b] for i in range(n)) + R[a][b] for b in range(m)] for a in range(m)]
    W = _solve(S, [[PH[i][a] for i in range(n)] for a in range(m)])  # S^-1 H P
    return np.array([[float(P[i][j] - sum(PH[i][a] * W[a][j] for a in range(m))) for j in range(n)] for i in range(n)])


def exact_gain(model: Linear):
    """The gain (n,) of one scalar measurement, in rational arithmetic."""
    P, H, R = (_rational(x) for x in (model.P0, model.H, model.R))
    Ph = [sum(p * h for p, h in zip(row, H[0], strict=True)) for row in P]
    s = sum(h * x for h, x in zip(H[0], Ph, strict=True)) + R[0][0]
    return np.array([float(x / s) for x in Ph])


def exact_slope(delta, dtype) -> float:
    """d log-likelihood / d theta at theta = 1 of Dyer and McReynolds' update with P = theta I, R = theta delta^2 I.

    S = theta S1, so with y = [1, 1] it is -(m - y' S1^-1 y) / 2.
    """
    model = dyer_mcreynolds(delta, dtype)
    H, R = _rational(model.H), _rational(model.R)
    S = [[sum(x * y for x, y in zip(H[a], H[b], strict=True)) + R[a][b] for b in range(2)] for a in range(2)]
    w = _solve(S, [[Fraction(1)], [Fraction(1)]])
    return float(-(2 - (w[0][0] + w[1][0])) / 2)


def _rational(A):
    return [[Fraction(float(x)) for x in row] for row in np.asarray(A, np.float64)]


def _solve(S, B):
    """Gauss-Jordan in fractions; S is positive definite, so pivots need no search."""
    n = len(S)
    rows = [list(S[i]) + list(B[i]) for i in range(n)]
    for i in range(n):
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for j in range(n):
            if j != i:
                rows[j] = [x - rows[j][i] * y for x, y in zip(rows[j], rows[i], strict=True)]
    return [row[n:] for row in rows]


def filter_80_bit(model: Linear, ys, masks=None):
    """``(means, covs, log_lik per step)`` in Joseph form, one component of y after the other (R diagonal), 80 bit."""
    L = np.longdouble
    F, H, Q, R, mean, P = (np.asarray(x).astype(L) for x in model)
    ys = np.asarray(ys).astype(L)
    eye, log_2pi = np.eye(len(F), dtype=L), np.log(L(2) * np.arctan(L(1)) * 4)
    means, covs, log_lik = [], [], []
    for k, y in enumerate(ys):
        mean, P = F @ mean, F @ P @ F.T + Q
        total = L(0)
        for i, h in enumerate(H):
            if masks is not None and not masks[k][i]:
                continue
            Ph = P @ h
            s = h @ Ph + R[i, i]
            gain, nu = Ph / s, y[i] - h @ mean
            mean = mean + gain * nu
            A = eye - np.outer(gain, h)
            P = A @ P @ A.T + R[i, i] * np.outer(gain, gain)
            P = (P + P.T) / 2
            total += -(nu * nu / s + np.log(s) + log_2pi) / 2
        means.append(mean)
        covs.append(P)
        log_lik.append(total)
    return np.array(means), np.array(covs), np.array(log_lik)


def velocity(q=3.0, r=25.0, P0=None, noise="continuous", dt=1.0) -> Linear:
    """Constant velocity on one axis, position measured."""
    g = np.array([dt**2 / 2, dt])
    Q = q * (np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) if noise == "continuous" else np.outer(g, g))
    P0 = np.diag([100.0, 25.0]) if P0 is None else np.asarray(P0, float)
    return Linear(np.array([[1, dt], [0, 1]]), np.eye(1, 2), Q, np.array([[r]]), np.array([0.0, 10.0]), P0)


def acceleration(q=0.01, r=25.0, P0=1e4, dt=1.0) -> Linear:
    """Constant acceleration on one axis (white jerk of density q), position measured."""
    F = np.array([[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, 1]])
    Q = q * np.array(
        [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2], [dt**3 / 6, dt**2 / 2, dt]]
    )
    return Linear(F, np.eye(1, 3), Q, np.array([[r]]), np.zeros(3), P0 * np.eye(3))


def draw(model: Linear, T, seed):
    """Measurements (T, m) of a path drawn from the model, float64."""
    rng = np.random.default_rng(seed)
    n, m = len(model.F), len(model.H)
    L = [_root(x) for x in (model.P0, model.Q, model.R)]
    x, w, v = model.m0 + L[0] @ rng.normal(size=n), rng.normal(size=(T, n)) @ L[1].T, rng.normal(size=(T, m)) @ L[2].T
    ys = np.empty((T, m))
    for k in range(T):
        x = model.F @ x + w[k]
        ys[k] = model.H @ x + v[k]
    return ys


def _root(A):
    values, vectors = np.linalg.eigh(np.asarray(A, float))
    return vectors * np.sqrt(np.maximum(values, 0))


def indefiniteness(cov) -> float:
    """How negative the smallest eigenvalue is, in units of n eps times the largest; the worst over leading axes."""
    cov = np.asarray(cov)
    eps = float(jnp.finfo(cov.dtype).eps)
    values = np.linalg.eigvalsh(cov.astype(np.float64))
    largest = np.maximum(np.abs(values).max(axis=-1), np.finfo(float).tiny)
    return float((-values[..., 0] / (largest * cov.shape[-1] * eps)).max())


def asymmetric(cov) -> int:
    """The number of matrices that are not symmetric to the bit."""
    cov = np.asarray(cov)
    return int((cov != np.swapaxes(cov, -1, -2)).any(axis=(-1, -2)).sum())


def relative(got, want, axes=None) -> float:
    """The largest deviation over the largest value (over each of the leading entries where ``axes`` are given)."""
    got, want = np.asarray(got, np.float64), np.asarray(want, np.float64)
    if got.size == 0:
        return 0.0
    size = np.abs(want).max(axis=axes, keepdims=True)
    return float((np.abs(got - want) / np.where(size > 0, size, 1.0)).max())


def norm_error(got, want) -> np.ndarray:
    """The Frobenius norm of the error over that of the exact matrix, for stacks."""
    got, want = np.asarray(got, np.float64), np.asarray(want, np.float64)
    return np.linalg.norm(got - want, axis=(-2, -1)) / np.linalg.norm(want, axis=(-2, -1))


def not_finite(tree) -> int:
    """The number of NaN and infinite entries."""
    return sum(int((~np.isfinite(np.asarray(leaf))).sum()) for leaf in jax.tree.leaves(tree))


def without(status, bit) -> int:
    """The number of status words in which a bit is missing."""
    return int(((np.asarray(status) & int(bit)) == 0).sum())


def having(status, bit) -> int:
    """The number of status words that have a bit."""
    return int(((np.asarray(status) & int(bit)) != 0).sum())


def kalman_py_s4() -> Linear:
    """The ill-conditioned model S4 of kalman-py, by the rule that made it: precise sensors, random geometry, seed 1."""
    rng = np.random.default_rng(1)
    dt, q = rng.uniform(0.01, 1.0), 10.0 ** rng.uniform(-4, 1)
    one = velocity(q=q, dt=dt)
    H, B = rng.normal(size=(2, 4)), rng.normal(size=(2, 2))
    R = 1e-4 * (B @ B.T + 0.1 * np.eye(2))
    eye = np.eye(2)
    return Linear(np.kron(one.F, eye), H, np.kron(one.Q, eye), R, np.zeros(4), np.eye(4))
