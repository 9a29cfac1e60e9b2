"""Kernel of the sampler: positions along phases at ascending times."""

from __future__ import annotations

from typing import Any

import numpy as np

from models.jit import kernel

__all__ = ["sweep"]


@kernel
def sweep(
    times: Any,
    t0_s: float,
    dt_s: float,
    first: int,
    t_s: Any,
    accel_s: Any,
    cruise_s: Any,
    decel_s: Any,
    start_mm: Any,
    direction: Any,
    start_mm_s: Any,
    cruise_mm_s: Any,
    accel_mm_s2: Any,
    s_curve: Any,
    position: Any,
    row: Any,
) -> None:
    """Fill `position` (4, n) and `row` (n) at `times`, or at t0 + (first + k) dt if it is empty.

    On an s_curve the speed between v and v + d follows Marlin's quintic Bezier,
    v + d (10 u^3 - 15 u^4 + 6 u^5) with u from 0 to 1 (stepper.cpp, bugfix-2.1.x, 2026-08).
    Between phases and behind the last one the tool stands where the phase before ended.
    """
    moves = len(t_s)
    count = len(row)
    given = len(times) > 0
    k = 0
    for m in range(moves):
        # Samples k..stop - 1 belong to this move.
        stop = count
        if m + 1 < moves:
            behind = t_s[m + 1]
            if given:
                stop = k
                while stop < count and times[stop] < behind:
                    stop += 1
            else:
                guess = np.ceil((behind - t0_s) / dt_s) - first
                stop = int(min(max(guess, float(k)), float(count)))
                while stop > k and t0_s + (first + stop - 1) * dt_s >= behind:
                    stop -= 1
                while stop < count and t0_s + (first + stop) * dt_s < behind:
                    stop += 1
        begin, accel, cruise, decel = t_s[m], accel_s[m], cruise_s[m], decel_s[m]
        v0, v1, rate, eased = start_mm_s[m], cruise_mm_s[m], accel_mm_s2[m], s_curve[m]
        x, y, z, e = start_mm[m]
        dx, dy, dz, de = direction[m]
        for i in range(k, stop):
            t = times[i] if given else t0_s + (first + i) * dt_s
            left = max(t - begin, 0.0)
            rising = min(left, accel)
            left -= rising
            steady = min(left, cruise)
            falling = min(left - steady, decel)
            if eased:
                path = _eased(v0, rate, accel, rising) + v1 * steady
                path += _eased(v1, -rate, decel, falling)
            else:
                path = (v0 + 0.5 * rate * rising) * rising + v1 * steady
                path += (v1 - 0.5 * rate * falling) * falling
            position[0, i] = x + dx * path
            position[1, i] = y + dy * path
            position[2, i] = z + dz * path
            position[3, i] = e + de * path
            row[i] = m
        k = stop


@kernel(inline=True)
def _eased(v_mm_s: float, accel_mm_s2: float, whole_s: float, part_s: float) -> float:
    """Way after `part_s` of a change of speed by ``accel * whole_s`` along the Bezier curve."""
    u = part_s / whole_s if whole_s > 0.0 else 0.0
    bend = u * u * u * u * (2.5 + u * (u - 3.0))
    return v_mm_s * part_s + accel_mm_s2 * whole_s * whole_s * bend
