"""The kernel of plain lines: G0 and G1 with X Y Z E F in decimal numbers, comments, empty lines.

They make up nearly all of a print file, so they are optimised: the state is held in local variables
and numbers are read eight characters at a time. Anything else (another word, an unusual number, a
position outside the travel, an axis that becomes known) is left to `_lex_kernels.run`, which reads
the same line again by the same rules and reports errors.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stillpath.gcode._motion_kernels import extruder_is_absolute
from stillpath.gcode._slots import (
    E_KIND,
    E_LINE,
    E_MOVE,
    E_START,
    E_STOP,
    F_BASE,
    F_EXTRUDE_FACTOR,
    F_HIGH,
    F_LAST,
    F_LOW,
    F_SPEED,
    F_SPEED_FACTOR,
    F_TOOL,
    F_UNIT_E_MM,
    F_UNIT_MM,
    I_ABS_XYZ,
    I_AXES_FACTORS,
    I_EVENTS,
    I_EXPONENTS,
    I_FIRST_WINS,
    I_HOLD,
    I_KNOWN,
    I_LINE,
    I_LONGEST,
    I_MOTION,
    I_MOVES,
    I_OFFSET,
    I_ORIGIN_KNOWN,
    I_POS,
    I_STRICT,
    I_TOTAL_MOVES,
    M_LINE,
    M_START,
    M_STOP,
    MAX_VALUE,
    MIN_SPEED_MM_S,
    SMALLEST_MOVE_MM,
)
from stillpath.models.bytes import byte_at, trailing_zeros, word_at
from stillpath.models.jit import kernel

_HARMLESS, _MODE = 0, 1
_POWERS = 10.0 ** np.arange(23)
_WHOLE_POWERS = 10 ** np.arange(9, dtype=np.int64)
_ZEROS = np.uint64(0x3030303030303030)
_ABOVE_NINE = np.uint64(0x7676767676767676)
_HIGH_BITS = np.uint64(0x8080808080808080)
_LOW_BITS = np.uint64(0x0101010101010101)
_NEWLINES = np.uint64(0x0A0A0A0A0A0A0A0A)
_ONE, _THREE, _EIGHT, _64 = np.uint64(1), np.uint64(3), np.uint64(8), np.uint64(64)
_BYTE, _TEN, _SIXTEEN, _32 = np.uint64(0xFF), np.uint64(10), np.uint64(16), np.uint64(32)
_PAIRS = np.uint64(0x000000FF000000FF)
_MUL_HIGH = np.uint64(0x000F424000000064)  # 100 + (1000000 << 32)
_MUL_LOW = np.uint64(0x0000271000000001)  # 1 + (10000 << 32)
_SMALLEST_SQUARED = SMALLEST_MOVE_MM * SMALLEST_MOVE_MM

_MARKS = np.zeros(1024, np.bool_)
"""Whether a comment that begins with two letters (five bits of each) may be a slicer's mark."""
for _pair in ("la", "ty", "ch", "fe", "z:", "z_", "pr", "st", "me", "be", "ob", "--"):
    _MARKS[(ord(_pair[0]) & 31) << 5 | ord(_pair[1]) & 31] = True
_MARKS[(ord("'") & 31) << 5 : ((ord("'") & 31) + 1) << 5] = True


@kernel(force_inline=True, allocates=False)
def eight_digits(digits: Any) -> Any:
    """Return the number that eight digits (0 to 9, the first in the lowest byte) make."""
    pairs = digits * _TEN + (digits >> _EIGHT)
    high = (pairs & _PAIRS) * _MUL_HIGH
    low = ((pairs >> _SIXTEEN) & _PAIRS) * _MUL_LOW
    return np.int64((high + low) >> _32)


@kernel(force_inline=True, allocates=False)
def decimal(buf: Any, p: int) -> Any:
    """Read a number; return it and its end, or -1 if it is not plain.

    A plain number has up to 7 digits before and after its point; either part may be missing. It is
    read as an integer over a power of ten, both exact, so that the quotient is the nearest double.
    """
    c = byte_at(buf, p)
    negative = c == 45
    if negative or c == 43:
        p += 1
    digits = word_at(buf, p) ^ _ZEROS
    # The lowest non-digit byte gets its high bit set; later bytes are not reliable.
    others = ((digits + _ABOVE_NINE) | digits) & _HIGH_BITS
    n = trailing_zeros(others) >> _THREE
    if n == _EIGHT:
        return 0.0, -1
    stop = (digits >> (n << _THREE)) & _BYTE
    if stop != np.uint64(0x1E):  # the point, less 0
        if n == np.uint64(0):
            return 0.0, -1
        whole = float(eight_digits(digits << (_64 - (n << _THREE))))
        return (-whole if negative else whole), p + np.int64(n)
    later = others & (others - _ONE)
    if later != np.uint64(0):
        # Point and end are in the same eight characters: take the point out.
        end = trailing_zeros(later) >> _THREE
        count = end - _ONE
        if count == np.uint64(0):
            return 0.0, -1
        before = (_ONE << (n << _THREE)) - _ONE
        digits = (digits & before) | ((digits >> _EIGHT) & ~before)
        value = float(eight_digits(digits << (_64 - (count << _THREE))))
        value /= _POWERS[np.int64(count - n)]
        return (-value if negative else value), p + np.int64(end)
    whole_part: Any = np.int64(0)
    if n != np.uint64(0):
        whole_part = eight_digits(digits << (_64 - (n << _THREE)))
    p += int(np.int64(n)) + 1
    digits = word_at(buf, p) ^ _ZEROS
    others = ((digits + _ABOVE_NINE) | digits) & _HIGH_BITS
    count = trailing_zeros(others) >> _THREE
    if count == _EIGHT or count == np.uint64(0):
        return 0.0, -1
    fraction = eight_digits(digits << (_64 - (count << _THREE)))
    k: Any = np.int64(count)
    value = float(whole_part * _WHOLE_POWERS[k] + fraction) / _POWERS[k]
    return (-value if negative else value), p + k


@kernel(allocates=False)
def may_be_mark(buf: Any, p: int) -> bool:
    """Return whether a comment (p: after its semicolon) may be one that `recall` knows."""
    c = byte_at(buf, p)
    # Users' marks may have a tab or a no-break space (two bytes) before them.
    while c == 59 or c > 127 or (c <= 32 and c != 10):
        p += 1
        c = byte_at(buf, p)
    return bool(_MARKS[(c & 31) << 5 | byte_at(buf, p + 1) & 31])


@kernel(allocates=False)
def line_end(buf: Any, p: int) -> int:
    """Return the position of the newline at or after p."""
    while True:
        other = word_at(buf, p) ^ _NEWLINES
        found = (other - _LOW_BITS) & ~other & _HIGH_BITS
        if found != np.uint64(0):
            return int(p + np.int64(trailing_zeros(found) >> _THREE))
        p += 8


@kernel(allocates=False)
def _whole_number(buf: Any, p: int) -> Any:
    """Read the number of a command; return where it ends (or -1) and the number, below 1000."""
    number = 0
    digits = 0
    c = byte_at(buf, p)
    while 48 <= c <= 57 and digits < 4:
        number = number * 10 + (c - 48)
        digits += 1
        p += 1
        c = byte_at(buf, p)
    good = 0 < digits < 4 and (c <= 32 or c == 59) and byte_at(buf, p - digits) != 48
    return (p if good else -1), number


@kernel(allocates=False)
def _end_of_words(buf: Any, p: int) -> int:
    """Find the end of simple words (no G, no M, no text); -1 where there are others."""
    c = byte_at(buf, p)
    while c != 10 and c != 59:
        letter = c | 32
        if c > 90 or letter == 103 or letter == 109 or 33 <= c <= 42:
            return -1
        p += 1
        c = byte_at(buf, p)
    return p


@kernel(force_inline=True, allocates=False)
def plain(buf: Any, stop: int, f: Any, i: Any, rows: Any, m_words: Any) -> None:
    """Read plain lines from I_POS on; stop before the first one that is not plain."""
    if f[F_UNIT_MM] != 1.0 or f[F_UNIT_E_MM] != 1.0 or i[I_HOLD]:
        return
    pos, line, offset = i[I_POS], i[I_LINE], i[I_OFFSET]
    n, m, total = i[I_MOVES], i[I_EVENTS], i[I_TOTAL_MOVES]
    real, whole, tiny = rows.real, rows.whole, rows.tiny
    room = whole.shape[1]
    last_x, last_y, last_z, last_e = f[F_LAST], f[F_LAST + 1], f[F_LAST + 2], f[F_LAST + 3]
    tool_x, tool_y, tool_z, tool_e = f[F_TOOL], f[F_TOOL + 1], f[F_TOOL + 2], f[F_TOOL + 3]
    base_x, base_y, base_z, base_e = f[F_BASE], f[F_BASE + 1], f[F_BASE + 2], f[F_BASE + 3]
    speed, speed_factor, factor = f[F_SPEED], f[F_SPEED_FACTOR], f[F_EXTRUDE_FACTOR]
    absolute, absolute_e = i[I_ABS_XYZ] != 0, extruder_is_absolute(i)
    glued, repeated = i[I_EXPONENTS] == 0, i[I_FIRST_WINS] == 0
    alone = i[I_AXES_FACTORS] == 0 or (factor == 1.0 and speed_factor * 60.0 == 1.0)
    longest = i[I_LONGEST]
    # Axes that a coordinate would make known are not plain, nor is what leaves the travel.
    news = i[I_ORIGIN_KNOWN] & ~i[I_KNOWN] if absolute else 0
    low_x, low_y, low_z = -MAX_VALUE, -MAX_VALUE, -MAX_VALUE
    high_x, high_y, high_z = MAX_VALUE, MAX_VALUE, MAX_VALUE
    if i[I_STRICT] and i[I_KNOWN] & 1:
        low_x, high_x = max(f[F_LOW], low_x), min(f[F_HIGH], high_x)
    if i[I_STRICT] and i[I_KNOWN] & 2:
        low_y, high_y = max(f[F_LOW + 1], low_y), min(f[F_HIGH + 1], high_y)
    if i[I_STRICT] and i[I_KNOWN] & 4:
        low_z, high_z = max(f[F_LOW + 2], low_z), min(f[F_HIGH + 2], high_z)
    moved = False
    while pos < stop and n < room and m < room:
        p = pos
        c = byte_at(buf, p)
        kind = _HARMLESS
        if c == 71:
            c = byte_at(buf, p + 1)
            if (c != 49 and c != 48) or byte_at(buf, p + 2) != 32:
                break
            p += 3
            mask = 0
            good = True
            x, y, z, e, feed = 0.0, 0.0, 0.0, 0.0, 0.0
            code_end = p
            while True:
                c = byte_at(buf, p)
                while c == 32:
                    p += 1
                    c = byte_at(buf, p)
                code_end = p
                if c < 65:
                    if c == 10:
                        break
                    if c == 59:
                        p = line_end(buf, p)
                        break
                    if c == 13 and byte_at(buf, p + 1) == 10:
                        p += 1
                        break
                    good = False
                    break
                value, p_behind = decimal(buf, p + 1)
                if p_behind < 0:
                    good = False
                    break
                if c == 88:
                    bit = 1
                    x = value
                elif c == 89:
                    bit = 2
                    y = value
                elif c == 69:
                    bit = 8
                    e = value
                    if not glued and byte_at(buf, p - 1) != 32:
                        good = False
                        break
                elif c == 70:
                    bit = 16
                    feed = value
                elif c == 90:
                    bit = 4
                    z = value
                else:
                    good = False
                    break
                if not repeated and mask & bit:
                    good = False
                    break
                mask |= bit
                p = p_behind
            if not good or code_end - pos > longest or mask & 7 & news:
                break
            if mask & 7 == 0 and not alone:
                break
            new_speed = speed
            if mask & 16:
                if not 0.0 < feed <= MAX_VALUE:
                    break
                new_speed = feed * speed_factor
            if new_speed < MIN_SPEED_MM_S:
                break
            moved = True
            if mask & 15:
                new_x, new_y, new_z, new_e = last_x, last_y, last_z, last_e
                if mask & 1:
                    new_x = x + base_x if absolute else last_x + x
                if mask & 2:
                    new_y = y + base_y if absolute else last_y + y
                if mask & 4:
                    new_z = z + base_z if absolute else last_z + z
                if mask & 8:
                    length = e * factor
                    new_e = length + base_e if absolute_e else last_e + length
                dx, dy, dz = new_x - tool_x, new_y - tool_y, new_z - tool_z
                moving = dx * dx + dy * dy + dz * dz >= _SMALLEST_SQUARED
                if not moving and new_e == tool_e:
                    break
                if not (
                    low_x <= new_x <= high_x
                    and low_y <= new_y <= high_y
                    and low_z <= new_z <= high_z
                    and -MAX_VALUE <= new_e <= MAX_VALUE
                ):
                    break
                speed = new_speed
                last_x, last_y, last_z, last_e = new_x, new_y, new_z, new_e
                if moving:
                    tool_x, tool_y, tool_z = new_x, new_y, new_z
                tool_e = new_e
                at = 4 * (n + 1)
                real[at] = tool_x
                real[at + 1] = tool_y
                real[at + 2] = tool_z
                real[at + 3] = tool_e
                real[8 * room + 4 + n] = speed
                whole[M_LINE, n] = line
                whole[M_START, n] = offset + pos
                pos = min(p + 1, stop)
                whole[M_STOP, n] = offset + pos
                n += 1
                total += 1
                line += 1
                continue
            speed = new_speed
            kind = _MODE
        elif c == 77:
            # A command that does nothing to the motion, and holds neither text nor another one.
            p, number = _whole_number(buf, p + 1)
            if p < 0 or m_words[number] != _HARMLESS:
                break
            p = _end_of_words(buf, p)
            if p < 0 or p - pos > longest:
                break
            p = line_end(buf, p)
        elif c == 59:
            if may_be_mark(buf, p + 1):
                break
            p = line_end(buf, p)
        elif c != 10:
            break
        tiny[E_KIND, m] = kind
        whole[E_MOVE, m] = total
        whole[E_LINE, m] = line
        whole[E_START, m] = offset + pos
        pos = min(p + 1, stop)
        whole[E_STOP, m] = offset + pos
        m += 1
        line += 1
    i[I_POS], i[I_LINE] = pos, line
    i[I_MOVES], i[I_EVENTS], i[I_TOTAL_MOVES] = n, m, total
    f[F_LAST], f[F_LAST + 1], f[F_LAST + 2], f[F_LAST + 3] = last_x, last_y, last_z, last_e
    f[F_TOOL], f[F_TOOL + 1], f[F_TOOL + 2], f[F_TOOL + 3] = tool_x, tool_y, tool_z, tool_e
    f[F_SPEED] = speed
    if moved:
        i[I_MOTION] = 1
