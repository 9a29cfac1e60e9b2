"""Repeats lead to one machine: a file hardly depends on which of them were read."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from stillpath.applications.identification.run import InputFile, identify_files
from stillpath.compensation.registry import compensator
from stillpath.models.identification.readers import ReadSettings
from stillpath.models.reference_motion import reference_motion
from stillpath.models.store import load_machine
from stillpath.pipeline.caution import choose_caution
from stillpath.pipeline.measuring.reference_shaper import cached_shaper

DT_S = 1e-3
FOLDER = "richardjm_voron24_250"
TABLES = {
    "x": ("x_20220430_191517", "x_20220430_192532", "x_20220430_193805"),
    "y": ("y_20220430_191733", "y_20220430_192750", "y_20220430_194022"),
}


@pytest.mark.shared
@pytest.mark.slow
def test_any_two_of_three_tables_say_the_same(shared_dir: Path, tmp_path: Path) -> None:
    """Commands from any two of three tables of a real printer, taken within half an hour."""
    base = load_machine("generic-corexy")
    path, extruding = (part[..., :9000] for part in reference_motion(DT_S))
    commands = []
    for kept in combinations(range(3), 2):
        names = [f"resonances_{TABLES[axis][k]}.csv" for axis in "xy" for k in kept]
        folder = shared_dir / "measurements" / FOLDER
        files = [InputFile(name, (folder / name).read_bytes()) for name in names]
        machine = identify_files(files, base, ReadSettings(frame_firm=True)).machine
        caution, _ = choose_caution(machine, cached_shaper(machine, tmp_path), tmp_path, DT_S)
        made = compensator("fbf", machine, DT_S, robust="ensemble", caution=caution)
        made.reset(path[:, 0])
        commands.append(made.compensate(path, extruding, np.zeros((0, 2), np.int64)))

    def rms(difference: np.ndarray) -> float:
        return float(1e3 * np.sqrt(np.mean(difference[:, extruding] ** 2)))

    moved = min(rms(command - path) for command in commands)
    apart = max(rms(a - b) for a, b in combinations(commands, 2))
    assert moved > 4.0
    assert apart < 0.1 * moved
