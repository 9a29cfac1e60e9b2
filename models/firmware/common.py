"""Fields that every firmware's section of a machine document has."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple, Self

from pydantic import model_validator

from stillpath.models.document import Document, Finite, NonNegative, Positive

__all__ = [
    "AxisAllowance",
    "FirmwareFacts",
    "FirmwareRetraction",
    "Hotend",
]


_SPEEDS_MM_S, _ACCELS_MM_S2 = (1.0, 1e5), (1.0, 1e7)
"""Beyond what moves a printer: with less a motion has no end, with more it cannot be computed."""


class Hotend(Document):
    """Nozzle and filament."""

    nozzle_diameter_mm: Positive = 0.4
    filament_diameter_mm: Positive = 1.75


class FirmwareRetraction(Document):
    """What G10 and G11 do (Klipper: [firmware_retraction], Marlin: M207 and M208)."""

    retract_length_mm: NonNegative = 0.8
    retract_speed_mm_s: Positive = 35.0
    unretract_extra_length_mm: NonNegative = 0.0
    unretract_speed_mm_s: Positive = 35.0


class AxisAllowance(NamedTuple):
    """What a printer's configuration allows a file along one axis."""

    speed_mm_s: float
    accel_mm_s2: float
    """Of moves that print."""
    corner_mm_s: float
    """Through a square corner."""
    travel_accel_mm_s2: float
    """Of moves that do not print."""


class FirmwareFacts(Document):
    """Facts that G-code cannot tell and that every firmware has; the base of their sections.

    A section adds `kind` (its discriminator), `extruder` (a `Hotend` or more), and its limits.
    """

    arc_resolution_mm: Positive = 1.0
    arcs: bool = True
    retraction: FirmwareRetraction | None = FirmwareRetraction()
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

    @model_validator(mode="after")
    def _can_print(self) -> FirmwareFacts:
        """Refuse limits of X and Y, from whatever fields they follow, that are no printer's."""
        axes: tuple[Literal["x", "y"], ...] = ("x", "y")
        for axis in axes:
            allowed = self.allowance(axis)
            for what, value, (least, most), unit in (
                ("speed", allowed.speed_mm_s, _SPEEDS_MM_S, "mm/s"),
                ("acceleration", allowed.accel_mm_s2, _ACCELS_MM_S2, "mm/s2"),
            ):
                if not least <= value <= most:
                    raise ValueError(
                        f"the largest {what} of {axis.upper()} is {value:g} {unit}, not within "
                        f"{least:g} to {most:g}; state what the printer's configuration says"
                    )
        return self

    @property
    def hotend(self) -> Hotend:
        """Nozzle and filament."""
        raise NotImplementedError

    @property
    def fastest_mm_s(self) -> float:
        """Highest configured speed of X and Y."""
        raise NotImplementedError

    @property
    def largest_accel_mm_s2(self) -> float:
        """Largest configured acceleration of moves that print."""
        raise NotImplementedError

    @property
    def corner_mm_s(self) -> float:
        """Configured speed through a square corner of X and Y."""
        raise NotImplementedError

    def allowance(self, axis: Literal["x", "y"]) -> AxisAllowance:  # noqa: ARG002
        """Return what a file is allowed along X or Y; by default the same."""
        accel = self.largest_accel_mm_s2
        return AxisAllowance(self.fastest_mm_s, accel, self.corner_mm_s, accel)

    def motor_accel_mm_s2(self) -> float:
        """Acceleration that a file can ask of a motor of a CoreXY, on a diagonal.

        By default that of the head, in whatever direction.
        """
        return math.sqrt(2.0) * self.largest_accel_mm_s2

    def driven_at(self, accel_mm_s2: float) -> Self:
        """Return the same firmware with this as its acceleration of X and Y."""
        raise NotImplementedError

    @property
    def fastest_z_mm_s(self) -> float:
        """Highest configured speed of Z."""
        raise NotImplementedError
