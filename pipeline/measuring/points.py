"""Sampled planned motion, and the points of it at which errors are measured."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.types import Moves
from stillpath.models.arrays import Array

__all__ = ["MeasuredPoints", "MotionSamples", "part_of"]


@dataclass(frozen=True, slots=True)
class MotionSamples:
    """Planned motion on the sampling grid, with the attributes of each sample.

    Attributes
    ----------
    path_mm, executed_mm : ndarray, shape (2, n)
        X and Y as planned, and as the firmware executes them.
    z_mm : ndarray, shape (n,)
    extruding : ndarray of bool, shape (n,)
    row : ndarray of int64, shape (n,)
        Row of `moves` that each sample belongs to.
    first_move : int
        Number of the first of them in the file.
    sliced_mm : ndarray, shape (2, n), optional
        X and Y as the firmware executes the sliced file, if not as planned.
    next_mm : ndarray, shape (4,), optional
        Where the motion goes on, or stands: planned X and Y, then X and Y of the sliced file.
    """

    path_mm: Array
    executed_mm: Array
    z_mm: Array
    extruding: NDArray[np.bool_]
    row: NDArray[np.int64]
    moves: Moves
    first_move: int = 0
    sliced_mm: Array | None = None
    next_mm: Array | None = None

    def __len__(self) -> int:
        return int(self.path_mm.shape[1])

    def standing(self, samples: int) -> MotionSamples:
        """Return the motion of a machine that stands still after this one."""
        rows = np.full(samples, len(self) - 1)
        at_mm = _at(self, len(self) - 1) if self.next_mm is None else self.next_mm
        position, sliced = (
            np.repeat(xy[:, None], samples, axis=1) for xy in (at_mm[:2], at_mm[2:])
        )
        return replace(
            self,
            path_mm=position,
            executed_mm=position,
            z_mm=self.z_mm[rows],
            extruding=np.zeros(samples, dtype=bool),
            row=self.row[rows],
            sliced_mm=None if self.sliced_mm is None else sliced,
        )


def part_of(samples: MotionSamples, start: int, stop: int) -> MotionSamples:
    """Return the samples start..stop - 1."""
    return MotionSamples(
        samples.path_mm[:, start:stop],
        samples.executed_mm[:, start:stop],
        samples.z_mm[start:stop],
        samples.extruding[start:stop],
        samples.row[start:stop],
        samples.moves,
        samples.first_move,
        None if samples.sliced_mm is None else samples.sliced_mm[:, start:stop],
        _at(samples, stop) if stop < len(samples) else samples.next_mm,
    )


def _at(samples: MotionSamples, k: int) -> Array:
    sliced = samples.path_mm if samples.sliced_mm is None else samples.sliced_mm
    return np.concatenate([samples.path_mm[:, k], sliced[:, k]])


@dataclass(frozen=True, slots=True)
class MeasuredPoints:
    """Attributes of the samples at which contour errors are measured."""

    path_mm: Array
    z_mm: Array
    extruding: NDArray[np.bool_]
    row: NDArray[np.int64]
    moves: Moves
    first_move: int
    jumped: bool = False

    @classmethod
    def of(cls, samples: MotionSamples, which: slice, *, jumped: bool) -> MeasuredPoints:
        """Return the attributes of some samples."""
        return cls(
            samples.path_mm[:, which].copy(),
            samples.z_mm[which].copy(),
            samples.extruding[which].copy(),
            samples.row[which].copy(),
            samples.moves,
            samples.first_move,
            jumped,
        )

    def part(self, which: slice) -> MeasuredPoints:
        """Return some of the points."""
        return MeasuredPoints(
            self.path_mm[:, which],
            self.z_mm[which],
            self.extruding[which],
            self.row[which],
            self.moves,
            self.first_move,
            self.jumped and not which.start,
        )

    def __len__(self) -> int:
        return len(self.z_mm)
