"""From text to pieces and passages, for tests."""

from __future__ import annotations

from gcode.interpreter import Interpreter
from gcode.pieces import Passage, Piece, Splitter
from models.machine import Machine

__all__ = ["HEAD", "cut", "pieces_of"]

HEAD = "G28\nG90\nM83\nG1 X50 Y50 Z5 F6000\nG1 X60 Y50 F6000\nG4 P10\n"
"""Behind this the machine stands still at 60, 50, 5."""


def cut(
    data: bytes,
    machine: Machine,
    *,
    chunk: int = 1 << 17,
    longest_s: float = 60.0,
    compensate: bool = True,
) -> list[Piece | Passage]:
    """Cut a file that arrives in chunks."""
    reader = Interpreter(machine)
    splitter = Splitter(machine, longest_s=longest_s, compensate=compensate)
    items: list[Piece | Passage] = []
    for start in range(0, len(data), chunk):
        for block in reader.push(data[start : start + chunk]):
            items += splitter.push(block)
    for block in reader.flush():
        items += splitter.push(block)
    return [*items, *splitter.flush()]


def pieces_of(text: str | bytes, machine: Machine) -> list[Piece]:
    data = text.encode() if isinstance(text, str) else text
    return [item for item in cut(data, machine) if isinstance(item, Piece)]
