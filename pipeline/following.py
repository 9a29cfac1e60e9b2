"""How far executed motion may be from its command."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from stillpath.gcode.firmware.base import FirmwareAdapter

__all__ = ["follow_tolerance_mm", "strayed"]

_EXTRUDING_EXCESS_MM = 20e-3
_TRAVEL_EXCESS_MM = 200e-3
"""Largest distance of the executed motion from the command beyond the tolerance."""
_BRIEF, _BRIEF_RMS = 1000, 0.25
"""Before all corners of a piece are rounded, twice that distance while extruding is allowed where
the rms over a second (1000 samples) is at most a quarter of it."""


def follow_tolerance_mm(firmware: FirmwareAdapter, tolerance_um: float) -> float:
    """Return how far executed motion may normally be from its command.

    Rounding of vertices to steps, and the timing of steps, each add up to one step. Moves below the
    shortest one are merged, which adds up to its length there and back.
    """
    coarse_mm = max(2.0 * np.hypot(*firmware.step_mm[:2]), 2.0 * firmware.shortest_move_mm)
    return 1e-3 * tolerance_um + float(coarse_mm)


def strayed(
    gap_mm: NDArray[np.float64],
    extruding: NDArray[np.bool_],
    tolerance_mm: float,
    *,
    briefly: bool = False,
    drift_mm: NDArray[np.float64] | float = 0.0,
) -> str | None:
    """Return a message if motion is too far from its command; else None.

    Parameters
    ----------
    gap_mm : ndarray, shape (n,)
        From `pipeline.compensated_piece.deviation`.
    extruding : ndarray of bool, shape (n,)
    tolerance_mm : float
        From `follow_tolerance_mm`.
    briefly : bool
        Allow twice the distance while extruding, for some hundredths of a second.
    drift_mm : float, or ndarray, shape (n,)
        Distance that does not count, as the motion is only early or late by it.
    """
    gap_mm = np.maximum(gap_mm - drift_mm, 0.0)
    worst = float(np.max(gap_mm, initial=0.0))
    most_mm = tolerance_mm + _EXTRUDING_EXCESS_MM
    if worst <= most_mm:
        return None
    printing_mm = np.where(extruding, gap_mm, 0.0)
    printed = float(np.max(printing_mm, initial=0.0))
    if worst <= tolerance_mm + _TRAVEL_EXCESS_MM:
        if printed <= most_mm:
            return None
        mean = uniform_filter1d(printing_mm**2, _BRIEF, mode="constant")
        if briefly and printed <= 2.0 * most_mm and mean.max() <= (_BRIEF_RMS * most_mm) ** 2:
            return None
    return (
        f"the motion is {1e3 * printed:.1f} um from its command while extruding and "
        f"{1e3 * worst:.1f} um at worst (tolerance {1e3 * tolerance_mm:g} um)"
    )
