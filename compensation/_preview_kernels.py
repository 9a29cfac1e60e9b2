"""Kernels of the limited-preview recursion, wrapped by `compensation.preview`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.models.jit import kernel

__all__ = ["advance_state", "advance_window", "block_starts", "impulse_states", "run_windows"]

_NOTHING = 1e-100


@kernel
def run_windows(
    command_gain: NDArray[np.float64],
    state_gain: NDArray[np.float64],
    command_from_path: NDArray[np.float64],
    state_from_path: NDArray[np.float64],
    z: NDArray[np.float64],
    first: int,
    last: int,
    u: NDArray[np.float64],
) -> None:
    """Step windows first..last-1: u = E z + S y_d, z <- F z + H y_d, in place.

    `command_from_path` holds S y_d and `state_from_path` H y_d, one row per window.
    """
    update, states = command_gain.shape
    carried = state_gain.T.copy()
    following, before = np.empty(states), np.empty((last - first, states))
    for w in range(first, last):
        before[w - first] = z
        for i in range(states):
            following[i] = state_from_path[w, i]
        for j in range(states):
            value = z[j]
            for i in range(states):
                following[i] += carried[j, i] * value
        z[:] = following
    # Only the states follow one after the other.
    out = u[first * update : last * update].reshape(last - first, update)
    out[:] = command_from_path[first:last] + np.dot(before, command_gain.T)


@kernel
def advance_window(
    advance: NDArray[np.float64],
    state_drive: NDArray[np.float64],
    z: NDArray[np.float64],
    committed: NDArray[np.float64],
) -> None:
    """Advance z (the plants' states and the last two commands) by a committed command, in place.

    `advance` propagates the states without a command; `state_drive` adds the effect of the command.
    """
    following = np.dot(state_drive, committed)
    following[:-2] += np.dot(advance, z[:-2])
    z[:] = following


@kernel
def impulse_states(
    a: NDArray[np.float64], b: NDArray[np.float64], samples: int
) -> NDArray[np.float64]:
    """Return the state after an impulse of command, shape (order, samples), the latest last."""
    order = len(b)
    out = np.zeros((order, samples))
    if samples > 0:
        out[:, samples - 1] = b
    for k in range(samples - 2, -1, -1):
        for i in range(order):
            total = 0.0
            for j in range(order):
                total += a[i, j] * out[j, k + 1]
            # Flush decayed states to zero: denormal numbers are a hundred times slower.
            out[i, k] = total if abs(total) > _NOTHING else 0.0
    return out


@kernel
def advance_state(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    state: NDArray[np.float64],
    command: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the state of x <- a x + b u after the samples of `command`."""
    order = len(b)
    x = state.copy()
    following = np.empty(order)
    for k in range(len(command)):
        for i in range(order):
            total = b[i] * command[k]
            for j in range(order):
                total += a[i, j] * x[j]
            # Flush decayed states to zero: denormal numbers are a hundred times slower.
            following[i] = total if abs(total) > _NOTHING else 0.0
        x[:] = following
    return x


@kernel
def block_starts(
    step: NDArray[np.float64], drive: NDArray[np.float64], state: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return x <- step x + drive[k] from `state` on, shape (blocks + 1, order), both ends too."""
    blocks, order = drive.shape
    out = np.empty((blocks + 1, order))
    out[0] = state
    for k in range(blocks):
        for i in range(order):
            total = drive[k, i]
            for j in range(order):
                total += step[i, j] * out[k, j]
            # Flush decayed states to zero: denormal numbers are a hundred times slower.
            out[k + 1, i] = total if abs(total) > _NOTHING else 0.0
    return out
