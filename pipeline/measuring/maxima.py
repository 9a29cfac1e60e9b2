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
from stillpath.pipeline.measuring.points import MotionSamples
from stillpath.simulation.measures import ChosenMeter

__all__ = ["RINGING_S", "Maxima"]

RINGING_S = 0.1
"""Time after the end of a line in which ringing counts."""
_STILL_MM = 1e-9


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
        self._pending = np.zeros((3, 0), np.int64)
        """Extrusion, layer and feature of the samples without responses yet."""
        self._errors = ChosenMeter(dt_s, channels=channels)
        self._reach = round(RINGING_S / dt_s)
        self._index = np.zeros(0, np.int64)
        self._groups = np.zeros((2, 0), np.int64)
        """Number, layer and feature of the samples that are to be measured."""
        self._fed = self._answered = self._added = 0
        self.max_mm = np.zeros(channels)
        self.layers: dict[int, Array] = {}
        self.features: dict[int, Array] = {}
        self.jump()

    def jump(self) -> None:
        """Forget the position: all that was added was answered."""
        self._note(self._errors.flush())
        self._printed = self._moved = -self._reach - 1
        self._of = (-1, -1)
        self._at: Array | None = None

    def add(self, samples: MotionSamples) -> None:
        """Add motion whose responses follow later (`answered`)."""
        n = len(samples)
        path = samples.path_mm
        if self._exact is not None:
            marks = np.stack([samples.moves.layer, samples.moves.feature])[:, samples.row]
            known = np.concatenate([samples.extruding[None], marks], dtype=np.int64)
            self._pending = np.append(self._pending, known, axis=1)
        before = path[:, :1] if self._at is None else self._at
        moves = np.any(np.abs(np.diff(path, axis=1, prepend=before)) > _STILL_MM, axis=0)
        here = np.arange(n)
        printed = np.maximum.accumulate(np.where(samples.extruding, here, self._printed))
        moved = np.maximum.accumulate(np.where(moves, here, self._moved))
        # The last sample of a line may lie just before its end.
        chosen = np.flatnonzero(
            ~samples.extruding & (here - printed <= self._reach) & (moved <= printed + 1)
        )
        if len(chosen):
            self._index = np.append(self._index, self._added + chosen)
            of = np.stack([samples.moves.layer, samples.moves.feature])
            of = of[:, samples.row[np.maximum(printed[chosen], 0)]]
            of = np.where(printed[chosen] >= 0, of, np.array(self._of)[:, None])
            self._groups = np.append(self._groups, of.astype(np.int64), axis=1)
        if printed[-1] >= 0:
            row = samples.row[printed[-1]]
            self._of = int(samples.moves.layer[row]), int(samples.moves.feature[row])
        self._printed, self._moved = int(printed[-1]) - n, int(moved[-1]) - n
        self._at = path[:, -1:].copy()
        self._added += n

    def answered(self, path_mm: Array, answer_mm: Array) -> None:
        """Add the next responses, shapes (2, n) and (channels, 2, n), to samples added before."""
        upto = self._answered + path_mm.shape[1]
        if self._exact is not None:
            self._choose(np.hypot(*(answer_mm[self._exact] - path_mm)), self._exact)
        end = int(np.searchsorted(self._index, upto))
        at = self._index[self._fed : end] - self._answered
        self._answered, self._fed = upto, end
        self._note(self._errors.push(path_mm, answer_mm, at))

    def _choose(self, tracking_mm: Array, channel: int) -> None:
        """Add samples whose error may exceed their feature's maximum so far."""
        n = len(tracking_mm)
        (extruding, *of), self._pending = self._pending[:, :n], self._pending[:, n:]
        chosen = np.zeros(n, np.bool_)
        for feature in np.unique(of[1][extruding > 0]).tolist():
            max_mm = self.features[feature][channel] if feature in self.features else 0.0
            chosen |= (of[1] == feature) & (tracking_mm > max_mm)
        at = np.flatnonzero(chosen & (extruding > 0))
        index = np.append(self._index, self._answered + at)
        order = np.argsort(index, kind="stable")
        self._index = index[order]
        self._groups = np.append(self._groups, np.stack(of)[:, at], axis=1)[:, order]

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
