"""Record the path of every layer with its errors while a print is measured.

One point for each move of X or Y, and further ones along an edge where the error changes. A
point's errors are the largest of the stretch that ends there, so that no peak between two corners
is lost. Points are collected in a tile, which is passed on when its layer ends: memory does not
grow with the print.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.types import Moves
from stillpath.models.arrays import Array
from stillpath.pipeline.measuring import _layer_kernels as kernels

__all__ = ["ERROR_UM", "TILE_POINTS", "UNKNOWN", "LayerRecorder", "LayerTile", "point_bytes"]

TILE_POINTS = 1 << 17
"""A layer with more points is split into several tiles."""
_GRANTED = 20_000
"""Points along edges allowed beyond the file's size: small files have long edges."""
ERROR_UM = 0.1
"""Unit of a point's errors."""
UNKNOWN = kernels.UNKNOWN
"""Error of a point that does not end a measured stretch."""


def point_bytes(channels: int) -> int:
    """Return the bytes of a point: x y line, an error for each channel, feature, on."""
    return 14 + 2 * channels


@dataclass(frozen=True, slots=True)
class LayerTile:
    """A layer, or a part of one with very many points.

    Attributes
    ----------
    layer : int
        -1 before the first mark of a layer.
    z_mm : float
        Median height of the extruding points, or else of all.
    x_mm, y_mm : ndarray of float32, shape (n,)
        Corners of the path. The first point is where it begins.
    line : ndarray of uint32, shape (n,)
        Line of the file.
    error : ndarray of uint16, shape (channels, n)
        Largest contour error of the stretch that ends here, in `ERROR_UM`.
    feature : ndarray of int32, shape (n,)
        -1 where unknown.
    on : ndarray of uint8, shape (n,)
        1 where the stretch extrudes.
    rms_um, max_um : ndarray, shape (channels,)
        Contour error while extruding.
    seconds : float
        Extruding time.
    """

    layer: int
    z_mm: float
    x_mm: NDArray[np.float32]
    y_mm: NDArray[np.float32]
    line: NDArray[np.uint32]
    error: NDArray[np.uint16]
    feature: NDArray[np.int32]
    on: NDArray[np.uint8]
    rms_um: Array
    max_um: Array
    seconds: float

    def __len__(self) -> int:
        return len(self.line)


class LayerRecorder:
    """Turn measured samples into tiles.

    Parameters
    ----------
    sample_s : float
        Time from sample to sample.
    takers : sequence of callables
        Each receives every tile.
    """

    def __init__(
        self, channels: int, sample_s: float, takers: Sequence[Callable[[LayerTile], None]]
    ) -> None:
        self._sample_s, self._takers = sample_s, takers
        self._point_bytes = float(point_bytes(channels))
        self._nothing = kernels.Samples(
            np.zeros((2, 0)),
            np.zeros(0),
            np.zeros(0, dtype=bool),
            np.zeros(0, dtype=np.int64),
            np.zeros((channels, 0)),
        )
        self._moves: Moves | None = None
        self._layer = -1
        self._first = 0
        self._state = kernels.State(
            place=np.zeros(kernels.HEIGHT + 1),
            number=np.zeros(kernels.LINE + 1, dtype=np.int64),
            high=np.zeros(channels),
            low=np.zeros(channels),
            recent=np.zeros(channels),
            tally=np.zeros(2 * channels + 1),
        )
        self._place, self._number = self._state.place, self._state.number
        self._place[kernels.HEIGHT] = np.nan
        self._place[kernels.SPARE] = _GRANTED
        self._number[kernels.LINE] = -1
        self._points = kernels.Points(
            xyz=np.empty((3, TILE_POINTS), dtype=np.float32),
            line=np.empty(TILE_POINTS, dtype=np.uint32),
            error=np.empty((channels, TILE_POINTS), dtype=np.uint16),
            feature=np.empty(TILE_POINTS, dtype=np.int32),
            on=np.empty(TILE_POINTS, dtype=np.uint8),
        )

    def add(
        self,
        xy_mm: Array,
        z_mm: Array,
        extruding: NDArray[np.bool_],
        row: NDArray[np.int64],
        moves: Moves,
        first_move: int,
        error_mm: Array,
        *,
        jumped: bool = False,
    ) -> None:
        """Add samples.

        Parameters
        ----------
        xy_mm : ndarray, shape (2, n)
            Planned positions.
        z_mm, extruding, row : ndarray, shape (n,)
            `row` is an index into `moves`.
        first_move : int
            Number of the first of them in the file.
        error_mm : ndarray, shape (channels, n)
        jumped : bool
            The position was lost before these samples.
        """
        if len(row) == 0:
            return
        xy_mm, error_mm = np.ascontiguousarray(xy_mm), np.ascontiguousarray(error_mm)
        samples = kernels.Samples(xy_mm, z_mm, extruding, row, error_mm)
        here, begins = first_move + int(row[0]), self._moves is None
        if not begins and self._moves is not moves:
            # Moves that were too short for a sample end the moves before.
            self._add_points(self._nothing, here)
        self._moves, self._first = moves, first_move
        if begins or jumped:
            self._number[kernels.MOVE] = here
            self._lift(samples)
        # Numbers of moves continue from one item of the file to the next.
        self._number[kernels.MOVE] = max(int(self._number[kernels.MOVE]), first_move)
        self._add_points(samples, 0)

    def finish(self) -> None:
        """Finish: the motion has ended."""
        if self._moves is not None:
            self._add_points(self._nothing, self._first + len(self._moves))
            self._close()

    def _add_points(self, samples: kernels.Samples, until: int) -> None:
        """Add the points of samples and of the moves before `until`."""
        moves = self._moves
        assert moves is not None
        columns = kernels.Columns(
            moves.start_mm,
            moves.end_mm,
            moves.line,
            moves.byte_start,
            moves.byte_end,
            moves.layer,
            moves.feature,
        )
        until = min(until, self._first + len(moves))
        given = columns, self._first, until, self._point_bytes, self._state, self._points
        at = kernels.follow(samples, 0, *given)
        while at >= 0:
            self._close()
            self._begin()
            at = kernels.follow(samples, at, *given)

    def _lift(self, samples: kernels.Samples) -> None:
        """Jump to the first sample: the path to it is unknown."""
        assert self._moves is not None
        row = int(samples.row[0])
        self._place[[kernels.PEN_X, kernels.PEN_Y]] = samples.xy[:, 0]
        self._place[kernels.BEND] = 0.0
        self._number[kernels.SAMPLES] = 0
        if self._number[kernels.COUNT] + 2 > TILE_POINTS:
            self._close()
        if self._number[kernels.COUNT] == 0:
            self._number[kernels.LAYER] = self._moves.layer[row]
            self._layer = int(self._number[kernels.LAYER])
        self._start(float(samples.z[0]), int(self._moves.line[row]))

    def _begin(self) -> None:
        """Begin the next tile at the current end of the path."""
        self._layer = int(self._number[kernels.LAYER])
        self._start(np.nan, int(self._number[kernels.LINE]))

    def _start(self, z_mm: float, line: int) -> None:
        """Add a point where a path begins."""
        at = int(self._number[kernels.COUNT])
        points = self._points
        points.xyz[:, at] = (*self._place[[kernels.PEN_X, kernels.PEN_Y]], z_mm)
        points.line[at] = max(line, 0)
        points.error[:, at] = UNKNOWN
        points.feature[at], points.on[at] = -1, 0
        self._number[kernels.COUNT] = at + 1

    def _close(self) -> None:
        """Pass the tile on, unless it is a single point, and clear it."""
        count = int(self._number[kernels.COUNT])
        points, tally = self._points, self._state.tally
        if count > 1:
            on = points.on[:count] > 0
            z = points.xyz[2, :count][on] if on.any() else points.xyz[2, 1:count]
            squares, largest, seen = *np.split(tally[:-1], 2), float(tally[-1])
            tile = LayerTile(
                layer=self._layer,
                z_mm=round(_median(z), 4),
                x_mm=points.xyz[0, :count].copy(),
                y_mm=points.xyz[1, :count].copy(),
                line=points.line[:count].copy(),
                error=points.error[:, :count].copy(),
                feature=points.feature[:count].copy(),
                on=points.on[:count].copy(),
                rms_um=1e3 * np.sqrt(squares / max(seen, 1.0)),
                max_um=1e3 * largest,
                seconds=seen * self._sample_s,
            )
            for take in self._takers:
                take(tile)
        self._number[kernels.COUNT] = 0
        self._place[kernels.HEIGHT] = np.nan
        tally[:] = 0.0


def _median(z_mm: NDArray[np.float32]) -> float:
    """Return the median of heights, which are usually all equal."""
    low = z_mm.min()
    return float(low) if low == z_mm.max() else float(np.median(z_mm))
