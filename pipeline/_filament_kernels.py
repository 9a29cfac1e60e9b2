"""Kernel that smooths filament along a path."""

from __future__ import annotations

import math
from typing import Any

from stillpath.models.jit import kernel

__all__ = ["smooth_along"]

_LEAST_REACH_MM = 1e-3


@kernel(allocates=False)
def smooth_along(
    xy_mm: Any, fed_mm: Any, way_mm: Any, area: Any, reach: float, most_mm: float
) -> None:
    """Replace the filament along a path by its moving mean over the path, in place.

    Parameters
    ----------
    xy_mm : ndarray, shape (2, n)
    fed_mm : ndarray, shape (n,)
        Position of the filament.
    way_mm, area : ndarray, shape (n,)
        Work space.
    reach, most_mm : float
        Half-width of the mean: a multiple of the filament per mm of path, and the most in mm.
    """
    n, start_mm = len(fed_mm), fed_mm[0]
    way_mm[0] = area[0] = 0.0
    for i in range(1, n):
        step_mm = math.hypot(xy_mm[0, i] - xy_mm[0, i - 1], xy_mm[1, i] - xy_mm[1, i - 1])
        way_mm[i] = way_mm[i - 1] + step_mm
        between_mm = 0.5 * (fed_mm[i] + fed_mm[i - 1]) - start_mm
        area[i] = area[i - 1] + between_mm * (way_mm[i] - way_mm[i - 1])
    end_mm = way_mm[n - 1]
    if end_mm <= 0.0:
        return
    half_mm = min(reach * (fed_mm[n - 1] - start_mm) / end_mm, most_mm)
    low = high = 0
    for i in range(n):
        # The mean narrows towards both ends, so that the total is unchanged.
        width_mm = min(way_mm[i], end_mm - way_mm[i], half_mm)
        if width_mm <= _LEAST_REACH_MM:
            continue
        first_mm, last_mm = way_mm[i] - width_mm, way_mm[i] + width_mm
        while low < n - 2 and way_mm[low + 1] <= first_mm:
            low += 1
        while high < n - 2 and way_mm[high + 1] <= last_mm:
            high += 1
        begins = area[low] + (first_mm - way_mm[low]) * _slope(way_mm, area, low)
        ends = area[high] + (last_mm - way_mm[high]) * _slope(way_mm, area, high)
        fed_mm[i] = start_mm + (ends - begins) / (2.0 * width_mm)


@kernel(allocates=False)
def _slope(way_mm: Any, area: Any, i: int) -> float:
    step_mm = way_mm[i + 1] - way_mm[i]
    return (area[i + 1] - area[i]) / step_mm if step_mm > 0.0 else 0.0
