"""Bearing and Doppler shift of a tone, and the wrappers that came with it."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

import jaxfilt as jf
from jaxfilt.models.sensors import apart
from tests.examples import GAP, LINEAR, Example

_TONE = {
    "m0": np.array([30.0, 40.0, -1.0, 0.5, 2.0]),
    "P0": np.diag([20.0, 30.0, 0.5, 0.6, 0.3]),
    "q": np.array([0.01, 0.02, 0.03, 0.03, 0.01]),
    "R": np.array([[0.3, 0.01], [0.01, 0.5]]),
    "speed": np.array(30.0),
    "observer": np.array([-2.0, 3.0, 0.4, 0.2]),
}


def tone(p, doppler="first"):
    """Constant velocity and frequency, heard by an observer: n = 5, m = 2."""
    F = jnp.eye(5, dtype=p["m0"].dtype).at[0, 2].set(1).at[1, 3].set(1)
    motion = jf.models.linear_gaussian(F, jnp.eye(2, 5, dtype=F.dtype), jnp.diag(p["q"]), p["R"], p["m0"], p["P0"])
    options = {"speed": p["speed"], "observer": p["observer"], "doppler": doppler}
    return jf.models.with_sensor(motion, jf.models.sensors.bearing_doppler(p["R"], **options))


def _modified_covariance(p):
    return jf.extended(tone(p), relinearize=True)


def _residual_r(p):
    return jf.residual_r(jf.kalman(jf.models.linear_gaussian(**p["model"])), rate=p["rate"], largest=p["largest"])


def _residual_tone(p):
    return jf.residual_r(jf.extended(tone(p["tone"], "exact")), rate=p["rate"])


def _nis_q(p):
    return jf.nis_q(jf.kalman(jf.models.linear_gaussian(**p["model"])), window=3, largest=p["largest"])


def _usable_where(p):
    return jf.usable_where(jf.extended(tone(p)), Partial(apart, 1.0, p["observer"]))


def _matching_rate(p):
    return jf.covariance_matching(jf.kalman(jf.models.linear_gaussian(**p["model"])), window=4, rate=p["rate"])


_RATE = {"rate": np.array(0.2)}

EXAMPLES: dict[str, Example] = {
    "modified_covariance": Example(jf.extended, _modified_covariance, _TONE, options=GAP, twin=True),
    "residual_r": Example(
        jf.residual_r, _residual_r, {"model": LINEAR, **_RATE, "largest": np.array(80.0)}, options=GAP
    ),
    "residual_tone": Example(jf.residual_r, _residual_tone, {"tone": _TONE, **_RATE}, options=GAP, twin=True),
    "nis_q": Example(jf.nis_q, _nis_q, {"model": LINEAR, "largest": np.array(50.0)}, options=GAP),
    "usable_where": Example(jf.usable_where, _usable_where, _TONE, options=GAP, twin=True),
    "matching_rate": Example(
        jf.covariance_matching, _matching_rate, {"model": LINEAR, **_RATE}, options=GAP, twin=True
    ),
}
