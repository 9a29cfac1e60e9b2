"""Kernels of an estimator's queue: entry speeds by look-ahead over a limited number of blocks."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from stillpath.models.jit import kernel

__all__ = ["queue_times", "trapezoid_s"]

QUEUE = 64
REFRESH = 4 * QUEUE
_DISTANCE, _ACCEL, _CRUISE, _SAFE, _MOST, _ENTRY, _FREE, _CHANGED, _TIME = range(9)


@kernel
def trapezoid_s(entry: float, cruise: float, leave: float, accel: float, distance: float) -> float:
    """Return the time of a block; if too short, it does not reach its exit speed."""
    up = max(0.0, (cruise * cruise - entry * entry) / (2.0 * accel))
    down = max(0.0, (cruise * cruise - leave * leave) / (2.0 * accel))
    level = distance - up - down
    if level < 0.0:
        up = (2.0 * accel * distance - entry * entry + leave * leave) / (4.0 * accel)
        up = min(max(up, 0.0), distance)
        level = 0.0
        cruise = math.sqrt(entry * entry + 2.0 * accel * up)
    down = distance - up - level
    end = math.sqrt(max(0.0, cruise * cruise - 2.0 * accel * down))
    peak = math.sqrt(entry * entry + 2.0 * accel * up)
    seconds = (peak - entry + cruise - end) / accel
    return seconds + level / cruise if cruise > 0.0 else seconds


@kernel
def _reach(speed: float, accel: float, distance: float) -> float:
    return math.sqrt(speed * speed + 2.0 * accel * distance)


@kernel
def _forward(b: Any, n: int) -> None:
    for i in range(n - 1):
        if b[i, _FREE] == 0.0 and b[i, _ENTRY] < b[i + 1, _ENTRY]:
            entry = _reach(b[i, _ENTRY], b[i, _ACCEL], b[i, _DISTANCE])
            if entry < b[i + 1, _ENTRY]:
                b[i + 1, _ENTRY] = entry
                b[i + 1, _CHANGED] = 1.0


@kernel
def _reverse(b: Any, n: int, rechecks: bool) -> None:
    for i in range(n - 2, -1, -1):
        most = b[i, _MOST]
        if b[i, _ENTRY] == most and not (rechecks and b[i + 1, _CHANGED] == 1.0):
            continue
        entry = most
        if b[i, _FREE] == 0.0:
            entry = min(most, _reach(b[i + 1, _ENTRY], b[i, _ACCEL], b[i, _DISTANCE]))
        if entry != b[i, _ENTRY] or not rechecks:
            b[i, _ENTRY] = entry
            b[i, _CHANGED] = 1.0


@kernel
def _drain(b: Any, n: int, keep: int, forward_first: bool) -> float:
    """Plan n blocks, take all but the last `keep` out, and return their time."""
    if forward_first:
        _forward(b, n)
        _reverse(b, n, False)
    else:
        _reverse(b, n, True)
        _forward(b, n)
    for i in range(n):
        if i == n - 1:
            leave = b[i, _SAFE]
        elif b[i, _CHANGED] == 1.0 or b[i + 1, _CHANGED] == 1.0:
            leave = b[i + 1, _ENTRY]
        else:
            continue
        b[i, _TIME] = trapezoid_s(b[i, _ENTRY], b[i, _CRUISE], leave, b[i, _ACCEL], b[i, _DISTANCE])
        b[i, _CHANGED] = 0.0
    seconds = 0.0
    for i in range(n - keep):
        seconds += b[i, _TIME]
    for i in range(keep):
        b[i] = b[n - keep + i]
    if keep and not forward_first:
        b[0, _MOST] = b[0, _ENTRY]
    return seconds


@kernel
def queue_times(
    distance: Any,
    accel: Any,
    cruise: Any,
    safe: Any,
    junction: Any,
    stops: Any,
    forward_first: bool,
) -> float:
    """Return the time of all blocks [s].

    Parameters
    ----------
    distance, accel, cruise : ndarray, shape (n,)
    safe : ndarray, shape (n,)
        Speed from which a block may stop at once.
    junction : ndarray, shape (n,)
        Most speed between the block before and this one.
    stops : ndarray of bool, shape (n,)
        The queue runs empty before the block.
    forward_first : bool
        Pass forward, then back, as the estimator did at first; else back, then forward.
    """
    b = np.zeros((REFRESH + 1, 9))
    n, seconds = 0, 0.0
    for r in range(len(distance)):
        if stops[r] and n > 1:
            seconds += _drain(b, n, 0, forward_first)
            n = 0
        most = junction[r] if n > 0 else safe[r]
        reach = _reach(safe[r], accel[r], distance[r])
        b[n, _DISTANCE], b[n, _ACCEL], b[n, _CRUISE] = distance[r], accel[r], cruise[r]
        b[n, _SAFE], b[n, _MOST], b[n, _ENTRY] = safe[r], most, min(most, reach)
        b[n, _FREE] = 1.0 if cruise[r] <= reach else 0.0
        b[n, _CHANGED] = 1.0
        n += 1
        if n > REFRESH:
            seconds += _drain(b, n, QUEUE, forward_first)
            n = QUEUE
    if n > 1:
        seconds += _drain(b, n, 0, forward_first)
    return seconds
