"""Kernel of the classic commands: moves, dwells, modes, origins and factors."""

from __future__ import annotations

from math import fabs
from typing import Any

from stillpath.gcode._arc_kernels import arc, curve
from stillpath.gcode._motion_kernels import move
from stillpath.gcode._slots import (
    ERROR_INCHES,
    ERROR_POSITIVE,
    ERROR_RANGE,
    F_BASE,
    F_ERROR,
    F_EXTRUDE_FACTOR,
    F_LAST,
    F_SPEED,
    F_SPEED_FACTOR,
    F_TOOL,
    F_UNIT_E_MM,
    F_UNIT_MM,
    I_ABS_E,
    I_ABS_XYZ,
    I_DWELL_RULE,
    I_E_RULE,
    I_ERROR_AXIS,
    I_EVENTS,
    I_FACTOR_DEFAULT,
    I_KNOWN,
    I_MACROS,
    I_ORIGIN_KNOWN,
    I_ORIGIN_RULE,
    I_PLANE,
    MAX_VALUE,
    MIN_VALUE,
    OK,
    Action,
)
from stillpath.gcode._table_kernels import note_modal, put_event, settle
from stillpath.models.jit import kernel

_HARMLESS, _MODE, _STOP, _UNKNOWN, _STATE = 0, 1, 3, 4, 8
_X, _E, _P, _S = 23, 4, 15, 18
# Compiled code takes plain numbers.
_MOVE, _ARC_CW, _ARC_CCW, _CURVE = (
    int(a) for a in (Action.MOVE, Action.ARC_CW, Action.ARC_CCW, Action.CURVE)
)
_DWELL, _SET_POSITION = int(Action.DWELL), int(Action.SET_POSITION)
_PLANE_XY, _PLANE_YZ = int(Action.PLANE_XY), int(Action.PLANE_YZ)
_INCHES, _MILLIMETRES = int(Action.INCHES), int(Action.MILLIMETRES)
_ABSOLUTE, _RELATIVE = int(Action.ABSOLUTE), int(Action.RELATIVE)
_ABSOLUTE_E, _RELATIVE_E = int(Action.ABSOLUTE_E), int(Action.RELATIVE_E)
_SPEED_FACTOR, _EXTRUDE_FACTOR = int(Action.SPEED_FACTOR), int(Action.EXTRUDE_FACTOR)
_MARLIN_E = 1
_P_ONLY, _OR_NOTHING = 0, 2
_BARE_IS_ZERO, _OFFSET, _POSITION = 0, 1, 2


@kernel(allocates=False)
def execute(action: int, w: Any, mask: int, f: Any, i: Any, rows: Any, tables: Any) -> int:
    """Execute one command of the kernel's table; write its move or event.

    Parameters
    ----------
    action : int
        An `Action`, or the `EventKind` of a line that only leaves its event.
    w, mask : ndarray of 26 floats, int
        Values of the words A to Z and which of them are present.
    f, i : ndarray
        The state (`gcode._slots`).
    rows, tables
        Where moves and events are written; the tables of the dialect (`gcode._table_kernels`).
    """
    if action < _MOVE:  # an `EventKind`
        if action == _UNKNOWN:
            settle(f, i, rows)
            i[I_KNOWN] = 0
            i[I_MACROS] += 1
        put_event(i, rows, action)
        return OK
    if action == _MOVE:
        return move(w, mask, f, i, rows)
    if action in (_ARC_CW, _ARC_CCW):
        return arc(action == _ARC_CW, w, mask, f, i, rows)
    if action == _CURVE:
        return curve(w, mask, f, i, rows)
    if action == _DWELL:
        return _dwell(w, mask, f, i, rows)
    settle(f, i, rows)
    kind = _MODE
    if _PLANE_XY <= action <= _PLANE_YZ:
        i[I_PLANE] = action - _PLANE_XY
    elif action in (_INCHES, _MILLIMETRES):
        unit_mm = 25.4 if action == _INCHES else 1.0
        if f[F_UNIT_MM] != unit_mm:
            kind = _STATE
        if f[F_UNIT_E_MM] == f[F_UNIT_MM]:
            f[F_UNIT_E_MM] = unit_mm
        else:  # in cubic mm or inches (M200)
            f[F_UNIT_E_MM] *= (unit_mm / f[F_UNIT_MM]) ** 3
        f[F_UNIT_MM] = unit_mm
    elif action in (_ABSOLUTE, _RELATIVE):
        i[I_ABS_XYZ] = 1 if action == _ABSOLUTE else 0
        if i[I_E_RULE] == _MARLIN_E:
            i[I_ABS_E] = i[I_ABS_XYZ]
    elif action in (_ABSOLUTE_E, _RELATIVE_E):
        i[I_ABS_E] = 1 if action == _ABSOLUTE_E else 0
    elif action == _SET_POSITION:
        return _set_position(w, mask, f, i, rows, tables)
    elif action in (_SPEED_FACTOR, _EXTRUDE_FACTOR):
        if mask & (1 << _S) or i[I_FACTOR_DEFAULT]:
            percent = w[_S] if mask & (1 << _S) else 100.0
            f[F_ERROR] = percent
            if not MIN_VALUE <= percent <= MAX_VALUE:
                return ERROR_POSITIVE
            if action == _SPEED_FACTOR:
                factor = percent / (60.0 * 100.0)
                f[F_SPEED] = f[F_SPEED] / f[F_SPEED_FACTOR] * factor
                f[F_SPEED_FACTOR] = factor
            else:
                factor = percent / 100.0
                e_value = (f[F_LAST + 3] - f[F_BASE + 3]) / f[F_EXTRUDE_FACTOR]
                f[F_BASE + 3] = f[F_LAST + 3] - e_value * factor
                f[F_EXTRUDE_FACTOR] = factor
    else:
        return ERROR_INCHES
    note_modal(f, i, tables)
    put_event(i, rows, kind)
    return OK


@kernel(allocates=False)
def _dwell(w: Any, mask: int, f: Any, i: Any, rows: Any) -> int:
    """G4: every firmware comes to rest first."""
    seconds = 0.0
    given = False
    if mask & (1 << _S) and i[I_DWELL_RULE] != _P_ONLY:
        seconds = w[_S]
        given = True
    elif mask & (1 << _P):
        seconds = w[_P] / 1000.0
        given = True
    if not 0.0 <= seconds <= MAX_VALUE:
        f[F_ERROR] = w[_S] if mask & (1 << _S) and i[I_DWELL_RULE] != _P_ONLY else w[_P]
        return ERROR_POSITIVE
    if i[I_DWELL_RULE] == _OR_NOTHING and not given:
        put_event(i, rows, _HARMLESS)
        return OK
    settle(f, i, rows)
    put_event(i, rows, _STOP)
    settle(f, i, rows)
    rows.real[9 * rows.whole.shape[1] + 4 + i[I_EVENTS] - 1] = seconds
    return OK


@kernel(allocates=False)
def _set_position(w: Any, mask: int, f: Any, i: Any, rows: Any, tables: Any) -> int:
    """G92; the rows before it are settled."""
    rule = i[I_ORIGIN_RULE]
    any_axis = False
    places = False
    for k in range(4):
        letter = _X + k if k < 3 else _E
        if not mask & (1 << letter):
            continue
        any_axis = True
        value = w[letter] * (f[F_UNIT_E_MM] * f[F_EXTRUDE_FACTOR] if k == 3 else f[F_UNIT_MM])
        if not fabs(value) <= MAX_VALUE:
            i[I_ERROR_AXIS] = k
            f[F_ERROR] = w[letter]
            f[F_ERROR + 1] = MAX_VALUE
            return ERROR_RANGE
        if rule == _POSITION and k < 3:
            f[F_LAST + k] = f[F_TOOL + k] = value + f[F_BASE + k]
            if f[F_BASE + k] != 0.0:  # a workspace, which it passes over, or a hop
                i[I_KNOWN] &= ~(1 << k)
            places = True
            continue
        f[F_BASE + k] = f[F_LAST + k] - value
        # An origin set from a guessed position is a guess.
        i[I_ORIGIN_KNOWN] &= ~(1 << k) | i[I_KNOWN]
        i[I_ORIGIN_KNOWN] |= (1 << k) & i[I_KNOWN]
    if not any_axis and rule == _BARE_IS_ZERO:
        for k in range(4):
            f[F_BASE + k] = f[F_LAST + k]
        i[I_ORIGIN_KNOWN] = i[I_KNOWN]
    if places:
        settle(f, i, rows)  # the machine did not get here along a path
    note_modal(f, i, tables)
    put_event(i, rows, _UNKNOWN if places else _MODE)
    return OK
