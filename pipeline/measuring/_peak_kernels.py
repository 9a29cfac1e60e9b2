"""Kernels for the peak demands of a command or of its moves, each in one pass."""

from __future__ import annotations

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.jit import kernel

__all__ = ["peaks", "speed_steps"]

_HALF_S = 5e-4


@kernel(allocates=False)
def peaks(command: Array) -> tuple[float, float]:
    """Return the longest step of X and Y together, and the largest second difference of either.

    Parameters
    ----------
    command : ndarray, shape (2 or more, n)
        X and Y first.
    """
    step2 = bend = 0.0
    before_x = before_y = 0.0
    for k in range(1, command.shape[1]):
        dx, dy = command[0, k] - command[0, k - 1], command[1, k] - command[1, k - 1]
        step2 = max(step2, dx * dx + dy * dy)
        if k > 1:
            bend = max(bend, abs(dx - before_x), abs(dy - before_y))
        before_x, before_y = dx, dy
    return np.sqrt(step2), bend


@kernel(allocates=False)
def speed_steps(
    accel_s: Array,
    cruise_s: Array,
    decel_s: Array,
    start_mm_s: Array,
    cruise_mm_s: Array,
    accel_mm_s2: Array,
    direction: Array,
    step_mm: float,
    mean: bool,
    corexy: bool,
) -> tuple[float, float]:
    """Return how a motor's speed changes between moves: by steps, and within a millisecond.

    Less what rounding may cause. In the second, the ramps beside a step count, which the firmware
    keeps to its acceleration.

    Parameters
    ----------
    accel_s ... direction
        Columns of `Phases`.
    step_mm : float
        Possible error of a move's length; that of its speed is this over its duration.
    mean : bool
        Ramps are shorter than a motor's step: moves have their mean speed from begin to end.
    corexy : bool
        The motors turn with x + y and x - y.
    """
    step = change = 0.0
    end_a = end_b = near_a = near_b = rounded_before = 0.0
    for k in range(len(cruise_s)):
        duration = accel_s[k] + cruise_s[k] + decel_s[k]
        begin, fallen = start_mm_s[k], accel_mm_s2[k] * decel_s[k]
        end = cruise_mm_s[k] - fallen
        if mean:
            lost = accel_s[k] * (cruise_mm_s[k] - begin) + fallen * decel_s[k]
            begin = end = after = before = cruise_mm_s[k] - 0.5 * lost / max(duration, 1e-9)
        else:
            rate = accel_mm_s2[k]
            # At most the cruise speed: what a move then loses again is not counted.
            after = min(begin + rate * _HALF_S, cruise_mm_s[k])
            before = min(end + rate * _HALF_S, cruise_mm_s[k])
        a, b = direction[k, 0], direction[k, 1]
        rounded = step_mm / max(duration, 1e-4)
        if corexy:
            a, b, rounded = a + b, a - b, 2.0 * rounded
        if k > 0:
            less = rounded_before + rounded
            step = max(step, abs(a * begin - end_a) - less, abs(b * begin - end_b) - less)
            change = max(change, abs(a * after - near_a) - less, abs(b * after - near_b) - less)
        end_a, end_b, near_a, near_b = a * end, b * end, a * before, b * before
        rounded_before = rounded
    return step, change
