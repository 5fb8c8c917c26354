"""Runs the notebooks: text in, executed ``.ipynb`` out.

``python docs/run_notebooks.py [--short] [NAMES] --out build/notebooks`` from anywhere. A notebook keeps its sizes in
one cell with the tag ``parameters``; ``--short`` puts the values of ``short.toml`` in a cell after it.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import tomllib
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from tqdm import tqdm

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "notebooks"
OUT = ROOT / "build" / "notebooks"
TIMEOUT = 900  # s, of one cell
ENVIRONMENT = {
    "MPLBACKEND": "module://matplotlib_inline.backend_inline",  # pictures stand in the notebook
    "PYTHONWARNINGS": "ignore:IProgress not found",  # tqdm would like ipywidgets, which a page cannot show
}


def names() -> list[str]:
    """All notebooks."""
    return sorted(path.stem for path in FOLDER.glob("*.py"))


def read(name: str, *, short: bool = False) -> nbformat.NotebookNode:
    """A notebook as it stands in the repository; with ``short``, with the small sizes after its own.

    Raises:
        ValueError: a size in ``short.toml`` that the notebook's parameters do not have.
    """
    notebook = jupytext.read(FOLDER / f"{name}.py")
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    if not short:
        return notebook
    sizes = tomllib.loads((FOLDER / "short.toml").read_text(encoding="utf-8"))[name]
    places = [i for i, cell in enumerate(notebook.cells) if "parameters" in cell.metadata.get("tags", [])]
    (place,) = places
    given = {line.split("=")[0].strip() for line in notebook.cells[place].source.splitlines() if "=" in line}
    if unknown := sorted(set(sizes) - given):
        raise ValueError(f"short.toml: {name} has no parameter {', '.join(unknown)}")
    lines = "\n".join(f"{size} = {value!r}" for size, value in sizes.items())
    cell = nbformat.v4.new_code_cell(f"# the short form\n{lines}", metadata={"tags": ["injected-parameters"]})
    notebook.cells.insert(place + 1, cell)
    return notebook


def execute(name: str, *, short: bool = False, out: Path | None = None) -> tuple[nbformat.NotebookNode, float]:
    """Runs a notebook in a kernel of its own, with the repository's root as working directory.

    Args:
        name: of the notebook.
        short: with the small sizes.
        out: folder for the executed notebook; also what a failed one got done is written. None = not kept.

    Returns:
        The executed notebook, and the wall time in seconds.

    Raises:
        CellExecutionError: a cell failed; its text has the cell and the traceback.
    """
    notebook = read(name, short=short)
    begun = time.perf_counter()
    try:
        NotebookClient(
            notebook,
            timeout=TIMEOUT,
            kernel_name="python3",
            coalesce_streams=True,  # a progress bar is its last state
            resources={"metadata": {"path": str(ROOT)}},
        ).execute(env={**os.environ, **ENVIRONMENT})
    finally:
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            nbformat.write(notebook, out / f"{name}.ipynb")
    return notebook, time.perf_counter() - begun


def _job(name: str, short: bool, out: Path) -> tuple[float, str | None]:
    """Seconds and what went wrong: exceptions of nbclient do not cross processes."""
    begun = time.perf_counter()
    try:
        return execute(name, short=short, out=out)[1], None
    except CellExecutionError as error:
        return time.perf_counter() - begun, str(error)


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAMES", help=f"of {', '.join(names())}; default all")
    parser.add_argument("--short", action="store_true", help="with the small sizes of short.toml")
    parser.add_argument("--out", type=Path, default=OUT, help="folder of the executed .ipynb (build/notebooks)")
    parser.add_argument("--jobs", type=int, default=2, help="notebooks at a time")
    given = parser.parse_args(arguments)
    chosen = given.names or names()
    if unknown := sorted(set(chosen) - set(names())):
        parser.error(f"no notebook {', '.join(unknown)}; there are {', '.join(names())}")
    seconds, failed = {}, {}
    with ProcessPoolExecutor(given.jobs) as pool, tqdm(total=len(chosen), unit="notebook") as bar:
        jobs = {pool.submit(_job, name, given.short, given.out): name for name in chosen}
        for job in as_completed(jobs):
            name = jobs[job]
            seconds[name], trouble = job.result()
            if trouble is not None:
                failed[name] = trouble
            bar.update()
            bar.set_postfix_str(f"{name} {seconds[name]:.0f} s")
    for name in sorted(seconds):
        print(f"{name}: {seconds[name]:.1f} s{', failed' if name in failed else ''}")
    for name, trouble in failed.items():
        print(f"\n{name} failed:\n{trouble}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
