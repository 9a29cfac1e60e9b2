"""What a machine is: kinematics, travel, limits, firmware facts and the plants of its axes.

A machine is one JSON document. Every bound is checked where the document is read, so that the
rest of the house can rely on it.
"""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Literal

from pydantic import Field, model_validator

from stillpath.models.confirmation import Confirmation
from stillpath.models.document import Document, Finite, NonNegative, Positive
from stillpath.models.errors import ModelError
from stillpath.models.firmware import Firmware, Klipper
from stillpath.models.plants import PlantSetSpec
from stillpath.models.provenance import ADDED
from stillpath.models.ripple import AxisRipple, MachineRipple, RippleAxis
from stillpath.models.schedule import AxisSchedule

__all__ = [
    "AxisTravel",
    "CommandLimits",
    "Machine",
]


class AxisTravel(Document):
    """Where an axis may go; no emitted coordinate lies outside."""

    min_mm: Finite
    max_mm: Finite

    @model_validator(mode="after")
    def _ordered(self) -> AxisTravel:
        if self.min_mm >= self.max_mm:
            raise ValueError(f"min_mm {self.min_mm} must be below max_mm {self.max_mm}")
        return self


class CommandLimits(Document):
    """What the motors of X and Y bear: no command asks for more, nor does a stream that breaks off.

    The written stream runs under these limits, so that the firmware itself keeps them whatever
    happens: braking for a pause, going on behind it, at any line.
    """

    velocity_mm_s: Positive = 500.0
    accel_mm_s2: Positive = 20_000.0
    speed_step_mm_s: Positive = 45.0
    """Largest step of a motor's speed within a ms, from one straight segment to the next."""


class Machine(Document):
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
    confirmations : dict
        `x` and `y` to what a ring test on the machine said of the plants.
    """

    schema_version: Literal[1] = 1
    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]
    title: Annotated[str, Field(max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")]
    source: str = ""
    kinematics: Literal["cartesian", "corexy"]
    travel: dict[Literal["x", "y", "z"], AxisTravel]
    command: CommandLimits = CommandLimits()
    firmware: Firmware = Klipper()
    axes: dict[Literal["x", "y"], PlantSetSpec]
    pressure_advance_s: NonNegative = 0.0
    mesh_slope: NonNegative = 0.0
    schedules: dict[Literal["x", "y"], AxisSchedule] = Field(default_factory=dict)
    ripple: dict[RippleAxis, AxisRipple] = Field(default_factory=dict)
    confirmations: dict[Literal["x", "y"], Confirmation] = Field(default_factory=dict)

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
        for added in ("schedules", "ripple", "confirmations"):
            if not content[added]:
                # Machines from before there were such fields keep their revision.
                del content[added]
        for axis in content["axes"].values():
            if axis["friction_mm"] is None:
                del axis["friction_mm"]
            about = axis["provenance"] or {}
            for added in ADDED:
                if about.get(added, ...) is None:
                    del about[added]
        if not content["firmware"].get("ft_motion", True):
            del content["firmware"]["ft_motion"]
        if content["firmware"].get("ft_motion_version") == 2:
            del content["firmware"]["ft_motion_version"]
        document = json.dumps(content, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(document.encode()).hexdigest()[:12]

    @property
    def friction_mm(self) -> tuple[float, float]:
        """How far dry friction holds X and Y back."""
        return self.axes["x"].friction_mm or 0.0, self.axes["y"].friction_mm or 0.0

    def without_friction(self) -> Machine:
        """Return the machine with guides that do not rub."""
        axes = {k: v.model_copy(update={"friction_mm": None}) for k, v in self.axes.items()}
        return self.model_copy(update={"axes": axes})

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
