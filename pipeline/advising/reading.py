"""First pass over a file to be advised: collects what is needed, or refuses the file."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.base import Adviser
from stillpath.gcode.types import EventKind, ProgramBlock, rows_of
from stillpath.models.machine import Machine
from stillpath.models.operating import OperatingGrid
from stillpath.models.schedule import EMPTY, OperatingPoint
from stillpath.pipeline.advising.choosing import LEVEL_STEP
from stillpath.pipeline.advising.inserting import MARK
from stillpath.pipeline.operating_point import Operation
from stillpath.pipeline.parts import refuse_processed

__all__ = ["FirstReading"]


class FirstReading:
    """What the first pass over the sliced file collects.

    Attributes
    ----------
    levels : list of (layer, OperatingPoint)
        Operating points that differ for the plants, and the layers at which they begin.
    stored_lines : list of int
        Lines that save the settings in force permanently.
    """

    def __init__(self, machine: Machine, adviser: Adviser) -> None:
        self._adviser = adviser
        self._follows = bool(machine.schedules)
        self._operation = Operation(machine)
        self._grid = OperatingGrid(machine, step=LEVEL_STEP, blend_step=LEVEL_STEP)
        self._layer: int | None = None
        self._level: OperatingPoint | None = None
        self.levels: list[tuple[int, OperatingPoint]] = [(-1, EMPTY)]
        self.stored_lines: list[int] = []

    def see(self, block: ProgramBlock) -> None:
        """Process a block; refuse a file that was processed, or could not be restored."""
        refuse_processed(block, "advise")
        if MARK in block.text:
            raise GcodeError(
                f"the file has lines with {MARK.decode()!r}, so that advice could not be undone; "
                "take them out (stillpath remove-advice) first"
            )
        self._see_stores(block)
        if not self._follows or len(block.moves) == 0:
            return
        edges = np.flatnonzero(np.diff(block.moves.layer)) + 1
        for first, last in pairwise([0, *edges.tolist(), len(block.moves)]):
            moves = rows_of(block.moves, slice(first, last))
            point, layer = self._operation.at(moves), int(moves.layer[0])
            self._operation.passed(moves)
            if layer == self._layer:
                continue
            level = self._grid.level(point)
            if level != self._level:
                self._level = level
                if self._layer is None:
                    self.levels = [(layer, point)]
                else:
                    self.levels.append((layer, point))
            self._layer = layer

    def _see_stores(self, block: ProgramBlock) -> None:
        events = block.events
        for k in np.flatnonzero(events.kind == EventKind.UNKNOWN).tolist():
            if self._adviser.stores(block.line(events, k).decode("utf-8", "replace")):
                self.stored_lines.append(int(events.line[k]))
