"""The current setting of a firmware's input shaper, applied to the command of X and Y."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stillpath.models.shaper_pulses import SHAPERS, Pulses, shaper_pulses

__all__ = ["OFF", "AxisShaper", "Shaping"]


@dataclass(frozen=True, slots=True)
class AxisShaper:
    """The shaper of one axis.

    Attributes
    ----------
    type : str
        One of `models.shaper_pulses.SHAPERS`, or ``none``.
    f_hz, damping : float
        What it is built for.
    """

    type: str = "none"
    f_hz: float = 0.0
    damping: float = 0.1

    @property
    def is_on(self) -> bool:
        """It changes the command."""
        return self.type != "none" and self.f_hz > 0.0

    def pulses(self) -> Pulses:
        """Return weights and delays [s]; one pulse at once where it is off.

        Raises
        ------
        ModelError
            For a type that is not known.
        """
        if not self.is_on:
            return np.ones(1), np.zeros(1)
        return shaper_pulses(self.type, self.f_hz, self.damping)

    @property
    def label(self) -> str:
        """Type and frequency for a person."""
        return f"{self.type} {self.f_hz:.1f} Hz" if self.is_on else "none"


@dataclass(frozen=True, slots=True)
class Shaping:
    """The shapers of X and Y."""

    x: AxisShaper = AxisShaper()
    y: AxisShaper = AxisShaper()

    @property
    def is_on(self) -> bool:
        """It changes the command of an axis."""
        return self.x.is_on or self.y.is_on

    @property
    def unknown_types(self) -> list[str]:
        """Types that are on and have no model."""
        types = {s.type for s in (self.x, self.y) if s.is_on}
        return sorted(types - set(SHAPERS))

    @property
    def modelled(self) -> Shaping:
        """The same without axes whose type has no model."""
        x, y = (AxisShaper() if s.is_on and s.type not in SHAPERS else s for s in (self.x, self.y))
        return Shaping(x, y)

    @property
    def label(self) -> str:
        """Types and frequencies for a person."""
        if not self.is_on:
            return "none"
        if self.x.type == self.y.type:
            return f"{self.x.type} {self.x.f_hz:.1f} / {self.y.f_hz:.1f} Hz"
        return f"{self.x.label} / {self.y.label}"


OFF = Shaping()
