"""Errors of an executed motion against the planned one, added up block by block.

Contour error: distance from the point y(t) to the planned path within +-80 ms of t. Tracking
error: distance to the planned point of the same instant. Residual vibration: what still moves
in the first 0.1 s after the plan came to rest.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from simulation._contour_kernels import (
    arc_length,
    contour_distances,
    group_sums,
    residual_sums,
)

__all__ = [
    "ContourErrors",
    "ContourMeter",
    "GroupTally",
    "MotionMeter",
    "ResidualMeter",
    "Tally",
    "contour_error",
    "distance_to_path",
    "tracking_error",
]

Array = NDArray[np.float64]
Ints = NDArray[np.int32]
Mask = NDArray[np.bool_]


@dataclass(slots=True)
class Tally:
    """Root mean square, maximum and number of the values added so far."""

    square_sum: float = 0.0
    max: float = 0.0
    count: int = 0

    @property
    def rms(self) -> float:
        """Root mean square; 0 of nothing."""
        return float(np.sqrt(self.square_sum / self.count)) if self.count else 0.0

    def add(self, values: Array, use: Mask | None = None) -> None:
        """Add the values (those where `use` is true)."""
        chosen = values if use is None else values[use]
        if len(chosen):
            self.square_sum += float(chosen @ chosen)
            self.max = max(self.max, float(chosen.max()))
            self.count += len(chosen)


@dataclass(slots=True)
class GroupTally:
    """A `Tally` for each integer id (layer, feature)."""

    lowest: int = 0
    square_sum: Array = field(default_factory=lambda: np.zeros(0))
    max: Array = field(default_factory=lambda: np.zeros(0))
    count: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))

    def add(self, values: Array, groups: Ints, use: Mask) -> None:
        """Add the values where `use` is true to their group."""
        if len(values) == 0:
            return
        self._cover(int(groups.min()), int(groups.max()))
        group_sums(
            values,
            np.ascontiguousarray(groups, dtype=np.int32),
            np.ascontiguousarray(use),
            self.lowest,
            self.square_sum,
            self.max,
            self.count,
        )

    def tallies(self) -> dict[int, Tally]:
        """Return id to tally, for the ids that have values, rising."""
        return {
            self.lowest + int(i): Tally(
                float(self.square_sum[i]), float(self.max[i]), int(self.count[i])
            )
            for i in np.flatnonzero(self.count)
        }

    def _cover(self, low: int, high: int) -> None:
        if len(self.count) == 0:
            self.lowest = low
        before = max(self.lowest - low, 0)
        after = max(high - (self.lowest + len(self.count) - 1), 0)
        if before or after:
            self.lowest -= before
            self.square_sum = np.pad(self.square_sum, (before, after))
            self.max = np.pad(self.max, (before, after))
            self.count = np.pad(self.count, (before, after))


@dataclass(frozen=True, slots=True)
class ContourErrors:
    """Errors of the samples first, first + stride, ... of the whole motion."""

    first: int
    stride: int
    error_mm: Array

    def __len__(self) -> int:
        """Return the number of errors."""
        return len(self.error_mm)

    @property
    def index(self) -> NDArray[np.int64]:
        """Sample numbers that the errors belong to."""
        return self.first + self.stride * np.arange(len(self.error_mm), dtype=np.int64)


class ContourMeter:
    """Contour error of a motion that arrives in blocks.

    Parameters
    ----------
    dt_s : float
        Sampling time.
    window_s : float
        The path counts this long before and after a point's instant; less at start and end.
    stride : int
        Every which sample is measured (0, stride, 2 stride, ...); the path keeps all samples.

    Attributes
    ----------
    evaluations : int
        Point-to-segment distances worked out so far.
    """

    def __init__(self, dt_s: float = 1e-3, window_s: float = 0.08, stride: int = 2) -> None:
        self._window = round(window_s / dt_s)
        self._stride = stride
        self._path = np.zeros((2, 0))
        self._points = np.zeros((2, 0))
        self._path_from = 0
        self._next = 0
        self.evaluations = 0

    def push(self, y_d_mm: Array, y_mm: Array) -> ContourErrors:
        """Add a block of planned and executed positions, both of shape (2, n).

        Returns the errors of the samples whose window has become complete.
        """
        if y_d_mm.shape != y_mm.shape or len(y_d_mm) != 2:
            raise ValueError(f"planned {y_d_mm.shape} and executed {y_mm.shape} must be (2, n)")
        self._path = np.hstack([self._path, y_d_mm])
        self._points = np.hstack([self._points, y_mm])
        return self._measure(self._path_from + self._path.shape[1] - self._window)

    def flush(self) -> ContourErrors:
        """Return the errors of the samples still waiting; their window ends with the motion."""
        return self._measure(self._path_from + self._path.shape[1])

    def _measure(self, stop: int) -> ContourErrors:
        """Errors of the due samples before `stop`; forget what no later sample needs."""
        first = self._next
        count = max(0, -(-(stop - first) // self._stride))
        errors = np.empty(count)
        if count:
            self._next = first + count * self._stride
            offset = first - self._path_from
            end = offset + (count - 1) * self._stride + 1
            length = np.empty(self._path.shape[1])
            arc_length(self._path, length)
            self.evaluations += contour_distances(
                self._path,
                length,
                np.ascontiguousarray(self._points[:, offset : end : self._stride]),
                offset + self._stride * np.arange(count, dtype=np.int64),
                self._window,
                errors,
            )
            drop = max(0, self._next - self._window - self._path_from)
            drop = min(drop, self._path.shape[1])
            self._path = self._path[:, drop:].copy()
            self._points = self._points[:, drop:].copy()
            self._path_from += drop
        return ContourErrors(first, self._stride, errors)


class ResidualMeter:
    """Residual vibration: |y - y_d| in the first `window_s` of each rest.

    A rest begins when the planned path stops changing after a motion, and counts if it lasts
    `shortest_s`; rests shorter than `window_s` count as long as they last.
    """

    def __init__(self, dt_s: float = 1e-3, window_s: float = 0.1, shortest_s: float = 0.02) -> None:
        self._window = max(1, round(window_s / dt_s))
        self._shortest = min(round(shortest_s / dt_s), self._window - 1)
        self._state = np.array([np.nan, np.nan, -1.0, 0, 0, 0, 0, 0, 0, 0])

    def push(self, y_d_mm: Array, y_mm: Array) -> None:
        """Add a block of planned and executed positions, both of shape (2, n)."""
        residual_sums(
            np.ascontiguousarray(y_d_mm),
            np.ascontiguousarray(y_mm),
            self._state,
            1e-9,
            self._shortest,
            self._window,
        )

    @property
    def tally(self) -> Tally:
        """Deviation [mm] over all rests so far."""
        return Tally(float(self._state[6]), float(self._state[8]), int(self._state[7]))

    @property
    def rests(self) -> int:
        """Number of rests so far."""
        return int(self._state[9])


class MotionMeter:
    """All measures of one motion, with who is extruding and in which layer and feature.

    Attributes
    ----------
    contour_extruding, contour_all, tracking_extruding, tracking_all : Tally
        In mm; contour error at every `stride`-th sample, tracking error at every sample.
    layers, features : GroupTally
        Contour error while extruding, by id.
    residual : ResidualMeter
    """

    def __init__(self, dt_s: float = 1e-3, window_s: float = 0.08, stride: int = 2) -> None:
        self.contour_extruding, self.contour_all = Tally(), Tally()
        self.tracking_extruding, self.tracking_all = Tally(), Tally()
        self.layers, self.features = GroupTally(), GroupTally()
        self.residual = ResidualMeter(dt_s)
        self._contour = ContourMeter(dt_s, window_s, stride)
        self._from = 0
        self._extruding = np.zeros(0, bool)
        self._layer = np.zeros(0, np.int32)
        self._feature = np.zeros(0, np.int32)

    def push(
        self,
        y_d_mm: Array,
        y_mm: Array,
        extruding: Mask,
        layer: Ints | None = None,
        feature: Ints | None = None,
    ) -> ContourErrors:
        """Add a block: positions (2, n), the rest (n,); layer and feature default to -1.

        Returns the contour errors that the block completed.
        """
        unknown = np.full(len(extruding), -1, np.int32)
        error = tracking_error(y_d_mm, y_mm)
        self.tracking_all.add(error)
        self.tracking_extruding.add(error, extruding)
        self.residual.push(y_d_mm, y_mm)
        self._extruding = np.concatenate([self._extruding, extruding])
        self._layer = np.concatenate([self._layer, unknown if layer is None else layer])
        self._feature = np.concatenate([self._feature, unknown if feature is None else feature])
        return self._add(self._contour.push(y_d_mm, y_mm))

    def flush(self) -> ContourErrors:
        """End the motion: return the contour errors that waited for their window."""
        return self._add(self._contour.flush())

    def _add(self, errors: ContourErrors) -> ContourErrors:
        if len(errors) == 0:
            return errors
        at = errors.index - self._from
        use = self._extruding[at]
        self.contour_all.add(errors.error_mm)
        self.contour_extruding.add(errors.error_mm, use)
        self.layers.add(errors.error_mm, self._layer[at], use)
        self.features.add(errors.error_mm, self._feature[at], use)
        done = int(at[-1]) + 1
        self._from += done
        self._extruding = self._extruding[done:]
        self._layer = self._layer[done:]
        self._feature = self._feature[done:]
        return errors


def tracking_error(y_d_mm: Array, y_mm: Array) -> Array:
    """Return |y - y_d| sample by sample, shapes (2, n) to (n,)."""
    difference = y_mm - y_d_mm
    # Not hypot: it guards against overflow that cannot happen here, at five times the cost.
    return np.asarray(np.sqrt(difference[0] ** 2 + difference[1] ** 2))


def contour_error(
    y_d_mm: Array, y_mm: Array, dt_s: float = 1e-3, window_s: float = 0.08, stride: int = 1
) -> Array:
    """Return the contour error of samples 0, stride, 2 stride, ... of a whole motion."""
    meter = ContourMeter(dt_s, window_s, stride)
    first = meter.push(y_d_mm, y_mm)
    return np.concatenate([first.error_mm, meter.flush().error_mm])


def distance_to_path(
    path_mm: Array,
    points_mm: Array,
    index: NDArray[np.int64],
    dt_s: float = 1e-3,
    window_s: float = 0.08,
) -> Array:
    """Return the contour error of chosen samples only.

    Parameters
    ----------
    path_mm : ndarray, shape (2, n)
        The whole planned motion.
    points_mm : ndarray, shape (2, m)
        Executed positions at the samples `index`.
    index : ndarray of int64, shape (m,)
        Rising; each within the path.
    """
    path = np.ascontiguousarray(path_mm)
    length = np.empty(path.shape[1])
    arc_length(path, length)
    out = np.empty(len(index))
    points = np.ascontiguousarray(points_mm)
    contour_distances(path, length, points, index, round(window_s / dt_s), out)
    return out
