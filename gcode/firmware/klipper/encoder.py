"""Encode a compensated command as G1 lines that make Klipper execute it.

Klipper plans every line under acceleration and corner limits that the motors can follow, so the
stream may be interrupted at any line. The time that ramps cost at speed steps is predicted by a
formula and compensated in the feedrates. The firmware's own planner then checks the times; rare
deviations from the formula are corrected in another pass (docs/emission.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.firmware._encoding_kernels import MoveLimits
from stillpath.gcode.firmware.base import square_corner_mm_s
from stillpath.gcode.firmware.encoding import (
    UNITS_PER_MM,
    Encoded,
    as_moves,
    encoded_piece,
    group_durations,
    interleave,
    limits_in_force,
)
from stillpath.gcode.firmware.klipper._encoder_kernels import assign_speeds, expected_braking
from stillpath.gcode.firmware.klipper._limit_kernels import move_limits
from stillpath.gcode.firmware.klipper.limits import KlipperLimits
from stillpath.gcode.firmware.klipper.planner import Planner
from stillpath.gcode.firmware.klipper.stream_commands import IN_STREAM_MARK_MM_S
from stillpath.gcode.pieces import Piece
from stillpath.gcode.segments import Segments
from stillpath.gcode.timeline import Group, Timeline
from stillpath.gcode.types import Limits
from stillpath.models.firmware import Klipper
from stillpath.models.machine import CommandLimits

__all__ = ["KlipperEncoder", "stream_limits"]


_GRID = 100
"""1e-6 mm, of X and Y; the last point of every stretch keeps all the file's digits. Rounding to 1
um would be noise at all frequencies, which a resonance above the model's band amplifies to microns
(docs/tried.md)."""
_Z_GRID = 10
"""On a 1 um grid a slow climb, as in a vase, is flat and then too steep for Z's acceleration."""
_FEED_SHARE = 0.7
"""Of the step of the extruder's speed for which Klipper brakes: ends are moved after the fit."""
_PASSES = 4
_TIME_TOLERANCE_S = 2e-6


def stream_limits(
    firmware: Klipper, command: CommandLimits, mesh_slope: float = 0.0
) -> KlipperLimits:
    """Return the limits of a stream: those of the motors, so that it may be interrupted anywhere.

    Parameters
    ----------
    mesh_slope : float
        Largest slope of the bed mesh. Klipper adds the mesh's Z to every move and then caps it by
        the limits of Z (klippy/extras/bed_mesh.py, kinematics/cartesian.py, 2026-08). Those limits
        divided by the slope never bind, however the bed lies, so that times stay as planned.
    """
    accel = command.every_way.accel_mm_s2
    # The command keeps its speed axis by axis, Klipper its limit along the path.
    velocity_mm_s = math.hypot(command.velocity_mm_s, command.velocity_mm_s)
    if mesh_slope > 0.0:
        accel = min(accel, firmware.planner.max_z_accel_mm_s2 / mesh_slope)
        velocity_mm_s = min(velocity_mm_s, firmware.planner.max_z_velocity_mm_s / mesh_slope)
    if firmware.limits_capped:
        accel = min(accel, firmware.planner.max_accel_mm_s2)
        velocity_mm_s = min(velocity_mm_s, firmware.planner.max_velocity_mm_s)
    return KlipperLimits(
        velocity_mm_s=velocity_mm_s,
        accel_mm_s2=accel,
        square_corner_velocity_mm_s=round(square_corner_mm_s(command), 2) + IN_STREAM_MARK_MM_S,
        minimum_cruise_ratio=0.0,
    )


class KlipperEncoder:
    """Encode pieces for one machine."""

    grid_mm = _GRID / UNITS_PER_MM

    def __init__(self, firmware: Klipper, limits: KlipperLimits) -> None:
        self._firmware, self._limits = firmware, limits
        self.feed_step_mm_s = _FEED_SHARE * firmware.extruder.instantaneous_corner_velocity_mm_s
        self._grids = np.array([_GRID, _GRID, _Z_GRID])

    def rest_durations(self, piece: Piece, groups: Sequence[Group]) -> NDArray[np.float64]:
        """Return estimated durations of rests: their own moves between stretches of the stream."""
        rows = np.full(len(piece.moves), -1)
        for group in groups:
            if group.rest:
                rows[group.first : group.last] = np.arange(group.first, group.last)
        moves = piece.moves
        limits_id, limits = limits_in_force(piece, rows, [self._limits], np.zeros_like(rows))
        own = as_moves(moves.start_mm, moves.end_mm, moves.speed_mm_s, limits_id)
        phases = Planner(self._firmware).plan_whole(own, limits)
        return group_durations(phases, groups)

    def encode(self, piece: Piece, timeline: Timeline, segments: Segments) -> Encoded:
        """Choose rounded positions and feedrates for the segments of a piece.

        Raises
        ------
        GcodeError
            If the firmware would refuse a move.
        """
        moves = interleave(piece, timeline, segments, self._grids)
        rows = moves.row
        places_mm = moves.places_mm()
        start_mm, end_mm = places_mm[:-1], places_mm[1:]
        ours = rows < 0
        limits_id, limits = limits_in_force(piece, rows, [self._limits], np.zeros_like(rows))
        allowed, stops = self._allowed(start_mm, end_mm, limits_id, limits)
        asked = np.where(ours, np.inf, piece.moves.speed_mm_s[rows])
        speed = np.minimum(allowed.speed_mm_s, asked)
        allowed = allowed._replace(speed_mm_s=speed)

        correction, braking, feedrate, predicted = np.zeros((4, len(rows)))
        expected_braking(ours, stops, allowed, moves.planned_s, braking)
        for _ in range(_PASSES):
            assign_speeds(
                ours,
                stops,
                allowed,
                moves.end_s,
                moves.planned_s,
                correction,
                float(timeline.start_s[0]),
                braking,
                feedrate,
                predicted,
            )
            chosen = np.where(ours, feedrate / 60.0, speed)
            written = as_moves(start_mm, end_mm, chosen, limits_id)
            phases = Planner(self._firmware).plan_whole(written, limits)
            miss = phases.lasts_s - predicted
            if np.max(np.abs(np.cumsum(miss)), initial=0.0) < _TIME_TOLERANCE_S:
                break
            correction += miss
        return encoded_piece(timeline, moves, self._limits, feedrate, phases)

    def _allowed(
        self,
        start_mm: NDArray[np.float64],
        end_mm: NDArray[np.float64],
        limits_id: NDArray[np.int32],
        limits: Sequence[Limits],
    ) -> tuple[MoveLimits, NDArray[np.bool_]]:
        """Return the limits of every move, and which are of the extruder alone."""
        planner, extruder = self._firmware.planner, self._firmware.extruder
        facts = (
            planner.max_z_velocity_mm_s,
            planner.max_z_accel_mm_s2,
            extruder.max_extrude_only_velocity_mm_s,
            extruder.max_extrude_only_accel_mm_s2,
            extruder.instantaneous_corner_velocity_mm_s,
        )
        allowed, stops = MoveLimits(*np.empty((4, len(limits_id)))), np.empty(len(limits_id), bool)
        table = np.array([one.as_row() for one in limits])
        move_limits(start_mm, end_mm, limits_id, table, facts, allowed, stops)
        return allowed, stops
