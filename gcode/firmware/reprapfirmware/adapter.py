"""RepRapFirmware's interface to the pipeline."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.dialect import Dialect
from stillpath.gcode.firmware.base import scaled
from stillpath.gcode.firmware.reprapfirmware.advice import RepRapAdviser
from stillpath.gcode.firmware.reprapfirmware.encoder import (
    STEEPEST,
    RepRapEncoder,
    stream_limits,
    with_diagonals,
)
from stillpath.gcode.firmware.reprapfirmware.limits import RepRapLimits
from stillpath.gcode.firmware.reprapfirmware.planner import GRACE_S, RepRapPlanner, on_steps
from stillpath.gcode.firmware.reprapfirmware.stream_commands import RepRapStreamCommands
from stillpath.gcode.types import Limits
from stillpath.models.firmware import RepRapFirmware
from stillpath.models.machine import CommandLimits, Machine

__all__ = ["RepRapAdapter"]

STEEPEST_MESH = 0.1
"""Z is driven with the stream's acceleration times the slope."""


_ACCELERATIONS = ("accel_x_mm_s2", "accel_y_mm_s2", "print_accel_mm_s2", "travel_accel_mm_s2")
_SPEEDS = ("speed_x_mm_s", "speed_y_mm_s")
_JERKS = ("jerk_x_mm_s", "jerk_y_mm_s", "max_jerk_x_mm_s", "max_jerk_y_mm_s")


class RepRapAdapter:
    """Adapter of a RepRapFirmware machine; see `gcode.firmware.base.FirmwareAdapter`."""

    extruder_alone_stops = False
    shortest_move_mm = 0.0

    def __init__(self, machine: Machine, firmware: RepRapFirmware) -> None:
        self._machine = machine
        self._firmware = firmware
        self._stream = stream_limits(
            firmware, machine.command, machine.mesh_slope, corexy=machine.kinematics == "corexy"
        )
        x, y, z, _ = (1.0 / drive.steps_per_mm for drive in firmware.drives)
        if machine.kinematics == "corexy":
            x = y = 0.5 * (x + y)
        self.step_mm = (x, y, z, 0.0)
        self.restart_s = GRACE_S + firmware.prepare_ahead_s

    @property
    def refusal(self) -> str | None:
        """Why no stream can be made."""
        slope = self._machine.mesh_slope
        if slope <= STEEPEST_MESH:
            return None
        return (
            f"the bed mesh rises by up to {slope:g} mm per mm (mesh_slope), and Z can follow a "
            f"stream up to {STEEPEST_MESH:g}: tram the bed, or use method advise, which leaves "
            "all moves as they are and sets shaper and accelerations"
        )

    def stands(self, places_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the places in whole steps of the motors."""
        return on_steps(places_mm, self._firmware, self._machine.kinematics)

    def initial_limits(self) -> RepRapLimits:
        """Limits of config.g."""
        return RepRapLimits.of(self._firmware, self._machine.pressure_advance_s)

    def stream_limits(self, own: Limits) -> RepRapLimits:  # noqa: ARG002
        """Return the raised limits; nothing of the file's is kept."""
        return self._stream

    def paced(self, own: Limits, accel: float, speed: float, most: CommandLimits) -> RepRapLimits:
        """Return limits under which X and Y are quicker."""
        mine = cast(RepRapLimits, own)
        raised = {
            name: scaled(getattr(mine, name), accel, most.accel_mm_s2) for name in _ACCELERATIONS
        }
        raised |= {name: scaled(getattr(mine, name), speed, most.velocity_mm_s) for name in _SPEEDS}
        jerk = math.sqrt(raised["accel_x_mm_s2"] / mine.accel_x_mm_s2)
        raised |= {name: jerk * getattr(mine, name) for name in _JERKS}
        return replace(mine, **raised)

    def planner(self, *, rests_apart: bool = False) -> RepRapPlanner:  # noqa: ARG002
        """Return a planner at rest; this firmware joins no moves."""
        return RepRapPlanner(self._firmware, self._machine.kinematics)

    def encoder(self) -> RepRapEncoder:
        """Return an encoder of the stream."""
        machine = self._machine
        travel_mm = [(machine.travel[a].min_mm, machine.travel[a].max_mm) for a in ("x", "y")]
        corexy = machine.kinematics == "corexy"
        late = with_diagonals(self._stream, machine.command, corexy=corexy)
        return RepRapEncoder(self._firmware, machine.kinematics, self._stream, travel_mm, late)

    def stream_commands(self) -> RepRapStreamCommands:
        """Return RepRapFirmware's words."""
        return RepRapStreamCommands(self._firmware, self._machine.pressure_advance_s)

    def adviser(self, dialect: Dialect) -> RepRapAdviser:
        """Return its words for shaper and acceleration."""
        return RepRapAdviser(self._firmware, dialect)

    def too_steep(self, travel_mm: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Mark travels (n, 4) that climb more, with the bed mesh, than Z can follow in a stream."""
        way = np.sqrt(np.sum(travel_mm[:, :2] ** 2, axis=1))
        return np.asarray(np.abs(travel_mm[:, 2]) > STEEPEST * way)
