"""Dry friction of guides: how far it holds an axis back, and which command compensates for it.

A friction force F holds the sliding part F/k behind its command, k the stiffness of belt and motor:
c micrometres, against the direction of motion. As a sliding contact is first bent and then dragged
along (Dahl 1968), it reverses within some micrometres of travel. The force acts where the belt
pulls, so the plant G responds to the command that is left after friction:

    y = G w,    w + c s(w) = u,    |s| <= 1 the bend.

No command linear in the path can compensate for that; u = w + c s(w) does.

Where an axis stands while the other moves, what still vibrates lets its guides creep until they are
straight (Dahl's own model does so; a guide in a vibrating machine hardly rubs). So s decays within
`CREEP_S`, and the command returns to the path. In very slow motion s is smaller for the same
reason: half at `BEND_MM` / `CREEP_S`, 0.2 mm/s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from stillpath.models._friction_kernels import bent, received
from stillpath.models.arrays import Array
from stillpath.models.plant_specs import MOST_FRICTION_MM
from stillpath.models.plants import PlantSetSpec, RelativeModesSpec, frequency_response

__all__ = [
    "BEND_MM",
    "CREEP_S",
    "LEAST_MM_S2",
    "DryFriction",
    "Guides",
    "bend_of",
    "held_back_mm",
    "usual_guides",
    "with_least_friction",
]

Guides = Literal["wheels", "rails"]
"""What an axis runs on; bushings on rods count as wheels."""
BEND_MM = 0.01
"""Travel over which friction reverses: 5 to 20 um on rolling and sliding guides. Half or twice as
much changes contour errors by a few per cent."""
CREEP_S = 0.05
"""Time constant of a bend while an axis stands. 0.03 and 0.1 are about as good (docs/tried.md)."""
LEAST_MM_S2: dict[Guides, float] = {"wheels": 150.0, "rails": 75.0}
"""Dry friction over moving mass that is assumed where none could be measured. Most guides rub more;
more would make stiff printers with light guides worse (docs/tried.md)."""
_FRAME_BELOW = 0.8
"""Highest frequency of a frame on its feet, over that of the main mode."""
_SLOW_HZ = 3.0
"""Well below all modes: there a plant follows its command but for the bend of its springs."""


def held_back_mm(plants: PlantSetSpec, accel_mm_s2: float) -> float:
    """Return how far an axis is held back by a friction force, given over its moving mass.

    A force bends the springs of an axis as far as an acceleration that needs this force.
    """
    slow = frequency_response(plants.without_delay().nominal, np.array([_SLOW_HZ]))
    bend_s2 = abs(float(slow.real[0]) - 1.0) / (2.0 * np.pi * _SLOW_HZ) ** 2
    return accel_mm_s2 * bend_s2


def usual_guides(kinematics: str) -> Guides:
    """Return what the axes of most such machines run on."""
    return "wheels" if kinematics == "cartesian" else "rails"


def with_least_friction(plants: PlantSetSpec, guides: Guides = "rails") -> PlantSetSpec:
    """Return plants whose measurement cannot show friction with the least that guides have.

    Modes well below the main one may be the frame's, which friction inside the printer does not
    bend.
    """
    least_mm_s2 = LEAST_MM_S2[guides]
    held_mm, nominal = held_back_mm(plants, least_mm_s2), plants.nominal
    if isinstance(nominal, RelativeModesSpec):
        main = max(nominal.modes, key=lambda mode: abs(mode.share))
        springs = [mode for mode in nominal.modes if mode.f_hz >= _FRAME_BELOW * main.f_hz]
        bend_s2 = sum(mode.share / (2.0 * np.pi * mode.f_hz) ** 2 for mode in springs)
        held_mm = min(held_mm, least_mm_s2 * abs(bend_s2))
    return plants.with_friction(min(held_mm, MOST_FRICTION_MM), assumed=True)


def bend_of(way_mm: Array, dt_s: float = 0.0) -> Array:
    """Return s along a path from rest, shape (n,).

    Parameters
    ----------
    dt_s : float
        Between samples; 0: guides do not creep, as in a test in which an axis never stands.
    """
    out = np.empty(len(way_mm))
    if len(out):
        bent(np.ascontiguousarray(way_mm), BEND_MM, _kept(dt_s), out)
    return out


class DryFriction:
    """Dry friction of several axes, applied to commands that arrive in blocks.

    Parameters
    ----------
    held_mm : sequence of float
        Distance by which friction holds each axis back; 0: no friction.
    dt_s : float
        Between samples; 0: guides do not creep.
    """

    def __init__(self, held_mm: Sequence[float], dt_s: float) -> None:
        self._held, self._kept = np.array(held_mm, float), _kept(dt_s)
        self._states: Array | None = None

    def __bool__(self) -> bool:
        """Whether any axis has friction."""
        return bool(self._held.any())

    def stand(self) -> None:
        """Reset to standstill with unbent guides."""
        self._states = None

    def received_mm(self, command_mm: Array) -> Array:
        """Return w for the next block of commands, shape (axes, n)."""
        if not self or command_mm.shape[1] == 0:
            return command_mm
        if self._states is None:
            first = command_mm[:, 0]
            self._states = np.stack([first, np.zeros(len(first))], axis=1)
        out = np.empty(command_mm.shape)
        command_mm = np.ascontiguousarray(command_mm)
        received(command_mm, self._held, BEND_MM, self._kept, self._states, out)
        return out


def _kept(dt_s: float) -> float:
    return math.exp(-dt_s / CREEP_S)
