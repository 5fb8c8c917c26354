from __future__ import annotations

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.report import Cell, Options, Report, Table, compare, peak_memory, provenance


def example(rmse: float = 12.34, se: float | None = 0.21, count: float = 7.0, **fields) -> Report:
    table = Table(
        "gap",
        "RMSE in the gap",
        ["model", "strategy", "RMSE, m", "paper", "|e| > 3"],
        [
            ["matched", "coast", Cell(rmse, se), "12.1", Cell(count, exact=True)],
            ["matched", "a|b", Cell(float("nan")), "", 3],
        ],
        note="Window: the gap.",
        runs=2000,
    )
    return Report("lost", "A lost target", [table], provenance={"seed": 5}, **fields)


@pytest.mark.parametrize(
    ("cell", "shown"),
    [
        (Cell(12.345), "12.3"),
        (Cell(0.0012345), "0.00123"),
        (Cell(1.2345e-9), "1.23e-09"),
        (Cell(12345.6), "12346"),
        (Cell(-0.5, digits=2), "-0.50"),
        (Cell(0.0), "0.00"),
        (Cell(float("nan"), 0.1), "nan"),
        (Cell(12.345, 0.2), "12.3 ± 0.2"),
        (Cell(512.345, 0.04), "512.35 ± 0.04"),
        (Cell(512.345, 1e-12), "512.345 ± 0.000"),
        (Cell(3, 25.0), "3.00 ± 25.00"),
        (Cell(jnp.float32(2.5)), "2.50"),
    ],
)
def test_a_cell_shows_its_significant_digits_and_its_standard_error(cell, shown):
    assert str(cell) == shown


def test_rows_must_fit_the_header():
    with pytest.raises(ValueError, match="table t: expected rows of 2 cells"):
        Table("t", "", ["a", "b"], [["x"]])


def test_a_table_in_markdown_escapes_bars_and_aligns_numbers_right():
    lines = example().tables[0].text("pipe").splitlines()
    header = [cell.strip() for cell in lines[0].replace(r"\|", "!").split("|")[1:-1]]
    assert header == ["model", "strategy", "RMSE, m", "paper", "!e! > 3"]
    assert lines[1].split("|")[3].endswith(":")
    assert r"a\|b" in lines[3]
    assert "12.3 ± 0.2" in lines[2]


def test_an_empty_table_is_still_a_table():
    assert "a" in Table("t", "", ["a", "b"], []).text("simple")


def test_the_report_says_how_it_was_made(tmp_path):
    figure = Options(out=tmp_path).directory("lost") / "track.png"
    figure.write_bytes(b"png")
    report = example(figures=[figure], findings=["Coasting wins."], facts={"runs per second": 12345.6, "runs": 2000})
    report.provenance = provenance(Options(seed=5, out=tmp_path, quick=True), 1.5)
    directory = report.write(tmp_path)
    text = (directory / "report.md").read_text(encoding="utf-8")
    for part in (
        "# A lost target",
        "* Coasting wins.",
        "2000 runs, seed 5. Window: the gap.",
        "![track](track.png)",
        "runs per second: 12346",
        "form: quick",
        "wall time: 1.5 s",
        "jax 0.",
        "Python 3.",
        "MiB",
        "UTC",
    ):
        assert part in text, part
    assert "A lost target" in report.to_console()


def test_tables_are_kept_as_strict_json(tmp_path):
    path = example().write(tmp_path) / "tables.json"

    def refuse(name):
        raise AssertionError(name)

    kept = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    first, second = kept["tables"]["gap"]["rows"]
    assert first[2] == {"value": 12.34, "se": 0.21, "exact": False}
    assert first[3] == "12.1"
    assert second[2]["value"] == "nan"
    assert kept["provenance"]["seed"] == 5


def test_arrays_of_one_number_can_be_cells(tmp_path):
    table = Table("t", "", ["a", "b"], [["x", Cell(jnp.float64(1.5), np.float32(0.25))]])
    kept = json.loads((Report("r", "", [table]).write(tmp_path) / "tables.json").read_text())
    assert kept["tables"]["t"]["rows"][0][1] == {"value": 1.5, "se": 0.25, "exact": False}


README = "# Lost\n\n<!-- table: gap -->\nold\n<!-- /table: gap -->\n\nThe end.\n"


def test_the_readme_gets_its_tables_figures_and_numbers(tmp_path):
    readme = tmp_path / "README.md"
    readme.write_text(README, encoding="utf-8")
    figure = tmp_path / "track.png"
    figure.write_bytes(b"png")
    report = example(figures=[figure])
    report.write_readme(readme)
    once = readme.read_text(encoding="utf-8")
    assert "old" not in once
    assert "12.3 ± 0.2" in once
    assert once.startswith("# Lost\n\n<!-- table: gap -->\n")
    assert once.endswith("<!-- /table: gap -->\n\nThe end.\n")
    assert (tmp_path / "figures" / "track.png").read_bytes() == b"png"
    report.write_readme(readme)
    assert readme.read_text(encoding="utf-8") == once
    assert compare(json.loads((tmp_path / "published.json").read_text(encoding="utf-8")), report) == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (README.replace("table: gap", "table: other"), "no table other in the report, which has gap"),
        (README.replace("<!-- /table: gap -->", ""), "expected <!-- table: gap --> once"),
        (README + README, "expected <!-- table: gap --> once"),
    ],
)
def test_a_readme_with_wrong_markers_is_refused_and_left_alone(tmp_path, text, message):
    readme = tmp_path / "README.md"
    readme.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        example().write_readme(readme)
    assert readme.read_text(encoding="utf-8") == text


def test_compare_accepts_what_lies_within_four_combined_standard_errors():
    published = example(12.34, 0.21).to_json()
    assert compare(published, example(12.34 + 3.9 * np.hypot(0.21, 0.5), 0.5)) == []
    (line,) = compare(published, example(12.34 + 4.1 * np.hypot(0.21, 0.5), 0.5))
    assert line.startswith("gap, matched / coast, RMSE, m: published 12.34 ± 0.21, now ")


def test_compare_holds_exact_cells_to_equality_and_skips_cells_without_an_error():
    published = example(se=None).to_json()
    assert compare(published, example(rmse=99.0, se=None, count=7.0 + 1e-9)) == []
    (line,) = compare(published, example(count=7.1))
    assert "|e| > 3: published 7.0, now 7.1" in line


def test_compare_notices_what_the_rerun_lacks_and_what_turned_to_nan():
    published = example().to_json()
    assert len(compare(published, example(rmse=float("nan")))) == 1
    short = example()
    del short.tables[0].rows[0]
    assert all("not in the re-run" in line for line in compare(published, short))
    assert len(compare(published, short)) == 2


def test_compare_refuses_to_compare_nothing():
    with pytest.raises(ValueError, match="nothing to compare"):
        compare(example().to_json(), Report("lost", ""))


def test_rows_with_the_same_label_are_told_apart():
    table = Table("t", "", ["a", "b"], [["x", Cell(1.0)], ["x", Cell(2.0)], [3.0, 4.0]])
    assert [key for key in table.cells() if key[1] == "b"] == [("x", "b"), ("x #2", "b"), ("3.0", "b")]


def test_options_choose_the_number_of_runs(tmp_path):
    assert Options().count(full=2000, quick=50) == 2000
    assert Options(quick=True).count(full=2000, quick=50) == 50
    assert Options(quick=True, runs=7).count(full=2000, quick=50) == 7
    assert Options(out=tmp_path).directory("a").is_dir()


def test_peak_memory_is_in_bytes():
    assert 2**25 < peak_memory() < 2**40


def test_recorded_data_carry_their_readme_licence_and_listing():
    root = Path(__file__).parents[1]
    data = root / "experiments" / "data"
    sets = [path for path in data.iterdir() if path.is_dir()]
    assert sets
    for path in sets:
        assert (path / "README.md").is_file()
        assert f"`{path.name}`" in (data / "README.md").read_text(encoding="utf-8")
        assert f"experiments/data/{path.name}" in (root / "NOTICE").read_text(encoding="utf-8")
