"""Compute the command of the Klipper extra from planned motion, block by block."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from stillpath.compensation.base import DesignError
from stillpath.compensation.live_filter import LiveFilter
from stillpath.models.arrays import Array
from stillpath.models.schedule import OperatingPoint
from stillpath.models.shaping import Shaping
from stillpath.pipeline.measuring.points import MotionSamples, part_of

__all__ = ["LiveMotion"]


class LiveMotion:
    """The motion of a file through a look-ahead filter, rests included."""

    def __init__(self, live: LiveFilter) -> None:
        self._live = live
        self._begin()

    def push(
        self, samples: MotionSamples, shaping: Shaping, point: OperatingPoint
    ) -> Iterator[tuple[MotionSamples, OperatingPoint]]:
        """Take planned motion; yield finished samples, with the command as `executed_mm`.

        Raises
        ------
        DesignError
            If the file sets the firmware's shaper: the extra steps aside for it.
        """
        if shaping.is_on:
            raise DesignError(
                f"the file sets the firmware's shaper ({shaping.label}), which "
                "disables the compensation inside Klipper: remove that line from the file"
            )
        if len(samples):
            self._held.append((samples, point))
            yield from self._extended(samples.executed_mm)

    def flush(self) -> Iterator[tuple[MotionSamples, OperatingPoint]]:
        """Yield the remaining samples, as if the machine stood still from now on."""
        if self._known is not None:
            last = self._known[:, -1:]
            yield from self._extended(np.repeat(last, self._live.margin, axis=1))
        self._begin()

    def _begin(self) -> None:
        self._known: Array | None = None
        self._held: deque[tuple[MotionSamples, OperatingPoint]] = deque()

    def _extended(self, path_mm: Array) -> Iterator[tuple[MotionSamples, OperatingPoint]]:
        margin = self._live.margin
        before = np.repeat(path_mm[:, :1], margin, axis=1) if self._known is None else self._known
        known = np.concatenate([before, path_mm], axis=1)
        self._known = known[:, max(known.shape[1] - 2 * margin, 0) :]
        if known.shape[1] <= 2 * margin:
            self._known = known
            return
        command = self._live.command(known)
        while command.shape[1] and self._held:
            samples, point = self._held.popleft()
            count = min(command.shape[1], len(samples))
            if count < len(samples):
                self._held.appendleft((part_of(samples, count, len(samples)), point))
                samples = part_of(samples, 0, count)
            yield replace(samples, executed_mm=command[:, :count]), point
            command = command[:, count:]
