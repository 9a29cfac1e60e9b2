"""Limits under which a stream runs."""

from __future__ import annotations

import math
from dataclasses import replace

from stillpath.gcode.firmware.base import corner_step_mm_s, square_corner_mm_s
from stillpath.gcode.firmware.marlin.limits import MarlinLimits, advance_speed_mm_s, without_advance
from stillpath.models.machine import CommandLimits, MotorLimits

__all__ = ["DEVIATION_MM", "STEEPEST", "stream_limits", "with_diagonals"]

STEEPEST = 0.01
"""Steepest climb of a stream on top of the bed mesh's slope; Z's limits are raised for both."""
STREAM_E_ACCEL_MM_S2 = 300_000.0
"""High enough that linear advance never limits X and Y, but within the 32 bits of Marlin's
acceleration_rate."""
STREAM_MESH_ACCEL_MM_S2 = 20_000.0
"""Acceleration of Z where it follows a mesh: a step of 2.5 um in a third of a ms."""
STREAM_E_JERK_MM_S = 100.0
DEVIATION_MM = (0.01, 0.3)
"""Range of M205 J (Marlin/src/gcode/config/M200-M205.cpp, 2.0.x and 2.1.x)."""

_ROOM = 1.05
"""Speed of an axis above the command's, since vertices lie on whole steps."""


def stream_limits(
    own: MarlinLimits, command: CommandLimits, mesh_slope: float = 0.0
) -> MarlinLimits:
    """Return the limits of a stream where the file has set `own`.

    X and Y have the motors' limits, so that the stream may be interrupted anywhere. Retractions
    keep their acceleration. Linear advance is off, and the extruder's limit is raised by the speed
    that it adds to the filament.
    """
    feed = 2.0 * own.feedrate_e_mm_s
    if own.linear_advance_k_s > 0.0:
        feed += 2.0 * max(advance_speed_mm_s(own, classic_jerk=jerk) for jerk in (False, True))
    x, y = command.of("x"), command.of("y")
    accel, step = (
        max(x.accel_mm_s2, y.accel_mm_s2),
        max(corner_step_mm_s(x), corner_step_mm_s(y)),
    )
    motors = command.motors or MotorLimits()
    slope = mesh_slope + STEEPEST
    # Along a mesh Z takes a step within one segment, and none within the next.
    hop = STREAM_MESH_ACCEL_MM_S2 if mesh_slope > 0.0 else 0.0
    # By junction deviation a corner is passed as by Klipper's square corner velocity.
    deviation_mm = (math.sqrt(2.0) - 1.0) * square_corner_mm_s(command) ** 2 / accel
    return replace(
        without_advance(own),
        # Of motors, also on a CoreXY.
        accel_x_mm_s2=motors.accel_mm_s2 or x.accel_mm_s2,
        accel_y_mm_s2=motors.accel_mm_s2 or y.accel_mm_s2,
        accel_z_mm_s2=max(own.accel_z_mm_s2, slope * accel, hop),
        accel_e_mm_s2=STREAM_E_ACCEL_MM_S2,
        feedrate_x_mm_s=max(own.feedrate_x_mm_s, _ROOM * (motors.velocity_mm_s or x.velocity_mm_s)),
        feedrate_y_mm_s=max(own.feedrate_y_mm_s, _ROOM * (motors.velocity_mm_s or y.velocity_mm_s)),
        feedrate_e_mm_s=feed,
        print_accel_mm_s2=accel,
        travel_accel_mm_s2=accel,
        # It limits the step of each axis.
        jerk_x_mm_s=round(corner_step_mm_s(x) / math.sqrt(2.0), 2),
        jerk_y_mm_s=round(corner_step_mm_s(y) / math.sqrt(2.0), 2),
        jerk_z_mm_s=max(own.jerk_z_mm_s, slope * step),
        jerk_e_mm_s=max(own.jerk_e_mm_s, STREAM_E_JERK_MM_S),
        junction_deviation_mm=min(max(deviation_mm, DEVIATION_MM[0]), DEVIATION_MM[1]),
        min_segment_time_us=0.0,
        min_feedrate_mm_s=0.0,
        min_travel_feedrate_mm_s=0.0,
    )


def with_diagonals(limits: MarlinLimits, command: CommandLimits, *, corexy: bool) -> MarlinLimits:
    """Return limits of a stream with the acceleration that X and Y bear together.

    M204 holds along the way and M201 by motor (`planner.cpp`, `_populate_block`). With one figure
    for both, cartesian axes have only sqrt(1/2) of it each along a diagonal, and so has the way on
    a CoreXY, of which each motor makes sqrt(2) times as much there.
    """
    x, y = limits.accel_x_mm_s2, limits.accel_y_mm_s2
    if not corexy:
        both = math.hypot(x, y)
        return replace(limits, print_accel_mm_s2=both, travel_accel_mm_s2=both)
    if command.motors is not None and command.motors.accel_mm_s2 is not None:
        return limits
    diagonal = math.sqrt(2.0)
    return replace(limits, accel_x_mm_s2=diagonal * x, accel_y_mm_s2=diagonal * y)
