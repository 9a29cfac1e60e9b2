"""Divide a piece, where it stands still or nearly so, into compensated and other sections."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.pieces import LeftOut, Piece, VerbatimPart
from stillpath.gcode.plan import plan_moves
from stillpath.gcode.types import Limits, ModalState, Phases, rows_of
from stillpath.models.machine import Machine
from stillpath.models.runs import runs

__all__ = ["divided", "sections"]

_SLOW_MM_S = 15.0
"""From this speed, stopping and restarting takes only a few milliseconds."""


def sections(piece: Piece) -> list[tuple[int, int]]:
    """Return runs of moves of X or Y between which a piece may be cut, in order.

    They are separated by a rest, or by a place where printing begins or ends slowly: the machine
    can stop there without a significant loss of time. No cut lies within a line.

    Returns
    -------
    list of (int, int)
        First row and one past the last.
    """
    phases = piece.phases
    # By line of the file: an arc is many moves, some of which feed less than a step.
    starts = np.flatnonzero(np.diff(piece.moves.byte_start, prepend=-1))
    moves_xy = np.logical_or.reduceat(phases.moves_xy, starts)
    feeds = np.logical_or.reduceat(phases.direction[:, 3] > 0.0, starts)
    slow = (feeds[1:] != feeds[:-1]) & (phases.end_mm_s[starts[1:] - 1] <= _SLOW_MM_S)
    edges = np.flatnonzero((moves_xy[1:] != moves_xy[:-1]) | slow) + 1
    rows = [*starts.tolist(), len(phases)]
    runs = pairwise([0, *edges.tolist(), len(starts)])
    return [(rows[first], rows[last]) for first, last in runs if moves_xy[first]]


def divided(piece: Piece, wanted: NDArray[np.bool_], machine: Machine) -> Iterator[Piece | LeftOut]:
    """Cut a piece so that only the wanted sections remain pieces.

    Parameters
    ----------
    wanted : ndarray of bool, shape (len(sections(piece)),)
        Neighbours that are wanted stay one piece, with the rests between them.

    Yields
    ------
    Piece or LeftOut
        In order; their texts add up to the piece's. A part is planned again, from rest to rest, if
        the firmware would otherwise pass the cut without stopping.
    """
    if np.all(wanted):
        yield piece
        return
    rows = sections(piece)
    moves = piece.moves
    done = 0
    for first, stop in runs(wanted):
        start, end = rows[first][0], rows[stop - 1][1]
        if start > done:
            yield _left_out(piece, done, start)
        yield Piece.planned(_part(piece, start, end), _plan(piece, start, end, machine))
        done = end
    if done < len(moves):
        yield _left_out(piece, done, len(moves))


def _plan(piece: Piece, start: int, end: int, machine: Machine) -> Phases:
    """Return the plan of some moves of a piece, which begin and end at rest."""
    phases = piece.phases
    bounds = [row for row in (start - 1, end) if 0 <= row < len(phases)]
    apart = adapter(machine).extruder_alone_stops and not np.any(phases.direction[bounds, :3])
    if apart:
        return rows_of(phases, slice(start, end))
    rows = rows_of(piece.moves, slice(start, end))
    return plan_moves(rows, piece.limits, machine, rests_apart=True)


def _part(piece: Piece, start: int, end: int) -> VerbatimPart:
    """Return the lines of moves start..end - 1 of a part that is compensated, no others."""
    begin = int(piece.moves.byte_start[start]) if start else piece.text_offset
    return _lines(piece, start, end, begin, int(piece.moves.byte_end[end - 1]))


def _left_out(piece: Piece, start: int, end: int) -> LeftOut:
    """Return moves start..end - 1 with all that stands between the parts around them."""
    begin, until = piece.text_offset, piece.text_offset + len(piece.text)
    if start:
        begin = int(piece.moves.byte_end[start - 1])
    if end < len(piece.moves):
        until = int(piece.moves.byte_start[end])
    lines = _lines(piece, start, end, begin, until)
    return LeftOut(**{f.name: getattr(lines, f.name) for f in fields(VerbatimPart)})


def _lines(piece: Piece, start: int, end: int, begin: int, until: int) -> VerbatimPart:
    """Return moves start..end - 1 and the bytes begin..until - 1, both of a piece."""
    moves, events = piece.moves, piece.events
    rows = slice(*np.searchsorted(events.byte_start, [begin, until]).tolist())
    ours = rows_of(events, rows)
    limits_before, modal_before = _state(piece, begin)
    limits_after, modal_after = _state(piece, until)
    return VerbatimPart(
        moves=rows_of(moves, slice(start, end)),
        events=replace(ours, move_index=ours.move_index - start),
        text=piece.text[begin - piece.text_offset : until - piece.text_offset],
        text_offset=begin,
        limits=piece.limits,
        modal=piece.modal,
        limits_before=limits_before,
        limits_after=limits_after,
        modal_before=modal_before,
        modal_after=modal_after,
    )


def _state(piece: Piece, at_byte: int) -> tuple[Limits, ModalState]:
    """Return limits and modes after the last line that starts before a byte of the file."""
    found = piece.limits_before, piece.modal_before
    latest = -1
    for table in (piece.moves, piece.events):
        row = int(np.searchsorted(table.byte_start, at_byte)) - 1
        if row >= 0 and int(table.byte_start[row]) > latest:
            latest = int(table.byte_start[row])
            found = piece.limits[table.limits_id[row]], piece.modal[table.modal_id[row]]
    return found
