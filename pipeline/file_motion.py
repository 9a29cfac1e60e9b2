"""The planned motion of a print file, sampled part by part."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from stillpath.gcode.containers.opening import open_text
from stillpath.gcode.dialect import Dialect
from stillpath.gcode.firmware.planning import check_moves_end, check_print_ends, intended
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.sampler import Sampler, Samples
from stillpath.gcode.slicers.facts import SlicerFacts
from stillpath.gcode.types import EventKind, Moves, Phases, ProgramBlock, joined, rows_of
from stillpath.models.machine import Machine
from stillpath.models.shaping import OFF, Shaping
from stillpath.pipeline.endless import LengthGuard
from stillpath.pipeline.file_dialect import (
    cut_off_warnings,
    dialect_for,
    dialect_warnings,
    no_moves,
    skipped_notes,
    skipped_warnings,
)
from stillpath.pipeline.measuring.points import MotionSamples
from stillpath.pipeline.options import DialectName
from stillpath.pipeline.progress import ProgressCallback, ProgressReports, progress_to

__all__ = ["STANDING_S", "FileMotion", "MotionPart", "TextMotion"]

STANDING_S = 2.0
"""Measured part of a standstill: after it all vibration has died down."""


@dataclass(frozen=True, slots=True)
class MotionPart:
    """Samples with the moves they belong to.

    `path_mm`, shape (2, n), is the path in the file, given if the firmware rounds to motor steps.
    `jumped`: the position was lost before these samples. `shaping`: the firmware's shaper as set
    by the file.
    """

    samples: Samples
    path_mm: np.ndarray | None
    moves: Moves
    first_move: int
    jumped: bool
    shaping: Shaping

    def own_moves(self) -> Moves:
        """Return the moves in which the samples lie."""
        first, last = self.samples.move_index[[0, -1]] - self.first_move
        return rows_of(self.moves, slice(first, last + 1))

    def motion(self) -> MotionSamples:
        """Return the samples with line, layer and feature."""
        row = self.samples.move_index - self.first_move
        executed_mm = self.samples.xyz_mm[:2]
        return MotionSamples(
            path_mm=executed_mm if self.path_mm is None else self.path_mm,
            executed_mm=executed_mm,
            z_mm=self.samples.xyz_mm[2],
            extruding=self.moves.prints[row] & self.samples.moving,
            row=row,
            moves=self.moves,
            first_move=self.first_move,
            sliced_mm=None if self.path_mm is None else executed_mm,
        )


class TextMotion:
    """Iterate over the sampled motion of a text in bounded memory.

    Parameters
    ----------
    file : binary file
        Plain G-code, seekable; read from its beginning.
    longest_stand_s : float
        Longer standstills are cut to this.
    shaping : Shaping
        The firmware's shaper before the first line.
    progress : callable, optional
        Receives the share of the file read so far and its print time, from time to time.
    each : callable, optional
        Receives every block of the program before its motion.

    Attributes
    ----------
    time_s : float
        Duration of the motion planned so far.
    reader : Interpreter
    shapers : list of str
        Labels of the shapers set by the file, without repeats.
    """

    def __init__(
        self,
        file: BinaryIO,
        machine: Machine,
        dialect: Dialect,
        dt_s: float,
        *,
        longest_stand_s: float = np.inf,
        shaping: Shaping = OFF,
        progress: Callable[[float, float], None] = lambda _share, _time_s: None,
        each: Callable[[ProgramBlock], None] = lambda _block: None,
    ) -> None:
        self._file, self._machine, self._dialect = file, machine, dialect
        self._longest_stand_s = longest_stand_s
        self._progress, self._each = progress, each
        self._left_out_s = self._end_s = 0.0
        self._held: list[tuple[int, Moves]] = []
        self._jumps: list[int] = []
        """Indices in the file of the moves before which the position was lost."""
        self._shaping = self._read_shaping = shaping
        self._changes: list[tuple[int, Shaping]] = []
        """Indices of the moves before which the shaper was set, and the shaper."""
        self._step_mm = adapter(machine).step_mm
        self._sampler, self._path_sampler = Sampler(dt_s), Sampler(dt_s)
        self._adviser = adapter(machine).adviser(dialect)
        self._unmodelled: set[str] = set()
        self.shapers: list[str] = []
        self.time_s = 0.0
        self.reader = Interpreter(machine, dialect=dialect)

    @property
    def warnings(self) -> list[str]:
        """Return warnings about commands that the firmware skips, or that are not modelled."""
        return [*skipped_warnings(self.reader), *sorted(self._unmodelled)]

    @property
    def notes(self) -> list[str]:
        """Return notes on commands that the firmware skips unless the printer has them."""
        return skipped_notes(self.reader)

    def __iter__(self) -> Iterator[MotionPart]:
        file = self._file
        planner = adapter(self._machine).planner()
        moves = 0
        guard = LengthGuard(file, self._machine, self._dialect)
        size = max(file.seek(0, io.SEEK_END), 1)
        file.seek(0)
        for block in self.reader.blocks(file):
            moves += len(block.moves)
            self._each(block)
            self._hold(block)
            phases = planner.push(block)
            self._check(phases, planner.time_s, guard.check)
            for samples, path_mm in self._sampled(self._shortened(phases), final=False):
                yield from self._parts(samples, path_mm)
            self._progress(file.tell() / size, planner.time_s)
        phases = planner.flush()
        self._check(phases, planner.time_s, check_print_ends)
        for samples, path_mm in self._sampled(self._shortened(phases), final=True):
            yield from self._parts(samples, path_mm)
        self.time_s = planner.time_s
        if moves == 0:
            raise no_moves(self._dialect)

    def _hold(self, block: ProgramBlock) -> None:
        if len(block.moves):
            self._held.append((block.first_move, block.moves))
        events = block.events
        lost = events.kind == EventKind.UNKNOWN
        self._jumps += events.move_index[lost].tolist()
        for row in np.flatnonzero(events.kind == EventKind.SHAPER).tolist():
            self._set_shaper(block, row)

    def _set_shaper(self, block: ProgramBlock, row: int) -> None:
        events = block.events
        line = block.line(events, row).decode("utf-8", "replace")
        try:
            found = self._adviser.read_shaper(line, self._read_shaping)
        except ValueError:
            return
        self._read_shaping = found
        shaping = found.modelled
        for kind in found.unknown_types:
            self._unmodelled.add(
                f"the shaper {kind} has no model: figures are those without it (line "
                f"{int(events.line[row])})"
            )
        if shaping.label not in self.shapers:
            self.shapers.append(shaping.label)
        self._changes.append((int(events.move_index[row]), shaping))

    def _check(
        self, phases: Phases, time_s: float, check_length: Callable[[float, int], None]
    ) -> None:
        if self._held:
            check_moves_end(phases, self._line)
            check_length(time_s, int(self._held[-1][1].line[-1]))

    def _line(self, move_index: int) -> int:
        first, moves = [held for held in self._held if held[0] <= move_index][-1]
        return int(moves.line[move_index - first])

    def _shortened(self, phases: Phases) -> Phases:
        """Shorten standstills to the longest that is measured."""
        if len(phases) == 0 or np.isinf(self._longest_stand_s):
            return phases
        end_s = phases.end_s
        stands_s = phases.t_s - np.append(self._end_s, end_s[:-1])
        left_out_s = np.cumsum(np.maximum(stands_s - self._longest_stand_s, 0.0)) + self._left_out_s
        self._left_out_s, self._end_s = float(left_out_s[-1]), float(end_s[-1])
        return replace(phases, t_s=phases.t_s - left_out_s)

    def _sampled(
        self, phases: Phases, *, final: bool
    ) -> Iterator[tuple[Samples, np.ndarray | None]]:
        """Sample the motion, and the path in the file if the firmware rounds to motor steps."""
        if max(self._step_mm[:2]) == 0.0:
            for samples in _all(self._sampler, phases, final=final):
                yield samples, None
            return
        if len(phases):
            moves, first = joined([m for _, m in self._held]), self._held[0][0]
            numbered = replace(phases, move_index=phases.move_index - first)
            asked = intended(numbered, moves.start_mm, moves.end_mm, self._step_mm)
        else:
            asked = phases
        executed = _all(self._sampler, phases, final=final)
        for samples, path in zip(
            executed, _all(self._path_sampler, asked, final=final), strict=True
        ):
            yield samples, path.xyz_mm[:2]

    def _parts(self, samples: Samples, path_mm: np.ndarray | None) -> Iterator[MotionPart]:
        """Split samples where the position is lost or the shaper changes."""
        begun, jumped, last = 0, False, int(samples.move_index[-1])
        while True:
            jump = self._jumps[0] if self._jumps else last + 1
            change = self._changes[0][0] if self._changes else last + 1
            if min(jump, change) > last:
                break
            at = int(np.searchsorted(samples.move_index, min(jump, change)))
            if at > begun:
                yield self._part(samples, path_mm, slice(begun, at), jumped)
                begun, jumped = at, False
            if jump <= change:
                self._jumps.pop(0)
                jumped = True
            else:
                self._shaping = self._changes.pop(0)[1]
        yield self._part(samples, path_mm, slice(begun, len(samples)), jumped)

    def _part(
        self, samples: Samples, path_mm: np.ndarray | None, rows: slice, jumped: bool
    ) -> MotionPart:
        samples = samples.part(rows.start, rows.stop)
        path_mm = None if path_mm is None else path_mm[:, rows]
        first = int(samples.move_index[0])
        while len(self._held) > 1 and self._held[1][0] <= first:
            self._held.pop(0)
        moves = joined([m for _, m in self._held])
        return MotionPart(samples, path_mm, moves, self._held[0][0], jumped, self._shaping)


class FileMotion:
    """Iterate over the sampled motion of a print file of any kind; parameters as `TextMotion`."""

    def __init__(
        self,
        source: Path,
        plate: int | None,
        machine: Machine,
        dialect: DialectName | None,
        dt_s: float,
        progress: ProgressCallback | None,
        *,
        longest_stand_s: float = np.inf,
        each: Callable[[ProgramBlock], None] = lambda _block: None,
    ) -> None:
        self.source, self.machine, self._plate = source, machine, plate
        self._dialect = dialect_for(machine, dialect)
        self._asked = dialect
        self._dt_s, self._longest_stand_s, self._each = dt_s, longest_stand_s, each
        self._progress, self._reports = progress, ProgressReports(progress)
        self.time_s = 0.0
        self.feature_names: list[str] = []
        self.facts = SlicerFacts()
        self.warnings: list[str] = []
        self.notes: list[str] = []
        self.shapers: list[str] = []

    def __iter__(self) -> Iterator[MotionPart]:
        unpacking = progress_to(self._progress, "unpacking", 0.0)
        with open_text(self.source, plate=self._plate, progress=unpacking) as container:
            self.facts = container.facts()
            doubtful = dialect_warnings(container.text, self.machine, self._asked)
            motion = TextMotion(
                container.text,
                self.machine,
                self._dialect,
                self._dt_s,
                longest_stand_s=self._longest_stand_s,
                progress=partial(self._reports.say, "planning"),
                each=self._each,
            )
            self.feature_names = motion.reader.feature_names
            yield from motion
        self.time_s, self.shapers = motion.time_s, motion.shapers
        self.warnings = [
            *doubtful,
            *cut_off_warnings(self.facts, motion.reader),
            *motion.warnings,
        ]
        self.notes = motion.notes


def _all(sampler: Sampler, phases: Phases, *, final: bool) -> Iterator[Samples]:
    yield from sampler.push(phases)
    if final:
        yield from sampler.flush()
