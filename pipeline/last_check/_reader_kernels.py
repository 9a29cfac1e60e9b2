"""Kernels of the last check's reader for plain lines such as ``G1 X10.5 Y-3 E.02 F1800``.

A state is an array of `SIZE` floats; nan means unknown. Text ends with a newline.
"""

from __future__ import annotations

from math import atan2, fabs, isnan, nan, sqrt
from typing import Any

import numpy as np

from stillpath.models.jit import kernel

__all__ = [
    "carry_out_moves",
    "compare",
    "compare_moves",
    "may_be_no_arc",
    "move",
    "ours",
    "settle",
    "way_xy_mm",
]

X, Y, Z, E, FED, F, UNIT, RELATIVE, RELATIVE_E, WAITS, SIZE = range(11)
"""Indices of a state: x y z, E, filament fed since the beginning [mm]; F [mm/min]; the file's unit
[mm]; 1 where coordinates, or those of E, are relative; 1 after a move of X and Y so short that the
firmware may execute it with the next one."""
WORD_COUNT = 7
"""X Y Z E F, and I J for arcs."""
SAME, PLACE, FILAMENT, FEED, MODES = -1, 0, 4, 5, 7
"""Results of `compare`: nothing, or the first number of a state that differs."""
WORDS, WITHIN = 15, 32
"""Bits in the mask of `compare`: words of a move, and whether it lies within a stream."""

_POWERS = 10.0 ** np.arange(16)
_LONGEST = 90
"""Marlin's buffer takes 95 characters."""
_LEAST_ARC_MM = 0.01
_FEED_MM_MIN, _FEED_SHARE = 1e-4, 2e-6


@kernel(force_inline=True, allocates=False)
def _words(text: Any, at: int, words: Any, arcs: bool) -> tuple[int, int]:
    """Parse a plain G0 or G1; return where the next line begins, or -1, and the mask of its words.

    Bits 0 to 4 of the mask: X Y Z E F. Words are separated by blanks and have plain numbers.
    With `arcs`, G2 and G3 with a centre are parsed too (bits 5 and 6: I J).
    """
    mask = 0
    number = text[at + 1] - 48
    if text[at] != 71 or number < 0 or number > (3 if arcs else 1):
        return -1, mask
    p = at + 2
    while True:
        c = text[p]
        if c == 10:
            break
        if c == 13 and text[p + 1] == 10:
            p += 1
            break
        if c != 32:
            return -1, mask
        while c == 32:
            p += 1
            c = text[p]
        if c == 59:  # ; a comment
            while text[p] != 10:
                p += 1
            break
        word = 3 if c == 69 else 4 if c == 70 else c - 88
        if c == 73 or c == 74:
            word = c - 68 if number > 1 else -1
        if word < 0 or word > 6 or (c >= 88 and word > 2) or mask >> word & 1:
            return -1, mask
        p += 1
        negative = text[p] == 45
        if negative:
            p += 1
        digits, mantissa, fraction = 0, 0, 0
        while 48 <= text[p] <= 57 and digits < 16:
            mantissa = 10 * mantissa + (text[p] - 48)
            digits += 1
            p += 1
        if text[p] == 46:
            p += 1
            while 48 <= text[p] <= 57 and digits < 16:
                mantissa = 10 * mantissa + (text[p] - 48)
                digits += 1
                fraction += 1
                p += 1
        # Up to 15 digits the quotient of two exact doubles is the nearest double.
        if digits == 0 or digits > 15:
            return -1, mask
        value = mantissa / _POWERS[fraction]
        words[word] = -value if negative else value
        mask |= 1 << word
    if p - at > _LONGEST or (mask & 16 and words[4] <= 0.0):
        return -1, mask
    if number > 1 and not (mask & 32 and words[5] != 0.0) and not (mask & 64 and words[6] != 0.0):
        return -1, mask
    return p + 1, mask


@kernel(force_inline=True, allocates=False)
def _comments(text: Any, at: int, stop: int, marks: bool) -> tuple[int, int]:
    """Skip empty lines and comments; return where the next line begins, and how many were skipped.

    With `marks`, a comment that may be a mark of ours is not skipped.
    """
    lines = 0
    while at < stop:
        if text[at] == 59:
            if marks and text[at + 1] == 32 and text[at + 2] == 115:  # "; s"
                break
        elif text[at] != 10:
            break
        while text[at] != 10:
            at += 1
        at += 1
        lines += 1
    return at, lines


@kernel(force_inline=True, allocates=False)
def way_xy_mm(state: Any, words: Any, mask: int) -> float:
    """Return the length of a move in X and Y [mm]; nan if unknown."""
    squares = 0.0
    for axis in range(2):
        if mask >> axis & 1:
            way = words[axis] * state[UNIT]
            if state[RELATIVE] != 1.0:
                way = way - state[axis] if state[RELATIVE] == 0.0 else nan
            elif isnan(state[axis]):
                way = nan
            squares += way * way
    return sqrt(squares)


@kernel(force_inline=True, allocates=False)
def move(state: Any, words: Any, mask: int) -> None:
    """Update the state by a move."""
    for axis in range(3):
        if mask >> axis & 1:
            value = words[axis] * state[UNIT]
            state[axis] = value if state[RELATIVE] == 0.0 else value + state[axis]
            if isnan(state[RELATIVE]):
                state[axis] = nan
    if mask & 8:
        value = words[3] * state[UNIT]
        if state[RELATIVE_E] == 1.0:
            state[FED] += value
            state[E] += value
        elif state[RELATIVE_E] == 0.0:
            state[FED] += value - state[E]
            state[E] = value
        else:
            state[FED] = state[E] = nan
    if mask & 16:
        state[F] = words[4] * state[UNIT]


@kernel(force_inline=True, allocates=False)
def may_be_no_arc(state: Any, words: Any, mask: int) -> bool:
    """Return whether a firmware may treat an arc with a centre as one of zero length and skip it.

    That is so if its end lies in the same direction from the centre as its start, but elsewhere.
    """
    i_mm = words[5] * state[UNIT] if mask & 32 else 0.0
    j_mm = words[6] * state[UNIT] if mask & 64 else 0.0
    x_mm = words[0] * state[UNIT] if mask & 1 else 0.0
    y_mm = words[1] * state[UNIT] if mask & 2 else 0.0
    if state[RELATIVE] != 1.0:
        x_mm -= state[X] if mask & 1 else 0.0
        y_mm -= state[Y] if mask & 2 else 0.0
    cross = j_mm * (x_mm - i_mm) - i_mm * (y_mm - j_mm)
    dot = -i_mm * (x_mm - i_mm) - j_mm * (y_mm - j_mm)
    if x_mm == 0.0 and y_mm == 0.0:
        return False  # a whole circle
    return not sqrt(i_mm * i_mm + j_mm * j_mm) * atan2(fabs(cross), dot) > _LEAST_ARC_MM


@kernel(force_inline=True, allocates=False)
def settle(state: Any, way_mm: float, shortest_mm: float, z_mm: float, fed_mm: float) -> None:
    """Note after a move whether it is still pending, given Z and filament before it.

    A pending move is executed with the next one that is long enough in any axis.
    """
    waits = state[WAITS] == 1.0 if way_mm == 0.0 else way_mm <= shortest_mm
    others_mm, more_mm = fabs(state[Z] - z_mm), fabs(state[FED] - fed_mm)
    if more_mm > others_mm:
        others_mm = more_mm
    state[WAITS] = 1.0 if waits and not others_mm > shortest_mm else 0.0


@kernel(allocates=False)
def compare(one: Any, other: Any, mask: int, place_mm: Any, filament_mm: float) -> int:
    """Compare two states; values unknown in either are skipped.

    Parameters
    ----------
    one, other : float array
        Of the original and of the written file. Where either does not know the filament, counting
        restarts.
    mask : int
        Words of the move just made; 0: no move, and F is not compared. With `WITHIN`: in a stream,
        where E is corrected only before lines that depend on it.
    place_mm : float array, shape (3,)
    filament_mm : float
        Tolerances.
    """
    for axis in range(3):
        if fabs(one[axis] - other[axis]) > place_mm[axis]:
            return PLACE + axis
    if isnan(one[FED]) or isnan(other[FED]):
        one[FED] = other[FED] = 0.0
    elif fabs(one[FED] - other[FED]) > filament_mm:
        return FILAMENT
    if fabs(one[RELATIVE] - other[RELATIVE]) > 0.0:
        return MODES
    if fabs(one[RELATIVE_E] - other[RELATIVE_E]) > 0.0:
        return MODES + 1
    if not mask & WITHIN and one[RELATIVE_E] == 0.0 and fabs(one[E] - other[E]) > filament_mm:
        return E
    if mask & WORDS and fabs(one[F] - other[F]) > _FEED_MM_MIN + _FEED_SHARE * fabs(one[F]):
        return FEED
    return SAME


@kernel(allocates=False)
def compare_before(before: Any, after: Any, state: Any, place_mm: Any, filament_mm: float) -> int:
    """Compare the state before a line of a stream with the original's.

    If filament counting restarts before the line, it does so after it too.
    """
    if isnan(before[FED]) or isnan(state[FED]):
        after[FED] = nan
    return compare(before, state, WITHIN, place_mm, filament_mm)


@kernel(allocates=False)
def ours(
    text: Any,
    at: int,
    stop: int,
    state: Any,
    words: Any,
    wanted: Any,
    rests: bool,
    in_doubt: bool,
    before: Any,
    after: Any,
    place_mm: Any,
    filament_mm: float,
) -> tuple[int, int, bool, int]:
    """Execute plain moves of a stream up to the awaited line, or to one that is not plain.

    Parameters
    ----------
    text : uint8 array
    at, stop : int
        Where to begin, and after the last newline.
    state, words : float array
    wanted : uint8 array
        The awaited line of the original without blanks at its end; may be empty. Executed if plain.
    rests : bool
        Compare the states before and after it with those of the original.
    in_doubt : bool
        Stop at lines that do not move X or Y, too: one may be the line after the awaited one.
    before, after : float array
        States of the original.
    place_mm, filament_mm
        As of `compare`.

    Returns
    -------
    (int, int, bool, int)
        Where the next line begins, how many lines were executed, whether the last was the awaited
        one, and what differs there.
    """
    lines = 0
    length = len(wanted)
    while at < stop:
        at, passed = _comments(text, at, stop, True)
        lines += passed
        if at >= stop:
            break
        is_wanted = False
        if length:
            k = 0
            while k < length and text[at + k] == wanted[k]:
                k += 1
            if k == length:
                while text[at + k] == 32 or (9 <= text[at + k] <= 13 and text[at + k] != 10):
                    k += 1
                is_wanted = text[at + k] == 10
        next_at, mask = _words(text, at, words, False)
        if next_at < 0:
            break
        if in_doubt and not is_wanted and way_xy_mm(state, words, mask) == 0.0:
            break
        if is_wanted and rests:
            found = compare_before(before, after, state, place_mm, filament_mm)
            if found != SAME:
                return at, lines, True, found
        move(state, words, mask)
        at = next_at
        lines += 1
        if is_wanted:
            found = SAME
            if rests:
                found = compare(after, state, mask | WITHIN, place_mm, filament_mm)
            return at, lines, True, found
    return at, lines, False, SAME


@kernel(allocates=False)
def carry_out_moves(
    text: Any,
    at: int,
    stop: int,
    most: int,
    shortest_mm: float,
    arcs: bool,
    divides_extruder: bool,
    state: Any,
    words: Any,
    before: Any,
    perhaps: Any,
) -> tuple[int, int, int, int]:
    """Execute plain moves of the original that may move X or Y, and the next that does not.

    Parameters
    ----------
    text, at, stop, state, words
        As of `ours`.
    most : int
        Largest number of lines.
    shortest_mm : float
        A move that is no longer than this in X and Y may be joined with the next one.
    arcs, divides_extruder : bool
        Arcs in the plane of X and Y are plain moves, and give each of their pieces a part of E.
    before : float array
        Receives the state before the line that does not move X or Y.
    perhaps : int array
        Receives the offsets of lines that may or may not move X or Y; its size is the limit.

    Returns
    -------
    (int, int, int, int)
        Where the next line begins, how many lines were executed, the words of the last if it does
        not move X or Y (else -1), and the count in `perhaps`.
    """
    lines, found = 0, 0
    while at < stop and lines < most and found < len(perhaps):
        if text[at] == 59 or text[at] == 10:
            while text[at] != 10:
                at += 1
            at += 1
            lines += 1
            continue
        next_at, mask = _words(text, at, words, arcs)
        if next_at < 0:
            break
        lines += 1
        if mask > 31:
            if not divides_extruder and may_be_no_arc(state, words, mask):
                lines -= 1
                break
            move(state, words, mask)
            if divides_extruder and mask & 8 and state[RELATIVE_E] != 1.0:
                state[E] = state[FED] = nan
            perhaps[found] = at
            found += 1
            at = next_at
            continue
        way_mm = way_xy_mm(state, words, mask)
        if way_mm == 0.0 and (state[WAITS] == 0.0 or not mask & WORDS):
            for k in range(SIZE):
                before[k] = state[k]
            move(state, words, mask)
            return next_at, lines, mask, found
        if way_mm > shortest_mm:
            state[WAITS] = 0.0
            move(state, words, mask)
        else:
            z_mm, fed_mm = state[Z], state[FED]
            move(state, words, mask)
            settle(state, way_mm, shortest_mm, z_mm, fed_mm)
            perhaps[found] = at
            found += 1
        at = next_at
    return at, lines, -1, found


@kernel(allocates=False)
def compare_moves(
    before: Any,
    at: int,
    stop: int,
    after: Any,
    written_at: int,
    written_stop: int,
    one: Any,
    other: Any,
    words: Any,
    place_mm: Any,
    filament_mm: float,
) -> tuple[int, int, int, int, int, int, int, int]:
    """Execute plain moves that both texts share, and compare the states after each.

    Parameters
    ----------
    before, at, stop : uint8 array, int, int
        Text of the original.
    after, written_at, written_stop : uint8 array, int, int
        Text of the written file.
    one, other : float array
        Their states.
    words, place_mm, filament_mm
        As of `compare`.

    Returns
    -------
    (int, int, int, int, int, int, int, int)
        Where both texts go on, how many lines of each were read, how many moves were executed, how
        many of these with X and Y unknown, how many lines precede the first with them known, and
        what differs after the last.
    """
    lines, written_lines, moves, unknown, before_known = 0, 0, 0, 0, -1
    while True:
        at, passed = _comments(before, at, stop, False)
        written_at, written_passed = _comments(after, written_at, written_stop, True)
        lines += passed
        written_lines += written_passed
        if at >= stop or written_at >= written_stop:
            break
        next_at, mask = _words(before, at, words, False)
        length = next_at - at
        if next_at < 0 or written_at + length > written_stop:
            break
        k = 0
        while k < length and before[at + k] == after[written_at + k]:
            k += 1
        if k < length:
            break
        move(one, words, mask)
        move(other, words, mask)
        at = next_at
        written_at += length
        lines += 1
        written_lines += 1
        moves += 1
        if isnan(one[X] + one[Y] + other[X] + other[Y]):
            unknown += 1
        elif before_known < 0:
            before_known = lines - 1
        found = compare(one, other, mask, place_mm, filament_mm)
        if found != SAME:
            return at, written_at, lines, written_lines, moves, unknown, before_known, found
    return at, written_at, lines, written_lines, moves, unknown, before_known, SAME
