"""The encoder's electronics: the capacitance network of stator and rotor, the signal chain, the converter's loop."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array


class Capacitances(NamedTuple):
    """Of one cycle of electrodes; any unit. The values are arbitrary: none are published."""

    stator: float = 10.0  # c_st, a stator phase's own
    rotor: float = 14.0  # c_sl, a rotor phase's own without the induction electrode
    adjacent: float = 0.6  # c_ta, between neighbouring stator phases
    opposite: float = 0.3  # c_tb
    between: float = 0.8  # c_l, between the rotor phases
    induction: float = 6.0  # c_i, rotor phase to its induction electrode
    mean: float = 3.0  # C_mo, stator to rotor: C_mo + C_ml cos theta
    modulation: float = 1.2  # C_ml


def matrix(theta: float, c: Capacitances) -> np.ndarray:
    """The (8, 8) matrix ``q = C v`` of stator phases 1 to 4, rotor phases 5 and 6, induction electrodes 7 and 8."""
    C = np.zeros((8, 8))

    def couple(i, j, value):
        C[i, j] = C[j, i] = value

    C[range(4), range(4)] = c.stator
    C[[4, 5], [4, 5]] = c.rotor + c.induction
    C[[6, 7], [6, 7]] = c.induction  # drops out: their charges are not asked for
    for j in range(4):
        couple(j, (j + 1) % 4, -c.adjacent)
        for k in (0, 1):
            couple(j, 4 + k, -c.mean - c.modulation * np.cos(theta - j * np.pi / 2 - k * np.pi))
    for j in (0, 1):
        couple(j, j + 2, -c.opposite)
    couple(4, 5, -c.between)
    couple(4, 6, -c.induction)
    couple(5, 7, -c.induction)
    return C


def receiver_voltages(theta: float, c: Capacitances) -> np.ndarray:
    """(4,) voltages of the stator phases per unit of excitation: no charge flows to them or to the floating rotor."""
    C = matrix(theta, c)
    return np.linalg.solve(C[:6, :6], -C[:6, 6:] @ np.array([1.0, -1.0]))[:4]


def network_gain(c: Capacitances) -> float:
    """K_c in closed form, eq. (8)."""
    own = (c.induction + c.between + c.rotor) * (c.stator + c.opposite)
    return 2 * c.induction * c.modulation / (own - 4 * c.modulation**2)


CARRIER, SAMPLING = 20e3, 1e6  # [Hz]


def demodulated(theta: Array) -> Array:
    """Carrier-level signals: (n, 2) from angles (n * SAMPLING / CARRIER,) at 1 MHz.

    Each is multiplied by the carrier and averaged over one of its periods; scaled to amplitude 1.
    """
    period = round(SAMPLING / CARRIER)
    carrier = jnp.sin(2 * np.pi / period * jnp.arange(theta.shape[0], dtype=theta.dtype))
    received = jnp.stack([jnp.cos(theta), jnp.sin(theta)], axis=1) * carrier[:, None]
    return 2 * (received * carrier[:, None]).reshape(-1, period, 2).mean(axis=1)


# --------------------------------------------------------------------------------------------- the converter AD2S1210

CLOCK, K1 = 4.096e6, 0.63
# bits: k2, a, b, 1/c; and the data sheet's t1 [s], t2 [s], K_a [1/s^2]
LOOPS = {
    10: ((6e6 * 2 * np.pi, 8187 / 8192, 509 / 512, 1_024_000), (0.4e-3, 42e-6, 39.6e6)),
    12: ((18e6 * 2 * np.pi, 4095 / 4096, 4085 / 4096, 4_096_000), (1e-3, 91e-6, 6.5e6)),
    14: ((82e6 * 2 * np.pi, 8191 / 8192, 16359 / 16384, 16_384_000), (2e-3, 160e-6, 1.6e6)),
    16: ((66e6 * 2 * np.pi, 32767 / 32768, 32757 / 32768, 65_536_000), (8e-3, 728e-6, 92.7e3)),
}


def loop_constants(bits: int) -> tuple[float, float, float]:
    """``(t1, t2, K_a)`` of the converter's loop ``k1 k2 I^2 C`` from its coefficients."""
    k2, a, b, inverse = LOOPS[bits][0]
    t = 1 / CLOCK
    gain = K1 * k2 * (1 - a) / (1 - b) / (inverse * t) ** 2
    return 0.5 * t * (1 + a) / (1 - a), 0.5 * t * (1 + b) / (1 - b), gain


def loop_gains(bits: int, dt: float) -> tuple[float, float]:
    """``(alpha, beta)`` of the loop at a sampling interval [s], without its second pole."""
    t1, _, gain = loop_constants(bits)
    return gain * t1 * dt, gain * dt**2
