"""Sampled motion, the currency between the rooms of the house."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["MotionBlock"]


@dataclass(frozen=True, slots=True)
class MotionBlock:
    """A stretch of uniformly sampled machine motion, linear between samples.

    Attributes
    ----------
    t0_s : float
        Time of the first sample, counted from the first move of the file.
    dt_s : float
        Sampling time.
    position_mm : ndarray, shape (4, n)
        Rows x, y, z (machine axes) and e (cumulative extruder position).
    extruding : ndarray of bool, shape (n,)
        True where the sample belongs to a move of X or Y that feeds filament.
    line : ndarray of int64, shape (n,)
        1-based source line that the sample comes from.
    layer, feature : ndarray of int32, shape (n,)
        Layer number and feature id (see `gcode.types.FeatureNames`); -1 is unknown.
    """

    t0_s: float
    dt_s: float
    position_mm: NDArray[np.float64]
    extruding: NDArray[np.bool_]
    line: NDArray[np.int64]
    layer: NDArray[np.int32]
    feature: NDArray[np.int32]

    def __len__(self) -> int:
        return int(self.position_mm.shape[1])
