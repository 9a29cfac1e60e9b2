"""Kernels of straight moves: G0 and G1, and the move shared by all commands.

Sources: Klipper klippy/extras/gcode_move.py, 2026-08; Marlin Marlin/src/gcode/gcode.cpp
(get_destination_from_command), bugfix-2.1.x of 2024; RepRapFirmware src/GCodes/GCodes.cpp
(DoStraightMove, LoadExtrusionFromGCode), 3.6.
"""

from __future__ import annotations

from math import fabs
from typing import Any

from stillpath.gcode._slots import (
    DONE,
    ERROR_FEED,
    ERROR_RANGE,
    ERROR_SLOW,
    ERROR_TRAVEL,
    F_BASE,
    F_ERROR,
    F_EXTRUDE_FACTOR,
    F_HIGH,
    F_LAST,
    F_LOW,
    F_SPEED,
    F_SPEED_FACTOR,
    F_TOOL,
    F_UNIT_E_MM,
    F_UNIT_MM,
    I_ABS_E,
    I_ABS_XYZ,
    I_AXES_FACTORS,
    I_E_RULE,
    I_END,
    I_ERROR_AXIS,
    I_KNOWN,
    I_LINE,
    I_MOVES,
    I_OFFSET,
    I_ORIGIN_KNOWN,
    I_POS,
    I_STRICT,
    I_TOTAL_MOVES,
    I_ZERO_FEED,
    M_LINE,
    M_START,
    M_STOP,
    MAX_VALUE,
    MIN_SPEED_MM_S,
    OK,
    SMALLEST_MOVE_MM,
)
from stillpath.gcode._table_kernels import put_event, settle
from stillpath.models.jit import kernel

_MODE, _UNKNOWN = 1, 4
_X, _E, _F = 23, 4, 5


@kernel(allocates=False)
def travel(
    f: Any,
    i: Any,
    named: int,
    trusted: bool,
    rows: Any,
) -> int:
    """Send the tool to F_LAST; write a move unless nothing moves.

    Parameters
    ----------
    named : int
        Bit per axis named by an absolute coordinate.
    trusted : bool
        False marks the row as unknown on all axes: its line does more than move.

    Returns
    -------
    int
        OK for a move, DONE for none, else an error.
    """
    before = i[I_KNOWN]
    after = before | named
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
    moving = dx * dx + dy * dy + dz * dz >= SMALLEST_MOVE_MM * SMALLEST_MOVE_MM
    if not moving and de == 0.0:
        if after != before:
            settle(f, i, rows)
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
    if not trusted:
        settle(f, i, rows)
        i[I_KNOWN] = 0
    n = i[I_MOVES]
    real, room = rows.real, rows.whole.shape[1]
    for k in range(4):
        if moving or k == 3:
            f[F_TOOL + k] = f[F_LAST + k]
        real[4 * (n + 1) + k] = f[F_TOOL + k]
    real[8 * room + 4 + n] = f[F_SPEED]
    rows.whole[M_LINE, n] = i[I_LINE]
    rows.whole[M_START, n] = i[I_OFFSET] + i[I_POS]
    rows.whole[M_STOP, n] = i[I_OFFSET] + i[I_END]
    i[I_MOVES] = n + 1
    i[I_TOTAL_MOVES] += 1
    if after != i[I_KNOWN]:
        # A row holds what was known at both of its ends.
        settle(f, i, rows)
        i[I_KNOWN] = after
    return OK


@kernel(allocates=False)
def set_feed(f: Any, i: Any, feed: float) -> int:
    """Take the F of a line."""
    if feed <= 0.0 and i[I_ZERO_FEED]:
        return OK
    if not 0.0 < feed <= MAX_VALUE:
        f[F_ERROR] = feed
        return ERROR_FEED
    f[F_SPEED] = feed * f[F_UNIT_MM] * f[F_SPEED_FACTOR]
    return OK


@kernel(allocates=False)
def extruder_is_absolute(i: Any) -> bool:
    """Return whether E is absolute."""
    return bool(i[I_ABS_E] != 0 and (i[I_E_RULE] != 0 or i[I_ABS_XYZ] != 0))


@kernel(allocates=False)
def move(
    w: Any,
    mask: int,
    f: Any,
    i: Any,
    rows: Any,
) -> int:
    """G0 and G1."""
    if mask & (1 << _F):
        status = set_feed(f, i, w[_F])
        if status != OK:
            return status
    named = 0
    for k in range(3):
        if mask & (1 << (_X + k)):
            if i[I_ABS_XYZ]:
                f[F_LAST + k] = w[_X + k] * f[F_UNIT_MM] + f[F_BASE + k]
                named |= 1 << k
            else:
                f[F_LAST + k] += w[_X + k] * f[F_UNIT_MM]
    axes = mask & (7 << _X)
    normal_mm_s = f[F_SPEED]
    if mask & (1 << _E):
        length = w[_E] * f[F_UNIT_E_MM]
        scaled = length * f[F_EXTRUDE_FACTOR]
        absolute = extruder_is_absolute(i)
        unscaled = f[F_EXTRUDE_FACTOR] == 1.0 and f[F_SPEED_FACTOR] * 60.0 == 1.0
        if i[I_AXES_FACTORS] and axes == 0 and not unscaled:
            # Only the extruder moves: M220 and M221 do not apply.
            at = (f[F_LAST + 3] - f[F_BASE + 3]) / f[F_EXTRUDE_FACTOR]
            f[F_LAST + 3] += length - at if absolute else length
            if f[F_EXTRUDE_FACTOR] != 1.0:
                settle(f, i, rows)
                reads = length if absolute else at + length
                f[F_BASE + 3] = f[F_LAST + 3] - reads * f[F_EXTRUDE_FACTOR]
            f[F_SPEED] = f[F_SPEED] / (f[F_SPEED_FACTOR] * 60.0)
        elif absolute:
            f[F_LAST + 3] = scaled + f[F_BASE + 3]
        else:
            f[F_LAST + 3] += scaled
    # A coordinate equal to the guessed position may still move the axis.
    guessed = named & ~i[I_KNOWN]
    status = travel(f, i, named & i[I_ORIGIN_KNOWN], True, rows)
    f[F_SPEED] = normal_mm_s
    if status == DONE:
        put_event(i, rows, _UNKNOWN if guessed else _MODE)
        return OK
    return status
