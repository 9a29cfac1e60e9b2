"""A Klipper machine's firmware: what printer.cfg says and its G-code cannot tell."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from stillpath.models.document import Document, NonNegative, Positive
from stillpath.models.firmware.common import FirmwareFacts, Hotend

__all__ = ["Extruder", "FirmwareShaper", "Klipper", "PlannerLimits"]


class PlannerLimits(Document):
    """The planner limits from printer.cfg ([printer]); the file may change them as it goes."""

    max_velocity_mm_s: Positive = 500.0
    max_accel_mm_s2: Positive = 5000.0
    square_corner_velocity_mm_s: NonNegative = 5.0
    minimum_cruise_ratio: Annotated[float, Field(ge=0, lt=1)] = 0.5
    max_z_velocity_mm_s: Positive = 20.0
    max_z_accel_mm_s2: Positive = 200.0


class Extruder(Hotend):
    """Extruder facts from printer.cfg ([extruder])."""

    instantaneous_corner_velocity_mm_s: NonNegative = 1.0
    max_extrude_only_velocity_mm_s: Positive = 100.0
    max_extrude_only_accel_mm_s2: Positive = 5000.0
    max_extrude_only_distance_mm: Positive = 50.0
    max_extrude_cross_section_mm2: Positive | None = None
    """None: Klipper's default, 4 nozzle_diameter^2."""


class FirmwareShaper(Document):
    """The firmware's own input shaper as configured, to be restored after our moves."""

    type_x: str = "mzv"
    freq_x_hz: NonNegative = 0.0
    damping_x: NonNegative = 0.1
    type_y: str = "mzv"
    freq_y_hz: NonNegative = 0.0
    damping_y: NonNegative = 0.1


class Klipper(FirmwareFacts):
    """Facts of a Klipper machine that its G-code cannot tell."""

    kind: Literal["klipper"] = "klipper"
    planner: PlannerLimits = PlannerLimits()
    extruder: Extruder = Extruder()
    shaper: FirmwareShaper | None = None
    """None: unknown. It is switched off for our moves and stays off, and the report says so."""
    macros: tuple[str, ...] = ()
    """Configured macros with the name of another firmware's word, such as M205 or M900: they may do
    anything."""

    @property
    def hotend(self) -> Hotend:
        """Nozzle and filament."""
        return self.extruder

    @property
    def fastest_mm_s(self) -> float:
        """Highest configured speed of X and Y."""
        return self.planner.max_velocity_mm_s

    @property
    def largest_accel_mm_s2(self) -> float:
        """Largest configured acceleration of moves that print."""
        return self.planner.max_accel_mm_s2

    @property
    def corner_mm_s(self) -> float:
        """Configured speed through a square corner of X and Y."""
        return self.planner.square_corner_velocity_mm_s

    @property
    def fastest_z_mm_s(self) -> float:
        """Highest configured speed of Z."""
        return self.planner.max_z_velocity_mm_s
