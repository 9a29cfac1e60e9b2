"""Ripple through the whole pipeline: a file in, a verified file out, measured with the ripple."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from stillpath.compensation.base import DesignError
from stillpath.models.machine import Machine
from stillpath.models.plants import Mode, ModesSpec, PlantSetSpec
from stillpath.models.ripple import AxisRipple, RippleHarmonic, RippleSource
from stillpath.models.store import load_machine
from stillpath.pipeline.options import Options
from tests.compensating import compensated


def print_file() -> str:
    lines = ["G28", "G90", "M83", "G1 Z5 F600", "G1 X40 Y30 F6000", "G4 P10", "G1 X40 Y40 F6000"]
    for k, speed in enumerate((30, 60, 90, 110)):
        lines.append(f"G1 X{160 if k % 2 == 0 else 40} Y{43 + 3 * k} E4 F{60 * speed}")
    return "\n".join([*lines, "G1 E-1 F2100", ""])


def rippled() -> Machine:
    harmonics = tuple(
        RippleHarmonic(number=h, amplitude_um=a, phase_deg=p)
        for h, a, p in ((1, 20, 10), (2, 8, 40), (3, 4, -70))
    )
    source = RippleSource(name="belt", pitch_mm=2.0, harmonics=harmonics)
    plants = PlantSetSpec(nominal=ModesSpec(modes=(Mode(f_hz=45.0, zeta=0.05),)))
    update = {"axes": {"x": plants, "y": plants}, "ripple": {"x": AxisRipple(sources=(source,))}}
    return load_machine("ender3").model_copy(update=update)


@pytest.mark.slow
def test_nine_tenths_are_gone_from_the_written_file(tmp_path: Path, cache: Path) -> None:
    left = {}
    for method in ("fbf", "fbf+ripple"):
        options = {"method": method, "tolerance_um": 1.0}
        result, written = compensated(print_file(), tmp_path, cache, rippled(), **options)
        assert result.put_back == []
        left[method] = next(
            c.extruding.tracking_rms_um for c in result.channels if c.name == "after"
        )
    assert b"method=fbf+ripple" in written[:200]
    assert left["fbf+ripple"] < 0.1 * left["fbf"]


def test_a_machine_without_ripple_says_so(tmp_path: Path, cache: Path) -> None:
    with pytest.raises(DesignError, match="no ripple is known"):
        compensated(print_file(), tmp_path, cache, method="none+ripple")
    assert not (tmp_path / "out.gcode").exists()


@pytest.mark.parametrize(("accel_mm_s2", "said"), [(20_000.0, []), (6000.0, ["8 s of extruding"])])
def test_ripple_that_the_limits_leave_no_room_for_is_told(
    accel_mm_s2: float, said: list[str], tmp_path: Path, cache: Path
) -> None:
    machine = rippled()
    command = machine.command.model_copy(update={"accel_mm_s2": accel_mm_s2})
    machine = machine.model_copy(update={"command": command})
    result, _ = compensated(
        print_file(), tmp_path, cache, machine, method="shaper:mzv+ripple", tolerance_um=1.0
    )
    found = [w.partition("the ripple of ")[2] for w in result.warnings if "the ripple of" in w]
    assert [w.partition(" is not compensated")[0] for w in found] == said


def test_ripple_is_laid_over_any_method_but_is_none_itself() -> None:
    for method in ("fbf+ripple", "none+ripple", "zpetc+ripple", "shaper:mzv+ripple"):
        assert Options(method=method).method == method
    with pytest.raises(ValidationError):
        Options(method="ripple")


def test_machines_without_ripple_keep_their_revision() -> None:
    machine = load_machine("ender3")
    assert "ripple" in machine.model_dump()
    assert machine.revision != rippled().revision
    assert machine.model_copy(update={"ripple": {}}).revision == machine.revision
