"""What the encoders of all firmwares share: the encoded piece, and how it is put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcode.firmware._encoding_kernels import merge_still, round_ends
from gcode.pieces import Piece
from gcode.segments import Segments
from gcode.timeline import Group, Timeline
from gcode.types import Limits, Moves, Phases

__all__ = [
    "UNITS_PER_MM",
    "Encoded",
    "Interleaved",
    "as_moves",
    "encoded_piece",
    "group_durations",
    "interleave",
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
    limits : Limits
        What our segments run under.
    feedrate_mm_min : ndarray, shape (n,)
    start_s : ndarray, shape (n,)
        When each move begins, counted as on the timeline.
    group_start_s : ndarray, shape (groups,)
        When each group begins; rests move the groups behind them a little.
    row_start_s : ndarray, shape (rows of the piece,)
        When each original move begins on the timeline.
    rest_s : ndarray, shape (groups,)
        How long each rest takes.
    phases : Phases
        The firmware's plan of the moves.
    """

    position: NDArray[np.int64]
    begin: NDArray[np.int64]
    row: NDArray[np.int64]
    limits: Limits
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
        How long a segment lasts.
    group : ndarray of int64, shape (n,)
    """

    row: NDArray[np.int64]
    begin: NDArray[np.int64]
    position: NDArray[np.int64]
    end_s: NDArray[np.float64]
    planned_s: NDArray[np.float64]
    group: NDArray[np.int64]


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
    groups = timeline.groups
    # Where the file wants to be; a firmware that counts steps is there but for a part of a step.
    asked = to_units(np.vstack([piece.moves.start_mm[:1], piece.moves.end_mm]))
    position = np.empty((len(segments), 4), np.int64)
    grids = np.broadcast_to(np.asarray(grid, np.int64), 3)
    round_ends(segments.end_mm, segments.group, grids, UNITS_PER_MM, position)
    final = np.flatnonzero(np.append(segments.group[1:] != segments.group[:-1], True))
    lasts = np.array([group.last for group in groups])
    position[final] = asked[lasts[segments.group[final]]]
    firsts = np.array([group.first for group in groups])
    begins = asked[firsts]
    # Where the file leaves Z alone nobody may name it: it may be off the grid, or not be known.
    level = ~np.logical_or.reduceat(np.diff(asked[:, 2]) != 0, firsts)[segments.group]
    position[level, 2] = begins[segments.group[level], 2]
    end_s, keep = segments.end_s.copy(), np.ones(len(segments), dtype=bool)
    merge_still(position, end_s, segments.group, begins, keep)

    rests = [np.arange(g.first, g.last) for g in groups if g.rest]
    rest_rows = np.concatenate(rests) if rests else np.zeros(0, np.int64)
    rest_group = np.concatenate(
        [np.full(g.last - g.first, i) for i, g in enumerate(groups) if g.rest]
        or [np.zeros(0, np.int64)]
    )
    rows = np.concatenate([np.full(int(keep.sum()), -1), rest_rows])
    group = np.concatenate([segments.group[keep], rest_group])
    order = np.argsort(group, kind="stable")
    group, end_s = group[order], np.concatenate([end_s[keep], np.zeros(len(rest_rows))])[order]
    same = np.append(False, group[1:] == group[:-1])
    return Interleaved(
        row=rows[order],
        begin=asked[0],
        position=np.concatenate([position[keep], asked[rest_rows + 1]])[order],
        end_s=end_s,
        planned_s=end_s - np.where(same, np.append(0.0, end_s[:-1]), timeline.start_s[group]),
        group=group,
    )


def limits_in_force(
    piece: Piece, rows: NDArray[np.int64], stream: Limits
) -> tuple[NDArray[np.int32], list[Limits]]:
    """Return `Moves.limits_id` and its table: the stream's limits, or the file's own in a rest.

    Parameters
    ----------
    rows : ndarray of int64, shape (n,)
        Row of the piece for a rest's own move, -1 for a segment.
    """
    own = rows >= 0
    used, found = np.unique(piece.moves.limits_id[rows[own]], return_inverse=True)
    limits_id = np.zeros(len(rows), np.int32)
    limits_id[own] = 1 + found
    return limits_id, [stream, *(piece.limits[i] for i in used)]


def as_moves(
    start_mm: NDArray[np.float64],
    end_mm: NDArray[np.float64],
    speed_mm_s: NDArray[np.float64],
    limits_id: NDArray[np.int32],
) -> Moves:
    """Return moves for a planner; lines count from 1 and stand for nothing."""
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
    limits: Limits,
    feedrate_mm_min: NDArray[np.float64],
    phases: Phases,
) -> Encoded:
    """Return the encoded piece with the times that the firmware's plan of its moves gives."""
    duration_s = phases.accel_s + phases.cruise_s + phases.decel_s
    start_s = timeline.start_s[0] + phases.t_s
    group_start_s = _group_starts(timeline, moves.group, start_s, duration_s)
    own = moves.row >= 0
    rest_s = np.zeros(len(timeline.groups))
    np.add.at(rest_s, moves.group[own], duration_s[own])
    return Encoded(
        position=moves.position,
        begin=moves.begin,
        row=moves.row,
        limits=limits,
        feedrate_mm_min=feedrate_mm_min,
        start_s=start_s,
        group_start_s=group_start_s,
        row_start_s=_moved_rows(timeline, group_start_s),
        rest_s=rest_s,
        phases=phases,
    )


def group_durations(phases: Phases, groups: Sequence[Group]) -> NDArray[np.float64]:
    """Return how long each group takes; `phases` has a row for every row of the piece."""
    duration = phases.accel_s + phases.cruise_s + phases.decel_s
    return np.array([duration[g.first : g.last].sum() for g in groups])


def to_units(position_mm: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return positions in 1e-6 mm."""
    return np.round(position_mm * UNITS_PER_MM).astype(np.int64)


def _group_starts(
    timeline: Timeline,
    group: NDArray[np.int64],
    start_s: NDArray[np.float64],
    duration_s: NDArray[np.float64],
) -> NDArray[np.float64]:
    """When each group begins; one without moves begins where the one before ends."""
    starts = np.full(len(timeline.groups), np.nan)
    first = np.append(True, group[1:] != group[:-1])
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
