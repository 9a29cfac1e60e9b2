"""Small files that would print for months: refused before anything is computed."""

from __future__ import annotations

from pathlib import Path

import pytest

from stillpath.gcode.errors import GcodeError
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from stillpath.pipeline.progress import Progress, ProgressCallback
from stillpath.pipeline.simulate import plan_file, simulate_file
from tests.gcode.cutting import HEAD

MOVES = "G1 X120 E1 F6000\nG1 X60 E1\n"
FILES = {
    "dwell": (HEAD + MOVES + "G4 P4000000000\n" + MOVES, "the print takes .* more than 1000 h"),
    "dwells": (HEAD + "G4 P60000000\n" * 61 + MOVES, "line .*the print takes .* more than 1000 h"),
    "move": (
        HEAD + MOVES + "SET_VELOCITY_LIMIT VELOCITY=1e-9\nG1 X80\n",
        "line 10: the move takes .* more than 20 min; correct its F",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "method"),
    [
        *((name, "shaper:mzv") for name in sorted(FILES)),
        ("dwell", "none"),
        ("dwells", "simulate"),
        ("move", "plan"),
    ],
)
def test_endless_prints_are_refused_and_leave_no_file(
    tmp_path: Path, cache: Path, name: str, method: str
) -> None:
    text, message = FILES[name]
    source, target = tmp_path / "in.gcode", tmp_path / "out"
    source.write_text(text)
    with pytest.raises(GcodeError, match=message):
        go(method, source, target, cache)
    assert [path.name for path in tmp_path.iterdir()] == ["in.gcode"]


def go(
    method: str, source: Path, target: Path, cache: Path, progress: ProgressCallback | None = None
) -> None:
    machine = load_machine("ender3")
    if method == "plan":
        plan_file(source, target, machine, rate_hz=1.0, progress=progress)
    elif method == "simulate":
        simulate_file(source, machine, cache_dir=cache, progress=progress)
    else:
        options = Options(method=method)
        compensate_file(source, target, machine, options, cache_dir=cache, progress=progress)


@pytest.mark.parametrize("method", ["none", "shaper:mzv", "simulate", "plan"])
def test_refused_before_it_is_computed(tmp_path: Path, cache: Path, method: str) -> None:
    """What makes the print endless stands after two long days of it: the file is read to its end
    before hours are spent on its beginning."""
    source, target = tmp_path / "in.gcode", tmp_path / "out"
    days = "G4 P180000000\n"  # cheap ones
    source.write_text(HEAD + MOVES + days + MOVES * 8000 + "G4 P3600000000\n" + MOVES)
    told: list[Progress] = []
    with pytest.raises(GcodeError, match=r"line 16012: .* takes 1052\.76 h, more than 1000 h"):
        go(method, source, target, cache, told.append)
    assert all(report.print_seconds < 60.0 for report in told)
    assert [path.name for path in tmp_path.iterdir()] == ["in.gcode"]


def test_long_stands_cost_no_figures(tmp_path: Path, cache: Path) -> None:
    """Forty hours of dwells: the time is told, the figures are those of short ones."""
    source, machine = tmp_path / "in.gcode", load_machine("ender3")
    found = []
    for dwell_ms in (3_000, 20 * 3_600_000):
        source.write_text(HEAD + (MOVES + f"G4 P{dwell_ms}\n") * 2 + MOVES)
        found.append(simulate_file(source, machine, cache_dir=cache))
    short, long = found
    assert long.time_s - short.time_s == pytest.approx(2 * (20 * 3600 - 3))
    for one, other in zip(long.channels, short.channels, strict=True):
        assert one.all_motion.model_dump() == pytest.approx(other.all_motion.model_dump(), rel=1e-6)
