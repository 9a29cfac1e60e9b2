"""Klipper's planner: from moves to phases of constant acceleration.

However the stream is divided, `Planner` gives the result of a look-ahead over the whole stretch
between two stops; Klipper's own queue of a quarter second agrees with it on the golden files.
The rules are in `_planner_kernels`; sources: klippy/toolhead.py, klippy/kinematics/extruder.py,
2026-08.
"""

from __future__ import annotations

import math

import numpy as np

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.klipper import _planner_kernels as kernels
from stillpath.gcode.firmware.planning import empty_phases
from stillpath.gcode.firmware.queueing import QueuePlanner, with_motion
from stillpath.gcode.types import Moves, Phases
from stillpath.models.firmware import Klipper

__all__ = ["Planner"]


class Planner(QueuePlanner):
    """Plan a stream of moves.

    Parameters
    ----------
    firmware : Klipper
        Limits of Z and of the extruder. Limits that G-code can change come with the moves.

    Notes
    -----
    A move without any displacement gives no phase; `Phases.move_index` names the move of each.
    """

    def __init__(self, firmware: Klipper) -> None:
        super().__init__(kernels.Q_SIZE)
        extruder, planner = firmware.extruder, firmware.planner
        area = math.pi * (0.5 * extruder.filament_diameter_mm) ** 2
        section = extruder.max_extrude_cross_section_mm2
        if section is None:
            section = 4.0 * extruder.nozzle_diameter_mm**2
        self._area_mm2 = area
        facts = np.zeros(kernels.C_SIZE)
        facts[kernels.C_Z_SPEED] = planner.max_z_velocity_mm_s
        facts[kernels.C_Z_ACCEL] = planner.max_z_accel_mm_s2
        facts[kernels.C_E_CORNER] = extruder.instantaneous_corner_velocity_mm_s
        facts[kernels.C_E_SPEED] = extruder.max_extrude_only_velocity_mm_s
        facts[kernels.C_E_ACCEL] = extruder.max_extrude_only_accel_mm_s2
        facts[kernels.C_E_LENGTH] = extruder.max_extrude_only_distance_mm
        facts[kernels.C_E_RATIO] = section / area
        facts[kernels.C_NOZZLE] = extruder.nozzle_diameter_mm
        self._facts = facts
        self._retry = 0

    def _due(self) -> bool:
        # After a search that settled nothing, wait until the queue has doubled.
        return self._count >= self._retry

    def _append(self, moves: Moves, rows: slice) -> tuple[int, int]:
        self._count, problem, bad = kernels.append(
            moves.start_mm[rows],
            moves.end_mm[rows],
            moves.speed_mm_s[rows],
            moves.limits_id[rows],
            self._limits,
            self._facts,
            self._next_move,
            self._queue,
            self._count,
        )
        return problem, bad

    def _take(self, *, final: bool) -> Phases:
        settled = kernels.look_ahead(self._queue, self._count, final)
        phases = empty_phases(settled)
        times, speeds = np.empty((4, settled)), np.empty((4, settled))
        self._time_s = kernels.emit(
            self._queue,
            settled,
            self._time_s,
            times,
            phases.start_mm,
            phases.direction,
            speeds,
            phases.move_index,
        )
        self._drop(settled)
        self._retry = 2 * self._count
        return with_motion(phases, times, speeds)

    def _error(self, problem: int, moves: Moves, row: int) -> GcodeError:
        line = int(moves.line[row])
        step = moves.end_mm[row] - moves.start_mm[row]
        path = float(np.sqrt(np.sum(step[:3] ** 2)))
        if problem == kernels.E_TOO_LONG:
            return GcodeError(
                f"the extruder-only move of {abs(step[3]):.3f} mm is longer than the machine's "
                f"limit of {self._facts[kernels.C_E_LENGTH]:.3f} mm; split it, or raise "
                "max_extrude_only_distance in printer.cfg and here",
                line=line,
            )
        if problem == kernels.E_TOO_THICK:
            return GcodeError(
                f"the move has an extrusion cross section of {step[3] / path * self._area_mm2:.3f} "
                "mm2, more than the machine's limit of "
                f"{self._facts[kernels.C_E_RATIO] * self._area_mm2:.3f} mm2 "
                "(max_extrude_cross_section); check relative and absolute E",
                line=line,
            )
        accel_mm_s2 = float(self._limits[int(moves.limits_id[row]), 1])
        return GcodeError(
            f"the move's speed is {moves.speed_mm_s[row]:g} mm/s, its acceleration "
            f"{accel_mm_s2:g} mm/s2; both must be above 0: correct its F, M220 or "
            "SET_VELOCITY_LIMIT",
            line=line,
        )
