"""Errors of everything that explains a measurement, on excerpts of the print itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.shapers import shape_xy
from stillpath.models.arrays import Array
from stillpath.models.machine import Machine
from stillpath.pipeline.error_range import ErrorRange, error_ranges
from stillpath.pipeline.measuring.points import MotionSamples
from stillpath.pipeline.measuring.reference_shaper import BestShaper
from stillpath.pipeline.result import Channel
from stillpath.simulation.measures import PathDistances

__all__ = ["MotionExcerpts"]

_STRETCH_S, _MOST = 3.0, 40
"""Length of a stretch, and the most that are kept: every second one is dropped when there are more,
so that a long print is sampled along its whole length."""
_LEAD_S, _CUT_S = 0.6, 0.1
"""Beginning and end of a stretch that are not measured: vibrations of what came before die down,
and a shaper looks ahead."""
_RUN_UP_S = 0.1
"""How long the motion in front of a stretch takes from a standstill to its first velocity."""
_STANDS_MM = 0.02
"""First step of a short piece that begins at a standstill: it does without the lead."""
_LEAST_EXTRUDING = 0.1
"""Share of a stretch; others say nothing about what prints."""
_STRIDE = 5
"""Contour errors are measured at every fifth sample."""


class MotionExcerpts:
    """Keep some stretches of a print's motion, and find the range of its errors on them.

    Parameters
    ----------
    dt_s : float
        Sampling time.
    """

    def __init__(self, dt_s: float) -> None:
        self._dt_s = dt_s
        self._kept: list[_Stretch] = []
        self._seen, self._every = 0, 1

    def add(self, samples: MotionSamples) -> None:
        """Add the motion of a piece."""
        length, lead, cut = (round(each / self._dt_s) for each in (_STRETCH_S, _LEAD_S, _CUT_S))
        if len(samples) < length and np.all(np.abs(np.diff(samples.path_mm[:, :2])) < _STANDS_MM):
            lead = 0
        for start in range(0, max(len(samples) - cut, 0), length):
            stop = min(start + length, len(samples))
            measured = samples.extruding[start : stop - cut].copy()
            measured[:lead] = False
            at = np.flatnonzero(measured).astype(np.int64)[::_STRIDE]
            if _STRIDE * len(at) <= _LEAST_EXTRUDING * (stop - start):
                continue
            if self._seen % self._every == 0:
                self._kept.append(_Stretch.of(samples, start, stop, at, self._dt_s))
                if len(self._kept) > _MOST:
                    self._kept, self._every = self._kept[::2], 2 * self._every
            self._seen += 1

    def ranged(
        self, channels: Sequence[Channel], machine: Machine, shaper: BestShaper
    ) -> list[Channel]:
        """Return the measured figures of a print with their ranges (`ranges`)."""
        ranges = self.ranges(machine, shaper)
        return [ranges[c.name].applied_to(c) if c.name in ranges else c for c in channels]

    def ranges(self, machine: Machine, shaper: BestShaper) -> dict[str, ErrorRange]:
        """Return the ranges of the errors by channel; none if nothing was printed.

        `before` is the sliced file, `after` the executed motion, `shaper` the sliced file through
        the best shaper.
        """
        if not self._kept:
            return {}
        commands = {
            "before": [one.sliced_mm for one in self._kept],
            "after": [one.executed_mm for one in self._kept],
            "shaper": [shape_xy(one.sliced_mm, self._dt_s, shaper.pulses) for one in self._kept],
        }
        distances = [PathDistances(one.path_mm, self._dt_s) for one in self._kept]

        def rms(motions_mm: Sequence[Array]) -> float:
            found = [
                path.at(moved[:, one.at], one.at)
                for path, moved, one in zip(distances, motions_mm, self._kept, strict=True)
            ]
            return float(np.sqrt(np.mean(np.concatenate(found) ** 2)))

        return error_ranges(machine, commands, rms, self._dt_s)


@dataclass(frozen=True, slots=True)
class _Stretch:
    """Motion from a standstill, (2, n) each, and the samples at which it is measured."""

    path_mm: Array
    sliced_mm: Array
    executed_mm: Array
    at: NDArray[np.int64]

    @classmethod
    def of(
        cls, samples: MotionSamples, start: int, stop: int, at: NDArray[np.int64], dt_s: float
    ) -> _Stretch:
        """Copy samples of a piece, which else would stay in memory as a whole."""
        sliced = samples.path_mm if samples.sliced_mm is None else samples.sliced_mm
        path, sliced, executed = (
            _from_a_standstill(motion[:2, start:stop], dt_s)
            for motion in (samples.path_mm, sliced, samples.executed_mm)
        )
        return cls(path, sliced, executed, at + path.shape[1] - (stop - start))


def _from_a_standstill(motion_mm: Array, dt_s: float) -> Array:
    """Return motion (2, n) behind a run-up to its first velocity, a raised cosine in speed."""
    n = round(_RUN_UP_S / dt_s)
    gained = 0.5 - 0.5 * np.cos(np.pi * np.arange(n) / n)
    behind = np.cumsum(gained[::-1])[::-1]
    run_up = motion_mm[:, :1] - (motion_mm[:, 1:2] - motion_mm[:, :1]) * behind
    return np.concatenate([run_up, motion_mm], axis=1)
