"""What several wrappers ask of the filter that they wrap."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from jaxfilt.core import Filter, Info, PyTree, StepInput
from jaxfilt.core import check_count as check_count


def predict_measurement(filt: Filter, state: PyTree, inp: StepInput) -> tuple[Array, Info]:
    """The measurement (m,) that a filter expects in ``state``, and the Info of the dry update that told it.

    Every filter's innovation is ``y - yhat``, so an update with y = 0 whose state is dropped gives ``-yhat``, and with
    ``innovation_cov`` and ``noise_cov`` also ``H P H'``. Only these parts are computed under ``jit``. All components
    are asked for, absent ones too.
    """
    _, info = filt.update(state, inp._replace(y=jnp.zeros_like(inp.y), mask=None))
    return -info.innovation, info


def covariances(info: Info, wrapper: str) -> tuple[Array, Array]:
    """``(innovation_cov, noise_cov)`` (m, m), or a ValueError at trace time if the filter does not report them."""
    if info.innovation_cov is None or info.noise_cov is None:
        raise ValueError(f"filt: {wrapper} needs a filter that reports innovation_cov and noise_cov")
    return info.innovation_cov, info.noise_cov
