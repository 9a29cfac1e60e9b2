"""Loop of the input shapers; `compensation.shapers` wraps it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.models.jit import kernel

__all__ = ["add_delayed"]

_BLOCK = 1024


@kernel
def add_delayed(
    command: NDArray[np.float64],
    samples: NDArray[np.int64],
    gains: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Add a command, times each gain and shifted by so many samples, to `out`, all of shape (n,).

    Before its first and after its last sample the command stands; shifts below 0 are earlier.
    """
    n = len(command)
    # Block by block, so that what was written is still in the cache for the next pulse.
    for first in range(0, n, _BLOCK):
        stop = min(first + _BLOCK, n)
        for late, gain in zip(samples, gains):  # noqa: B905 - numba knows no strict
            begun = min(max(late, first), stop)
            ended = max(begun, min(max(n + late, first), stop))
            out[first:begun] += gain * command[0]
            out[ended:stop] += gain * command[n - 1]
            # Slices and an index from 0: what numba vectorises.
            moved, taken = out[begun:ended], command[begun - late : ended - late]
            for k in range(len(moved)):
                moved[k] += gain * taken[k]
