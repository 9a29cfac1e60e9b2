"""Klipper's interface to the pipeline."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.dialect import Dialect
from stillpath.gcode.firmware.base import scaled
from stillpath.gcode.firmware.klipper.advice import KlipperAdviser
from stillpath.gcode.firmware.klipper.encoder import KlipperEncoder, stream_limits
from stillpath.gcode.firmware.klipper.limits import KlipperLimits
from stillpath.gcode.firmware.klipper.planner import Planner
from stillpath.gcode.firmware.klipper.stream_commands import KlipperStreamCommands
from stillpath.gcode.types import Limits
from stillpath.models.firmware import Klipper
from stillpath.models.machine import CommandLimits, Machine

__all__ = ["KlipperAdapter"]


class KlipperAdapter:
    """Adapter of a Klipper machine; see `gcode.firmware.base.FirmwareAdapter`."""

    step_mm = (0.0, 0.0, 0.0, 0.0)
    shortest_move_mm = 0.0
    extruder_alone_stops = True
    restart_s = 0.0

    def __init__(self, machine: Machine, firmware: Klipper) -> None:
        self._machine = machine
        self._firmware = firmware
        self._stream = stream_limits(firmware, machine.command, machine.mesh_slope)

    @property
    def refusal(self) -> str | None:
        """The bed is too crooked for the machine's Z, or None."""
        left, needed = self._stream.accel_mm_s2, self._machine.command.every_way.accel_mm_s2
        if left >= needed:
            return None
        least = needed * self._machine.mesh_slope
        stated = (
            "motors.accel_mm_s2" if needed < self._machine.command.accel_mm_s2 else "accel_mm_s2"
        )
        return (
            f"the bed mesh rises by up to {self._machine.mesh_slope:g} mm per mm (mesh_slope), and "
            f"Z, which follows it, leaves X and Y an acceleration of {left:.0f} mm/s2 "
            f"(firmware.planner.max_z_accel_mm_s2 = "
            f"{self._firmware.planner.max_z_accel_mm_s2:g}); a command may ask for "
            f"{needed:.0f} (command.{stated}): level the bed, raise max_z_accel in printer.cfg "
            f"and here to {least:.0f}, or lower command.{stated}. Or use method advise, which "
            "leaves all moves as they are and sets the firmware's own shaper."
        )

    def stands(self, places_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the places: moves between them are exact, whatever the motors round."""
        return places_mm

    def initial_limits(self) -> KlipperLimits:
        """Limits of printer.cfg."""
        planner = self._firmware.planner
        return KlipperLimits(
            velocity_mm_s=planner.max_velocity_mm_s,
            accel_mm_s2=planner.max_accel_mm_s2,
            square_corner_velocity_mm_s=planner.square_corner_velocity_mm_s,
            minimum_cruise_ratio=planner.minimum_cruise_ratio,
            accel_to_decel_mm_s2=planner.max_accel_to_decel_mm_s2 or 0.0,
        )

    def stream_limits(self, own: Limits) -> KlipperLimits:  # noqa: ARG002
        """Return the raised limits; nothing of the file's is kept."""
        return self._stream

    def paced(self, own: Limits, accel: float, speed: float, most: CommandLimits) -> KlipperLimits:
        """Return limits under which X and Y are quicker."""
        mine = cast(KlipperLimits, own)
        fastest, hardest = most.velocity_mm_s, most.accel_mm_s2
        if self._firmware.limits_capped:
            fastest = min(fastest, self._firmware.fastest_mm_s)
            hardest = min(hardest, self._firmware.largest_accel_mm_s2)
        raised = scaled(mine.accel_mm_s2, accel, hardest)
        corner = math.sqrt(raised / mine.accel_mm_s2) * mine.square_corner_velocity_mm_s
        return replace(
            mine,
            velocity_mm_s=scaled(mine.velocity_mm_s, speed, fastest),
            accel_mm_s2=raised,
            square_corner_velocity_mm_s=corner,
            accel_to_decel_mm_s2=raised / mine.accel_mm_s2 * mine.accel_to_decel_mm_s2,
        )

    def planner(self, *, rests_apart: bool = False) -> Planner:  # noqa: ARG002
        """Return a planner at rest; this firmware joins no moves."""
        return Planner(self._firmware)

    def encoder(self) -> KlipperEncoder:
        """Return an encoder of the stream."""
        return KlipperEncoder(self._firmware, self._stream)

    def stream_commands(self) -> KlipperStreamCommands:
        """Return Klipper's words."""
        return KlipperStreamCommands(self._firmware)

    def adviser(self, dialect: Dialect) -> KlipperAdviser:
        """Return its words for shaper and acceleration."""
        return KlipperAdviser(self._firmware, dialect)

    def too_steep(self, travel_mm: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Mark travels (n, 4) that climb so much that Z's limit leaves a stream too little."""
        length = np.sqrt(np.sum(travel_mm[:, :3] ** 2, axis=1))
        flat = np.hypot(travel_mm[:, 0], travel_mm[:, 1])
        climb = np.abs(travel_mm[:, 2]) + self._machine.mesh_slope * flat
        most_z_accel = self._firmware.planner.max_z_accel_mm_s2 * (1.0 + 1e-9)
        return np.asarray(climb * self._stream.accel_mm_s2 > length * most_z_accel)
