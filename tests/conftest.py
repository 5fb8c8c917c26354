"""Every test runs in strict JAX: nothing is promoted silently, and warnings are errors (see pyproject.toml)."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator

os.environ.setdefault("MPLBACKEND", "Agg")

import hypothesis
import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# The first example compiles, which no deadline allows for; the same examples each time, as with our own seeds.
hypothesis.settings.register_profile("jaxfilt", deadline=None, derandomize=True)
hypothesis.settings.load_profile("jaxfilt")


@contextlib.contextmanager
def _lenient() -> Iterator[None]:
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture
def lenient() -> Callable[[], contextlib.AbstractContextManager[None]]:
    """For code that is not ours, as the peers': ``with lenient(): ...`` promotes as JAX does by default."""
    return _lenient
