"""Reproduce the print time that a slicer of the PrusaSlicer family estimates for a file.

The estimator plans much as Marlin with classic jerk does, and differs in details that add up to per
cents: the queue is longer, whole passes go over it, G28 is a move to 0, an axis's limit of
acceleration has its own form. A file that contains its slicer's limits is planned here as the
slicer did, as a check of the interpreter and the planners.

Source: `GCodeProcessor.cpp` of PrusaSlicer 2.4 (queue forward, then back; an axis's acceleration
limit taken as the block's) and 2.9 (back, then forward; scaled to the axis), OrcaSlicer 2.3, and
BambuStudio 2.3 (limit of centripetal acceleration, jerk of the vector, arcs as one block each).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.slicers._estimator_kernels import queue_times
from stillpath.gcode.slicers.facts import SlicerFacts

__all__ = ["Rules", "estimated_s", "rules_of"]

_AXES = "xyze"
_WORD = re.compile(rb"([A-Z])\s*([-+]?(?:\d+\.?\d*|\.\d+))")
_KLIPPER_LIMIT = re.compile(rb"\b(ACCEL|VELOCITY|SQUARE_CORNER_VELOCITY)\s*=\s*([\d.]+)")
_DEFAULT_ACCEL_MM_S2 = 1500.0
_DEFAULT_TRAVEL_ACCEL_MM_S2 = 1250.0
_CHAMBER_WAIT_S = 720.0
_NEVER = 1e12
_ARC_TOLERANCE_MM = 0.0125
# Columns of a move: travel x y z e, then what was in force.
_TRAVEL, _ENTER, _LEAVE = slice(0, 4), slice(4, 7), slice(7, 10)
_LENGTH, _RADIUS, _SPEED, _ACCEL, _PRINT_ACCEL, _FLOW, _STOP = range(10, 17)
_MAX_ACCEL, _MAX_SPEED, _JERK = slice(17, 21), slice(21, 25), slice(25, 29)
_COLUMNS = 29


@dataclass(frozen=True, slots=True)
class Rules:
    """Which of the family's estimators.

    Attributes
    ----------
    forward_first : bool
        Order of the two passes over the queue.
    scaled : bool
        An axis's acceleration limit is divided by the axis's share of the move.
    arcs : str
        ``ignored``, ``pieces`` or ``blocks`` (one each).
    centripetal : bool
        Speed is limited by v**2 / r where the path turns a little.
    vector_jerk : bool
        Jerk of X Y Z is that of the velocity's vector, reversals included.
    waits : bool
        G4, M400 and waiting for a hot chamber take time.
    velocity_limits : bool
        SET_VELOCITY_LIMIT counts.
    """

    forward_first: bool = True
    scaled: bool = False
    arcs: str = "ignored"
    centripetal: bool = False
    vector_jerk: bool = False
    waits: bool = False
    velocity_limits: bool = False


_ORCA = Rules(scaled=True, arcs="blocks", centripetal=True, waits=True, velocity_limits=True)


def rules_of(facts: SlicerFacts) -> Rules | None:
    """Return the estimator of a file's slicer, or None for slicers of other families."""
    if facts.slicer in ("PrusaSlicer", "SuperSlicer"):
        version = tuple(int(part) for part in re.findall(r"\d+", facts.version)[:2])
        if version < (2, 6):
            return Rules()
        return Rules(forward_first=version < (2, 8), scaled=True, arcs="pieces")
    if facts.slicer == "OrcaSlicer":
        return _ORCA
    if facts.slicer == "BambuStudio":
        return replace(_ORCA, vector_jerk=True)
    return None


def estimated_s(file: BinaryIO, facts: SlicerFacts, rules: Rules | None = None) -> float | None:
    """Return the time that the slicer's estimator gives a file.

    Parameters
    ----------
    file : BinaryIO
        Plain G-code, read from its beginning to its end.
    facts : SlicerFacts
        Of the same file: limits of the machine, flavor.
    rules : Rules, optional
        By default those of the file's slicer.

    Returns
    -------
    float or None
        None where the slicer is of another family or its limits do not stand in the file.
    """
    rules = rules or rules_of(facts)
    if rules is None or not facts.numbers("machine_max_acceleration_x"):
        return None
    file.seek(0)
    reader = _Reader(facts, rules)
    rows = np.array(list(reader.rows(file)), dtype=np.float64).reshape(-1, _COLUMNS)
    if len(rows) == 0:
        return reader.waited_s
    cruise, accel, safe, junction = _blocks(rows, rules)
    length, stops = rows[:, _LENGTH], rows[:, _STOP] != 0.0
    return reader.waited_s + float(
        queue_times(length, accel, cruise, safe, junction, stops, rules.forward_first)
    )


def _blocks(
    rows: NDArray[np.float64], rules: Rules
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return cruising speed, acceleration, safe speed and speed of the junction before a block."""
    length = rows[:, _LENGTH]
    share = rows[:, _TRAVEL] / length[:, None]
    speed = rows[:, _SPEED].copy()
    arc = rows[:, _RADIUS] > 0.0
    before = np.vstack([np.zeros(3), rows[:-1, _LEAVE]])
    if rules.centripetal:
        radius = np.where(arc, rows[:, _RADIUS], _turn_radius(before, rows))
        speed = np.minimum(speed, np.sqrt(rows[:, _PRINT_ACCEL] * radius))
    wanted = np.abs(share) * speed[:, None]
    wanted[:, 3] *= rows[:, _FLOW]
    most = np.where(rows[:, _MAX_SPEED] > 0.0, rows[:, _MAX_SPEED], _NEVER)
    factor = np.min(np.minimum(1.0, most / np.maximum(wanted, 1e-12)), axis=1)
    cruise = speed * factor
    velocity = share * cruise[:, None]
    velocity[:, 3] *= rows[:, _FLOW]

    accel = rows[:, _ACCEL].copy()
    for axis in range(4):
        limit, part = rows[:, _MAX_ACCEL][:, axis], np.abs(share[:, axis])
        over = accel * part > limit
        accel[over] = limit[over] / part[over] if rules.scaled else limit[over]

    jerk = rows[:, _JERK]
    steps = np.where(np.abs(velocity) > jerk, jerk, _NEVER)
    safe = np.minimum(cruise, steps.min(axis=1))
    # Speeds before are those of the request, not of the limits, but where centripetal ones count.
    asked = cruise if rules.centripetal else speed
    return cruise, accel, safe, _junctions(rows, rules, cruise, asked, velocity, safe)


def _junctions(
    rows: NDArray[np.float64],
    rules: Rules,
    cruise: NDArray[np.float64],
    asked: NDArray[np.float64],
    velocity: NDArray[np.float64],
    safe: NDArray[np.float64],
) -> NDArray[np.float64]:
    last = np.concatenate([[0.0], asked[:-1]])
    slower = np.minimum(last, cruise)
    leaving = np.vstack([np.zeros(4), velocity[:-1]])
    leaving *= np.where(last > cruise, cruise / np.maximum(last, 1e-12), 1.0)[:, None]
    entering = velocity.copy()
    if rules.vector_jerk:
        before = np.vstack([np.zeros(3), rows[:-1, _LEAVE]])
        leaving[:, :3] = before * slower[:, None]
        entering[:, :3] = rows[:, _ENTER] * cruise[:, None]
    factor = np.ones(len(rows))
    for axis in range(4):
        a, b = leaving[:, axis] * factor, entering[:, axis] * factor
        step = np.abs(a - b)
        if axis == 3 or not rules.vector_jerk:
            # A reversal counts as one stop, not as two.
            step = np.where(a * b < 0.0, np.maximum(np.abs(a), np.abs(b)), step)
        limit = rows[:, _JERK][:, axis]
        factor *= np.where(step > limit, limit / np.maximum(step, 1e-12), 1.0)
    junction = slower * factor
    if rules.arcs == "blocks":
        bend = np.abs(rows[:, _ENTER] - np.vstack([np.zeros(3), rows[:-1, _LEAVE]]))
        by_axis = rows[:, _JERK][:, :3] / np.maximum(bend, 1e-12)
        arc = rows[:, _RADIUS] > 0.0
        junction[arc] = np.minimum(by_axis.min(axis=1), slower)[arc]
    stops = (np.concatenate([[0.0], safe[:-1]]) > 0.99 * junction) & (safe > 0.99 * junction)
    return np.where(stops | (last <= 1e-4), safe, junction)


def _turn_radius(before: NDArray[np.float64], rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the radius of the circle of a slight turn of the path; infinite for others."""
    now = rows[:, _ENTER]
    norms = np.hypot(*before[:, :2].T) * np.hypot(*now[:, :2].T)
    dot = np.clip(np.sum(before[:, :2] * now[:, :2], axis=1) / np.maximum(norms, 1e-12), -1.0, 1.0)
    chord = np.sqrt(2.0 * (1.0 - dot))
    slight = (norms > 0.0) & (chord < 0.5) & (chord > 1e-5)
    radius = np.hypot(rows[:, 0], rows[:, 1]) / np.maximum(chord, 1e-12)
    return np.where(slight, radius, _NEVER)


class _Reader:
    """Read a file's moves as the estimator does."""

    def __init__(self, facts: SlicerFacts, rules: Rules) -> None:
        self._rules = rules
        self._flavor = facts.flavor
        self._max_accel = [_limit(facts, f"machine_max_acceleration_{a}") for a in _AXES]
        self._max_speed = [
            _limit(facts, f"machine_max_feedrate_{a}", f"machine_max_speed_{a}") for a in _AXES
        ]
        self._jerk = [_limit(facts, f"machine_max_jerk_{a}") for a in _AXES]
        extruding = _limit(facts, "machine_max_acceleration_extruding")
        retracting = _limit(facts, "machine_max_acceleration_retracting")
        travelling = extruding
        if facts.flavor in ("marlin2", "marlinfirmware"):
            travelling = _limit(facts, "machine_max_acceleration_travel")
        self._caps = {"P": extruding, "R": retracting, "T": travelling}
        self._accel = {
            "P": extruding or _DEFAULT_ACCEL_MM_S2,
            "R": retracting or _DEFAULT_ACCEL_MM_S2,
            "T": travelling or _DEFAULT_TRAVEL_ACCEL_MM_S2,
        }
        self._position = [0.0] * 4
        self._origin = [0.0] * 4
        self._speed = 0.0
        self._flow = 1.0
        self._absolute = self._absolute_e = True
        self._wiping = False
        self._stop = False
        self._tool = b"0"
        self.waited_s = 0.0

    def rows(self, file: BinaryIO) -> Iterator[list[float]]:
        """Yield a row for every block."""
        for line in file:
            code = line.partition(b";")[0].strip()
            if not code:
                comment = line.strip()[1:].strip()
                if comment.startswith(b"WIPE_"):
                    self._wiping = comment.startswith(b"WIPE_START")
                continue
            if code.startswith(b"SET_VELOCITY_LIMIT"):
                if self._rules.velocity_limits:
                    self._klipper_limits(code)
                continue
            words = _WORD.findall(code)
            if not words or not code.startswith(words[0][0]):
                continue
            name = b"".join(words[0])
            given = {letter.decode(): float(number) for letter, number in words[1:]}
            if name in (b"G0", b"G1"):
                yield from self._line(given)
            elif name in (b"G2", b"G3"):
                yield from self._arc(given, clockwise=name == b"G2")
            elif name == b"G28":
                axes = [axis for axis in "XYZ" if axis.encode() in code[3:]] or list("XYZ")
                yield from self._line(dict.fromkeys(axes, 0.0))
            else:
                self._other(name, given)

    def _line(self, given: dict[str, float]) -> Iterator[list[float]]:
        end = self._end(given)
        if "F" in given:
            self._speed = given["F"] / 60.0
        travel = [b - a for a, b in zip(self._position, end, strict=True)]
        self._position = end
        if not any(travel):
            return
        path = math.sqrt(sum(t * t for t in travel[:3]))
        unit = [t / path for t in travel[:3]] if path else [0.0] * 3
        kind = "R" if not path else "P"
        if path and not self._wiping and (travel[3] <= 0.0 or not (travel[0] or travel[1])):
            kind = "T"
        yield self._row(travel, unit, unit, path or abs(travel[3]), 0.0, kind)

    def _arc(self, given: dict[str, float], *, clockwise: bool) -> Iterator[list[float]]:
        if self._rules.arcs == "ignored" or not ("I" in given or "J" in given):
            return
        start, end = self._position, self._end(given)
        if "F" in given:
            self._speed = given["F"] / 60.0
        x, y = start[0] + given.get("I", 0.0), start[1] + given.get("J", 0.0)
        radius = math.hypot(start[0] - x, start[1] - y)
        first = math.atan2(start[1] - y, start[0] - x)
        last = math.atan2(end[1] - y, end[0] - x)
        turn = -1.0 if clockwise else 1.0
        angle = (turn * (last - first)) % (2.0 * math.pi)
        if "P" in given or (start[0] == end[0] and start[1] == end[1]):
            angle = 2.0 * math.pi
        if self._rules.arcs == "pieces":
            step = 2.0 * math.acos(max(1.0 - _ARC_TOLERANCE_MM / max(radius, 1e-9), -1.0))
            count = max(math.ceil(angle / max(step, 1e-9)), 1)
            for k in range(1, count + 1):
                at = first + turn * angle * k / count
                point = [a + (b - a) * k / count for a, b in zip(start, end, strict=True)]
                if k < count:
                    point[:2] = x + radius * math.cos(at), y + radius * math.sin(at)
                yield from self._to(point)
            return
        path = math.hypot(radius * angle, end[2] - start[2])
        travel = [b - a for a, b in zip(start, end, strict=True)]
        self._position = end
        if path == 0.0:
            return
        # An arc is limited as if it went along X and along Y at once.
        flat = radius * angle
        along = [flat, flat, travel[2], 0.0]
        enter = [-turn * math.sin(first), turn * math.cos(first), 0.0]
        at_end = first + turn * angle
        leave = [-turn * math.sin(at_end), turn * math.cos(at_end), 0.0]
        yield self._row(along, enter, leave, path, radius, "P" if travel[3] else "T")

    def _to(self, point: list[float]) -> Iterator[list[float]]:
        absolute, self._absolute = self._absolute, True
        relative, self._absolute_e = self._absolute_e, True
        words = {
            axis: value - o for axis, value, o in zip("XYZE", point, self._origin, strict=True)
        }
        yield from self._line(words)
        self._absolute, self._absolute_e = absolute, relative

    def _row(
        self,
        travel: list[float],
        enter: list[float],
        leave: list[float],
        length: float,
        radius: float,
        kind: str,
    ) -> list[float]:
        accel = self._accel
        stop, self._stop = self._stop, False
        state = [self._speed, accel[kind], accel["P"], self._flow, float(stop)]
        limits = [*self._max_accel, *self._max_speed, *self._jerk]
        return [*travel, *enter, *leave, length, radius, *state, *limits]

    def _end(self, given: dict[str, float]) -> list[float]:
        end = list(self._position)
        for k, axis in enumerate("XYZE"):
            if axis in given:
                absolute = self._absolute and (k < 3 or self._absolute_e)
                end[k] = (self._origin[k] if absolute else end[k]) + given[axis]
        return end

    def _other(self, name: bytes, given: dict[str, float]) -> None:
        if name in (b"G90", b"G91"):
            self._absolute = name == b"G90"
        elif name in (b"M82", b"M83"):
            self._absolute_e = name == b"M82"
        elif name == b"G92":
            for k, axis in enumerate("XYZ"):
                if axis in given:
                    self._origin[k] = self._position[k] - given[axis]
            if "E" in given:
                self._position[3] = given["E"]
            else:
                self._stop = True
        elif name == b"M204":
            self._accelerations(given)
        elif name in (b"M201", b"M203", b"M205", b"M566"):
            self._limits(name, given)
        elif name == b"M221" and "S" in given and "T" not in given:
            self._flow = given["S"] / 100.0
        elif name == b"M1" or (name.startswith(b"T") and name[1:] != self._tool):
            self._stop = True
            self._tool = name[1:] if name.startswith(b"T") else self._tool
        elif self._rules.waits and name in (b"G4", b"M400"):
            self._stop = True
            self.waited_s += given.get("S", 0.001 * given.get("P", 0.0))
        elif self._rules.waits and name == b"M191" and given.get("S", 0.0) > 40.0:
            self._stop = True
            self.waited_s += _CHAMBER_WAIT_S

    def _accelerations(self, given: dict[str, float]) -> None:
        wanted = {kind: given[kind] for kind in "PRT" if kind in given}
        if "S" in given:
            wanted = {"P": given["S"], "T": given["S"]}
            if "T" in given:
                wanted["R"] = given["T"]
        for kind, value in wanted.items():
            cap = self._caps[kind]
            self._accel[kind] = min(value, cap) if cap else value

    def _limits(self, name: bytes, given: dict[str, float]) -> None:
        values, factor = self._jerk, 1.0
        if name == b"M201":
            values = self._max_accel
        elif name == b"M203":
            values = self._max_speed
            per_minute = self._flavor not in ("marlin", "marlin2", "klipper", "smoothie")
            factor = 1.0 / 60.0 if per_minute else 1.0
        elif name == b"M566":
            factor = 1.0 / 60.0
        elif "X" in given:
            given.setdefault("Y", given["X"])
        for k, axis in enumerate("XYZE"):
            if axis in given:
                values[k] = factor * given[axis]

    def _klipper_limits(self, code: bytes) -> None:
        for key, number in _KLIPPER_LIMIT.findall(code):
            if key == b"ACCEL":
                self._accelerations({"S": float(number)})
            elif key == b"VELOCITY":
                self._max_speed[:2] = [float(number)] * 2
            else:
                self._jerk[:2] = [float(number)] * 2


def _limit(facts: SlicerFacts, *keys: str) -> float:
    return facts.number(*keys) or 0.0
