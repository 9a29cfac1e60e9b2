"""Loops that every encoder needs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.jit import kernel

__all__ = ["merge_still", "round_ends"]


@kernel
def round_ends(
    end_mm: NDArray[np.float64],
    group: NDArray[np.int64],
    grid: NDArray[np.int64],
    units_per_mm: float,
    position: NDArray[np.int64],
) -> None:
    """Round the ends of segments, (4, n), to units, (n, 4), and X Y Z to the grid.

    `grid` (3,) is in units. The last end of every group keeps all digits.
    """
    count = len(group)
    for axis in range(4):
        for i in range(count):
            value = np.round(end_mm[axis, i] * units_per_mm)
            final = i + 1 == count or group[i + 1] != group[i]
            if axis < 3 and not final:
                value = grid[axis] * np.round(value / grid[axis])
            position[i, axis] = np.int64(value)


@kernel
def merge_still(
    position: NDArray[np.int64],
    end_s: NDArray[np.float64],
    group: NDArray[np.int64],
    begin: NDArray[np.int64],
    keep: NDArray[np.bool_],
) -> None:
    """Drop segments that round to no motion; their time and filament go to a neighbour.

    `position` (n, 4) in nanometres-like integers (1e-6 mm) is edited in place; `begin` (groups, 4)
    holds where each group starts.
    """
    count = len(end_s)
    last_kept = -1
    previous = begin[0].copy()
    for i in range(count):
        if i == 0 or group[i] != group[i - 1]:
            previous[:] = begin[group[i]]
            last_kept = -1
        still = (
            position[i, 0] == previous[0]
            and position[i, 1] == previous[1]
            and position[i, 2] == previous[2]
        )
        final = i + 1 == count or group[i + 1] != group[i]
        if still and not final:
            keep[i] = False
        elif still and last_kept >= 0:
            # Nothing follows in this stretch: the segment before takes filament and time.
            keep[i] = False
            position[last_kept, 3] = position[i, 3]
            end_s[last_kept] = end_s[i]
        elif still and position[i, 3] == previous[3]:
            keep[i] = False
        else:
            keep[i] = True
            last_kept = i
            previous[:] = position[i]
