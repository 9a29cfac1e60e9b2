"""Contour errors of the worst plant of a machine's set, by class of moves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.pacing import AS_SLICED, TRAVEL
from stillpath.models.arrays import Array, Mask
from stillpath.models.machine import Machine
from stillpath.models.plants import plant_set
from stillpath.models.schedule import EMPTY, OperatingPoint
from stillpath.simulation.machine_response import MachineStream
from stillpath.simulation.measures import ContourErrors, ContourMeter, GroupTally

__all__ = ["LANDING_S", "WHOLE", "ClassError", "ErrorSum", "SetErrors", "machine_numbers", "whole"]

Ints = NDArray[np.int32]

LANDING_S = 0.05
"""Extrusion this soon after a travel also counts for the travel, which excited the machine."""
WHOLE = -4
"""Number, beside those of classes, of all that they extrude."""


@dataclass(frozen=True, slots=True)
class ClassError:
    """Contour error of one class of moves: rms of the worst plant, and the time measured."""

    rms_um: float
    seconds: float


@dataclass(frozen=True, slots=True)
class ErrorSum:
    """Errors of one class of moves, added up over time.

    Attributes
    ----------
    squares_um2_s : ndarray, shape (plants,)
        Integral of the squared error of every plant.
    """

    squares_um2_s: Array
    seconds: float

    def __add__(self, other: ErrorSum) -> ErrorSum:
        return ErrorSum(self.squares_um2_s + other.squares_um2_s, self.seconds + other.seconds)

    def __sub__(self, other: ErrorSum) -> ErrorSum:
        return ErrorSum(self.squares_um2_s - other.squares_um2_s, self.seconds - other.seconds)

    @property
    def worst(self) -> ClassError:
        """The error of the plant with the largest."""
        if self.seconds <= 0.0:
            return ClassError(0.0, 0.0)
        mean = max(float(np.max(self.squares_um2_s)), 0.0) / self.seconds
        return ClassError(float(np.sqrt(mean)), self.seconds)


def whole(sums: Mapping[int, ErrorSum]) -> ErrorSum | None:
    """Return the sum over all classes that have a pace; None if they extrude nothing."""
    parts = [found for one, found in sums.items() if one not in (TRAVEL, AS_SLICED)]
    return reduce(add, parts) if parts else None


def machine_numbers(machine: Machine, dt_s: float) -> list[int | None]:
    """Return the numbers of the machines of a set: the nominal one (None), and the members.

    Member k of X and member k of Y make one machine; the shorter list repeats.
    """
    sets = [plant_set(machine.axes[axis], dt_s) for axis in ("x", "y")]
    return [None, *range(max(len(one.members) for one in sets))]


class SetErrors:
    """Measure motion with all machines of a set (`machine_numbers`).

    Parameters
    ----------
    stride : int
        Every `stride`-th sample is measured.
    """

    def __init__(self, machine: Machine, dt_s: float, *, stride: int) -> None:
        self._machine, self._dt_s, self._stride = machine, dt_s, stride
        self._numbers = machine_numbers(machine, dt_s)
        self._streams: list[MachineStream] = []
        self._point = EMPTY
        self._never = round(LANDING_S / dt_s) + 1
        self.begin()

    def begin(self) -> None:
        """Discard what was measured; the machine stands still when motion resumes."""
        channels = len(self._numbers)
        self._meter = ContourMeter(self._dt_s, stride=self._stride, channels=channels)
        self._tally, self._landed = GroupTally(channels), GroupTally(channels)
        self._waiting: list[tuple[Ints, Mask, Mask]] = []
        self._count = 0
        self.jump()

    def operate_at(self, point: OperatingPoint) -> None:
        """Set the operating point of the motion that follows."""
        self._point = point
        for stream in self._streams:
            stream.operate_at(point)

    def jump(self) -> None:
        """Forget the motion so far: the machine stands still when it resumes."""
        self._note(self._meter.flush())
        self._fresh, self._since = True, self._never

    def add(self, path_mm: Array, command_mm: Array, extruding: Mask, classes: Ints) -> None:
        """Add motion.

        Parameters
        ----------
        path_mm, command_mm : ndarray, shape (2, n)
            Planned motion, and the command that the machine receives.
        extruding : ndarray of bool, shape (n,)
        classes : ndarray of int32, shape (n,)
            Class that the errors of each extruding sample count for.
        """
        n = path_mm.shape[1]
        if n == 0:
            return
        if not self._streams:
            self._streams = [
                MachineStream(self._machine, self._dt_s, self._point, member=number)
                for number in self._numbers
            ]
        elif self._fresh:
            for stream in self._streams:
                stream.stand()
        self._fresh = False
        due = slice(-self._count % self._stride, None, self._stride)
        landing = extruding & self._landing(classes == TRAVEL)
        self._waiting.append((classes[due], extruding[due], landing[due]))
        self._count += n
        # Ripple and guides are the same for all of them.
        received_mm = self._streams[0].received_mm(command_mm)
        responses_mm = np.stack([stream.respond(received_mm, path_mm) for stream in self._streams])
        self._note(self._meter.push(path_mm, responses_mm))

    def finish(self) -> None:
        """Finish: the motion has ended."""
        self._note(self._meter.flush())

    def sums(self) -> dict[int, ErrorSum]:
        """Return the sums of the errors measured so far, by class."""
        step_s = self._stride * self._dt_s
        found: dict[int, ErrorSum] = {}
        for tally in (self._tally, self._landed):
            for at in np.flatnonzero(tally.count).tolist():
                squares = 1e6 * step_s * tally.square_sum[:, at]
                found[tally.lowest + at] = ErrorSum(squares, step_s * int(tally.count[at]))
        return found

    def errors(self) -> dict[int, ClassError]:
        """Return the errors measured so far, by class."""
        return {one: found.worst for one, found in self.sums().items()}

    def _landing(self, travels: Mask) -> Mask:
        """Mark the samples soon after a travel move."""
        n = len(travels)
        at = np.where(travels, np.arange(n), -1 - self._since)
        since = np.arange(n) - np.maximum.accumulate(at)
        self._since = min(int(since[-1]), self._never)
        return np.asarray(since < self._never)

    def _note(self, errors: ContourErrors) -> None:
        done = 0
        while done < len(errors):
            classes, extruding, landing = self._waiting[0]
            count = min(len(classes), len(errors) - done)
            found = errors.error_mm[:, done : done + count]
            done += count
            if count < len(classes):
                rest = slice(count, None)
                self._waiting[0] = classes[rest], extruding[rest], landing[rest]
            else:
                del self._waiting[0]
            if count:
                travel = np.full(count, TRAVEL, np.int32)
                self._tally.add(found, classes[:count], extruding[:count])
                self._landed.add(found, travel, landing[:count])
