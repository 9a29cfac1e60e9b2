"""Kernels of Klipper's planner: limits of each move, look-ahead, phases.

Moves wait in rows of one array (``Q_`` columns). `append` enters moves with their limits and
junctions, `look_ahead` decides how many of them no later move can change any more, `emit` turns
those into phases. All speeds are squared until the end: along a straight line v^2 changes by
2 a d.

Rules: klippy/toolhead.py, klippy/kinematics/cartesian.py, klippy/kinematics/extruder.py, 2026-08.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

from stillpath.models.jit import kernel

__all__ = ["append", "emit", "look_ahead"]

Q_PATH = 0  # length, mm
Q_DIRECTION = 1  # x y z e per mm of path
Q_START = 5  # x y z e
Q_ACCEL = 9
Q_CRUISE2 = 10  # highest cruise speed
Q_GAIN2 = 11  # how much v^2 can change within the move
Q_SMOOTH_GAIN2 = 12  # the same with the acceleration that keeps the minimum cruise ratio
Q_JUNCTION2 = 13  # highest speed at the start
Q_SMOOTH_JUNCTION2 = 14
Q_DEVIATION = 15  # junction deviation, mm; negative for an extruder-only move
Q_PLAN_START2 = 16
Q_PLAN_CRUISE2 = 17
Q_PLAN_END2 = 18
Q_INDEX = 19
Q_SIZE = 20

# Facts of the machine.
C_Z_SPEED, C_Z_ACCEL = 0, 1
C_E_CORNER, C_E_SPEED, C_E_ACCEL, C_E_LENGTH, C_E_RATIO, C_NOZZLE = 2, 3, 4, 5, 6, 7
C_SIZE = 8

OK, E_TOO_LONG, E_TOO_THICK, BAD_SPEED = -1, 1, 2, 3

SMALLEST_MOVE_MM = 1e-9
_E_ONLY_ACCEL = 99999999.9  # no limit but the extruder's own
_SQRT2_MINUS_1 = sqrt(2.0) - 1.0


@kernel(allocates=False)
def append(
    start: Any,
    end: Any,
    speed: Any,
    limits_id: Any,
    limits: Any,
    facts: Any,
    first_index: int,
    queue: Any,
    count: int,
) -> tuple[int, int, int]:
    """Enter moves after the `count` rows of the queue.

    Returns
    -------
    count, problem, move : int
        New number of rows; OK or what is wrong with which move.
    """
    for m in range(len(speed)):
        row = queue[count]
        dx = end[m, 0] - start[m, 0]
        dy = end[m, 1] - start[m, 1]
        dz = end[m, 2] - start[m, 2]
        de = end[m, 3] - start[m, 3]
        path = sqrt(dx * dx + dy * dy + dz * dz)
        limit = limits[limits_id[m]]
        accel = limit[1]
        cruise = min(speed[m], limit[0])
        straight = path >= SMALLEST_MOVE_MM
        if not straight:
            dx = dy = dz = 0.0
            path = abs(de)
            if path == 0.0:
                continue
            accel = _E_ONLY_ACCEL
            cruise = speed[m]
        if not (cruise > 0.0 and accel > 0.0):
            return count, BAD_SPEED, m
        smooth_accel = limit[1] * (1.0 - limit[3])
        if limit[4] > 0.0:
            smooth_accel = min(limit[1], limit[4])
        if dz != 0.0:
            cruise = min(cruise, facts[C_Z_SPEED] * path / abs(dz))
            accel = min(accel, facts[C_Z_ACCEL] * path / abs(dz))
        if de != 0.0:
            ratio = de * (1.0 / path)
            if (dx == 0.0 and dy == 0.0) or ratio < 0.0:
                if abs(de) > facts[C_E_LENGTH]:
                    return count, E_TOO_LONG, m
                cruise = min(cruise, facts[C_E_SPEED] / abs(ratio))
                accel = min(accel, facts[C_E_ACCEL] / abs(ratio))
            elif ratio > facts[C_E_RATIO] and de > facts[C_NOZZLE] * facts[C_E_RATIO]:
                return count, E_TOO_THICK, m
        row[Q_PATH] = path
        # Same arithmetic as Klipper: near a reversal the corner speed depends on the last bit.
        inverse = 1.0 / path
        row[Q_DIRECTION] = dx * inverse
        row[Q_DIRECTION + 1] = dy * inverse
        row[Q_DIRECTION + 2] = dz * inverse
        row[Q_DIRECTION + 3] = de * inverse
        for k in range(4):
            row[Q_START + k] = start[m, k]
        row[Q_ACCEL] = accel
        row[Q_CRUISE2] = cruise * cruise
        row[Q_GAIN2] = 2.0 * path * accel
        row[Q_SMOOTH_GAIN2] = 2.0 * path * min(smooth_accel, accel)
        row[Q_DEVIATION] = limit[2] * limit[2] * _SQRT2_MINUS_1 / limit[1] if straight else -1.0
        row[Q_JUNCTION2] = 0.0
        row[Q_SMOOTH_JUNCTION2] = 0.0
        row[Q_INDEX] = first_index + m
        if count > 0 and straight and queue[count - 1, Q_DEVIATION] >= 0.0:
            _junction(queue[count - 1], row, facts[C_E_CORNER])
        count += 1
    return count, OK, 0


@kernel(allocates=False)
def _junction(before: Any, row: Any, e_corner: float) -> None:
    """Set the highest speed at which the corner between two moves may be passed."""
    v2 = min(row[Q_CRUISE2], before[Q_CRUISE2], before[Q_JUNCTION2] + before[Q_GAIN2])
    e_step = abs(row[Q_DIRECTION + 3] - before[Q_DIRECTION + 3])
    if e_step != 0.0:
        v2 = min(v2, (e_corner / e_step) ** 2)
    cosine = 0.0  # of the turn: 1 straight on, -1 back
    for k in range(3):
        cosine += row[Q_DIRECTION + k] * before[Q_DIRECTION + k]
    # Half angles of the corner between the two legs.
    sin_half = sqrt(max(0.5 * (1.0 + cosine), 0.0))
    cos_half = sqrt(max(0.5 * (1.0 - cosine), 0.0))
    if sin_half < 1.0 and cos_half > 0.0:
        radius = sin_half / (1.0 - sin_half)
        v2 = min(
            v2,
            radius * row[Q_DEVIATION] * row[Q_ACCEL],
            radius * before[Q_DEVIATION] * before[Q_ACCEL],
        )
        # The rounding arc may use at most half of each leg.
        quarter_tan = 0.25 * sin_half / cos_half
        v2 = min(v2, row[Q_GAIN2] * quarter_tan, before[Q_GAIN2] * quarter_tan)
    row[Q_JUNCTION2] = v2
    row[Q_SMOOTH_JUNCTION2] = min(v2, before[Q_SMOOTH_JUNCTION2] + before[Q_SMOOTH_GAIN2])


@kernel(allocates=False)
def look_ahead(queue: Any, count: int, final: bool) -> int:
    """Plan the queue as if it ended at rest; return how many moves are settled.

    The backward pass finds for each junction the highest speed from which the rest of the queue
    can still be braked, once with full acceleration and once with the gentler one of the minimum
    cruise ratio, whose peaks cap the cruise speeds. A junction that is held by its own limit in
    both chains cannot change when moves are added, nor can what lies before it, provided that
    the next cap before it is a peak of its own. With `final` all moves are settled.
    """
    next2 = 0.0
    next_smooth2 = 0.0
    peak2 = 0.0
    coasting = 0  # moves after the present one whose cruise speed comes from before them
    settled = count if final else 0
    candidate = 0
    for m in range(count - 1, -1, -1):
        row = queue[m]
        reach2 = next2 + row[Q_GAIN2]
        start2 = min(row[Q_JUNCTION2], reach2)
        reach_smooth2 = next_smooth2 + row[Q_SMOOTH_GAIN2]
        smooth2 = min(row[Q_SMOOTH_JUNCTION2], reach_smooth2)
        row[Q_PLAN_START2] = start2
        row[Q_PLAN_END2] = next2
        row[Q_PLAN_CRUISE2] = -1.0
        coasting += 1
        if smooth2 < reach_smooth2:
            if smooth2 + row[Q_SMOOTH_GAIN2] > next_smooth2 or coasting > 1:
                peak2 = 0.5 * (smooth2 + reach_smooth2)
                if settled == 0 and candidate > 0:
                    settled = candidate
            row[Q_PLAN_CRUISE2] = min(0.5 * (start2 + reach2), row[Q_CRUISE2], peak2)
            coasting = 0
            candidate = m if row[Q_JUNCTION2] <= reach2 else 0
        next2 = start2
        next_smooth2 = smooth2
    before2 = 0.0
    for m in range(settled):
        row = queue[m]
        if row[Q_PLAN_CRUISE2] < 0.0:
            row[Q_PLAN_CRUISE2] = min(before2, row[Q_PLAN_START2])
        cruise2 = row[Q_PLAN_CRUISE2]
        row[Q_PLAN_START2] = min(row[Q_PLAN_START2], cruise2)
        row[Q_PLAN_END2] = min(row[Q_PLAN_END2], cruise2)
        before2 = cruise2
    return settled


@kernel(allocates=False)
def emit(
    queue: Any,
    settled: int,
    t_s: float,
    times: Any,
    starts: Any,
    directions: Any,
    speeds: Any,
    index: Any,
) -> float:
    """Write the settled moves as phases; return the time at their end.

    Parameters
    ----------
    times : ndarray, shape (4, n)
        t, acceleration, cruise, deceleration.
    starts, directions : ndarray, shape (n, 4)
    speeds : ndarray, shape (4, n)
        Start, cruise, end speed and acceleration.
    """
    for m in range(settled):
        row = queue[m]
        start2, cruise2, end2 = row[Q_PLAN_START2], row[Q_PLAN_CRUISE2], row[Q_PLAN_END2]
        start, cruise, end = sqrt(start2), sqrt(cruise2), sqrt(end2)
        accel = row[Q_ACCEL]
        up_mm = 0.5 * (cruise2 - start2) / accel
        down_mm = 0.5 * (cruise2 - end2) / accel
        level_mm = max(row[Q_PATH] - up_mm - down_mm, 0.0)
        times[0, m] = t_s
        if cruise > 0.0:
            times[1, m] = up_mm / (0.5 * (start + cruise))
            times[2, m] = level_mm / cruise
            times[3, m] = down_mm / (0.5 * (end + cruise))
        else:  # too short to have a speed in doubles
            times[1, m] = times[2, m] = times[3, m] = 0.0
        for k in range(4):
            starts[m, k] = row[Q_START + k]
            directions[m, k] = row[Q_DIRECTION + k]
        speeds[0, m] = start
        speeds[1, m] = cruise
        speeds[2, m] = end
        speeds[3, m] = accel
        index[m] = int(row[Q_INDEX])
        t_s += times[1, m] + times[2, m] + times[3, m]
    return t_s
