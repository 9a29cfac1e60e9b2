"""Times in a compensated file, on the whole pipeline."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stillpath.models.store import load_machine
from stillpath.pipeline.simulate import plan_file, simulate_file
from tests.compensating import compensated
from tests.gcode.cutting import HEAD, ender3_with
from tests.gcode.prints import polygon

LAYER = "\n".join(polygon(6, 15))
TEXT = (
    ";FLAVOR:Marlin\n;TIME:100\n;Generated with Cura_SteamEngine 5.0.0\n"
    f"{HEAD}G1 X120 Y100 F6000\n;LAYER:0\n;TYPE:WALL-OUTER\n{LAYER}\n;TIME_ELAPSED:50.000000\n"
    f"M73 P50 R1\nG1 E-1 F2100\nG4 P500\nG1 E1 F2100\n;LAYER:1\n{LAYER}\n;TIME_ELAPSED:100.000000\n"
    "G1 E-1 F2100\n;End of Gcode\n;SETTING_3 {}\n"
).encode()


def elapsed(lines: list[bytes]) -> list[float]:
    start = b";TIME_ELAPSED:"
    return [float(x.removeprefix(start)) for x in lines if x.startswith(start)]


def test_times_follow_the_motion(tmp_path: Path, cache: Path) -> None:
    # A robust design weighs the path more than the time.
    result, written = compensated(TEXT, tmp_path, cache, along=0.01)
    lines = written.splitlines()
    delay_s = result.time_s - result.original_time_s
    first, last = (b - a for a, b in zip((50.0, 100.0), elapsed(lines), strict=True))
    assert last == pytest.approx(delay_s, abs=0.02)
    assert 0.0 < first < last
    assert b";TIME:%d" % round(100.0 + delay_s) in lines
    assert (result.slicer, result.slicer_time_s) == ("Cura", 100.0)


def test_the_ends_of_the_file_stay_the_slicers(tmp_path: Path, cache: Path) -> None:
    _, written = compensated(TEXT, tmp_path, cache)
    lines = written.splitlines()
    assert lines[0] == b";FLAVOR:Marlin"
    assert lines[-1] == b";SETTING_3 {}"
    stamps = [k for k, line in enumerate(lines) if line.startswith(b"; Processed by stillpath")]
    assert len(stamps) == 2
    assert all(line.startswith(b";") for line in lines[: stamps[0]] if line)
    assert lines[stamps[1] + 1 :] == [b";End of Gcode", b";SETTING_3 {}"]


def test_kept_times_and_the_method_none(tmp_path: Path, cache: Path) -> None:
    _, written = compensated(TEXT, tmp_path, cache, times="kept", along=0.01)
    lines = written.splitlines()
    assert elapsed(lines) == [50.0, 100.0]
    _, written = compensated(TEXT, tmp_path, cache, method="none")
    lines = written.splitlines()
    assert b"\n".join(lines) + b"\n" == TEXT


def test_what_is_sliced_does_not_stop_before_a_piece(tmp_path: Path, cache: Path) -> None:
    """After a mark a piece begins behind a move of Z, from which Klipper goes on without a stop."""
    marks = "EXCLUDE_OBJECT_START NAME={}\nG1 Z{} F600\n"
    layers = [f"{marks.format('ab'[k % 2], 0.4 + 0.2 * k)}{LAYER}\nG1 E-1\n" for k in range(8)]
    text = f"{HEAD}G1 X120 Y100 F6000\nG1 E-1 F2100\n{''.join(layers)}".encode()
    written, _ = compensated(text, tmp_path, cache)
    sliced, _ = compensated(text, tmp_path, cache, method="none")
    assert written.original_time_s == pytest.approx(sliced.original_time_s, abs=2e-3)
    assert written.pieces >= 8


@pytest.mark.parametrize("where", ["all", "walls"])
@pytest.mark.parametrize("kind", ["klipper", "marlin", "reprapfirmware"])
def test_times_are_those_of_both_files(kind: str, where: str, tmp_path: Path, cache: Path) -> None:
    """Hops along slopes stay as sliced: the sliced file flows into them, and out of them again.

    RepRapFirmware waits for more moves wherever it begins to move again.
    """
    hop = "G1 X134 Y101 Z{0:.1f} F9000\nG1 X120 Y100\nG1 Z{1:.1f}\n"
    walls = [
        f";TYPE:{'WALL-INNER' if k % 2 else 'WALL-OUTER'}\n{LAYER}\n{hop.format(0.6 + z, z)}"
        for k, z in enumerate(np.arange(0.4, 2.0, 0.2))
    ]
    text = HEAD + "G1 X120 Y100 Z.2 F6000\n" + "M400\n".join(walls)
    machine = ender3_with(kind)
    result, _ = compensated(text, tmp_path, cache, machine, where=where)
    assert result.pieces >= 4
    for name, time_s in (("in", result.original_time_s), ("out", result.time_s)):
        planned = plan_file(tmp_path / f"{name}.gcode", tmp_path / "motion.npz", machine)
        assert time_s == pytest.approx(planned.time_s, abs=0.02), name


def test_plan_and_simulate_tell_the_slicers_time(tmp_path: Path, cache: Path) -> None:
    source = tmp_path / "in.gcode"
    source.write_bytes(TEXT)
    machine = load_machine("ender3")
    planned = plan_file(source, tmp_path / "motion.npz", machine)
    simulated = simulate_file(source, machine, cache_dir=cache)
    assert planned.slicer_time_s == simulated.slicer_time_s == 100.0
    assert planned.slicer == simulated.slicer == "Cura"
    assert planned.time_s == pytest.approx(simulated.time_s)
