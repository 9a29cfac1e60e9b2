"""Base of the compensators on top of another one: ripple, friction."""

from __future__ import annotations

import numpy as np

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
        self._travel = [machine.travel[axis] for axis in ("x", "y")]

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
        # A shaper of other plants has another length.
        self.lead_s, self.tail_s = self._inner.lead_s, self._inner.tail_s

    def ease(self, accel_share: float) -> bool:
        """See `compensation.base.Compensator.ease`."""
        return self._inner.ease(accel_share)

    def _within_travel(self, wanted: Array, u: Array) -> Array:
        """Keep `u` (2, n) within the travel, or as near to it as the inner command."""
        for row, inner, travel in zip(u, wanted, self._travel, strict=True):
            low, high = inner.min(initial=travel.min_mm), inner.max(initial=travel.max_mm)
            np.clip(row, low, high, out=row)
        return u
