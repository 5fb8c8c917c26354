"""The random sine: bands of the specification, section 5.8 item 14, and the published table."""

from __future__ import annotations

import json

import pytest

from experiments.__main__ import ROOT
from experiments.report import Report, compare
from experiments.sine import run as sine

BANDS = {  # (filter, part, variable): low, high
    ("EKF1", "filtered", 1): (0.48, 0.59),
    ("EKF1", "filtered", 3): (0.23, 0.255),
    ("EKF1", "filtered", 0): (0.5, 0.85),
    ("EKF1", "filtered", 2): (0.34, 0.5),
    ("UKF", "filtered", 1): (0.52, 0.61),
    ("UKF", "filtered", 3): (0.25, 0.28),
    ("EKF2", "filtered", 2): (0.28, 0.335),
    ("EKF2", "filtered", 3): (0.275, 0.305),
    ("EKF1", "smoothed", 3): (0.145, 0.165),
    ("EKF2", "smoothed", 3): (0.145, 0.165),
    ("UKF", "smoothed", 3): (0.145, 0.165),
}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_bands(seed):
    result = sine.simulate(1000, seed)
    for (name, part, i), (low, high) in BANDS.items():
        assert low <= result.scores[name][part][:, i].mean() <= high, (name, part, i)
    y = {name: result.scores[name]["filtered"][:, 3].mean() for name in ("EKF1", "UKF", "EKF2")}
    assert y["EKF1"] < y["UKF"] < y["EKF2"]


def test_published_table_agrees_with_a_small_run(monkeypatch):
    """Another seed and 60 runs; two filters, so that it stays small."""
    everything = sine.filters()
    monkeypatch.setattr(sine, "filters", lambda: {name: everything[name] for name in ("EKF1", "UKF")})
    published = json.loads((ROOT / "sine" / "published.json").read_text(encoding="utf-8"))
    ours = sine.table(sine.simulate(60, 1))
    table = published["tables"]["sine"]
    table["rows"] = [row for row in table["rows"] if row[0].removeprefix("RTS of ") in ("EKF1", "UKF")]
    assert compare(published, Report("sine", "", [ours])) == []
