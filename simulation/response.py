"""What a machine's axes do with a command: linear response, block by block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.modal import modal_form
from models.plants import DiscretePlant
from models.response_kernels import dense_response, modal_response

__all__ = ["PlantStream", "response"]

Array = NDArray[np.float64]


@dataclass(slots=True)
class _Axis:
    plant: DiscretePlant
    modes: Array | None
    state: Array

    def push(self, u: Array, origin: float, y: Array) -> None:
        if self.modes is not None:
            modal_response(self.modes, self.plant.d, origin, self.state, u, y)
        else:
            p = self.plant
            dense_response(p.a, p.b, p.c, p.d, origin, self.state, u, y)


class PlantStream:
    """Response of several axes to a command that arrives in blocks.

    The axes stand still at the first sample pushed.

    Parameters
    ----------
    plants : sequence of DiscretePlant
        One per row of the command; all with DC gain 1 and the same sampling time.
    """

    def __init__(self, plants: Sequence[DiscretePlant]) -> None:
        if len({p.dt_s for p in plants}) > 1:
            raise ValueError("plants of one stream must share their sampling time")
        self._axes = []
        for plant in plants:
            modes = modal_form(plant)
            shape = (plant.order,) if modes is None else (len(modes), 2)
            self._axes.append(_Axis(plant, modes, np.zeros(shape)))
        self._origin: Array | None = None

    def stand(self) -> None:
        """Stand still from here on: the next sample pushed is the first one again."""
        for axis in self._axes:
            axis.state[:] = 0.0
        self._origin = None

    def push(self, u_mm: Array, out: Array | None = None) -> Array:
        """Return the positions that answer the command block `u_mm`, shape (axes, n).

        They are written to `out`, if that is given.
        """
        u = np.asarray(u_mm, dtype=np.float64)
        if u.ndim != 2 or len(u) != len(self._axes):
            raise ValueError(f"command of shape {u.shape}, expected ({len(self._axes)}, n)")
        y = np.empty(u.shape) if out is None else out
        if u.shape[1] == 0:
            return y
        if self._origin is None:
            # Counting from the start keeps digits: the response of a shift is that shift.
            self._origin = u[:, 0].copy()
        for axis, origin, row_u, row_y in zip(self._axes, self._origin, u, y, strict=True):
            axis.push(np.ascontiguousarray(row_u), float(origin), row_y)
        return y


def response(plants: Sequence[DiscretePlant], u_mm: Array) -> Array:
    """Return the response to a whole command at once, shape (axes, n)."""
    return PlantStream(plants).push(u_mm)
