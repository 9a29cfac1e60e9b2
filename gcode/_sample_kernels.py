"""Kernel of the sampler: positions along phases at ascending times."""

from __future__ import annotations

from typing import Any

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
    position: Any,
    row: Any,
) -> None:
    """Fill `position` (4, n) and `row` (n) at `times`, or at t0 + (first + k) dt if it is empty.

    Between phases and behind the last one the tool stands where the phase before ended.
    """
    last = len(t_s) - 1
    m = 0
    for k in range(len(row)):
        t = times[k] if len(times) > 0 else t0_s + (first + k) * dt_s
        while m < last and t >= t_s[m + 1]:
            m += 1
        left = max(t - t_s[m], 0.0)
        part = min(left, accel_s[m])
        path = (start_mm_s[m] + 0.5 * accel_mm_s2[m] * part) * part
        left -= part
        if left > 0.0:
            part = min(left, cruise_s[m])
            path += cruise_mm_s[m] * part
            left -= part
            if left > 0.0:
                part = min(left, decel_s[m])
                path += (cruise_mm_s[m] - 0.5 * accel_mm_s2[m] * part) * part
        for axis in range(4):
            position[axis, k] = start_mm[m, axis] + direction[m, axis] * path
        row[k] = m
