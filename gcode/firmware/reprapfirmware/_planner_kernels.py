"""Kernels of RepRapFirmware's planner: limits of each move, the ring and its look-ahead, phases.

Moves wait in rows of one array (``Q_`` columns): first those that are frozen but not over, then
those in the ring that can still change, then those that do not fit into the ring yet. `append`
enters moves with their limits, `run` lets the ring work for as long as it is clear what happens.

The ring is part of the plan: a move is frozen shortly before it begins, by what the ring holds at
that moment, and the newest move in the ring always ends at rest.

Rules: src/Movement/DDA.cpp, DDARing.cpp, MoveTiming.h and Kinematics/CoreKinematics.cpp of
RepRapFirmware 3.6.0-beta.2, 2024-11.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np

from stillpath.models.jit import kernel

__all__ = ["append", "drop", "emit", "on_steps", "run"]

Q_PATH = 0  # length as commanded, mm
Q_DIRECTION = 1  # x y z e as commanded, per mm of path
Q_START = 5  # x y z e where the motors stand
Q_TRAVEL = 9  # x y z e that the motors move, per mm of path
Q_ACCEL = 13
Q_SPEED = 14  # highest cruise speed
Q_KIND = 15  # bits: feeds filament along X Y, moves X or Y, moves the extruder otherwise
Q_POLICY = 16  # M566 P
Q_INDEX = 17
Q_IN, Q_TOP, Q_OUT = 18, 19, 20  # speeds
Q_UP, Q_DOWN = 21, 22  # ways of acceleration and deceleration, mm
Q_TARGET = 23  # at which the next move would like to start
Q_LASTS = 24
Q_BEGINS = 25
Q_JERK = 26  # x y z e
Q_SIZE = 30

PRINTS, MOVES_XY, FEEDS_OTHERWISE = 1, 2, 4

# Columns of the limits' rows, in the order of RepRapLimits.
L_ACCEL, L_SPEED, L_LEAST_SPEED, L_PRINT, L_TRAVEL = 0, 4, 8, 9, 10
L_JERK, L_MOST_JERK, L_POLICY, L_ADVANCE = 11, 15, 19, 20

# Facts of the machine.
C_COREXY, C_STEPS, C_RING, C_CLOCK, C_AHEAD, C_LEAST = 0, 1, 4, 5, 6, 7
C_SIZE = 8

# State of the ring.
S_OVER, S_FROZEN, S_HELD = 0, 1, 2  # rows below: over, frozen, in the ring
S_NOW, S_FROZEN_END, S_OPEN_S, S_SHORT_S = 3, 4, 5, 6
S_SIZE = 7

OK, BAD_SPEED = -1, 1

SHORT_CLOCKS = 10.0  # a shorter acceleration is left out
_EPS_S, _ROUNDING = 1e-9, 1e-15
_MOST_S = 1e15
_NO_STEP = 1e-9
OPEN_MOST_S, OPEN_BUT_FIRST_S = 2.0, 0.5  # the ring takes no more when its open moves last longer


@kernel
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
    """Enter moves after the `count` rows of the queue; moves of no length are left out.

    Returns
    -------
    count, problem, move : int
        New number of rows; OK or what is wrong with which move.
    """
    way = np.empty(4)
    starts, ends = on_steps(start, facts), on_steps(end, facts)
    for m in range(len(speed)):
        row = queue[count]
        limit = limits[limits_id[m]]
        for k in range(4):
            way[k] = end[m, k] - start[m, k]
        path = sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2])
        if path == 0.0:
            path = abs(way[3])
        if path == 0.0:
            continue
        xy = way[0] != 0.0 or way[1] != 0.0
        kind = MOVES_XY if xy else 0
        if xy and way[3] > 0.0:
            kind |= PRINTS
        elif way[3] != 0.0:
            kind |= FEEDS_OTHERWISE
        accel = np.inf
        cruise = max(speed[m], limit[L_LEAST_SPEED])
        for k in range(4):
            share = abs(way[k]) / path
            row[Q_DIRECTION + k] = way[k] / path
            if share == 0.0:
                continue
            most = limit[L_ACCEL + k]
            if k == 3 and kind & PRINTS and limit[L_ADVANCE] > 0.0:
                # Pressure advance makes acceleration times K a step of the extruder's speed.
                most = min(most, limit[L_MOST_JERK + 3] / limit[L_ADVANCE])
            accel = min(accel, most / share)
            cruise = min(cruise, limit[L_SPEED + k] / share)
        if xy:
            accel = min(accel, limit[L_PRINT] if kind & PRINTS else limit[L_TRAVEL])
        if facts[C_COREXY] != 0.0:
            # The motors run as fast as the sum and the difference of X and Y.
            for k in range(2):
                share = abs(way[0]) + (1 - 2 * k) * abs(way[1])
                share = abs(share) / path
                if share > 0.0:
                    accel = min(accel, limit[L_ACCEL + k] / share)
                    cruise = min(cruise, limit[L_SPEED + k] / share)
        if not (cruise > 0.0 and accel > 0.0 and np.isfinite(cruise) and np.isfinite(accel)):
            return count, BAD_SPEED, m
        if not (path < _MOST_S * cruise and path < _MOST_S**2 * accel):
            return count, BAD_SPEED, m
        row[Q_PATH] = path
        row[Q_ACCEL] = accel
        row[Q_SPEED] = cruise
        row[Q_KIND] = kind
        row[Q_POLICY] = limit[L_POLICY]
        row[Q_INDEX] = first_index + m
        # The extruder's fractions of a step are carried on, so it is left as it is.
        for k in range(3):
            row[Q_START + k] = starts[m, k]
            row[Q_TRAVEL + k] = (ends[m, k] - starts[m, k]) / path
            if row[Q_TRAVEL + k] == 0.0:
                # Not a step, but still a move of this axis: it does not count as a rest.
                row[Q_TRAVEL + k] = _NO_STEP * way[k] / path
        for k in range(4):
            row[Q_JERK + k] = limit[L_JERK + k]
        row[Q_START + 3] = start[m, 3]
        row[Q_TRAVEL + 3] = way[3] / path
        count += 1
    return count, OK, 0


@kernel
def on_steps(places: Any, facts: Any) -> Any:
    """Places x y z (n, 3) of motors in whole steps, when they are sent to `places`."""
    stands = np.empty((len(places), 3))
    corexy = facts[C_COREXY] != 0.0
    for i in range(len(places)):
        x, y = places[i, 0], places[i, 1]
        a, b = (x + y, x - y) if corexy else (x, y)
        a = np.rint(a * facts[C_STEPS]) / facts[C_STEPS]
        b = np.rint(b * facts[C_STEPS + 1]) / facts[C_STEPS + 1]
        stands[i, 0], stands[i, 1] = (0.5 * (a + b), 0.5 * (a - b)) if corexy else (a, b)
        stands[i, 2] = np.rint(places[i, 2] * facts[C_STEPS + 2]) / facts[C_STEPS + 2]
    return stands


@kernel
def run(
    queue: Any,
    count: int,
    state: Any,
    facts: Any,
    final: bool,
) -> None:
    """Let the ring work until it wants a move that is not there yet; with `final` to its end.

    A move begins where the one before ends, unless it was frozen too late for that.
    """
    ring = int(facts[C_RING])
    ahead, least = facts[C_AHEAD], facts[C_LEAST]
    while True:
        now = state[S_NOW]
        over, frozen = int(state[S_OVER]), int(state[S_FROZEN])
        while over < frozen and queue[over, Q_BEGINS] + queue[over, Q_LASTS] <= now:
            over += 1
        state[S_OVER] = over
        while _takes_more(queue, state, ring):
            held = int(state[S_HELD])
            if held == count:
                if not final:
                    return
                break
            _enter(queue, state)
        held = int(state[S_HELD])
        freezes = now
        while frozen < held and 2 * (frozen - over) < ring:
            row = queue[frozen]
            lead = state[S_FROZEN_END] - now
            freezes = _freezes(queue, over, frozen, ahead)
            if freezes > now + max(_EPS_S, _ROUNDING * now):  # else `now` might never come there
                break
            if frozen == over:
                begins = now + ahead
            elif lead >= least:
                begins = state[S_FROZEN_END]
            else:
                begins = now + (ahead if row[Q_IN] == 0.0 else least)
            state[S_OPEN_S] -= row[Q_LASTS]
            row[Q_BEGINS] = begins
            up_s, level_s, down_s = _whole_clocks(row, facts[C_CLOCK])
            row[Q_LASTS] = up_s + level_s + down_s
            state[S_FROZEN_END] = begins + row[Q_LASTS]
            frozen += 1
        state[S_FROZEN] = frozen
        if frozen == count and final:
            return
        following = np.inf
        if over < frozen:
            following = queue[over, Q_BEGINS] + queue[over, Q_LASTS]
        if frozen < held and 2 * (frozen - over) < ring:
            following = min(following, freezes)
        state[S_NOW] = max(now, following)


@kernel
def _freezes(queue: Any, over: int, frozen: int, ahead: float) -> float:
    """Return when the next move is frozen: when the frozen ones have only `ahead` still to run.

    Waiting does not count: after a standstill, moves of that duration are frozen at once.
    """
    left = ahead
    for m in range(frozen - 1, over - 1, -1):
        if queue[m, Q_LASTS] >= left:
            return float(queue[m, Q_BEGINS] + queue[m, Q_LASTS] - left)
        left -= queue[m, Q_LASTS]
    return -np.inf


@kernel
def _takes_more(queue: Any, state: Any, ring: int) -> bool:
    """Tell whether the ring has a place, and not too much time in moves that are still open."""
    over, frozen, held = int(state[S_OVER]), int(state[S_FROZEN]), int(state[S_HELD])
    used = held - over
    if used >= ring or (used == ring - 1 and frozen == over):
        return False
    if frozen == held:
        return True
    open_s = state[S_OPEN_S]
    return bool(open_s < OPEN_MOST_S or open_s - queue[frozen, Q_LASTS] < OPEN_BUT_FIRST_S)


@kernel
def _enter(queue: Any, state: Any) -> None:
    """Put the next move into the ring and let the moves before it run on into it."""
    frozen, new = int(state[S_FROZEN]), int(state[S_HELD])
    row = queue[new]
    row[Q_IN] = 0.0
    row[Q_OUT] = 0.0
    row[Q_LASTS] = 0.0
    if new > frozen:
        before = queue[new - 1]
        if row[Q_POLICY] != 0.0 or before[Q_KIND] == row[Q_KIND]:
            brake = sqrt(2.0 * row[Q_ACCEL] * row[Q_PATH])
            before[Q_TARGET] = min(brake, row[Q_SPEED])
            _look_ahead(queue, frozen, new - 1, state)
            row[Q_IN] = before[Q_OUT]
    _shape(row, state)
    state[S_HELD] = new + 1


@kernel
def _look_ahead(queue: Any, first: int, last: int, state: Any) -> None:
    """Raise the speed at the end of row `last` to its target, and those before it as needed.

    Rows before `first` are frozen. The search goes back as long as moves do nothing but brake; the
    speeds at the ends never fall again. The limits are those of the move that enters, row last + 1.
    """
    j = last
    entering = queue[last + 1]
    while True:
        row = queue[j]
        row[Q_TARGET] = min(row[Q_TARGET], row[Q_SPEED])
        if row[Q_TOP] < row[Q_SPEED]:
            if j > first and _brakes(row) and _may_rise(queue[j - 1], row, entering):
                _respect_jerk(queue, j, entering)
                could = sqrt(row[Q_TARGET] ** 2 + 2.0 * row[Q_ACCEL] * row[Q_PATH])
                queue[j - 1, Q_TARGET] = min(could, row[Q_SPEED])
                j -= 1
                continue
            _respect_reach(row)
        _respect_jerk(queue, j, entering)
        break
    for i in range(j, last + 1):
        row = queue[i]
        if i > j:
            row[Q_IN] = queue[i - 1, Q_OUT]
            _respect_reach(row)
        row[Q_OUT] = max(row[Q_OUT], row[Q_TARGET])
        _shape(row, state)


@kernel(inline=True)
def _brakes(row: Any) -> bool:
    """Tell whether a move does nothing but brake; a sliver of acceleration is rounding."""
    return bool(
        row[Q_DOWN] == row[Q_PATH]
        or (row[Q_TOP] < row[Q_SPEED] and row[Q_DOWN] > 0.98 * row[Q_PATH])
    )


@kernel(inline=True)
def _may_rise(before: Any, row: Any, entering: Any) -> bool:
    """Tell whether the look-ahead goes on from a move to the open one before it."""
    if before[Q_DOWN] == 0.0:
        return False
    if entering[Q_POLICY] != 0.0:
        return True
    kind, kind_before = int(row[Q_KIND]), int(before[Q_KIND])
    if (kind ^ kind_before) & MOVES_XY:
        return False
    same = (kind ^ kind_before) & PRINTS == 0
    return bool(same or (kind_before & PRINTS and before[Q_SPEED] == row[Q_SPEED]))


@kernel(inline=True)
def _respect_reach(row: Any) -> None:
    """No higher target than the speed that the move can reach."""
    reach = sqrt(row[Q_IN] ** 2 + 2.0 * row[Q_ACCEL] * row[Q_PATH])
    row[Q_TARGET] = min(row[Q_TARGET], reach)


@kernel
def _respect_jerk(queue: Any, j: int, entering: Any) -> None:
    """No higher target than one at which every drive's speed steps by no more than its jerk."""
    row, after = queue[j], queue[j + 1]
    for k in range(4):
        step = abs(row[Q_DIRECTION + k] - after[Q_DIRECTION + k])
        if step * row[Q_TARGET] > entering[Q_JERK + k]:
            row[Q_TARGET] = entering[Q_JERK + k] / step


@kernel
def _shape(row: Any, state: Any) -> None:
    """Fit acceleration, cruise and deceleration between the speeds at both ends."""
    accel, path = row[Q_ACCEL], row[Q_PATH]
    speed, enter, leave = row[Q_SPEED], row[Q_IN], row[Q_OUT]
    up = (speed * speed - enter * enter) / (2.0 * accel)
    down = (speed * speed - leave * leave) / (2.0 * accel)
    top = speed
    if up + down < path:
        higher = max(enter, leave)
        if higher + accel * state[S_SHORT_S] > speed and higher >= 0.9 * speed:
            # The way of the other phase stays the one to the full speed.
            top = higher
            if enter >= leave:
                up = 0.0
            else:
                down = 0.0
    else:
        top2 = accel * path + 0.5 * (enter * enter + leave * leave)
        if top2 > enter * enter and top2 > leave * leave:
            top = sqrt(top2)
            up = (top2 - enter * enter) / (2.0 * accel)
            down = (top2 - leave * leave) / (2.0 * accel)
        elif enter < leave:
            top, up, down = leave, path, 0.0
        else:
            top, up, down = enter, 0.0, path
    row[Q_TOP], row[Q_UP], row[Q_DOWN] = top, up, down
    lasts = (2.0 * top - enter - leave) / accel + (path - up - down) / top
    state[S_OPEN_S] += lasts - row[Q_LASTS]
    row[Q_LASTS] = lasts


@kernel
def _whole_clocks(row: Any, clock_hz: float) -> tuple[float, float, float]:
    """Durations of acceleration, cruise and deceleration; each is a whole number of clocks."""
    path, top = row[Q_PATH], row[Q_TOP]
    up_s = (top - row[Q_IN]) / row[Q_ACCEL]
    down_s = (top - row[Q_OUT]) / row[Q_ACCEL]
    if row[Q_UP] == path:
        up_s, down_s = 2.0 * path / (row[Q_IN] + row[Q_OUT]), 0.0
    elif row[Q_DOWN] == path:
        up_s, down_s = 0.0, 2.0 * path / (row[Q_IN] + row[Q_OUT])
    level_s = max(path - row[Q_UP] - row[Q_DOWN], 0.0) / top
    return (
        np.rint(up_s * clock_hz) / clock_hz,
        np.rint(level_s * clock_hz) / clock_hz,
        np.rint(down_s * clock_hz) / clock_hz,
    )


@kernel
def emit(
    queue: Any,
    first: int,
    last: int,
    clock_hz: float,
    times: Any,
    starts: Any,
    directions: Any,
    speeds: Any,
    index: Any,
) -> None:
    """Write frozen rows as phases.

    The firmware keeps the way and the whole clocks of every phase, so its speeds differ a little
    from the planned ones; here the whole way is kept.

    Parameters
    ----------
    times : ndarray, shape (4, n)
        t, acceleration, cruise, deceleration.
    starts, directions : ndarray, shape (n, 4)
    speeds : ndarray, shape (4, n)
        Start, cruise, end speed and acceleration.
    """
    for m in range(last - first):
        row = queue[first + m]
        up_s, level_s, down_s = _whole_clocks(row, clock_hz)
        accel = row[Q_ACCEL]
        one_ramp = row[Q_UP] == row[Q_PATH] or row[Q_DOWN] == row[Q_PATH]
        if one_ramp and up_s + down_s > 0.0:
            accel = abs(row[Q_OUT] - row[Q_IN]) / (up_s + down_s)
        lasts = up_s + level_s + down_s
        enter = 0.0
        if lasts > 0.0:
            rise = 0.5 * up_s * up_s + up_s * (level_s + down_s) - 0.5 * down_s * down_s
            enter = (row[Q_PATH] - accel * rise) / lasts
        times[0, m] = row[Q_BEGINS]
        times[1, m], times[2, m], times[3, m] = up_s, level_s, down_s
        for k in range(4):
            starts[m, k] = row[Q_START + k]
            directions[m, k] = row[Q_TRAVEL + k]
        speeds[0, m] = enter
        speeds[1, m] = enter + accel * up_s
        speeds[2, m] = speeds[1, m] - accel * down_s
        speeds[3, m] = accel
        index[m] = int(row[Q_INDEX])


@kernel
def drop(queue: Any, count: int, state: Any) -> int:
    """Move the rows that are not over to the front; return how many there are."""
    over = int(state[S_OVER])
    for m in range(over, count):
        for k in range(Q_SIZE):
            queue[m - over, k] = queue[m, k]
    state[S_OVER] = 0.0
    state[S_FROZEN] -= over
    state[S_HELD] -= over
    return count - over
