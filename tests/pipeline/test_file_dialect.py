"""Which firmware a file looks as if it were made for, against that of the machine."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import pytest

import stillpath
from stillpath.gcode.errors import GcodeError
from stillpath.models.machine import Machine
from stillpath.pipeline.file_dialect import dialect_for, dialect_warnings, extruder_mode_awaited
from tests.gcode.cutting import ender3_with


def compensate(source: Path, machine: Machine) -> object:
    return stillpath.compensate(source, source.with_suffix(".out"), machine)


def simulate(source: Path, machine: Machine) -> object:
    return stillpath.simulate(source, machine)


START = b"; a slicer that does not say its flavour\nM83\nM572 S0.04\nG1 X50 Y50 E1 F3000\n"


@pytest.mark.parametrize(
    ("kind", "text", "doubted"),
    [
        ("reprapfirmware", START, False),
        ("reprapfirmware", b"M555 X1 Y1 W2 H2\n" + START, True),
        ("marlin", START, True),
        ("marlin", START.replace(b"M572 S", b"M900 K"), False),
    ],
)
def test_pressure_advance_of_the_tool_in_use_is_no_sign_against_reprapfirmware(
    kind: str, text: bytes, doubted: bool
) -> None:
    """M572 without D was called a command of Prusa's firmware alone."""
    found = dialect_warnings(io.BytesIO(text), ender3_with(kind))
    assert any("written for prusa" in warning for warning in found) is doubted


_LINES = "G1 X50 Y50 Z.2 F6000\nG1 X90 E1.5 F1800\nG1 Y90 E1.5\nG1 X50 E1.5\nG1 Y50 E1.5\n"
_GROWING = "G1 X50 Y50 Z.2 F6000\nG1 X90 E1.5 F1800\nG1 Y90 E3\nG1 X50 E4.5\nG1 E3.5\nG1 E4.5\n"


_KISSLICER = "START_PRINT\nG1 X10 Y10 E0 F6000\nG1 E8 F4200\n" + "".join(
    f"G1 X{10 + k} E{8 + 0.05 * (k - k % 2):.4f} F600\n" for k in range(1, 20)
)
_WIDE = "START_PRINT\n" + "".join(f"G1 X{100 * (k % 2)} E{3 + k - k % 2}\n" for k in range(30))
"""E stays as it is on the way to the next line."""


@pytest.mark.parametrize(
    ("text", "awaited"),
    [
        ("START_PRINT\n" + _LINES, True),
        (";FLAVOR:Marlin\nprint_start bed=70\nG1 E-6 F4200\n" + _LINES + "G1 E6\n" + _LINES, True),
        ("START_PRINT\n" + _GROWING, False),
        (_KISSLICER, False),
        (_WIDE, False),
        ("START_PRINT\n" + _GROWING + "G92 E0\n" + _GROWING, False),
        ("M83\nSTART_PRINT\n" + _LINES, False),
        ("START_PRINT\nM83\n" + _LINES, False),
        ("START_PRINT\nG91\n" + _LINES + "G90\n" + _GROWING, False),
    ],
)
def test_a_start_macro_may_have_made_e_relative(text: str, awaited: bool) -> None:
    """Kiri:Moto says no mode by itself, and Klipper's macro print_start has M83."""
    machine = ender3_with("klipper")
    own = dialect_for(machine)
    dialect, warnings = extruder_mode_awaited(io.BytesIO(text.encode()), machine, own)
    assert dialect.extruder_mode_known is not awaited
    assert any("says M82 or M83" in warning for warning in warnings) is awaited


@pytest.mark.parametrize(("kind", "word"), [("klipper", "G01"), ("marlin", "g1")])
@pytest.mark.parametrize("work", [compensate, simulate])
def test_moves_that_the_firmware_does_not_read_are_no_moves(
    tmp_path: Path, kind: str, word: str, work: Callable[[Path, Machine], object]
) -> None:
    """CAM programs write G01; the error asked for LF line ends, which the file had."""
    source = tmp_path / "part.gcode"
    source.write_text(f"G28\nM83\n{word} X50 Y50 F6000\n{word} X90 E1\n")
    with pytest.raises(GcodeError, match=rf"no moves that (Klipper|Marlin) reads.* no {word}\b"):
        work(source, ender3_with(kind))
