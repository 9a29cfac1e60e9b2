"""The advice for a file: accelerations by feature, shapers by layer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from stillpath.gcode.firmware.base import Adviser
from stillpath.gcode.pacing import FirstLayer
from stillpath.gcode.slicers.features import Feature, feature_of
from stillpath.gcode.types import KEPT, Limits, Moves
from stillpath.models.arrays import Array, Mask
from stillpath.models.shaping import Shaping

__all__ = ["KEPT_FEATURES", "Advice", "Bound", "is_visible", "wanted_accel"]

KEPT_FEATURES = frozenset(
    {
        Feature.BRIDGE,
        Feature.INTERNAL_BRIDGE,
        Feature.OVERHANG_WALL,
        Feature.IRONING,
        Feature.TRAVEL,
        Feature.CUSTOM,
    }
)
"""Features whose accelerations are not changed: their speeds are chosen for other reasons."""
_VISIBLE = frozenset({Feature.OUTER_WALL, Feature.THIN_WALL})


@dataclass(frozen=True, slots=True)
class Bound:
    """Bounds of a feature's acceleration [mm/s^2]; the file's own is clamped to them."""

    at_least: float = 0.0
    at_most: float = np.inf

    def of(self, file_mm_s2: float) -> float:
        """Return the file's acceleration, clamped to the bounds."""
        return min(max(file_mm_s2, self.at_least), self.at_most)


@dataclass(frozen=True, slots=True)
class Advice:
    """Advice for one file.

    Attributes
    ----------
    bounds : mapping
        Feature id to bounds; features not listed keep the file's acceleration.
    shapers : sequence of (layer, Shaping)
        Layer from which each shaper applies, rising; the first applies from the first line.
        Empty: the firmware's own shaper stays.
    first_layer : FirstLayer
        Keeps the file's accelerations.
    """

    bounds: Mapping[int, Bound] = field(default_factory=dict)
    shapers: Sequence[tuple[int, Shaping]] = ()
    first_layer: FirstLayer = field(default_factory=FirstLayer)

    def keeps(self, moves: Moves) -> Mask:
        """Mark the moves whose acceleration stays as in the file, travel included."""
        return np.asarray(self.first_layer.has(moves) | ((moves.known & KEPT) != 0))

    def shaping(self, layer: int) -> Shaping | None:
        """Return the shaper of a layer."""
        found = None
        for first, shaping in self.shapers:
            if found is None or first <= layer:
                found = shaping
        return found


def is_visible(name: str) -> bool:
    """Return whether a feature is visible on the print: walls, and unnamed features."""
    feature = feature_of(name)
    return feature is None or feature in _VISIBLE


def wanted_accel(
    moves: Moves, limits: Sequence[Limits], advice: Advice, adviser: Adviser
) -> tuple[Array, Array]:
    """Return the advised acceleration of each move, and the one that the file sets.

    Returns
    -------
    wanted : ndarray, shape (n,)
        NaN for moves that do not print in X or Y.
    file : ndarray, shape (n,)
    """
    prints = moves.prints
    used, place = np.unique(moves.limits_id, return_inverse=True)
    file = np.array([adviser.accel_mm_s2(limits[k]) for k in used.tolist()])[place.reshape(-1)]
    wanted = np.where(prints, file, np.nan)
    free = prints & ~advice.keeps(moves)
    for feature, bound in advice.bounds.items():
        rows = free & (moves.feature == feature)
        wanted[rows] = np.clip(file[rows], bound.at_least, None).clip(None, bound.at_most)
    return wanted, file
