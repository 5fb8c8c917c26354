"""What the site takes from elsewhere: READMEs of experiments, executed notebooks, root files, the status bits.

Pages keep their path in the repository, so that links between READMEs hold; links to what is no page become text.
"""

from __future__ import annotations

import ast
import contextlib
import io
import os
import re
import shutil
import tempfile
from pathlib import Path

import jupytext
import nbformat
from mkdocs.exceptions import PluginError
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File

DOCS = Path(__file__).parent
ROOT = DOCS.parent
EXECUTED = Path(os.environ.get("JAXFILT_DOCS_NOTEBOOKS", ROOT / "build" / "notebooks"))
STAGED = Path(tempfile.gettempdir()) / f"jaxfilt-docs-{os.getpid()}"  # mkdocs-jupyter reads notebooks from folders only
NOTEBOOKS = (
    "first_filter", "tuning", "imm_flight", "delayed", "robust", "attitude", "particles", "monte_carlo", "own_filter",
)  # fmt: skip
ROOT_PAGES = ("CONTRIBUTING.md", "CHANGELOG.md")
FIGURES = (".png", ".svg")

_EXTERNAL = re.compile(
    r"<(?:script|img|iframe|source|link|object)\b[^>]*?\b(?:src|href|data)=[\"']?(?:https?:)?//[^>]*>"
)
_HELP = re.compile(r"<!-- help: (\w+) -->")
_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!\w+:|#)([^)#\s]+)(#[^)]*)?\)")


def on_config(config):
    """Writes the navigation of what is found in the repository."""
    notebooks = [f"notebooks/{name}.ipynb" for name in _notebooks()]
    experiments = [f"experiments/{name}/README.md" for name in _experiments()]
    measured = ["experiments/benchmarks/README.md", "tests/robustness/README.md", "experiments/data/README.md"]
    lists = {
        "Notebooks": ["notebooks/index.md", *notebooks],
        "Experiments": ["experiments/index.md", *experiments, *measured],
    }
    for entry in config.nav:
        for title in entry.keys() & lists.keys():
            entry[title] = lists[title]
    return config


@event_priority(100)  # before mkdocs-jupyter, which takes the notebooks
def on_files(files, config):
    """Adds the pages and pictures that are not in ``docs/``."""
    for name in _notebooks():
        uri = f"notebooks/{name}.ipynb"
        _stage(name, STAGED / uri)
        files.append(File(uri, str(STAGED), config.site_dir, config.use_directory_urls))
    pages = {"experiments/index.md": _overview(), "notebooks/index.md": _notebook_index()}
    for path in (*ROOT.glob("experiments/**/README.md"), ROOT / "tests/robustness/README.md"):
        pages[path.relative_to(ROOT).as_posix()] = path.read_text(encoding="utf-8")
    for name in ROOT_PAGES:
        pages[name.lower()] = (ROOT / name).read_text(encoding="utf-8")
    for uri, text in pages.items():
        files.append(File.generated(config, uri, content=_without_dead_links(uri, text, pages)))
    for folder in (*ROOT.glob("experiments/*/figures"), ROOT / "tests/robustness"):
        for path in folder.iterdir():
            if path.suffix in FIGURES:
                uri = path.relative_to(ROOT).as_posix()
                files.append(File.generated(config, uri, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown, page, **kwargs):
    """Fills in what pages ask for."""
    del page, kwargs
    markdown = markdown.replace("<!-- readme: code -->", _readme_code())
    markdown = markdown.replace("<!-- status bits -->", _status_table())
    return _HELP.sub(_help, markdown)


def on_post_page(output, page, **kwargs):
    """Refuses a page that would fetch something when it is looked at."""
    del kwargs
    if match := _EXTERNAL.search(output):
        raise PluginError(f"{page.file.src_uri}: fetches from elsewhere: {match.group(0)}")
    return output


def on_post_build(**kwargs):
    """Removes the copies of the notebooks."""
    del kwargs
    shutil.rmtree(STAGED, ignore_errors=True)


on_build_error = on_post_build


def _experiments():
    """Names of the experiments, in the README's order."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    named = re.findall(r"^\| \[`(\w+)`\]\(experiments/\1/README.md\)", readme, re.MULTILINE)
    found = {path.parent.name for path in ROOT.glob("experiments/*/run.py")}
    return [*(name for name in named if name in found), *sorted(found - set(named))]


def _overview():
    """The README's section on the experiments, with what else is measured."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    section = re.search(r"^## Experiments\n(.*?)^## ", readme, re.DOTALL | re.MULTILINE)
    assert section is not None
    text = section.group(1).replace("](experiments/", "](")
    return (
        f"# Experiments\n{text}\n"
        "The speed against other libraries is in [benchmarks](benchmarks/README.md), thirty numerically hard problems "
        "are in [robustness](../tests/robustness/README.md), and the recordings and their licenses in "
        "[data](data/README.md). `python -m experiments run NAME` makes each page's tables and figures anew.\n"
    )


def _notebooks():
    found = {path.stem for path in DOCS.glob("notebooks/*.py")}
    return [*(name for name in NOTEBOOKS if name in found), *sorted(found - set(NOTEBOOKS))]


def _stage(name, path):
    """Puts the executed notebook at ``path``, or its source with a line that says so."""
    path.parent.mkdir(parents=True, exist_ok=True)
    executed = EXECUTED / path.name
    if executed.exists():
        shutil.copyfile(executed, path)
        return
    notebook = jupytext.read(DOCS / "notebooks" / f"{name}.py")
    notebook.cells.insert(1, nbformat.v4.new_markdown_cell("*This copy was not executed.*"))
    jupytext.write(notebook, path)


def _notebook_index():
    lines = ["# Notebooks", "", "Executed when these pages were built; kept as text in `docs/notebooks/`.", ""]
    for name in _notebooks():
        source = jupytext.read(DOCS / "notebooks" / f"{name}.py")
        first = next(cell.source for cell in source.cells if cell.cell_type == "markdown")
        title, _, rest = first.partition("\n")
        paragraph = rest.strip().split("\n\n")[0].replace("\n", " ")
        lines += [f"**[{title.lstrip('# ')}]({name}.ipynb)**", f":   {paragraph}", ""]
    return "\n".join(lines)


def _without_dead_links(uri, text, pages):
    """Links to what is a page of the site lead there; others become their text."""

    def mend(match):
        label, target, anchor = match.groups()
        path = os.path.normpath(os.path.join(os.path.dirname(uri), target))
        if path in ROOT_PAGES:
            path = path.lower()
        elif path.startswith("docs/"):
            path = re.sub(r"^(notebooks/\w+)\.py$", r"\1.ipynb", path.removeprefix("docs/"))
        elif f"{path}/README.md" in pages:
            path += "/README.md"
        if not (path in pages or (STAGED / path).is_file() or (DOCS / path).is_file()):
            return label
        return f"[{label}]({os.path.relpath(path, os.path.dirname(uri))}{anchor or ''})"

    return _LINK.sub(mend, text)


def _readme_code():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n.*?^```$", readme, re.DOTALL | re.MULTILINE)
    return code


def _help(match):
    """What a command of the command line says of itself."""
    from jaxfilt.__main__ import main  # jax takes seconds to import

    text = io.StringIO()
    os.environ |= {"COLUMNS": "100", "NO_COLOR": "1"}  # argparse's width, and no colors
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        main([match.group(1), "--help"])
    if not text.getvalue().startswith("usage:"):
        raise PluginError(f"jaxfilt {match.group(1)} --help says nothing")
    return text.getvalue().strip()


def _status_table():
    """Name, value, meaning and advice of each bit, from the source."""
    core = (ROOT / "jaxfilt/core.py").read_text(encoding="utf-8")
    (body,) = re.findall(r"^class Status\(.*?\n\n\n", core, re.DOTALL | re.MULTILINE)
    advice = {}
    for node in ast.walk(ast.parse((ROOT / "jaxfilt/status.py").read_text(encoding="utf-8"))):
        if isinstance(node, ast.Dict):
            items = zip(node.keys, node.values, strict=True)
            advice |= {key.attr: ast.literal_eval(text) for key, text in items if isinstance(key, ast.Attribute)}
    rows = ["| bit | value | what happened | what `jf.check` says |", "|:--|--:|:--|:--|"]
    for name, number, meaning in re.findall(r"^    (\w+) = (\d+)  # (.*)$", body, re.MULTILINE):
        rows.append(f"| `{name}` | {number} | {meaning} | {advice[name]} |")
    return "\n".join(rows)
