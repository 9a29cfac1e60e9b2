"""What every compensator offers, and the list of them by name."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from models.machine import Machine
from models.schedule import OperatingPoint

__all__ = [
    "COMPENSATORS",
    "INVERSIONS",
    "Compensator",
    "DesignError",
    "Memoryless",
    "compensator",
]

INVERSIONS = ("npz-ignore", "zmetc", "zpetc", "ebzpetc", "ts")
COMPENSATORS = ("fbf", *INVERSIONS, "shaper:zv", "shaper:mzv", "shaper:ei", "shaper:2hump_ei",
                "shaper:3hump_ei")  # fmt: skip


class DesignError(ValueError):
    """A compensator that cannot be designed; the message says why and what to do."""


class Compensator(Protocol):
    """From planned positions to commands, X and Y together, one piece at a time.

    Attributes
    ----------
    name : str
    lead_s, tail_s : float
        Standing time that it needs before and after every stretch of motion; 0 where the command
        stands on the plan in every rest.
    """

    name: str
    lead_s: float
    tail_s: float

    def reset(self, position_mm: NDArray[np.float64]) -> None:
        """Take the machine to stand still at `position_mm`, shape (2,)."""
        ...

    def observe(self, command_mm: NDArray[np.float64]) -> None:
        """Let the machine follow a command, shape (2, n), that was not ours."""
        ...

    def commit(self) -> None:
        """Take the last command as executed."""
        ...

    def operate_at(self, point: OperatingPoint) -> None:
        """Say where the machine is during the next piece; it stands still now."""
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
    """Base of compensators that take every piece by itself: nothing vibrates when it begins."""

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


def compensator(name: str, machine: Machine, dt_s: float, **settings: Any) -> Compensator:
    """Make the compensator `name` for a machine, at the sampling time `dt_s`.

    ``NAME+ripple``, and ``none+ripple``, undo the machine's ripple as well (`compensation.ripple`).
    For a machine with schedules it follows the plants (`compensation.scheduled`).

    Raises
    ------
    DesignError
        If there is no such compensator or it cannot be designed for this machine.
    """
    made: Compensator
    if name.endswith("+ripple"):
        from compensation.ripple import with_ripple

        made = with_ripple(name.removesuffix("+ripple"), machine, dt_s, **settings)
    elif machine.schedules:
        from compensation.scheduled import ScheduledCompensator

        made = ScheduledCompensator(
            machine, lambda then: compensator(name, then, dt_s, **settings), dt_s
        )
    elif name == "fbf":
        from compensation.fbf import PreviewFbf

        made = PreviewFbf(machine, dt_s, **settings)
    elif name in INVERSIONS:
        from compensation.inverting import InversionCompensator

        made = InversionCompensator(machine, dt_s, kind=name, **settings)
    elif name.startswith("shaper:"):
        from compensation.shapers import ShaperCompensator

        made = ShaperCompensator(machine, dt_s, shaper=name.removeprefix("shaper:"), **settings)
    else:
        raise DesignError(f"no compensator is called {name!r}; there are {', '.join(COMPENSATORS)}")
    return made
