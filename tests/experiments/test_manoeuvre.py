"""Maneuver detection and answers: bands of the specification, section 5.8 item 21."""

from __future__ import annotations

import json

import pytest

from experiments.__main__ import ROOT
from experiments.manoeuvre import run as manoeuvre
from experiments.report import Report, compare


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_bands(seed):
    detection = manoeuvre.detect(1000, seed)
    for name in manoeuvre.DETECTORS:
        assert 0.007 <= float(detection[0.5].mean(name, "false").value) <= 0.015, name
        assert float(detection[1.0].mean(name, "delay").value) <= 9, name
    strong = manoeuvre.respond(1000, seed)[3.0]
    rmse = {name: float(strong.root_mean(name, "maneuver").value) for name in manoeuvre.answers()}
    quiet = {name: float(strong.root_mean(name, "quiet").value) for name in manoeuvre.answers()}
    for name in ("variable dimension", "IMM (CV, CA)"):
        assert rmse[name] <= 0.2 * rmse["CV alone"]
        assert rmse[name] < min(rmse["gain floored"], rmse["Q x 200"], rmse["P x 5"])
    assert quiet["variable dimension"] <= 1.05 * quiet["CV alone"]
    assert quiet["IMM (CV, CA)"] <= 1.12 * quiet["CV alone"]


def test_published_tables_agree_with_a_small_run():
    published = json.loads((ROOT / "manoeuvre" / "published.json").read_text(encoding="utf-8"))
    report = Report("manoeuvre", "", [manoeuvre.answer_table(manoeuvre.respond(150, 1))])
    assert compare(published, report) == []
