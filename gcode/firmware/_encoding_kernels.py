"""Kernels shared by several encoders."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array
from stillpath.models.jit import kernel

__all__ = ["MoveLimits", "lay_out"]


class MoveLimits(NamedTuple):
    """Limits of every move in a firmware, without look-ahead; arrays of shape (n,).

    Attributes
    ----------
    length_mm : ndarray
        In X Y Z, or of filament if these stand.
    accel_mm_s2, speed_mm_s : ndarray
    junction_mm_s : ndarray
        Highest speed where the move begins.
    """

    length_mm: Array
    accel_mm_s2: Array
    speed_mm_s: Array
    junction_mm_s: Array


@kernel(allocates=False)
def lay_out(
    end_mm: NDArray[np.float64],
    end_s: NDArray[np.float64],
    segment_group: NDArray[np.int64],
    groups: NDArray[np.int64],
    group_start_s: NDArray[np.float64],
    asked: NDArray[np.int64],
    grid: NDArray[np.int64],
    units_per_mm: float,
    row: NDArray[np.int64],
    position: NDArray[np.int64],
    move_end_s: NDArray[np.float64],
    planned_s: NDArray[np.float64],
    group: NDArray[np.int64],
) -> int:
    """Round segments, insert the rests' own moves between them; return the number of moves.

    Segments that round to no motion are dropped; their time and filament go to a neighbour.

    Parameters
    ----------
    end_mm, end_s, segment_group : ndarray, shapes (4, n), (n,) and (n,)
        As in `gcode.segments.Segments`.
    groups : ndarray of int64, shape (groups, 3)
        First row, one past the last row, and 1 for a rest.
    asked : ndarray of int64, shape (rows + 1, 4)
        Position in the file before the first row and after every row, in units.
    grid : ndarray of int64, shape (3,)
        Grid of X, Y and Z in units; the last end of every group is what the file wants.
    row, position, move_end_s, planned_s, group : ndarray
        As in `gcode.firmware.encoding.Interleaved`, with room for all segments and rows.
    """
    count = at = 0
    for g in range(len(groups)):
        first, last = groups[g, 0], groups[g, 1]
        if groups[g, 2]:
            for r in range(first, last):
                row[count], group[count] = r, g
                move_end_s[count] = planned_s[count] = 0.0
                for axis in range(4):
                    position[count, axis] = asked[r + 1, axis]
                count += 1
            continue
        x0, y0, z0, e0 = asked[first, 0], asked[first, 1], asked[first, 2], asked[first, 3]
        # Do not write Z where the file does not: it may be off the grid or unknown.
        level = True
        for r in range(first, last):
            level = level and asked[r + 1, 2] == z0
        begun, begin_s, now_s = count, group_start_s[g], group_start_s[g]
        while at < len(end_s) and segment_group[at] == g:
            final = at + 1 == len(end_s) or segment_group[at + 1] != g
            if final:
                x, y, z, e = asked[last, 0], asked[last, 1], asked[last, 2], asked[last, 3]
            else:
                x = _on_grid(end_mm[0, at] * units_per_mm, grid[0])
                y = _on_grid(end_mm[1, at] * units_per_mm, grid[1])
                z = z0 if level else _on_grid(end_mm[2, at] * units_per_mm, grid[2])
                e = _on_grid(end_mm[3, at] * units_per_mm, 1)
            if x != x0 or y != y0 or z != z0 or (final and count == begun and e != e0):
                row[count], group[count] = -1, g
                position[count, 0], position[count, 1] = x, y
                position[count, 2], position[count, 3] = z, e
                begin_s, now_s = now_s, end_s[at]
                move_end_s[count], planned_s[count] = now_s, now_s - begin_s
                x0, y0, z0, e0 = x, y, z, e
                count += 1
            elif final and count > begun:
                # The last of its stretch: the previous segment takes its filament and time.
                position[count - 1, 3] = e
                move_end_s[count - 1], planned_s[count - 1] = end_s[at], end_s[at] - begin_s
            at += 1
    return count


@kernel(force_inline=True, allocates=False)
def _on_grid(units: float, grid: int) -> int:
    return grid * int(np.round(np.round(units) / grid))
