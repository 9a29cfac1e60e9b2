"""A piece is written on trial: if its check fails, the writer must be as it was."""

from __future__ import annotations

import pytest

from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.firmware.writing import StreamWriter
from tests.gcode.cutting import HEAD, compensated, ender3_with
from tests.gcode.prints import polygon


@pytest.mark.parametrize("kind", ["klipper", "marlin", "reprapfirmware"])
def test_what_a_snapshot_writes_leaves_the_writer_as_it_is(kind: str) -> None:
    """A piece switches the shaper off, and sets a far E to 0 where E is a 32-bit float."""
    machine = ender3_with(kind)
    text = HEAD + "G1 X120 Y100 F6000\n" + "\n".join(polygon(8, 20))
    piece, made = compensated(text, machine)
    writer, far_mm = StreamWriter(adapter(machine), "1.0"), 400.0
    once = writer.snapshot().piece(piece, made.encoded, far_mm)
    assert writer.snapshot().piece(piece, made.encoded, far_mm) == once
    assert writer.end(True, far_mm) == b""
