"""Filtered basis functions blended with a shaper, for plants that are only partly known.

Where the members of a set disagree, inverting the plant in the middle makes the others worse; a
shaper, which only smooths, helps every member a little and harms none. Plant and command
are linear, so for every member the error of a mixture of both commands is the mixture of their
errors, and the best mixture can be computed (`pipeline.caution`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.base import DesignError
from stillpath.compensation.fbf import PreviewFbf
from stillpath.compensation.ladder import GENTLE_RUNG
from stillpath.compensation.shapers import ShaperCompensator
from stillpath.models.arrays import Array
from stillpath.models.machine import Machine
from stillpath.models.schedule import OperatingPoint

__all__ = ["Caution", "CautiousFbf"]


@dataclass(frozen=True, slots=True)
class Caution:
    """Share of filtered basis functions in the command of X and Y, and the shaper for the rest.

    Attributes
    ----------
    shares : (float, float)
        For X and Y, 0 (the shaper alone) to 1.
    fit_share : float
        Share of the tolerance that a fit to the command may use.
    """

    shares: tuple[float, float]
    shaper: str
    fx_hz: float
    fy_hz: float
    fit_share: float = 1.0


class CautiousFbf:
    """share * filtered basis functions + (1 - share) * shaper, axis by axis.

    A shaper demands no more acceleration than the path: where the motors cannot follow any command
    of filtered basis functions, or only one that is less accurate, the shaper's is used.

    Raises
    ------
    DesignError
        For shares outside 0 to 1, or an unknown shaper.
    """

    name = "fbf"

    def __init__(self, inner: PreviewFbf, machine: Machine, dt_s: float, caution: Caution) -> None:
        if not all(0.0 <= share <= 1.0 for share in caution.shares):
            raise DesignError(f"shares of filtered basis functions are {caution.shares}: 0 to 1")
        self._inner = inner
        inner.leave_out([share == 0.0 for share in caution.shares])
        self._smoothing = ShaperCompensator(
            machine, dt_s, shaper=caution.shaper, fx_hz=caution.fx_hz, fy_hz=caution.fy_hz
        )
        # A shaper spreads every motion over its length; filtered basis functions end with the plan.
        alone = not any(caution.shares)
        self.lead_s = self._smoothing.lead_s if alone else 0.0
        self.tail_s = self._smoothing.tail_s if alone else 0.0
        self._shares = np.array(caution.shares)[:, None]
        self._shaper_alone = False
        self._last = np.zeros((2, 0))

    @property
    def rungs(self) -> tuple[int, ...]:
        """See `compensation.fbf.PreviewFbf`."""
        return self._inner.rungs

    def reset(self, position_mm: Array) -> None:
        """Assume that the machine stands still at `position_mm` (2,)."""
        self._inner.reset(position_mm)

    def observe(self, command_mm: Array) -> None:
        """Account for a command (2, n) that did not come from `compensate`."""
        self._inner.observe(command_mm)

    def commit(self) -> None:
        """Mark the last command as executed."""
        self._inner.commit_as(self._last)

    def operate_at(self, point: OperatingPoint) -> None:
        """Do nothing: the plants of this machine are constant."""

    def ease(self, accel_share: float) -> bool:
        """Use at most this share of the machine's acceleration from now on; 0: the shaper alone."""
        self._shaper_alone = accel_share == 0.0
        return self._shaper_alone or self._inner.ease(accel_share)

    def compensate(
        self, y_d_mm: Array, extruding: NDArray[np.bool_], rests: NDArray[np.int64]
    ) -> Array:
        """See `compensation.base.Compensator.compensate`; both commands stand in the rests."""
        self._last = smooth = self._smoothing.compensate(y_d_mm, extruding, rests)
        if not self._shaper_alone and self._shares.any():
            exact = self._inner.compensate(y_d_mm, extruding, rests)
            mixed = self._shares * exact + (1.0 - self._shares) * smooth
            # A gentler design than the one for which the shares were chosen may be worse.
            gentler = max(self._inner.rungs) > GENTLE_RUNG
            if not gentler or self._better(mixed, smooth, y_d_mm, extruding):
                self._last = mixed
        # Both end on the plan, but their weighted sum may miss it by rounding.
        self._last[:, -1] = y_d_mm[:, -1]
        return self._last

    def _better(
        self, one: Array, other: Array, y_d_mm: Array, extruding: NDArray[np.bool_]
    ) -> bool:
        error_mm2 = self._inner.contour_square(y_d_mm, one, extruding)
        return error_mm2 <= self._inner.contour_square(y_d_mm, other, extruding, error_mm2)
