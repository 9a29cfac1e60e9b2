"""Marlin's planner: from moves to blocks of whole steps and their trapezoids.

The result of `Planner` does not depend on how the stream is divided. It assumes that the file is
read faster than executed, so the firmware's queue is full except right after a stop. The rules are
in `_block_kernels` (speeds, accelerations and junctions of a block) and `_planner_kernels`
(look-ahead, trapezoids, step timing); sources: docs/marlin.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.marlin import _block_kernels as blocks
from stillpath.gcode.firmware.marlin import _planner_kernels as kernels
from stillpath.gcode.firmware.planning import empty_phases
from stillpath.gcode.firmware.queueing import QueuePlanner, with_motion
from stillpath.gcode.types import Moves, Phases
from stillpath.models.firmware import Marlin

__all__ = ["Planner", "planner_facts"]

_FAMILY = {
    "2.0": blocks.RELEASE,
    "2.1": blocks.RELEASE,
    "bugfix": blocks.BUGFIX,
    "prusa": blocks.PRUSA,
    "bambu": blocks.PRUSA,
}
_PRUSA_PARTS = 4
"""PLANNER_STEPS_MULTIPLIER: positions are rounded to a quarter of a step."""
_PRUSA_AHEAD = 15
"""Half of BLOCK_BUFFER_SIZE, 32 of all printers since 5.0, whatever the document assumes: the other
half is steps already (PreciseStepping::is_waiting_before_delivering)."""
_RELEASE_MIN_RATE_HZ = 120.0
"""MINIMAL_STEP_RATE of 2.0 and 2.1; bugfix has what the timer can hold."""


class Planner(QueuePlanner):
    """Plan a stream of moves.

    Parameters
    ----------
    firmware : Marlin
        Limits that G-code can change come with the moves.
    corexy : bool
        Steps and caps are those of the motors A = X + Y and B = X - Y.
    rests_apart : bool
        A move before one of Z or the extruder alone, and the last one, are executed however short.

    Notes
    -----
    There is one row for every move. A move of fewer steps than `min_steps_per_segment` has no
    duration, and the next row starts where the machine stands.
    """

    def __init__(
        self, firmware: Marlin, *, corexy: bool = False, rests_apart: bool = False
    ) -> None:
        super().__init__(blocks.Q_SIZE)
        self._facts = planner_facts(firmware, corexy=corexy)
        self._facts[blocks.C_RESTS_APART] = rests_apart
        self._s_curve = firmware.s_curve
        self._state = np.zeros(blocks.S_SIZE)
        self._state[blocks.S_ENTRY2] = -1.0

    def stop(self, dwell_s: float = 0.0) -> Phases:
        """Come to rest after the last move and stand for `dwell_s`."""
        phases = super().stop(dwell_s)
        self._state[blocks.S_BLOCKS] = 0.0
        self._state[blocks.S_ENTRY2] = -1.0
        return phases

    def _append(self, moves: Moves, rows: slice) -> tuple[int, int]:
        self._count, problem, bad = blocks.append(
            moves.start_mm[rows],
            moves.end_mm[rows],
            moves.speed_mm_s[rows],
            moves.limits_id[rows],
            self._limits,
            self._facts,
            self._next_move,
            self._state,
            self._queue,
            self._count,
        )
        return problem, bad

    def _error(self, problem: int, moves: Moves, row: int) -> GcodeError:  # noqa: ARG002
        return GcodeError(
            f"the move's speed is {moves.speed_mm_s[row]:g} mm/s; it must be above 0: give it an "
            "F, or correct M220",
            line=int(moves.line[row]),
        )

    def _take(self, *, final: bool) -> Phases:
        settled = kernels.settle(self._queue, self._count, self._facts, final)
        phases = empty_phases(settled)
        times, speeds = np.empty((4, settled)), np.empty((4, settled))
        self._time_s = kernels.emit(
            self._queue,
            settled,
            self._count,
            self._facts,
            self._state,
            self._time_s,
            times,
            phases.start_mm,
            phases.direction,
            speeds,
            phases.move_index,
        )
        self._drop(settled)
        phases.s_curve[:] = self._s_curve
        return with_motion(phases, times, speeds)


def planner_facts(firmware: Marlin, *, corexy: bool) -> NDArray[np.float64]:
    """Return the machine's facts in the kernels' order (``C_`` entries)."""
    facts = np.zeros(blocks.C_SIZE)
    scale = firmware.steps_per_mm
    family = _FAMILY[firmware.variant]
    parts = _PRUSA_PARTS if family == blocks.PRUSA else 1
    facts[blocks.C_STEPS_PER_MM : blocks.C_STEPS_PER_MM + 4] = (
        parts * scale.x,
        parts * scale.y,
        parts * scale.z,
        parts * scale.e,
    )
    facts[blocks.C_FAMILY] = family
    facts[blocks.C_CORE] = corexy
    facts[blocks.C_CLASSIC_JERK] = firmware.junction == "classic_jerk"
    facts[blocks.C_SMALL_SEGMENTS] = firmware.small_segment_junctions
    facts[blocks.C_MIN_STEPS] = parts * firmware.min_steps_per_segment
    facts[blocks.C_AHEAD] = firmware.block_buffer_size - 3
    facts[blocks.C_SLOWDOWN] = 0.5 * firmware.block_buffer_size - 1.0 if firmware.slowdown else 0.0
    if firmware.variant == "prusa":
        # It slows down only where the file comes too slowly, and M203 X holds for the motors A and
        # B (COREXY_CONVERT_LIMITS; both Planner::_populate_block). Of Bambu's that is not known.
        facts[blocks.C_AHEAD] = _PRUSA_AHEAD
        facts[blocks.C_SLOWDOWN] = 0.0
        facts[blocks.C_MOTOR_SPEED] = corexy
    facts[blocks.C_MIN_SPEED] = firmware.minimum_planner_speed_mm_s
    facts[blocks.C_ADVANCE] = bool(firmware.linear_advance)
    facts[blocks.C_TIMER_HZ] = firmware.step_timer_hz
    facts[blocks.C_SMOOTHING_HZ] = firmware.step_smoothing_hz
    facts[blocks.C_MIN_RATE] = _RELEASE_MIN_RATE_HZ
    if family == blocks.BUGFIX:
        facts[blocks.C_MIN_RATE] = 31.0 if firmware.board == "avr" else 1.0
    facts[blocks.C_S_CURVE] = firmware.s_curve
    facts[blocks.C_FIRST_STEPS] = 2.0 if firmware.variant == "2.0" else 1.0
    return facts
