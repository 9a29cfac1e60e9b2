"""RepRapFirmware's planner limits that G-code can change."""

from __future__ import annotations

from dataclasses import dataclass

from stillpath.gcode.types import Limits
from stillpath.models.firmware.reprapfirmware import RepRapFirmware

__all__ = ["RepRapLimits"]


@dataclass(frozen=True, slots=True)
class RepRapLimits(Limits):
    """What M201, M203, M204, M566, M205 and M572 set, in mm and s.

    M566 sets the jerk and its ceiling; M205 sets the jerk alone, up to the ceiling
    (src/Movement/Move2.cpp SetInstantDv, 3.6.0-beta.2, 2024-11). Before 3.6 both are one.
    """

    accel_x_mm_s2: float
    accel_y_mm_s2: float
    accel_z_mm_s2: float
    accel_e_mm_s2: float
    speed_x_mm_s: float
    speed_y_mm_s: float
    speed_z_mm_s: float
    speed_e_mm_s: float
    min_speed_mm_s: float
    print_accel_mm_s2: float
    travel_accel_mm_s2: float
    jerk_x_mm_s: float
    jerk_y_mm_s: float
    jerk_z_mm_s: float
    jerk_e_mm_s: float
    max_jerk_x_mm_s: float
    max_jerk_y_mm_s: float
    max_jerk_z_mm_s: float
    max_jerk_e_mm_s: float
    jerk_policy: float
    pressure_advance_s: float

    @classmethod
    def of(cls, firmware: RepRapFirmware, pressure_advance_s: float) -> RepRapLimits:
        """Return what config.g sets."""
        drives = firmware.drives
        jerks = [drive.jerk_mm_s for drive in drives]
        row = (
            *(drive.max_accel_mm_s2 for drive in drives),
            *(drive.max_speed_mm_s for drive in drives),
            firmware.min_speed_mm_s,
            firmware.print_accel_mm_s2,
            firmware.travel_accel_mm_s2,
            *jerks,
            *jerks,
            float(firmware.jerk_policy),
            pressure_advance_s,
        )
        return cls.from_row(row)
