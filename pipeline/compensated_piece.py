"""A compensated piece, and its motion as the firmware executes it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.firmware.encoding import Encoded
from stillpath.gcode.sampler import distances, sample_phases, sample_until
from stillpath.gcode.segments import Segments
from stillpath.gcode.timeline import Timeline
from stillpath.gcode.types import Phases

__all__ = ["CompensatedPiece", "Unfit", "as_executed", "deviation"]


class Unfit(ValueError):
    """A piece that should stay as sliced; the message says why."""


@dataclass(frozen=True, slots=True)
class CompensatedPiece:
    """A piece with its command.

    Attributes
    ----------
    command_mm : ndarray, shape (4, n)
        x y as commanded, z as planned, e along the command (`pipeline.filament`), on the
        timeline's grid.
    extruding : ndarray of bool, shape (n,)
    step_mm, bend_mm : float
        Longest step of the command in XY, and largest second difference of either axis.
    keeps_ripple : bool
        Its ripple is not compensated, although that was asked for.
    """

    timeline: Timeline
    command_mm: NDArray[np.float64]
    extruding: NDArray[np.bool_]
    segments: Segments
    encoded: Encoded
    step_mm: float
    bend_mm: float
    keeps_ripple: bool


def deviation(piece: CompensatedPiece, executed: Phases) -> NDArray[np.float64]:
    """Return the XY distance [mm] of executed motion from the command at its samples, shape (n,).

    Each stretch is timed from its own start: rests may be slightly longer or shorter than planned.
    """
    timeline, encoded = piece.timeline, piece.encoded
    first = np.round(timeline.start_s / timeline.dt_s - 0.5).astype(np.int64)
    np.clip(first, 0, piece.command_mm.shape[1], out=first)
    first[0] = 0
    origin_s = timeline.start_s[0]
    return distances(
        executed,
        piece.command_mm,
        timeline.dt_s,
        first,
        encoded.group_start_s - timeline.start_s - origin_s,
        # During a rest, time stops at the beginning of the next stretch.
        np.append(encoded.group_start_s[1:], np.inf) - origin_s,
    )


def as_executed(
    piece: CompensatedPiece, phases: Phases, executed: Phases
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return planned and executed motion of a piece on one time grid.

    Parameters
    ----------
    phases : Phases
        The intended motion (`gcode.firmware.planning.intended`).

    Returns
    -------
    planned_mm, executed_mm : ndarray, shapes (3, n) and (2, n)
    row : ndarray of int64, shape (n,)
        Row in the piece's `phases`.
    extruding : ndarray of bool, shape (n,)
    """
    dt_s = piece.timeline.dt_s
    origin = float(piece.timeline.start_s[0])
    last = executed.lasts_s[-1]
    n = int(np.ceil((float(executed.t_s[-1] + last) + origin) / dt_s - 1e-3)) + 1
    moved = replace(phases, t_s=piece.encoded.row_start_s)
    until = np.where(phases.prints, moved.t_s + phases.lasts_s, -np.inf)
    planned, row, extruding = sample_until(moved, (0.0, dt_s, n), until, axes=3)
    position, _ = sample_phases(executed, (-origin, dt_s, n), flat=True)
    return planned, position, row, extruding
