"""Kernels for the peak demands of a command or of its moves, each in one pass."""

from __future__ import annotations

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.jit import kernel

__all__ = ["peaks", "speed_step"]


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
def speed_step(
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
) -> float:
    """Return the largest speed step of a motor between moves, less what rounding may cause.

    Ramps are no steps: the firmware keeps them to its acceleration, which is what motors bear.

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
    worst = 0.0
    before_a = before_b = rounded_before = 0.0
    for k in range(len(cruise_s)):
        duration = accel_s[k] + cruise_s[k] + decel_s[k]
        begin, fallen = start_mm_s[k], accel_mm_s2[k] * decel_s[k]
        end = cruise_mm_s[k] - fallen
        if mean:
            lost = accel_s[k] * (cruise_mm_s[k] - begin) + fallen * decel_s[k]
            begin = end = cruise_mm_s[k] - 0.5 * lost / max(duration, 1e-9)
        a, b = direction[k, 0], direction[k, 1]
        rounded = step_mm / max(duration, 1e-4)
        if corexy:
            a, b, rounded = a + b, a - b, 2.0 * rounded
        if k > 0:
            step = max(abs(a * begin - before_a), abs(b * begin - before_b))
            worst = max(worst, step - rounded_before - rounded)
        before_a, before_b, rounded_before = a * end, b * end, rounded
    return worst
