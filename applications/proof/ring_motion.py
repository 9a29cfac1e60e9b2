"""The motion of a ring test: its sudden stops, and the model's prediction for them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillpath.applications.proof.matching import Signal
from stillpath.applications.proof.ring_test import (
    AXES,
    PARTS,
    REST,
    ROUNDS,
    TITLE,
    Axis,
    plants_line,
    region,
)
from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.friction import DryFriction
from stillpath.models.machine import Machine
from stillpath.models.plants import PlantSpec, discretise
from stillpath.models.ripple import MachineRipple
from stillpath.models.runs import runs
from stillpath.pipeline.file_dialect import dialect_for
from stillpath.pipeline.file_motion import TextMotion
from stillpath.simulation.response import PlantStream

__all__ = [
    "RingMotion",
    "Stop",
    "begins_ring_test",
    "is_ring_test",
    "read_ring_motion",
    "ring_motion",
]

RATE_HZ = 1000.0
_HEAD_BYTES = 4096
_LONGEST_S = 900.0
_HEX = "([0-9a-f]{12})"
_FAST = 0.95
"""Share of a move's top speed below which it counts as braking."""


@dataclass(frozen=True, slots=True)
class Stop:
    """A stop: braking begins at `from_s`, and the axis should stand still from `at_s` on.

    Stops of one `kind` are from the same speed in the same direction.
    """

    axis: Axis
    compensated: bool
    from_s: float
    at_s: float
    kind: int


@dataclass(frozen=True, slots=True, eq=False)
class RingMotion:
    """What a ring test commands.

    Attributes
    ----------
    command : Signal
        Positions of X and Y in mm, as ripple and dry friction let the axes have them.
    planned_mm : ndarray, shape (2, n)
        The same before dry friction.
    added_mm : ndarray, shape (2, n)
        Deviation of the tool on top of that, by ripple on the output side.
    quiet_s : dict
        By axis from when until when it stands still long before it moves (the other one creeps, as
        after the stops).
    about : dict
        By axis which samples are about it.
    plants : dict
        By axis the digest of the plants that the file was compensated for.
    """

    command: Signal
    planned_mm: Array
    added_mm: Array
    stops: tuple[Stop, ...]
    quiet_s: dict[Axis, list[tuple[float, float]]]
    about: dict[Axis, NDArray[np.bool_]]
    plants: dict[Axis, str]

    def of(self, axis: Axis, *, compensated: bool) -> list[Stop]:
        """Return the stops of a half of an axis."""
        return [s for s in self.stops if s.axis == axis and s.compensated is compensated]

    def predicted(self, axis: Axis, spec: PlantSpec) -> Array:
        """Return the acceleration [mm/s^2] of an axis, shape (n,), by one of its plants."""
        k = AXES.index(axis)
        plant = discretise(spec, 1.0 / RATE_HZ)
        moved = PlantStream([plant]).push(self.command.rows[k : k + 1])
        return np.asarray(accelerations(moved + self.added_mm[k])[0])


def is_ring_test(printed: Path) -> bool:
    """Whether a file is marked as a ring test."""
    with printed.open("rb") as file:
        return begins_ring_test(file.read(_HEAD_BYTES))


def begins_ring_test(content: bytes) -> bool:
    """Whether a file that begins so is marked as a ring test."""
    return content.startswith(f"; {TITLE}".encode())


def read_ring_motion(printed: Path, machine: Machine) -> RingMotion:
    """Plan a ring test as the firmware does, and find its stops.

    Raises
    ------
    GcodeError
        The file cannot be read.
    ModelError
        It is not a ring test, or lacks its stops.
    """
    if not is_ring_test(printed):
        raise ModelError(
            f"{printed.name} is not a ring test: write one (`stillpath ring-test`), and give the "
            "file as it was written"
        )
    return ring_motion(printed.read_bytes(), printed.name, machine)


def ring_motion(content: bytes, name: str, machine: Machine) -> RingMotion:
    """Return what `read_ring_motion` does, of a ring test's content; `name` is for messages.

    Raises
    ------
    ModelError
        If it is not a whole ring test.
    """
    rows, numbers = [], []
    motion = TextMotion(BytesIO(content), machine, dialect_for(machine, None), 1.0 / RATE_HZ)
    samples = 0
    for part in motion:
        samples += part.samples.xyz_mm.shape[1]
        if samples > _LONGEST_S * RATE_HZ:
            raise ModelError(
                f"{name} lasts more than {_LONGEST_S / 60.0:.0f} minutes, and a ring test two: "
                "give the file as written"
            )
        rows.append(part.samples.xyz_mm[:2])
        numbers.append(part.moves.feature[part.samples.move_index - part.first_move])
    names = motion.reader.feature_names
    if not rows:
        raise ModelError(f"{name} moves nothing: give the file as written")
    command, feature = np.concatenate(rows, axis=1), np.concatenate(numbers)
    stops: list[Stop] = []
    quiet: dict[Axis, list[tuple[float, float]]] = {}
    about: dict[Axis, NDArray[np.bool_]] = {}
    for k, axis in enumerate(AXES):
        wanted = [region(axis, part) for part in PARTS]
        if not set(wanted) <= set(names):
            raise ModelError(f"{name} has no stops of {axis}: give the file as written")
        own = {part: feature == names.index(region(axis, part)) for part in PARTS}
        speed = np.abs(np.diff(command[k], prepend=command[k, 0])) * RATE_HZ
        for half in ("off", "on"):
            stops += _stops(axis, half == "on", speed, own[half], own[half + REST])
        quiet[axis] = [(first / RATE_HZ, end / RATE_HZ) for first, end in runs(own["quiet"])]
        about[axis] = np.any(list(own.values()), axis=0)
    stops.sort(key=lambda stop: stop.at_s)
    ripple = MachineRipple(machine.kinematics, machine.ripple)
    friction = DryFriction(machine.friction_mm, 1.0 / RATE_HZ)
    planned = ripple.received_mm(command)
    return RingMotion(
        Signal(0.0, 1.0 / RATE_HZ, friction.received_mm(planned)),
        planned,
        ripple.added_mm(command),
        tuple(stops),
        quiet,
        about,
        _plants(content),
    )


def accelerations(position: Array) -> Array:
    """Return second differences of rows of positions, as long as these."""
    return np.asarray(np.pad(np.diff(position, 2) * RATE_HZ**2, ((0, 0), (1, 1))))


def _stops(
    axis: Axis,
    compensated: bool,
    speed: Array,
    moves: NDArray[np.bool_],
    rests: NDArray[np.bool_],
) -> list[Stop]:
    """Find where a rest follows a move, and where the braking before it began."""
    begins = np.flatnonzero(moves & ~np.append(False, moves[:-1]))
    ends = np.flatnonzero(rests[1:] & moves[:-1]) + 1
    kinds = max(len(ends) // ROUNDS, 1)
    out = []
    for k, end in enumerate(ends):
        first = begins[begins < end][-1]
        own = speed[first:end]
        fast = np.flatnonzero(own > _FAST * own.max())
        out.append(Stop(axis, compensated, (first + fast[-1]) / RATE_HZ, end / RATE_HZ, k % kinds))
    return out


def _plants(content: bytes) -> dict[Axis, str]:
    """Return the plant digests in the first lines of the file."""
    head = content[:_HEAD_BYTES].decode("utf-8", "replace")
    return {axis: digest for axis in AXES for digest in re.findall(plants_line(axis, _HEX), head)}
