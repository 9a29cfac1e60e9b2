"""Kernel of the input shapers, wrapped by `compensation.shapers`."""

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
    """Add copies of a command, delayed by `samples` and scaled by `gains`, to `out`, shape (n,).

    The command holds its end values beyond its ends; negative delays are advances.
    """
    n = len(command)
    # Block by block, so that the output is still in the cache for the next pulse.
    for first in range(0, n, _BLOCK):
        stop = min(first + _BLOCK, n)
        for late, gain in zip(samples, gains):  # noqa: B905 - numba knows no strict
            begun = min(max(late, first), stop)
            ended = max(begun, min(max(n + late, first), stop))
            out[first:begun] += gain * command[0]
            out[ended:stop] += gain * command[n - 1]
            # Slices indexed from 0, which numba vectorises.
            moved, taken = out[begun:ended], command[begun - late : ended - late]
            for k in range(len(moved)):
                moved[k] += gain * taken[k]
