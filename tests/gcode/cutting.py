"""From text to pieces and verbatim parts, for tests."""

from __future__ import annotations

import json
from pathlib import Path

from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.pieces import Piece, VerbatimPart
from stillpath.gcode.splitter import Splitter
from stillpath.gcode.types import ProgramBlock
from stillpath.models.firmware.marlin import MarlinPlanner, PerAxis
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensated_piece import CompensatedPiece
from stillpath.pipeline.options import Options
from stillpath.pipeline.piece_compensator import PieceCompensator

__all__ = ["HEAD", "MARLIN_PLANNER", "blocks_of", "compensated", "cut", "ender3_with", "pieces_of"]

_SECTIONS = Path(__file__).parents[2] / "examples" / "firmware"

MARLIN_PLANNER = MarlinPlanner(
    max_accel_mm_s2=PerAxis(x=3000.0, y=3000.0, z=200.0, e=5000.0),
    max_feedrate_mm_s=PerAxis(x=500.0, y=500.0, z=20.0, e=100.0),
    accel_mm_s2=2000.0,
    travel_accel_mm_s2=2000.0,
    junction_deviation_mm=0.02,
)

HEAD = "G28\nG90\nM83\nG1 X50 Y50 Z5 F6000\nG1 X60 Y50 F6000\nG4 P10\n"
"""After this the machine stands still at 60, 50, 5."""


def blocks_of(data: bytes, machine: Machine, *, strict_bounds: bool = True) -> list[ProgramBlock]:
    """Interpret a whole file."""
    interpreter = Interpreter(machine, strict_bounds=strict_bounds)
    return [*interpreter.push(data), *interpreter.flush()]


def cut(
    data: bytes,
    machine: Machine,
    *,
    chunk: int = 1 << 17,
    longest_s: float = 60.0,
    compensate: bool = True,
) -> list[Piece | VerbatimPart]:
    """Cut a file that arrives in chunks."""
    reader = Interpreter(machine)
    splitter = Splitter(machine, longest_s=longest_s, compensate=compensate)
    items: list[Piece | VerbatimPart] = []
    for start in range(0, len(data), chunk):
        for block in reader.push(data[start : start + chunk]):
            items += splitter.push(block)
    for block in reader.flush():
        items += splitter.push(block)
    return [*items, *splitter.flush()]


def pieces_of(text: str | bytes, machine: Machine) -> list[Piece]:
    data = text.encode() if isinstance(text, str) else text
    return [item for item in cut(data, machine) if isinstance(item, Piece)]


def ender3_with(kind: str, mesh_slope: float = 0.0) -> Machine:
    """The Ender 3 with a firmware of the examples, on a bed that is crooked by so much."""
    document = load_machine("ender3").model_dump(mode="json") | {"mesh_slope": mesh_slope}
    if kind != "klipper":
        document["firmware"] = json.loads((_SECTIONS / f"{kind}.json").read_text())
    return Machine.model_validate(document)


def compensated(text: str, machine: Machine) -> tuple[Piece, CompensatedPiece]:
    """The piece after the head, as sliced and compensated."""
    work = PieceCompensator(machine, Options())
    piece = pieces_of(text, machine)[1]
    work.compensator.reset(piece.moves.start_mm[0, :2])
    return piece, work.compensate(piece)
