"""What the README promises, run."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

import jaxfilt

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_code_of_the_readme_runs():
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    names: dict = {}
    exec(code, names)
    out, smoothed = names["out"], names["smoothed"]
    assert out.mean.shape == (40, 2)
    assert (np.asarray(out.status)[20:26] == jaxfilt.Status.MISSED).all()
    assert (np.asarray(smoothed.cov)[25, 0, 0] < np.asarray(out.cov)[25, 0, 0]).all()
    assert np.isfinite(names["slope"])
    assert names["batch"].shape == (3,)
    assert names["slopes"].shape == (1000,)


def test_the_names_of_the_readme_exist():
    rows = re.findall(
        r"^\| (?:Filters|Nonlinear|Maneuvers|Association|Lost|Smoothing|Models|Long|Simulation|Tuning).*$",
        README,
        re.MULTILINE,
    )
    for row in rows:
        for name in re.findall(r"`([a-z_0-9.]+)`", row):
            parts = name.removeprefix("jf.").split(".")
            homes = (jaxfilt, jaxfilt.models, jaxfilt.tune)
            assert any(_has(home, parts) for home in homes), name


def _has(home, parts):
    for part in parts:
        if not hasattr(home, part):
            return False
        home = getattr(home, part)
    return True


def test_the_commands_of_the_readme_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"make ([a-z-]+)", README))
    assert {"reproduce", "test"} <= targets
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
