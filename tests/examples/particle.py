"""Particle filters."""

from __future__ import annotations

import jax
import numpy as np

import jaxfilt as jf
from tests.examples import GAP, LINEAR, Example

COUNT = 25


def _particle(p):
    return jf.particle(jf.models.linear_gaussian(**p["model"]), COUNT, threshold=p["threshold"])


def _guided(p):
    """Never resampled, so that it is a smooth function of its parameters."""
    return jf.particle(jf.models.linear_gaussian(**p["model"]), COUNT, guide=jf.extended, threshold=0.0)


def _transport(p):
    """Moved instead of drawn, in every step: a smooth function too."""
    model = jf.models.linear_gaussian(**p["model"])
    return jf.particle(model, COUNT, threshold=1.0, gradient="transport", epsilon=p["epsilon"], sweeps=10)


_OPTIONS = {**GAP, "key": jax.random.key(3)}
_DRAWN = "the process noise of a missed step is drawn too, so the mean is that of the draws"
_CHOSEN = "which particles are drawn again is a step function of the weights; differences reach across a step"

EXAMPLES: dict[str, Example] = {
    "particle": Example(
        jf.particle,
        _particle,
        {"model": LINEAR, "threshold": np.array(0.5)},
        options=_OPTIONS,
        exempt={"all_false_mask": _DRAWN, "differences": _CHOSEN},
        twin=True,
    ),
    "particle_transport": Example(
        jf.particle,
        _transport,
        {"model": LINEAR, "epsilon": np.array(0.5)},
        options=_OPTIONS,
        exempt={"all_false_mask": _DRAWN},
        twin=True,
    ),
    "particle_guided": Example(
        jf.particle, _guided, {"model": LINEAR}, options=_OPTIONS, exempt={"all_false_mask": _DRAWN}, twin=True
    ),
}
