"""The encoded piece, and functions shared by all encoders to assemble it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.firmware._encoding_kernels import lay_out
from stillpath.gcode.pieces import Piece
from stillpath.gcode.segments import Segments
from stillpath.gcode.timeline import Group, Timeline
from stillpath.gcode.types import Limits, Moves, Phases

__all__ = [
    "UNITS_PER_MM",
    "Encoded",
    "Interleaved",
    "as_moves",
    "encoded_piece",
    "group_durations",
    "interleave",
    "lateness_s",
    "limits_in_force",
    "to_units",
]

UNITS_PER_MM = 1e6
"""Positions are integers of 1e-6 mm, the last digit that is written."""


@dataclass(frozen=True, slots=True)
class Encoded:
    """A piece as it will be written.

    Attributes
    ----------
    position : ndarray of int64, shape (n, 4)
        End of every move in 1e-6 mm: our segments and the rests' own moves, in order.
    begin : ndarray of int64, shape (4,)
    row : ndarray of int64, shape (n,)
        Row of the piece for a rest's own move, -1 for a segment of ours.
    limits : sequence of Limits
        Limits of our segments.
    level : ndarray of int64, shape (n,)
        Index into `limits` for every segment of ours.
    feedrate_mm_min : ndarray, shape (n,)
    start_s : ndarray, shape (n,)
        When each move begins, counted as on the timeline.
    group_start_s : ndarray, shape (groups,)
        Start of each group; rests shift the groups after them slightly.
    row_start_s : ndarray, shape (rows of the piece,)
        When each original move begins on the timeline.
    rest_s : ndarray, shape (groups,)
        Duration of each rest.
    phases : Phases
        The firmware's plan of the moves.
    """

    position: NDArray[np.int64]
    begin: NDArray[np.int64]
    row: NDArray[np.int64]
    limits: Sequence[Limits]
    level: NDArray[np.int64]
    feedrate_mm_min: NDArray[np.float64]
    start_s: NDArray[np.float64]
    group_start_s: NDArray[np.float64]
    row_start_s: NDArray[np.float64]
    rest_s: NDArray[np.float64]
    phases: Phases


@dataclass(frozen=True, slots=True)
class Interleaved:
    """Segments of a piece with the rests' own moves between them, in order.

    Attributes
    ----------
    row : ndarray of int64, shape (n,)
        Row of the piece for a rest's own move, -1 for a segment.
    begin : ndarray of int64, shape (4,)
    position : ndarray of int64, shape (n, 4)
        Ends in 1e-6 mm.
    end_s : ndarray, shape (n,)
        When a segment ends on the timeline; 0 for a rest's move.
    planned_s : ndarray, shape (n,)
        How long a segment lasts; 0 for a rest's move.
    group : ndarray of int64, shape (n,)
    """

    row: NDArray[np.int64]
    begin: NDArray[np.int64]
    position: NDArray[np.int64]
    end_s: NDArray[np.float64]
    planned_s: NDArray[np.float64]
    group: NDArray[np.int64]

    def places_mm(self) -> NDArray[np.float64]:
        """Return where the moves begin and end, shape (n + 1, 4): move i goes from i to i + 1."""
        return np.concatenate([self.begin[None], self.position]) / UNITS_PER_MM


def interleave(
    piece: Piece, timeline: Timeline, segments: Segments, grid: int | NDArray[np.int64]
) -> Interleaved:
    """Round the segments and put the rests' own moves between them.

    Parameters
    ----------
    grid : int, or ndarray of int64, shape (3,)
        Grid of X, Y and Z in 1e-6 mm; the last point of every stretch keeps all digits, and a
        stretch that does not climb the height that it has. Segments that round to no motion give
        their time and filament to a neighbour.
    """
    # Positions in the file; a firmware that counts steps is off by a fraction of a step.
    asked = to_units(np.vstack([piece.moves.start_mm[:1], piece.moves.end_mm]))
    room = len(segments) + len(piece.moves)
    row, group = np.empty((2, room), np.int64)
    position = np.empty((room, 4), np.int64)
    end_s, planned_s = np.empty((2, room))
    n = lay_out(
        segments.end_mm,
        segments.end_s,
        segments.group,
        np.array([(g.first, g.last, g.rest) for g in timeline.groups], np.int64),
        timeline.start_s,
        asked,
        np.broadcast_to(np.asarray(grid, np.int64), 3),
        UNITS_PER_MM,
        row,
        position,
        end_s,
        planned_s,
        group,
    )
    return Interleaved(row[:n], asked[0], position[:n], end_s[:n], planned_s[:n], group[:n])


def limits_in_force(
    piece: Piece,
    rows: NDArray[np.int64],
    stream: Sequence[Limits],
    level: NDArray[np.int64],
) -> tuple[NDArray[np.int32], list[Limits]]:
    """Return `Moves.limits_id` and its table: the stream's limits, or the file's own in a rest.

    Parameters
    ----------
    rows : ndarray of int64, shape (n,)
        Row of the piece for a rest's own move, -1 for a segment.
    level : ndarray of int64, shape (n,)
        Index into `stream` for each segment.
    """
    own = rows >= 0
    used, found = np.unique(piece.moves.limits_id[rows[own]], return_inverse=True)
    limits_id = level.astype(np.int32)
    limits_id[own] = len(stream) + found
    return limits_id, [*stream, *(piece.limits[i] for i in used)]


def as_moves(
    start_mm: NDArray[np.float64],
    end_mm: NDArray[np.float64],
    speed_mm_s: NDArray[np.float64],
    limits_id: NDArray[np.int32],
) -> Moves:
    """Return moves for a planner from places (n, 4), speeds (n,) and rows of a table (n,).

    Their line numbers count from 1 and have no meaning.
    """
    n = len(speed_mm_s)
    zeros, none = np.zeros(n, np.int32), np.full(n, -1, np.int32)
    count = np.arange(n, dtype=np.int64)
    return Moves(
        start_mm=start_mm,
        end_mm=end_mm,
        speed_mm_s=speed_mm_s,
        limits_id=limits_id,
        modal_id=zeros,
        known=np.full(n, 7, np.uint8),
        line=count + 1,
        byte_start=count,
        byte_end=count + 1,
        layer=none,
        feature=none,
        object_id=none,
        tool=zeros,
    )


def encoded_piece(
    timeline: Timeline,
    moves: Interleaved,
    limits: Limits | tuple[Sequence[Limits], NDArray[np.int64]],
    feedrate_mm_min: NDArray[np.float64],
    phases: Phases,
) -> Encoded:
    """Return the encoded piece with the times that the firmware's plan of its moves gives.

    Parameters
    ----------
    limits : Limits, or sequence of Limits and ndarray of int64, shape (n,)
        The stream's, or several and which of them each segment runs under.
    """
    table, level = limits if isinstance(limits, tuple) else ([limits], np.zeros_like(moves.row))
    duration_s = phases.lasts_s
    start_s = timeline.start_s[0] + phases.t_s
    group_start_s = _group_starts(timeline, moves.group, start_s, duration_s)
    own = moves.row >= 0
    rest_s = np.zeros(len(timeline.groups))
    np.add.at(rest_s, moves.group[own], duration_s[own])
    return Encoded(
        position=moves.position,
        begin=moves.begin,
        row=moves.row,
        limits=table,
        level=level,
        feedrate_mm_min=feedrate_mm_min,
        start_s=start_s,
        group_start_s=group_start_s,
        row_start_s=_moved_rows(timeline, group_start_s),
        rest_s=rest_s,
        phases=phases,
    )


def lateness_s(
    moves: Interleaved, phases: Phases, *, after_first: bool = False
) -> NDArray[np.float64]:
    """Return how late each segment ends, shape (n,), counted from where its stretch begins.

    Parameters
    ----------
    after_first : bool
        Count from the end of the stretch's first segment instead.
    """
    ours = moves.row < 0
    first = ours & np.append(True, ~ours)[:-1]
    begin = np.maximum.accumulate(np.where(first, np.arange(len(first)), 0))
    lost_s = np.where(ours, phases.lasts_s - moves.planned_s, 0.0)
    passed_s = np.cumsum(np.where(first, 0.0, lost_s))
    late_s = passed_s - passed_s[begin]
    return np.where(ours, late_s if after_first else late_s + lost_s[begin], 0.0)


def group_durations(phases: Phases, groups: Sequence[Group]) -> NDArray[np.float64]:
    """Return how long each group takes [s]; `phases` has a row for every row of the piece."""
    lasts_s = phases.lasts_s
    return np.array([lasts_s[g.first : g.last].sum() for g in groups])


def to_units(position_mm: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return positions of any shape in 1e-6 mm."""
    return np.round(position_mm * UNITS_PER_MM).astype(np.int64)


def _group_starts(
    timeline: Timeline,
    group: NDArray[np.int64],
    start_s: NDArray[np.float64],
    duration_s: NDArray[np.float64],
) -> NDArray[np.float64]:
    """When each group begins; one without moves begins where the one before ends."""
    starts = np.full(len(timeline.groups), np.nan)
    first = np.diff(group, prepend=-1) != 0  # of no moves, where all round to nothing, none
    starts[group[first]] = start_s[first]
    for i in np.flatnonzero(np.isnan(starts)):
        earlier = np.flatnonzero(group < i)
        starts[i] = timeline.start_s[0]
        if len(earlier):
            starts[i] = start_s[earlier[-1]] + duration_s[earlier[-1]]
    return starts


def _moved_rows(timeline: Timeline, group_start_s: NDArray[np.float64]) -> NDArray[np.float64]:
    shift = group_start_s - timeline.start_s
    lengths = [group.last - group.first for group in timeline.groups]
    return timeline.row_start_s + np.repeat(shift, lengths)
