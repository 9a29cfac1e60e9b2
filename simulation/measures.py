"""Measure errors of an executed motion against the planned one, block by block.

Contour error: distance from the point y(t) to the planned path within +-80 ms of t. Tracking
error: distance to the planned point of the same instant. Residual vibration: deviation in the
first 0.1 s after the plan came to rest.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array, Ints, Mask
from stillpath.simulation._contour_kernels import (
    ALL,
    BOX,
    COUNTED,
    EXTRUDING,
    RESTING,
    RESTS,
    contour_distances,
    contour_errors,
    group_sums,
    motion_sums,
    path_tables,
)

__all__ = [
    "ChosenMeter",
    "ContourErrors",
    "ContourMeter",
    "GroupTally",
    "MotionMeter",
    "PathDistances",
    "Tally",
    "contour_error",
    "tracking_error",
]


WINDOW_S = 0.08
"""Time before and after a sample in which the nearest point of the path is searched."""
_RESIDUAL_S = 0.1
_SHORTEST_REST_S = 0.02
_STILL_MM = 1e-9


@dataclass(slots=True)
class Tally:
    """Root mean square, maximum and number of the values added so far."""

    square_sum: float = 0.0
    max: float = 0.0
    count: int = 0

    @property
    def rms(self) -> float:
        """Root mean square; 0 without values."""
        return float(np.sqrt(self.square_sum / self.count)) if self.count else 0.0

    def add(self, values: Array, use: Mask | None = None) -> None:
        """Add the values, shape (n,) (those where `use` is true)."""
        chosen = values if use is None else values[use]
        if len(chosen):
            self.square_sum += float(chosen @ chosen)
            self.max = max(self.max, float(chosen.max()))
            self.count += len(chosen)


@dataclass(slots=True)
class GroupTally:
    """Tallies of several channels for each integer id (layer, feature)."""

    channels: int
    lowest: int = 0
    count: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    square_sum: Array = field(init=False)
    max: Array = field(init=False)

    def __post_init__(self) -> None:
        self.square_sum = np.zeros((self.channels, 0))
        self.max = np.zeros((self.channels, 0))

    def add(self, values: Array, groups: NDArray[np.int32], use: Mask) -> None:
        """Add the values, shape (channels, n), where `use` is true to their group."""
        if len(groups) == 0:
            return
        self._cover(int(groups.min()), int(groups.max()))
        group_sums(
            np.ascontiguousarray(values),
            np.ascontiguousarray(groups, dtype=np.int32),
            np.ascontiguousarray(use),
            self.lowest,
            self.square_sum,
            self.max,
            self.count,
        )

    def tallies(self, channel: int = 0) -> dict[int, Tally]:
        """Return id to tally of a channel, for the ids that have values, rising."""
        squares, largest = self.square_sum[channel], self.max[channel]
        return {
            self.lowest + int(i): Tally(float(squares[i]), float(largest[i]), int(self.count[i]))
            for i in np.flatnonzero(self.count)
        }

    def _cover(self, low: int, high: int) -> None:
        if len(self.count) == 0:
            self.lowest = low
        before = max(self.lowest - low, 0)
        after = max(high - (self.lowest + len(self.count) - 1), 0)
        if before or after:
            # Grow by doubling: layers arrive one by one.
            after = max(after, len(self.count)) if after else 0
            self.lowest -= before
            self.count = np.pad(self.count, (before, after))
            self.square_sum = np.pad(self.square_sum, ((0, 0), (before, after)))
            self.max = np.pad(self.max, ((0, 0), (before, after)))


@dataclass(frozen=True, slots=True)
class ContourErrors:
    """Errors of the samples first, first + stride, ... of the whole motion.

    Attributes
    ----------
    error_mm : ndarray, shape (channels, m)
    """

    first: int
    stride: int
    error_mm: Array

    def __len__(self) -> int:
        """Return the number of samples."""
        return int(self.error_mm.shape[1])

    @property
    def index(self) -> Ints:
        """Sample numbers that the errors belong to."""
        return self.first + self.stride * np.arange(len(self), dtype=np.int64)


class ContourMeter:
    """Contour errors of motions along one path that arrive in blocks.

    Parameters
    ----------
    window_s : float
        Time before and after a point in which the path counts; less at start and end.
    stride : int
        Samples 0, stride, 2 stride, ... are measured; the path keeps all samples.
    channels : int
        Number of motions.

    Attributes
    ----------
    evaluations : int
        Number of point-to-line distances computed so far.
    """

    def __init__(
        self, dt_s: float = 1e-3, window_s: float = WINDOW_S, stride: int = 2, channels: int = 1
    ) -> None:
        self._window = round(window_s / dt_s)
        self._stride = stride
        self._path = np.zeros((2, 0))
        self._path_from = 0
        # Only the samples that are measured, from number `_next` on.
        self._points = np.zeros((channels, 2, 0))
        self._next = 0
        self.evaluations = 0

    def push(self, y_d_mm: Array, y_mm: Array) -> ContourErrors:
        """Add a block of planned and executed positions, shapes (2, n) and (channels, 2, n).

        Returns the errors of the samples whose window has become complete.

        Raises
        ------
        ValueError
            For other shapes.
        """
        if y_mm.shape != (len(self._points), *y_d_mm.shape) or len(y_d_mm) != 2:
            raise ValueError(
                f"planned {y_d_mm.shape} and executed {y_mm.shape} must be (2, n) and "
                f"({len(self._points)}, 2, n)"
            )
        due = -(self._path_from + self._path.shape[1]) % self._stride
        self._path = np.concatenate([self._path, y_d_mm], axis=1)
        self._points = np.concatenate([self._points, y_mm[:, :, due :: self._stride]], axis=2)
        return self._measure(self._path_from + self._path.shape[1] - self._window)

    def flush(self) -> ContourErrors:
        """Return the errors of the samples still waiting; their window ends with the motion.

        What is pushed afterwards is another motion.
        """
        errors = self._measure(self._path_from + self._path.shape[1])
        self._path_from += self._path.shape[1]
        self._path = self._path[:, :0]
        return errors

    def _measure(self, stop: int) -> ContourErrors:
        """Errors of the due samples before `stop`; forget what no later sample needs."""
        first = self._next
        count = max(0, -(-(stop - first) // self._stride))
        errors = np.empty((len(self._points), count))
        if count:
            self._next = first + count * self._stride
            centres = first - self._path_from + self._stride * np.arange(count, dtype=np.int64)
            self.evaluations += contour_errors(
                self._path,
                *_room_for_tables(self._path),
                self._points,
                centres,
                self._window,
                errors,
            )
            self._points = self._points[:, :, count:].copy()
            drop = max(0, self._next - self._window - self._path_from)
            drop = min(drop, self._path.shape[1])
            self._path = self._path[:, drop:].copy()
            self._path_from += drop
        return ContourErrors(first, self._stride, errors)


class ChosenMeter:
    """Contour errors of chosen samples of motions beside one path that arrive in blocks.

    Parameters
    ----------
    dt_s, channels
        As `ContourMeter` has them.
    """

    def __init__(self, dt_s: float = 1e-3, channels: int = 1) -> None:
        self._window = round(WINDOW_S / dt_s)
        self._path = np.zeros((2, 0))
        self._points = np.zeros((channels, 2, 0))
        self._centres = np.zeros(0, np.int64)

    def push(self, y_d_mm: Array, y_mm: Array, chosen: Ints) -> Array:
        """Add a block as `ContourMeter` has it, and which of its samples are to be measured.

        Returns the errors (channels, m) of the next chosen samples, as many as have their window.
        """
        self._centres = np.append(self._centres, chosen + self._path.shape[1])
        self._path = np.concatenate([self._path, y_d_mm], axis=1)
        self._points = np.concatenate([self._points, y_mm[:, :, chosen]], axis=2)
        return self._measure(self._path.shape[1] - self._window)

    def flush(self) -> Array:
        """Return the errors (channels, m) of the samples that wait; see `ContourMeter.flush`."""
        errors = self._measure(self._path.shape[1])
        self._path = self._path[:, :0]
        return errors

    def _measure(self, stop: int) -> Array:
        count = int(np.searchsorted(self._centres, stop))
        errors = np.empty((len(self._points), count))
        if count:
            begin = max(int(self._centres[0]) - self._window, 0)
            path = np.ascontiguousarray(self._path[:, begin:])
            contour_errors(
                path,
                *_room_for_tables(path),
                np.ascontiguousarray(self._points[:, :, :count]),
                self._centres[:count] - begin,
                self._window,
                errors,
            )
        self._centres, self._points = self._centres[count:], self._points[:, :, count:]
        first = int(self._centres[0]) if len(self._centres) else self._path.shape[1]
        drop = max(first - self._window, 0)
        self._path, self._centres = self._path[:, drop:], self._centres - drop
        return errors


class MotionMeter:
    """All measures of motions along one path, overall and while extruding.

    Parameters
    ----------
    dt_s, stride, channels
        As `ContourMeter` has them.

    Attributes
    ----------
    contour_extruding, contour_all : list of Tally
        Of every channel, in mm, at every `stride`-th sample.
    """

    def __init__(self, dt_s: float = 1e-3, stride: int = 2, channels: int = 1) -> None:
        self.contour_extruding = [Tally() for _ in range(channels)]
        self.contour_all = [Tally() for _ in range(channels)]
        self._contour = ContourMeter(dt_s, stride=stride, channels=channels)
        self._stride = stride
        self._seen = self._seen_extruding = 0
        self._extruding = np.zeros(0, bool)
        self._still_window = max(1, round(_RESIDUAL_S / dt_s))
        self._shortest = min(round(_SHORTEST_REST_S / dt_s), self._still_window - 1)
        # No point of the path yet, and no motion.
        self._rest = np.array([np.nan, np.nan, -1.0, 0.0, 0.0, 0.0])
        self._sums = np.zeros((channels, 8))

    @property
    def tracking_all(self) -> list[Tally]:
        """Tracking error [mm] of every channel, at every sample."""
        return self._tallies(ALL, self._seen)

    @property
    def tracking_extruding(self) -> list[Tally]:
        """The same while extruding."""
        return self._tallies(EXTRUDING, self._seen_extruding)

    @property
    def residual(self) -> list[Tally]:
        """Deviation [mm] in the first 0.1 s of each rest, of every channel.

        A rest begins when the planned path stops changing after a motion, and counts if it lasts
        20 ms; rests shorter than 0.1 s count as long as they last.
        """
        return self._tallies(RESTING, int(self._rest[COUNTED]))

    @property
    def rests(self) -> int:
        """Number of rests so far."""
        return int(self._rest[RESTS])

    def push(self, y_d_mm: Array, y_mm: Array, extruding: Mask) -> ContourErrors:
        """Add a block: planned (2, n) and executed positions (channels, 2, n), the rest (n,).

        Returns the contour errors that the block completed.
        """
        due = -self._seen % self._stride
        errors = self._contour.push(y_d_mm, y_mm)
        motion_sums(
            np.ascontiguousarray(y_d_mm[0]),
            np.ascontiguousarray(y_d_mm[1]),
            y_mm,
            np.ascontiguousarray(extruding),
            _STILL_MM,
            self._shortest,
            self._still_window,
            self._rest,
            self._sums,
        )
        self._seen += len(extruding)
        self._seen_extruding += int(np.count_nonzero(extruding))
        self._extruding = np.concatenate([self._extruding, extruding[due :: self._stride]])
        return self._add(errors)

    def flush(self) -> ContourErrors:
        """End the motion: return the contour errors that waited for their window."""
        return self._add(self._contour.flush())

    def _add(self, errors: ContourErrors) -> ContourErrors:
        count = len(errors)
        use = self._extruding[:count]
        for c, error in enumerate(errors.error_mm):
            self.contour_all[c].add(error)
            self.contour_extruding[c].add(error, use)
        self._extruding = self._extruding[count:]
        return errors

    def _tallies(self, column: int, count: int) -> list[Tally]:
        return [
            Tally(float(row[column]), float(np.sqrt(row[column + 1])), count) for row in self._sums
        ]


def tracking_error(y_d_mm: Array, y_mm: Array) -> Array:
    """Return |y - y_d| sample by sample, shapes (2, n) to (n,)."""
    difference = y_mm - y_d_mm
    # Not hypot: it guards against overflow that cannot happen here, at five times the cost.
    return np.asarray(np.sqrt(difference[0] ** 2 + difference[1] ** 2))


def contour_error(y_d_mm: Array, y_mm: Array, dt_s: float = 1e-3, stride: int = 1) -> Array:
    """Return contour errors [mm] of samples 0, stride, 2 stride, ... of a whole motion (2, n)."""
    meter = ContourMeter(dt_s, stride=stride)
    first = meter.push(y_d_mm, y_mm[None])
    return np.concatenate([first.error_mm[0], meter.flush().error_mm[0]])


class PathDistances:
    """Contour errors of chosen samples of many motions beside one path.

    Parameters
    ----------
    path_mm : ndarray, shape (2, n)
        The whole planned motion.
    """

    def __init__(self, path_mm: Array, dt_s: float = 1e-3, window_s: float = WINDOW_S) -> None:
        self._path = np.ascontiguousarray(path_mm)
        self._tables = _room_for_tables(self._path)
        path_tables(self._path, *self._tables)
        self._window = round(window_s / dt_s)

    def at(self, points_mm: Array, index: Ints) -> Array:
        """Return the errors [mm] of positions (2, m) at the samples `index`, rising, shape (m,)."""
        out = np.empty(len(index))
        points = np.ascontiguousarray(points_mm)
        contour_distances(self._path, *self._tables, points, index, self._window, out)
        return out


def _room_for_tables(path: Array) -> tuple[Ints, Ints, Array]:
    segments = max(path.shape[1] - 1, 0)
    first, last = np.empty((2, segments), np.int64)
    return first, last, np.empty((-(-segments // BOX), 4))
