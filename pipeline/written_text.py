"""The text of the written file: our lines and the file's, written and read back as one."""

from __future__ import annotations

import copy

from stillpath.gcode.dialect import Dialect
from stillpath.gcode.firmware.encoding import Encoded
from stillpath.gcode.firmware.planning import join_phases
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.firmware.writing import StreamWriter
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.pieces import Piece, VerbatimPart
from stillpath.gcode.plan import plan_moves
from stillpath.gcode.types import Phases, ProgramBlock
from stillpath.models.machine import Machine

__all__ = ["WrittenText"]


class WrittenText:
    """Writes lines in order, and reads them as the printer will.

    What is written depends on the printer's E after everything before, which the reader of the
    written text knows. So every text must be read back before the next one is written.

    Parameters
    ----------
    dialect : Dialect
        How the file is read.
    stamp : str
        Version and options (`pipeline.options.stamp`).

    Attributes
    ----------
    writer : StreamWriter
    """

    def __init__(self, machine: Machine, dialect: Dialect, stamp: str) -> None:
        self._machine, self._adapter = machine, adapter(machine)
        self.writer = StreamWriter(self._adapter, stamp)
        self._reader = Interpreter(machine, dialect=dialect)

    def snapshot(self) -> WrittenText:
        """Return a copy of the state, to go back to if the next piece must not be written."""
        twin = copy.copy(self)
        twin.writer, twin._reader = self.writer.snapshot(), self._reader.snapshot()
        return twin

    def leading(self, piece: Piece) -> list[ProgramBlock]:
        """Return what lines before a piece's stream would do that take time; often nothing."""
        lines = self.writer.leading(piece, self._reader.extruder_mm)
        return self._reader.snapshot().push(lines) if lines else []

    def piece(self, piece: Piece, encoded: Encoded) -> tuple[bytes, bytes]:
        """Return the text of a compensated piece: lines behind an object's mark, and the rest."""
        extruder_mm = self._reader.extruder_mm
        lead = self.writer.leading(piece, extruder_mm) if piece.after_mark else b""
        return lead, self.writer.piece(piece, encoded, extruder_mm)[len(lead) :]

    def executed(self, lead: bytes, text: bytes) -> Phases:
        """Read the text of a piece back; return the plan of its moves by the firmware's rules.

        Raises
        ------
        GcodeError
            The firmware would refuse a line.
        """
        self._reader.push(lead)
        blocks = self._reader.push(text)
        parts = [(block.moves, block.limits) for block in blocks if len(block.moves)]
        if len(parts) == 1:
            return plan_moves(*parts[0], self._machine)
        planner = self._adapter.planner()
        phases = [planner.push_moves(moves, limits) for moves, limits in parts]
        return join_phases([*phases, planner.flush()])

    def verbatim(self, verbatim: VerbatimPart) -> bytes:
        """Return the text of unchanged lines, with our own before them if needed.

        Raises
        ------
        GcodeError
            For a line that must not stand in a file with a stream.
        """
        return self.writer.verbatim(verbatim, self._reader.extruder_mm)

    def end(self, *, ends_with_newline: bool) -> bytes:
        """Return lines that give the printer back at the end of the file; often none."""
        return self.writer.end(ends_with_newline, self._reader.extruder_mm)

    def read_back(self, text: bytes) -> list[ProgramBlock]:
        """Read text as written, other than that of a piece; return its content."""
        return self._reader.push(text)
