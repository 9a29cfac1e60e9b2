"""Moves as Klipper's own host plans them, beside what Stillpath reads back of the same file.

The host records what it appends to its motion queues (`trapq_append` in klippy/toolhead.py and
kinematics/extruder.py, 2023-10 and 2026-08): when a move begins, how long it speeds up, cruises and
brakes, from where and in which direction, the speeds and the acceleration.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.firmware.planning import join_phases
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.types import Phases
from stillpath.models.machine import Machine

__all__ = [
    "COLUMNS",
    "Difference",
    "HostMoves",
    "compared",
    "of_the_package",
    "read_back",
    "recorded",
]

Array = NDArray[np.float64]

COLUMNS = {
    "start": "mm",
    "direction": "",
    "start speed": "mm/s",
    "cruise speed": "mm/s",
    "acceleration": "mm/s2",
    "speeding up": "s",
    "cruising": "s",
    "braking": "s",
    "begin": "s",
}
"""What is compared, and in which unit; `begin` counts from the end of the move before it."""
_STANDS_S = 1e-6
_WIDTH = 14


@dataclass(frozen=True)
class HostMoves:
    """What the host appended to the queues of the head and of the extruder.

    Attributes
    ----------
    head, extruder : ndarray, shape (n, 13)
        Begin; speeding up, cruising, braking in s; start in mm (3); direction (3); speed at the
        start and while cruising; acceleration. The extruder's first place is filament, and its
        second direction says whether pressure advance counts.
    """

    head: Array
    extruder: Array

    def head_at(self, at_s: Array) -> Array:
        """Where the plan has the head in X and Y at these times, (2, n), mm."""
        begins_s = self.head[:, 0]
        rows = self.head[np.maximum(np.searchsorted(begins_s, at_s, "right") - 1, 0)]
        since_s = np.maximum(at_s - rows[:, 0], 0.0)
        speeding_s = np.minimum(since_s, rows[:, 1])
        cruising_s = np.clip(since_s - rows[:, 1], 0.0, rows[:, 2])
        braking_s = np.clip(since_s - rows[:, 1] - rows[:, 2], 0.0, rows[:, 3])
        start, cruise, accel = rows[:, 10], rows[:, 11], rows[:, 12]
        way_mm = (start + 0.5 * accel * speeding_s) * speeding_s + cruise * cruising_s
        way_mm += (cruise - 0.5 * accel * braking_s) * braking_s
        return np.asarray((rows[:, 4:6] + rows[:, 7:9] * way_mm[:, None]).T)


@dataclass(frozen=True)
class Difference:
    """How far two plans of a file are apart.

    Attributes
    ----------
    moves, extruding, stands : int
        How many were compared: of the head, of filament, and times between moves of the head, in
        which it stands.
    largest : dict
        Largest absolute difference of each of `COLUMNS`, of the head and of filament; speeds and
        accelerations relative to the larger of the host's value and 1.
    stand_s : float
        Largest difference of a stand.
    """

    moves: int
    extruding: int
    stands: int
    largest: dict[str, float]
    stand_s: float


def of_the_package(machine: Machine) -> Machine:
    """The machine with the limit that the package's Klipper of 2023 has in place of the ratio."""
    firmware = machine.firmware
    assert firmware.kind == "klipper"
    older = {"max_accel_to_decel_mm_s2": 0.5 * firmware.planner.max_accel_mm_s2}
    planner = firmware.planner.model_copy(update=older)
    return machine.model_copy(update={"firmware": firmware.model_copy(update={"planner": planner})})


def recorded(place: Path) -> HostMoves:
    """Read what the host left beside its log."""
    rows = np.fromfile(place / "moves.bin", dtype="<f8").reshape(-1, _WIDTH)
    return HostMoves(rows[rows[:, 0] == 0.0, 1:], rows[rows[:, 0] == 1.0, 1:])


def compared(text: str, machine: Machine, host: HostMoves) -> Difference:
    """Compare the host's moves of a file with the read-back of the same text, row by row.

    The file homes first; the host's moves for that are no part of the comparison.
    """
    phases = read_back(text, machine)
    moves = np.any(phases.direction[:, :3] != 0.0, axis=1)
    feeds = phases.direction[:, 3] != 0.0
    head, extruder = host.head[-np.count_nonzero(moves) :], host.extruder
    assert len(head) == np.count_nonzero(moves)
    assert len(extruder) == np.count_nonzero(feeds)
    largest = dict.fromkeys(COLUMNS, 0.0)
    e = phases.direction[feeds, 3]
    of_head = _rows(phases, moves, np.ones(len(head)))
    of_head[:, 4:7] = phases.start_mm[moves, :3]
    of_head[:, 7:10] = phases.direction[moves, :3]
    of_extruder = _rows(phases, feeds, e)
    of_extruder[:, 4] = phases.start_mm[feeds, 3]
    of_extruder[:, 7] = 1.0
    extruder = extruder.copy()
    extruder[:, 8] = 0.0
    for theirs, ours in ((head, of_head), (extruder, of_extruder)):
        for name, columns in _PLACES.items():
            off = np.abs(theirs[:, columns] - ours[:, columns])
            if name.endswith(("speed", "acceleration")):
                off = off / np.maximum(1.0, np.abs(theirs[:, columns]))
            largest[name] = max(largest[name], float(off.max()))
    rests = _waits(head) > _STANDS_S
    off = np.abs(_waits(head) - _waits(of_head))
    largest["begin"] = float(off[~rests].max())
    stand_s = float(off[rests].max(initial=0.0))
    return Difference(len(head), len(extruder), int(rests.sum()), largest, stand_s)


def read_back(text: str, machine: Machine) -> Phases:
    """Interpret and plan a text as Stillpath does."""
    reader, planner = Interpreter(machine), adapter(machine).planner()
    parts = [planner.push(block) for block in (*reader.push(text.encode()), *reader.flush())]
    return join_phases([*parts, planner.flush()])


_PLACES = {
    "start": slice(4, 7),
    "direction": slice(7, 10),
    "start speed": slice(10, 11),
    "cruise speed": slice(11, 12),
    "acceleration": slice(12, 13),
    "speeding up": slice(1, 2),
    "cruising": slice(2, 3),
    "braking": slice(3, 4),
}


def _rows(phases: Phases, chosen: NDArray[np.bool_], per_mm: Array) -> Array:
    """Columns of the host's record, without places; `per_mm`: of the axis, of path."""
    rows = np.zeros((int(chosen.sum()), 13))
    rows[:, 0] = phases.t_s[chosen]
    rows[:, 1], rows[:, 2] = phases.accel_s[chosen], phases.cruise_s[chosen]
    rows[:, 3] = phases.decel_s[chosen]
    rows[:, 10] = phases.start_mm_s[chosen] * per_mm
    rows[:, 11] = phases.cruise_mm_s[chosen] * per_mm
    rows[:, 12] = phases.accel_mm_s2[chosen] * per_mm
    return rows


def _waits(rows: Array) -> Array:
    """From the end of each move to the begin of the next."""
    return rows[1:, 0] - (rows[:-1, 0] + rows[:-1, 1:4].sum(axis=1))
