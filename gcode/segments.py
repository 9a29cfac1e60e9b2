"""The fewest straight constant-speed segments that follow a sampled command within a tolerance.

One pass over X, Y, Z and E together: a funnel of admissible slopes per axis starts at the end of
the last segment and narrows with every sample; when it closes, the segment ends. On a path of
constant acceleration this finds the best piecewise linear fit in the maximum norm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcode._segment_kernels import fit_stretch
from gcode.timeline import Timeline

__all__ = ["Segments", "fit_segments"]

XY_SHARE = 0.75
"""Tolerance of X and of Y as a share of the distance allowed: .75 sqrt(2) = 1.06."""
E_TOLERANCE_MM = 1e-3


@dataclass(frozen=True, slots=True)
class Segments:
    """Straight constant-speed pieces of a command.

    Attributes
    ----------
    end_s : ndarray, shape (n,)
        When each segment ends.
    end_mm : ndarray, shape (4, n)
        Where it ends.
    group : ndarray of int64, shape (n,)
        The timeline's group it belongs to.
    """

    end_s: NDArray[np.float64]
    end_mm: NDArray[np.float64]
    group: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.end_s)


def fit_segments(
    timeline: Timeline,
    command_mm: NDArray[np.float64],
    tolerance_mm: float,
    *,
    minimum_s: float = 0.5e-3,
) -> Segments:
    """Fit the stretches of a piece.

    Parameters
    ----------
    timeline : Timeline
        Groups and their times.
    command_mm : ndarray, shape (4, n)
        Command on the timeline's grid: x y compensated, z e as planned.
    tolerance_mm : float
        Largest distance in X Y between command and fit, at the samples.
    minimum_s : float
        Samples nearer than this to the start of a stretch are not ends of segments.
    """
    dt = timeline.dt_s
    tolerance = np.array(
        [XY_SHARE * tolerance_mm, XY_SHARE * tolerance_mm, 0.5 * tolerance_mm, E_TOLERANCE_MM]
    )
    capacity = command_mm.shape[1] + len(timeline.groups)
    end_s, end_mm = np.empty(capacity), np.empty((4, capacity))
    groups = np.empty(capacity, dtype=np.int64)
    count = 0
    for i, group in enumerate(timeline.groups):
        if group.rest:
            continue
        start = timeline.end_s[i - 1] if i else 0.0
        last = round(timeline.end_s[i] / dt)
        if i == len(timeline.groups) - 1:
            last = command_mm.shape[1] - 1
        first = min(int(np.ceil((start + minimum_s) / dt)), last)
        before = int(np.floor(start / dt + 1e-6))
        # Z and E moved in the rest before; X and Y stand where the command left them.
        begin = np.concatenate([command_mm[:2, before], timeline.group_start_mm[i, 2:]])
        n = fit_stretch(
            command_mm, tolerance, dt, start, first, last, begin, end_s[count:], end_mm[:, count:]
        )
        groups[count : count + n] = i
        count += n
    return Segments(end_s[:count].copy(), end_mm[:, :count].copy(), groups[:count].copy())

