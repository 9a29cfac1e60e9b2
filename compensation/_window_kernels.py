"""Loops of a window with rests; `compensation.window_problem` wraps them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.jit import kernel

__all__ = ["extremes", "segment_states", "tied_command", "tied_response"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@kernel
def segment_states(summed: Array, reach: Array, moving: Ints, begun: Array, stopped: Array) -> None:
    """Find the states that functions leave behind, moved by increments in segments only.

    Parameters
    ----------
    summed : ndarray, shape (window, n)
        Commands of the functions: the double running sums of their increments.
    reach : ndarray, shape (nz - 2, window)
        From commands to states at the window's end.
    moving : ndarray of int64, shape (k, 2)
        Segments [s, e) between rests.
    begun, stopped : ndarray, shape (k, nz, n)
        Filled: states at s from all increments before; states at e from those of the segment.
    """
    window = len(summed)
    for m in range(len(moving)):
        s, e = moving[m]
        _states_at(summed, reach, 0, s, begun[m])
        if e < window:
            _states_at(summed, reach, s, e, stopped[m])


@kernel
def _states_at(summed: Array, reach: Array, s: int, e: int, states: Array) -> None:
    window, n = summed.shape
    order = len(reach)
    states[:] = 0.0
    # The straight line on which the functions go on from before.
    line, step = np.zeros(n), np.zeros(n)
    if s > 0:
        line[:] = summed[s - 1]
        step[:] = summed[s - 1]
        if s > 1:
            step -= summed[s - 2]
    newest, before = states[order], states[order + 1]
    for k in range(s, e):
        function = summed[k]
        for j in range(n):
            line[j] += step[j]
            before[j] = newest[j]
            newest[j] = function[j] - line[j]
        for i in range(order):
            _add(reach[i, window - e + k], newest, states[i])


@kernel
def tied_response(
    filtered: Array,
    free: Array,
    moving: Ints,
    begun: Array,
    stopped: Array,
    weight: Array,
    error: Array,
    right: Array,
) -> Array:
    """Return a component's weighted response to the tied functions, shape (window, n).

    Between rests, from sample s on, the tied functions are the free ones without a past: their
    response is the free one, `filtered` (window, n), minus what the states at s would go on to do.
    From the rest at e on, it is what the segment's states there go on to do with a command that
    stands. What states do by themselves is `free` (window, nz). Adds response' weight^2 error to
    `right`.
    """
    window, n = filtered.shape
    states = free.shape[1]
    response = np.zeros((window, n))
    for m in range(len(moving)):
        s, e = moving[m]
        for r in range(s, e):
            out = response[r]
            out += filtered[r]
            if s > 0:
                for i in range(states):
                    _add(-free[r - s, i], begun[m, i], out)
        if s < e:
            for r in range(e, window):
                out = response[r]
                for i in range(states - 2):
                    _add(free[r - e, i], stopped[m, i], out)
                # Both last commands are the same from now on.
                _add(free[r - e, -2] + free[r - e, -1], stopped[m, -2], out)
    for r in range(window):
        out = response[r]
        out *= weight[r]
        _add(weight[r] * error[r], out, right)
    return response


@kernel(inline=True)
def _add(gain: float, row: Array, out: Array) -> None:
    for j in range(len(out)):
        out[j] += gain * row[j]


@kernel
def tied_command(increments: Array, moving: Ints, last: float, previous: float) -> Array:
    """Command of increments, (window,), that stops with the first sample of every rest."""
    window = len(increments)
    out = np.empty(window)
    u, step = last, last - previous
    for m in range(len(moving)):
        s, e = moving[m]
        for k in range(s, e):
            step += increments[k]
            u += step
            out[k] = u
        step = 0.0
        following = moving[m + 1, 0] if m + 1 < len(moving) else window
        out[e:following] = u
    return out


@kernel
def extremes(
    command: Array, last: float, previous: float, stops: bool
) -> tuple[float, float, float, float, float]:
    """Look at a command that follows the samples `previous` and `last`.

    Returns
    -------
    accel, speed, low, high, mean_square : float
        Largest second and first difference, lowest and highest value, and the mean of the squared
        second differences; with `stops` that behind the last sample is looked at too.
    """
    accel = speed = total = 0.0
    low = high = command[0]
    step = last - previous
    for k in range(len(command)):
        value = command[k]
        following = value - last
        bend = following - step
        accel = max(accel, abs(bend))
        speed = max(speed, abs(following))
        low, high = min(low, value), max(high, value)
        total += bend * bend
        last, step = value, following
    if stops:
        accel = max(accel, abs(step))
        total += step * step
    return accel, speed, low, high, total / len(command)
