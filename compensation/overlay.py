"""What is laid over a compensator of vibration: ripple, friction."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.base import Compensator
from stillpath.models.machine import Machine
from stillpath.models.schedule import OperatingPoint

__all__ = ["Overlay"]

Array = NDArray[np.float64]


class Overlay:
    """Base of compensators that add to the command of another one.

    What is added is no motion that the inner compensator knows of: it keeps its own state.

    Parameters
    ----------
    inner : Compensator
    machine : Machine
        Its limits of the command.
    dt_s : float
    """

    name: str

    def __init__(self, inner: Compensator, machine: Machine, dt_s: float) -> None:
        self.lead_s, self.tail_s = inner.lead_s, inner.tail_s
        self._inner, self._dt_s, self._limits = inner, dt_s, machine.command

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

    def _peaks(self, u: Array) -> tuple[float, float]:
        """Largest speed and acceleration of an axis."""
        speed = float(np.abs(np.diff(u)).max(initial=0.0)) / self._dt_s
        return speed, float(np.abs(np.diff(u, 2)).max(initial=0.0)) / self._dt_s**2
