"""Kernels of Marlin's planner: from a move to a block with its rates, caps and junction.

A block is a row of one array (``Q_`` columns). What one block hands to the next (position in
steps, direction, speeds) lives in the ``S_`` entries of a state vector. Everything is float64;
the firmware computes in float32, so a rate that lies within some thousandths of a whole number of
steps per second may come out one step per second off. A 2 at the end of a name means squared.

Rules: Marlin/src/module/planner.cpp, `_populate_block`: release 2.0.8 (2021-05), release 2.1.2.5
(2024-11), bugfix-2.1.x as of 2025-09; docs/marlin.md says what differs.
"""

from __future__ import annotations

from math import ceil, floor, sqrt
from typing import Any

import numpy as np

from stillpath.models.jit import kernel

__all__ = ["append"]

# Columns of a block.
Q_PATH = 0  # length, mm
Q_START = 1  # x y z e, mm
Q_DIRECTION = 5  # x y z e per mm of path
Q_STEPS = 9  # step events; 0: the firmware swallows the move
Q_STEPS_PER_MM = 10
Q_SPEED = 11  # nominal, mm/s
Q_RATE = 12  # nominal, steps/s
Q_ACCEL = 13  # mm/s2
Q_ACCEL_STEPS = 14  # steps/s2
Q_JUNCTION2 = 15  # highest entry speed, squared
Q_FLOOR2 = 16  # lowest speed at either end (MINIMUM_PLANNER_SPEED, or bugfix's own), squared
Q_REACH2 = 17  # entry speed from which the rest of the queue can be braked, squared
Q_INDEX = 18
Q_SIZE = 19

# What a block hands to the next.
S_STEPS = 0  # x y z e, whole steps
S_POSITION = 4  # x y z e that the last block was asked for, mm
S_SPEED = 8  # x y z e
S_NOMINAL = 12
S_SAFE = 13
S_UNIT = 14  # x y z e
S_BLOCKS = 18  # blocks since the queue was empty
S_KNOWN = 19  # 1: the position is known
S_ENTRY2 = 20  # entry speed of the first row of the queue, squared
S_ASKED = 21  # x y z e that the last move asked for, mm
S_SIZE = 25

# A row of limits (MarlinLimits).
L_ACCEL, L_FEEDRATE, L_PRINT, L_RETRACT, L_TRAVEL, L_JERK, L_DEVIATION = 0, 4, 8, 9, 10, 11, 15
L_MIN_SEGMENT_US, L_MIN_FEEDRATE, L_MIN_TRAVEL = 16, 17, 18
L_ADVANCE, L_IN_FILAMENT = 19, 20

# Facts of the machine.
C_STEPS_PER_MM = 0  # x y z e
C_FAMILY, C_CORE, C_CLASSIC_JERK, C_SMALL_SEGMENTS = 4, 5, 6, 7
C_MIN_STEPS, C_MIN_SPEED, C_ADVANCE = 8, 11, 12
C_AHEAD = 9  # blocks after a block that are known when it starts
C_SLOWDOWN = 10  # most waiting blocks for which short ones are stretched; 0: never
C_TIMER_HZ, C_SMOOTHING_HZ, C_MIN_RATE, C_S_CURVE = 13, 14, 15, 16
C_RESTS_APART = 17  # short moves are not joined with moves of Z or the extruder alone
C_FIRST_STEPS = 18  # steps of a block that have the time of its first one
C_MOTOR_SPEED = 19  # X and Y together are no faster than M203 X
C_SIZE = 20

RELEASE, BUGFIX, PRUSA = 0, 1, 2

OK, BAD_SPEED = -1, 1

_STILL = 1e-6
_STRAIGHT = 0.999999
_SAME_MM = 1e-7  # positions closer than this are one
_NOISE = 1e-9

_TURN_CORNERS = 17
_TURN_COSINE = 1.0 - 0.5 ** np.arange(_TURN_CORNERS)
_TURN_COSINE[-1] = _STRAIGHT
_TURN_ANGLE = np.arccos(_TURN_COSINE)
_TURN_ANGLE[1:-1] *= 1.00751495
"""Corners of the broken line by which the firmware finds the angle of a slight turn, rad."""


@kernel(inline=True)
def _whole(x: float) -> float:
    """Round half away from zero, as lround does."""
    return floor(x + 0.5) if x >= 0.0 else ceil(x - 0.5)


@kernel(inline=True)
def _up(x: float) -> float:
    """Round up, but not for the noise of the last bits."""
    return ceil(x * (1.0 - _NOISE))


@kernel
def append(
    start: Any,
    end: Any,
    speed: Any,
    limits_id: Any,
    limits: Any,
    facts: Any,
    first_index: int,
    state: Any,
    queue: Any,
    count: int,
) -> tuple[int, int, int]:
    """Enter moves after the `count` rows of the queue, one row for each move.

    Returns
    -------
    count, problem, move : int
        New number of rows; OK or what is wrong with which move.
    """
    apart, last = facts[C_RESTS_APART] != 0.0, len(speed) - 1
    for m in range(len(speed)):
        row = queue[count]
        limit = limits[limits_id[m]]
        fewest = facts[C_MIN_STEPS]
        if apart and (m == last or not _moves_xy(start, end, m + 1)):
            fewest = 1.0
        if not (speed[m] > 0.0):
            return count, BAD_SPEED, m
        # After homing, G92 of an axis and the like the machine is where the file says.
        for k in range(4):
            if state[S_KNOWN] == 0.0 or abs(start[m, k] - state[S_ASKED + k]) > _SAME_MM:
                state[S_STEPS + k] = _whole(start[m, k] * facts[C_STEPS_PER_MM + k])
                state[S_POSITION + k] = start[m, k]
            state[S_ASKED + k] = end[m, k]
        state[S_KNOWN] = 1.0
        row[Q_INDEX] = first_index + m
        _block(start[m], end[m], speed[m], limit, facts, fewest, state, row)
        count += 1
    return count, OK, 0


@kernel
def _block(
    start: Any,
    end: Any,
    speed: float,
    limit: Any,
    facts: Any,
    fewest: float,
    state: Any,
    row: Any,
) -> None:
    """Fill the row of one move and move the state on; one of fewer steps is swallowed."""
    family = facts[C_FAMILY]
    rounds = family != PRUSA
    core = facts[C_CORE] != 0.0
    s0 = _whole(end[0] * facts[C_STEPS_PER_MM])
    s1 = _whole(end[1] * facts[C_STEPS_PER_MM + 1])
    s2 = _whole(end[2] * facts[C_STEPS_PER_MM + 2])
    s3 = _whole(end[3] * facts[C_STEPS_PER_MM + 3])
    d0, d1 = s0 - state[S_STEPS], s1 - state[S_STEPS + 1]
    d2, d3 = s2 - state[S_STEPS + 2], s3 - state[S_STEPS + 3]
    x_mm, y_mm = d0 / facts[C_STEPS_PER_MM], d1 / facts[C_STEPS_PER_MM + 1]
    z_mm, e_mm = d2 / facts[C_STEPS_PER_MM + 2], d3 / facts[C_STEPS_PER_MM + 3]
    # Steps and millimetres of the motors; of a CoreXY they are sum and difference, of Prusa's
    # firmware, whose limits but M203 are those of the axes, they are not.
    motors = core and family != PRUSA
    a, b = (abs(d0 + d1), abs(d0 - d1)) if motors else (abs(d0), abs(d1))
    a_mm, b_mm = (x_mm + y_mm, x_mm - y_mm) if motors else (x_mm, y_mm)
    c, e = abs(d2), abs(d3)
    far = a >= fewest or b >= fewest or c >= fewest
    path = sqrt(x_mm * x_mm + y_mm * y_mm + z_mm * z_mm) if far else abs(e_mm)
    steps = max(a, b, c, e)
    for k in range(4):
        row[Q_START + k] = state[S_STEPS + k] / facts[C_STEPS_PER_MM + k]
    if steps < fewest or path <= 0.0:
        _swallow(start, end, row)
        return

    # Speed: asked for, stretched while the queue is short, capped for every axis.
    inverse_s = max(speed, limit[L_MIN_FEEDRATE if e > 0.0 else L_MIN_TRAVEL]) / path
    blocks = state[S_BLOCKS]
    # The first block is taken from the queue when there are three.
    queued = blocks if blocks <= 2.0 else blocks - 1.0
    if 2.0 <= queued <= facts[C_SLOWDOWN]:
        segment_us = _whole(1e6 / inverse_s)
        short_us = floor(limit[L_MIN_SEGMENT_US] - segment_us)
        if short_us > 0.0:
            inverse_s = 1e6 / (segment_us + floor(2.0 * short_us / queued))
    nominal = path * inverse_s
    rate = _up(steps * inverse_s) if rounds else steps * inverse_s
    v0, v1, v2, v3 = a_mm * inverse_s, b_mm * inverse_s, z_mm * inverse_s, e_mm * inverse_s
    factor = 1.0
    if facts[C_MOTOR_SPEED] != 0.0:
        if abs(v0) + abs(v1) > limit[L_FEEDRATE]:
            factor = limit[L_FEEDRATE] / (abs(v0) + abs(v1))
    else:
        if abs(v0) > limit[L_FEEDRATE]:
            factor = min(factor, limit[L_FEEDRATE] / abs(v0))
        if abs(v1) > limit[L_FEEDRATE + 1]:
            factor = min(factor, limit[L_FEEDRATE + 1] / abs(v1))
    if abs(v2) > limit[L_FEEDRATE + 2]:
        factor = min(factor, limit[L_FEEDRATE + 2] / abs(v2))
    if abs(v3) > limit[L_FEEDRATE + 3]:
        factor = min(factor, limit[L_FEEDRATE + 3] / abs(v3))
    if factor < 1.0:
        v0, v1, v2, v3 = factor * v0, factor * v1, factor * v2, factor * v3
        nominal *= factor
        rate = max(floor(rate * factor * (1.0 + _NOISE)), 1.0) if rounds else rate * factor

    # Acceleration in steps/s2: by the kind of the move, linear advance, and axis by axis.
    per_mm = steps / path
    if a == 0.0 and b == 0.0 and c == 0.0:
        accel = _up(limit[L_RETRACT] * per_mm)
    else:
        accel = _up((limit[L_PRINT] if e > 0.0 else limit[L_TRAVEL]) * per_mm)
        advances = facts[C_ADVANCE] != 0.0 and limit[L_IN_FILAMENT] == 0.0
        if advances and limit[L_ADVANCE] > 0.0 and d3 > 0.0:
            accel = min(accel, _advance_cap(end, limit, facts, state) * per_mm)
        accel = _axis_accel(accel, limit[L_ACCEL] * facts[C_STEPS_PER_MM], steps, a)
        accel = _axis_accel(accel, limit[L_ACCEL + 1] * facts[C_STEPS_PER_MM + 1], steps, b)
        accel = _axis_accel(accel, limit[L_ACCEL + 2] * facts[C_STEPS_PER_MM + 2], steps, c)
        accel = _axis_accel(accel, limit[L_ACCEL + 3] * facts[C_STEPS_PER_MM + 3], steps, e)
    accel = max(floor(accel), 1.0)
    accel_mm = accel / per_mm

    # No junction is slower than this; bugfix: as fast as the first step allows.
    floor2 = facts[C_MIN_SPEED] ** 2
    if family == BUGFIX:
        floor2 = min(0.5 * accel_mm / per_mm, nominal * nominal)
    moving = blocks > 0.0 and state[S_NOMINAL] > _STILL
    if facts[C_CLASSIC_JERK] != 0.0:
        if family == BUGFIX:
            junction2 = _jerk_junction2(v0, v1, v2, v3, nominal, limit, state, moving)
        else:
            junction2 = _safe_jerk_junction2(v0, v1, v2, v3, nominal, limit, state, moving)
    else:
        if family == PRUSA:
            u0, u1 = end[0] - state[S_POSITION], end[1] - state[S_POSITION + 1]
            u2, u3 = end[2] - state[S_POSITION + 2], end[3] - state[S_POSITION + 3]
            length = sqrt(u0 * u0 + u1 * u1 + u2 * u2 + u3 * u3) if core else path
        else:
            u0, u1, u2, u3 = a_mm, b_mm, z_mm, e_mm
            length = path
            if core or e > 0.0:
                length = sqrt(u0 * u0 + u1 * u1 + u2 * u2 + u3 * u3)
        inverse = 1.0 / length
        junction2 = _deviation_junction2(
            u0 * inverse,
            u1 * inverse,
            u2 * inverse,
            u3 * inverse,
            path,
            nominal,
            accel_mm,
            floor2,
            limit,
            facts,
            state,
            moving,
        )

    row[Q_PATH] = path
    row[Q_DIRECTION] = x_mm / path
    row[Q_DIRECTION + 1] = y_mm / path
    row[Q_DIRECTION + 2] = z_mm / path
    row[Q_DIRECTION + 3] = e_mm / path
    row[Q_STEPS] = steps
    row[Q_STEPS_PER_MM] = per_mm
    row[Q_SPEED] = nominal
    row[Q_RATE] = rate
    row[Q_ACCEL] = accel_mm
    row[Q_ACCEL_STEPS] = accel
    row[Q_FLOOR2] = floor2
    row[Q_JUNCTION2] = max(junction2, floor2)
    if blocks == 0.0:  # from an empty queue: the lowest speed
        row[Q_JUNCTION2] = floor2
    state[S_STEPS] = s0
    state[S_STEPS + 1] = s1
    state[S_STEPS + 2] = s2
    state[S_STEPS + 3] = s3
    for k in range(4):
        state[S_POSITION + k] = end[k]
    state[S_SPEED] = v0
    state[S_SPEED + 1] = v1
    state[S_SPEED + 2] = v2
    state[S_SPEED + 3] = v3
    state[S_NOMINAL] = nominal
    state[S_BLOCKS] = blocks + 1.0


@kernel(inline=True)
def _moves_xy(start: Any, end: Any, m: int) -> bool:
    return bool(start[m, 0] != end[m, 0] or start[m, 1] != end[m, 1])


@kernel
def _swallow(start: Any, end: Any, row: Any) -> None:
    """Fill the row of a move too short to be a block; the next one makes up for it."""
    path = sqrt((end[0] - start[0]) ** 2 + (end[1] - start[1]) ** 2 + (end[2] - start[2]) ** 2)
    if path == 0.0:
        path = abs(end[3] - start[3])
    for k in range(4):
        row[Q_DIRECTION + k] = (end[k] - start[k]) / path if path > 0.0 else 0.0
    row[Q_PATH] = 0.0
    row[Q_STEPS] = 0.0
    row[Q_STEPS_PER_MM] = 1.0
    row[Q_SPEED] = row[Q_RATE] = 0.0
    row[Q_ACCEL] = row[Q_ACCEL_STEPS] = 1.0
    row[Q_JUNCTION2] = row[Q_FLOOR2] = 0.0


@kernel(inline=True)
def _axis_accel(accel: float, largest: float, steps: float, own: float) -> float:
    """Cap the acceleration of the leading axis so that another axis keeps its own limit."""
    largest = floor(largest)
    if own > 0.0 and largest < accel:
        return min(accel, floor(largest * steps / own))
    return accel


@kernel
def _advance_cap(end: Any, limit: Any, facts: Any, state: Any) -> float:
    """Acceleration, mm/s2, at which classic linear advance asks the extruder for its jerk."""
    x = end[0] - state[S_POSITION]
    y = end[1] - state[S_POSITION + 1]
    z = end[2] - state[S_POSITION + 2]
    path = sqrt(x * x + y * y + z * z)
    feed = end[3] - state[S_POSITION + 3]
    if feed > 3.0 * path or feed <= 0.0:
        return 1e30  # a retraction that was joined with a move; or none
    jerk = limit[L_JERK + 3]
    if facts[C_CLASSIC_JERK] == 0.0:
        half = sqrt(0.5)
        jerk = sqrt(limit[L_DEVIATION] * half / (1.0 - half) * limit[L_ACCEL + 3])
    return float(jerk / (limit[L_ADVANCE] * feed / path))


@kernel
def _deviation_junction2(
    u0: float,
    u1: float,
    u2: float,
    u3: float,
    path: float,
    nominal: float,
    accel: float,
    floor2: float,
    limit: Any,
    facts: Any,
    state: Any,
    moving: bool,
) -> float:
    """Entry speed squared by junction deviation; also keeps the direction for the next block."""
    p0, p1, p2, p3 = state[S_UNIT], state[S_UNIT + 1], state[S_UNIT + 2], state[S_UNIT + 3]
    state[S_UNIT] = u0
    state[S_UNIT + 1] = u1
    state[S_UNIT + 2] = u2
    state[S_UNIT + 3] = u3
    if not moving:
        return floor2
    cosine = -(p0 * u0 + p1 * u1 + p2 * u2 + p3 * u3)  # 1: straight back
    if cosine > _STRAIGHT:
        return floor2
    cosine = max(cosine, -_STRAIGHT)
    j0, j1, j2, j3 = u0 - p0, u1 - p1, u2 - p2, u3 - p3
    size = sqrt(j0 * j0 + j1 * j1 + j2 * j2 + j3 * j3)
    if size > 0.0:
        inverse = 1.0 / size
        j0, j1, j2, j3 = abs(j0) * inverse, abs(j1) * inverse, abs(j2) * inverse, abs(j3) * inverse
        if accel * j0 > limit[L_ACCEL]:
            accel = limit[L_ACCEL] / j0
        if accel * j1 > limit[L_ACCEL + 1]:
            accel = limit[L_ACCEL + 1] / j1
        if accel * j2 > limit[L_ACCEL + 2]:
            accel = limit[L_ACCEL + 2] / j2
        if accel * j3 > limit[L_ACCEL + 3]:
            accel = limit[L_ACCEL + 3] / j3
    sine = sqrt(0.5 * (1.0 - cosine))
    v2 = accel * limit[L_DEVIATION] * sine / (1.0 - sine)
    if facts[C_SMALL_SEGMENTS] != 0.0 and path < 1.0:
        turn = _turn(cosine, facts[C_FAMILY] == PRUSA)
        if turn > 0.0:
            v2 = min(v2, path * accel / turn)
    return float(min(v2, nominal * nominal, state[S_NOMINAL] ** 2))


@kernel
def _turn(cosine: float, prusa: bool) -> float:
    """Angle of a turn that short segments make part of an arc, rad; 0 where they do not."""
    if prusa:
        # A parabola through the arc cosine, less its error.
        theta = (-0.6981317008 * cosine * cosine - 0.872664626) * cosine + 1.570796327 - 0.18
        return 3.141592654 - theta if theta > 2.35619449 else 0.0
    if cosine >= -0.7071067812:
        return 0.0
    # JD_USE_LOOKUP_TABLE, which planner.h defines since 2020-05 (#17817): straight lines between
    # the points 1 - 2^-k of the arc cosine, with a factor that centres the error.
    k = 0
    while k < _TURN_CORNERS - 2 and -cosine >= _TURN_COSINE[k + 1]:
        k += 1
    slope = (_TURN_ANGLE[k + 1] - _TURN_ANGLE[k]) / (_TURN_COSINE[k + 1] - _TURN_COSINE[k])
    return float(_TURN_ANGLE[k] + slope * (-cosine - _TURN_COSINE[k]))


@kernel
def _jerk_junction2(
    v0: float,
    v1: float,
    v2: float,
    v3: float,
    nominal: float,
    limit: Any,
    state: Any,
    moving: bool,
) -> float:
    """Entry speed squared by classic jerk in bugfix-2.1.x: the step of every axis' speed."""
    own, before, junction = 1.0, 0.0, nominal
    if moving:
        if nominal < state[S_NOMINAL]:
            before = nominal / state[S_NOMINAL]
        else:
            junction = state[S_NOMINAL]
            own, before = junction / nominal, 1.0
    factor = 1.0
    speeds = (v0, v1, v2, v3)
    for k in range(4):
        jerk = abs(speeds[k] * own - state[S_SPEED + k] * before)
        if jerk * factor > limit[L_JERK + k]:
            factor = limit[L_JERK + k] / jerk
    return float((junction * factor) ** 2)


@kernel
def _safe_jerk_junction2(
    v0: float,
    v1: float,
    v2: float,
    v3: float,
    nominal: float,
    limit: Any,
    state: Any,
    moving: bool,
) -> float:
    """Entry speed squared by classic jerk in the releases, with their rule of safe speeds.

    A safe speed is one from which every axis may stop at once; where stopping and starting at
    the safe speeds is no slower than passing the corner, the corner is passed at the safe speed.
    """
    speeds = (v0, v1, v2, v3)
    safe = nominal
    for k in range(4):
        if abs(speeds[k]) > limit[L_JERK + k]:
            safe = min(safe, nominal * limit[L_JERK + k] / abs(speeds[k]))
    before_safe = state[S_SAFE]
    state[S_SAFE] = safe
    if not moving:
        return safe * safe
    junction = min(nominal, state[S_NOMINAL])
    smaller = junction / state[S_NOMINAL]
    factor = 1.0
    for k in range(4):
        leave = state[S_SPEED + k] * smaller * factor
        enter = speeds[k] * factor
        if leave > enter:
            straight = enter > 0.0 or leave < 0.0
            jerk = leave - enter if straight else max(leave, -enter)
        else:
            straight = enter < 0.0 or leave > 0.0
            jerk = enter - leave if straight else max(-leave, enter)
        if jerk > limit[L_JERK + k]:
            factor *= limit[L_JERK + k] / jerk
    junction *= factor
    if before_safe > 0.99 * junction and safe > 0.99 * junction:
        junction = safe
    return float(junction * junction)
