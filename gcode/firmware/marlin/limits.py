"""The planner limits that G-code can change on a Marlin machine: M201, M203, M204, M205, M900."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from stillpath.gcode.types import Limits
from stillpath.models.firmware import Marlin

__all__ = ["MarlinLimits", "advance_speed_mm_s", "initial_limits", "without_advance"]


@dataclass(frozen=True, slots=True)
class MarlinLimits(Limits):
    """Limits in force; the order of the fields is that of a row of the interpreter's table."""

    accel_x_mm_s2: float
    accel_y_mm_s2: float
    accel_z_mm_s2: float
    accel_e_mm_s2: float
    """M201 X Y Z E."""
    feedrate_x_mm_s: float
    feedrate_y_mm_s: float
    feedrate_z_mm_s: float
    feedrate_e_mm_s: float
    """M203 X Y Z E."""
    print_accel_mm_s2: float
    """M204 P."""
    retract_accel_mm_s2: float
    """M204 R."""
    travel_accel_mm_s2: float
    """M204 T."""
    jerk_x_mm_s: float
    jerk_y_mm_s: float
    jerk_z_mm_s: float
    jerk_e_mm_s: float
    """M205 X Y Z E, where classic jerk is configured."""
    junction_deviation_mm: float
    """M205 J, where it is not."""
    min_segment_time_us: float
    """M205 B."""
    min_feedrate_mm_s: float
    """M205 S."""
    min_travel_feedrate_mm_s: float
    """M205 T."""
    linear_advance_k_s: float
    """M900 K."""
    advance_in_filament: float
    """1 in a stream of a K above 0: the firmware has M900 K0, and the filament is ahead by K."""


def initial_limits(firmware: Marlin) -> MarlinLimits:
    """Return the limits at power-on."""
    planner = firmware.planner
    accel, feedrate, jerk = planner.max_accel_mm_s2, planner.max_feedrate_mm_s, planner.jerk_mm_s
    return MarlinLimits(
        accel_x_mm_s2=accel.x,
        accel_y_mm_s2=accel.y,
        accel_z_mm_s2=accel.z,
        accel_e_mm_s2=accel.e,
        feedrate_x_mm_s=feedrate.x,
        feedrate_y_mm_s=feedrate.y,
        feedrate_z_mm_s=feedrate.z,
        feedrate_e_mm_s=feedrate.e,
        print_accel_mm_s2=planner.accel_mm_s2,
        retract_accel_mm_s2=planner.retract_accel_mm_s2,
        travel_accel_mm_s2=planner.travel_accel_mm_s2,
        jerk_x_mm_s=jerk.x,
        jerk_y_mm_s=jerk.y,
        jerk_z_mm_s=jerk.z,
        jerk_e_mm_s=jerk.e,
        junction_deviation_mm=planner.junction_deviation_mm,
        min_segment_time_us=planner.min_segment_time_us,
        min_feedrate_mm_s=planner.min_feedrate_mm_s,
        min_travel_feedrate_mm_s=planner.min_travel_feedrate_mm_s,
        linear_advance_k_s=firmware.linear_advance_k_s,
        advance_in_filament=0.0,
    )


def without_advance(own: MarlinLimits) -> MarlinLimits:
    """Return limits under which the firmware's linear advance is off, and what K stays known."""
    return replace(own, advance_in_filament=1.0) if own.linear_advance_k_s > 0.0 else own


def advance_speed_mm_s(own: MarlinLimits, *, classic_jerk: bool) -> float:
    """Return the largest speed that linear advance adds to the extruder's own.

    The firmware lowers accelerations so that it is no more than the extruder's jerk
    (Marlin/src/module/planner.cpp, `_populate_block`: MAX_E_JERK; 2.0.8, 2.1.2.5).
    """
    if classic_jerk:
        return own.jerk_e_mm_s
    half = math.sqrt(0.5)
    return math.sqrt(own.junction_deviation_mm * half / (1.0 - half) * own.accel_e_mm_s2)
