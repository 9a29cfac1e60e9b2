"""Kernels of the sliding targets (`compensation.sliding`), explained in docs/method.md."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array
from stillpath.models.jit import kernel

__all__ = ["contour_square", "longest_step", "move_targets", "nearest_point"]


@kernel
def longest_step(path: Array) -> float:
    """Return the largest distance between neighbouring samples of a path (2, n)."""
    longest = 0.0
    for k in range(path.shape[1] - 1):
        dx, dy = path[0, k + 1] - path[0, k], path[1, k + 1] - path[1, k]
        longest = max(longest, dx * dx + dy * dy)
    return float(np.sqrt(longest))


@kernel
def nearest_point(
    path: Array, x: float, y: float, k: int, reach: int, longest: float
) -> tuple[float, float]:
    """Return the nearest point of the path (2, n) within `reach` samples of sample k.

    No step of the path is longer than `longest`.
    """
    n = path.shape[1]
    bx, by = path[0, k], path[1, k]
    nearest = (x - bx) ** 2 + (y - by) ** 2
    # A step that begins farther away cannot come nearer.
    limit = (np.sqrt(nearest) + longest) ** 2
    for i in range(max(0, k - reach), min(n - 1, k + reach)):
        ex, ey = x - path[0, i], y - path[1, i]
        if ex * ex + ey * ey > limit:
            continue
        dx, dy = path[0, i + 1] - path[0, i], path[1, i + 1] - path[1, i]
        size = dx * dx + dy * dy
        if size > 0.0:
            share = min(1.0, max(0.0, (ex * dx + ey * dy) / size))
            ex -= share * dx
            ey -= share * dy
        squared = ex * ex + ey * ey
        if squared < nearest:
            nearest = squared
            limit = (np.sqrt(nearest) + longest) ** 2
            bx, by = x - ex, y - ey
    return bx, by


@kernel
def move_targets(
    path: Array,
    answer: Array,
    extruding: NDArray[np.bool_],
    tau: float,
    travel: float,
    reach: int,
    relaxation: float,
    targets: Array,
) -> None:
    """Move the targets of one member towards its response, along the path only, in place.

    Parameters
    ----------
    path, answer : ndarray, shape (2, n)
        Planned positions, and the member's response to the present command.
    extruding : ndarray of bool, shape (n,)
    tau : float
        Weight of the error along the path against that across it, 0 to 1.
    travel : float
        Weight of the whole error where nothing is extruded.
    reach : int
        Samples before and after in which the nearest point is searched.
    relaxation : float
        1: exactly to the new targets; up to 1.9: beyond them (over-relaxation).
    targets : ndarray, shape (2, n)
    """
    longest = longest_step(path)
    for k in range(path.shape[1]):
        px, py = path[0, k], path[1, k]
        if extruding[k]:
            bx, by = nearest_point(path, answer[0, k], answer[1, k], k, reach, longest)
            tx, ty = bx + tau * (px - bx), by + tau * (py - by)
        else:
            tx = answer[0, k] + travel * (px - answer[0, k])
            ty = answer[1, k] + travel * (py - answer[1, k])
        targets[0, k] += relaxation * (tx - targets[0, k])
        targets[1, k] += relaxation * (ty - targets[1, k])


@kernel
def contour_square(
    path: Array, answer: Array, extruding: NDArray[np.bool_], reach: int, stride: int
) -> float:
    """Return the mean squared distance from the path while extruding, every `stride` samples."""
    total, count = 0.0, 0
    longest = longest_step(path)
    for k in range(0, path.shape[1], stride):
        if extruding[k]:
            bx, by = nearest_point(path, answer[0, k], answer[1, k], k, reach, longest)
            total += (answer[0, k] - bx) ** 2 + (answer[1, k] - by) ** 2
            count += 1
    return total / max(count, 1)
