"""Pressure advance in the filament of a stream, where the firmware's own cannot be used.

A firmware adds advance during its ramps. In a stream of short segments a ramp is shorter than a
motor step, so nothing would be added. The firmware's own advance is therefore switched off there,
and the filament of the stream is advanced by the same amount.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.pieces import Piece
from stillpath.gcode.segments import Segments
from stillpath.gcode.timeline import Timeline
from stillpath.gcode.types import Phases

__all__ = ["feed_at_ends"]


def feed_at_ends(
    piece: Piece, timeline: Timeline, segments: Segments
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return the plan's row and extruder speed at the end of each segment.

    Returns
    -------
    row : ndarray of int64, shape (n,)
        Row of the piece that the plan is in by then.
    feed_mm_s : ndarray, shape (n,)
        Speed of the extruder there; 0 in rows that do not print.
    prints : ndarray of bool, shape (n,)
        Whether the row moves X or Y and feeds forward.
    """
    rows = np.maximum(np.searchsorted(timeline.row_start_s, segments.end_s, "right") - 1, 0)
    speed = _speed_at(piece.phases, rows, segments.end_s - timeline.row_start_s[rows])
    prints = piece.phases.prints[rows]
    return rows, np.where(prints, piece.phases.direction[rows, 3] * speed, 0.0), prints


def _speed_at(
    phases: Phases, rows: NDArray[np.int64], after_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Speed along the path of each row, so long after its start."""
    up = np.minimum(after_s, phases.accel_s[rows])
    down = np.clip(
        after_s - phases.accel_s[rows] - phases.cruise_s[rows], 0.0, phases.decel_s[rows]
    )
    ends = after_s > phases.lasts_s[rows] + 1e-9
    speed = phases.start_mm_s[rows] + phases.accel_mm_s2[rows] * (up - down)
    return np.where(ends, 0.0, np.maximum(speed, 0.0))
