"""The line-of-sight loop of a remotely guided vehicle: gains, the loop as the estimator sees it, and the plant alone.

The lateral distance h from the line of sight obeys, with the command ``u_c`` and the loop's gain K(t)::

    K d/dt((h''' + u_c') / K) + K u_c' = w,    u_c = K_p h + K_D h' + int K_I h dt

The feedback eliminated, ``h'''' + a_4 h''' + a_3 h'' + a_2 h' + a_1 h = w``: an autonomous system, which is what the
estimator's model is. Source: Nikfetrat, Mahboobi Esfanjani and Azimi 2017, eqs. (1) to (6), corrected; the gains are
ours, since the paper prints none.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm

import jaxfilt as jf

DT, T = 0.1, 35  # s, samples
QW, R = 1500.0, 0.01  # (m/s^4)^2 per sample, m^2
D = 2  # samples, the longest delay
P0 = (0.01, 2.5, 2000.0, 9000.0)
M0 = (45.0, -45.0, 0.0, 0.0)
INTEGRAL_FROM = 10  # the first sample of the integral term in the paper, 0.95 s


class Gains(NamedTuple):
    """The loop's gains at times t, and their slopes; all are straight lines in time."""

    p: np.ndarray
    d: np.ndarray
    i: np.ndarray
    k: np.ndarray


# Value at t = 0, and relative slope per second.
START = Gains(*map(np.asarray, (34.0, 12.0, 110.0, 3.4)))
SLOPE = Gains(*map(np.asarray, (0.05, 0.05, 0.05, -0.05)))


def gains(t: np.ndarray) -> tuple[Gains, Gains]:
    """The gains at t [s] and their time derivatives."""
    values = Gains(*(g0 * (1 + c * t) for g0, c in zip(START, SLOPE, strict=True)))
    return values, Gains(*(g0 * c * np.ones_like(t) for g0, c in zip(START, SLOPE, strict=True)))


def coefficients(t: np.ndarray) -> np.ndarray:
    """a_1..a_4 (..., 4) of the loop at t (...) [s]."""
    g, slope = gains(t)
    rest = g.k - slope.k / g.k
    a = (
        rest * (slope.p + g.i) + slope.i,
        rest * (slope.d + g.p) + 2 * slope.p + g.i,
        rest * g.d + 2 * slope.d + g.p,
        g.d - slope.k / g.k,
    )
    return np.stack(a, axis=-1)


def discrete() -> tuple[np.ndarray, np.ndarray]:
    """A (T, 4, 4) and B (T, 4) of the interval that begins at each sample, coefficients frozen at its begin."""
    Ac = np.zeros((T, 4, 4))
    Ac[:, np.arange(3), np.arange(1, 4)] = 1.0
    Ac[:, 3] = -coefficients(DT * np.arange(T))
    return zero_order_hold(Ac, np.eye(4)[:, 3:])


def zero_order_hold(Ac: np.ndarray, Bc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact (A, B) over DT for ``x' = Ac x + Bc u`` with u held; Ac (T, n, n), Bc (n, p) or (T, n, p)."""
    n, p = Bc.shape[-2:]
    block = np.zeros((len(Ac), n + p, n + p))
    block[:, :n, :n], block[:, :n, n:] = Ac, Bc
    both = expm(DT * block)[:, :n]
    return both[:, :, :n], both[:, :, n:] if p > 1 else both[:, :, n]


def inputs(known: np.ndarray | float = 0.0) -> dict[str, np.ndarray]:
    """What varies with time, as ``u`` of a filter; ``known`` (T,) is the known input [m/s^4] from each sample on.

    A filter's ``u[k]`` belongs to the interval that *ends* at k, so everything moves up by one; entry 0 is not used.
    """
    A, B = discrete()
    before = np.maximum(np.arange(T) - 1, 0)
    A, B, known = A[before], B[before], np.broadcast_to(known, T)[before]
    return {"F": A, "Q": QW * B[:, :, None] * B[:, None, :], "input": known[:, None] * B}


def _transition(u: Any, dt: Any) -> Any:
    del dt
    return u["F"]


def _noise(u: Any, dt: Any) -> Any:
    del dt
    return u["Q"]


def _input(u: Any, dt: Any) -> Any:
    del dt
    return u["input"]


def model(m0: Any = M0, P0: Any = P0) -> jf.models.LinearGaussian:
    """The loop with its feedback, x = [h, h', h'', h'''], driven by :func:`inputs`; h is measured."""
    return jf.models.linear_gaussian(
        _transition, np.eye(1, 4), _noise, [[R]], np.array(m0, float), np.diag(P0), B=_input
    )  # fmt: skip


def command_weights() -> np.ndarray:
    """(T, 3) of h, h' and the integral's increments ``DT K_I h`` in the command [m/s^2]."""
    g, _ = gains(DT * np.arange(T))
    return np.stack([g.p, g.d, DT * g.i], axis=-1)
