"""Check that a compensated piece is executed as commanded.

Where the firmware rounds to motor steps, also that it is not clearly worse than as sliced.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.defaults import DT_S
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.pieces import Piece
from stillpath.gcode.types import Phases
from stillpath.models.machine import Machine
from stillpath.models.schedule import OperatingPoint
from stillpath.pipeline.compensated_piece import CompensatedPiece, Unfit
from stillpath.pipeline.following import follow_tolerance_mm, strayed
from stillpath.pipeline.measuring.points import MotionSamples
from stillpath.simulation.machine_response import MachineStream
from stillpath.simulation.measures import MotionMeter

__all__ = ["NEGLIGIBLE_UM", "Verifier"]

NEGLIGIBLE_UM = 1.0
"""Invisible contour error: below it, which of two is smaller does not matter."""

_TIME_EXCESS_S = 20e-3
_DRIFT_S = 0.25e-3
"""A minute without a rest ends as much early or late: encoders expect where the firmware brakes."""
_END_MM = np.array([1e-6, 1e-6, 1e-6, 1e-4])
"""Largest distance between the ends of a piece and its original, x y z e, beyond a motor step."""
_STRIDE = 6
_PAST = 2000
"""Samples of motion kept from before a piece, as vibration may last into it."""
_CLEARLY_WORSE = 1.1


class Verifier:
    """Checks compensated pieces by their read-back motion."""

    def __init__(self, machine: Machine, tolerance_um: float) -> None:
        firmware = adapter(machine)
        self._machine = machine
        self._step_mm = np.array(firmware.step_mm)
        self._tolerance_mm = follow_tolerance_mm(firmware, tolerance_um)
        # Motion too short for a move of its own is executed with the next one.
        self._waits_mm = firmware.shortest_move_mm
        self._end_mm = self._step_mm + _END_MM
        if self._waits_mm > 0.0:
            self._end_mm[3] *= self._waits_mm / np.max(self._step_mm[:2])
        self._past_mm = np.zeros((2, 0))

    def check_motion(
        self, piece: Piece, made: CompensatedPiece, gap_mm: NDArray[np.float64], executed: Phases
    ) -> None:
        """Compare executed with intended motion.

        Parameters
        ----------
        gap_mm : ndarray, shape (n,)
            Distance from the command (`pipeline.compensated_piece.deviation`).

        Raises
        ------
        Unfit
            With the reason.
        """
        step_mm = np.diff(made.command_mm[:2], axis=1, append=made.command_mm[:2, -1:])
        drift_mm = _DRIFT_S / DT_S * np.hypot(*step_mm)
        reason = strayed(
            gap_mm, made.extruding, self._tolerance_mm, briefly=True, drift_mm=drift_mm
        )
        if reason is not None:
            raise Unfit(f"read back, {reason}")
        timeline, begins_s = made.timeline, float(made.timeline.start_s[0])
        lasts_s = float(timeline.end_s[-1] - timeline.start_s[-1])
        begun_s = float(made.encoded.group_start_s[-1]) - begins_s
        late_s = executed.duration_s - begun_s - lasts_s
        tolerance_mm = self._end_mm
        last_mm = made.command_mm[:2, round(timeline.start_s[-1] / timeline.dt_s) :]
        if np.max(np.ptp(last_mm, axis=1)) < self._waits_mm:
            # The whole last stretch may still be pending.
            late_s = max(late_s, min(late_s + lasts_s, 0.0))
            tolerance_mm = np.maximum(tolerance_mm, [self._waits_mm, self._waits_mm, 0.0, 0.0])
        if abs(late_s) > _TIME_EXCESS_S:
            raise Unfit(f"read back, the piece takes {1e3 * late_s:+.2f} ms longer than planned")
        end, wanted = executed.end_mm[-1], piece.moves.end_mm[-1]
        if np.any(np.abs(end - wanted) > tolerance_mm):
            raise Unfit(f"read back, the piece ends at {end.round(6)}, not at {wanted.round(6)}")

    def observe(self, command_mm: NDArray[np.float64]) -> None:
        """Record motion, shape (2, n), whose vibration may last into the next piece."""
        if command_mm.shape[1] >= _PAST:
            self._past_mm = command_mm[:2, -_PAST:].copy()
        else:
            self._past_mm = np.hstack([self._past_mm, command_mm[:2]])[:, -_PAST:]

    def lose_position(self) -> None:
        """Forget the motion so far: the machine stands still when motion resumes."""
        self._past_mm = self._past_mm[:, :0]

    def check_gain(self, motion: MotionSamples, point: OperatingPoint) -> None:
        """Compare the contour error of a piece with that of the sliced file, on coarse motor steps.

        Parameters
        ----------
        motion : MotionSamples
            Without `sliced_mm` (the firmware does not round to steps) nothing is done.

        Raises
        ------
        Unfit
            If the sliced lines would print better.
        """
        if motion.sliced_mm is None:
            return
        commands = (motion.sliced_mm, motion.executed_mm)
        meter = MotionMeter(DT_S, stride=_STRIDE, channels=len(commands))
        past = self._past_mm
        path_mm = np.hstack([past, motion.path_mm])
        responses = [
            MachineStream(self._machine, DT_S, point).push(np.hstack([past, command]), path_mm)
            for command in commands
        ]
        extruding = np.append(np.zeros(past.shape[1], np.bool_), motion.extruding)
        meter.push(path_mm, np.stack(responses), extruding)
        meter.flush()
        sliced_um, ours_um = (1e3 * tally.rms for tally in meter.contour_extruding)
        if ours_um > max(_CLEARLY_WORSE * sliced_um, NEGLIGIBLE_UM):
            raise Unfit(
                f"rounded to motor steps, its contour error would be {ours_um:.1f} µm rms, against "
                f"{sliced_um:.1f} µm as sliced"
            )
