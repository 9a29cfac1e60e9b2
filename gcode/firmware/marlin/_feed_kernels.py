"""Kernel that puts the steps of E into the moves of a stream that can bear them.

E moves by whole steps: one block has a step, the next one none. Junction deviation takes that for a
turn, and passes it, between moves of less than a millimetre, no faster than an arc of that turn and
that length: v2 = a length / turn. At 93 steps/mm a move of 0.1 mm that makes a step turns by 6
degrees (`planner.cpp`, `_populate_block`; 2.0.8, 2.1.2.5).
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.jit import kernel

__all__ = ["place_steps"]

_OPTIONS = 4
"""Places of a vertex: from one step below the whole one at or below the wish, to two above."""
_FREE = 0.7
"""Share of the acceleration that a turn may need before it counts."""
_NEAR = 0.01
"""Weight of the squared distance from the wish, in steps, relative to that of what is needed."""
_NO_FEED = 1e-6
"""Steps of a move without filament, but for rounding."""


@kernel
def place_steps(way: Array, speed: Array, wish: Array, step: float, accel: float) -> Array:
    """Choose a whole step for every vertex of a stretch, by the least cost of all its turns.

    Parameters
    ----------
    way : ndarray, shape (n, 3)
        Of every move, mm of the motors of X, Y and Z.
    speed : ndarray, shape (n,)
        mm/s.
    wish : ndarray, shape (n + 1,)
        Where E should be at the start and at every end, in steps from the start.
    step : float
        Of E, mm.
    accel : float
        Of the moves, mm/s2.

    Returns
    -------
    ndarray, shape (n + 1,)
        The nearest whole steps where there is no choice.
    """
    n = len(way)
    base = np.floor(wish)
    cost = np.full((n + 1, _OPTIONS, _OPTIONS), np.inf)
    came = np.zeros((n + 1, _OPTIONS, _OPTIONS), np.int64)
    for here in range(_OPTIONS):
        made = base[1] + here - 1.0
        if _allowed(made, wish[1] - wish[0]):
            cost[1, here, 1] = _NEAR * (made - wish[1]) ** 2
    for k in range(1, n):
        asked = wish[k + 1] - wish[k]
        gain = base[k + 1] - base[k]
        for here in range(_OPTIONS):
            for before in range(_OPTIONS):
                if cost[k, here, before] == np.inf:
                    continue
                earlier = base[k] - base[k - 1] + here - before
                for to in range(_OPTIONS):
                    made = gain + to - here
                    if not _allowed(made, asked):
                        continue
                    total = cost[k, here, before]
                    total += _turning(way, speed, k, step * earlier, step * made, accel)
                    total += _NEAR * (base[k + 1] + to - 1.0 - wish[k + 1]) ** 2
                    if total < cost[k + 1, to, here]:
                        cost[k + 1, to, here], came[k + 1, to, here] = total, before
    whole = np.floor(wish + 0.5)
    here = int(whole[n] - base[n]) + 1
    before = int(np.argmin(cost[n, here]))
    if cost[n, here, before] == np.inf:
        return whole
    for k in range(n, 0, -1):
        whole[k] = base[k] + here - 1.0
        here, before = before, came[k, here, before]
    return whole


@kernel(inline=True)
def _allowed(made: float, asked: float) -> bool:
    """Return whether steps go where the filament does; a move without filament makes none."""
    return made == 0.0 or made * asked > _NO_FEED


@kernel
def _turning(
    way: Array, speed: Array, k: int, before_mm: float, made_mm: float, accel: float
) -> float:
    """Return the cost of the turn into move k."""
    square, square0, path2 = made_mm * made_mm, before_mm * before_mm, 0.0
    dot = made_mm * before_mm
    for axis in range(3):
        path2 += way[k, axis] ** 2
        square0 += way[k - 1, axis] ** 2
        dot += way[k, axis] * way[k - 1, axis]
    square += path2
    size = sqrt(square * square0)
    if size == 0.0 or dot <= 0.0:
        return 0.0
    turn = sqrt(max(2.0 - 2.0 * dot / size, 0.0))
    needed = min(speed[k], speed[k - 1]) ** 2 * turn / (sqrt(path2) * accel + 1e-12)
    return float(max(needed - _FREE, 0.0) ** 2)
