"""Spread filament along a compensated path, in place of the plan's times."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.timeline import Timeline
from stillpath.gcode.types import Phases
from stillpath.models.arrays import Array
from stillpath.models.runs import runs
from stillpath.pipeline._filament_kernels import smooth_along

__all__ = ["feed_evenly", "retract_along"]

_FEED_REACH, _FEED_REACH_MM = 2.5, 0.5
"""Half-width of the smoothing of filament along the path: a multiple of the filament per mm of
path, and the most in mm."""


def retract_along(command: Array, timeline: Timeline, phases: Phases) -> None:
    """Spread the filament that wipes pull back evenly over the command's path, in place.

    Klipper limits such moves by E per mm of XY. The command may stand where the plan creeps, and
    vice versa: filament at the plan's times would need impossible accelerations.

    Parameters
    ----------
    command : ndarray, shape (4, n)
        X Y Z E in mm on the timeline's grid.
    """
    wipes = phases.moves_xy & (phases.direction[:, 3] < 0.0)
    if not np.any(wipes):
        return
    inside = wipes[timeline.row] & timeline.moving
    last = command.shape[1] - 1
    for first, end in runs(inside):
        # Use the plan's ends: samples around a wipe may lie in a retraction at rest.
        row, stop = timeline.row[first], timeline.row[end - 1] + 1
        begins = phases.start_mm[row, 3]
        ends = phases.start_mm[stop, 3] if stop < len(phases) else command[3, last]
        span = slice(max(first - 1, 0), min(end, last) + 1)
        step = np.sqrt(np.sum(np.diff(command[:2, span]) ** 2, axis=0))
        way = np.concatenate([[0.0], np.cumsum(step)])
        if way[-1] > 0.0:
            share = way[first - span.start : end - span.start] / way[-1]
            command[3, first:end] = begins + (ends - begins) * share


def feed_evenly(command: Array, extruding: NDArray[np.bool_]) -> None:
    """Smooth the filament along the command's path within each printed run, in place.

    In corners the command's speed differs from the plan's, which the filament follows: the filament
    per mm of path is uneven there, and firmwares brake for it, more so on thick lines.

    Parameters
    ----------
    command : ndarray, shape (4, n)
        X Y Z E in mm.
    extruding : ndarray of bool, shape (n,)
    """
    way_mm, area = np.empty((2, command.shape[1]))
    for first, end in runs(extruding):
        span = slice(max(first - 1, 0), end)
        xy_mm, fed_mm = command[:2, span], command[3, span]
        smooth_along(xy_mm, fed_mm, way_mm, area, _FEED_REACH, _FEED_REACH_MM)
