"""Pass on the measured motion sample by sample, for callers that need all of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array
from stillpath.pipeline.measuring.points import MeasuredPoints

__all__ = ["Trace", "Tracer"]


@dataclass(frozen=True, slots=True)
class Trace:
    """Motion as measured, sample by sample.

    Attributes
    ----------
    first : int
        Number of the first sample.
    path_mm, executed_mm : ndarray, shape (2, n)
        As planned, and as the firmware executes the written file.
    simulated_mm : ndarray, shape (channels, 2, n)
    error_mm : ndarray, shape (channels, n)
        Contour errors.
    z_mm, extruding, line, layer : ndarray, shape (n,)
    """

    first: int
    path_mm: Array
    executed_mm: Array
    simulated_mm: Array
    error_mm: Array
    z_mm: Array
    extruding: NDArray[np.bool_]
    line: NDArray[np.int64]
    layer: NDArray[np.int32]


class Tracer:
    """Buffer the motion until its errors are known."""

    def __init__(self, trace: Callable[[Trace], None]) -> None:
        self._trace = trace
        self._executed: Array | None = None
        self._simulated = np.zeros((0, 2, 0))
        self._told = 0

    def wait(self, executed_mm: Array, simulated_mm: Array) -> None:
        """Take motion, shapes (2, n) and (channels, 2, n)."""
        if self._executed is None:
            self._executed, self._simulated = executed_mm, simulated_mm
        else:
            self._executed = np.concatenate([self._executed, executed_mm], axis=1)
            self._simulated = np.concatenate([self._simulated, simulated_mm], axis=2)

    def tell(self, points: MeasuredPoints, error_mm: Array) -> None:
        """Take the errors (channels, n) of the next samples, and pass these on."""
        count = len(points)
        assert self._executed is not None
        executed, simulated = self._executed[:, :count], self._simulated[:, :, :count]
        self._executed = self._executed[:, count:]
        self._simulated = self._simulated[:, :, count:]
        first, self._told = self._told, self._told + count
        self._trace(
            Trace(
                first,
                points.path_mm,
                executed,
                simulated,
                error_mm,
                points.z_mm,
                points.extruding,
                points.moves.line[points.row],
                points.moves.layer[points.row],
            )
        )
