"""The notebooks of the documentation: the short form of each runs, and the text keeps to what there is."""

from __future__ import annotations

import importlib
import re

import pytest

import jaxfilt
from docs.run_notebooks import FOLDER, execute, names, read

NAMES = names()
every = pytest.mark.parametrize("name", NAMES)


@every
def test_the_short_form_runs(name):
    """In a kernel of its own, with the environment of the tests; no warning of the library, no error is shown."""
    notebook, _ = execute(name, short=True)
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    shown = [output.text for output in outputs if output.get("name") == "stderr"]
    assert not [text for text in shown if "Warning" in text], shown


@every
def test_a_notebook_has_a_title_sizes_in_one_cell_and_an_end(name):
    cells = read(name).cells
    assert re.match(r"# \w", cells[0].source), "the first cell is the title"
    assert sum("parameters" in cell.metadata.get("tags", []) for cell in cells) == 1
    assert cells[-1].cell_type == "markdown"
    assert "## What to take away" in cells[-1].source
    assert re.search(r"^Next: ", cells[-1].source, re.MULTILINE)


@every
def test_the_names_in_the_prose_exist(name):
    """`jf.tune.gradient`, `experiments/circling` or another notebook's name."""
    known = {"jf": jaxfilt}
    for cell in read(name).cells:
        if cell.cell_type != "markdown":
            continue
        for words in re.findall(r"`([^`]+)`", cell.source):
            if re.fullmatch(r"jf(\.\w+)+", words):
                found = known["jf"]
                for part in words.split(".")[1:]:
                    assert hasattr(found, part), words
                    found = getattr(found, part)
            elif re.fullmatch(r"(experiments|jaxfilt|tests)/[\w/.]+", words):
                assert (FOLDER.parents[1] / words).exists(), words


@every
def test_the_next_notebook_exists(name):
    (last,) = re.findall(r"^Next: .*", read(name).cells[-1].source, re.MULTILINE | re.DOTALL)
    for word in re.findall(r"`(\w+)`", last):
        assert word in NAMES or hasattr(importlib.import_module("jaxfilt"), word), word


def test_the_short_sizes_are_parameters():
    for name in NAMES:
        assert len(read(name, short=True).cells) == len(read(name).cells) + 1
