"""Kernels of the interpreter: cut lines into words and carry out the frequent ones.

One call of `run` walks over whole lines of a buffer and writes rows of moves and events. It stops
early with a status when a line needs Python (`HANDBACK`), when the output is full (`FULL`), when
a table must grow (`GROW`) or when the line is an error. All state lives in two small arrays,
addressed by the ``F_`` (float64) and ``I_`` (int64) slots below, so that Python and
kernel share it.

Rules: klippy/gcode.py, klippy/extras/gcode_move.py, klippy/extras/gcode_arcs.py, 2026-08.
"""

from __future__ import annotations

from math import atan2, cos, fabs, floor, hypot, pi, sin, sqrt
from typing import Any

import numpy as np

from models.jit import kernel

__all__ = ["execute", "run", "travel"]

# Float state: positions are x y z e.
F_LAST = 0  # where the G-code says the tool is
F_BASE = 4  # origin of the G-code coordinates
F_TOOL = 8  # where the planner was last sent; differs from F_LAST by skipped tiny moves
F_HOMING = 12  # SET_GCODE_OFFSET
F_SPEED = 16  # mm/s
F_SPEED_FACTOR = 17  # mm/s per mm/min of F
F_EXTRUDE_FACTOR = 18
F_LOW = 20  # travel of x y z
F_HIGH = 23
F_ARC_MM = 26
F_LIMITS = 27  # velocity, acceleration, corner velocity, minimum cruise ratio
F_ERROR = 31  # value, limit
F_SIZE = 33

I_POS = 0  # next line starts here
I_LINE = 1  # its number
I_MOVES = 2  # rows written
I_EVENTS = 3
I_TOTAL_MOVES = 4  # of the whole file
I_ABS_XYZ = 5
I_ABS_E = 6
I_KNOWN = 7  # bit per axis
I_LIMITS_ID = 8
I_MODAL_ID = 9
I_N_LIMITS = 10
I_N_MODAL = 11
I_LAYER = 12
I_FEATURE = 13
I_OBJECT = 14
I_PLANE = 15
I_STRICT = 16
I_END = 17  # end of the line in hand
I_ERROR_AXIS = 18
I_OFFSET = 19  # file offset of the buffer
I_NEED = 20  # move rows that the line in hand needs
I_ORIGIN_KNOWN = 21  # bit per axis: F_BASE holds in the machine's axes
I_KEPT = 22  # `gcode.types.KEPT` between the marks that forbid to change moves, else 0
I_SIZE = 23

# Columns of the integer rows.
M_LIMITS, M_MODAL, M_KNOWN, M_LINE, M_START, M_STOP, M_LAYER, M_FEATURE, M_OBJECT = range(9)
E_KIND, E_MOVE, E_LIMITS, E_MODAL, E_LINE, E_START, E_STOP = range(7)

OK, DONE, HANDBACK, FULL, GROW = 0, 1, 2, 3, 4
ERROR_INCHES, ERROR_FEED, ERROR_TRAVEL, ERROR_RANGE = 10, 11, 12, 13
ERROR_ARC_RADIUS, ERROR_ARC_RELATIVE, ERROR_ARC_CENTER, ERROR_ARC_LONG = 14, 15, 16, 17
ERROR_POSITIVE, ERROR_SLOW = 18, 19

MODAL_SIZE = 7

MARK_NONE, MARK_LAYER, MARK_FEATURE, MARK_OBJECT = 0, 1, 2, 3
MARK_STRIDE = 1 << 32

MAX_VALUE = 1e9  # no coordinate or feedrate of a printer is larger
MIN_SPEED_MM_S = 1e-4
MIN_VALUE = 1e-9
MAX_ARC_PIECES = 200_000
SMALLEST_MOVE_MM = 1e-9

_HARMLESS, _MODE, _LIMITS, _STOP, _UNKNOWN = 0, 1, 2, 3, 4
_X, _Y, _Z, _E, _F, _I, _J, _K, _P, _R, _S, _T = 23, 24, 25, 4, 5, 8, 9, 10, 15, 17, 18, 19
_POWERS = 10.0 ** np.arange(23)
_FNV_OFFSET = 1469598103934665603
_FNV_PRIME = 1099511628211


@kernel
def mark_hash(text: Any, start: int, stop: int) -> int:
    """Hash the bytes (FNV-1a) to a positive int64."""
    h = np.int64(_FNV_OFFSET)
    for p in range(start, stop):
        h = (h ^ np.int64(text[p])) * np.int64(_FNV_PRIME)
    h = h & np.int64(0x7FFFFFFFFFFFFFFF)
    return int(h) if h != 0 else 1


@kernel
def mark_slot(keys: Any, h: int) -> int:
    """Find the slot of a remembered mark, or the free slot where it belongs."""
    mask = len(keys) - 1
    slot = h & mask
    while keys[slot] != 0 and keys[slot] != h:
        slot = (slot + 1) & mask
    return slot


@kernel
def intern_row(rows: Any, index: Any, count: int, row: Any) -> int:
    """Look `row` up in the append-only table `rows`; the number is `count` if it is new."""
    mask = len(index) - 1
    h = np.int64(0)
    for k in range(rows.shape[1]):
        h = h * np.int64(1000003) ^ np.int64(hash(row[k]))
    h ^= h >> np.int64(29)
    slot = h & mask
    while True:
        number = int(index[slot])
        if number < 0:
            index[slot] = count
            for k in range(rows.shape[1]):
                rows[count, k] = row[k]
            return count
        same = True
        for k in range(rows.shape[1]):
            if rows[number, k] != row[k]:
                same = False
        if same:
            return number
        slot = (slot + 1) & mask


@kernel
def note_modal(f: Any, i: Any, rows: Any, index: Any) -> None:
    """Enter the modal state in its table."""
    row = np.empty(MODAL_SIZE)
    row[0] = i[I_ABS_XYZ]
    row[1] = i[I_ABS_E]
    row[2] = f[F_SPEED_FACTOR] * 60.0
    row[3] = f[F_EXTRUDE_FACTOR]
    for k in range(3):
        row[4 + k] = f[F_BASE + k]
    number = intern_row(rows, index, i[I_N_MODAL], row)
    i[I_N_MODAL] = max(i[I_N_MODAL], number + 1)
    i[I_MODAL_ID] = number


@kernel
def note_limits(f: Any, i: Any, rows: Any, index: Any) -> None:
    """Enter the planner's limits in their table."""
    number = intern_row(rows, index, i[I_N_LIMITS], f[F_LIMITS : F_LIMITS + 4])
    i[I_N_LIMITS] = max(i[I_N_LIMITS], number + 1)
    i[I_LIMITS_ID] = number


@kernel
def put_event(i: Any, ei: Any, ef: Any, kind: int, dwell_s: float) -> None:
    """Write the line in hand as an event."""
    n = i[I_EVENTS]
    ei[n, E_KIND] = kind
    ei[n, E_MOVE] = i[I_TOTAL_MOVES]
    ei[n, E_LIMITS] = i[I_LIMITS_ID]
    ei[n, E_MODAL] = i[I_MODAL_ID]
    ei[n, E_LINE] = i[I_LINE]
    ei[n, E_START] = i[I_OFFSET] + i[I_POS]
    ei[n, E_STOP] = i[I_OFFSET] + i[I_END]
    ef[n] = dwell_s
    i[I_EVENTS] = n + 1


@kernel(inline=True)
def travel(f: Any, i: Any, mf: Any, mi: Any, named: int, trusted: bool) -> int:
    """Send the tool to F_LAST; write a move unless nothing moves.

    Parameters
    ----------
    named : int
        Bit per axis that an absolute coordinate has made known.
    trusted : bool
        False marks the row as unknown on all axes: its line is more than a plain move.

    Returns
    -------
    int
        OK for a move, DONE for none, else an error.
    """
    known = i[I_KNOWN]
    after = known | named
    for k in range(4):
        if not fabs(f[F_LAST + k]) <= MAX_VALUE:
            i[I_ERROR_AXIS] = k
            f[F_ERROR] = f[F_LAST + k]
            f[F_ERROR + 1] = MAX_VALUE
            return ERROR_RANGE
    dx = f[F_LAST] - f[F_TOOL]
    dy = f[F_LAST + 1] - f[F_TOOL + 1]
    dz = f[F_LAST + 2] - f[F_TOOL + 2]
    de = f[F_LAST + 3] - f[F_TOOL + 3]
    moving = sqrt(dx * dx + dy * dy + dz * dz) >= SMALLEST_MOVE_MM
    if not moving and de == 0.0:
        i[I_KNOWN] = after
        return DONE
    if f[F_SPEED] < MIN_SPEED_MM_S:
        f[F_ERROR] = f[F_SPEED]
        f[F_ERROR + 1] = MIN_SPEED_MM_S
        return ERROR_SLOW
    if moving and i[I_STRICT]:
        for k in range(3):
            if (after >> k) & 1:
                value = f[F_LAST + k]
                if value < f[F_LOW + k] or value > f[F_HIGH + k]:
                    i[I_ERROR_AXIS] = k
                    f[F_ERROR] = value
                    f[F_ERROR + 1] = f[F_LOW + k] if value < f[F_LOW + k] else f[F_HIGH + k]
                    return ERROR_TRAVEL
    n = i[I_MOVES]
    for k in range(4):
        mf[n, k] = f[F_TOOL + k]
        if moving or k == 3:
            f[F_TOOL + k] = f[F_LAST + k]
        mf[n, 4 + k] = f[F_TOOL + k]
    mf[n, 8] = f[F_SPEED]
    mi[n, M_LIMITS] = i[I_LIMITS_ID]
    mi[n, M_MODAL] = i[I_MODAL_ID]
    mi[n, M_KNOWN] = (known if trusted else 0) | i[I_KEPT]
    mi[n, M_LINE] = i[I_LINE]
    mi[n, M_START] = i[I_OFFSET] + i[I_POS]
    mi[n, M_STOP] = i[I_OFFSET] + i[I_END]
    mi[n, M_LAYER] = i[I_LAYER]
    mi[n, M_FEATURE] = i[I_FEATURE]
    mi[n, M_OBJECT] = i[I_OBJECT]
    i[I_MOVES] = n + 1
    i[I_TOTAL_MOVES] += 1
    i[I_KNOWN] = after
    return OK


@kernel
def _set_feed(f: Any, feed: float) -> int:
    if not 0.0 < feed <= MAX_VALUE:
        f[F_ERROR] = feed
        return ERROR_FEED
    f[F_SPEED] = feed * f[F_SPEED_FACTOR]
    return OK


@kernel(inline=True)
def _move(
    w: Any,
    mask: int,
    f: Any,
    i: Any,
    mf: Any,
    mi: Any,
    ei: Any,
    ef: Any,
) -> int:
    named = 0
    for k in range(3):
        if mask & (1 << (_X + k)):
            if i[I_ABS_XYZ]:
                f[F_LAST + k] = w[_X + k] + f[F_BASE + k]
                named |= 1 << k
            else:
                f[F_LAST + k] += w[_X + k]
    if mask & (1 << _E):
        length = w[_E] * f[F_EXTRUDE_FACTOR]
        if i[I_ABS_XYZ] and i[I_ABS_E]:
            f[F_LAST + 3] = length + f[F_BASE + 3]
        else:
            f[F_LAST + 3] += length
    if mask & (1 << _F):
        status = _set_feed(f, w[_F])
        if status != OK:
            return status
    # A coordinate that only seems to stand where we guess the axis to be may well move it.
    guessed = named & ~i[I_KNOWN]
    status = travel(f, i, mf, mi, named & i[I_ORIGIN_KNOWN], True)
    if status == DONE:
        put_event(i, ei, ef, _UNKNOWN if guessed else _MODE, 0.0)
        return OK
    return status


@kernel
def _arc(
    clockwise: bool,
    w: Any,
    mask: int,
    f: Any,
    i: Any,
    mf: Any,
    mi: Any,
    ei: Any,
    ef: Any,
) -> int:
    if not i[I_ABS_XYZ]:
        return ERROR_ARC_RELATIVE
    if mask & (1 << _R):
        return ERROR_ARC_RADIUS
    here = np.empty(3)
    there = np.empty(3)
    named = 0
    for k in range(3):
        here[k] = f[F_LAST + k] - f[F_BASE + k]
        there[k] = here[k]
        if mask & (1 << (_X + k)):
            there[k] = w[_X + k]
            named |= 1 << k
    a, b, c = 0, 1, 2
    if i[I_PLANE] == 1:
        a, b, c = 0, 2, 1
    elif i[I_PLANE] == 2:
        a, b, c = 1, 2, 0
    off_a = w[_I + a] if mask & (1 << (_I + a)) else 0.0
    off_b = w[_I + b] if mask & (1 << (_I + b)) else 0.0
    if off_a == 0.0 and off_b == 0.0:
        return ERROR_ARC_CENTER
    # Angle from the start's radius to the target's, in the direction of the arc.
    center_a = here[a] + off_a
    center_b = here[b] + off_b
    to_a = there[a] - center_a
    to_b = there[b] - center_b
    angle = atan2(-off_a * to_b + off_b * to_a, -off_a * to_a - off_b * to_b)
    if angle < 0.0:
        angle += 2.0 * pi
    if clockwise:
        angle -= 2.0 * pi
    if angle == 0.0 and here[a] == there[a] and here[b] == there[b]:
        angle = 2.0 * pi
    rise = there[c] - here[c]
    flat_mm = hypot(off_a, off_b) * angle
    length_mm = hypot(flat_mm, rise) if rise != 0.0 else fabs(flat_mm)
    pieces = max(1.0, floor(length_mm / f[F_ARC_MM]))
    if not pieces <= MAX_ARC_PIECES:
        f[F_ERROR] = pieces
        f[F_ERROR + 1] = MAX_ARC_PIECES
        return ERROR_ARC_LONG
    n = int(pieces)
    if i[I_MOVES] + n > len(mf):
        i[I_NEED] = n
        return FULL
    if mask & (1 << _F):
        status = _set_feed(f, w[_F])
        if status != OK:
            return status
    e_here = (f[F_LAST + 3] - f[F_BASE + 3]) / f[F_EXTRUDE_FACTOR]
    e_each = 0.0
    if mask & (1 << _E):
        e_each = (w[_E] - (e_here if i[I_ABS_E] else 0.0)) / pieces
    angle_each = angle / pieces
    rise_each = rise / pieces
    moved = False
    point = np.empty(3)
    for piece in range(1, n + 1):
        if piece < n:
            turn_cos = cos(piece * angle_each)
            turn_sin = sin(piece * angle_each)
            point[a] = center_a + (-off_a * turn_cos + off_b * turn_sin)
            point[b] = center_b + (-off_a * turn_sin - off_b * turn_cos)
            point[c] = here[c] + piece * rise_each
        else:
            for k in range(3):
                point[k] = there[k]
        for k in range(3):
            f[F_LAST + k] = point[k] + f[F_BASE + k]
        if e_each != 0.0:
            if i[I_ABS_E]:
                e_here += e_each
                f[F_LAST + 3] = e_here * f[F_EXTRUDE_FACTOR] + f[F_BASE + 3]
            else:
                f[F_LAST + 3] += e_each * f[F_EXTRUDE_FACTOR]
        status = travel(f, i, mf, mi, named & i[I_ORIGIN_KNOWN] if piece == n else 0, True)
        if status > DONE:
            return status
        moved = moved or status == OK
    if not moved:
        put_event(i, ei, ef, _MODE, 0.0)
    return OK


@kernel
def _positive(f: Any, value: float) -> bool:
    f[F_ERROR] = value
    return MIN_VALUE <= value <= MAX_VALUE


@kernel
def execute(
    action: int,
    w: Any,
    mask: int,
    f: Any,
    i: Any,
    mf: Any,
    mi: Any,
    ei: Any,
    ef: Any,
    lim_rows: Any,
    lim_index: Any,
    mod_rows: Any,
    mod_index: Any,
) -> int:
    """Carry out one command of the kernel's table; write its move or event.

    Parameters
    ----------
    action : int
        A `dialect.Action`.
    w, mask : ndarray of 26 floats, int
        Values of the words A to Z and which of them are present.
    """
    if action == 20:
        return _move(w, mask, f, i, mf, mi, ei, ef)
    if action == 21 or action == 22:
        return _arc(action == 21, w, mask, f, i, mf, mi, ei, ef)
    if action == 23:
        dwell_ms = w[_P] if mask & (1 << _P) else 0.0
        if not 0.0 <= dwell_ms <= MAX_VALUE:
            f[F_ERROR] = dwell_ms
            return ERROR_POSITIVE
        put_event(i, ei, ef, _STOP, dwell_ms / 1000.0)
        return OK
    if action == 27:
        return ERROR_INCHES
    if action == 33:
        accel = 0.0
        if mask & (1 << _S):
            accel = w[_S]
        elif mask & (1 << _P) and mask & (1 << _T):
            accel = min(w[_P], w[_T]) if w[_P] > 0.0 and w[_T] > 0.0 else 0.0
        else:
            put_event(i, ei, ef, _LIMITS, 0.0)
            return OK
        if not _positive(f, accel):
            return ERROR_POSITIVE
        if accel != f[F_LIMITS + 1]:
            f[F_LIMITS + 1] = accel
            note_limits(f, i, lim_rows, lim_index)
        put_event(i, ei, ef, _LIMITS, 0.0)
        return OK
    if 24 <= action <= 26:
        i[I_PLANE] = action - 24
    elif action == 28 or action == 29:
        i[I_ABS_XYZ] = 1 if action == 28 else 0
    elif action == 31 or action == 32:
        i[I_ABS_E] = 1 if action == 31 else 0
    elif action == 30:
        any_axis = False
        for k in range(4):
            letter = _X + k if k < 3 else _E
            if mask & (1 << letter):
                any_axis = True
                scale = f[F_EXTRUDE_FACTOR] if k == 3 else 1.0
                if not fabs(w[letter]) <= MAX_VALUE:
                    i[I_ERROR_AXIS] = k
                    f[F_ERROR] = w[letter]
                    f[F_ERROR + 1] = MAX_VALUE
                    return ERROR_RANGE
                f[F_BASE + k] = f[F_LAST + k] - w[letter] * scale
                # An origin set from a guessed position is a guess.
                i[I_ORIGIN_KNOWN] &= ~(1 << k) | i[I_KNOWN]
                i[I_ORIGIN_KNOWN] |= (1 << k) & i[I_KNOWN]
        if not any_axis:
            for k in range(4):
                f[F_BASE + k] = f[F_LAST + k]
            i[I_ORIGIN_KNOWN] = i[I_KNOWN]
    elif action == 34 or action == 35:
        percent = w[_S] if mask & (1 << _S) else 100.0
        if not _positive(f, percent):
            return ERROR_POSITIVE
        if action == 34:
            factor = percent / (60.0 * 100.0)
            f[F_SPEED] = f[F_SPEED] / f[F_SPEED_FACTOR] * factor
            f[F_SPEED_FACTOR] = factor
        else:
            factor = percent / 100.0
            e_value = (f[F_LAST + 3] - f[F_BASE + 3]) / f[F_EXTRUDE_FACTOR]
            f[F_BASE + 3] = f[F_LAST + 3] - e_value * factor
            f[F_EXTRUDE_FACTOR] = factor
    note_modal(f, i, mod_rows, mod_index)
    put_event(i, ei, ef, _MODE, 0.0)
    return OK


@kernel
def _line_end(buf: Any, p: int, stop: int) -> int:
    while p < stop and buf[p] != 10:
        p += 1
    return p


@kernel
def _maybe_mark(buf: Any, p: int, end: int) -> bool:
    """Tell whether the comment (p: behind its semicolon) may be a mark that Python knows."""
    while p < end and (buf[p] == 32 or buf[p] == 59):
        p += 1
    if p + 3 >= end:
        return False
    # First two letters, lower case: LA TY CH FE Z: Z_ pr st ME PR BE 'P OB fe -- and our stamp.
    a: int = buf[p] | 32
    b: int = buf[p + 1] | 32
    if a == 108:
        return b == 97
    if a == 116:
        return b == 121
    if a == 99:
        return b == 104
    if a == 102:
        return b == 101
    if a == 122:
        return b == 58 or b == 127  # colon, underscore
    if a == 112:
        return b == 114
    if a == 115:
        return b == 116
    if a == 109:
        return b == 101
    if a == 98:
        return b == 101
    if a == 111:
        return b == 98
    return a == 39 or (a == 45 and b == 45)  # both have bit 5 set


@kernel
def run(
    buf: Any,
    stop: int,
    f: Any,
    i: Any,
    w: Any,
    mf: Any,
    mi: Any,
    ei: Any,
    ef: Any,
    lim_rows: Any,
    lim_index: Any,
    mod_rows: Any,
    mod_index: Any,
    mark_keys: Any,
    mark_values: Any,
    g_table: Any,
    m_table: Any,
) -> int:
    """Interpret the lines of ``buf[i[I_POS]:stop]``; the last one may lack its newline.

    Returns
    -------
    int
        DONE at the end of the buffer, or why the line at I_POS could not be finished.
    """
    while i[I_POS] < stop:
        if i[I_MOVES] + 1 > len(mf) or i[I_EVENTS] + 1 > len(ei):
            i[I_NEED] = 1
            return FULL
        if i[I_N_MODAL] + 2 > len(mod_rows) or i[I_N_LIMITS] + 2 > len(lim_rows):
            return GROW
        p = i[I_POS]
        # The command letter, after blanks and an N word.
        while p < stop and (buf[p] == 32 or buf[p] == 9 or buf[p] == 13):
            p += 1
        if p + 1 < stop and (buf[p] | 32) == 110 and (buf[p + 1] == 32 or 48 <= buf[p + 1] <= 57):
            p += 1
            while p < stop and (buf[p] == 32 or 48 <= buf[p] <= 57):
                p += 1
        if p >= stop or buf[p] == 10:
            i[I_END] = min(p + 1, stop)
            put_event(i, ei, ef, _HARMLESS, 0.0)
        elif buf[p] == 59:
            start = p
            p = _line_end(buf, p, stop)
            i[I_END] = min(p + 1, stop)
            if _maybe_mark(buf, start + 1, p):
                h = mark_hash(buf, start, p)
                slot = mark_slot(mark_keys, h)
                if mark_keys[slot] == 0:
                    return HANDBACK
                value = mark_values[slot]
                what = value // MARK_STRIDE
                if what == MARK_LAYER:
                    i[I_LAYER] += 1
                elif what == MARK_FEATURE:
                    i[I_FEATURE] = value % MARK_STRIDE - 1
                elif what == MARK_OBJECT:
                    i[I_OBJECT] = value % MARK_STRIDE - 1
            put_event(i, ei, ef, _HARMLESS, 0.0)
        else:
            letter = buf[p] & 0xDF
            p += 1
            number = 0
            digits = 0
            while p < stop and 48 <= buf[p] <= 57 and digits < 5:
                number = number * 10 + (buf[p] - 48)
                digits += 1
                p += 1
            zero_led = digits > 1 and buf[p - digits] == 48
            plain = digits > 0 and not zero_led and number < 1024
            action = -1
            if plain and letter == 71:
                action = g_table[number]
            elif plain and letter == 77:
                action = m_table[number]
            # Words: single letters with plain decimal numbers; anything else is for Python.
            mask = 0
            good = action >= 0
            while good:
                while p < stop and (buf[p] == 32 or buf[p] == 9 or buf[p] == 13):
                    p += 1
                if p >= stop or buf[p] == 10:
                    break
                if buf[p] == 59:
                    p = _line_end(buf, p, stop)
                    break
                key = (buf[p] & 0xDF) - 65 if buf[p] >= 65 else -1
                if buf[p] == 42:
                    key = 26
                if key < 0 or key > 26 or (key == 26 and buf[p] != 42):
                    good = False
                    break
                p += 1
                while p < stop and (buf[p] == 32 or buf[p] == 9 or buf[p] == 13):
                    p += 1
                negative = False
                if p < stop and (buf[p] == 45 or buf[p] == 43):
                    negative = buf[p] == 45
                    p += 1
                mantissa = 0
                seen = 0
                fraction = 0
                dot = False
                while p < stop:
                    c = buf[p]
                    if 48 <= c <= 57:
                        mantissa = mantissa * 10 + (c - 48)
                        seen += 1
                        if dot:
                            fraction += 1
                    elif c == 46 and not dot:
                        dot = True
                    else:
                        break
                    p += 1
                    if seen > 15:
                        break
                # Up to 15 digits the quotient of two exact doubles is the nearest double.
                if seen == 0 or seen > 15:
                    good = False
                    break
                value = mantissa / _POWERS[fraction]
                if key < 26:
                    w[key] = -value if negative else value
                    mask |= 1 << key
            if not good:
                i[I_END] = min(_line_end(buf, p, stop) + 1, stop)
                return HANDBACK
            i[I_END] = min(p + 1, stop)
            if action < 20:
                put_event(i, ei, ef, action, 0.0)
            elif action == 20:  # here again: passing so many arrays on costs as much as the rest
                status = _move(w, mask, f, i, mf, mi, ei, ef)
                if status != OK:
                    return status
            else:
                status = execute(
                    action, w, mask, f, i, mf, mi, ei, ef, lim_rows, lim_index, mod_rows, mod_index
                )
                if status != OK:
                    return status
        i[I_POS] = i[I_END]
        i[I_LINE] += 1
    return DONE
