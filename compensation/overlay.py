"""Base of the compensators on top of another one: ripple, friction."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.base import Compensator
from stillpath.models.machine import Machine, MotorLimits
from stillpath.models.schedule import OperatingPoint

__all__ = ["Overlay"]

Array = NDArray[np.float64]


class Overlay:
    """Base of compensators that add to the command of another one.

    The inner compensator does not see the addition: its state follows its own command.

    Parameters
    ----------
    inner : Compensator
    machine : Machine
        Source of the command limits.
    dt_s : float
    """

    name: str

    def __init__(self, inner: Compensator, machine: Machine, dt_s: float) -> None:
        self.lead_s, self.tail_s = inner.lead_s, inner.tail_s
        self._inner, self._dt_s = inner, dt_s
        limits = [machine.command.of("x"), machine.command.of("y")]
        self._speed_mm_s = np.array([one.velocity_mm_s for one in limits])
        self._accel_mm_s2 = np.array([one.accel_mm_s2 for one in limits])
        motors = machine.command.motors or MotorLimits()
        # Without limits of their own, motors bear what both axes ask.
        self._motor_limits = (motors.velocity_mm_s or np.inf, motors.accel_mm_s2 or np.inf)

    def reset(self, position_mm: Array) -> None:
        """See `compensation.base.Compensator.reset`."""
        self._inner.reset(position_mm)

    def observe(self, command_mm: Array) -> None:
        """See `compensation.base.Compensator.observe`."""
        self._inner.observe(command_mm)

    def commit(self) -> None:
        """See `compensation.base.Compensator.commit`."""
        self._inner.commit()

    def operate_at(self, point: OperatingPoint) -> None:
        """See `compensation.base.Compensator.operate_at`."""
        self._inner.operate_at(point)

    def ease(self, accel_share: float) -> bool:
        """See `compensation.base.Compensator.ease`."""
        return self._inner.ease(accel_share)

    def _beyond(self, u: Array, wanted: Array) -> NDArray[np.bool_]:
        """Return where a command exceeds the limits and all that `wanted` needs, (2, n).

        The inner compensator may exceed the limits; the addition must not make that worse. What is
        too much for a motor of a CoreXY, is too much of X as well as of Y.
        """
        beyond = np.zeros(u.shape, np.bool_)
        both = np.array([[1.0, 1.0], [1.0, -1.0]])
        limits = zip((1, 2), (self._speed_mm_s, self._accel_mm_s2), self._motor_limits, strict=True)
        for order, of_axes, of_motors in limits:
            size = self._dt_s**order
            beyond[:, order:] |= _more(u, wanted, order, of_axes * size)
            motors = _more(both @ u, both @ wanted, order, np.full(2, of_motors) * size)
            beyond[:, order:] |= motors.any(axis=0)
        return beyond

    def _kept(self, u: Array, wanted: Array) -> bool:
        """Return whether a command keeps each axis' limits, or needs no more than `wanted`."""
        return not self._beyond(u, wanted).any()


def _more(u: Array, wanted: Array, order: int, limits: Array) -> NDArray[np.bool_]:
    """Return where differences of rows of `u` exceed the limits and the largest of `wanted`."""
    asked, own = (np.abs(np.diff(rows, order)) for rows in (u, wanted))
    return np.asarray(asked > np.maximum(own.max(axis=1, initial=0.0), limits)[:, None])
