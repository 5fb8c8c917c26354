"""Naive float64 NumPy versions: slow, obvious, and written apart from the library."""

from __future__ import annotations

import numpy as np


def kalman(F, H, Q, R, m0, P0, ys, mask=None, first_update_only=False):
    """Textbook Kalman filter with absent rows dropped: means, covs, log-likelihood per step."""
    mean, cov = np.array(m0, float), np.array(P0, float)
    means, covs, log_lik = [], [], []
    for k, y in enumerate(np.asarray(ys, float)):
        if not (k == 0 and first_update_only):
            mean, cov = F @ mean, F @ cov @ F.T + Q
        keep = np.ones(len(y), bool) if mask is None else np.asarray(mask)[k]
        ll = 0.0
        if keep.any():
            Hk, Rk = H[keep], R[np.ix_(keep, keep)]
            S = Hk @ cov @ Hk.T + Rk
            nu = y[keep] - Hk @ mean
            K = cov @ Hk.T @ np.linalg.inv(S)
            mean, cov = mean + K @ nu, cov - K @ S @ K.T
            ll = -0.5 * (nu @ np.linalg.solve(S, nu) + np.log(np.linalg.det(2 * np.pi * S)))
        means.append(mean)
        covs.append(cov)
        log_lik.append(ll)
    return np.array(means), np.array(covs), np.array(log_lik)


def joint_gaussian(F, H, Q, R, m0, P0, ys, mask=None, S=None, first_update_only=False):
    """Filtered and smoothed moments and the log-likelihood from one dense solve of the joint Gaussian of all states.

    F may be one matrix or one per step, and Q likewise. S is Cov(w_{k+1}, v_k).
    """
    T, m = np.shape(ys)
    n = len(m0)
    Fs = np.broadcast_to(F, (T, n, n))
    Qs = np.broadcast_to(Q, (T, n, n))
    # Independent sources: x0, then w_1..w_T, then v_1..v_T; states and measurements are linear in them.
    size = n + T * n + T * m
    noise = np.zeros((size, size))
    noise[:n, :n] = P0
    mean_source = np.zeros(size)
    mean_source[:n] = m0
    for k in range(T):
        w = slice(n + k * n, n + (k + 1) * n)
        v = slice(n + T * n + k * m, n + T * n + (k + 1) * m)
        noise[w, w] = Qs[k]
        noise[v, v] = R
        if S is not None and k + 1 < T:
            w_next = slice(n + (k + 1) * n, n + (k + 2) * n)
            noise[w_next, v] = S
            noise[v, w_next] = S.T
    row = np.zeros((n, size))
    row[:, :n] = np.eye(n)
    X, Y = [], []
    for k in range(T):
        if not (k == 0 and first_update_only):
            row = Fs[k] @ row
            row[:, n + k * n : n + (k + 1) * n] += np.eye(n)
        X.append(row)
        y_row = H @ row
        y_row[:, n + T * n + k * m : n + T * n + (k + 1) * m] += np.eye(m)
        Y.append(y_row)
    keep = np.ones((T, m), bool) if mask is None else np.asarray(mask)
    y_all = np.asarray(ys, float)

    def condition(k_state, last):
        A = np.concatenate([Y[k][keep[k]] for k in range(last + 1)])
        y = np.concatenate([y_all[k][keep[k]] for k in range(last + 1)])
        C = X[k_state] @ noise @ A.T
        S_all = A @ noise @ A.T
        prior = X[k_state] @ noise @ X[k_state].T
        gain = np.linalg.solve(S_all, C.T).T if len(y) else np.zeros((n, 0))
        return X[k_state] @ mean_source + gain @ (y - A @ mean_source), prior - gain @ C.T

    filtered = [condition(k, k) for k in range(T)]
    smoothed = [condition(k, T - 1) for k in range(T)]
    A = np.concatenate([Y[k][keep[k]] for k in range(T)])
    nu = np.concatenate([y_all[k][keep[k]] for k in range(T)]) - A @ mean_source
    S_all = A @ noise @ A.T
    log_lik = -0.5 * (nu @ np.linalg.solve(S_all, nu) + np.linalg.slogdet(S_all)[1] + len(nu) * np.log(2 * np.pi))
    stack = lambda pairs: (np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs]))  # noqa: E731
    return stack(filtered), stack(smoothed), log_lik


def random_model(rng, n, m, *, scale=1.0):
    """A stable random model with full, asymmetric F and correlated noise: (F, H, Q, R, m0, P0) in float64."""
    F = rng.normal(size=(n, n))
    F *= 0.95 / max(abs(np.linalg.eigvals(F)))
    H = rng.normal(size=(m, n))

    def covariance(k):
        A = rng.normal(size=(k, k))
        return scale * (A @ A.T + 0.1 * np.eye(k))

    return F, H, covariance(n), covariance(m), np.sqrt(scale) * rng.normal(size=n), covariance(n)
