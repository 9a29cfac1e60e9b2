"""Which firmware a file looks as if it were made for, against that of the machine."""

from __future__ import annotations

import io

import pytest

from stillpath.pipeline.file_dialect import dialect_warnings
from tests.gcode.cutting import ender3_with

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
