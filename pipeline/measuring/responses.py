"""Simulate a machine's response to a print as sliced, as compensated, and with the best shaper.

Motion is pushed as it comes; responses follow some samples later, as a shaper looks ahead. Short
motion is buffered, since there are often only a few moves between two pieces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.shapers import shape
from stillpath.models.arrays import Array
from stillpath.models.machine import Machine
from stillpath.models.schedule import EMPTY, OperatingPoint
from stillpath.pipeline.measuring.points import MotionSamples
from stillpath.pipeline.measuring.reference_shaper import BestShaper
from stillpath.simulation.machine_response import MachineStream

__all__ = ["ResponseSamples", "Responses"]

_LEAST_SAMPLES = 4096


@dataclass(frozen=True, slots=True)
class ResponseSamples:
    """Motion with the machine's response to the command of every channel.

    Attributes
    ----------
    path_mm, executed_mm : ndarray, shape (2, n)
    extruding : ndarray of bool, shape (n,)
    response_mm : ndarray, shape (channels, 2, n)
        View of a larger array.
    """

    path_mm: Array
    executed_mm: Array
    extruding: NDArray[np.bool_]
    response_mm: Array


class Responses:
    """Responses of the nominal plants to the commands of some channels.

    Parameters
    ----------
    shaper : BestShaper
        Its delay is removed.
    names : sequence of str
        Channels: `before` is the sliced file (the executed motion, if nothing is compensated),
        `after` the executed motion, `shaper` the sliced file, shaped.
    """

    def __init__(
        self,
        machine: Machine,
        dt_s: float,
        shaper: BestShaper,
        names: tuple[str, ...],
    ) -> None:
        self._machine, self._dt_s, self._names = machine, dt_s, names
        self._compensated = "after" in names
        self._point = EMPTY
        self._pulses = shaper.pulses
        self._reach = 2 + max(int(np.ceil(times[-1] / dt_s)) for _, times in self._pulses)
        # Plants that change do so where the motion has come to.
        self._least = 1 if machine.schedules else _LEAST_SAMPLES
        # A linear machine's response to a shaped path is its shaped response to the path.
        linear = not (machine.schedules or machine.ripple or any(machine.friction_mm))
        self._shapes_response = linear and self._compensated and {"before", "shaper"} <= set(names)
        self._streams: dict[str, MachineStream] = {}
        self._planned, self._executed = np.zeros((2, 0)), np.zeros((2, 0))
        """Planned: the path, followed by the rows of the sliced file where they differ."""
        self._extruding = np.zeros(0, bool)
        self._response = np.zeros((2, 0))
        """Response to the path, from `reach` samples before the held motion as far as known."""

    def operate_at(self, point: OperatingPoint) -> None:
        """Set the operating point of the motion that follows."""
        self._point = point
        for stream in self._streams.values():
            stream.operate_at(point)

    def push(self, samples: MotionSamples) -> ResponseSamples | None:
        """Return the responses to the motion so far, all but the last few samples."""
        fresh = samples.path_mm
        if samples.sliced_mm is not None:
            fresh = np.concatenate([fresh, samples.sliced_mm])
        if self._planned.shape[1] == 0:
            # Before, the machine stood where the motion begins.
            self._planned = np.repeat(fresh[:, :1], self._reach, axis=1)
            self._response = self._planned[-2:]
            self._stand()
        self._planned = np.concatenate([self._planned, fresh], axis=1)
        self._executed = np.concatenate([self._executed, samples.executed_mm], axis=1)
        self._extruding = np.concatenate([self._extruding, samples.extruding])
        ready = len(self._extruding) - self._reach
        return self._release(ready) if ready >= self._least else None

    def flush(self) -> ResponseSamples | None:
        """Return the remaining samples, as if the machine stood still from now on."""
        if self._planned.shape[1] == 0:
            return None
        end = np.repeat(self._planned[:, -1:], self._reach, axis=1)
        self._planned = np.concatenate([self._planned, end], axis=1)
        out = self._release(len(self._extruding))
        self._planned = self._planned[:, :0]
        return out

    def _stand(self) -> None:
        for stream in self._streams.values():
            stream.stand()
        if not self._streams:
            self._streams = {
                name: MachineStream(self._machine, self._dt_s, self._point)
                for name in self._names
                if name != "shaper" or not self._shapes_response
            }

    def _release(self, ready: int) -> ResponseSamples:
        # What is planned begins `reach` samples before what is held, and ends as many after it.
        span = slice(self._reach, self._reach + ready)
        sliced = self._planned[-2:]
        path, executed = self._planned[:2, span], self._executed[:, :ready]
        responses = np.empty((len(self._names), *sliced.shape))
        for name, response in zip(self._names, responses, strict=True):
            if name == "before" and self._shapes_response:
                known = self._response.shape[1]
                response[:, :known] = self._response
                self._streams[name].push(sliced[:, known:], sliced[:, known:], response[:, known:])
                self._response = response
            elif name == "shaper" and self._shapes_response:
                self._shape(self._response, response)
            elif name == "shaper":
                command = np.empty(sliced.shape)
                self._shape(sliced, command)
                self._streams[name].push(command[:, span], path, response[:, span])
            else:
                came = name == "before" and self._compensated
                command = sliced[:, span] if came else executed
                self._streams[name].push(command, path, response[:, span])
        out = ResponseSamples(path, executed, self._extruding[:ready], responses[:, :, span])
        self._planned, self._response = self._planned[:, ready:], self._response[:, ready:].copy()
        self._executed, self._extruding = self._executed[:, ready:], self._extruding[ready:]
        return out

    def _shape(self, motion: Array, out: Array) -> None:
        for row, pulses, shaped in zip(motion, self._pulses, out, strict=True):
            shape(row, self._dt_s, pulses, out=shaped)
