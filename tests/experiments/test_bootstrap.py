from __future__ import annotations

import numpy as np
import pytest

from experiments.bootstrap import Bootstrap
from experiments.report import Cell


def test_bootstrap_agrees_with_the_standard_error_of_a_mean():
    values = np.random.default_rng(0).normal(3.0, 2.0, 400)
    group = Bootstrap(np.ones(400, bool), np.random.default_rng(1), draws=4000)
    cell = group.cell(values, np.ones(400), root=False)
    assert isinstance(cell, Cell)
    assert cell.value == pytest.approx(values.mean())
    assert cell.se == pytest.approx(values.std() / 20, rel=0.05)


def test_interval_holds_the_value():
    values = np.random.default_rng(0).normal(3.0, 2.0, 400) ** 2
    group = Bootstrap(np.ones(400, bool), np.random.default_rng(1))
    low, high = (float(x) for x in group.interval(values, np.ones(400)).split(" to "))
    assert low < np.sqrt(values.mean()) < high
