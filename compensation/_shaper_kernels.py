"""Loop of the input shapers; `compensation.shapers` wraps it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.jit import kernel

__all__ = ["add_delayed"]


@kernel
def add_delayed(
    command: NDArray[np.float64],
    samples: NDArray[np.int64],
    gains: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Add a command, times each gain and shifted by so many samples, to `out`, all of shape (n,).

    Before its first and behind its last sample the command stands; shifts below 0 are earlier.
    """
    n = len(command)
    for late, gain in zip(samples, gains):  # noqa: B905 - numba knows no strict
        begun = min(max(late, 0), n)
        ended = max(begun, min(max(n + late, 0), n))
        # Three plain loops: an index that is clipped would not be vectorised.
        for k in range(begun):
            out[k] += gain * command[0]
        for k in range(begun, ended):
            out[k] += gain * command[k - late]
        for k in range(ended, n):
            out[k] += gain * command[n - 1]
