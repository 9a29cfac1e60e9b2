"""Klipper's planner: from moves to phases of constant acceleration.

`Planner` gives for any cutting of the stream what a look-ahead over the whole stretch between
two stops gives; Klipper's own queue of a quarter second agrees with it on the golden files.
Rules: klippy/toolhead.py, klippy/kinematics/extruder.py, 2026-08.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gcode.errors import GcodeError
from gcode.firmware.klipper import _planner_kernels as kernels
from gcode.types import EventKind, Limits, Moves, Phases, ProgramBlock
from models.machine import Klipper

__all__ = ["STOPPING", "Planner", "join_phases", "plan_moves"]

STOPPING = frozenset({EventKind.STOP, EventKind.UNKNOWN, EventKind.SHAPER})
"""Events at which the motion comes to rest."""

_STOPPING = np.array([int(kind) for kind in sorted(STOPPING)])


class Planner:
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
        self._queue = np.empty((1024, kernels.Q_SIZE))
        self._count = 0
        self._retry = 0
        self._moves = 0
        self._begun = False
        self._time_s = 0.0
        self._limits = np.empty((0, 4))

    @property
    def time_s(self) -> float:
        """When the last planned move or dwell ends."""
        return self._time_s

    def push(self, block: ProgramBlock) -> Phases:
        """Plan the moves of a block, with the stops that its events bring.

        Raises
        ------
        GcodeError
            For a move that Klipper's extruder refuses.
        """
        self._moves = block.first_move
        events = block.events
        parts = []
        begun = 0
        for row in np.flatnonzero(np.isin(events.kind, _STOPPING)).tolist():
            end = int(events.move_index[row]) - block.first_move
            parts.append(self._plan(block.moves, begun, end, block.limits))
            parts.append(self.stop(float(events.dwell_s[row])))
            begun = end
        parts.append(self._plan(block.moves, begun, len(block.moves), block.limits))
        return join_phases(parts)

    def push_moves(self, moves: Moves, limits: Sequence[Limits]) -> Phases:
        """Plan moves that follow the last ones without a stop; return what is settled by now.

        Parameters
        ----------
        limits : sequence of Limits
            The table of `Moves.limits_id`; it may only grow.
        """
        return self._plan(moves, 0, len(moves), limits)

    def stop(self, dwell_s: float = 0.0) -> Phases:
        """Come to rest after the last move and stand for `dwell_s`."""
        phases = self._take(final=True)
        if self._begun:
            self._time_s += dwell_s
        return phases

    def flush(self) -> Phases:
        """Come to rest; return all that is left."""
        return self.stop()

    def _plan(self, moves: Moves, begun: int, end: int, limits: Sequence[Limits]) -> Phases:
        n = end - begun
        if n == 0:
            return _empty()
        self._note_limits(limits)
        if self._count + n > len(self._queue):
            larger = np.empty((2 * (self._count + n), kernels.Q_SIZE))
            larger[: self._count] = self._queue[: self._count]
            self._queue = larger
        self._count, problem, bad = kernels.append(
            moves.start_mm[begun:end],
            moves.end_mm[begun:end],
            moves.speed_mm_s[begun:end],
            moves.limits_id[begun:end],
            self._limits,
            self._facts,
            self._moves,
            self._queue,
            self._count,
        )
        if problem != kernels.OK:
            raise self._error(problem, moves, begun + bad)
        self._moves += n
        self._begun = self._begun or self._count > 0
        # A queue that settles nothing is not searched again before it has doubled.
        return self._take(final=False) if self._count >= self._retry else _empty()

    def _take(self, *, final: bool) -> Phases:
        settled = kernels.look_ahead(self._queue, self._count, final)
        phases = _empty(settled)
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
        kernels.drop(self._queue, settled, self._count)
        self._count -= settled
        self._retry = 2 * self._count
        return Phases(
            times[0],
            times[1],
            times[2],
            times[3],
            phases.start_mm,
            phases.direction,
            speeds[0],
            speeds[1],
            speeds[2],
            speeds[3],
            phases.move_index,
        )

    def _note_limits(self, limits: Sequence[Limits]) -> None:
        if len(limits) != len(self._limits):
            self._limits = np.array(
                [
                    (
                        limit.velocity_mm_s,
                        limit.accel_mm_s2,
                        limit.square_corner_velocity_mm_s,
                        limit.minimum_cruise_ratio,
                    )
                    for limit in limits
                ]
            )

    def _error(self, problem: int, moves: Moves, row: int) -> GcodeError:
        line = int(moves.line[row])
        step = moves.end_mm[row] - moves.start_mm[row]
        path = float(np.sqrt(np.sum(step[:3] ** 2)))
        if problem == kernels.E_TOO_LONG:
            return GcodeError(
                f"the extruder-only move of {step[3]:.3f} mm is longer than the machine's limit "
                f"of {self._facts[kernels.C_E_LENGTH]:.3f} mm (max_extrude_only_distance)",
                line=line,
            )
        if problem == kernels.E_TOO_THICK:
            return GcodeError(
                f"the move extrudes {step[3] / path * self._area_mm2:.3f} mm2, more than the "
                f"machine's limit of {self._facts[kernels.C_E_RATIO] * self._area_mm2:.3f} mm2 "
                "(max_extrude_cross_section); check relative and absolute E",
                line=line,
            )
        return GcodeError("speed and acceleration of a move must be above 0", line=line)


def plan_moves(moves: Moves, limits: Sequence[Limits], firmware: Klipper) -> Phases:
    """Plan moves from rest to rest."""
    planner = Planner(firmware)
    return join_phases([planner.push_moves(moves, limits), planner.flush()])


def join_phases(parts: Sequence[Phases]) -> Phases:
    """Put phases one behind the other."""
    parts = [part for part in parts if len(part)]
    if len(parts) == 1:
        return parts[0]
    if not parts:
        return _empty()
    return Phases(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in Phases.__dataclass_fields__
        )
    )


def _empty(n: int = 0) -> Phases:
    return Phases(
        t_s=np.empty(n),
        accel_s=np.empty(n),
        cruise_s=np.empty(n),
        decel_s=np.empty(n),
        start_mm=np.empty((n, 4)),
        direction=np.empty((n, 4)),
        start_mm_s=np.empty(n),
        cruise_mm_s=np.empty(n),
        end_mm_s=np.empty(n),
        accel_mm_s2=np.empty(n),
        move_index=np.empty(n, np.int64),
    )
