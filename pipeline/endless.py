"""Refuse prints that would take impossibly long, before hours are spent on compensating them."""

from __future__ import annotations

from typing import BinaryIO

from stillpath.gcode.dialect import Dialect
from stillpath.gcode.firmware.planning import check_print_ends
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.types import Events, Moves
from stillpath.models.machine import Machine

__all__ = ["LengthGuard"]

LOOK_AHEAD_S = 48 * 3600.0
"""After this print time the rest of the file is planned first: planning costs time per line, all
else per second of the print, and a single line may last twenty minutes."""


class LengthGuard:
    """Check the print time as a file is read.

    Parameters
    ----------
    text : binary file
        The print; its position is preserved.
    """

    def __init__(self, text: BinaryIO, machine: Machine, dialect: Dialect) -> None:
        self._text, self._machine, self._dialect = text, machine, dialect
        self._looked = False

    def check(self, time_s: float, line: int) -> None:
        """Check the print time up to and including `line`, before these lines are processed.

        Raises
        ------
        GcodeError
            This, or the whole file, takes more than 1000 hours.
        """
        check_print_ends(time_s, line)
        if time_s > LOOK_AHEAD_S and not self._looked:
            self._looked = True
            place = self._text.tell()
            self._look_ahead()
            self._text.seek(place)

    def _look_ahead(self) -> None:
        reader = Interpreter(self._machine, dialect=self._dialect)
        planner = adapter(self._machine).planner()
        line = 1
        self._text.seek(0)
        for block in reader.blocks(self._text):
            planner.push(block)
            rows: Moves | Events = block.moves if len(block.moves) else block.events
            line = int(rows.line[-1]) if len(rows) else line
            check_print_ends(planner.time_s, line)
        planner.flush()
        check_print_ends(planner.time_s, line)
