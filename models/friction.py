"""Dry friction of guides: how far it holds an axis back, and which command compensates for it.

Friction of force F holds what slides F/k behind its command, k the stiffness of belt and motor: c
micrometres, against the direction of motion. As a sliding surface is first bent and then dragged
along (Dahl 1968), it turns over within some micrometres of way. The force enters where the belt
pulls, so the plant G answers a command that was held back:

    y = G w,    w + c s(w) = u,    |s| <= 1 the bend.

No command that is linear in the path does anything about that; u = w + c s(w) does away with it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stillpath.models._friction_kernels import bent, received

__all__ = ["BEND_MM", "DryFriction", "bend_of"]

Array = NDArray[np.float64]

BEND_MM = 0.01
"""Way over which friction turns over: 5 to 20 um on rolling and sliding guides. Half or twice as
much changes contour errors by a few per cent."""


def bend_of(way_mm: Array) -> Array:
    """Return s along a way from rest, shape (n,)."""
    out = np.empty(len(way_mm))
    if len(out):
        bent(np.ascontiguousarray(way_mm), BEND_MM, out)
    return out


class DryFriction:
    """Dry friction of several axes, met by commands that arrive in blocks.

    Parameters
    ----------
    held_mm : sequence of float
        How far each axis is held back; 0: not at all.
    """

    def __init__(self, held_mm: Sequence[float]) -> None:
        self._held = tuple(held_mm)
        self._states: Array | None = None

    def __bool__(self) -> bool:
        """Whether there is any."""
        return any(self._held)

    def stand(self) -> None:
        """Stand still, unbent, from here on."""
        self._states = None

    def received_mm(self, command_mm: Array) -> Array:
        """Return w for the next block of commands, shape (axes, n)."""
        if not self or command_mm.shape[1] == 0:
            return command_mm
        if self._states is None:
            first = command_mm[:, 0]
            self._states = np.stack([first, first, np.zeros(len(first))], axis=1)
        out = np.empty(command_mm.shape)
        for row, held, state, to in zip(command_mm, self._held, self._states, out, strict=True):
            received(np.ascontiguousarray(row), held, BEND_MM, state, to)
        return out
