"""Kernels of the sampler: positions along phases at ascending times."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array
from stillpath.models.jit import kernel

__all__ = ["Plan", "distances", "sweep", "visit"]


class Plan(NamedTuple):
    """The columns of `gcode.types.Phases` that positions depend on."""

    t_s: Array
    accel_s: Array
    cruise_s: Array
    decel_s: Array
    start_mm: Array
    direction: Array
    start_mm_s: Array
    cruise_mm_s: Array
    accel_mm_s2: Array
    s_curve: NDArray[np.bool_]


@kernel(allocates=False)
def sweep(
    t0_s: float,
    dt_s: float,
    first: int,
    position: Any,
    row: Any,
    until: Any,
    inside: Any,
    plan: Plan,
) -> None:
    """Fill `position` and `row` (n) at t0 + (first + k) dt.

    `position` has at least the first two rows of x y z e. Between phases and after the last one the
    tool stands at the end of the previous phase. `inside` (n), or empty, receives whether samples
    are no later than `until` of their phase.
    """
    moves = len(plan.t_s)
    count = len(row)
    axes = len(position)
    k = 0
    for m in range(moves):
        # Samples k..stop - 1 belong to this move.
        stop = count
        if m + 1 < moves:
            next_s = plan.t_s[m + 1]
            stop = _place(next_s, t0_s, dt_s, first, k, count)
            while stop > k and t0_s + (first + stop - 1) * dt_s >= next_s:
                stop -= 1
            while stop < count and t0_s + (first + stop) * dt_s < next_s:
                stop += 1
        if stop == k:
            continue
        begin, accel, cruise, decel, v0, v1, rate, eased = _move(plan, m)
        # One loop per part of the move avoids branches per sample; x holds the path length first.
        way, number = position[0, k:stop], first + k
        if eased:
            for i in range(len(way)):
                left = t0_s + (number + i) * dt_s - begin
                way[i] = _way(left, accel, cruise, decel, v0, v1, rate, True)
        else:
            risen = _passed(begin, 0.0, accel, t0_s, dt_s, first, k, stop)
            steady = _passed(begin, accel, cruise, t0_s, dt_s, first, risen, stop)
            for i in range(risen - k):
                rising = max(t0_s + (number + i) * dt_s - begin, 0.0)
                way[i] = (v0 + 0.5 * rate * rising) * rising
            lifted = (v0 + 0.5 * rate * accel) * accel
            way, number = position[0, risen:stop], first + risen
            for i in range(steady - risen):
                way[i] = lifted + v1 * (t0_s + (number + i) * dt_s - begin - accel)
            lifted += v1 * cruise
            way, number = position[0, steady:stop], first + steady
            for i in range(len(way)):
                falling = min(t0_s + (number + i) * dt_s - begin - accel - cruise, decel)
                way[i] = lifted + (v1 - 0.5 * rate * falling) * falling
        way = position[0, k:stop]
        for axis in range(axes - 1, -1, -1):
            along = position[axis, k:stop]
            origin, slope = plan.start_mm[m, axis], plan.direction[m, axis]
            for i in range(len(way)):
                along[i] = origin + slope * way[i]
        row[k:stop] = m
        if len(inside) > 0:
            part, last_s, number = inside[k:stop], until[m], first + k
            for i in range(len(part)):
                part[i] = t0_s + (number + i) * dt_s <= last_s
        k = stop


@kernel(inline=True, allocates=False)
def _move(plan: Plan, m: int) -> tuple[float, float, float, float, float, float, float, bool]:
    """Return begin, lengths of the three phases, speeds, acceleration and shape of a move."""
    return (
        plan.t_s[m],
        plan.accel_s[m],
        plan.cruise_s[m],
        plan.decel_s[m],
        plan.start_mm_s[m],
        plan.cruise_mm_s[m],
        plan.accel_mm_s2[m],
        plan.s_curve[m],
    )


@kernel(inline=True, allocates=False)
def _place(t_s: float, t0_s: float, dt_s: float, first: int, low: int, high: int) -> int:
    """Return an estimate of the first sample not before a time, within low to high."""
    guess = np.ceil((t_s - t0_s) / dt_s) - first
    return int(min(max(guess, float(low)), float(high)))


@kernel(inline=True, allocates=False)
def _passed(
    begin: float,
    before: float,
    lasts: float,
    t0_s: float,
    dt_s: float,
    first: int,
    low: int,
    high: int,
) -> int:
    """Return the first sample, low to high, after a part of a move.

    The part begins `before` seconds into the move, and has the duration `lasts`.
    """
    at = _place(begin + before + lasts, t0_s, dt_s, first, low, high)
    while at > low and t0_s + (first + at - 1) * dt_s - begin - before > lasts:
        at -= 1
    while at < high and t0_s + (first + at) * dt_s - begin - before <= lasts:
        at += 1
    return at


@kernel(allocates=False)
def visit(
    times: Any,
    position: Any,
    row: Any,
    plan: Plan,
) -> None:
    """Fill `position` and `row` (n) as `sweep` does, at rising `times`."""
    m = 0
    for i in range(len(times)):
        while m + 1 < len(plan.t_s) and times[i] >= plan.t_s[m + 1]:
            m += 1
        begin, accel, cruise, decel, v0, v1, rate, eased = _move(plan, m)
        path = _way(times[i] - begin, accel, cruise, decel, v0, v1, rate, eased)
        for axis in range(len(position)):
            position[axis, i] = plan.start_mm[m, axis] + plan.direction[m, axis] * path
        row[i] = m


@kernel(allocates=False)
def distances(
    dt_s: float,
    first: Any,
    late_s: Any,
    until_s: Any,
    points: Any,
    out: Any,
    plan: Plan,
) -> None:
    """Fill `out` (n) with the distance in x y between `points` (2, n) and the tool.

    The points from `first[g]` on, up to the next of these, belong to k dt + late, `until` at the
    latest. Time never goes back.
    """
    t_s, start_mm, direction = plan.t_s, plan.start_mm, plan.direction
    moves, count = len(t_s), len(out)
    m = 0
    begin, accel, cruise, decel, v0, v1, rate, eased = _move(plan, 0)
    x, y, dx, dy = start_mm[0, 0], start_mm[0, 1], direction[0, 0], direction[0, 1]
    next_s = t_s[1] if moves > 1 else np.inf
    t = -np.inf
    for g in range(len(first)):
        late, until = late_s[g], until_s[g]
        for k in range(first[g], first[g + 1] if g + 1 < len(first) else count):
            t = max(t, min(k * dt_s + late, until))
            if t >= next_s:
                while m + 1 < moves and t >= t_s[m + 1]:
                    m += 1
                begin, accel, cruise, decel, v0, v1, rate, eased = _move(plan, m)
                x, y, dx, dy = start_mm[m, 0], start_mm[m, 1], direction[m, 0], direction[m, 1]
                next_s = t_s[m + 1] if m + 1 < moves else np.inf
            path = _way(t - begin, accel, cruise, decel, v0, v1, rate, eased)
            gap_x, gap_y = x + dx * path - points[0, k], y + dy * path - points[1, k]
            out[k] = np.sqrt(gap_x * gap_x + gap_y * gap_y)


@kernel(inline=True, allocates=False)
def _way(
    left: float,
    accel: float,
    cruise: float,
    decel: float,
    v0: float,
    v1: float,
    rate: float,
    eased: bool,
) -> float:
    """Return the distance along a move after a time.

    On an s_curve the speed between v and v + d follows Marlin's quintic Bezier,
    v + d (10 u^3 - 15 u^4 + 6 u^5) with u from 0 to 1 (stepper.cpp, bugfix-2.1.x, 2026-08).
    """
    rising = min(max(left, 0.0), accel)
    path = _eased(v0, rate, accel, rising) if eased else (v0 + 0.5 * rate * rising) * rising
    left -= accel
    if left > 0.0:
        path += v1 * min(left, cruise)
        left -= cruise
        if left > 0.0:
            falling = min(left, decel)
            if eased:
                path += _eased(v1, -rate, decel, falling)
            else:
                path += (v1 - 0.5 * rate * falling) * falling
    return path


@kernel(inline=True, allocates=False)
def _eased(v_mm_s: float, accel_mm_s2: float, whole_s: float, part_s: float) -> float:
    """Return the distance after `part_s` of a Bezier speed change by ``accel * whole_s``."""
    u = part_s / whole_s if whole_s > 0.0 else 0.0
    bend = u * u * u * u * (2.5 + u * (u - 3.0))
    return v_mm_s * part_s + accel_mm_s2 * whole_s * whole_s * bend
