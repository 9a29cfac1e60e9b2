"""Kernels that choose the samples at which the largest errors are sought, each in one pass."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array, Ints
from stillpath.models.jit import kernel

__all__ = ["above", "ringing"]


@kernel(allocates=False)
def ringing(
    path: Array,
    extruding: NDArray[np.bool_],
    before: Array,
    still_mm: float,
    reach: int,
    printed: int,
    moved: int,
    chosen: Ints,
) -> tuple[int, int, int]:
    """Choose the samples behind ends of lines, until the path moves on or `reach` samples passed.

    Parameters
    ----------
    path : ndarray, shape (2, n)
    extruding : ndarray of bool, shape (n,)
    before : ndarray, shape (2,)
        The path's sample before.
    still_mm : float
        Shorter steps of either axis are standing still.
    printed, moved : int
        The last sample that extruded, and the last that moved: negative before the path.
    chosen : ndarray of int64, shape (2, n)
        Filled: the samples, and the last one of their line.

    Returns
    -------
    count, printed, moved : int
    """
    count = 0
    last_x, last_y = before[0], before[1]
    for k in range(path.shape[1]):
        x, y = path[0, k], path[1, k]
        if abs(x - last_x) > still_mm or abs(y - last_y) > still_mm:
            moved = k
        last_x, last_y = x, y
        if extruding[k]:
            printed = k
        # The last sample of a line may lie just before its end.
        elif k - printed <= reach and moved <= printed + 1:
            chosen[0, count], chosen[1, count] = k, printed
            count += 1
    return count, printed, moved


@kernel(allocates=False)
def above(path: Array, answer: Array, feature: NDArray[np.int32], most: Array, chosen: Ints) -> int:
    """Choose the samples whose tracking error is above their feature's largest error so far.

    Parameters
    ----------
    path, answer : ndarray, shape (2, n)
    feature : ndarray of int32, shape (n,)
        From -1 on; below: none.
    most : ndarray, shape (features + 1,)
        Of features -1, 0, ..; 0 beyond.
    chosen : ndarray of int64, shape (n,)
        Filled with the samples.

    Returns
    -------
    int
        Their number.
    """
    count = 0
    for k in range(path.shape[1]):
        at = feature[k] + 1
        if at >= 0:
            x, y = answer[0, k] - path[0, k], answer[1, k] - path[1, k]
            limit = most[at] if at < len(most) else 0.0
            if x * x + y * y > limit * limit:
                chosen[count] = k
                count += 1
    return count
