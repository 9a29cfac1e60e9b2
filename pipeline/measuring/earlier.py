"""Errors of the sliced file at the places of the advised file.

Both make the same moves at different times. Errors of the first are stored by place (the number of
the move plus the fraction of it that is done) and interpolated at the places of the second.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from stillpath.models.arrays import Array
from stillpath.pipeline.measuring.points import MeasuredPoints

__all__ = ["EarlierErrors"]

_ROWS = 1 << 16


class EarlierErrors:
    """Store errors of some channels along a file.

    Parameters
    ----------
    folder : Path
        Folder of the temporary file.
    """

    def __init__(self, folder: Path, channels: int) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed by __exit__
        self._columns = 1 + channels
        self._last = -1.0
        self._rows = np.zeros((0, self._columns))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def note(self, points: MeasuredPoints, error_mm: Array) -> None:
        """Store errors (channels, n) at points."""
        place = np.maximum.accumulate(np.append(self._last, _places(points)))[1:]
        if len(place):
            self._last = float(place[-1])
            self._file.write(np.column_stack([place, error_mm.T]).tobytes())

    def rewind(self) -> None:
        """Read from the beginning."""
        self._file.seek(0)
        self._rows = np.zeros((0, self._columns))

    def at(self, points: MeasuredPoints) -> Array:
        """Return errors (channels, n) at points that follow those of the last call."""
        places = _places(points)
        if len(places) == 0:
            return np.zeros((self._columns - 1, 0))
        while len(self._rows) == 0 or self._rows[-1, 0] < places.max():
            data = self._file.read(8 * self._columns * _ROWS)
            if not data:
                break
            new = np.frombuffer(data).reshape(-1, self._columns)
            begun = max(int(np.searchsorted(self._rows[:, 0], places.min())) - 1, 0)
            self._rows = np.concatenate([self._rows[begun:], new])
        if len(self._rows) == 0:
            return np.zeros((self._columns - 1, len(places)))
        key = self._rows[:, 0]
        return np.stack([np.interp(places, key, column) for column in self._rows[:, 1:].T])


def _places(points: MeasuredPoints) -> Array:
    moves, row = points.moves, points.row
    start, way = moves.start_mm[row, :2], moves.end_mm[row, :2] - moves.start_mm[row, :2]
    length2 = np.sum(way**2, axis=1)
    done = np.sum((points.path_mm.T - start) * way, axis=1) / np.where(length2 > 0.0, length2, 1.0)
    return np.asarray(points.first_move + row + np.clip(done, 0.0, 0.999_999))
