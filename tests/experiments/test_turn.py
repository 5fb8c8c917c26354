"""The coordinated turn: bands of the specification, section 5.8 item 15, and the published table."""

from __future__ import annotations

import json

import numpy as np
import pytest

from experiments.__main__ import ROOT
from experiments.report import Report, compare
from experiments.turn import run as turn


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_bands(seed):
    result = turn.simulate(500, seed)
    mse = {name: float(result.mean(name, "filtered").value) for name in turn.filters()}
    assert 0.0245 <= mse["KF (CV)"] <= 0.0285
    assert 0.0165 <= mse["IMM-EKF, zero"] <= 0.0200
    assert 0.0143 <= mse["IMM-UKF, zero"] <= 0.0175
    for name in ("EKF", "UKF"):
        assert mse[f"IMM-{name}, own"] <= 0.92 * mse[f"IMM-{name}, zero"]


def test_published_table_agrees_with_a_small_run(monkeypatch):
    """Another seed and 100 runs; the EKF bank, so that it stays small."""
    chosen = ("KF (CV)", "IMM-EKF, own")
    everything = turn.filters()
    monkeypatch.setattr(turn, "filters", lambda: {name: everything[name] for name in chosen})
    published = json.loads((ROOT / "turn" / "published.json").read_text(encoding="utf-8"))
    table = published["tables"]["turn"]
    table["rows"] = [row for row in table["rows"] if row[0] in chosen]
    assert compare(published, Report("turn", "", [turn.table(turn.simulate(100, 1))])) == []


def test_the_path_closes_its_turns():
    """Five seconds at 1 rad/s each way: the course turns by 5 rad and back, at unit speed."""
    path = turn.path()
    course = np.unwrap(np.arctan2(path[:, 3], path[:, 2]))
    np.testing.assert_allclose([course[89], course[159]], [5.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(np.hypot(path[:, 2], path[:, 3]), 1.0, rtol=1e-12)
