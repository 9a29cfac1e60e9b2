"""Loops of the limited-preview recursion; `compensation.preview` wraps them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.jit import kernel

__all__ = ["advance_state", "run_windows"]

_NOTHING = 1e-100


@kernel
def run_windows(
    command_gain: NDArray[np.float64],
    state_gain: NDArray[np.float64],
    command_drive: NDArray[np.float64],
    state_drive: NDArray[np.float64],
    z: NDArray[np.float64],
    first: int,
    last: int,
    u: NDArray[np.float64],
) -> None:
    """Step windows first..last-1: u = E z + (S y_d), z <- F z + (H y_d), in place.

    `command_drive` and `state_drive` hold S y_d and H y_d with one row per window.
    """
    update, states = command_gain.shape
    following = np.empty(states)
    for w in range(first, last):
        start = w * update
        for i in range(update):
            total = command_drive[w, i]
            for j in range(states):
                total += command_gain[i, j] * z[j]
            u[start + i] = total
        for i in range(states):
            total = state_drive[w, i]
            for j in range(states):
                total += state_gain[i, j] * z[j]
            following[i] = total
        z[:] = following


@kernel
def advance_state(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    state: NDArray[np.float64],
    command: NDArray[np.float64],
) -> NDArray[np.float64]:
    """State of x <- a x + b u after the samples of `command`."""
    order = len(b)
    x = state.copy()
    following = np.empty(order)
    for k in range(len(command)):
        for i in range(order):
            total = b[i] * command[k]
            for j in range(order):
                total += a[i, j] * x[j]
            # What has died away must not become denormal: such numbers are a hundred times slower.
            following[i] = total if abs(total) > _NOTHING else 0.0
        x[:] = following
    return x
