"""A file simulated as it is: the same figures as those beside a compensated one."""

from __future__ import annotations

from pathlib import Path

import pytest

from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from stillpath.pipeline.simulate import simulate_file
from tests.compensating import compensated
from tests.gcode.cutting import HEAD, ender3_with

LINES = "G1 X20 Y20 F6000\nG1 X100 Y20 E5 F3000\nG1 X100 Y60 E2\n"


@pytest.mark.slow
@pytest.mark.parametrize("between", ["G28 X Y\n", "PAUSE\n", "T1\nT0\n", "G4 P300\n", ""])
def test_where_the_machine_is_lost_nothing_is_measured(
    tmp_path: Path, cache: Path, between: str
) -> None:
    """The nozzle does not jump to where homing leaves it, nor ring from it."""
    source, machine = tmp_path / "in.gcode", load_machine("ender3")
    source.write_text(HEAD + LINES + between + LINES + between * 2 + LINES)
    simulated = simulate_file(source, machine, cache_dir=cache)
    kept = compensate_file(
        source, tmp_path / "out.gcode", machine, Options(method="none"), cache_dir=cache
    )
    for name in ("extruding", "all_motion"):
        one, other = (getattr(r.channels[0], name).model_dump() for r in (simulated, kept))
        assert one == pytest.approx(other, rel=0.03)
        assert one["tracking_max_um"] < 1000.0
    assert simulated.peak_velocity_mm_s == pytest.approx(100.0, rel=1e-3)


@pytest.mark.parametrize("kind", ["klipper", "marlin", "reprapfirmware"])
def test_of_a_compensated_file_it_tells_nothing_and_says_so(
    kind: str, tmp_path: Path, cache: Path
) -> None:
    machine = ender3_with(kind)
    _, written = compensated(HEAD + LINES, tmp_path, cache, machine, method="shaper:mzv")
    bare = b"".join(x for x in written.splitlines(keepends=True) if not x.startswith(b";"))
    for name, text, says in (("in", None, False), ("out", written, True), ("out", bare, True)):
        path = tmp_path / f"{name}.gcode"
        if text is not None:
            path.write_bytes(text)
        warnings = simulate_file(path, machine, cache_dir=cache).warnings
        assert any("simulate the original" in warning for warning in warnings) is says
