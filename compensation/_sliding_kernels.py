"""Loops of the sliding targets; `compensation.fbf` uses them, docs/method.md explains them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.jit import kernel

__all__ = ["move_targets"]

Array = NDArray[np.float64]


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
    """Move the targets of one member towards its own answer, along the path only, in place.

    Parameters
    ----------
    path, answer : ndarray, shape (2, n)
        Planned positions, and what the member does with the present command.
    extruding : ndarray of bool, shape (n,)
    tau : float
        Weight of the error along the path against that across it, 0 to 1.
    travel : float
        Weight of the whole error where nothing is extruded.
    reach : int
        The nearest point is looked for so many samples before and after.
    relaxation : float
        1: to the new targets; up to 1.9: beyond them.
    targets : ndarray, shape (2, n)
    """
    n = path.shape[1]
    for k in range(n):
        px, py = path[0, k], path[1, k]
        x, y = answer[0, k], answer[1, k]
        if extruding[k]:
            nearest = np.inf
            bx, by = px, py
            for i in range(max(0, k - reach), min(n - 1, k + reach)):
                dx, dy = path[0, i + 1] - path[0, i], path[1, i + 1] - path[1, i]
                ex, ey = x - path[0, i], y - path[1, i]
                size = dx * dx + dy * dy
                if size > 0.0:
                    share = min(1.0, max(0.0, (ex * dx + ey * dy) / size))
                    ex -= share * dx
                    ey -= share * dy
                squared = ex * ex + ey * ey
                if squared < nearest:
                    nearest = squared
                    bx, by = x - ex, y - ey
            tx, ty = bx + tau * (px - bx), by + tau * (py - by)
        else:
            tx, ty = x + travel * (px - x), y + travel * (py - y)
        targets[0, k] += relaxation * (tx - targets[0, k])
        targets[1, k] += relaxation * (ty - targets[1, k])
