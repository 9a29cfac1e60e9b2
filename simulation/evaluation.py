"""The judge: the continuous plant, sampled ten times finer than the design.

A design at 1 kHz must not be judged by its own model. Here the command is taken as the machine
executes it, piecewise linear, and the continuous plant answers exactly (first-order hold on the
fine grid; exact wherever the command's corners lie on that grid).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stillpath.models.plants import PlantSpec, discretise
from stillpath.simulation.response import PlantStream

__all__ = ["ContinuousPlantStream", "continuous_response", "refined"]

Array = NDArray[np.float64]


class ContinuousPlantStream:
    """Stream of the true response to a command sampled at `dt_s`.

    Parameters
    ----------
    specs : sequence of PlantSpec
        One document per row of the command.
    dt_s : float
        Grid on which the command is given (for instance 1e-4).
    """

    def __init__(self, specs: Sequence[PlantSpec], dt_s: float = 1e-4) -> None:
        self._stream = PlantStream([discretise(spec, dt_s) for spec in specs])

    def push(self, u_mm: Array) -> Array:
        """Return the true positions at the command's samples, shape (axes, n)."""
        return self._stream.push(u_mm)


def refined(u_mm: Array, factor: int) -> Array:
    """Sample a piecewise-linear command `factor` times finer.

    Sample k of `u_mm` is sample k * factor of the result, shape (axes, (n - 1) * factor + 1).
    """
    n = u_mm.shape[1]
    if n < 2:
        return u_mm.copy()
    fine = np.arange((n - 1) * factor + 1) / factor
    return np.vstack([np.interp(fine, np.arange(n), row) for row in u_mm])


def continuous_response(
    specs: Sequence[PlantSpec], u_mm: Array, dt_s: float = 1e-3, factor: int = 10
) -> Array:
    """Return the true positions at `dt_s / factor` for a command sampled at `dt_s`."""
    return ContinuousPlantStream(specs, dt_s / factor).push(refined(u_mm, factor))
