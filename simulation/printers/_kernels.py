"""Kernel that simulates bodies with dry friction."""

from __future__ import annotations

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.jit import kernel

__all__ = ["followed"]


@kernel
def followed(
    step: Array,
    now: Array,
    slope: Array,
    command: Array,
    dt_s: float,
    slips: Array,
    force: Array,
    bend: Array,
    states: Array,
) -> None:
    """Compute states (n, 2 coordinates) of bodies that follow a command (2, n) from rest.

    The command is linear over a step, so its rate is constant; friction follows the slip of a step,
    exactly for a constant rate (Dahl 1968), and acts during the next one.
    """
    size = step.shape[0]
    half = size // 2
    rubbing = len(force)
    bent = np.zeros(rubbing)
    for k in range(1, states.shape[0]):
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += step[i, j] * states[k - 1, j]
            for j in range(2):
                change = command[j, k] - command[j, k - 1]
                total += now[i, j] * command[j, k - 1] + slope[i, j] * change
                total += now[i, 2 + j] * change / dt_s
            for j in range(rubbing):
                total += now[i, 4 + j] * force[j] * bent[j]
            states[k, i] = total
        for j in range(rubbing):
            way = 0.0
            for i in range(half):
                way += slips[j, i] * (states[k, i] - states[k - 1, i])
            towards = 1.0 if way > 0.0 else -1.0
            bent[j] = towards + (bent[j] - towards) * np.exp(-abs(way) / bend[j])
