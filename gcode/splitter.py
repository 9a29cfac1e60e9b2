"""Cut an interpreted file into pieces to compensate and verbatim parts that are not changed."""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Iterator
from dataclasses import fields, replace
from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.firmware.line_reader import EXTRUSION
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.pieces import Piece, VerbatimPart
from stillpath.gcode.plan import plan_moves
from stillpath.gcode.types import (
    AFTER_MARK,
    KEPT,
    OF_STATE,
    EventKind,
    Events,
    Limits,
    ModalState,
    Moves,
    Phases,
    ProgramBlock,
    joined,
    rows_of,
)
from stillpath.models.machine import Machine

__all__ = ["Splitter", "excerpt"]

S = TypeVar("S", Moves, Events)
R = TypeVar("R")

PURGE_FEED_MM, PURGE_RATIO = 10.0, 5.0
"""A move that feeds more filament than the first, and per mm of path more than the second, counts
as an extruder move: X and Y hardly move, and would be cut into thousands of segments."""

_SHORTEST_JUMP_MM = 0.1
"""A shorter first move after an object's mark stays as sliced."""
_AHEAD = 1.25
"""Time planned before a piece is cut, relative to its longest duration."""
_MOST_MOVES, _MOST_EVENTS, _MOST_BYTES = 1 << 15, 1 << 16, 1 << 23
"""Largest contents of a piece. A minute of an ordinary print has at most 15 thousand moves; with
moves of a micrometre it would have millions."""

_SET_POSITION = re.compile(rb"G\s*0*92(?!\d)")
_SET_EXTRUDER = re.compile(rb"\s*(?:N\d+\s*)?G92\s*E\s*[-+]?(?:\d+\.?\d*|\.\d+)\s*(?:\*\d+\s*)?")
"""A spelling that all firmwares read alike; others end a piece."""


class Splitter:
    """Cut a stream of program blocks.

    Parameters
    ----------
    longest_s : float
        No piece lasts longer.
    compensate : bool
        False makes everything one verbatim part after another (method none).
    """

    def __init__(
        self, machine: Machine, *, longest_s: float = 60.0, compensate: bool = True
    ) -> None:
        self._machine = machine
        self._adapter = adapter(machine)
        self._replays = self._adapter.stream_commands().replays
        self._longest_s = longest_s
        self._compensate = compensate
        self._moves: Moves | None = None
        self._events: Events | None = None
        self._stays = np.zeros(0, dtype=bool)
        self._text = b""
        self._text_offset = 0
        self._after_mark = False
        self._tables: tuple[list[Limits], list[ModalState]] = ([], [])
        self._interpreter_limits: list[Limits] | None = None
        self._held_tables: tuple[list[Limits], list[ModalState]] = ([], [])
        self._limits_id = 0
        self._modal_id = 0

    def push(self, block: ProgramBlock) -> Iterator[Piece | VerbatimPart]:
        """Take a block; yield complete parts."""
        self._append(block)
        yield from self._cut(final=False)

    def flush(self) -> Iterator[Piece | VerbatimPart]:
        """Yield the rest at the end of the file."""
        if self._moves is not None:
            yield from self._cut(final=True)

    def _append(self, block: ProgramBlock) -> None:
        if block.limits is not self._interpreter_limits:
            self._held_tables = self._rows_in_use()
            self._interpreter_limits = block.limits
        moves, events = block.moves, block.events
        self._tables = block.limits, block.modal
        limits, modal = self._held_tables
        if limits:
            # What is held keeps its rows, and those of the interpreter's new tables follow.
            self._tables = limits + block.limits, modal + block.modal
            moves = _renumbered(moves, len(limits), len(modal))
            events = _renumbered(events, len(limits), len(modal))
        local = _shifted(events, -block.first_move)
        raw = self._raw_moves(block)
        moves = self._marked(moves, local, raw)
        if self._moves is None or self._events is None:
            self._moves, self._events, self._stays = moves, local, raw
            self._text, self._text_offset = block.text, block.text_offset
            return
        local = _shifted(local, len(self._moves))
        self._moves = joined([self._moves, moves])
        self._events = joined([self._events, local])
        self._stays = np.concatenate([self._stays, raw])
        # A block's text covers its lines and may begin before the end of what we hold.
        held = self._text_offset + len(self._text)
        self._text += block.text[held - block.text_offset :]

    def _rows_in_use(self) -> tuple[list[Limits], list[ModalState]]:
        """Return the rows of the tables that what is held needs, and number it by them."""
        moves, events = self._moves, self._events
        if self._interpreter_limits is None:
            return [], []
        limits_ids, modal_ids = (
            [np.array([self._limits_id], np.int32)],
            [np.array([self._modal_id], np.int32)],
        )
        if moves is not None and events is not None:
            limits_ids += [moves.limits_id, events.limits_id]
            modal_ids += [moves.modal_id, events.modal_id]
        limits, limits_id = _numbered(np.concatenate(limits_ids))
        modal, modal_id = _numbered(np.concatenate(modal_ids))
        self._limits_id, self._modal_id = int(limits_id[0]), int(modal_id[0])
        if moves is not None and events is not None:
            n = 1 + len(moves)
            self._moves = replace(moves, limits_id=limits_id[1:n], modal_id=modal_id[1:n])
            self._events = replace(events, limits_id=limits_id[n:], modal_id=modal_id[n:])
        return [self._tables[0][k] for k in limits], [self._tables[1][k] for k in modal]

    def _first_barrier(self, events: Events, most: int) -> int | None:
        """Return the first of `most` moves after which a piece must end; None: there is none.

        A piece ends at a stop, a G92 other than one plain E, M221, a change of the stream's limits,
        and at M82 if the firmware replays moves, but not at those before its first move.
        """
        limits, modal = self._tables
        count = int(np.searchsorted(events.move_index, most, "right"))
        behind_move = events.move_index[:count] > 0
        found = np.flatnonzero((events.kind[:count] >= EventKind.STOP) & behind_move)
        end = int(found[0]) if len(found) else count
        kind = events.kind[:end]
        of_limits, of_mode = (
            np.flatnonzero(kind == what) for what in (EventKind.LIMITS, EventKind.MODE)
        )
        others = _changes(
            self._limits_id, events.limits_id[of_limits], limits, self._adapter.stream_limits
        )
        # Where the scale of E changes, the extruder must be at the file's position.
        factors = _changes(
            self._modal_id, events.modal_id[of_mode], modal, lambda state: state.extrude_factor
        )
        for rows in (of_limits[others], of_mode[factors]):
            end = min([end, *rows[behind_move[rows]][:1].tolist()])
        for row in of_mode[behind_move[of_mode] & (of_mode < end)].tolist():
            start, stop = events.byte_start[row], events.byte_end[row]
            line = self._text[start - self._text_offset : stop - self._text_offset]
            counts = self._replays and modal[int(events.modal_id[row])].absolute_e
            if _shifts_origin(line) or (counts and EXTRUSION.match(line)):
                end = row
                break
        return int(events.move_index[end]) if end < count else None

    def _raw_moves(self, block: ProgramBlock) -> NDArray[np.bool_]:
        """Mark moves of X or Y that must keep their lines, and others that must end a piece."""
        moves = block.moves
        travel, xy = moves.end_mm - moves.start_mm, moves.moves_xy
        # Our lines state positions, so a move of Z cannot be replaced where Z is unknown.
        needed = np.where(travel[:, 2] != 0.0, 7, 3)
        raw = xy & (((moves.known & needed) != needed) | ((moves.known & KEPT) != 0))
        raw |= xy & _finds_height(block)
        raw |= xy & self._adapter.too_steep(travel)
        length = np.sqrt(np.sum(travel[:, :3] ** 2, axis=1))
        raw |= xy & (length > self._longest_s * moves.speed_mm_s)
        feed = np.abs(travel[:, 3])
        raw |= xy & (feed > PURGE_FEED_MM) & (feed > PURGE_RATIO * length)
        if len(moves):
            # All segments of an arc share one line and are treated alike.
            starts = np.flatnonzero(np.append(True, np.diff(moves.line) != 0))
            ends = np.append(starts[1:], len(raw))
            # A piece cannot begin or end within a line, nor where X and Y rest.
            spread = np.maximum.reduceat(raw, starts) | ~xy[starts] | ~xy[ends - 1]
            raw = np.repeat(spread, ends - starts) & xy
        if self._replays:
            # Lines that find E absolute must not stand among those of a stream.
            absolute = np.array([state.absolute_e for state in block.modal], bool)
            raw |= ~xy & absolute[moves.modal_id]
        return np.asarray(raw | ((moves.known & OF_STATE) != 0))

    def _marked(self, moves: Moves, events: Events, raw: NDArray[np.bool_]) -> Moves:
        """Mark the first moves of X or Y after objects' marks: the firmware may jump there.

        `raw` receives those that cannot be told apart from the jump.
        """
        marks = events.move_index[events.kind == EventKind.OBJECT]
        if self._after_mark:
            marks = np.concatenate([[0], marks])
        xy_rows = np.flatnonzero(moves.moves_xy)
        following = np.searchsorted(xy_rows, marks)
        self._after_mark = bool(np.any(following == len(xy_rows)))
        jumps = xy_rows[following[following < len(xy_rows)]]
        way = np.abs(moves.end_mm[jumps, :2] - moves.start_mm[jumps, :2]).max(axis=1, initial=0.0)
        same_line = np.append(np.diff(moves.line) == 0, False)
        unfit = jumps[(way < _SHORTEST_JUMP_MM) | same_line[jumps]]
        raw[np.isin(moves.line, moves.line[unfit]) & moves.moves_xy] = True
        known = moves.known.copy()
        known[jumps] |= AFTER_MARK
        return replace(moves, known=known)

    def _cut(self, *, final: bool) -> Iterator[Piece | VerbatimPart]:
        while self._moves is not None and self._events is not None:
            moves, events = self._moves, self._events
            count = len(moves)
            travel, xy = moves.end_mm - moves.start_mm, moves.moves_xy
            ours = np.flatnonzero(xy & ~self._stays) if self._compensate else np.zeros(0, np.int64)
            if len(ours) == 0:
                yield self._take(None)
                return
            head = int(ours[0])
            if head > 0 or (len(events) and events.byte_start[0] < moves.byte_start[0]):
                yield self._take(int(moves.byte_start[head]))
                continue
            kept = np.flatnonzero(self._stays)
            lasting_s = np.cumsum(_shortest_s(moves))
            most = min(self._most_moves(moves, events), self._enough(moves, lasting_s))
            barrier = self._first_barrier(events, most)
            full = len(events) > _MOST_EVENTS or len(self._text) > _MOST_BYTES
            closed = final or barrier is not None or len(kept) > 0 or most < count or full
            end = min(count if barrier is None else barrier, most, *kept[:1].tolist())
            if not closed and lasting_s[-1] < self._longest_s:
                return
            last = int(np.flatnonzero(xy[:end])[-1]) + 1
            phases = self._plan(rows_of(moves, slice(0, last)))
            if len(phases) != last or not np.all(np.any(travel[:last] != 0.0, axis=1)):
                # A move of zero length has no plan; leave its neighbourhood unchanged.
                self._stays[:last] |= xy[:last]
                continue
            slow = phases.lasts_s > self._longest_s
            if np.any(slow & xy[:last]):
                # Slower under the limits in force than their F says.
                lines = moves.line[:last]
                self._stays[:last] |= xy[:last] & np.isin(lines, lines[slow])
                continue
            if phases.end_s[-1] <= self._longest_s:
                if not closed:
                    return
                yield self._piece(last, phases)
                continue
            last, natural = _place_to_cut(moves, phases, self._longest_s)
            if natural and self._adapter.extruder_alone_stops:
                phases = rows_of(phases, slice(0, last))
            else:
                phases = self._plan(rows_of(moves, slice(0, last)))
            yield self._piece(last, phases)

    def _plan(self, moves: Moves) -> Phases:
        return plan_moves(moves, self._tables[0], self._machine, rests_apart=True)

    def _enough(self, moves: Moves, lasting_s: NDArray[np.float64]) -> int:
        """Return how many moves to plan, so that they last longer than a piece may.

        This includes whole arcs and some more moves, as the end of a plan slows those before it.
        """
        rows = int(np.searchsorted(lasting_s, _AHEAD * self._longest_s)) + 1
        if rows >= len(moves):
            return len(moves)
        return int(np.searchsorted(moves.line, moves.line[rows - 1], "right"))

    def _most_moves(self, moves: Moves, events: Events) -> int:
        """Return how many of the moves a piece may have: all, or less where too much is held."""
        count, until = len(moves), self._text_offset + _MOST_BYTES
        if len(events) > _MOST_EVENTS:
            until = min(until, int(events.byte_start[_MOST_EVENTS]))
        if count > _MOST_MOVES:
            until = min(until, int(moves.byte_end[_MOST_MOVES - 1]))
        return int(np.searchsorted(moves.byte_start, until))

    def _piece(self, last: int, phases: Phases) -> Piece:
        assert self._moves is not None
        return Piece.planned(self._take(int(self._moves.byte_end[last - 1])), phases)

    def _take(self, until: int | None) -> VerbatimPart:
        """Remove the lines before byte `until` (None: all) from what is held."""
        assert self._moves is not None
        assert self._events is not None
        moves, events = self._moves, self._events
        if until is None:
            until = self._text_offset + len(self._text)
        m = int(np.searchsorted(moves.byte_start, until))
        e = int(np.searchsorted(events.byte_start, until))
        limits, modal = self._tables
        limits_before, modal_before = limits[self._limits_id], modal[self._modal_id]
        last_move = int(moves.byte_start[m - 1]) if m else -1
        last_event = int(events.byte_start[e - 1]) if e else -1
        if max(last_move, last_event) >= 0:
            state: Moves | Events = moves if last_move > last_event else events
            row = (m if last_move > last_event else e) - 1
            self._limits_id, self._modal_id = int(state.limits_id[row]), int(state.modal_id[row])
        text = self._text[: until - self._text_offset]
        taken = VerbatimPart(
            moves=rows_of(moves, slice(0, m)),
            events=rows_of(events, slice(0, e)),
            text=text,
            text_offset=self._text_offset,
            limits=limits,
            modal=modal,
            limits_before=limits_before,
            modal_before=modal_before,
            limits_after=limits[self._limits_id],
            modal_after=modal[self._modal_id],
        )
        self._text = self._text[len(text) :]
        self._text_offset = until
        self._stays = self._stays[m:]
        if m == len(moves) and e == len(events):
            self._moves = self._events = None
        else:
            self._moves = rows_of(moves, slice(m, None))
            self._events = _shifted(rows_of(events, slice(e, None)), -m)
        return taken


def excerpt(piece: Piece, first: int, last: int, machine: Machine) -> Piece:
    """Return moves first..last - 1 of a piece as one of its own, from rest to rest.

    It has no text and holds no memory of the piece. Its first and last move must be of X or Y.
    """
    moves = replace(
        piece.moves,
        **{f.name: getattr(piece.moves, f.name)[first:last].copy() for f in fields(piece.moves)},
    )
    return replace(
        piece,
        moves=moves,
        events=rows_of(piece.events, slice(0, 0)),
        text=b"",
        phases=plan_moves(moves, piece.limits, machine, rests_apart=True),
    )


def _changes(
    before: int,
    after: NDArray[np.int32],
    table: list[R],
    seen: Callable[[R], Hashable],
) -> NDArray[np.bool_]:
    """Mark events after which `seen` of their table row differs from that before."""
    used, place = np.unique(np.append(before, after), return_inverse=True)
    numbers: dict[Hashable, int] = {}
    number = [numbers.setdefault(seen(table[row]), len(numbers)) for row in used.tolist()]
    return np.asarray(np.diff(np.array(number)[place]) != 0)


@lru_cache(maxsize=64)
def _shifts_origin(line: bytes) -> bool:
    """Return whether a line is a G92 other than a plain E; cached, as files repeat such lines."""
    code = line.split(b";", 1)[0].upper()
    return bool(_SET_POSITION.search(code)) and not _SET_EXTRUDER.fullmatch(code)


def _finds_height(block: ProgramBlock) -> NDArray[np.bool_]:
    """Mark moves whose lines name Z while it is only guessed: they may climb."""
    moves = block.moves
    found = (moves.known & 7) == 3
    for row in np.flatnonzero(found).tolist():
        found[row] = b"Z" in block.line(moves, row).split(b";", 1)[0].upper()
    return np.asarray(found)


def _place_to_cut(moves: Moves, phases: Phases, longest_s: float) -> tuple[int, bool]:
    """Return the row after which to end a piece, and whether the plan stops there anyway.

    The best place is a rest before filament is fed again (nothing oozes there), then any
    extruder-only move, then a Z move, then the slowest corner of the last ten seconds.
    """
    direction, xy, end_s = phases.direction, phases.moves_xy, phases.end_s
    only_e = ~xy & (direction[:, 2] == 0.0)
    inside = end_s <= longest_s
    follows = np.zeros(len(xy), dtype=bool)
    follows[:-1] = xy[:-1] & ~xy[1:]
    after_e = np.append(only_e[1:], False)
    feeds = np.append(direction[1:, 3] > 0.0, False)
    late = inside & follows & (end_s > 0.5 * longest_s)
    for wanted in (late & after_e & feeds, late & after_e, inside & follows & after_e):
        rows = np.flatnonzero(wanted)
        if len(rows):
            return int(rows[-1]) + 1, True
    rows = np.flatnonzero(late)
    if len(rows):
        return int(rows[-1]) + 1, False
    line = moves.line[: len(phases)]
    boundary = np.append(line[1:] != line[:-1], False)
    rows = np.flatnonzero(boundary & xy & inside & (end_s > longest_s - 10.0))
    if len(rows) == 0:
        rows = np.flatnonzero(boundary & xy & inside)
    if len(rows) == 0:
        rows = np.flatnonzero(boundary & xy)[:1]
    if len(rows) == 0:
        return len(phases), False
    return int(rows[np.argmin(phases.end_mm_s[rows])]) + 1, False


def _shortest_s(moves: Moves) -> NDArray[np.float64]:
    """Lower bound of the time that each of the moves takes."""
    travel = moves.end_mm - moves.start_mm
    length = np.sqrt(np.sum(travel[:, :3] ** 2, axis=1))
    length = np.where(length > 0.0, length, np.abs(travel[:, 3]))
    return np.asarray(length / moves.speed_mm_s)


def _numbered(ids: NDArray[np.int32]) -> tuple[list[int], NDArray[np.int32]]:
    """Return the different ids, and for each of `ids` its place among them."""
    different, place = np.unique(ids, return_inverse=True)
    return different.tolist(), place.astype(np.int32)


def _renumbered(table: S, limits: int, modal: int) -> S:
    return replace(table, limits_id=table.limits_id + limits, modal_id=table.modal_id + modal)


def _shifted(events: Events, by: int) -> Events:
    columns = {f.name: getattr(events, f.name) for f in fields(events)}
    columns["move_index"] = columns["move_index"] + by
    return Events(**columns)
