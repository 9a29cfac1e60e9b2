"""What a command asks for at most, in one pass."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.jit import kernel

__all__ = ["peaks"]


@kernel(allocates=False)
def peaks(command: NDArray[np.float64]) -> tuple[float, float]:
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
