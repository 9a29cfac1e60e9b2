"""Benchmarks that need no shared data run, and miss none of the limits that they judge."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

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
            "voron-v0",
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
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / script), *arguments],
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert "MISS" not in done.stdout
