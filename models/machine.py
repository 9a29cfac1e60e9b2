"""What a machine is: kinematics, travel, limits, firmware facts and the plants of its axes.

A machine is one JSON document. Every bound is checked where the document is read, so that the
rest of the house can rely on it.
"""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from models.errors import ModelError
from models.plants import PlantSetSpec
from models.ripple import AxisRipple, MachineRipple, RippleAxis
from models.schedule import AxisSchedule

__all__ = [
    "AxisTravel",
    "CommandLimits",
    "Extruder",
    "FirmwareRetraction",
    "FirmwareShaper",
    "Klipper",
    "Machine",
    "PlannerLimits",
]

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Document(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class AxisTravel(_Document):
    """Where an axis may go; no emitted coordinate lies outside."""

    min_mm: Finite
    max_mm: Finite

    @model_validator(mode="after")
    def _ordered(self) -> AxisTravel:
        if self.min_mm >= self.max_mm:
            raise ValueError(f"min_mm {self.min_mm} must be below max_mm {self.max_mm}")
        return self


class PlannerLimits(_Document):
    """The planner limits from printer.cfg ([printer]); the file may change them as it goes."""

    max_velocity_mm_s: Positive = 500.0
    max_accel_mm_s2: Positive = 5000.0
    square_corner_velocity_mm_s: NonNegative = 5.0
    minimum_cruise_ratio: Annotated[float, Field(ge=0, lt=1)] = 0.5
    max_z_velocity_mm_s: Positive = 20.0
    max_z_accel_mm_s2: Positive = 200.0


class Extruder(_Document):
    """Extruder facts from printer.cfg ([extruder])."""

    nozzle_diameter_mm: Positive = 0.4
    filament_diameter_mm: Positive = 1.75
    instantaneous_corner_velocity_mm_s: NonNegative = 1.0
    max_extrude_only_velocity_mm_s: Positive = 100.0
    max_extrude_only_accel_mm_s2: Positive = 5000.0
    max_extrude_only_distance_mm: Positive = 50.0
    max_extrude_cross_section_mm2: Positive | None = None
    """None: Klipper's default, 4 nozzle_diameter^2."""


class FirmwareRetraction(_Document):
    """[firmware_retraction] of printer.cfg, what G10 and G11 do."""

    retract_length_mm: NonNegative = 0.8
    retract_speed_mm_s: Positive = 35.0
    unretract_extra_length_mm: NonNegative = 0.0
    unretract_speed_mm_s: Positive = 35.0


class FirmwareShaper(_Document):
    """The firmware's own input shaper as configured, to be restored after our moves."""

    type_x: str = "mzv"
    freq_x_hz: NonNegative = 0.0
    damping_x: NonNegative = 0.1
    type_y: str = "mzv"
    freq_y_hz: NonNegative = 0.0
    damping_y: NonNegative = 0.1


class Klipper(_Document):
    """Facts of a Klipper machine that its G-code cannot tell."""

    kind: Literal["klipper"] = "klipper"
    planner: PlannerLimits = PlannerLimits()
    extruder: Extruder = Extruder()
    arc_resolution_mm: Positive = 1.0
    arcs: bool = True
    retraction: FirmwareRetraction | None = FirmwareRetraction()
    shaper: FirmwareShaper | None = None
    """None: unknown. It is switched off for our moves and stays off, and the report says so."""
    harmless_macros: tuple[str, ...] = ()
    """Configured macros that neither move nor wait, for instance _ON_LAYER_CHANGE."""
    stopping_macros: tuple[str, ...] = ()
    """Configured macros that wait but end at the position where they began."""
    unknown_commands: Literal["unknown", "skip"] = "unknown"
    """What an upper-case name that no table knows does: leaves the state unknown (it may be a
    macro), or nothing (the firmware is known to lack it)."""
    homed_at_start: bool = False
    """True: X, Y and Z are known (at `home_mm`) before the first line."""
    home_mm: tuple[Finite, Finite, Finite] | None = None
    """Where G28 leaves the axes, if the machine says; None: unknown after homing."""
    max_segments_per_s: Positive = 1000.0


class CommandLimits(_Document):
    """What the compensated command of X and Y may ask of the machine."""

    velocity_mm_s: Positive = 500.0
    accel_mm_s2: Positive = 20_000.0
    speed_step_mm_s: Positive = 45.0
    """Largest step of a motor's speed from one straight segment to the next."""


class Machine(_Document):
    """One printer.

    Attributes
    ----------
    axes : dict
        `x` and `y` to the plants (commanded position to nozzle position) of that axis.
    mesh_slope : float
        Largest slope of the bed mesh; Z follows X and Y with at most this ratio.
    schedules : dict
        `x` and `y` to how the plants of that axis change during a print, if they do. Without a
        schedule, or where none is looked at, the plants are those of `axes`.
    ripple : dict
        `x`, `y` and the motors of CoreXY, `a` and `b`, to errors that repeat with position.
    """

    schema_version: Literal[1] = 1
    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]
    title: Annotated[str, Field(max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")]
    source: str = ""
    kinematics: Literal["cartesian", "corexy"]
    travel: dict[Literal["x", "y", "z"], AxisTravel]
    command: CommandLimits = CommandLimits()
    firmware: Klipper = Klipper()
    axes: dict[Literal["x", "y"], PlantSetSpec]
    pressure_advance_s: NonNegative = 0.0
    mesh_slope: NonNegative = 0.0
    schedules: dict[Literal["x", "y"], AxisSchedule] = {}
    ripple: dict[RippleAxis, AxisRipple] = {}

    @model_validator(mode="after")
    def _complete(self) -> Machine:
        for axis in ("x", "y", "z"):
            if axis not in self.travel:
                raise ValueError(f"travel of axis {axis} is missing")
        for axis in ("x", "y"):
            if axis not in self.axes:
                raise ValueError(f"plant of axis {axis} is missing")
        self._check_schedules()
        MachineRipple(self.kinematics, self.ripple)
        return self

    @property
    def revision(self) -> str:
        """First 12 hex digits of the SHA-256 of the canonical JSON document."""
        content = self.model_dump(mode="json")
        for added in ("schedules", "ripple"):
            if not content[added]:
                # Machines from before there were such fields keep their revision.
                del content[added]
        document = json.dumps(content, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(document.encode()).hexdigest()[:12]

    def _check_schedules(self) -> None:
        densities = set()
        for axis, schedule in self.schedules.items():
            try:
                schedule.check(self.axes[axis])
            except ModelError as error:
                raise ModelError(f"schedule of axis {axis}: {error}") from None
            if schedule.mass is not None:
                densities.add(schedule.mass.filament_density_g_cm3)
                if self.kinematics == "corexy":
                    raise ModelError(
                        f"schedule of axis {axis}: the bed of a corexy machine does not move in X "
                        "and Y, so the print's mass changes nothing; leave `mass` out"
                    )
        if len(densities) > 1:
            raise ModelError(
                f"the schedules name filament densities of {sorted(densities)} g/cm3; there is one "
                "filament"
            )
