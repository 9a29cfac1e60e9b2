"""Measure and sum the motion along a file, and show it to the compensator."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from stillpath.compensation.base import Compensator
from stillpath.compensation.defaults import DT_S
from stillpath.gcode.firmware.planning import intended
from stillpath.gcode.pieces import Piece, VerbatimPart
from stillpath.gcode.sampler import sample_phases, sample_until
from stillpath.gcode.types import Phases
from stillpath.pipeline.compensated_piece import CompensatedPiece, as_executed
from stillpath.pipeline.file_motion import STANDING_S
from stillpath.pipeline.measuring.measure import Measurement
from stillpath.pipeline.measuring.points import MotionSamples
from stillpath.pipeline.totals import Totals
from stillpath.pipeline.verifying import Verifier

__all__ = ["Followers", "MotionRecord"]

_CHUNK = 1 << 17


class Followers(NamedTuple):
    """Those who must know all motion of the machine, as its vibration lasts into the next piece."""

    compensator: Compensator
    verifier: Verifier


class MotionRecord:
    """Samples of pieces, and the handling of motion that is not changed.

    Parameters
    ----------
    step_mm : (float, float, float, float)
        Steps of X Y Z E that the firmware rounds to; 0: it does not.
    followers : Followers, optional
        None: the file is not changed.
    """

    def __init__(
        self,
        step_mm: tuple[float, float, float, float],
        measurement: Measurement,
        totals: Totals,
        followers: Followers | None,
    ) -> None:
        self._step_mm, self._rounds = step_mm, max(step_mm[:2]) > 0.0
        self._measurement, self._sum, self._followers = measurement, totals, followers
        self._jumped = True
        """Whether the followers do not know yet where the machine stands."""

    def begin(self, piece: Piece) -> None:
        """Let a piece begin where the machine stands."""
        if self._jumped and self._followers is not None:
            # The machine did not get here along the path (homing, for example).
            self._followers.compensator.reset(self._asked(piece, piece.phases).start_mm[0, :2])
            self._jumped = False

    def as_written(
        self, piece: Piece, paced: Piece, made: CompensatedPiece, executed: Phases
    ) -> MotionSamples:
        """Return planned and executed motion of a piece on one time grid."""
        asked = self._asked(paced, paced.phases)
        planned, position, row, extruding = as_executed(made, asked, executed)
        sliced = planned
        if self._rounds:
            moved = replace(paced.phases, t_s=made.encoded.row_start_s)
            sliced, _ = sample_phases(moved, (0.0, DT_S, len(row)), flat=True)
        return self._samples(piece, row, planned, position, extruding, sliced)

    def as_sliced(self, piece: Piece) -> MotionSamples:
        """Return the motion of a piece as the firmware executes the sliced file."""
        phases = piece.phases
        grid = (0.0, DT_S, max(round(phases.duration_s / DT_S), 1))
        asked = self._asked(piece, phases)
        path, row = sample_phases(asked, grid)
        sliced = sample_phases(phases, grid, flat=True)[0] if self._rounds else path
        moved = self._samples(piece, row, path, sliced, phases.prints[row], sliced)
        return _ending(moved, asked, phases)

    def pass_by(self, verbatim: VerbatimPart, part: Phases | float | None) -> None:
        """Measure a verbatim part: motion, standing still [s], or (None) a lost position."""
        if part is None:
            self._measurement.jump()
            if self._followers is not None:
                self._followers.verifier.lose_position()
                self._jumped = True
        elif isinstance(part, Phases):
            self._sum.add_verbatim(verbatim, part)
            self._move(verbatim, part)
        else:
            self._sum.original_s += part
            self.wait(part)

    def wait(self, dwell_s: float) -> None:
        """Count a standstill in the written file."""
        self._sum.time_s += dwell_s
        if dwell_s <= 0.0:
            return
        stood = self._measurement.stand(round(min(dwell_s, STANDING_S) / DT_S))
        if stood is not None:
            self._observe(stood)

    def _move(self, verbatim: VerbatimPart, phases: Phases) -> None:
        until = np.where(phases.prints, phases.t_s + phases.lasts_s, -np.inf)
        asked = self._asked(verbatim, phases)
        samples = max(round(phases.duration_s / DT_S), 1)
        for start in range(0, samples, _CHUNK):
            grid = (start * DT_S, DT_S, min(_CHUNK, samples - start))
            path, row, extruding = sample_until(asked, grid, until, axes=3)
            sliced = sample_phases(phases, grid, flat=True)[0] if self._rounds else path
            at = phases.move_index[row]
            moved = self._samples(verbatim, at, path, sliced, extruding, sliced)
            last = start + _CHUNK >= samples
            self._measurement.add(_ending(moved, asked, phases) if last else moved)
            self._observe(path[:2])

    def _observe(self, command_mm: np.ndarray) -> None:
        if self._followers is None:
            return
        compensator, verifier = self._followers
        verifier.observe(command_mm)
        if self._jumped and command_mm.shape[1]:
            compensator.reset(command_mm[:, 0])
            self._jumped = False
        compensator.observe(command_mm)

    def _samples(
        self,
        item: Piece | VerbatimPart,
        row: np.ndarray,
        planned: np.ndarray,
        executed: np.ndarray,
        extruding: np.ndarray,
        sliced: np.ndarray,
    ) -> MotionSamples:
        """Return the samples of an item whose moves have been counted.

        `sliced` is how the sliced file is executed, where the firmware rounds.
        """
        return MotionSamples(
            path_mm=planned[:2],
            executed_mm=executed[:2],
            z_mm=planned[2],
            extruding=extruding,
            row=row,
            moves=item.moves,
            first_move=self._sum.moves - len(item.moves),
            sliced_mm=sliced if self._rounds else None,
        )

    def _asked(self, item: Piece | VerbatimPart, phases: Phases) -> Phases:
        return intended(phases, item.moves.start_mm, item.moves.end_mm, self._step_mm)


def _ending(samples: MotionSamples, planned: Phases, sliced: Phases) -> MotionSamples:
    """Return samples with the end of their motion, which lies up to 1.5 samples after the last."""
    return replace(samples, next_mm=np.append(planned.end_mm[-1, :2], sliced.end_mm[-1, :2]))
