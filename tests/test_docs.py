"""The documentation site: it builds strictly and offline, is complete, and its figures are those that were measured."""

from __future__ import annotations

import ast
import html
import importlib
import inspect
import os
import re
import subprocess
import sys
import zlib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import jaxfilt as jf

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
EXAMPLES = DOCS / "examples"
FIGURE = re.compile(r"(?<![\w.])[+−-]?\d+\.\d+(?:e[+-]?\d+)?|(?<![\w.])\d+e-\d+")

pytestmark = pytest.mark.xdist_group("docs")  # one process builds


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, its notebooks not executed."""
    out = tmp_path_factory.mktemp("site")
    environment = os.environ | {"JAXFILT_DOCS_NOTEBOOKS": str(out / "none"), "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def text_of(page: Path) -> str:
    return html.unescape(re.sub(r"<[^>]+>", "", page.read_text(encoding="utf-8")))


def inventory(path: Path) -> set[str]:
    """The names in a Sphinx inventory."""
    body = path.read_bytes().split(b"\n", 4)[4]
    return {line.split(" ", 1)[0] for line in zlib.decompress(body).decode().splitlines()}


def public_names(module, prefix="jaxfilt"):
    """What a module exports with ``X as X``, modules followed; of a module that exports nothing, what it defines."""
    tree = ast.parse(inspect.getsource(module))
    exported = [
        alias.name
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name and not alias.name.startswith("_")
    ]
    if not exported:
        defined = (node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef))
        exported = [name for name in defined if not name.startswith("_")]
    for name in exported:
        member = getattr(module, name)
        if inspect.ismodule(member):
            yield from public_names(member, f"{prefix}.{name}")
        else:
            yield f"{prefix}.{name}"


def test_every_public_name_is_in_the_api(site):
    names = set(public_names(jf))
    assert {"jaxfilt.kalman", "jaxfilt.models.sensors.bearing", "jaxfilt.gains.kalata", "jaxfilt.smooth"} <= names
    missing = sorted(names - inventory(site / "objects.inv"))
    assert not missing, f"add them to a page in docs/api: {missing}"


def test_the_reference_shows_functions_not_modules_of_the_same_name(site):
    page = text_of(site / "api" / "smoothing.html")
    assert "jaxfilt.smooth.smooth" not in page
    assert "smooth(filt: Filter" in page


def test_no_role_is_left_in_the_reference(site):
    for page in (site / "api").glob("*.html"):
        assert not re.search(r":(func|class|mod|meth|attr|data):", text_of(page)), page.name


def test_every_experiment_has_a_page_with_its_figures(site):
    readmes = [*ROOT.glob("experiments/*/README.md"), ROOT / "tests/robustness/README.md"]
    for readme in readmes:
        page = site / readme.relative_to(ROOT).with_name("index.html")
        source = page.read_text(encoding="utf-8")
        for figure in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", readme.read_text(encoding="utf-8")):
            assert f'src="{figure}"' in source
            assert (page.parent / figure).is_file()


def test_every_notebook_has_a_page(site):
    for source in (DOCS / "notebooks").glob("*.py"):
        assert (site / "notebooks" / f"{source.stem}.html").is_file()


def test_the_status_bits_are_those_of_the_code(site):
    page = text_of(site / "api" / "status.html")
    for bit in jf.Status:
        assert re.search(rf"^{bit.name}\s+{bit.value}\s", page, re.MULTILINE), bit.name


def test_the_front_page_shows_the_code_of_the_readme(site):
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert code in text_of(site / "index.html")


def test_a_page_that_fetches_from_elsewhere_is_refused(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    hooks = importlib.import_module("hooks")
    page = SimpleNamespace(file=SimpleNamespace(src_uri="x.md"))
    fine = '<a href="https://docs.jax.dev">JAX</a><img src="figures/a.png"><script src="a.js"></script>'
    assert hooks.on_post_page(fine, page) == fine
    for bad in (
        '<script src="https://cdn.org/a.js">',
        "<link rel=x href='//fonts.org/a.css'>",
        '<img src="http://a/b">',
    ):
        with pytest.raises(hooks.PluginError, match=r"x\.md"):
            hooks.on_post_page(fine + bad, page)


def evidence(path: Path, line: str) -> str:
    """The README's text; of the robustness table the rows that the line names (R6)."""
    text = path.read_text(encoding="utf-8")
    if path.parent.name != "robustness":
        return text
    blocks = {block.split("**")[0]: block for block in text.split("\n| **")[1:]}
    return "".join(blocks[row] for row in re.findall(r"\bR\d+\b", line) if row in blocks)


@pytest.mark.parametrize(
    ("page", "heading", "source"),
    [
        ("choose.md", "By problem", None),
        ("compared.md", "Speed", "experiments/benchmarks/README.md"),
        ("compared.md", "Robustness", "tests/robustness/README.md"),
    ],
)
def test_figures_stand_in_the_readme_that_is_linked(page, heading, source):
    section = (DOCS / page).read_text(encoding="utf-8").split(f"\n## {heading}\n")[1].split("\n## ")[0]
    checked = 0
    for line in section.splitlines():
        linked = [source] if source else re.findall(r"\]\(([^)#]*README\.md)", line)
        text = "".join(evidence(ROOT / link, line) for link in linked)
        for figure in FIGURE.findall(re.sub(r"\]\([^)]*\)", "]", line)):
            assert re.search(rf"(?<![\d.]){re.escape(figure.lstrip('+'))}(?!\d)", text), f"{figure} in: {line}"
            checked += 1
    assert checked >= 10


@pytest.fixture
def comparison(monkeypatch):
    pytest.importorskip("filterpy")
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module("compare_filterpy")


def test_filterpy_and_jaxfilt_track_alike(comparison):
    for row in comparison.measure(20, repeats=1):
        assert row["difference"] < 1e-9, row
        np.testing.assert_allclose(row["rmse"], row["their_rmse"], rtol=1e-9)
        assert 15 < row["rmse"] < 30, row  # m; the sensor's noise is 20 m along and 35 m across at 2 km


def test_the_lines_of_code_are_counted_right(comparison):
    assert comparison.lines_of_code(EXAMPLES / "range_bearing_data.py") < 40
    page = (DOCS / "from_filterpy.md").read_text(encoding="utf-8")
    lines = comparison.code_lines()
    for name, count in lines.items():
        assert f'=== "{name} ({count} lines)"' in page
    assert f"| lines of code, both filters | {lines['filterpy']} | {lines['jaxfilt']} |" in page
