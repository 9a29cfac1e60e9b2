"""Kernels that store the interpreter's output: remembered lines, limits, modes, moves, events.

Rows are written in two steps. What differs from row to row is written at once; what stays the same
over many rows (modes, layer, feature, object, tool) is filled in by `settle` whenever it is about
to change, and the limits, which change most often, by `settle_limits`.
"""

from __future__ import annotations

from math import floor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode._slots import (
    E_KIND,
    E_LIMITS,
    E_LINE,
    E_MODAL,
    E_MOVE,
    E_START,
    E_STOP,
    F_BASE,
    F_EXTRUDE_FACTOR,
    F_LIMITS,
    F_RUN,
    F_SPEED_FACTOR,
    F_TOOL,
    F_UNIT_E_MM,
    F_UNIT_MM,
    I_ABS_E,
    I_ABS_XYZ,
    I_APART,
    I_END,
    I_EVENTS,
    I_FEATURE,
    I_FILLED_EVENTS,
    I_FILLED_MOVES,
    I_KEPT,
    I_KNOWN,
    I_LAYER,
    I_LIMITED_EVENTS,
    I_LIMITED_MOVES,
    I_LIMITS_ID,
    I_LINE,
    I_MODAL_ID,
    I_MOVES,
    I_N_LIMITS,
    I_N_MODAL,
    I_OBJECT,
    I_OFFSET,
    I_POS,
    I_TOOL,
    I_TOTAL_MOVES,
    M_FEATURE,
    M_KNOWN,
    M_LAYER,
    M_LIMITS,
    M_MODAL,
    M_OBJECT,
    M_STOP,
    M_TOOL,
)
from stillpath.models.bytes import word_at
from stillpath.models.jit import kernel


class Rows(NamedTuple):
    """The columns that one block of the program is written to, with room for the same number each.

    There are few arrays because passing each between kernels costs time. They share one block of
    memory, which is quickly reused when a block is freed.
    """

    real: NDArray[np.float64]
    """One after the other: where the first move starts (4 numbers), end of the moves (4 a row),
    start of the moves (4 a row, written only if I_APART), speed, dwell of events."""
    whole: NDArray[np.int64]
    """Rows M_LINE, M_START, M_STOP, E_MOVE, E_LINE, E_START, E_STOP."""
    small: NDArray[np.int32]
    """Rows M_LIMITS, M_MODAL, M_LAYER, M_FEATURE, M_OBJECT, M_TOOL, E_LIMITS, E_MODAL."""
    tiny: NDArray[np.uint8]
    """Rows M_KNOWN, E_KIND."""

    @classmethod
    def empty(cls, count: int) -> Rows:
        """Return room for so many moves and as many events."""
        reals, wholes, smalls, tinies = 10 * count + 4, 7 * count, 8 * count, 2 * count
        memory = np.empty(8 * (reals + wholes) + 4 * smalls + tinies, np.uint8)
        whole = 8 * reals
        small = whole + 8 * wholes
        tiny = small + 4 * smalls
        return cls(
            memory[:whole].view(np.float64),
            memory[whole:small].view(np.int64).reshape(7, count),
            memory[small:tiny].view(np.int32).reshape(8, count),
            memory[tiny:].reshape(2, count),
        )

    @property
    def room(self) -> int:
        """How many rows there are."""
        return int(self.whole.shape[1])

    @property
    def dwell(self) -> NDArray[np.float64]:
        """Dwell of the events, shape (n,)."""
        return self.real[9 * self.room + 4 :]

    def moves(self, count: int, *, apart: bool) -> dict[str, NDArray[Any]]:
        """Return the first rows of the moves' columns."""
        real, room = self.real, self.room
        starts = 4 * (room + 1) if apart else 0
        line, byte_start, byte_end = self.whole[: M_STOP + 1, :count]
        limits_id, modal_id, layer, feature, object_id, tool = self.small[: M_TOOL + 1, :count]
        return {
            "start_mm": real[starts : starts + 4 * count].reshape(count, 4),
            "end_mm": real[4 : 4 + 4 * count].reshape(count, 4),
            "speed_mm_s": real[8 * room + 4 : 8 * room + 4 + count],
            "limits_id": limits_id,
            "modal_id": modal_id,
            "known": self.tiny[M_KNOWN, :count],
            "line": line,
            "byte_start": byte_start,
            "byte_end": byte_end,
            "layer": layer,
            "feature": feature,
            "object_id": object_id,
            "tool": tool,
        }

    def events(self, count: int) -> dict[str, NDArray[Any]]:
        """Return the first rows of the events' columns."""
        move_index, line, byte_start, byte_end = self.whole[E_MOVE:, :count]
        limits_id, modal_id = self.small[E_LIMITS:, :count]
        return {
            "kind": self.tiny[E_KIND, :count].view(np.int8),
            "move_index": move_index,
            "modal_id": modal_id,
            "limits_id": limits_id,
            "dwell_s": self.dwell[:count],
            "line": line,
            "byte_start": byte_start,
            "byte_end": byte_end,
        }


class Tables(NamedTuple):
    """Tables that rows refer to, and the remembered meaning of lines."""

    limits: NDArray[np.float64]
    limits_index: NDArray[np.int32]
    modal: NDArray[np.float64]
    modal_index: NDArray[np.int32]
    memo_keys: NDArray[np.int64]
    """Hashes of remembered lines; 0: free."""
    memo_values: NDArray[np.int64]
    memo_limits: NDArray[np.float64]
    """Limits that remembered lines set; NaN: left alone."""
    memo_after: NDArray[np.int32]
    """The row of `limits` that such a line was last found with, and the one it led to."""
    g_words: NDArray[np.int8]
    """What G0 to G1023 are: an `EventKind`, an `Action` or -1."""
    m_words: NDArray[np.int8]
    layer_z: NDArray[np.float64]
    """Height of each layer; NaN where no mark tells it."""


_KEPT = 8
_FNV_PRIME = 1099511628211
_HASH_PRIME, _ONE, _29 = np.uint64(0x9E3779B97F4A7C15), np.uint64(1), np.uint64(29)


@kernel(allocates=False)
def line_hash(text: Any, start: int, stop: int) -> int:
    """Hash the bytes to a positive int64; after them there must be room of 8 bytes.

    Like FNV-1a, but eight bytes at a time: texts of up to eight bytes collide only through the sign
    bit.
    """
    h = np.uint64(stop - start)
    for p in range(start, stop, 8):
        word = word_at(text, p)
        if stop - p < 8:
            word &= (_ONE << np.uint64(8 * (stop - p))) - _ONE
        h = (h ^ word) * _HASH_PRIME
        h ^= h >> _29
    return max(int(np.int64(h) & np.int64(0x7FFFFFFFFFFFFFFF)), 1)


@kernel(force_inline=True, allocates=False)
def memo_slot(keys: Any, h: int) -> int:
    """Find the slot of a remembered line, or the free slot where it belongs."""
    mask = len(keys) - 1
    slot = h & mask
    while keys[slot] != 0 and keys[slot] != h:
        slot = (slot + 1) & mask
    return slot


@kernel(allocates=False)
def _same(rows: Any, one: int, other: int) -> bool:
    same = True
    for k in range(rows.shape[1]):
        same = same and rows[one, k] == rows[other, k]
    return same


@kernel(allocates=False)
def intern_row(rows: Any, index: Any, count: int) -> int:
    """Look row `count` up among those before it; its number is `count` if it is new."""
    mask = len(index) - 1
    h = np.int64(0)
    for k in range(rows.shape[1]):
        scaled = rows[count, k] * 1048576.0
        whole = floor(scaled)
        h = (h ^ np.int64(whole)) * np.int64(_FNV_PRIME)
        h ^= np.int64((scaled - whole) * 1048576.0) << np.int64(17)
    h ^= h >> np.int64(29)
    slot = h & mask
    while True:
        number = int(index[slot])
        if number < 0:
            index[slot] = count
            return count
        if _same(rows, number, count):
            return number
        slot = (slot + 1) & mask


@kernel(allocates=False)
def _start_anew(f: Any, i: Any, rows: Any) -> None:
    """Let the next move start at the tool's position instead of the end of the last move."""
    apart = False
    for k in range(4):
        apart = apart or f[F_RUN + k] != f[F_TOOL + k]
        f[F_RUN + k] = f[F_TOOL + k]
    if apart and i[I_MOVES] > 0 and not i[I_APART]:
        starts = 4 * (rows.small.shape[1] + 1)
        for k in range(4 * i[I_MOVES]):
            rows.real[starts + k] = rows.real[k]
        i[I_APART] = 1


@kernel(allocates=False)
def settle(f: Any, i: Any, rows: Any) -> None:
    """Fill the slow columns of the rows written since the last time."""
    a, b = i[I_FILLED_MOVES], i[I_MOVES]
    small = rows.small
    if a < b:
        real, tiny = rows.real, rows.tiny
        kept = i[I_KEPT]
        if f[F_UNIT_MM] != 1.0 or f[F_UNIT_E_MM] != 1.0:
            kept = _KEPT  # a stream in millimetres would not fit in
        known = i[I_KNOWN] | kept
        modal, layer = i[I_MODAL_ID], i[I_LAYER]
        feature, thing, tool = i[I_FEATURE], i[I_OBJECT], i[I_TOOL]
        if a == 0:
            for k in range(4):
                real[k] = f[F_RUN + k]
        if i[I_APART]:
            starts = 4 * (small.shape[1] + 1)
            for k in range(4):
                real[starts + 4 * a + k] = f[F_RUN + k]
            for k in range(4 * (a + 1), 4 * b):
                real[starts + k] = real[k]
        for k in range(4):
            f[F_RUN + k] = real[4 * b + k]
        for n in range(a, b):
            tiny[M_KNOWN, n] = known
            small[M_MODAL, n] = modal
            small[M_LAYER, n] = layer
            small[M_FEATURE, n] = feature
            small[M_OBJECT, n] = thing
            small[M_TOOL, n] = tool
        i[I_FILLED_MOVES] = b
    else:
        _start_anew(f, i, rows)
    a, b = i[I_FILLED_EVENTS], i[I_EVENTS]
    if a < b:
        dwells = 9 * small.shape[1] + 4
        modal = i[I_MODAL_ID]
        for n in range(a, b):
            small[E_MODAL, n] = modal
            rows.real[dwells + n] = 0.0
        i[I_FILLED_EVENTS] = b


@kernel(force_inline=True, allocates=False)
def settle_limits(i: Any, rows: Any) -> None:
    """Fill the limits of the rows written since the last time."""
    small, limits = rows.small, i[I_LIMITS_ID]
    for n in range(i[I_LIMITED_MOVES], i[I_MOVES]):
        small[M_LIMITS, n] = limits
    for n in range(i[I_LIMITED_EVENTS], i[I_EVENTS]):
        small[E_LIMITS, n] = limits
    i[I_LIMITED_MOVES], i[I_LIMITED_EVENTS] = i[I_MOVES], i[I_EVENTS]


@kernel(allocates=False)
def note_modal(f: Any, i: Any, tables: Any) -> None:
    """Enter the modal state in its table; the rows before it must be settled."""
    rows, count = tables.modal, i[I_N_MODAL]
    row = rows[count]
    row[0] = i[I_ABS_XYZ]
    row[1] = i[I_ABS_E]
    row[2] = f[F_SPEED_FACTOR] * 60.0
    row[3] = f[F_EXTRUDE_FACTOR]
    for k in range(3):
        row[4 + k] = f[F_BASE + k]
    if count > 0 and _same(rows, i[I_MODAL_ID], count):
        return
    number = intern_row(rows, tables.modal_index, count)
    i[I_N_MODAL] = max(count, number + 1)
    i[I_MODAL_ID] = number


@kernel(allocates=False)
def note_limits(f: Any, i: Any, rows: Any, tables: Any) -> None:
    """Enter the limits in their table; the rows before them get those that were in force."""
    table, count = tables.limits, i[I_N_LIMITS]
    for k in range(table.shape[1]):
        table[count, k] = f[F_LIMITS + k]
    if count > 0 and _same(table, i[I_LIMITS_ID], count):
        return
    settle_limits(i, rows)
    number = intern_row(table, tables.limits_index, count)
    i[I_N_LIMITS] = max(count, number + 1)
    i[I_LIMITS_ID] = number


@kernel(force_inline=True, allocates=False)
def recall_limits(line: int, f: Any, i: Any, rows: Any, tables: Any) -> None:
    """Set the limits that a remembered line sets.

    Slicers alternate between a few limits, so the row found the last time is usually right again.
    """
    before, after = i[I_LIMITS_ID], tables.memo_after
    if after[line, 0] != before:
        for k in range(tables.limits.shape[1]):
            limit = tables.memo_limits[line, k]
            if limit == limit:
                f[F_LIMITS + k] = limit
        note_limits(f, i, rows, tables)
        after[line, 0], after[line, 1] = before, i[I_LIMITS_ID]
    elif after[line, 1] != before:
        settle_limits(i, rows)
        i[I_LIMITS_ID] = after[line, 1]
        for k in range(tables.limits.shape[1]):
            f[F_LIMITS + k] = tables.limits[after[line, 1], k]


@kernel(force_inline=True, allocates=False)
def put_event(i: Any, rows: Any, kind: int) -> None:
    """Write the line in hand as an event."""
    n = i[I_EVENTS]
    rows.tiny[E_KIND, n] = kind
    rows.whole[E_MOVE, n] = i[I_TOTAL_MOVES]
    rows.whole[E_LINE, n] = i[I_LINE]
    rows.whole[E_START, n] = i[I_OFFSET] + i[I_POS]
    rows.whole[E_STOP, n] = i[I_OFFSET] + i[I_END]
    i[I_EVENTS] = n + 1
