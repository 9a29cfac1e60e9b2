"""A RepRapFirmware machine's firmware: what config.g says and its G-code cannot tell."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field

from stillpath.models.document import Document, NonNegative, Positive
from stillpath.models.firmware.common import AxisAllowance, FirmwareFacts, Hotend

__all__ = ["Drive", "RepRapExtruder", "RepRapFirmware", "RepRapShaper"]


class Drive(Document):
    """What M92, M203, M201 and M566 say of an axis, or of the motor of a CoreXY axis."""

    steps_per_mm: Positive = 80.0
    """Microsteps per mm (M92). Which microstepping and motor make them up does not matter."""
    max_speed_mm_s: Positive = 100.0
    """M203 (there in mm/min)."""
    max_accel_mm_s2: Positive = 1000.0
    """M201."""
    jerk_mm_s: Annotated[float, Field(ge=0.1, allow_inf_nan=False)] = 15.0
    """M566 (there in mm/min): the speed may step by this much from move to move."""


class RepRapExtruder(Hotend, Drive):
    """The extruder drive, its nozzle and its filament. All extruders have the same limits."""

    steps_per_mm: Positive = 420.0
    max_accel_mm_s2: Positive = 500.0
    jerk_mm_s: Annotated[float, Field(ge=0.1, allow_inf_nan=False)] = 5.0


class RepRapShaper(Document):
    """The firmware's own input shaper (M593), to be restored after our moves."""

    type: Literal["none", "mzv", "zvd", "zvdd", "zvddd", "ei2", "ei3"] = "none"
    """The P parameter. One of P"custom" cannot be restored by its name, and is not supported."""
    freq_hz: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 40.0
    damping: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.1


class RepRapFirmware(FirmwareFacts):
    """Facts of a RepRapFirmware machine that its G-code cannot tell.

    Defaults are the firmware's own where it has any (src/Config/Configuration.h, 3.6.0-beta.2,
    2024-11).
    """

    kind: Literal["reprapfirmware"] = "reprapfirmware"
    x: Drive = Drive()
    y: Drive = Drive()
    z: Drive = Drive(steps_per_mm=800.0, max_speed_mm_s=20.0, max_accel_mm_s2=200.0, jerk_mm_s=10.0)
    extruder: RepRapExtruder = RepRapExtruder()
    min_speed_mm_s: Annotated[float, Field(ge=0.01, allow_inf_nan=False)] = 0.5
    """M203 I."""
    print_accel_mm_s2: Positive = 50_000.0
    """M204 P: moves of X or Y that feed filament."""
    travel_accel_mm_s2: Positive = 50_000.0
    """M204 T: other moves of X or Y."""
    jerk_policy: Annotated[int, Field(ge=0)] = 0
    """M566 P. 0: no jerk between moves of different kind (printing, travel, without X and Y)."""
    shaper: RepRapShaper = RepRapShaper()
    """M593."""
    ring_length: Annotated[int, Field(ge=4, le=1000)] = 40
    """Moves that the queue holds (M595 P): 60 on Duet 3 6HC and 6XD, 40 on Duet 3 Mini and Duet 2
    unless config.g says more."""
    step_clock_hz: Positive = 750_000.0
    """Duet 3; 937 500 on Duet 2."""
    prepare_ahead_s: Positive = 0.05
    """How long before its start a move is frozen; what comes later cannot change it."""
    prepare_least_s: NonNegative = 0.025
    """A move that is frozen later than this before its start is delayed: the motion stutters. Say 0
    for 3.5 and older (before 3.6.0-beta.2), where it follows without a pause."""
    arc_deviation_mm: Positive = 0.005
    arc_least_mm: Positive = 0.02
    arc_segments_per_s: Positive = 200.0
    unknown_commands: Literal["unknown", "skip"] = "unknown"

    @property
    def hotend(self) -> Hotend:
        """Nozzle and filament."""
        return self.extruder

    @property
    def drives(self) -> tuple[Drive, Drive, Drive, Drive]:
        """X, Y, Z and extruder."""
        return self.x, self.y, self.z, self.extruder

    @property
    def fastest_mm_s(self) -> float:
        """Highest configured speed of X and Y."""
        return max(self.x.max_speed_mm_s, self.y.max_speed_mm_s)

    @property
    def largest_accel_mm_s2(self) -> float:
        """Largest configured acceleration of moves that print."""
        return min(self.print_accel_mm_s2, max(self.x.max_accel_mm_s2, self.y.max_accel_mm_s2))

    @property
    def corner_mm_s(self) -> float:
        """Configured speed through a square corner of X and Y."""
        return min(self.x.jerk_mm_s, self.y.jerk_mm_s)

    def allowance(self, axis: Literal["x", "y"]) -> AxisAllowance:
        """Return what a file is allowed along X or Y."""
        drive: Drive = getattr(self, axis)
        accel, travel = (
            min(most, drive.max_accel_mm_s2)
            for most in (self.print_accel_mm_s2, self.travel_accel_mm_s2)
        )
        return AxisAllowance(drive.max_speed_mm_s, accel, drive.jerk_mm_s, travel)

    def driven_at(self, accel_mm_s2: float) -> RepRapFirmware:
        """Return the same firmware with this as its acceleration of X and Y."""
        most = {"max_accel_mm_s2": accel_mm_s2}
        changed = {
            "x": self.x.model_copy(update=most),
            "y": self.y.model_copy(update=most),
            "print_accel_mm_s2": accel_mm_s2,
            "travel_accel_mm_s2": accel_mm_s2,
        }
        return self.model_copy(update=changed)

    def motor_accel_mm_s2(self) -> float:
        """Return what M201 leaves of the acceleration of a diagonal: it holds for motors, too."""
        least = min(self.x.max_accel_mm_s2, self.y.max_accel_mm_s2)
        return min(math.sqrt(2.0) * max(self.print_accel_mm_s2, self.travel_accel_mm_s2), least)

    @property
    def fastest_z_mm_s(self) -> float:
        """Highest configured speed of Z."""
        return self.z.max_speed_mm_s
