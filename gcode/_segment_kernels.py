"""Loop of the one-pass segment fit; `gcode.segments` wraps it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.jit import kernel

__all__ = ["fit_stretch"]


@kernel
def fit_stretch(
    position: NDArray[np.float64],
    tolerance: NDArray[np.float64],
    dt_s: float,
    start_s: float,
    first: int,
    last: int,
    begin: NDArray[np.float64],
    out_t: NDArray[np.float64],
    out_position: NDArray[np.float64],
) -> int:
    """Cover samples first..last of `position` (axes, n) with straight segments.

    The fit starts at `begin` at `start_s` and ends exactly at sample `last`. Every sample in
    between is met within `tolerance` of its axis. Returns the number of segments written.
    """
    axes = position.shape[0]
    low = np.empty(axes)
    high = np.empty(axes)
    new_low = np.empty(axes)
    new_high = np.empty(axes)
    origin = begin.copy()
    origin_s = start_s
    k = first
    count = 0
    while k <= last:
        low[:] = -np.inf
        high[:] = np.inf
        j = k
        while j <= last:
            span = j * dt_s - origin_s
            fits = True
            for a in range(axes):
                slack = 0.0 if j == last else tolerance[a]
                new_low[a] = max(low[a], (position[a, j] - slack - origin[a]) / span)
                new_high[a] = min(high[a], (position[a, j] + slack - origin[a]) / span)
                if new_low[a] > new_high[a]:
                    fits = False
            if not fits:
                break
            low[:] = new_low
            high[:] = new_high
            j += 1
        end = j - 1
        if end < k:
            # Not even one sample (an origin off the path just before the exact end).
            end = k
            span = end * dt_s - origin_s
            for a in range(axes):
                origin[a] = position[a, end]
        else:
            span = end * dt_s - origin_s
            for a in range(axes):
                if end == last:
                    origin[a] = position[a, last]
                else:
                    origin[a] += 0.5 * (low[a] + high[a]) * span
        origin_s = end * dt_s
        out_t[count] = origin_s
        for a in range(axes):
            out_position[a, count] = origin[a]
        count += 1
        k = end + 1
    return count
