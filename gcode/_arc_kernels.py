"""Kernels of curved moves: G2, G3 and G5, cut into straight pieces as each firmware cuts them.

Sources: Klipper klippy/extras/gcode_arcs.py, 2026-08; Marlin Marlin/src/gcode/motion/G2_G3.cpp,
G5.cpp and Marlin/src/module/planner_bezier.cpp, 2.0.x of 2021 and bugfix-2.1.x of 2024;
RepRapFirmware src/GCodes/GCodes.cpp (DoArcMove), 3.6.
"""

from __future__ import annotations

from math import atan2, ceil, cos, fabs, floor, hypot, pi, sin, sqrt
from typing import Any

import numpy as np

from stillpath.gcode._motion_kernels import extruder_is_absolute, set_feed, travel
from stillpath.gcode._slots import (
    DONE,
    ERROR_ARC_CENTER,
    ERROR_ARC_ENDS,
    ERROR_ARC_LONG,
    ERROR_ARC_RADIUS,
    ERROR_ARC_RELATIVE,
    ERROR_ARC_SAME,
    ERROR_ARC_SHORT,
    ERROR_ARC_TURNS,
    F_ARC_DEVIATION_MM,
    F_ARC_LEAST_MM,
    F_ARC_MM,
    F_ARC_PER_CIRCLE,
    F_ARC_PER_S,
    F_BASE,
    F_ERROR,
    F_EXTRUDE_FACTOR,
    F_LAST,
    F_SPEED,
    F_UNIT_E_MM,
    F_UNIT_MM,
    FULL,
    I_ABS_XYZ,
    I_ARC_CIRCLES,
    I_ARC_RULE,
    I_MOVES,
    I_NEED,
    I_ORIGIN_KNOWN,
    I_PLANE,
    MAX_ARC_PIECES,
    OK,
)
from stillpath.gcode._table_kernels import put_event
from stillpath.models.jit import kernel

_MODE = 1
_X, _E, _F, _I, _P, _R = 23, 4, 5, 8, 15, 17
_KLIPPER, _MARLIN_2_0, _MARLIN_2_1, _REPRAP = 0, 1, 2, 3
_NEAR_MM = 1e-6  # Marlin's NEAR, planner.h
_RADIUS_TOLERANCE_MM = 0.05  # MaxNonCncRadiusError, RepRapFirmware Configuration.h, 3.6
_MOST_CIRCLES = 100
# Steps of the curve's parameter and tolerance, planner_bezier.cpp.
_CURVE_MIN_STEP, _CURVE_MAX_STEP, _CURVE_SIGMA_MM = 0.002, 0.1, 0.1


@kernel
def arc_pieces(f: Any, rule: int, radius: float, angle: float, rise: float, whole: bool) -> float:
    """Return the number of straight pieces of an arc (a whole number)."""
    flat = radius * fabs(angle)
    if rule <= _MARLIN_2_0:
        length = hypot(flat, rise) if rise != 0.0 else flat
        least = 1.0
        if rule == _MARLIN_2_0:
            least = max(1.0, ceil(f[F_ARC_PER_CIRCLE] * fabs(angle) / (2.0 * pi)))
        return float(max(least, floor(length / f[F_ARC_MM])))
    if rule == _MARLIN_2_1 and f[F_ARC_DEVIATION_MM] == 0.0:
        least = f[F_ARC_PER_CIRCLE]
        if not whole:
            least = ceil(f[F_ARC_PER_CIRCLE] * fabs(angle) / (2.0 * pi))
        longest = f[F_ARC_MM]
        ideal = longest
        if f[F_ARC_PER_S] > 0.0:
            ideal = min(max(f[F_SPEED] / f[F_ARC_PER_S], f[F_ARC_LEAST_MM]), longest)
        pieces = max(floor(flat / ideal), least)
        if flat / pieces > longest:
            return float(ceil(flat / longest))
        if flat / pieces < f[F_ARC_LEAST_MM]:
            return float(max(1.0, floor(flat / f[F_ARC_LEAST_MM])))
        return float(pieces)
    # RepRapFirmware, and Prusa's Buddy after it.
    each = min(sqrt(8.0 * radius * f[F_ARC_DEVIATION_MM]), f[F_SPEED] / f[F_ARC_PER_S])
    each = min(max(each, f[F_ARC_LEAST_MM]), f[F_ARC_MM])
    return float(max(1.0, floor(flat / each + 0.8)))


@kernel
def _center(
    clockwise: bool,
    rule: int,
    w: Any,
    mask: int,
    unit: float,
    a: int,
    b: int,
    here: Any,
    there: Any,
    out: Any,
) -> int:
    """Compute the vector from the start to the centre; return OK or why there is none."""
    out[0] = out[1] = 0.0
    if mask & (1 << _R):
        if rule == _KLIPPER:
            return ERROR_ARC_RADIUS
        r = w[_R] * unit
        # Marlin computes R in X and Y in every plane.
        p = a if rule == _REPRAP else 0
        q = b if rule == _REPRAP else 1
        dp = there[p] - here[p]
        dq = there[q] - here[q]
        chord = hypot(dp, dq)
        if chord == 0.0:
            return ERROR_ARC_SAME if rule == _REPRAP else ERROR_ARC_CENTER
        if r == 0.0 and rule != _REPRAP:
            return ERROR_ARC_CENTER
        h2 = r * r - chord * chord / 4.0
        if h2 < 0.0:
            if rule == _REPRAP and h2 < -0.02 * r * r:
                return ERROR_ARC_SHORT
            h2 = 0.0
        side = sqrt(h2) / chord
        if clockwise == (r >= 0.0):
            side = -side
        out[0] = dp / 2.0 - dq * side
        out[1] = dq / 2.0 + dp * side
        return OK
    if mask & (1 << (_I + a)):
        out[0] = w[_I + a] * unit
    if mask & (1 << (_I + b)):
        out[1] = w[_I + b] * unit
    return ERROR_ARC_CENTER if out[0] == 0.0 and out[1] == 0.0 else OK


@kernel
def _whole_turn(rule: int, angle: float, here: Any, there: Any, a: int, b: int) -> bool:
    """Return whether an arc that ends at its start is a full circle."""
    if rule >= _MARLIN_2_1:  # RepRapFirmware compares 32-bit floats, offsets included
        return fabs(here[a] - there[a]) < _NEAR_MM and fabs(here[b] - there[b]) < _NEAR_MM
    if rule == _MARLIN_2_0:
        near = fabs(here[a] - there[a]) < _NEAR_MM and fabs(here[b] - there[b]) < _NEAR_MM
        return fabs(angle) < _NEAR_MM and near
    return bool(angle == 0.0 and here[a] == there[a] and here[b] == there[b])


@kernel
def arc(
    clockwise: bool,
    w: Any,
    mask: int,
    f: Any,
    i: Any,
    rows: Any,
) -> int:
    """G2 and G3: arcs, helices and circles, cut as the firmware cuts them."""
    rule = i[I_ARC_RULE]
    unit = f[F_UNIT_MM]
    if rule == _KLIPPER and not i[I_ABS_XYZ]:
        return ERROR_ARC_RELATIVE
    here = np.empty(3)
    there = np.empty(3)
    named = 0
    for k in range(3):
        here[k] = f[F_LAST + k] - f[F_BASE + k]
        there[k] = here[k]
        if mask & (1 << (_X + k)):
            if i[I_ABS_XYZ]:
                there[k] = w[_X + k] * unit
                named |= 1 << k
            else:
                there[k] += w[_X + k] * unit
    a, b, c = 0, 1, 2
    if i[I_PLANE] == 1:
        a, b, c = 2, 0, 1
        if rule == _KLIPPER:
            a, b = 0, 2  # the other way round than everybody else
    elif i[I_PLANE] == 2:
        a, b, c = 1, 2, 0
    offset = np.empty(2)
    status = _center(clockwise, rule, w, mask, unit, a, b, here, there, offset)
    if status != OK:
        return status
    off_a, off_b = offset[0], offset[1]
    radius = hypot(off_a, off_b)
    # Angle from the start's radius to the target's, in the direction of the arc.
    center_a = here[a] + off_a
    center_b = here[b] + off_b
    to_a = there[a] - center_a
    to_b = there[b] - center_b
    if rule == _REPRAP and not mask & (1 << _R):
        off_by = fabs(hypot(to_a, to_b) - radius)
        if off_by > _RADIUS_TOLERANCE_MM:
            f[F_ERROR] = off_by
            f[F_ERROR + 1] = _RADIUS_TOLERANCE_MM
            return ERROR_ARC_ENDS
    angle = atan2(-off_a * to_b + off_b * to_a, -off_a * to_a - off_b * to_b)
    nothing = rule == _MARLIN_2_1 and angle == 0.0
    if angle < 0.0:
        angle += 2.0 * pi
    whole = _whole_turn(rule, angle, here, there, a, b)
    if whole:
        angle = -2.0 * pi if clockwise else 2.0 * pi
    elif clockwise:
        angle -= 2.0 * pi
    # A full turn back, rounded, is none either.
    nothing = (nothing or (rule == _MARLIN_2_1 and angle == 0.0)) and not whole
    turns = 0
    if mask & (1 << _P) and i[I_ARC_CIRCLES] and not nothing:
        turns = int(max(0.0, min(w[_P], 65535.0)))
        if turns > _MOST_CIRCLES:
            f[F_ERROR] = turns
            f[F_ERROR + 1] = _MOST_CIRCLES
            return ERROR_ARC_LONG
    rise = there[c] - here[c]
    # Extra circles first; each takes its part of the rise and of the filament.
    around = 2.0 * pi
    total = (angle if rule == _MARLIN_2_0 else fabs(angle)) + turns * around
    if turns and fabs(total) < 1e-9:
        return ERROR_ARC_TURNS
    per_circle = around / total if turns else 0.0
    circle_angle = -around if clockwise else around
    circle_pieces = 0.0
    if turns:
        circle_pieces = arc_pieces(f, rule, radius, circle_angle, rise * per_circle, True)
    last_rise = rise * (1.0 - turns * per_circle)
    pieces = 0.0 if nothing else arc_pieces(f, rule, radius, angle, last_rise, whole)
    if rule != _KLIPPER and radius * fabs(angle) < 1e-4 and last_rise < 1e-4:
        pieces = 0.0
    if not pieces + turns * circle_pieces <= MAX_ARC_PIECES:
        f[F_ERROR] = pieces + turns * circle_pieces
        f[F_ERROR + 1] = MAX_ARC_PIECES
        return ERROR_ARC_LONG
    need = int(pieces + turns * circle_pieces) + 1
    if i[I_MOVES] + need > rows.whole.shape[1]:
        i[I_NEED] = need
        return FULL
    if mask & (1 << _F):
        status = set_feed(f, i, w[_F])
        if status != OK:
            return status
    factor = f[F_EXTRUDE_FACTOR]
    e_from = (f[F_LAST + 3] - f[F_BASE + 3]) / factor
    absolute = extruder_is_absolute(i)
    feed = 0.0
    if mask & (1 << _E):
        feed = w[_E] * f[F_UNIT_E_MM] - (e_from if absolute else 0.0)
    origin_e = f[F_LAST + 3]
    moved = False
    point = np.empty(3)
    done = 0.0  # part of the rise and of the filament
    for k in range(3):
        point[k] = here[k]
    for turn in range(turns + 1):
        last = turn == turns
        n = int(pieces if last else circle_pieces)
        swept = angle if last else circle_angle
        part = 1.0 - turns * per_circle if last else per_circle
        for piece in range(1, n + 1):
            if piece < n or not last:
                if piece < n:
                    turn_cos = cos(piece * (swept / n))
                    turn_sin = sin(piece * (swept / n))
                    point[a] = center_a + (-off_a * turn_cos + off_b * turn_sin)
                    point[b] = center_b + (-off_a * turn_sin - off_b * turn_cos)
                else:
                    point[a] = here[a]
                    point[b] = here[b]
                point[c] = here[c] + rise * done + piece * (rise * part / n)
            else:
                for k in range(3):
                    point[k] = there[k]
            for k in range(3):
                f[F_LAST + k] = point[k] + f[F_BASE + k]
            if feed != 0.0:
                share = done + part * (piece / n)
                if last and piece == n:
                    share = 1.0
                f[F_LAST + 3] = origin_e + share * feed * factor
            axes = named & i[I_ORIGIN_KNOWN] if last and piece == n else 0
            status = travel(f, i, axes, True, rows)
            if status > DONE:
                return status
            moved = moved or status == OK
        done += part
    if not moved:
        put_event(i, rows, _MODE)
    return OK


@kernel
def _bezier(p0: float, p1: float, p2: float, p3: float, t: float) -> float:
    """Return the point of a cubic Bezier curve (Bernstein form)."""
    s = 1.0 - t
    return s * s * s * p0 + 3.0 * s * s * t * p1 + 3.0 * s * t * t * p2 + t * t * t * p3


@kernel
def curve(
    w: Any,
    mask: int,
    f: Any,
    i: Any,
    rows: Any,
) -> int:
    """G5 of Marlin: a cubic Bezier curve; I J count from the start, P Q from the end.

    The parameter's step is halved until the middle of the piece lies within 0.1 mm (as a sum over
    X and Y) of the straight line, or else doubled as long as it does.
    """
    unit = f[F_UNIT_MM]
    if i[I_PLANE] != 0:
        put_event(i, rows, _MODE)  # an error message, and no motion
        return OK
    need = int(2.0 / _CURVE_MIN_STEP) + 2
    if i[I_MOVES] + need > rows.whole.shape[1]:
        i[I_NEED] = need
        return FULL
    if mask & (1 << _F):
        status = set_feed(f, i, w[_F])
        if status != OK:
            return status
    p = np.empty((4, 2))
    rise = 0.0
    named = 0
    for k in range(3):
        here = f[F_LAST + k]
        there = here
        if mask & (1 << (_X + k)):
            if i[I_ABS_XYZ]:
                there = w[_X + k] * unit + f[F_BASE + k]
                named |= 1 << k
            else:
                there += w[_X + k] * unit
        if k == 2:
            rise = there - here
        else:
            p[0, k] = here
            p[3, k] = there
            p[1, k] = here + (w[_I + k] * unit if mask & (1 << (_I + k)) else 0.0)
            p[2, k] = there + (w[_P + k] * unit if mask & (1 << (_P + k)) else 0.0)
    z_from = f[F_LAST + 2]
    e_from = f[F_LAST + 3]
    feed = 0.0
    if mask & (1 << _E):
        length = w[_E] * f[F_UNIT_E_MM] * f[F_EXTRUDE_FACTOR]
        feed = length + f[F_BASE + 3] - e_from if extruder_is_absolute(i) else length
    t = 0.0
    step = _CURVE_MAX_STEP
    x, y = p[0, 0], p[0, 1]
    moved = False
    while t < 1.0:
        new_t = min(t + step, 1.0)
        new_x = _bezier(p[0, 0], p[1, 0], p[2, 0], p[3, 0], new_t)
        new_y = _bezier(p[0, 1], p[1, 1], p[2, 1], p[3, 1], new_t)
        reduced = False
        while new_t - t >= _CURVE_MIN_STEP:
            mid_t = 0.5 * (t + new_t)
            mid_x = _bezier(p[0, 0], p[1, 0], p[2, 0], p[3, 0], mid_t)
            mid_y = _bezier(p[0, 1], p[1, 1], p[2, 1], p[3, 1], mid_t)
            if fabs(mid_x - 0.5 * (x + new_x)) + fabs(mid_y - 0.5 * (y + new_y)) <= _CURVE_SIGMA_MM:
                break
            new_t, new_x, new_y = mid_t, mid_x, mid_y
            reduced = True
        while not reduced and new_t - t <= _CURVE_MAX_STEP:
            far_t = t + 2.0 * (new_t - t)
            if far_t >= 1.0:
                break
            far_x = _bezier(p[0, 0], p[1, 0], p[2, 0], p[3, 0], far_t)
            far_y = _bezier(p[0, 1], p[1, 1], p[2, 1], p[3, 1], far_t)
            if fabs(new_x - 0.5 * (x + far_x)) + fabs(new_y - 0.5 * (y + far_y)) > _CURVE_SIGMA_MM:
                break
            new_t, new_x, new_y = far_t, far_x, far_y
        step = new_t - t
        t = new_t
        x, y = new_x, new_y
        f[F_LAST], f[F_LAST + 1] = x, y
        f[F_LAST + 2] = z_from + rise * t
        f[F_LAST + 3] = e_from + feed * t
        if t == 1.0:
            f[F_LAST], f[F_LAST + 1] = p[3, 0], p[3, 1]
        axes = named & i[I_ORIGIN_KNOWN] if t == 1.0 else 0
        status = travel(f, i, axes, True, rows)
        if status > DONE:
            return status
        moved = moved or status == OK
    if not moved:
        put_event(i, rows, _MODE)
    return OK
