"""Benchmarks that need no shared data run, and miss none of the limits that they judge."""

from __future__ import annotations

import ast
import importlib
import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import pytest

from tests.checkout import PYTHONPATH

ROOT = Path(__file__).parents[1]
GEAR = str(ROOT / "examples" / "cura_ender3_gear24.gcode")


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        ["emission.py", GEAR, "--machines", "ender3", "--tolerance-um", "2"],
        ["bed_slinger.py", "--kg", "0.1", "--moving-kg", "0.16"],
        ["ripple.py"],
        ["proof.py", "--machines", "ender3"],
        ["containers.py", GEAR],
        ["estimates.py", str(ROOT / "examples" / "ps_ender3_pauses_hept24f.gcode")],
        ["papers/feedback.py"],
        [
            "quality.py",
            GEAR,
            "--machines",
            "voron-v24-250",
            "--tolerance-um",
            "2",
            "--robust",
            "off",
            "--jobs",
            "1",
        ],
        # Simulated logs and spectra, and every real table, are tests of their own.
        ["identification.py", "--file", GEAR, "--machines", "ender3", "--only", "prints"],
    ],
    ids=lambda command: command[0],
)
def test_it_runs(command: list[str]) -> None:
    script, *arguments = command
    environment = {**os.environ, "PYTHONPATH": PYTHONPATH}
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / script), *arguments],
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert "MISS" not in done.stdout


@pytest.mark.slow
def is_module(package: ModuleType, name: str) -> bool:
    return hasattr(package, "__path__") and find_spec(f"{package.__name__}.{name}") is not None


@pytest.mark.parametrize("folder", ["benchmarks", "docs", "examples"])
def test_what_scripts_import_is_there(folder: str) -> None:
    """Also within functions that no other test calls."""
    taken = {
        (node.module, name.name)
        for path in (ROOT / folder).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("stillpath.")
        for name in node.names
    }
    assert taken
    missing = []
    for module, name in sorted(taken):
        found = importlib.import_module(module)
        if not hasattr(found, name) and not is_module(found, name):
            missing.append(f"{module}.{name}")
    assert missing == []


@pytest.mark.parametrize(
    "script",
    sorted(p.name for p in ROOT.glob("benchmarks/*.py") if "from tests." in p.read_text("utf-8")),
)
def test_it_finds_what_it_imports(script: str, tmp_path: Path) -> None:
    """As docs/benchmarks.md says it: by its path, with nothing set."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / script), "--help"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.parametrize("script", ["corpus.py", "interpreting.py"])
def test_it_says_that_the_shared_data_are_not_there(script: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / script)],
        env={**os.environ, "STILLPATH_SHARED": str(tmp_path / "none")},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("no shared data")


@pytest.mark.slow
def test_the_rows_on_closed_loops_are_those_that_the_script_prints(tmp_path: Path) -> None:
    kept = ROOT / "benchmarks" / "results" / "feedback.json"
    made = tmp_path / "feedback.json"
    made.write_bytes(kept.read_bytes())
    script = ROOT / "benchmarks" / "papers" / "feedback.py"
    subprocess.run([sys.executable, str(script), "--json", str(made)], check=True, timeout=600)
    before, after = (json.loads(path.read_text("utf-8")) for path in (kept, made))
    # Not "ours", nor remarks with figures: their last digits and speeds are this computer's.
    assert [[*row[:3], row[4]] for row in after["rows"]] == [
        [*row[:3], row[4]] for row in before["rows"]
    ]
    within = sum(row[4] == "within its tolerance" for row in before["rows"])
    assert f"{within} of {len(before['rows'])} rows" in before["means"]
