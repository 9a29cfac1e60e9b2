"""One run of the pipeline over a file: read, compensated, written, read back and measured.

A file is read block by block, cut into pieces and verbatim parts, and written in order. Every piece
that was changed is read back from the bytes as written, planned by the firmware's rules and
compared with its command; a piece that fails is written as sliced. All figures come from the motion
that was read back.
"""

from __future__ import annotations

import copy
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from stillpath.compensation.base import DesignError
from stillpath.compensation.defaults import DT_S
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.pieces import LeftOut, Piece, VerbatimPart
from stillpath.gcode.slicers.facts import SlicerFacts
from stillpath.gcode.slicers.retiming import Retiming
from stillpath.gcode.splitter import Splitter
from stillpath.gcode.types import Events, Moves, Phases, ProgramBlock
from stillpath.models.errors import ModelError
from stillpath.models.schedule import EMPTY
from stillpath.pipeline.clock import StageClock
from stillpath.pipeline.compensated_piece import CompensatedPiece, Unfit, deviation
from stillpath.pipeline.endless import LengthGuard
from stillpath.pipeline.file_dialect import (
    dialect_for,
    dialect_warnings,
    extruder_mode_awaited,
    no_moves,
)
from stillpath.pipeline.files import Discarding, default_cache_dir
from stillpath.pipeline.job_design import design_job
from stillpath.pipeline.last_check.comparing import LastCheck
from stillpath.pipeline.measuring.layer_files import LayerWriter
from stillpath.pipeline.measuring.measure import Measurement
from stillpath.pipeline.measuring.points import MotionSamples, part_of
from stillpath.pipeline.measuring.tracing import Trace
from stillpath.pipeline.motion_record import Followers, MotionRecord
from stillpath.pipeline.operating_point import Operation
from stillpath.pipeline.options import stamp
from stillpath.pipeline.order import Order
from stillpath.pipeline.pacing.budget import SpeedBudget
from stillpath.pipeline.pacing.budget_measure import BudgetMeasurement
from stillpath.pipeline.pacing.excerpts import take_excerpts
from stillpath.pipeline.parts import FileParts
from stillpath.pipeline.progress import ProgressReports
from stillpath.pipeline.result import PutBack, Result, StageTime
from stillpath.pipeline.selection import Selection, TooLarge
from stillpath.pipeline.summary import Summary
from stillpath.pipeline.totals import Totals
from stillpath.pipeline.verbatim import (
    Restarts,
    flowing_s,
    plan_verbatim,
    stops_in,
    switching_s,
    takes_s,
)
from stillpath.pipeline.verifying import Verifier
from stillpath.pipeline.written_text import WrittenText

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

__all__ = ["COMPENSATED", "PieceAttempt", "PipelineRun"]

_EXPLAINED = (Unfit, GcodeError, DesignError, ModelError)
"""Errors whose message tells the user why a piece cannot be compensated."""
_FAULTS = (*_EXPLAINED, ArithmeticError, AssertionError, LookupError, TypeError, ValueError)
"""These and our own bugs: only the piece concerned stays as sliced."""
_PLANNED = (Piece, LeftOut)
_CHOSEN = 0.2
COMPENSATED = 0.99
"""Shares of the work done when the speeds are chosen, and when the last piece is compensated."""


@dataclass(frozen=True, slots=True)
class PieceAttempt:
    """A piece as it may be written, its motion as read back, and its gap (n,) from the command."""

    made: CompensatedPiece
    executed: Phases
    gap_mm: np.ndarray
    text: bytes
    motion: MotionSamples


class PipelineRun:
    """One run of the pipeline over one file.

    The text stays in `target` until its times are known; `retiming` then copies it. `_reader`
    follows the sliced file, and `_written` what is written of it. Where the file is not changed
    there is no `_piece_compensator`, `_verifier` or `_written`.

    Parameters
    ----------
    source, target : binary files
        Plain G-code, seekable; the target is read again at the end.
    trace : callable, optional
        Is given the motion as it is measured.
    budget : SpeedBudget, optional
        Paces from an earlier run; None: chosen here if the options have a budget.

    Attributes
    ----------
    compensated : list of (int, int)
        First and last line of every compensated piece, in order.
    """

    def __init__(
        self,
        source: BinaryIO,
        target: BinaryIO,
        order: Order,
        layers: LayerWriter | None = None,
        trace: Callable[[Trace], None] | None = None,
        budget: SpeedBudget | None = None,
    ) -> None:
        machine, options = order.machine, order.options
        self._order, self._layers, self._budget = order, layers, budget
        self.compensated: list[tuple[int, int]] = []
        self._verbatim_before: VerbatimPart | None = None
        """The part before, if it was written as sliced."""
        self._source, self._target = source, target
        self._machine, self._options = machine, options
        self._reports = ProgressReports(order.progress)
        self._clock = StageClock()
        self._changes = options.method != "none"
        self._sum = Totals()
        self._adapter = adapter(machine)
        self._restarts_sliced = Restarts(self._adapter.restart_s)
        self._restarts_written = copy.copy(self._restarts_sliced)
        if self._changes and self._adapter.refusal is not None:
            raise ModelError(f"{machine.name} cannot execute this file: {self._adapter.refusal}")
        cache_dir = order.cache_dir or default_cache_dir()
        self._design = design_job(machine, options, cache_dir, self._clock, self._say)
        own = dialect_for(machine, options.dialect)
        dialect, unsaid = extruder_mode_awaited(source, machine, own)
        self._length = LengthGuard(source, machine, dialect)
        self._reader = Interpreter(machine, dialect=dialect)
        self._splitter = Splitter(machine, compensate=self._changes)
        self._selection = Selection(options.where, machine)
        self._operation = Operation(machine)
        self._point = EMPTY
        """Operating point of the item in hand."""
        measures = BudgetMeasurement if options.paced else Measurement
        self._measurement = measures(
            machine,
            DT_S,
            self._design.shaper,
            take_layer=layers.add if layers else None,
            trace=trace,
            size=source.seek(0, io.SEEK_END),
        )
        followers = None
        if self._design.piece_compensator is not None:
            self._piece_compensator = self._design.piece_compensator
            self._verifier = Verifier(machine, options.tolerance_um)
            self._written = WrittenText(machine, dialect, stamp(machine, options))
            followers = Followers(self._piece_compensator.compensator, self._verifier)
        self._motion = MotionRecord(self._adapter.step_mm, self._measurement, self._sum, followers)
        writer = self._written.writer if self._changes else None
        ends = () if writer is None else (writer.header(), writer.footer())
        self._sum.written_bytes = sum(len(text) for text in ends)
        self.retiming = Retiming(*ends, keep_times=options.times == "kept" or not self._changes)
        self._sum.warnings += [*dialect_warnings(source, machine, options.dialect), *unsaid]

    @property
    def _pairs(self) -> BudgetMeasurement | None:
        """The measurement, if it compares both paces; else None."""
        return self._measurement if isinstance(self._measurement, BudgetMeasurement) else None

    @property
    def gentler(self) -> SpeedBudget | None:
        """Return a gentler budget if the written file exceeds its own; else None."""
        if self._budget is None or self._pairs is None:
            return None
        return self._budget.gentler(self._pairs.sums())

    @property
    def same(self) -> SpeedBudget | None:
        """Return the budget with which the file was written."""
        return self._budget.again() if self._budget is not None else None

    @property
    def delay_s(self) -> float:
        """Delay of the written file against the original at the current place."""
        return self._sum.time_s - self._sum.original_s

    def write(self, name: str, facts: SlicerFacts) -> Result:
        """Write the file except for its times, and return the figures measured on it.

        Raises
        ------
        GcodeError, TooLarge
        """
        size, begun = max(self._source.seek(0, io.SEEK_END), 1), 0.0
        if self._pairs is not None and self._budget is None:
            self._budget, begun = self._chosen_paces(size), _CHOSEN
        self._source.seek(0)
        for item in self._selected():
            self._point = self._operation.at(item.moves)
            self._measurement.operate_at(self._point)
            if isinstance(item, Piece):
                self._piece(item)
            else:
                self._verbatim(item)
            self._operation.passed(item.moves)
            # Not source.tell(): a whole block is read before its first piece is compensated.
            share = (item.text_offset + len(item.text)) / size
            self._say("compensating", begun + (COMPENSATED - begun) * share)
        if self._sum.moves == 0:
            raise no_moves(self._reader.dialect)
        if self._changes:
            text = self._written.end(ends_with_newline=self._sum.newline)
            self._motion.wait(switching_s(self._written.read_back(text)))
            self._count(self.retiming.end(text.lstrip(b"\n")))
        self._measurement.finish()
        if self._layers is not None:
            self._layers.finish(self._reader.feature_names)
        return self._summary().result(name, size, facts, self._clock)

    def checked(self, result: Result) -> Result:
        """Compare the file to be delivered with the original.

        Raises
        ------
        LastCheckError
        """
        if not self._changes:
            self._say("done", 1.0)
            return result
        step_mm, shortest_mm = self._adapter.step_mm, 2.0 * self._adapter.shortest_move_mm
        check = LastCheck(Discarding(), self._source, self._machine, step_mm, shortest_mm)
        self.deliver(check)
        figures = check.finish()
        self._say("done", 1.0)
        stage = StageTime(stage="last check", cpu_s=round(check.cpu_s, 4))
        return result.model_copy(update={"last_check": figures, "stages": [*result.stages, stage]})

    def deliver(self, text: SupportsWrite[bytes]) -> None:
        """Write the file with its new times."""
        self._target.seek(0)
        self.retiming.copy(self._target, text, self.delay_s)

    def _chosen_paces(self, size: int) -> SpeedBudget:
        self._source.seek(0)
        with self._clock.stage("budget"):
            found = take_excerpts(
                self._source,
                self._machine,
                dialect_for(self._machine, self._options.dialect),
                lambda read: self._say("choosing speeds", _CHOSEN * read / size),
            )
            design = self._design
            return SpeedBudget.chosen(
                found, self._machine, self._options, design.shaper, design.caution
            )

    def _selected(self) -> Iterator[Piece | VerbatimPart]:
        previous: VerbatimPart | None = None
        for item in FileParts(self._source, self._reader, self._splitter, self._clock):
            with self._clock.stage("plan"):
                # The sliced file does not stop between them.
                late_s = self._restarts_sliced.after([item]) - self._gained_s(previous, item)
            self._sum.original_s += late_s
            if self._budget is not None:
                self._budget.passed(late_s)
            previous = item
            before_s, names = self._sum.original_s, self._reader.feature_names
            yield from self._clock.each("plan", self._selection.divide(item, names))
            if isinstance(item, Piece) and self._options.where != "all":
                # The sliced file does not stand still where it was divided.
                self._sum.original_s = before_s + item.phases.duration_s

    def _piece(self, piece: Piece) -> None:
        delay_s = self.delay_s
        self._sum.begin_piece(piece)
        self._check_end(piece, piece.phases.duration_s)
        self._sum.original_s += piece.phases.duration_s
        lines = int(piece.moves.line[0]), int(piece.moves.line[-1])
        paces = iter((piece,)) if self._budget is None else self._budget.paced(piece)
        refusal = self._order.refusal(*lines) or self._written.writer.shaper_test(piece)
        if refusal is not None:
            next(paces)  # counts the time with the shaper
            self._put_back(piece, refusal)
            return
        self._motion.begin(piece)
        led_s = self._led_s(piece)
        for paced in self._clock.each("plan", paces):
            try:
                attempt = self._attempt(piece, paced)
                break
            except Unfit as error:
                reason = str(error)
            except GcodeError as error:  # its line number is of the written text
                reason = f"the firmware would refuse the compensated lines: {error.message}"
        else:
            self._sum.time_s -= led_s
            self._put_back(piece, reason)
            return
        self.compensated.append(lines)
        self._accept(piece, attempt, delay_s)

    def _accept(self, piece: Piece, attempt: PieceAttempt, delay_s: float) -> None:
        """Write and measure a piece as attempted; `delay_s` was the delay before it."""
        self._verbatim_before = None
        self._restarts_written.after([piece])
        self._piece_compensator.compensator.commit()
        # The last sample of an item is the first one of the next.
        written = part_of(attempt.motion, 0, len(attempt.motion) - 1)
        self._verifier.observe(written.executed_mm)
        self._sum.add_piece(attempt.made, attempt.executed, attempt.gap_mm)
        with self._clock.stage("measure"):
            if self._budget is None or self._pairs is None:
                self._measurement.add(written)
            else:
                classes = self._budget.classes(piece.moves)
                self._pairs.add_pair(written, self._motion.as_sliced(piece), classes)
                self._budget.correct(self._pairs.sums())
        late_s = attempt.made.encoded.row_start_s - (piece.phases.t_s - piece.phases.t_s[0])
        self._emit(attempt.text, piece, np.append(delay_s + late_s, self.delay_s))

    def _led_s(self, piece: Piece) -> float:
        """Count how long the lines before the piece's stream take, and return it.

        This precedes the compensation of the piece: vibration dies down meanwhile.
        """
        blocks = self._written.leading(piece)
        seconds, moving = switching_s(blocks), [block for block in blocks if len(block.moves)]
        seconds += sum(flowing_s(self._verbatim_before, b, self._machine) for b in moving)
        self._motion.wait(seconds)
        restarts = copy.copy(self._restarts_written)
        restart_s = restarts.after(blocks) + restarts.after([piece], from_rest=True)
        self._sum.time_s += restart_s
        return seconds + restart_s

    def _attempt(self, piece: Piece, paced: Piece) -> PieceAttempt:
        """Compensate and write a piece at a pace and read it back; or leave everything as it was.

        Parameters
        ----------
        piece, paced : Piece
            As sliced, and as planned at the new pace.
        """
        before = self._written.snapshot()
        try:
            with self._clock.stage("compensate"):
                made = self._piece_compensator.compensate(paced, self._point)
            with self._clock.stage("write"):
                lead, text = self._written.piece(piece, made.encoded)
            with self._clock.stage("read back"):
                executed = self._written.executed(lead, text)
                gap_mm = deviation(made, executed)
                self._verifier.check_motion(piece, made, gap_mm, executed)
            with self._clock.stage("measure"):
                motion = self._motion.as_written(piece, paced, made, executed)
                if self._budget is None:
                    self._verifier.check_gain(motion, self._point)
        except _FAULTS as error:
            self._written = before
            if isinstance(error, _EXPLAINED):
                raise
            raise Unfit(
                f"line {int(piece.moves.line[0])}: internal error ({type(error).__name__}: "
                f"{error}); please report it with the file"
            ) from error
        return PieceAttempt(made, executed, gap_mm, lead + text, motion)

    def _put_back(self, piece: Piece, reason: str) -> None:
        """Write a piece as sliced and undo what was counted for it."""
        phases, seconds = piece.phases, piece.phases.duration_s
        self._sum.put_back.append(
            PutBack(
                line_first=int(piece.moves.line[0]),
                line_last=int(piece.moves.line[-1]),
                seconds=seconds,
                extruding_seconds=float(np.sum(phases.lasts_s[phases.prints])),
                reason=reason,
            )
        )
        self._sum.original_s -= seconds
        self._sum.moves -= len(piece.moves)
        if self._budget is not None:
            self._budget.passed(-seconds)
        self._verbatim(piece)

    def _verbatim(self, verbatim: VerbatimPart) -> None:
        text = verbatim.text
        blocks: Sequence[VerbatimPart | ProgramBlock] = [verbatim]
        if self._changes:
            text = self._written.verbatim(verbatim)
            with self._clock.stage("read back"):
                blocks = self._written.read_back(text)
            # Our own lines can also add standstill, or lengthen the file's.
            self._motion.wait(switching_s(blocks) - switching_s([verbatim]))
            if stops_in(blocks) == stops_in([verbatim]):
                self._sum.time_s -= self._gained_s(self._verbatim_before, verbatim)
            self._verbatim_before = verbatim
        self._sum.time_s += self._restarts_written.after(blocks)
        self._emit(text, verbatim, self.delay_s)
        self._sum.moves += len(verbatim.moves)
        self._sum.newline = verbatim.text.endswith(b"\n") if verbatim.text else self._sum.newline
        with self._clock.stage("plan"):
            parts = list(plan_verbatim(verbatim, self._machine))
        seconds = sum(takes_s(part) for part in parts)
        self._check_end(verbatim, seconds)
        if self._budget is not None:
            self._budget.passed(seconds)
        with self._clock.stage("measure"):
            for part in parts:
                self._motion.pass_by(verbatim, part)

    def _gained_s(self, before: VerbatimPart | None, after: VerbatimPart) -> float:
        """Return how much sooner a part ends if the motion flows into it from the one before.

        Parts that are verbatim in the sliced file as well count alike in both times: 0.
        """
        if before is None or not any(isinstance(part, _PLANNED) for part in (before, after)):
            return 0.0
        alone_s = flowing_s(None, after, self._machine)
        return alone_s - flowing_s(before, after, self._machine)

    def _check_end(self, item: VerbatimPart, seconds: float) -> None:
        lines: Moves | Events = item.moves if len(item.moves) else item.events
        if len(lines):
            self._length.check(self._sum.original_s + seconds, int(lines.line[-1]))

    def _emit(self, text: bytes, item: VerbatimPart, delay_s: float | np.ndarray) -> None:
        self._count(len(text))
        self._target.write(text)
        self.retiming.push(text, item, delay_s)

    def _count(self, size: int) -> None:
        self._sum.written_bytes += size
        if self._sum.written_bytes > 1e6 * (self._options.max_mb or float("inf")):
            raise TooLarge

    def _say(self, stage: str, fraction: float) -> None:
        self._reports.say(stage, fraction, self._sum.time_s)

    def _summary(self) -> Summary:
        budget = None
        if self._budget is not None and self._pairs is not None:
            budget = self._budget, self._pairs
        return Summary(
            machine=self._machine,
            options=self._options,
            totals=self._sum,
            measurement=self._measurement,
            selection=self._selection,
            operation=self._operation,
            reader=self._reader,
            writer=self._written.writer if self._changes else None,
            shaper=self._design.shaper,
            choice=self._design.mixture,
            budget=budget,
        )
