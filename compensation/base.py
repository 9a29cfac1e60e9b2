"""The interface of all compensators."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stillpath.models.schedule import OperatingPoint

__all__ = ["Compensator", "DesignError", "Memoryless"]


class DesignError(ValueError):
    """A compensator that cannot be designed; the message says why and what to do."""


class Compensator(Protocol):
    """Turns planned positions into commands, X and Y together, one piece at a time.

    Attributes
    ----------
    lead_s, tail_s : float
        Standstill that it needs before and after every stretch of motion; 0 if the command stands
        on the plan in every rest.
    """

    name: str
    lead_s: float
    tail_s: float

    def reset(self, position_mm: NDArray[np.float64]) -> None:
        """Assume that the machine stands still at `position_mm`, shape (2,)."""
        ...

    def observe(self, command_mm: NDArray[np.float64]) -> None:
        """Account for a command, shape (2, n), that did not come from `compensate`."""
        ...

    def commit(self) -> None:
        """Mark the last command as executed."""
        ...

    def operate_at(self, point: OperatingPoint) -> None:
        """Set the operating point of the next piece; the machine stands still now."""
        ...

    def ease(self, accel_share: float) -> bool:
        """Use at most this share of the machine's acceleration; return whether that is possible.

        0: no more than the path itself needs, if the compensator has such a command.
        """
        ...

    def compensate(
        self,
        y_d_mm: NDArray[np.float64],
        extruding: NDArray[np.bool_],
        rests: NDArray[np.int64],
    ) -> NDArray[np.float64]:
        """Return the command u, shape (2, n), of a piece that starts and ends at rest.

        Parameters
        ----------
        y_d_mm : ndarray, shape (2, n)
        extruding : ndarray of bool, shape (n,)
        rests : ndarray of int64, shape (k, 2)
            Sample ranges [a, b) in which the command must stand still; may be empty.

        Raises
        ------
        DesignError
            If the command cannot keep the machine's limits.
        """
        ...


class Memoryless:
    """Base of compensators without state between pieces: nothing vibrates when a piece begins."""

    lead_s = 0.0
    tail_s = 0.0

    def reset(self, position_mm: NDArray[np.float64]) -> None:
        """Do nothing."""

    def observe(self, command_mm: NDArray[np.float64]) -> None:
        """Do nothing."""

    def commit(self) -> None:
        """Do nothing."""

    def operate_at(self, point: OperatingPoint) -> None:
        """Do nothing."""

    def ease(self, accel_share: float) -> bool:
        """Return whether the share is 1: a memoryless command cannot be eased."""
        return accel_share == 1.0
