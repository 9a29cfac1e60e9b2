"""The machine document: kinematics, travel, limits, firmware facts and the plants of its axes.

A machine is one JSON document. Every bound is checked where the document is read, so that the
rest of the house can rely on it.
"""

from __future__ import annotations

import hashlib
import json
import math
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, Field, model_validator

from stillpath.models.confirmation import Confirmation
from stillpath.models.document import Document, Finite, NonNegative, Positive
from stillpath.models.errors import ModelError
from stillpath.models.firmware import Firmware, Klipper
from stillpath.models.plants import PlantSetSpec
from stillpath.models.provenance import ADDED
from stillpath.models.ripple import AxisRipple, MachineRipple, RippleAxis
from stillpath.models.schedule import AxisSchedule

__all__ = [
    "AxisLimits",
    "AxisTravel",
    "CommandLimits",
    "Machine",
    "MotorLimits",
]


_Part = TypeVar("_Part", bound=Document)

_FASTEST_MM_S, _STRONGEST_MM_S2 = 1e5, 1e7
"""Ten times what the fastest machines reach; with far larger limits no motion can be computed."""

_ADDED: dict[tuple[str, ...], dict[str, Any]] = {
    (): {"schedules": {}, "ripple": {}, "confirmations": {}},
    ("command",): {"axes": {}, "motors": None},
    ("axes", "*"): {"friction_mm": None},
    ("axes", "*", "provenance"): dict.fromkeys(ADDED),
    ("firmware",): {
        "ft_motion": False,
        "ft_motion_version": 2,
        "macros": [],
        "macros_known": False,
        "no_input_shaper": False,
        "limit_macros": [],
        "arc_circles": False,
        "limits_capped": False,
    },
    ("firmware", "extruder"): {"pressure_advance_smooth_time_s": 0.04},
    ("firmware", "planner"): {"max_accel_to_decel_mm_s2": None},
}
"""Fields that older documents lack, by place, with the value that says nothing new: where they have
it, they are left out of the revision, so that machines from before them keep theirs."""


def _up_to(most: float, unit: str) -> AfterValidator:
    def check(value: float) -> float:
        if value > most:
            raise ValueError(
                f"{value:g} {unit} is more than any motor bears; state what yours do, at most "
                f"{most:g} {unit}, or leave it out"
            )
        return value

    return AfterValidator(check)


_Speed = Annotated[Positive, _up_to(_FASTEST_MM_S, "mm/s")]
_Accel = Annotated[Positive, _up_to(_STRONGEST_MM_S2, "mm/s2")]


class AxisTravel(Document):
    """Where an axis may go; no emitted coordinate lies outside."""

    min_mm: Finite
    max_mm: Finite

    @model_validator(mode="after")
    def _ordered(self) -> AxisTravel:
        if self.min_mm >= self.max_mm:
            raise ValueError(f"min_mm {self.min_mm} must be below max_mm {self.max_mm}")
        return self


class AxisLimits(Document):
    """Limits of one axis, where they exceed those of `CommandLimits`; None: the same."""

    velocity_mm_s: _Speed | None = None
    accel_mm_s2: _Accel | None = None
    speed_step_mm_s: _Speed | None = None


class MotorLimits(Document):
    """What each motor of a CoreXY bears of x + y, or x - y; None: as much as both axes ask."""

    velocity_mm_s: _Speed | None = None
    accel_mm_s2: _Accel | None = None


class CommandLimits(Document):
    """What the motors of X and Y bear: no command asks for more, nor does a stream that breaks off.

    The written stream runs under these limits, so that the firmware itself keeps them whatever
    happens: braking for a pause, going on after it, at any line.

    The plain numbers hold for X as well as for Y. Along one axis more may be borne (`axes`, where
    each axis has a motor); where both motors move either axis (CoreXY), X and Y together may be
    held to less than their sum (`motors`).
    """

    velocity_mm_s: _Speed = 500.0
    accel_mm_s2: _Accel = 20_000.0
    speed_step_mm_s: _Speed = 45.0
    """Largest step of a motor's speed within a ms, from one straight segment to the next."""
    axes: dict[Literal["x", "y"], AxisLimits] = Field(default_factory=dict)
    motors: MotorLimits | None = None

    @model_validator(mode="after")
    def _not_less(self) -> CommandLimits:
        parts = [(f"axes.{axis}", more) for axis, more in self.axes.items()]
        for place, more in [*parts, ("motors", self.motors)]:
            for name, value in {} if more is None else more:
                if value is not None and value < getattr(self, name):
                    raise ValueError(
                        f"{place}.{name} is {value:g}, below {name} {getattr(self, name):g}, which "
                        f"holds for every axis and motor: lower {name} to {value:g}, and state "
                        "what bears more"
                    )
        return self

    def of(self, axis: Literal["x", "y"]) -> CommandLimits:
        """Return what one axis bears by itself."""
        more = self.axes.get(axis)
        if more is None:
            return self
        stated = {name: value for name, value in more if value is not None}
        return self.model_copy(update={**stated, "axes": {}})

    @property
    def every_way(self) -> CommandLimits:
        """What is borne in every direction, by a firmware that has one limit for all of them.

        A motor of a CoreXY sees up to sqrt(2) times what the head does.
        """
        if self.motors is None or self.motors.accel_mm_s2 is None:
            return self
        accel = min(self.accel_mm_s2, self.motors.accel_mm_s2 / math.sqrt(2.0))
        return self.model_copy(update={"accel_mm_s2": accel})

    def scaled(self, *, velocity: float, accel: float) -> CommandLimits:
        """Return the limits with speeds and accelerations multiplied."""
        ratios = {"velocity_mm_s": velocity, "accel_mm_s2": accel}
        axes = {axis: _multiplied(more, ratios) for axis, more in self.axes.items()}
        motors = None if self.motors is None else _multiplied(self.motors, ratios)
        return _multiplied(self, ratios).model_copy(update={"axes": axes, "motors": motors})


def _parts(content: dict[str, Any], place: tuple[str, ...]) -> list[dict[str, Any]]:
    """Return the objects at a place of a JSON document; ``*`` is any name, null is no object."""
    parts = [content]
    for name in place:
        found = [value for part in parts for key, value in part.items() if name in (key, "*")]
        parts = [value for value in found if value is not None]
    return parts


def _multiplied(document: _Part, ratios: dict[str, float]) -> _Part:
    given = {name: getattr(document, name) for name in ratios}
    return document.model_copy(
        update={name: ratios[name] * value for name, value in given.items() if value is not None}
    )


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
        self._check_command()
        self._check_schedules()
        MachineRipple(self.kinematics, self.ripple)
        return self

    @property
    def revision(self) -> str:
        """First 12 hex digits of the SHA-256 of the canonical JSON document."""
        content = self.model_dump(mode="json")
        for place, added in _ADDED.items():
            for part in _parts(content, place):
                for name, before in added.items():
                    if name in part and part[name] == before:
                        del part[name]
        document = json.dumps(content, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(document.encode()).hexdigest()[:12]

    @property
    def live_refusal(self) -> str | None:
        """Why it cannot compensate while it prints (inside Klipper); None: it can."""
        if self.firmware.kind != "klipper":
            return (
                f"machine {self.name} runs {self.firmware.kind}: only Klipper has print-time "
                "compensation; print a compensated file instead"
            )
        if self.kinematics not in ("cartesian", "corexy"):
            return (
                f"machine {self.name} has {self.kinematics} kinematics: the extra of Klipper knows "
                "cartesian and corexy; print a compensated file instead"
            )
        return None

    @property
    def friction_mm(self) -> tuple[float, float]:
        """How far dry friction holds X and Y back."""
        return self.axes["x"].friction_mm or 0.0, self.axes["y"].friction_mm or 0.0

    def without_friction(self) -> Machine:
        """Return the machine with guides that do not rub."""
        axes = {k: v.with_friction(None) for k, v in self.axes.items()}
        return self.model_copy(update={"axes": axes})

    def _check_command(self) -> None:
        """See that limits by axis or motor are of a kind that kinematics and firmware know."""
        command = self.command
        if command.axes and self.kinematics == "corexy":
            raise ModelError(
                "command.axes: both motors of a corexy machine move X and Y; say what a motor "
                "bears in command.motors"
            )
        if command.motors is not None and self.kinematics != "corexy":
            raise ModelError(
                "command.motors: on a cartesian machine each axis has a motor; say what an axis "
                "bears in command.axes"
            )
        if command.axes and self.firmware.kind == "klipper":
            raise ModelError(
                "command.axes: Klipper has one acceleration and one corner speed for X and Y, so "
                "a stream that breaks off asks either axis for them: put what the weaker one bears "
                "at command.accel_mm_s2, velocity_mm_s and speed_step_mm_s, and leave axes out"
            )

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
