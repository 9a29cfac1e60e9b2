"""Apply the firmware's own input shaper, as it changes along a file, to planned motion.

Every increment of the path is spread over time by the pulses in force at that moment. A file can
change them only where the machine rests, so this is what the firmware does, without jumps.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.schedule import OperatingPoint
from stillpath.models.shaping import OFF, AxisShaper, Shaping
from stillpath.pipeline.measuring.points import MotionSamples, part_of

__all__ = ["ShapedMotion", "shaped"]

_REACH_S = 0.2
"""Largest delay or advance of a shaper: 3hump_ei at 10 Hz."""


class ShapedMotion:
    """Motion that arrives in blocks, with the firmware's command for it.

    Shapers are centred, like Klipper's: a constant delay is not a path error.
    """

    def __init__(self, dt_s: float) -> None:
        self._dt_s = dt_s
        self._reach = round(_REACH_S / dt_s)
        self._held: deque[tuple[MotionSamples, OperatingPoint]] = deque()
        self._begin()

    def push(
        self, samples: MotionSamples, shaping: Shaping, point: OperatingPoint
    ) -> Iterator[tuple[MotionSamples, OperatingPoint]]:
        """Take unshaped motion; yield finished samples, with the command as `executed_mm`."""
        if len(samples) == 0:
            return
        self._held.append((samples, point))
        self._spread(samples.executed_mm, shaping)
        yield from self._ready()

    def flush(self) -> Iterator[tuple[MotionSamples, OperatingPoint]]:
        """Yield the remaining samples, as if the machine stood still from now on."""
        if self._last is not None:
            self._spread(np.repeat(self._last[:, None], self._reach, axis=1), OFF)
            yield from self._ready()
        self._held.clear()
        self._begin()

    def _begin(self) -> None:
        self._last: Array | None = None
        self._early = self._reach
        """Number of samples before the first one still to be dropped."""
        self._pending = np.zeros((2, 2 * self._reach))
        self._offset = np.zeros(2)
        self._away: deque[Array] = deque()

    def _spread(self, path: Array, shaping: Shaping) -> None:
        """Add the difference between shaped and unshaped increments of a path."""
        last = path[:, :1] if self._last is None else self._last[:, None]
        steps = np.diff(np.concatenate([last, path], axis=1))
        self._last = path[:, -1].copy()
        count, reach = steps.shape[1], self._reach
        away = np.concatenate([self._pending, np.zeros((2, count))], axis=1)
        for row, step, shaper in zip(away, steps, (shaping.x, shaping.y), strict=True):
            if not shaper.is_on:
                continue
            row[reach : reach + count] -= step
            for weight, whole, part in _late(shaper, self._dt_s, reach):
                first = reach + whole
                row[first : first + count] += weight * (1.0 - part) * step
                row[first + 1 : first + 1 + count] += weight * part * step
        offset = self._offset[:, None] + np.cumsum(away[:, :count], axis=1)
        self._pending, self._offset = away[:, count:].copy(), offset[:, -1].copy()
        early = min(self._early, count)
        self._early -= early
        if count > early:
            self._away.append(offset[:, early:])

    def _ready(self) -> Iterator[tuple[MotionSamples, OperatingPoint]]:
        while self._away and self._held:
            away = self._away.popleft()
            samples, point = self._held.popleft()
            count = min(away.shape[1], len(samples))
            if count < away.shape[1]:
                self._away.appendleft(away[:, count:])
            if count < len(samples):
                self._held.appendleft((part_of(samples, count, len(samples)), point))
                samples = part_of(samples, 0, count)
            command_mm = samples.executed_mm + away[:, :count]
            yield replace(samples, executed_mm=command_mm), point


def shaped(path_mm: Array, shaping: Shaping, dt_s: float) -> Array:
    """Return the firmware's command for a whole motion, shape (2, n), at rest at both ends."""
    stream = ShapedMotion(dt_s)
    stream._spread(path_mm, shaping)
    stream._spread(np.repeat(path_mm[:, -1:], stream._reach, axis=1), OFF)
    return path_mm + np.concatenate(stream._away, axis=1)[:, : path_mm.shape[1]]


def _late(shaper: AxisShaper, dt_s: float, reach: int) -> list[tuple[float, int, float]]:
    """Return pulses as weight, whole samples of delay and fractional sample."""
    weights, delays = shaper.pulses()
    late = np.clip((delays - float(weights @ delays)) / dt_s, -reach, reach - 2)
    return [
        (float(w), math.floor(d), float(d - math.floor(d)))
        for w, d in zip(weights, late, strict=True)
    ]
