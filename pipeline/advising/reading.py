"""First pass over a file to be advised: collects what is needed, or refuses the file."""

from __future__ import annotations

import re
from itertools import pairwise

import numpy as np

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.base import Adviser
from stillpath.gcode.firmware.file_shapers import FileShapers
from stillpath.gcode.types import EventKind, ProgramBlock, rows_of
from stillpath.models.machine import Machine
from stillpath.models.operating import OperatingGrid
from stillpath.models.schedule import EMPTY, OperatingPoint
from stillpath.pipeline.advising.choosing import LEVEL_STEP
from stillpath.pipeline.advising.inserting import MARK
from stillpath.pipeline.operating_point import Operation
from stillpath.pipeline.parts import refuse_processed

__all__ = ["FirstReading"]

_ACCELS_OF_A_TEST = 4
_TUNING_TOWER = re.compile(rb"\s*TUNING_TOWER\b", re.IGNORECASE)


class FirstReading:
    """What the first pass over the sliced file collects.

    Attributes
    ----------
    levels : list of (layer, OperatingPoint)
        Operating points that differ for the plants, and the layers at which they begin.
    stored_lines : list of int
        Lines that save the settings in force permanently.
    test : str or None
        Why the file seems to try out shapers or accelerations, which advice would replace.
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
        self.test: str | None = None
        self._shapers = FileShapers()
        self._accels: dict[tuple[int, int], _RisingAccels] = {}
        """By tool and feature."""

    def see(self, block: ProgramBlock) -> None:
        """Process a block; refuse a file that was processed, or could not be restored."""
        refuse_processed(block, "advise")
        if MARK in block.text:
            raise GcodeError(
                f"the file has lines with {MARK.decode()!r}, so that advice could not be undone; "
                "take them out (stillpath remove-advice) first"
            )
        self._see_stores(block)
        if self.test is None:
            self._see_shapers(block)
            self._see_accels(block)
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
            if self.test is None and _TUNING_TOWER.match(block.line(events, k)):
                self.test = (
                    f"TUNING_TOWER (line {int(events.line[k])}) tries one setting after the other"
                )

    def _see_shapers(self, block: ProgramBlock) -> None:
        moves, events = block.moves, block.events
        printing, done = np.flatnonzero(moves.prints), 0
        for k in [*np.flatnonzero(events.kind == EventKind.SHAPER).tolist(), None]:
            at = len(moves) if k is None else int(events.move_index[k]) - block.first_move
            for row in printing[(printing >= done) & (printing < at)][:1].tolist():
                self.test = self.test or self._shapers.test(int(moves.tool[row]))
            if k is not None:
                self._shapers.note(block.line(events, k), int(events.line[k]))
            done = at

    def _see_accels(self, block: ProgramBlock) -> None:
        moves = block.moves
        rows = np.flatnonzero(moves.prints)
        if len(rows) == 0:
            return
        keys = np.stack([moves.tool[rows], moves.feature[rows], moves.limits_id[rows]])
        changed = np.append(True, np.any(keys[:, 1:] != keys[:, :-1], axis=0))
        for row in rows[changed].tolist():
            tool, feature = int(moves.tool[row]), int(moves.feature[row])
            accels = self._accels.setdefault((tool, feature), _RisingAccels())
            accel_mm_s2 = self._adviser.accel_mm_s2(block.limits[int(moves.limits_id[row])])
            accels.see(accel_mm_s2, float(moves.end_mm[row, 2]))
            if accels.is_test:
                self.test = (
                    "the file prints the same at one acceleration after the other, the higher it "
                    f"gets (line {int(moves.line[row])}: {accel_mm_s2:g} mm/s2 is number "
                    f"{_ACCELS_OF_A_TEST})"
                )
                return


class _RisingAccels:
    """Accelerations of one feature: a tower goes on to another one at a height, and never back."""

    def __init__(self) -> None:
        self._seen: list[float] = []
        self._last_z_mm = -np.inf
        self._mixed = False

    @property
    def is_test(self) -> bool:
        return len(self._seen) >= _ACCELS_OF_A_TEST and not self._mixed

    def see(self, accel_mm_s2: float, z_mm: float) -> None:
        if self._seen[-1:] == [accel_mm_s2]:
            return
        self._mixed |= accel_mm_s2 in self._seen or z_mm <= self._last_z_mm
        self._seen.append(accel_mm_s2)
        self._last_z_mm = z_mm
