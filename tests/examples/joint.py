"""Particle filters over modes and classes, and the bank of filters for several hypotheses."""

from __future__ import annotations

import jax
import numpy as np

import jaxfilt as jf
from tests.examples import GAP, LINEAR, Example

COUNT = 24


def _model(p, scale):
    return jf.models.linear_gaussian(**{**p, "Q": scale * p["Q"]})


def _joint(p):
    models = [[_model(p["model"], a), _model(p["model"], b)] for a, b in ((0.5, 1.0), (2.0, 4.0))]
    return jf.joint_particle(models, ((0.9, 0.1), (0.2, 0.8)), COUNT, threshold=p["threshold"], keep=True)


def _multi(p):
    """Neither resampled nor switched between modes, so that it is a smooth function of its parameters."""
    return jf.multi_mode_particle([_model(p["model"], 1.0)], ((1.0,),), COUNT, threshold=0.0)


def _bank(p):
    return jf.bank([jf.kalman(_model(p["model"], 1.0)), jf.extended(jf.models.nonlinear(**_as_functions(p["model"]))),
                    jf.kalman(_model(p["model"], 4.0))])  # fmt: skip


def _as_functions(p):
    return {
        "f": jax.tree_util.Partial(_linear, p["F"]), "h": jax.tree_util.Partial(_linear, p["H"]),
        **{name: p[name] for name in ("Q", "R", "m0", "P0")},
    }  # fmt: skip


def _linear(matrix, x, u, dt):
    del u, dt
    return matrix @ x


_OPTIONS = {**GAP, "key": jax.random.key(3)}
_CHOSEN = "which particles and modes are drawn is a step function of the parameters; differences reach across a step"

EXAMPLES: dict[str, Example] = {
    "bank": Example(jf.bank, _bank, {"model": LINEAR}, options=GAP),
    "joint_particle": Example(
        jf.joint_particle, _joint, {"model": LINEAR, "threshold": np.array(0.5)}, options=_OPTIONS,
        exempt={"differences": _CHOSEN},
    ),
    "multi_mode_particle": Example(
        jf.multi_mode_particle, _multi, {"model": LINEAR}, options=_OPTIONS, twin=True,
    ),
}  # fmt: skip
