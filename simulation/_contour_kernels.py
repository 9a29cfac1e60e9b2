"""Loops of the error measures; `simulation.measures` gives them names and checks."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from models.jit import kernel

__all__ = ["arc_length", "contour_distances", "group_sums", "residual_sums"]

Array = NDArray[np.float64]
_MARGIN_MM = 1e-9
"""Arc lengths are sums with rounding errors; jumps stay shorter by this much."""


@kernel
def arc_length(path: Array, s: Array) -> None:
    """Fill `s` with the length of the polyline `path`, shape (2, n), from its first vertex."""
    total = 0.0
    for j in range(path.shape[1]):
        if j > 0:
            total += math.hypot(path[0, j] - path[0, j - 1], path[1, j] - path[1, j - 1])
        s[j] = total


@kernel
def _segment_squared(path: Array, j: int, px: float, py: float) -> float:
    """Squared distance from a point to the segment between the vertices j and j + 1."""
    ax, ay = path[0, j], path[1, j]
    dx, dy = path[0, j + 1] - ax, path[1, j + 1] - ay
    ex, ey = px - ax, py - ay
    size = dx * dx + dy * dy
    if size > 0.0:
        along = (ex * dx + ey * dy) / size
        along = min(1.0, max(0.0, along))
        ex -= along * dx
        ey -= along * dy
    squared: float = ex * ex + ey * ey
    return squared


@kernel
def contour_distances(
    path: Array,
    s: Array,
    points: Array,
    centres: NDArray[np.int64],
    window: int,
    out: Array,
) -> int:
    """Distance of points to the stretch of the path that is near them in time.

    Point i belongs to the vertex `centres[i]` of the path; its distance is taken to the segments
    between the vertices up to `window` before and after.

    From a vertex at distance D the path must be at least D - best long before it can come
    nearer than `best`, so the search leaps to the segment in which that length runs out.
    Going straight, D grows with the length, and the leaps double.

    Returns
    -------
    int
        Segments looked at.
    """
    n = path.shape[1]
    looked = 0
    lag = 0
    for i in range(len(out)):
        px, py = points[0, i], points[1, i]
        centre = centres[i]
        low = max(0, centre - window)
        high = min(n - 1, centre + window)
        # The lag of the point before is nearly always right.
        start = min(max(centre + lag, low), max(high - 1, low))
        if high == low:
            out[i] = math.hypot(px - path[0, low], py - path[1, low])
            continue
        best2 = _segment_squared(path, start, px, py)
        best = math.sqrt(best2)
        best_at = start
        looked += 1
        j = start + 1
        while j < high:
            ex, ey = px - path[0, j], py - path[1, j]
            reach = math.sqrt(ex * ex + ey * ey) - best - _MARGIN_MM
            # The segment j..j+1 when nothing may be skipped, else the one where `reach` ends.
            if reach > 0.0:
                goal = s[j] + reach
                if s[high] <= goal:
                    break
                step = 1
                while j + step < high and s[j + step] <= goal:
                    j += step
                    step *= 2
                while step > 0:
                    if j + step < high and s[j + step] <= goal:
                        j += step
                    step //= 2
            found2 = _segment_squared(path, j, px, py)
            looked += 1
            if found2 < best2:
                best2, best, best_at = found2, math.sqrt(found2), j
            j += 1
        j = start
        while j > low:
            ex, ey = px - path[0, j], py - path[1, j]
            reach = math.sqrt(ex * ex + ey * ey) - best - _MARGIN_MM
            if reach > 0.0:
                goal = s[j] - reach
                if s[low] >= goal:
                    break
                step = 1
                while j - step > low and s[j - step] >= goal:
                    j -= step
                    step *= 2
                while step > 0:
                    if j - step > low and s[j - step] >= goal:
                        j -= step
                    step //= 2
            found2 = _segment_squared(path, j - 1, px, py)
            looked += 1
            if found2 < best2:
                best2, best, best_at = found2, math.sqrt(found2), j - 1
            j -= 1
        out[i] = best
        lag = best_at - centre
    return looked


@kernel
def group_sums(
    values: Array,
    groups: NDArray[np.int32],
    use: NDArray[np.bool_],
    lowest: int,
    squares: Array,
    largest: Array,
    counts: NDArray[np.int64],
) -> None:
    """Add squares, maxima and counts of the used values to row `group - lowest`."""
    for k in range(len(values)):
        if use[k]:
            row = groups[k] - lowest
            value = values[k]
            squares[row] += value * value
            counts[row] += 1
            if value > largest[row]:
                largest[row] = value


@kernel
def residual_sums(
    path: Array, points: Array, state: Array, still_mm: float, shortest: int, window: int
) -> None:
    """Add up the deviation in the first `window` samples of every rest.

    A rest counts once `shortest` samples stood still after a motion. `state` is carried on:
    last x, y of the path, still samples (-1 before the first motion), pending square sum,
    count and maximum, settled square sum, count and maximum, and number of rests.
    """
    for k in range(path.shape[1]):
        x, y = path[0, k], path[1, k]
        if math.isnan(state[0]):
            state[0], state[1] = x, y
        moved = abs(x - state[0]) > still_mm or abs(y - state[1]) > still_mm
        state[0], state[1] = x, y
        if moved:
            # The sample at which the path arrives is the first of the rest.
            state[2] = 0.0
            state[3] = state[4] = state[5] = 0.0
        elif state[2] >= 0.0:
            state[2] += 1.0
        if state[2] < 0.0 or state[2] >= window:
            continue
        error = math.hypot(points[0, k] - x, points[1, k] - y)
        state[3] += error * error
        state[4] += 1.0
        state[5] = max(state[5], error)
        if state[2] >= shortest:
            if state[2] == shortest:
                state[9] += 1.0
            state[6] += state[3]
            state[7] += state[4]
            state[8] = max(state[8], state[5])
            state[3] = state[4] = state[5] = 0.0
