"""A Marlin machine's firmware: what Configuration.h and M503 say and its G-code cannot tell.

The defaults are those of a Creality Ender-3 on Marlin 2.1 (MarlinFirmware/Configurations,
config/examples/Creality/Ender-3/CrealityV1, 2.1.x). Rules and sources: docs/marlin.md.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from stillpath.models.document import Document, NonNegative, Positive
from stillpath.models.firmware.common import AxisAllowance, FirmwareFacts, Hotend

__all__ = ["Marlin", "MarlinPlanner", "MarlinShaper", "PerAxis", "PerAxisLimit"]


_MOST_STEPS_PER_MM = 4000


class PerAxis(Document):
    """One positive number for each of X, Y, Z and E."""

    x: Positive
    y: Positive
    z: Positive
    e: Positive


def _countable(steps: PerAxis) -> PerAxis:
    """Refuse microsteps that Marlin's 32-bit step rates cannot count at the speeds of a stream."""
    for axis, per_mm in (("x", steps.x), ("y", steps.y)):
        if per_mm > _MOST_STEPS_PER_MM:
            raise ValueError(
                f"must be at most {_MOST_STEPS_PER_MM} in X and Y, and is {per_mm:g} in "
                f"{axis.upper()}; state what M92 says"
            )
    return steps


class PerAxisLimit(Document):
    """One number, 0 or more, for each of X, Y, Z and E."""

    x: NonNegative
    y: NonNegative
    z: NonNegative
    e: NonNegative


class MarlinPlanner(Document):
    """The planner limits as they are at power-on (M503); the file may change them as it goes."""

    max_feedrate_mm_s: PerAxis = PerAxis(x=500.0, y=500.0, z=5.0, e=25.0)
    """M203."""
    max_accel_mm_s2: PerAxis = PerAxis(x=500.0, y=500.0, z=100.0, e=5000.0)
    """M201."""
    accel_mm_s2: Positive = 500.0
    """M204 P."""
    retract_accel_mm_s2: Positive = 500.0
    """M204 R."""
    travel_accel_mm_s2: Positive = 500.0
    """M204 T."""
    jerk_mm_s: PerAxisLimit = PerAxisLimit(x=10.0, y=10.0, z=0.3, e=5.0)
    """M205 X Y Z E, where CLASSIC_JERK is configured."""
    junction_deviation_mm: Annotated[float, Field(gt=0, le=10)] = 0.08
    """M205 J, where CLASSIC_JERK is not configured."""
    min_segment_time_us: NonNegative = 20_000.0
    """M205 B."""
    min_feedrate_mm_s: NonNegative = 0.0
    """M205 S."""
    min_travel_feedrate_mm_s: NonNegative = 0.0
    """M205 T."""


class MarlinShaper(Document):
    """The firmware's own ZV shaper as configured (M593), to be restored after our moves."""

    freq_x_hz: NonNegative = 0.0
    damping_x: Annotated[float, Field(ge=0, lt=1)] = 0.15
    freq_y_hz: NonNegative = 0.0
    damping_y: Annotated[float, Field(ge=0, lt=1)] = 0.15


class Marlin(FirmwareFacts):
    """Facts of a Marlin machine that its G-code cannot tell."""

    kind: Literal["marlin"] = "marlin"
    variant: Literal["2.0", "2.1", "bugfix", "prusa", "bambu"] = "2.1"
    """Which rules the planner follows: releases 2.0.x, releases 2.1.x up to 2.1.2, the planner of
    bugfix-2.1.x since 2024, Prusa-Firmware-Buddy, or Bambu's closed firmware (an estimate)."""
    extruder: Hotend = Hotend()
    planner: MarlinPlanner = MarlinPlanner()
    steps_per_mm: Annotated[PerAxis, AfterValidator(_countable)] = PerAxis(
        x=80.0, y=80.0, z=400.0, e=93.0
    )
    """M92."""
    junction: Literal["deviation", "classic_jerk"] = "deviation"
    small_segment_junctions: bool = True
    """JD_HANDLE_SMALL_SEGMENTS."""
    s_curve: bool = False
    """S_CURVE_ACCELERATION."""
    slowdown: bool = True
    """SLOWDOWN: segments shorter than M205 B are stretched while the queue is short."""
    min_steps_per_segment: Annotated[int, Field(ge=1, le=1000)] = 6
    """MIN_STEPS_PER_SEGMENT: 6 in most configurations, 1 in some."""
    block_buffer_size: Literal[4, 8, 16, 32, 64, 128] = 16
    """BLOCK_BUFFER_SIZE."""
    minimum_planner_speed_mm_s: Positive = 0.05
    """MINIMUM_PLANNER_SPEED: lowest speed at a junction. `bugfix` computes its own."""
    linear_advance: bool | None = None
    """LIN_ADVANCE, classic: K above 0 caps accelerations. None: not known; times are planned as
    without it, but a file that sets K is taken for one of a printer that has it: the stream's
    filament holds its advance, where that would not have lowered the accelerations."""
    linear_advance_k_s: Annotated[float, Field(ge=0, le=10)] = 0.0
    """K at power-on (M900), up to 10 as Marlin takes it."""
    min_arc_segment_mm: Positive = 0.1
    """MIN_ARC_SEGMENT_MM; the longest segment is `arc_resolution_mm` (MAX_ARC_SEGMENT_MM)."""
    min_circle_segments: Annotated[int, Field(ge=1)] = 72
    """MIN_CIRCLE_SEGMENTS."""
    arc_circles: bool = False
    """ARC_P_CIRCLES: P of G2 and G3 adds circles. Others pass it over, as Orca's P1 in lifts."""
    inch_mode: bool = False
    """INCH_MODE_SUPPORT: G20."""
    cnc_planes: bool = False
    """CNC_WORKSPACE_PLANES: G18 and G19."""
    cnc_workspaces: bool = False
    """CNC_COORDINATE_SYSTEMS: G53 to G59.3 and G92.1."""
    bezier_curves: bool = False
    """BEZIER_CURVE_SUPPORT: G5."""
    saved_positions: bool = False
    """SAVED_POSITIONS: G60 and G61."""
    motion_modes: bool = False
    """GCODE_MOTION_MODES: a line may leave out the G of the line before it."""
    case_insensitive: bool = False
    """GCODE_CASE_INSENSITIVE: lower case is read."""
    paren_comments: bool = False
    """PAREN_COMMENTS: ( ) encloses a comment."""
    max_cmd_size: Annotated[int, Field(ge=32, le=4096)] = 96
    """MAX_CMD_SIZE: one less than this is read of a line, the rest is cut off."""
    shaper: MarlinShaper | None = None
    """None: not known. Without a shaper (M593) both frequencies are 0."""
    ft_motion: bool = False
    """FT_MOTION is built in and on (M493): it has shapers of its own, and M593 has no effect."""
    ft_motion_version: Literal[1, 2] = 2
    """How M493 is read; what it answers to M493 V. 2, since 2025-10: X and Y say whose C, A and I
    follow. 1, since 2024-03, does not answer: X and Y are shapers, A and I are X's, B and J Y's."""
    board: Literal["32bit", "avr"] = "32bit"
    """An 8-bit board computes step rates in 16 bits and cannot follow a dense stream."""
    step_timer_hz: Annotated[float, Field(ge=1e5, le=1e9)] = 2e6
    """STEPPER_TIMER_RATE: times between steps are whole ticks of it."""
    step_smoothing_hz: NonNegative = 0.0
    """ADAPTIVE_STEP_SMOOTHING: steps are timed in halves, quarters, ... up to this rate
    (MIN_STEP_ISR_FREQUENCY); 0: it is off."""
    link: Literal["media", "serial"] = "media"
    """Where the lines come from: the printer's own card or stick, or a host's serial line."""
    baud_rate: Annotated[int, Field(gt=0)] = 115_200
    unknown_commands: Literal["unknown", "skip"] = "skip"
    max_segments_per_s: Positive = 500.0
    """What a 32-bit board reads, plans and executes for long; the queue bears short bursts."""

    @model_validator(mode="after")
    def _arcs_fit(self) -> Marlin:
        if self.min_arc_segment_mm > self.arc_resolution_mm:
            raise ValueError(
                f"min_arc_segment_mm {self.min_arc_segment_mm:g} is above arc_resolution_mm "
                f"{self.arc_resolution_mm:g}"
            )
        return self

    @property
    def shortest_move_mm(self) -> float:
        """Shortest move along X or Y that is not swallowed (MIN_STEPS_PER_SEGMENT)."""
        scale = self.steps_per_mm
        return self.min_steps_per_segment * max(1.0 / scale.x, 1.0 / scale.y)

    @property
    def hotend(self) -> Hotend:
        """Nozzle and filament."""
        return self.extruder

    @property
    def fastest_mm_s(self) -> float:
        """Highest configured speed that X and Y both have."""
        return min(self.planner.max_feedrate_mm_s.x, self.planner.max_feedrate_mm_s.y)

    @property
    def largest_accel_mm_s2(self) -> float:
        """Largest configured acceleration of moves that print."""
        limit = self.planner.max_accel_mm_s2
        return min(self.planner.accel_mm_s2, max(limit.x, limit.y))

    @property
    def corner_mm_s(self) -> float:
        """Configured speed through a square corner of X and Y."""
        planner = self.planner
        if self.junction == "classic_jerk":
            return min(planner.jerk_mm_s.x, planner.jerk_mm_s.y)
        bend = planner.junction_deviation_mm * self.largest_accel_mm_s2
        return math.sqrt(bend / (math.sqrt(2.0) - 1.0))

    def allowance(self, axis: Literal["x", "y"]) -> AxisAllowance:
        """Return what a file is allowed along X or Y."""
        planner = self.planner
        accel, travel = (
            min(most, getattr(planner.max_accel_mm_s2, axis))
            for most in (planner.accel_mm_s2, planner.travel_accel_mm_s2)
        )
        corner = self.corner_mm_s
        if self.junction == "classic_jerk":
            corner = getattr(planner.jerk_mm_s, axis)
        return AxisAllowance(getattr(planner.max_feedrate_mm_s, axis), accel, corner, travel)

    def driven_at(self, accel_mm_s2: float) -> Marlin:
        """Return the same firmware with this as its acceleration of X and Y."""
        most = self.planner.max_accel_mm_s2.model_copy(update={"x": accel_mm_s2, "y": accel_mm_s2})
        changed = {
            "max_accel_mm_s2": most,
            "accel_mm_s2": accel_mm_s2,
            "travel_accel_mm_s2": accel_mm_s2,
        }
        return self.model_copy(update={"planner": self.planner.model_copy(update=changed)})

    def motor_accel_mm_s2(self) -> float:
        """Return what M201 leaves of the acceleration of a diagonal: it holds for motors."""
        planner, limit = self.planner, self.planner.max_accel_mm_s2
        largest = max(planner.accel_mm_s2, planner.travel_accel_mm_s2)
        return min(math.sqrt(2.0) * largest, limit.x, limit.y)

    @property
    def fastest_z_mm_s(self) -> float:
        """Highest configured speed of Z."""
        return self.planner.max_feedrate_mm_s.z
