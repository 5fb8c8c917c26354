"""Every test runs in strict JAX: nothing is promoted silently, and warnings are errors (see pyproject.toml)."""

from __future__ import annotations

import contextlib
import gc
import itertools
import os
from collections.abc import Callable, Iterator
from pathlib import Path

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


_finished = itertools.count(1)


@pytest.fixture(autouse=True)
def _release_programs() -> Iterator[None]:
    """Drops compiled programs before they exhaust the process's memory maps.

    Each program for the CPU holds hundreds of maps. Linux allows a process 65530 of them, beyond which XLA aborts.
    """
    yield
    if next(_finished) % 10 == 0 and _memory_maps() > 25_000:
        jax.clear_caches()
        gc.collect()


def _memory_maps() -> int:
    maps = Path("/proc/self/maps")
    return maps.read_bytes().count(b"\n") if maps.exists() else 0
