"""Klipper's planner limits that G-code can change."""

from __future__ import annotations

from dataclasses import dataclass

from stillpath.gcode.types import Limits

__all__ = ["KlipperLimits"]


@dataclass(frozen=True, slots=True)
class KlipperLimits(Limits):
    """What SET_VELOCITY_LIMIT and M204 set."""

    velocity_mm_s: float
    accel_mm_s2: float
    square_corner_velocity_mm_s: float
    minimum_cruise_ratio: float
    accel_to_decel_mm_s2: float = 0.0
    """Above 0: the limit of a Klipper before 2024-03, in place of the ratio."""
