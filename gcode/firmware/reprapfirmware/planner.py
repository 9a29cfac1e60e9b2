"""RepRapFirmware's planner: from moves to phases of constant acceleration.

The plan is the firmware's own incremental one, ring included: what a move may do depends on which
moves are in the ring when it is frozen. The ring is taken to be filled as fast as it takes moves,
which is what a file on the SD card does; the cutting of the stream changes nothing.

Rules: src/Movement/DDA.cpp, DDARing.cpp and MoveTiming.h, 3.6.0-beta.2, 2024-11
(docs/reprapfirmware.md).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.planning import empty_phases, join_phases
from stillpath.gcode.firmware.queueing import QueuePlanner, with_motion
from stillpath.gcode.firmware.reprapfirmware import _planner_kernels as kernels
from stillpath.gcode.types import Moves, Phases, rows_of
from stillpath.models.firmware import RepRapFirmware

__all__ = ["GRACE_S", "RepRapPlanner", "on_steps"]

GRACE_S = 0.01
"""How long the firmware waits for more moves before it starts from a standstill (M595 R)."""


class RepRapPlanner(QueuePlanner):
    """Plan a stream of moves.

    Parameters
    ----------
    firmware : RepRapFirmware
        Steps and ring. Limits that G-code can change come with the moves.
    kinematics : {"cartesian", "corexy"}

    Notes
    -----
    Every move has one row, in order. `Phases.start_mm` and `direction` are those of whole motor
    steps, so the length of `direction` is not exactly 1; times are those of the commanded way, in
    whole clocks. After a stop the next move begins `GRACE_S` and `prepare_ahead_s` later.
    """

    def __init__(self, firmware: RepRapFirmware, kinematics: str) -> None:
        super().__init__(kernels.Q_SIZE)
        facts = _motors(firmware, kinematics)
        facts[kernels.C_RING] = firmware.ring_length
        facts[kernels.C_CLOCK] = firmware.step_clock_hz
        facts[kernels.C_AHEAD] = firmware.prepare_ahead_s
        facts[kernels.C_LEAST] = min(firmware.prepare_least_s, firmware.prepare_ahead_s)
        self._facts = facts
        self._restart_s = GRACE_S + firmware.prepare_ahead_s
        self._still: list[tuple[int, NDArray[np.float64]]] = []
        self._rest_s = 0.0
        self._reset()

    @property
    def time_s(self) -> float:
        """When the last planned move or dwell ends."""
        return self._time_s + self._rest_s

    def stop(self, dwell_s: float = 0.0) -> Phases:
        """Come to rest after the last move and stand for `dwell_s`."""
        phases = self._take(final=True)
        self._reset()
        if self._next_move:
            self._rest_s += dwell_s
        return phases

    def _reset(self) -> None:
        self._state = np.zeros(kernels.S_SIZE)
        self._state[kernels.S_SHORT_S] = kernels.SHORT_CLOCKS / self._facts[kernels.C_CLOCK]
        self._count = 0
        self._emitted = 0
        self._standing = True

    def _append(self, moves: Moves, rows: slice) -> tuple[int, int]:
        before = self._count
        self._count, problem, bad = kernels.append(
            moves.start_mm[rows],
            moves.end_mm[rows],
            moves.speed_mm_s[rows],
            moves.limits_id[rows],
            self._limits,
            self._facts,
            self._next_move,
            self._queue,
            before,
        )
        start_mm, end_mm = moves.start_mm[rows], moves.end_mm[rows]
        if self._count - before < len(start_mm):
            for row in np.flatnonzero(np.all(start_mm == end_mm, axis=1)).tolist():
                self._still.append((self._next_move + row, start_mm[row].copy()))
        if self._standing and self._count:
            self._begin()
        return problem, bad

    def _error(self, problem: int, moves: Moves, row: int) -> GcodeError:  # noqa: ARG002
        return GcodeError(
            "speed and acceleration of a move must be above 0", line=int(moves.line[row])
        )

    def _begin(self) -> None:
        """Start from a standstill; the first motion of all starts at once."""
        if self._time_s > 0.0:
            self._time_s += max(self._rest_s, 0.0) + self._restart_s
        else:
            self._time_s += self._rest_s
        self._rest_s = 0.0
        self._state[kernels.S_NOW] = self._time_s - self._facts[kernels.C_AHEAD]
        self._standing = False

    def _take(self, *, final: bool) -> Phases:
        if self._count:
            kernels.run(self._queue, self._count, self._state, self._facts, final)
        frozen = int(self._state[kernels.S_FROZEN])
        settled = frozen - self._emitted
        phases = empty_phases(settled)
        times, speeds = np.empty((4, settled)), np.empty((4, settled))
        kernels.emit(
            self._queue,
            self._emitted,
            frozen,
            self._facts[kernels.C_CLOCK],
            times,
            phases.start_mm,
            phases.direction,
            speeds,
            phases.move_index,
        )
        if settled:
            self._time_s = float(times[:, -1].sum())
        self._count = kernels.drop(self._queue, self._count, self._state)
        self._emitted = int(self._state[kernels.S_FROZEN])
        planned = with_motion(phases, times, speeds)
        return self._with_still(planned, final=final) if self._still else planned

    def _with_still(self, planned: Phases, *, final: bool) -> Phases:
        """Put the moves of no length between the others."""
        upto = int(planned.move_index[-1]) if len(planned) else -1
        ready = [still for still in self._still if final or still[0] < upto]
        self._still = self._still[len(ready) :]
        if not ready:
            return planned
        rows = empty_phases(len(ready))
        for column in (rows.accel_s, rows.cruise_s, rows.decel_s, rows.direction):
            column[:] = 0.0
        for column in (rows.start_mm_s, rows.cruise_mm_s, rows.end_mm_s, rows.accel_mm_s2):
            column[:] = 0.0
        rows.move_index[:] = [index for index, _ in ready]
        rows.start_mm[:] = [place for _, place in ready]
        rows.start_mm[:, :3] = kernels.on_steps(rows.start_mm[:, :3], self._facts)
        following = np.searchsorted(planned.move_index, rows.move_index)
        rows.t_s[:] = np.append(planned.t_s, self._time_s)[following]
        both = join_phases([planned, rows])
        return rows_of(both, np.argsort(both.move_index, kind="stable"))


def on_steps(
    places_mm: NDArray[np.float64], firmware: RepRapFirmware, kinematics: str
) -> NDArray[np.float64]:
    """Return where the motors stand when they are sent to places, shape (n, 3)."""
    return np.asarray(kernels.on_steps(places_mm, _motors(firmware, kinematics)))


def _motors(firmware: RepRapFirmware, kinematics: str) -> NDArray[np.float64]:
    """Facts for the kernels, with the motors' ones filled in."""
    facts = np.zeros(kernels.C_SIZE)
    facts[kernels.C_COREXY] = float(kinematics == "corexy")
    steps = [drive.steps_per_mm for drive in firmware.drives[:3]]
    facts[kernels.C_STEPS : kernels.C_STEPS + 3] = steps
    return facts
