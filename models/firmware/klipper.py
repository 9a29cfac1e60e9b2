"""A Klipper machine's firmware: what printer.cfg says and its G-code cannot tell."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from stillpath.models.document import Document, NonNegative, Positive
from stillpath.models.firmware.common import FirmwareFacts, Hotend

__all__ = ["Extruder", "FirmwareShaper", "Klipper", "PlannerLimits", "shaper_type"]

_MOST_DAMPING = {"zv": 0.99, "mzv": 0.99, "zvd": 0.99, "ei": 0.4, "2hump_ei": 0.3, "3hump_ei": 0.2}
"""Klipper's shapers (klippy/extras/shaper_defs.py, 2026-08) and the damping that each takes."""
_TYPE = re.compile(r"(\w+)(\([\w=.,]*\))?", re.ASCII)


def shaper_type(text: str) -> str:
    """Return a shaper's type as it is written in a line: lower case, without white space.

    Since 2026 a type may have arguments: mzv(n=4,t=1.0).

    Raises
    ------
    ValueError
        If Klipper has no such shaper. The smoothers of Kalico (smooth_...) are taken as they are.
    """
    kind = "".join(text.split()).lower()
    found = _TYPE.fullmatch(kind)
    if found is None or not (found[1] in _MOST_DAMPING or found[1].startswith("smooth_")):
        raise ValueError(
            f"{text!r:.60} is no shaper of Klipper's; give {', '.join(_MOST_DAMPING)}, with its "
            "arguments if it has any, such as mzv(n=4,t=1.0)"
        )
    return kind


_Type = Annotated[str, AfterValidator(shaper_type)]


class PlannerLimits(Document):
    """The planner limits from printer.cfg ([printer]); the file may change them as it goes."""

    max_velocity_mm_s: Positive = 500.0
    max_accel_mm_s2: Positive = 5000.0
    square_corner_velocity_mm_s: NonNegative = 5.0
    minimum_cruise_ratio: Annotated[float, Field(ge=0, lt=1)] = 0.5
    max_accel_to_decel_mm_s2: Positive | None = None
    """Of a Klipper before 2024-03, as most vendors' are: it takes the place of the ratio, and an
    acceleration that a file sets leaves it as it is. None: a newer one."""
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
    pressure_advance_smooth_time_s: NonNegative = 0.04


class FirmwareShaper(Document):
    """The firmware's own input shaper as configured, to be restored after our moves."""

    type_x: _Type = "mzv"
    freq_x_hz: NonNegative = 0.0
    damping_x: NonNegative = 0.1
    type_y: _Type = "mzv"
    freq_y_hz: NonNegative = 0.0
    damping_y: NonNegative = 0.1

    @model_validator(mode="after")
    def _taken(self) -> FirmwareShaper:
        for axis, kind, damping in (
            ("x", self.type_x, self.damping_x),
            ("y", self.type_y, self.damping_y),
        ):
            most = _MOST_DAMPING.get(kind.partition("(")[0], 1.0)
            if damping > most:
                raise ValueError(
                    f"damping_{axis} is {damping:g}, and Klipper takes up to {most:g} for {kind}; "
                    "state what printer.cfg says"
                )
        return self


class Klipper(FirmwareFacts):
    """Facts of a Klipper machine that its G-code cannot tell."""

    kind: Literal["klipper"] = "klipper"
    planner: PlannerLimits = PlannerLimits()
    extruder: Extruder = Extruder()
    shaper: FirmwareShaper | None = None
    """None: unknown. It is switched off for our moves and stays off, and the report says so."""
    no_input_shaper: bool = False
    """printer.cfg was read whole and has no [input_shaper], so that the printer does not know
    SET_INPUT_SHAPER, and no shaper is advised. Our moves switch it off all the same: it may have
    been added since."""
    macros: tuple[str, ...] = ()
    """Configured macros with the name of another firmware's word, such as M205 or M900: they may do
    anything. M203 and M205 also set what `limit_macros` says; M204 is named where it sets
    ACCEL_TO_DECEL to half of its acceleration, too, as QIDI's does."""
    macros_known: bool = False
    """There are no other such macros: printer.cfg was read with all files that it includes."""
    limit_macros: tuple[Literal["M203", "M205"], ...] = ()
    """Such macros that do no more than set a limit, and are not among `macros`: M203 the speed (the
    smaller of X and Y), M205 the corner velocity (X, or else Y)."""
    limits_capped: bool = False
    """SET_VELOCITY_LIMIT and M204 set no speed and no acceleration above those of `planner`, as on
    Elegoo's Centauri Carbon."""

    @model_validator(mode="after")
    def _one_shaper(self) -> Klipper:
        if self.no_input_shaper and self.shaper is not None:
            raise ValueError(
                "shaper states a shaper, and no_input_shaper that printer.cfg has none: set "
                "no_input_shaper to false, or leave shaper out"
            )
        return self

    def driven_at(self, accel_mm_s2: float) -> Klipper:
        """Return the same firmware with this as its acceleration of X and Y."""
        planner = self.planner.model_copy(update={"max_accel_mm_s2": accel_mm_s2})
        return self.model_copy(update={"planner": planner})

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
