"""Running totals of a file, and the warnings that follow from them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from stillpath.compensation.defaults import DT_S
from stillpath.gcode.pieces import LeftOut, Piece, VerbatimPart
from stillpath.gcode.types import Phases
from stillpath.pipeline.compensated_piece import CompensatedPiece
from stillpath.pipeline.result import PutBack

__all__ = ["NOT_COMPENSATED", "Totals"]

NOT_COMPENSATED = "of the extruding time is not compensated"
"""Beginning of the warning, after the share."""

_WARN_SHARE = 0.2
"""Share of the extruding time above which the report warns that it is not compensated."""


class Totals:
    """Sums along a file.

    Attributes
    ----------
    moves, pieces, segments : int
        Moves of the file, pieces that may be compensated, and segments written.
    written_bytes : int
    original_s, time_s : float
        Time so far of the sliced and of the written file.
    compensated_s, extruding_s : float
        Time of the compensated pieces, and of all extruding.
    verbatim_s, verbatim_extruding_s : float
        Time of the motion whose lines are unchanged, reverted pieces included, and of its
        extruding; without what the options leave out.
    verbatim_line : int
        First line of it that extrudes, reverted pieces excepted; 0: none.
    left_out_s, left_out_extruding_s : float
        The same of what the options leave out.
    rippling_s : float
        Extruding time with ripple, although that was to be compensated.
    gap_square_mm2, gap_max_mm, gap_samples : float, float, int
        Distance of the written motion from its command: sum of squares, maximum, samples.
    filament_error_mm : float
        Largest difference of the filament that a piece feeds from its command.
    put_back : list of PutBack
        Reverted pieces.
    tools : set of int
        Those that print in pieces.
    newline : bool
        Whether the text so far ends with a line end.
    """

    def __init__(self) -> None:
        self.moves = self.pieces = self.segments = self.written_bytes = 0
        self.original_s = self.time_s = self.compensated_s = self.extruding_s = 0.0
        self.peak_segments_per_s = self.peak_velocity_mm_s = self.peak_accel_mm_s2 = 0.0
        self.gap_square_mm2 = self.gap_max_mm = self.filament_error_mm = 0.0
        self.gap_samples = 0
        self.verbatim_s, self.verbatim_extruding_s, self.verbatim_line = 0.0, 0.0, 0
        self.left_out_s = self.left_out_extruding_s = self.rippling_s = 0.0
        self.put_back: list[PutBack] = []
        self.tools: set[int] = set()
        self.warnings: list[str] = []
        self.newline = True

    def begin_piece(self, piece: Piece) -> None:
        """Count a piece of the file."""
        self.pieces += 1
        self.moves += len(piece.moves)
        self.tools.update(np.unique(piece.moves.tool[piece.moves.prints]).tolist())

    def add_piece(self, made: CompensatedPiece, executed: Phases, gap_mm: np.ndarray) -> None:
        """Add a piece as written, and the distance of its motion from its command."""
        timeline, encoded = made.timeline, made.encoded
        seconds = executed.duration_s + float(timeline.start_s[0])
        self.time_s += seconds
        self.compensated_s += seconds
        extruding_s = DT_S * np.count_nonzero(made.extruding)
        self.extruding_s += extruding_s
        self.rippling_s += extruding_s if made.keeps_ripple else 0.0
        # As written: an encoder that puts vertices on steps adds some to those of the fit.
        begin_s = encoded.start_s[encoded.row < 0]
        self.segments += len(begin_s)
        if len(begin_s):
            rate = np.bincount(begin_s.astype(np.int64))
            self.peak_segments_per_s = max(self.peak_segments_per_s, float(rate.max()))
        self.peak_velocity_mm_s = max(self.peak_velocity_mm_s, made.step_mm / DT_S)
        self.peak_accel_mm_s2 = max(self.peak_accel_mm_s2, made.bend_mm / DT_S**2)
        self.gap_square_mm2 += float(gap_mm @ gap_mm)
        self.gap_samples += len(gap_mm)
        self.gap_max_mm = max(self.gap_max_mm, float(np.max(gap_mm, initial=0.0)))
        missed_mm = abs(float(executed.end_mm[-1, 3] - made.command_mm[3, -1]))
        self.filament_error_mm = max(self.filament_error_mm, missed_mm)

    def add_verbatim(self, verbatim: VerbatimPart, phases: Phases) -> None:
        """Add motion whose lines are not changed."""
        motion_s, feeds = phases.duration_s, phases.prints
        self.original_s += motion_s
        self.time_s += motion_s
        extruding_s = float(np.sum(phases.lasts_s[feeds]))
        self.extruding_s += extruding_s
        if isinstance(verbatim, LeftOut):
            self.left_out_s += motion_s
            self.left_out_extruding_s += extruding_s
            return
        self.verbatim_s += motion_s
        if np.any(feeds):
            self.verbatim_extruding_s += extruding_s
            first = phases.move_index[int(np.argmax(feeds))]
            if not isinstance(verbatim, Piece):  # a piece was reverted for a reason of its own
                self.verbatim_line = self.verbatim_line or int(verbatim.moves.line[first])

    def figures(self, *, compensates: bool) -> dict[str, Any]:
        """Return the fields of `Result` that are sums or follow from sums.

        Parameters
        ----------
        compensates : bool
            Otherwise the file is only measured, and nothing counts as left alone.
        """
        rate = self.segments / self.compensated_s if self.compensated_s else 0.0
        return {
            "original_time_s": self.original_s,
            "time_s": self.time_s,
            "written_bytes": self.written_bytes,
            "segments": self.segments,
            "segments_per_s": rate,
            # The peak is counted over whole seconds, but a piece may be shorter.
            "peak_segments_per_s": max(self.peak_segments_per_s, rate),
            "peak_velocity_mm_s": self.peak_velocity_mm_s,
            "peak_accel_mm_s2": self.peak_accel_mm_s2,
            "emission_rms_um": 1e3 * np.sqrt(self.gap_square_mm2 / max(self.gap_samples, 1)),
            "emission_max_um": 1e3 * self.gap_max_mm,
            "filament_error_mm": self.filament_error_mm,
            "compensated_s": self.compensated_s,
            "extruding_s": self.extruding_s,
            "pieces": self.pieces,
            "put_back": self.put_back,
            "put_back_extruding_share": self.put_back_share,
            "left_out_s": self.left_out_s,
            "left_out_extruding_s": self.left_out_extruding_s,
            "left_alone_s": self.left_alone_s if compensates else 0.0,
            "left_alone_extruding_s": self.left_alone_extruding_s if compensates else 0.0,
        }

    @property
    def put_back_extruding_s(self) -> float:
        """Extruding time of the pieces that stayed as sliced."""
        return sum(piece.extruding_seconds for piece in self.put_back)

    @property
    def put_back_share(self) -> float:
        """The same as a share of all extruding time."""
        return self.put_back_extruding_s / self.extruding_s if self.extruding_s else 0.0

    @property
    def left_alone_s(self) -> float:
        """Time of the motion whose lines were not to be changed."""
        return max(self.verbatim_s - sum(piece.seconds for piece in self.put_back), 0.0)

    @property
    def left_alone_extruding_s(self) -> float:
        """The part of it that extrudes."""
        return max(self.verbatim_extruding_s - self.put_back_extruding_s, 0.0)

    @property
    def compensated_share(self) -> float:
        """Share of the extruding time, of what was to be compensated, that is."""
        chosen_s = self.extruding_s - self.left_out_extruding_s
        left_s = self.put_back_extruding_s + self.left_alone_extruding_s
        return max(1.0 - left_s / chosen_s, 0.0) if chosen_s > 0.0 else 0.0

    def left_out_notes(self, where: str) -> Iterator[str]:
        """Yield a note on what the options of the job left as sliced."""
        if where != "all":
            yield (
                f"where={where}: {self.left_out_s:.0f} s of motion are left as sliced, "
                f"{self.left_out_extruding_s:.0f} s of them extruding. The figures of the whole "
                "print include them"
            )

    def left_alone_warnings(self) -> Iterator[str]:
        """Yield warnings where ripple, or much, was not compensated."""
        if self.rippling_s > 0.0:
            yield (
                f"the ripple of {self.rippling_s:.0f} s of extruding is not compensated: the "
                "commands of these pieces are at the limits of the motors (command) without it. "
                "Slice with lower accelerations, or state what the motors bear"
            )
        alone_s, first_line = self.left_alone_extruding_s, self.verbatim_line
        if self.put_back_share > _WARN_SHARE:
            longest = max(self.put_back, key=lambda piece: piece.extruding_seconds)
            yield (
                f"{self.put_back_share:.0%} of the extruding time stayed as sliced and is not "
                f"compensated, for instance lines {longest.line_first} to {longest.line_last}: "
                f"{longest.reason}"
            )
        elif alone_s > _WARN_SHARE * self.extruding_s:
            yield (
                f"{alone_s / self.extruding_s:.0%} {NOT_COMPENSATED}, from line "
                f"{first_line} on: its moves keep their own lines, because they lie between "
                "STILLPATH_OFF and STILLPATH_ON, come after TUNING_TOWER, belong to a laser or "
                "to a tool whose K is not known (put M900 K behind each T), move other axes too, "
                "climb faster than Z can follow a stream (max_z_accel_mm_s2, max_z_velocity_mm_s), "
                "take long for their length, or start where the position is not known"
            )
