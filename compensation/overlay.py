"""Base of the compensators on top of another one: ripple, friction."""

from __future__ import annotations

from stillpath.compensation.base import Compensator
from stillpath.compensation.limits import CommandBounds
from stillpath.models.arrays import Array
from stillpath.models.machine import Machine
from stillpath.models.schedule import OperatingPoint

__all__ = ["Overlay"]


class Overlay:
    """Base of compensators that add to the command of another one.

    The inner compensator does not see the addition: its state follows its own command. That may
    exceed the limits; the addition must not make it worse.

    Parameters
    ----------
    machine : Machine
        Source of the command limits.
    """

    name: str

    def __init__(self, inner: Compensator, machine: Machine, dt_s: float) -> None:
        self.lead_s, self.tail_s = inner.lead_s, inner.tail_s
        self._inner, self._dt_s = inner, dt_s
        self._bounds = CommandBounds(machine, dt_s)

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
