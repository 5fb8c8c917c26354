from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import experiments.__main__ as cli
from experiments.__main__ import discover

RUN = """
    import jax.numpy as jnp
    from experiments.report import Cell, Report, Table

    TITLE: str = "The {name} experiment"
    MAIN = {main}

    def run(options):
        {body}
        runs = options.count(full=1000, quick=10)
        rows = [["coast", Cell(jnp.asarray(2.0).itemsize, exact=True), Cell(0.5 + options.seed, 0.1)]]
        table = Table("gap", "In the gap", ["strategy", "bytes", "RMSE"], rows, runs=runs)
        return Report("{name}", TITLE, [table])
"""


def write(root: Path, name: str, *, main: bool = False, body: str = "pass") -> None:
    (root / name).mkdir()
    (root / name / "__init__.py").touch()
    text = textwrap.dedent(RUN).format(name=name, main=main, body=body)
    (root / name / "run.py").write_text(text, encoding="utf-8")


@pytest.fixture
def root(tmp_path, monkeypatch) -> Path:
    """A folder of made-up experiments in place of the real one, and as the current folder."""
    root = tmp_path / f"made_up_{tmp_path.name}"
    root.mkdir()
    (root / "__init__.py").touch()
    write(root, "bravo")
    write(root, "zulu", main=True)
    (root / "data").mkdir()
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "discover", lambda: discover(root))
    return root


def test_list_names_the_experiments_main_ones_first(root, capsys):
    write(root, "broken", body="raise")
    assert cli.main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["zulu", "bravo", "broken"]
    assert lines[0].endswith("The zulu experiment (main)")


def test_list_imports_no_experiment_and_not_jax():
    code = "import sys; from experiments.__main__ import main; main(['list']); sys.exit('jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[1], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_run_prints_the_tables_and_writes_the_report(root, capsys):
    assert cli.main(["run", "bravo", "--runs", "7", "--seed", "3", "--out", "elsewhere"]) == 0
    text = Path("elsewhere/bravo/report.md").read_text(encoding="utf-8")
    assert "7 runs, seed 3." in text
    assert "3.50 ± 0.10" in text
    assert Path("elsewhere/bravo/tables.json").is_file()
    assert "3.50 ± 0.10" in capsys.readouterr().out


def test_experiments_run_in_double_precision(root, capsys):
    assert cli.main(["run", "bravo", "--quick"]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("coast"))
    assert row.split()[1] == "8.00"


def test_reproduce_runs_the_main_ones_in_full_and_the_others_quick(root, capsys):
    assert cli.main(["reproduce", "--out", "results"]) == 0
    assert "1000 runs" in Path("results/zulu/report.md").read_text(encoding="utf-8")
    assert "10 runs" in Path("results/bravo/report.md").read_text(encoding="utf-8")
    summary = Path("results/report.md").read_text(encoding="utf-8")
    assert "2 of 2 experiments" in summary
    assert "(zulu/report.md)" in summary


def test_one_failure_does_not_stop_the_others_and_is_not_hidden(root, capsys):
    write(root, "alpha", main=True, body="raise RuntimeError('no luck')")
    assert cli.main(["run", "all", "--quick"]) == 1
    assert "no luck" in capsys.readouterr().err
    summary = Path("results/report.md").read_text(encoding="utf-8")
    assert "2 of 3 experiments" in summary
    assert "failed" in summary
    assert Path("results/bravo/report.md").is_file()


def test_bars_are_for_terminals(root, capsys, monkeypatch):
    assert cli.main(["run", "all", "--quick"]) == 0
    assert "experiment/s" not in capsys.readouterr().err
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert cli.main(["run", "all", "--quick"]) == 0
    assert "bravo: 100%" in capsys.readouterr().err


def test_write_readme_publishes(root, capsys):
    readme = root / "bravo" / "README.md"
    readme.write_text("<!-- table: gap -->\n<!-- /table: gap -->\n", encoding="utf-8")
    assert cli.main(["run", "bravo", "--write-readme"]) == 0
    assert "1000 runs, seed 0." in readme.read_text(encoding="utf-8")
    assert (root / "bravo" / "published.json").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "nonsense"], "no experiment nonsense; there are zulu, bravo"),
        (["run", "bravo", "--quick", "--write-readme"], "not from a --quick run"),
        (["run", "bravo", "--runs", "0"], "expected a positive number, got 0"),
        ([], "required: command"),
    ],
)
def test_wrong_use_is_explained(root, capsys, arguments, message):
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments)
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def test_an_experiment_without_its_constants_is_refused(root):
    write(root, "alpha")
    path = root / "alpha" / "run.py"
    path.write_text(path.read_text(encoding="utf-8").replace("MAIN = ", "PLAIN = "), encoding="utf-8")
    with pytest.raises(ValueError, match="lacks MAIN"):
        cli.main(["list"])


def test_the_experiments_of_this_repository_are_found():
    for experiment in discover():
        assert experiment.title
        assert (experiment.directory / "__init__.py").is_file()
