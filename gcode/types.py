"""The interpreter's output: moves, events and the modal state between them.

All columns of one dataclass have the same length and are plain numpy arrays; a block holds some
thousand rows. Byte offsets count from the start of the file, line numbers from 1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Self, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "AFTER_MARK",
    "KEPT",
    "OF_STATE",
    "EventKind",
    "Events",
    "Limits",
    "ModalState",
    "Moves",
    "Phases",
    "ProgramBlock",
    "TextLines",
    "joined",
    "rows_of",
]

KEPT = 8
"""Bit of `Moves.known`: the file asks that the move stays as it is."""
OF_STATE = 16
"""Bit of `Moves.known`: the move's line depends on what the printer keeps (`EventKind.STATE`)."""
AFTER_MARK = 32
"""Bit of `Moves.known`: the first move of X or Y after an object's mark. If the firmware skipped
the object before, it jumps from there to the end of this line."""


class EventKind(IntEnum):
    """The effect on the motion of a line that is not a move."""

    HARMLESS = 0
    """Does not stop the motion and changes nothing that we track: comments, fan, M73, ..."""
    MODE = 1
    """Changes how later lines are read, without a stop: G90 G91 M82 M83 G92 M220 M221, a bare F."""
    LIMITS = 2
    """Changes the planner's limits without a stop: M204, SET_VELOCITY_LIMIT."""
    STOP = 3
    """Stops the motion; the position stays known: G4, M400, waits."""
    UNKNOWN = 4
    """Leaves position or state unknown, or changes the place without motion (RepRapFirmware's G92):
    homing, probing, macros, tool change, pause."""
    OBJECT = 5
    """Object-exclusion mark, or a comment by which hosts exclude: what follows may be skipped."""
    SHAPER = 6
    """Sets the firmware's own input shaper (stops the motion)."""
    STAMP = 7
    """Our own header or footer line."""
    STATE = 8
    """Keeps or brings back modes, F and place (SAVE_GCODE_STATE, G60, M120), or changes the units
    (G20, M200): the motion goes on, but what the printer keeps must be the file's, not a stream's,
    and a stream is in millimetres."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Planner limits that G-code can change, in force for a move.

    Every firmware has its own in `gcode/firmware/*/limits.py`: a frozen dataclass of floats. The
    interpreter keeps them as rows of a table; a row and the limits are the same numbers in order.
    """

    def as_row(self) -> tuple[float, ...]:
        """Return the fields in order."""
        return tuple(getattr(self, name) for name in type(self).__dataclass_fields__)

    @classmethod
    def from_row(cls, row: Iterable[float]) -> Self:
        """Return the limits whose fields are these numbers."""
        return cast(Callable[..., Self], cls)(*row)


@dataclass(frozen=True, slots=True)
class ModalState:
    """How the firmware reads the next line."""

    absolute_xyz: bool
    absolute_e: bool
    speed_factor: float
    """1.0 = 100 % (M220)."""
    extrude_factor: float
    """1.0 = 100 % (M221)."""
    origin_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Machine position of the G-code's X0 Y0 Z0 (G92, SET_GCODE_OFFSET): a line that means the
    machine's x says X = x - origin."""


@dataclass(frozen=True, slots=True)
class Moves:
    """Straight moves (arcs already cut), in file order.

    Attributes
    ----------
    start_mm, end_mm : ndarray, shape (n, 4)
        x y z in machine axes and e as the firmware's cumulative extruder position. Read-only: they
        usually share memory, one row apart.
    speed_mm_s : ndarray, shape (n,)
        Requested speed: F times the speed factor, before any limit.
    limits_id, modal_id : ndarray of int32, shape (n,)
        Rows of `ProgramBlock.limits` and `ProgramBlock.modal` in force for the move.
    known : ndarray of uint8, shape (n,)
        Bit 0..2 set: the machine's x, y, z are known at both ends of the move; bits `KEPT`,
        `OF_STATE`, `AFTER_MARK`.
    line, byte_start, byte_end : ndarray of int64, shape (n,)
        Source line; `byte_end` is one past its newline. An arc's pieces share one line.
    layer, feature, object_id : ndarray of int32, shape (n,)
        -1 where unknown.
    tool : ndarray of int32, shape (n,)
        Number of the tool that the file chose last; 0 before any.
    """

    start_mm: NDArray[np.float64]
    end_mm: NDArray[np.float64]
    speed_mm_s: NDArray[np.float64]
    limits_id: NDArray[np.int32]
    modal_id: NDArray[np.int32]
    known: NDArray[np.uint8]
    line: NDArray[np.int64]
    byte_start: NDArray[np.int64]
    byte_end: NDArray[np.int64]
    layer: NDArray[np.int32]
    feature: NDArray[np.int32]
    object_id: NDArray[np.int32]
    tool: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.line)

    @property
    def moves_xy(self) -> NDArray[np.bool_]:
        """Which moves change X or Y, shape (n,)."""
        return _moves_xy(self.end_mm - self.start_mm)

    @property
    def prints(self) -> NDArray[np.bool_]:
        """Which moves feed filament forward while X or Y moves, shape (n,)."""
        return _prints(self.end_mm - self.start_mm)


@dataclass(frozen=True, slots=True)
class Events:
    """Lines that are no moves, in file order.

    Attributes
    ----------
    kind : ndarray of int8, shape (n,)
        An `EventKind`.
    move_index : ndarray of int64, shape (n,)
        Number of moves in the file before the line.
    modal_id, limits_id : ndarray of int32, shape (n,)
        The state AFTER the line.
    dwell_s : ndarray, shape (n,)
        Planned standing time of a STOP (G4), otherwise 0.
    line, byte_start, byte_end : ndarray of int64, shape (n,)
    """

    kind: NDArray[np.int8]
    move_index: NDArray[np.int64]
    modal_id: NDArray[np.int32]
    limits_id: NDArray[np.int32]
    dwell_s: NDArray[np.float64]
    line: NDArray[np.int64]
    byte_start: NDArray[np.int64]
    byte_end: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.line)


class TextLines:
    """Base of what holds moves and events with the text that they come from."""

    __slots__ = ()
    text: bytes
    text_offset: int

    def line(self, rows: Moves | Events, row: int) -> bytes:
        """Return the line of a move or an event, with its end."""
        begin, end = int(rows.byte_start[row]), int(rows.byte_end[row])
        return self.text[begin - self.text_offset : end - self.text_offset]


@dataclass(frozen=True, slots=True)
class ProgramBlock(TextLines):
    """One block of an interpreted file.

    `limits` and `modal` are the interpreter's tables. They are shared by blocks and only grow,
    until they are large: then both are restarted, and ids of earlier blocks are not valid in them.
    `text` holds the bytes from `text_offset` on, and covers every line of the block.
    """

    first_move: int
    moves: Moves
    events: Events
    limits: list[Limits]
    modal: list[ModalState]
    text_offset: int
    text: bytes


@dataclass(frozen=True, slots=True)
class Phases:
    """Planned moves: each an acceleration, a cruise and a deceleration along a straight line.

    A move that the firmware swallows because it is too short has no duration; the next one starts
    where the machine really is.

    Attributes
    ----------
    t_s : ndarray, shape (n,)
        Start of the move, counted from the first move of the file.
    accel_s, cruise_s, decel_s : ndarray, shape (n,)
        Durations of the three phases.
    start_mm, direction : ndarray, shape (n, 4)
        Start position and travel per mm of path (x y z e). An extruder-only move has the
        direction (0, 0, 0, +-1) and its path is filament.
    start_mm_s, cruise_mm_s, end_mm_s : ndarray, shape (n,)
    accel_mm_s2 : ndarray, shape (n,)
    move_index : ndarray of int64, shape (n,)
        Index of the move in the whole file.
    s_curve : ndarray of bool, shape (n,)
        The speed changes along a quintic Bezier curve instead of a straight line, in the same
        time and over the same way (Marlin's S_CURVE_ACCELERATION).
    """

    t_s: NDArray[np.float64]
    accel_s: NDArray[np.float64]
    cruise_s: NDArray[np.float64]
    decel_s: NDArray[np.float64]
    start_mm: NDArray[np.float64]
    direction: NDArray[np.float64]
    start_mm_s: NDArray[np.float64]
    cruise_mm_s: NDArray[np.float64]
    end_mm_s: NDArray[np.float64]
    accel_mm_s2: NDArray[np.float64]
    move_index: NDArray[np.int64]
    s_curve: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.t_s)

    @property
    def lasts_s(self) -> NDArray[np.float64]:
        """Duration of each move, shape (n,)."""
        return np.asarray(self.accel_s + self.cruise_s + self.decel_s)

    @property
    def end_s(self) -> NDArray[np.float64]:
        """When each move ends, shape (n,)."""
        return np.asarray(self.t_s + self.accel_s + self.cruise_s + self.decel_s)

    @property
    def duration_s(self) -> float:
        """From the first move's start to the last one's end."""
        if len(self) == 0:
            return 0.0
        last_s = self.accel_s[-1] + self.cruise_s[-1] + self.decel_s[-1]
        return float(self.t_s[-1] + last_s - self.t_s[0])

    @property
    def length_mm(self) -> NDArray[np.float64]:
        """Way of each move along its path, shape (n,)."""
        begin, top, end = self.start_mm_s, self.cruise_mm_s, self.end_mm_s
        ramps = (begin + top) * self.accel_s + (top + end) * self.decel_s
        return np.asarray(0.5 * ramps + top * self.cruise_s)

    @property
    def end_mm(self) -> NDArray[np.float64]:
        """Where each move ends, x y z e, shape (n, 4)."""
        return np.asarray(self.start_mm + self.direction * self.length_mm[:, None])

    @property
    def moves_xy(self) -> NDArray[np.bool_]:
        """Which moves change X or Y, shape (n,)."""
        return _moves_xy(self.direction)

    @property
    def prints(self) -> NDArray[np.bool_]:
        """Which moves feed filament forward while X or Y moves, shape (n,)."""
        return _prints(self.direction)


def _moves_xy(travel: NDArray[np.float64]) -> NDArray[np.bool_]:
    # Faster than np.any along the short axis.
    return np.asarray((travel[:, 0] != 0.0) | (travel[:, 1] != 0.0))


def _prints(travel: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.asarray(_moves_xy(travel) & (travel[:, 3] > 0.0))


_Table = TypeVar("_Table", Moves, Events, Phases)


def rows_of(table: _Table, rows: slice | list[int] | NDArray[np.int64]) -> _Table:
    """Return some rows of a table; of a slice, they are the same in memory."""
    return type(table)(**{f.name: getattr(table, f.name)[rows] for f in fields(table)})


def joined(tables: Sequence[_Table]) -> _Table:
    """Return one table with the rows of all, in order; at least one must be given."""
    first = tables[0]
    if len(tables) == 1:
        return first
    names = [f.name for f in fields(first)]
    return type(first)(**{n: np.concatenate([getattr(t, n) for t in tables]) for n in names})
