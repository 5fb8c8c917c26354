"""Change indication: each registered filter still gives the trajectory that is committed."""

from __future__ import annotations

import numpy as np
import pytest

from tests.registry import REGISTRY
from tests.robustness import trajectories

DEFAULT = {"kalman", "extended", "imm"}  # the others are slow tests: most of the time goes into compiling
# In the group of the filter's other generic tests, whose compiled program this uses.
MARKED = [
    pytest.param(name, marks=[pytest.mark.xdist_group(name), *[pytest.mark.slow] * (name not in DEFAULT)])
    for name in sorted(REGISTRY)
]


@pytest.mark.parametrize("name", MARKED)
def test_a_filter_gives_its_committed_trajectory(name):
    found = trajectories.changes(trajectories.read(name), trajectories.compute(name))
    assert not found, f"{name} changed; if that is meant, python -m tests.robustness.trajectories:\n" + "\n".join(found)


def test_every_filter_has_a_trajectory():
    assert {file.stem for file in trajectories.FOLDER.glob("*.csv")} == set(REGISTRY)


def test_a_change_is_told_with_its_first_step():
    old = trajectories.read("kalman")
    new = {key: x.copy() for key, x in old.items()}
    new["mean_0"][5:] += 1e-6 * np.abs(old["mean_0"]).max()
    assert trajectories.changes(old, old) == []
    assert [line.startswith("mean_0: from step 5 on") for line in trajectories.changes(old, new)] == [True]
