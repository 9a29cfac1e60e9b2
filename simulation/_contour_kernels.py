"""Kernels of the error measures, wrapped and checked by `simulation.measures`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array
from stillpath.models.jit import kernel

__all__ = [
    "ALL",
    "BOX",
    "COUNTED",
    "EXTRUDING",
    "RESTING",
    "RESTS",
    "contour_distances",
    "contour_errors",
    "group_sums",
    "motion_sums",
    "path_tables",
]

BOX = 16
"""Segments of the path that share a box."""
_STRAIGHT_MM = 1e-11
"""A vertex this close to the line of a run continues it; rounding is smaller."""
ALL, EXTRUDING, PENDING, RESTING = 0, 2, 4, 6
"""Columns of sums of squares: of all samples, of those that extrude, of a rest that may yet count,
of rests that count. The column behind each has the maximum."""
LAST_X, LAST_Y, STILL, WAITING, COUNTED, RESTS = range(6)
"""Places in the state of a rest: the path's last point, samples since it moved (-1: it never did),
samples that may yet count, samples that count, rests that count."""


@kernel(allocates=False)
def path_tables(
    path: Array, first: NDArray[np.int64], last: NDArray[np.int64], boxes: Array
) -> None:
    """Prepare the polyline `path`, shape (2, n), for many distances.

    Collinear segments form one run, which is treated as a single segment.

    Parameters
    ----------
    first, last : ndarray, shape (n - 1,)
        Become the vertices at which the run of every segment begins and ends.
    boxes : ndarray, shape (ceil((n - 1) / BOX), 4)
        Becomes lowest x, highest x, lowest y, highest y of `BOX` segments each.
    """
    segments = path.shape[1] - 1
    begun = 0
    way_x = way_y = 0.0
    for j in range(segments):
        dx, dy = path[0, j + 1] - path[0, j], path[1, j + 1] - path[1, j]
        across = way_x * dy - way_y * dx
        off = across * across > _STRAIGHT_MM * _STRAIGHT_MM * (way_x * way_x + way_y * way_y)
        if off or way_x * dx + way_y * dy < 0.0:
            last[begun:j] = j
            begun = j
        first[j] = begun
        way_x, way_y = path[0, j + 1] - path[0, begun], path[1, j + 1] - path[1, begun]
    last[begun:] = segments
    for b in range(len(boxes)):
        x, y = path[0, b * BOX], path[1, b * BOX]
        left, right, below, above = x, x, y, y
        for j in range(b * BOX + 1, min(segments, (b + 1) * BOX) + 1):
            x, y = path[0, j], path[1, j]
            left, right = min(left, x), max(right, x)
            below, above = min(below, y), max(above, y)
        boxes[b, 0], boxes[b, 1], boxes[b, 2], boxes[b, 3] = left, right, below, above


@kernel(inline=True, allocates=False)
def _squared(path: Array, j: int, k: int, px: float, py: float) -> float:
    """Squared distance from a point to the straight line between the vertices j and k."""
    ax, ay = path[0, j], path[1, j]
    dx, dy = path[0, k] - ax, path[1, k] - ay
    ex, ey = px - ax, py - ay
    size = dx * dx + dy * dy
    if size > 0.0:
        along = min(1.0, max(0.0, (ex * dx + ey * dy) / size))
        ex -= along * dx
        ey -= along * dy
    squared: float = ex * ex + ey * ey
    return squared


@kernel(allocates=False)
def contour_distances(
    path: Array,
    first: NDArray[np.int64],
    last: NDArray[np.int64],
    boxes: Array,
    points: Array,
    centres: NDArray[np.int64],
    window: int,
    out: Array,
) -> int:
    """Compute the distances of points to the part of the path that is near them in time.

    Point i belongs to the vertex `centres[i]` of the path; its distance is taken to the segments
    between the vertices up to `window` before and after. The lag of the previous point is nearly
    always a good first guess; boxes whose segments are all further away are skipped.

    Returns
    -------
    int
        Number of straight lines examined.
    """
    n = path.shape[1]
    looked = 0
    lag = 0
    for i in range(len(out)):
        px, py = points[0, i], points[1, i]
        centre = centres[i]
        low = max(0, centre - window)
        high = min(n - 1, centre + window)
        if high == low:
            out[i] = math.hypot(px - path[0, low], py - path[1, low])
            continue
        best_at = min(max(centre + lag, low), high - 1)
        begin, end = max(low, first[best_at]), min(high, last[best_at])
        best2 = _squared(path, begin, end, px, py)
        looked += 1
        j = low
        while j < high:
            if begin <= j < end:
                j = end
                continue
            b = j // BOX
            stop = min(high, (b + 1) * BOX)
            ex = max(boxes[b, 0] - px, px - boxes[b, 1], 0.0)
            ey = max(boxes[b, 2] - py, py - boxes[b, 3], 0.0)
            if ex * ex + ey * ey >= best2:
                j = stop
                continue
            while j < stop:
                k = min(high, last[j])
                found2 = _squared(path, j, k, px, py)
                looked += 1
                if found2 < best2:
                    best2, best_at = found2, j
                j = k
        out[i] = math.sqrt(best2)
        lag = best_at - centre
    return looked


@kernel(allocates=False)
def contour_errors(
    path: Array,
    first: NDArray[np.int64],
    last: NDArray[np.int64],
    boxes: Array,
    points: Array,
    centres: NDArray[np.int64],
    window: int,
    out: Array,
) -> int:
    """Run `path_tables`, then `contour_distances` for points (channels, 2, m) of all channels."""
    path_tables(path, first, last, boxes)
    looked = 0
    for c in range(len(points)):
        looked += contour_distances(path, first, last, boxes, points[c], centres, window, out[c])
    return looked


@kernel(allocates=False)
def group_sums(
    values: Array,
    groups: NDArray[np.int32],
    use: NDArray[np.bool_],
    lowest: int,
    squares: Array,
    largest: Array,
    counts: NDArray[np.int64],
) -> None:
    """Add squares, maxima and counts of the used values to row `group - lowest`.

    `values`, `squares` and `largest` have one row per channel.
    """
    for k in range(len(groups)):
        if use[k]:
            row = groups[k] - lowest
            counts[row] += 1
            for c in range(len(values)):
                value = values[c, k]
                squares[c, row] += value * value
                largest[c, row] = max(largest[c, row], value)


@kernel(allocates=False)
def motion_sums(
    x: Array,
    y: Array,
    points: Array,
    extruding: NDArray[np.bool_],
    still_mm: float,
    shortest: int,
    window: int,
    rest: Array,
    sums: Array,
) -> None:
    """Sum the distances of points to the path's point at the same instant.

    Parameters
    ----------
    x, y : ndarray, shape (n,)
        The path as separate rows, since a slice of columns would have to be copied.
    points : ndarray, shape (channels, 2, n)
    still_mm : float
        Changes of an axis up to this do not count as motion.
    shortest, window : int
        The first `window` samples of a rest count if it has at least `shortest`.
    rest : ndarray, shape (6,)
        Updated in place: `LAST_X` to `RESTS`.
    sums : ndarray, shape (channels, 8)
        Updated in place: sum and maximum of squares at `ALL`, `EXTRUDING`, `PENDING`, `RESTING`.
    """
    n = len(x)
    if n > 0 and math.isnan(rest[LAST_X]):
        rest[LAST_X], rest[LAST_Y] = x[0], y[0]
    k = 0
    while k < n:
        next_k = k
        while next_k < n and _moved(x, y, next_k, rest, still_mm):
            next_k += 1
        # While the path moves, samples do not belong to rests.
        last = next_k - 1 if shortest > 0 else k
        if k < last:
            _add_squares(x[k:last], y[k:last], points[:, :, k:last], extruding[k:last], sums)
            k = last
        moved = next_k > k
        _add_sample(x, y, points, extruding, k, moved, shortest, window, rest, sums)
        k += 1
    if n > 0:
        rest[LAST_X], rest[LAST_Y] = x[n - 1], y[n - 1]


@kernel(inline=True, allocates=False)
def _moved(x: Array, y: Array, k: int, rest: Array, still_mm: float) -> bool:
    last_x, last_y = (x[k - 1], y[k - 1]) if k > 0 else (rest[LAST_X], rest[LAST_Y])
    moved: bool = abs(x[k] - last_x) > still_mm or abs(y[k] - last_y) > still_mm
    return moved


@kernel(allocates=False)
def _add_squares(
    x: Array, y: Array, points: Array, extruding: NDArray[np.bool_], sums: Array
) -> None:
    """Add samples that belong to no rest."""
    for c in range(len(points)):
        total, most = sums[c, ALL], sums[c, ALL + 1]
        printed, printed_most = sums[c, EXTRUDING], sums[c, EXTRUDING + 1]
        for k in range(len(extruding)):
            ex, ey = points[c, 0, k] - x[k], points[c, 1, k] - y[k]
            squared = ex * ex + ey * ey
            total += squared
            # A comparison, which does not depend on the maximum of the samples before.
            if squared > most:
                most = squared
            if extruding[k]:
                printed += squared
                if squared > printed_most:
                    printed_most = squared
        sums[c, ALL], sums[c, ALL + 1] = total, most
        sums[c, EXTRUDING], sums[c, EXTRUDING + 1] = printed, printed_most


@kernel(force_inline=True, allocates=False)
def _add_sample(
    x: Array,
    y: Array,
    points: Array,
    extruding: NDArray[np.bool_],
    k: int,
    moved: bool,
    shortest: int,
    window: int,
    rest: Array,
    sums: Array,
) -> None:
    """Add a sample that may belong to a rest."""
    if moved:
        # The sample at which the path arrives is the first of the rest.
        rest[STILL] = rest[WAITING] = 0.0
    elif rest[STILL] >= 0.0:
        rest[STILL] += 1.0
    rests = 0.0 <= rest[STILL] < window
    settled = rests and rest[STILL] >= shortest
    if rests:
        rest[WAITING] += 1.0
    if settled:
        rest[COUNTED] += rest[WAITING]
        rest[WAITING] = 0.0
        rest[RESTS] += 1.0 if rest[STILL] == shortest else 0.0
    for c in range(len(points)):
        ex, ey = points[c, 0, k] - x[k], points[c, 1, k] - y[k]
        squared = ex * ex + ey * ey
        sums[c, ALL] += squared
        sums[c, ALL + 1] = max(sums[c, ALL + 1], squared)
        if extruding[k]:
            sums[c, EXTRUDING] += squared
            sums[c, EXTRUDING + 1] = max(sums[c, EXTRUDING + 1], squared)
        if moved:
            sums[c, PENDING] = sums[c, PENDING + 1] = 0.0
        if rests:
            sums[c, PENDING] += squared
            sums[c, PENDING + 1] = max(sums[c, PENDING + 1], squared)
        if settled:
            sums[c, RESTING] += sums[c, PENDING]
            sums[c, RESTING + 1] = max(sums[c, RESTING + 1], sums[c, PENDING + 1])
            sums[c, PENDING] = sums[c, PENDING + 1] = 0.0
