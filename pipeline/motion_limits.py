"""The limits of a machine that the command of a piece, and the moves made of it, must keep."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.defaults import DT_S
from stillpath.compensation.window_problem import TRAVEL_SLACK_MM
from stillpath.gcode.pieces import Piece
from stillpath.gcode.segments import Segments
from stillpath.gcode.types import Phases
from stillpath.models.machine import Machine
from stillpath.pipeline.compensated_piece import Unfit
from stillpath.pipeline.measuring._peak_kernels import speed_steps

__all__ = ["MotionLimits", "TooAbrupt"]

_LOWER = "slice with less of it, or raise that to what the motors bear (docs/safety.md)"
_SHORT_QUEUES = {"marlin": "Marlin", "reprapfirmware": "RepRapFirmware"}
_SLACK = 1.0 + 1e-9
"""Factor of limits that allows for rounding."""


class TooAbrupt(Unfit):
    """A motor's speed step is too large, or the firmware cannot follow within its limits."""


class MotionLimits:
    """The motors' limits and the travel of a machine.

    Parameters
    ----------
    step_mm : tuple of float
        Motor steps x y z e that the firmware rounds to (`FirmwareAdapter.step_mm`).

    Attributes
    ----------
    speed_step_mm_s : float
        Largest step that a motor's speed may make between two segments.
    speed_change_mm_s : float
        By how much it may change within a millisecond.
    """

    def __init__(self, machine: Machine, step_mm: tuple[float, float, float, float]) -> None:
        command = machine.command
        self._machine, self._step_mm = machine, step_mm
        self._corexy = machine.kinematics == "corexy"
        steps = [command.of(axis).speed_step_mm_s for axis in ("x", "y")]
        # One limit serves both axes: the motion of an axis with a higher limit is scaled down.
        self._direction_scale = np.array(
            [*(command.speed_step_mm_s / step for step in steps), 1.0, 1.0]
        )
        self.speed_step_mm_s = command.speed_step_mm_s
        # Of a motor while the head accelerates along its path.
        accel_mm_s2 = command.accel_mm_s2 * (np.sqrt(2.0) if self._corexy else 1.0)
        # A fast machine's own acceleration changes its speed by more.
        self.speed_change_mm_s = max(self.speed_step_mm_s, 1e-3 * accel_mm_s2)

    def check_travel(
        self, place_mm: NDArray[np.float64], row: NDArray[np.int64], piece: Piece
    ) -> None:
        """Check that positions lie within the travel.

        Parameters
        ----------
        place_mm : ndarray, shape (2, n)
        row : ndarray of int64, shape (n,)
            Row of the piece's phases that each belongs to.

        Raises
        ------
        Unfit
        """
        for i, axis in enumerate(("x", "y")):
            travel = self._machine.travel[axis]  # type: ignore[index]
            beyond = np.maximum(travel.min_mm - place_mm[i], place_mm[i] - travel.max_mm)
            worst = int(np.argmax(beyond))
            # A sum of weights 1 misses by rounding; vertices are clamped in any case.
            if beyond[worst] > TRAVEL_SLACK_MM:
                line = int(piece.moves.line[piece.phases.move_index[row[worst]]])
                raise Unfit(
                    f"line {line}: the command would take {axis} to {place_mm[i, worst]:.4f} mm, "
                    f"outside {travel.min_mm:.7g} to {travel.max_mm:.7g} mm"
                )

    def check_motors(self, command_mm: NDArray[np.float64]) -> None:
        """Check that X and Y together, shape (2, n), keep the motor limits of a CoreXY.

        Raises
        ------
        TooAbrupt
        """
        motors = self._machine.command.motors
        if motors is None:
            return
        x, y = command_mm
        for order, unit, limit in (
            (1, "mm/s", motors.velocity_mm_s),
            (2, "mm/s2", motors.accel_mm_s2),
        ):
            changes = np.diff([x + y, x - y], order)
            asked = float(np.abs(changes).max(initial=0.0)) / DT_S**order
            if limit is not None and asked > _SLACK * limit:
                raise TooAbrupt(
                    f"X and Y together ask a motor for {asked:.0f} {unit}; the machine allows "
                    f"{limit:.0f} {unit} (command.motors): {_LOWER}"
                )

    def speed_steps(self, phases: Phases) -> tuple[float, float]:
        """Return the largest step of a motor's speed, and change within a millisecond [mm/s]."""
        return speed_steps(
            phases.accel_s,
            phases.cruise_s,
            phases.decel_s,
            phases.start_mm_s,
            phases.cruise_mm_s,
            phases.accel_mm_s2,
            phases.direction * self._direction_scale,
            max(self._step_mm[:2]),
            # Ramps are shorter than a motor step there, so the motor does not notice them.
            max(self._step_mm) > 0.0,
            self._corexy,
        )

    def keep_inside(self, segments: Segments, grid_mm: float) -> None:
        """Clamp, in place, vertices that the fit's tolerance or the grid would put off the bed."""
        for i, axis in enumerate(("x", "y")):
            travel = self._machine.travel[axis]  # type: ignore[index]
            # Outermost grid lines on the bed, with a margin for rounding.
            low = np.ceil(travel.min_mm / grid_mm - 1e-6) * grid_mm
            high = np.floor(travel.max_mm / grid_mm + 1e-6) * grid_mm
            np.clip(segments.end_mm[i], low, high, out=segments.end_mm[i])

    def remedy(self, piece: Piece) -> str:
        """Return what to do where motion does not follow its command, to end a message with; or "".

        The file may accelerate more than the command may, or a firmware with few moves in its
        queue stay below their speed.
        """
        asked = self.asked_too_much(piece)
        name = _SHORT_QUEUES.get(self._machine.firmware.kind)
        if asked or name is None:
            return asked
        return (
            f"; {name} does not reach the speed of short moves where command.accel_mm_s2 "
            f"({self._machine.command.accel_mm_s2:g}) is low: raise it to what the motors bear "
            "(docs/safety.md)"
        )

    def asked_too_much(self, piece: Piece) -> str:
        """Return that the file itself accelerates more than the command may, or ""."""
        if self._machine.firmware.kind == "marlin":
            return ""  # its phases stand for ramps of whole steps, with accelerations of their own
        command, phases = self._machine.command, piece.phases
        xy_mm_s2 = np.abs(phases.direction[:, :2]) * phases.accel_mm_s2[:, None]
        limits = command.of("x").accel_mm_s2, command.of("y").accel_mm_s2
        for axis, asked, limit in zip("XY", xy_mm_s2.max(axis=0, initial=0.0), limits, strict=True):
            if asked > _SLACK * limit:
                return (
                    f"; as sliced, {axis} accelerates by {asked:.0f} mm/s2, more than the "
                    f"command may ({limit:g}, command.accel_mm_s2): {_LOWER}"
                )
        return ""
