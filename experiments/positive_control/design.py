"""Gains for positive systems as linear programs (SciPy's HiGHS): output feedback and, its dual, the observer.

All inequalities are elementwise. x_{k+1} = A x_k + B u_k, y = C x, A anywhere between A_low and A_high. Wanted is
u = K y that makes A + B K C >= 0 and Schur for all of them. With one output the conditions are linear in lambda and
z = K C lambda, and scaling to C lambda = 1 makes them exact. The margin is maximised: the strictness constant of the
paper's feasibility problem is smaller than the solver's tolerance.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.optimize import linprog

FEASIBLE = 1e-9  # margin above which a design counts
BISECTIONS = 40


class Design(NamedTuple):
    """What a linear program gave; ``gain`` is None if it has no solution."""

    feasible: bool
    gain: np.ndarray | None  # K (p, 1), or L (n, m)
    weights: np.ndarray | None  # (n,) lambda, or mu
    margin: float  # t, or for "decay" the smallest gamma
    message: str


def check_system(A_low: Any, A_high: Any, B: Any, C: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The four as float arrays.

    Raises:
        ValueError: shapes that do not fit, NaN or infinite entries, A_low above A_high, or a C that is negative or 0.
    """
    A_low, A_high, B, C = (np.asarray(x, float) for x in (A_low, A_high, B, C))
    n = A_low.shape[0] if A_low.ndim == 2 else -1
    if (
        A_low.shape != (n, n)
        or A_high.shape != (n, n)
        or B.ndim != 2
        or B.shape[0] != n
        or C.ndim != 2
        or C.shape[1] != n
    ):
        raise ValueError(f"shapes do not fit: A_low {A_low.shape}, A_high {A_high.shape}, B {B.shape}, C {C.shape}")
    for name, x in (("A_low", A_low), ("A_high", A_high), ("B", B), ("C", C)):
        if not np.isfinite(x).all():
            raise ValueError(f"{name}: expected finite values")
    wrong = np.argwhere(A_low > A_high)
    if len(wrong):
        i, j = (int(index) for index in wrong[0])
        raise ValueError(f"A_low[{i}, {j}] = {A_low[i, j]} is above A_high[{i}, {j}] = {A_high[i, j]}")
    if (C < 0).any() or not C.any():
        raise ValueError(f"C: expected a nonnegative matrix that is not 0, got {C.tolist()}")
    return A_low, A_high, B, C


def output_feedback(
    A_low: Any, A_high: Any, B: Any, C: Any, *, nonneg_u: bool, objective: Literal["margin", "decay"] = "margin"
) -> Design:
    """K (p, 1) for a scalar output; with ``nonneg_u`` the input stays nonnegative too (theorem 5, else theorem 4).

    Args:
        A_low: (n, n).
        A_high: (n, n).
        B: (n, p) of any sign.
        C: (1, n) >= 0.
        nonneg_u: K >= 0.
        objective: ``"margin"`` maximises t in (A_high - I) lambda + B z <= -t, lambda >= t; ``"decay"`` finds the least
            gamma with (A_high - gamma I) lambda + B z <= 0, by bisection.

    Raises:
        ValueError: see :func:`check_system`; more than one output.
    """
    A_low, A_high, B, C = check_system(A_low, A_high, B, C)
    n, p = B.shape
    if C.shape[0] != 1:
        raise ValueError(f"C: expected one row, got {C.shape[0]}; B K C is not linear in lambda and z for more")

    def program(gamma, slack):
        rows = [np.hstack([A_high - gamma * np.eye(n), B, slack * np.ones((n, 1))])]
        rows.append(np.hstack([-np.eye(n), np.zeros((n, p)), np.ones((n, 1))]))
        rows.append(np.hstack([np.zeros((n * n, n)), -np.kron(C.T, B), np.zeros((n * n, 1))]))
        right = [np.zeros(2 * n), A_low.flatten("F")]
        if nonneg_u:
            rows.append(np.hstack([np.zeros((p, n)), -np.eye(p), np.zeros((p, 1))]))
            right.append(np.zeros(p))
        return _maximise(np.vstack(rows), np.concatenate(right), np.hstack([C, np.zeros((1, p + 1))]))

    return _design(program, objective, lambda w: (w[n : n + p, None], w[:n]))


def observer(A_low: Any, A_high: Any, C: Any, *, objective: Literal["margin", "decay"] = "margin") -> Design:
    """L (n, m) with A_low - L C >= 0 and A_high - L C Schur, for any number of outputs: the dual program.

    Raises:
        ValueError: see :func:`check_system`.
    """
    A_low, A_high, _, C = check_system(A_low, A_high, np.zeros((np.shape(A_low)[0], 1)), C)
    n, m = A_low.shape[0], C.shape[0]

    def program(gamma, slack):
        # w = [mu, vec(Y), t], Y = diag(mu) L; column j of diag(mu) A - Y C
        total = np.kron(C.T, np.ones((1, n)))  # 1' Y C
        rows = [np.hstack([A_high.T - gamma * np.eye(n), -total, slack * np.ones((n, 1))])]
        rows.append(np.hstack([-np.eye(n), np.zeros((n, n * m)), np.ones((n, 1))]))
        scaled = np.vstack([np.diag(A_low[:, j]) for j in range(n)])  # vec(diag(mu) A_low)
        rows.append(np.hstack([-scaled, np.kron(C.T, np.eye(n)), np.zeros((n * n, 1))]))
        right = np.zeros(2 * n + n * n)
        return _maximise(np.vstack(rows), right, np.hstack([np.ones((1, n)), np.zeros((1, n * m + 1))]))

    def read(w):
        mu, Y = w[:n], w[n : n + n * m].reshape((n, m), order="F")
        return Y / mu[:, None], mu

    return _design(program, objective, read)


def _maximise(A_ub, b_ub, A_eq):
    """The largest last coordinate; all coordinates are free, which is not SciPy's default."""
    size = A_ub.shape[1]
    goal = np.zeros(size)
    goal[-1] = -1.0
    return linprog(goal, A_ub, b_ub, A_eq, np.ones(1), bounds=[(None, None)] * size, method="highs")


def _design(program, objective, read) -> Design:
    if objective == "margin":
        found = program(1.0, 1.0)
        if found.status != 0 or not found.x[-1] > FEASIBLE:
            margin = float(found.x[-1]) if found.status == 0 else float("nan")
            return Design(False, None, None, margin, str(found.message))
        gain, weights = read(found.x)
        return Design(True, gain, weights, float(found.x[-1]), str(found.message))
    if objective != "decay":
        raise ValueError(f"objective: expected 'margin' or 'decay', got {objective!r}")
    low, high = 0.0, 1.0
    best = program(high, 0.0)
    if best.status != 0 or not best.x[-1] > FEASIBLE:
        return Design(False, None, None, float("nan"), str(best.message))
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        found = program(middle, 0.0)
        if found.status == 0 and found.x[-1] > FEASIBLE:
            high, best = middle, found
        else:
            low = middle
    gain, weights = read(best.x)
    return Design(True, gain, weights, high, str(best.message))


class Checked(NamedTuple):
    """A closed loop over the whole box."""

    low: np.ndarray  # (n, n) A_low + B K C
    high: np.ndarray  # (n, n)
    radius: float  # of the latter
    positive: bool


def check(A_low: Any, A_high: Any, B: Any, C: Any, K: Any) -> Checked:
    """Whether a gain keeps the state positive, and the worst spectral radius.

    Raises:
        ValueError: see :func:`check_system`; a K that does not fit.
    """
    A_low, A_high, B, C = check_system(A_low, A_high, B, C)
    K = np.asarray(K, float)
    if K.shape != (B.shape[1], C.shape[0]) or not np.isfinite(K).all():
        raise ValueError(f"K: expected finite values of shape {(B.shape[1], C.shape[0])}, got {K.shape}")
    fed = B @ K @ C
    low, high = A_low + fed, A_high + fed
    return Checked(low, high, float(np.abs(np.linalg.eigvals(high)).max()), bool(low.min() >= -1e-12))


def slacks(A_low: Any, A_high: Any, B: Any, C: Any, weights: Any, z: Any) -> dict[str, float]:
    """The smallest slack of each condition of theorem 5 as printed, (16) to (20); negative = violated."""
    A_low, A_high, B, C = check_system(A_low, A_high, B, C)
    weights, z = np.asarray(weights, float), np.asarray(z, float)
    c = float(C[0] @ weights)
    return {
        "(16)": -float((A_high @ weights - weights + B @ z).max()),
        "(17)": float(weights.min()),
        "(18)": c - 1.0,
        "(19)": float(np.min(c * A_low + np.outer(B @ z, C[0]) + (1 - c) * np.eye(len(weights)))),
        "(20)": float(z.min()),
    }


def printed_rows(A_low: np.ndarray, A_high: np.ndarray, B: np.ndarray, C: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A_ub and b_ub of the paper's (23) for W = [lambda, z], without its strictness constant, by Kronecker products."""
    n, p = B.shape
    rows = [
        np.hstack([A_high - np.eye(n), B]),
        np.hstack([-np.eye(n), np.zeros((n, p))]),
        np.hstack([-C, np.zeros((1, p))]),
        np.hstack([np.outer((np.eye(n) - A_low).flatten("F"), C[0]), np.kron(-C.T, B)]),
        np.hstack([np.zeros((p, n)), -np.eye(p)]),
    ]
    right = [np.zeros(2 * n), -np.ones(1), np.eye(n).flatten("F"), np.zeros(p)]
    return np.vstack(rows), np.concatenate(right)
