"""docs/benchmarks.md and the figures of README.md are what benchmarks/page.py makes of the data."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests.loading import module_at

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "benchmarks" / "page.py"
RESULTS = sorted((ROOT / "benchmarks" / "results").glob("*.json"))


@pytest.fixture(scope="module")
def page() -> ModuleType:
    return module_at(SCRIPT, "benchmarks_page")


def test_the_pages_are_what_the_results_make():
    done = subprocess.run([sys.executable, str(SCRIPT), "--check"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_check_says_which_page_differs(page, tmp_path, monkeypatch, capsys):
    wrong = tmp_path / "benchmarks.md"
    wrong.write_text(page.PAGE.read_text().replace("0.74", "0.47"))
    monkeypatch.setattr(page, "ROOT", tmp_path)
    monkeypatch.setattr(page, "PAGE", wrong)
    readme = tmp_path / "README.md"
    readme.write_bytes((ROOT / "README.md").read_bytes())
    monkeypatch.setattr(page, "README", readme)
    before = wrong.read_bytes()
    assert page.main(["--check"]) == 1
    assert wrong.read_bytes() == before
    said = capsys.readouterr().err
    assert "benchmarks.md" in said
    assert "README" not in said
    assert page.main([]) == 0
    assert page.main(["--check"]) == 0


def test_the_figures_of_the_readme_stand_in_the_results():
    """Read README.md by itself: every cell of its table, and the mean, against the data."""
    readme = (ROOT / "README.md").read_text()
    figures = readme.split("<!-- FIGURES")[1].split("<!-- END FIGURES")[0]
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in figures.splitlines()
        if line.startswith("| ")
    ][1:]
    data = json.loads((ROOT / "benchmarks" / "results" / "twins.json").read_text())["rows"]
    assert len(rows) == len(data)
    for shown, known in zip(rows, data, strict=True):
        assert shown[:2] == known[:2]
        assert [float(cell) for cell in shown[2:]] == known[2:]
    ratios = [ratio for row in data for ratio in row[5:]]
    product = 1.0
    for ratio in ratios:
        product *= ratio
    assert f"{product ** (1 / len(ratios)):.2f}." in figures
    chain = json.loads((ROOT / "benchmarks" / "results" / "closed_chain.json").read_text())["rows"]
    for value in (chain[0][2], chain[0][4], chain[0][8], chain[2][2], chain[2][4]):
        assert f"{value:.2f}" in figures


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
def test_a_result_names_a_script_that_is_there(page, path):
    result = page.read(path)
    assert (ROOT / result.script).is_file()
    assert result.script in result.command
    assert result.rows
    assert result.shown()
    assert len(result.date) == len("2026-01-31")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"section": "Elsewhere"}, "section 'Elsewhere' is none of"),
        ({"rows": [["one cell"]]}, "row 1 has 1 cells, not 8"),
        ({"verdict": "good"}, "unknown fields ['verdict']"),
    ],
)
def test_a_wrong_file_is_refused_by_name(page, tmp_path, change, said):
    data = json.loads((ROOT / "benchmarks" / "results" / "twins.json").read_text()) | change
    path = tmp_path / "twins.json"
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError, match=r"twins\.json: ") as refused:
        page.read(path)
    assert said in str(refused.value)
