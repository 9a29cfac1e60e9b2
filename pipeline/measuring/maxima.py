"""Find the largest contour errors, which a measurement of every sixth sample would miss.

Where a line ends at rest (for a retraction, say) the nozzle still rings on the soft plastic. Those
errors count for the line's maxima until X or Y moves on or the vibration has died down.

While something is extruded, a contour error is never above the tracking error, which is known at
every sample. So a sample whose tracking error is below the largest contour error so far needs no
measurement, and the others are few.
"""

from __future__ import annotations

import numpy as np

from stillpath.models.arrays import Array
from stillpath.pipeline.measuring._maxima_kernels import above, ringing
from stillpath.pipeline.measuring.points import MotionSamples
from stillpath.simulation.measures import ChosenMeter

__all__ = ["RINGING_S", "Maxima"]

RINGING_S = 0.1
"""Time after the end of a line in which ringing counts."""
_STILL_MM = 1e-9
_NO_FEATURE = -2
"""Of samples that do not extrude."""


class Maxima:
    """Find the largest errors on lines and after their ends: overall, by layer and by feature.

    On lines, only the largest of a feature is found, in the channel `exact`; those of a layer and
    of other channels may lie between the samples that are measured.

    Parameters
    ----------
    exact : int, optional
        The channel whose largest errors on lines are found; None: no channel.

    Attributes
    ----------
    max_mm : ndarray, shape (channels,)
    layers, features : dict of int to ndarray, shape (channels,)
    """

    def __init__(self, dt_s: float, channels: int, exact: int | None = None) -> None:
        self._exact = exact
        self._pending = np.zeros((2, 0), np.int32)
        """Layer and feature of the samples without responses yet."""
        self._errors = ChosenMeter(dt_s, channels=channels)
        self._reach = round(RINGING_S / dt_s)
        self._index = np.zeros(0, np.int64)
        self._groups = np.zeros((2, 0), np.int64)
        """Number, layer and feature of the samples that are to be measured."""
        self._fed = self._responded = self._added = 0
        self.max_mm = np.zeros(channels)
        self.layers: dict[int, Array] = {}
        self.features: dict[int, Array] = {}
        self.jump()

    def jump(self) -> None:
        """Forget the position: all that was added has had its response."""
        self._note(self._errors.flush())
        self._printed = self._moved = -self._reach - 1
        self._of = (-1, -1)
        self._at: Array | None = None

    def add(self, samples: MotionSamples) -> None:
        """Add motion whose responses follow later (`add_responses`)."""
        n, moves = len(samples), samples.moves
        path = samples.path_mm
        marks = np.stack([moves.layer, moves.feature])
        if self._exact is not None:
            pending = marks[:, samples.row]
            pending[1, ~samples.extruding] = _NO_FEATURE
            self._pending = np.append(self._pending, pending, axis=1)
        before = path[:, 0] if self._at is None else self._at
        found = np.empty((2, n), np.int64)
        count, printed, moved = ringing(
            path,
            samples.extruding,
            before,
            _STILL_MM,
            self._reach,
            self._printed,
            self._moved,
            found,
        )
        chosen, line = found[:, :count]
        if len(chosen):
            self._index = np.append(self._index, self._added + chosen)
            of = np.where(
                line >= 0, marks[:, samples.row[np.maximum(line, 0)]], np.array(self._of)[:, None]
            )
            self._groups = np.append(self._groups, of.astype(np.int64), axis=1)
        if printed >= 0:
            layer, feature = marks[:, samples.row[printed]].tolist()
            self._of = layer, feature
        self._printed, self._moved = printed - n, moved - n
        self._at = path[:, -1].copy()
        self._added += n

    def add_responses(self, path_mm: Array, response_mm: Array) -> None:
        """Add the next responses, shapes (2, n) and (channels, 2, n), to samples added before."""
        upto = self._responded + path_mm.shape[1]
        if self._exact is not None:
            self._choose(path_mm, response_mm[self._exact], self._exact)
        end = int(np.searchsorted(self._index, upto))
        at = self._index[self._fed : end] - self._responded
        self._responded, self._fed = upto, end
        self._note(self._errors.push(path_mm, response_mm, at))

    def _choose(self, path_mm: Array, response_mm: Array, channel: int) -> None:
        """Add samples whose error may exceed their feature's maximum so far."""
        n = path_mm.shape[1]
        of, self._pending = self._pending[:, :n], self._pending[:, n:]
        most_mm = np.zeros(max(self.features, default=-1) + 2)
        for feature, max_mm in self.features.items():
            most_mm[feature + 1] = max_mm[channel]
        chosen = np.empty(n, np.int64)
        at = chosen[: above(path_mm, response_mm, of[1], most_mm, chosen)]
        if len(at) == 0:
            return
        index = np.append(self._index, self._responded + at)
        order = np.argsort(index, kind="stable")
        self._index = index[order]
        self._groups = np.append(self._groups, of[:, at], axis=1)[:, order]

    def finish(self) -> None:
        """Finish: the motion has ended."""
        self._note(self._errors.flush())

    def _note(self, errors_mm: Array) -> None:
        count = errors_mm.shape[1]
        if count == 0:
            return
        groups, self._groups = self._groups[:, :count], self._groups[:, count:]
        self._index, self._fed = self._index[count:], self._fed - count
        self.max_mm = np.maximum(self.max_mm, errors_mm.max(axis=1))
        for of, maxima in zip(groups, (self.layers, self.features), strict=True):
            for number in np.unique(of).tolist():
                max_mm = errors_mm[:, of == number].max(axis=1)
                maxima[number] = np.maximum(maxima[number], max_mm) if number in maxima else max_mm
