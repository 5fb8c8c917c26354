"""Filters for randomly delayed and lost measurements."""

from __future__ import annotations

import numpy as np

import jaxfilt as jf
from tests.examples import GAP, LINEAR, Example

_ZERO = "a masked sample means that nothing arrived, which this filter's model reads as a measurement of 0"


def _delayed(p):
    """One delay for both channels, with all that a model may have."""
    model = jf.models.linear_gaussian(**p["model"], S=p["S"])
    return jf.delayed_kalman(model, jf.models.delay_probabilities(p["alpha"]))


def _adaptive(p):
    """A delay for each channel, with forgetting, which is tunable."""
    options = {"forgetting": p["forgetting"], "bounds": (p["smallest"], 50.0), "covariance": "inflated"}
    probabilities = jf.models.delay_probabilities(p["alpha"])
    model = jf.models.linear_gaussian(**p["model"])
    return jf.adaptive_delayed_kalman(model, probabilities, second_moment="posterior", **options)


EXAMPLES: dict[str, Example] = {
    "delayed_kalman": Example(
        jf.delayed_kalman,
        _delayed,
        {"model": LINEAR, "S": np.array([[0.2, 0.0], [0.1, -0.1], [0.0, 0.1]]), "alpha": np.array([0.6, 0.5, 0.3])},
        options=GAP,
        exempt={"all_false_mask": _ZERO},
    ),
    "adaptive_delayed_kalman": Example(
        jf.adaptive_delayed_kalman,
        _adaptive,
        {
            "model": LINEAR,
            "alpha": np.array([[0.6, 0.5], [0.7, 0.2]]),
            "forgetting": np.array(0.6),
            "smallest": np.array(0.05),
        },
        options=GAP,
        exempt={"all_false_mask": _ZERO},
        twin=True,
    ),
}
