"""Marlin's interface to the pipeline."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.dialect import Dialect
from stillpath.gcode.firmware.base import scaled
from stillpath.gcode.firmware.marlin.advice import MarlinAdviser
from stillpath.gcode.firmware.marlin.encoder import MarlinEncoder
from stillpath.gcode.firmware.marlin.limits import MarlinLimits, initial_limits
from stillpath.gcode.firmware.marlin.planner import Planner
from stillpath.gcode.firmware.marlin.stream_commands import MarlinStreamCommands
from stillpath.gcode.firmware.marlin.stream_limits import DEVIATION_MM, STEEPEST, stream_limits
from stillpath.gcode.types import Limits
from stillpath.models.firmware import Marlin
from stillpath.models.machine import CommandLimits, Machine

__all__ = ["LONGEST_LEAST_MM", "STEEPEST_MESH", "MarlinAdapter"]

STEEPEST_MESH = 0.1
"""Z is driven with the stream's acceleration times the slope."""

LONGEST_LEAST_MM = 0.1
"""Longest of the shortest moves that a firmware may execute: a turn straight back is cut off by a
quarter of it, and a stand in the middle of a stretch is crossed by half of it (docs/marlin.md)."""

LEAST_BUFFER = 8
"""With 4 blocks one is known behind the one that starts, and every other move would stop."""

_ACCELERATIONS = ("accel_x_mm_s2", "accel_y_mm_s2", "print_accel_mm_s2", "travel_accel_mm_s2")

_ALTERNATIVE = (
    "use method advise, which sets accelerations, and the firmware's own input shaper where the "
    "machine states one"
)


class MarlinAdapter:
    """Adapter of a Marlin machine; see `gcode.firmware.base.FirmwareAdapter`."""

    extruder_alone_stops = False
    restart_s = 0.0

    def __init__(self, machine: Machine, firmware: Marlin) -> None:
        self._firmware = firmware
        self._corexy = machine.kinematics == "corexy"
        self._command = machine.command
        self._mesh_slope = machine.mesh_slope
        x, y = machine.travel["x"], machine.travel["y"]
        self._travel_mm = ((x.min_mm, x.max_mm), (y.min_mm, y.max_mm))
        scale = firmware.steps_per_mm
        self.step_mm = (1.0 / scale.x, 1.0 / scale.y, 1.0 / scale.z, 1.0 / scale.e)
        self.shortest_move_mm = firmware.shortest_move_mm

    @property
    def refusal(self) -> str | None:
        """Why no stream can be made for this machine, and what to do instead."""
        firmware = self._firmware
        if firmware.variant == "bambu":
            return (
                "Bambu's firmware is closed: how it plans a stream is not known; it compensates "
                "itself (M975 S1), and method advise sets accelerations beside that"
            )
        if firmware.variant == "prusa":
            return (
                "Prusa's firmware holds accelerations and jerk to fixed limits "
                "(HWLIMIT_NORMAL_MAX_ACCELERATION), too low for a stream; " + _ALTERNATIVE
            )
        if firmware.variant == "bugfix":
            return (
                "bugfix-2.1.x brakes within the last step of every block, and a dense stream runs "
                "too late by that; install release 2.1.2 and say so in `variant`, or "
                + _ALTERNATIVE
            )
        if firmware.ft_motion:
            return (
                "fixed-time motion (ft_motion, M493) has a planner of its own, which would smooth "
                "a stream; build without FT_MOTION, or switch it off (M493 S0) and say so in "
                "`ft_motion`, or use method advise, which sets its shaper (M493)"
            )
        if firmware.board == "avr":
            return (
                "an 8-bit board (`board` avr) computes step rates in 16 bits and takes some "
                "hundred segments a second at most; print from a 32-bit board, or " + _ALTERNATIVE
            )
        deviation_mm = firmware.planner.junction_deviation_mm
        low, high = DEVIATION_MM
        if firmware.junction == "deviation" and not low <= deviation_mm <= high:
            return (
                f"M205 J takes {low:g} to {high:g} mm, so the machine's junction deviation of "
                f"{deviation_mm:g} mm could not be put back behind a stream; build with a "
                "JUNCTION_DEVIATION_MM in that range and say so in planner.junction_deviation_mm, "
                "or " + _ALTERNATIVE
            )
        least_mm = firmware.shortest_move_mm
        if firmware.min_steps_per_segment > 1 and least_mm > LONGEST_LEAST_MM:
            return (
                f"it swallows moves below {firmware.min_steps_per_segment} steps "
                f"({1e3 * least_mm:.0f} um), and a stream can do without moves of up to "
                f"{1e3 * LONGEST_LEAST_MM:.0f} um: build it with MIN_STEPS_PER_SEGMENT 1 "
                "(Configuration_adv.h) and say so in min_steps_per_segment, set finer "
                "microsteps, or " + _ALTERNATIVE
            )
        return self._beyond_reach()

    def _beyond_reach(self) -> str | None:
        """Return why queue or bed leave a stream no room, or None."""
        blocks, slope = self._firmware.block_buffer_size, self._mesh_slope
        if blocks < LEAST_BUFFER:
            return (
                f"its queue of {blocks} blocks (block_buffer_size) is too short to look ahead, and "
                f"moves end at a stand: build it with BLOCK_BUFFER_SIZE {LEAST_BUFFER} or more, or "
                + _ALTERNATIVE
            )
        if slope > STEEPEST_MESH:
            return (
                f"the bed mesh rises by up to {slope:g} mm per mm (mesh_slope), and Z, which "
                "follows it, takes part in a stream up to "
                f"{STEEPEST_MESH:g}: tram the bed, or " + _ALTERNATIVE
            )
        return None

    def stands(self, places_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the places in whole steps of the axes, also on a CoreXY (Marlin's planner.cpp)."""
        step_mm = np.array(self.step_mm[:3])
        return np.asarray(np.rint(places_mm / step_mm) * step_mm)

    def initial_limits(self) -> MarlinLimits:
        """Limits at power-on."""
        return initial_limits(self._firmware)

    def stream_limits(self, own: Limits) -> MarlinLimits:
        """Return the limits of a stream where the file has set `own`."""
        return stream_limits(cast(MarlinLimits, own), self._command, self._mesh_slope)

    def paced(self, own: Limits, accel: float, speed: float, most: CommandLimits) -> MarlinLimits:
        """Return limits under which X and Y are quicker; junctions keep their deviation."""
        mine = cast(MarlinLimits, own)
        raised = {
            name: scaled(getattr(mine, name), accel, most.accel_mm_s2) for name in _ACCELERATIONS
        }
        jerk = math.sqrt(raised["print_accel_mm_s2"] / mine.print_accel_mm_s2)
        return replace(
            mine,
            **raised,
            feedrate_x_mm_s=scaled(mine.feedrate_x_mm_s, speed, most.velocity_mm_s),
            feedrate_y_mm_s=scaled(mine.feedrate_y_mm_s, speed, most.velocity_mm_s),
            jerk_x_mm_s=jerk * mine.jerk_x_mm_s,
            jerk_y_mm_s=jerk * mine.jerk_y_mm_s,
        )

    def planner(self, *, rests_apart: bool = False) -> Planner:
        """Return a planner at rest."""
        return Planner(self._firmware, corexy=self._corexy, rests_apart=rests_apart)

    def encoder(self) -> MarlinEncoder:
        """Return an encoder of the stream."""
        return MarlinEncoder(
            self._firmware,
            self._command,
            corexy=self._corexy,
            mesh_slope=self._mesh_slope,
            travel_mm=self._travel_mm,
        )

    def stream_commands(self) -> MarlinStreamCommands:
        """Return Marlin's words."""
        return MarlinStreamCommands(self._firmware)

    def adviser(self, dialect: Dialect) -> MarlinAdviser:
        """Return its words for shaper and acceleration."""
        return MarlinAdviser(self._firmware, dialect)

    def too_steep(self, travel_mm: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Mark travels (n, 4) that climb more, with the bed mesh, than Z can follow in a stream."""
        length = np.sqrt(np.sum(travel_mm[:, :3] ** 2, axis=1))
        climb = np.abs(travel_mm[:, 2])
        steep = climb > STEEPEST * length
        fast = self._firmware.planner.max_feedrate_mm_s.z * length
        velocity_mm_s = max(self._command.of(axis).velocity_mm_s for axis in ("x", "y"))
        return np.asarray(steep | (climb * velocity_mm_s > fast))
