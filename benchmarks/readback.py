"""What a print file makes the machine do, read from the bytes alone, and the judge of that motion.

Shared by the benchmarks. Nothing here knows how a file was made: a file is interpreted, planned by
the firmware's rules and sampled at 10 kHz, and the continuous plants answer that motion.
"""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Self, TypeVar

import numpy as np

from stillpath.compensation.shapers import shape_xy
from stillpath.gcode.firmware.planning import STOPPING, intended, join_phases
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.sampler import sample_phases
from stillpath.gcode.types import Moves, Phases
from stillpath.models.arrays import Array, Ints, Mask
from stillpath.models.machine import Machine
from stillpath.models.plants import plant_set
from stillpath.models.shaper_pulses import Pulses
from stillpath.simulation.measures import PathDistances, Tally
from stillpath.simulation.response import PlantStream

__all__ = [
    "DT_S",
    "Aligned",
    "Judge",
    "Motion",
    "Own",
    "ReadBackError",
    "Shaped",
    "Timed",
    "forced_stops",
    "read_motion",
]

T = TypeVar("T", Moves, Phases)

DT_S = 1e-4
WINDOW_S = 0.08
_CONTOUR_EVERY, _MEMBER_EVERY = 20, 4
_BLOCK = 200_000
_READ_BYTES = 1 << 20
_SAME_MM, _SAME_E_MM = 1e-4, 5e-3
_LOST = 3
_JUMP_MM = 0.2
"""Places that are whole motor steps are not jumps."""
_SHAPER_REACH_S = 0.15
_LONGER_S, _ROUNDS = 5e-4, 4
_STOPPING = np.array([int(kind) for kind in sorted(STOPPING)])


class ReadBackError(RuntimeError):
    """The written file does not do what the original does."""


@dataclass(frozen=True, slots=True)
class Motion:
    """The motion of a whole file.

    Attributes
    ----------
    phases : Phases
        `move_index` counts the moves of the file.
    asked : Phases
        The same without the firmware's rounding to motor steps.
    end_mm : ndarray, shape (moves, 4)
        Where each move ends.
    line : ndarray of int64, shape (moves,)
    stops : ndarray of int64, shape (stops,)
        Number of moves before each line that stops the machine, rising.
    time_s : float
        From the first move to the last, dwells included.
    """

    phases: Phases
    asked: Phases
    end_mm: Array
    line: Ints
    stops: Ints
    time_s: float

    def stretches(self) -> tuple[Ints, Ints]:
        """First and last row of `phases` of each unbroken motion in X and Y."""
        phases = self.phases
        xy = phases.moves_xy
        stopped = np.searchsorted(self.stops, phases.move_index, "right")
        begins = xy & np.append(True, ~xy[:-1] | (np.diff(stopped) > 0))
        begins[self.jumps()] = xy[self.jumps()]
        ends = xy & np.append(begins[1:] | ~xy[1:], True)
        return np.flatnonzero(begins), np.flatnonzero(ends)

    def jumps(self) -> Ints:
        """Rows of `phases` before which the position changes without a motion (homing)."""
        before = self.end_mm[self.phases.move_index[:-1], :2]
        away = np.max(np.abs(self.phases.start_mm[1:, :2] - before), axis=1)
        return np.flatnonzero(away > _JUMP_MM) + 1


def read_motion(path: Path, machine: Machine, forced: Sequence[int] = ()) -> Motion:
    """Interpret and plan a file.

    Parameters
    ----------
    forced : sequence of int
        Rising numbers of moves after which the machine stops although the file does not say so.
    """
    reader, planner = Interpreter(machine), adapter(machine).planner()
    parts: list[Phases] = []
    ends: list[Array] = []
    starts: list[Array] = []
    lines: list[Ints] = []
    stops: list[Ints] = [np.array(forced, dtype=np.int64)]
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        while True:
            data = file.read(_READ_BYTES)
            for block in reader.push(data) if data else reader.flush():
                events, first, n = block.events, block.first_move, len(block.moves)
                rows = np.flatnonzero(np.isin(events.kind, _STOPPING))
                stops.append(events.move_index[rows])
                here = [
                    (int(events.move_index[row]) - first, float(events.dwell_s[row]))
                    for row in rows.tolist()
                ]
                here += [(k - first, 0.0) for k in forced if first <= k < first + n]
                done = 0
                for at, dwell_s in sorted(here):
                    parts.append(planner.push_moves(_rows(block.moves, done, at), block.limits))
                    parts.append(planner.stop(dwell_s))
                    done = at
                parts.append(planner.push_moves(_rows(block.moves, done, n), block.limits))
                ends.append(block.moves.end_mm.copy())
                starts.append(block.moves.start_mm.copy())
                lines.append(block.moves.line.copy())
            if not data:
                break
    parts.append(planner.flush())
    phases, end_mm = join_phases(parts), np.concatenate(ends)
    return Motion(
        phases=phases,
        asked=intended(phases, np.concatenate(starts), end_mm, adapter(machine).step_mm),
        end_mm=end_mm,
        line=np.concatenate(lines),
        stops=np.sort(np.concatenate(stops)),
        time_s=planner.time_s,
    )


def forced_stops(original: Motion, written: Motion) -> list[int]:
    """Find where the written file stops: numbers of moves of the original, rising.

    A stop is found by its place: the next move of the original that ends at the same X Y Z and the
    same amount of filament.
    """
    found: list[int] = []
    at = 0
    places = written.end_mm[np.unique(written.stops[written.stops > 0]) - 1]
    for place in places:
        row = _next_match(original.end_mm, place, at)
        if row is None:
            raise ReadBackError(f"the written file stops at {place}, where the original never is")
        at = row
        found.append(row + 1)
    return sorted(set(found))


class Timed:
    """A motion between two jumps of position, to be judged: what is wanted and what is commanded.

    Times count from the start of the section on the 10 kHz grid.
    """

    samples: int

    def path(self, first: int, last: int) -> tuple[Array, Mask]:
        """Planned X Y of the samples [first, last), and where they extrude."""
        raise NotImplementedError

    def command(self, first: int, last: int) -> Array:
        """X Y of the commanded motion."""
        raise NotImplementedError


class Own(Timed):
    """A file as it is: commanded is what is planned, but for the rounding to motor steps."""

    def __init__(self, motion: Motion, first_row: int, last_row: int) -> None:
        self._phases = _rows(motion.phases, first_row, last_row)
        self._asked = _rows(motion.asked, first_row, last_row)
        self._start_s = float(self._phases.t_s[0])
        self._end_s = motion.phases.end_s[first_row:last_row]
        self.samples = int(np.ceil((self._end_s[-1] - self._start_s) / DT_S)) + 1

    @classmethod
    def sections(cls, motion: Motion) -> list[Self]:
        """All sections of a file."""
        bounds = [0, *motion.jumps().tolist(), len(motion.phases)]
        return [cls(motion, a, b) for a, b in pairwise(bounds)]

    def path(self, first: int, last: int) -> tuple[Array, Mask]:
        t_s: Array = self._start_s + DT_S * np.arange(first, last, dtype=np.float64)
        phases, offset = _around(self._asked, t_s)
        position, row = sample_phases(phases, t_s)
        moving = t_s <= self._end_s[offset + row]
        return position[:2], moving & phases.moves_xy[row] & (phases.direction[row, 3] > 0.0)

    def command(self, first: int, last: int) -> Array:
        t_s: Array = self._start_s + DT_S * np.arange(first, last, dtype=np.float64)
        return sample_phases(_around(self._phases, t_s)[0], t_s)[0][:2]


class Shaped(Own):
    """A file as it is, driven through the firmware's shapers of X and Y."""

    pulses: Sequence[Pulses]

    @classmethod
    def through(cls, motion: Motion, pulses: Sequence[Pulses]) -> list[Self]:
        """All sections of a file, driven through a shaper each for X and Y."""
        sections = cls.sections(motion)
        for section in sections:
            section.pulses = pulses
        return sections

    def command(self, first: int, last: int) -> Array:
        reach = round(_SHAPER_REACH_S / DT_S)
        own = super().command(first - reach, last + reach)
        return shape_xy(own, DT_S, self.pulses)[:, reach:-reach]


class Aligned(Timed):
    """A written file against the original's path, laid on the written file's time.

    Both files consist of stretches of X Y motion between the same rests. A stretch of the original
    starts when the written one starts and runs in its own time; then the path stands still until
    the next stretch starts. Where the written one lasts longer, the path stands for the part of
    that time with which both are nearest. `original` must be planned with the written file's stops.
    """

    def __init__(self, original: Motion, written: Motion) -> None:
        self._path, self._written = original.asked, written.phases
        self.original_rows, self.written_rows = _match(original, written)
        ends = original.phases.end_s
        self._from_s = self._path.t_s[self.original_rows[0]]
        self._until_s = ends[self.original_rows[1]]
        self._begin_s = written.phases.t_s[self.written_rows[0]]
        self._begin_s = self._begin_s + self._standing_s(written.phases.end_s)
        self._start_s = 0.0
        self._last_s = written.time_s
        self.samples = int(np.ceil(written.time_s / DT_S)) + 1

    def _standing_s(self, end_s: Array) -> Array:
        """Standing time before each stretch."""
        stands = np.zeros(len(self._begin_s))
        begin_s, lasts_s = self._begin_s, self._until_s - self._from_s
        longer_s = end_s[self.written_rows[1]] - begin_s - lasts_s
        for k in np.flatnonzero((longer_s > _LONGER_S) & (lasts_s > _LONGER_S)):
            (a, b), (c, d) = (
                (int(rows[0][k]), int(rows[1][k]) + 1)
                for rows in (self.written_rows, self.original_rows)
            )
            written, plan = _rows(self._written, a, b), _rows(self._path, c, d)
            since_s = np.arange(0.0, lasts_s[k] + longer_s[k], _LONGER_S)
            command = sample_phases(written, begin_s[k] + since_s)[0][:2]
            stands[k] = _stands_s(plan, since_s, command, longer_s[k])
        return stands

    def sections(self, original: Motion, written: Motion) -> list[Aligned]:
        """Cut at the jumps of the written file's position."""
        jumps = written.jumps()
        if len(jumps) != len(original.jumps()):
            raise ReadBackError("the written file loses its position elsewhere")
        ends = written.phases.end_s
        bounds = [0, *jumps.tolist(), len(written.phases)]
        parts = []
        for a, b in pairwise(bounds):
            inside = (self.written_rows[0] >= a) & (self.written_rows[0] < b)
            if not inside.any():
                continue
            part = object.__new__(type(self))
            part._path, part._written = self._path, _rows(written.phases, a, b)
            part._from_s, part._until_s = self._from_s[inside], self._until_s[inside]
            part._begin_s = self._begin_s[inside]
            part._start_s, part._last_s = float(written.phases.t_s[a]), float(ends[b - 1])
            part.samples = int(np.ceil((part._last_s - part._start_s) / DT_S)) + 1
            parts.append(part)
        return parts

    def path(self, first: int, last: int) -> tuple[Array, Mask]:
        t_s: Array = self._start_s + DT_S * np.arange(first, last, dtype=np.float64)
        k = np.maximum(np.searchsorted(self._begin_s, t_s, "right") - 1, 0)
        since_s = t_s - self._begin_s[k]
        wanted_s = self._from_s[k] + np.maximum(since_s, 0.0)
        moving = wanted_s < self._until_s[k]
        # Just before the end; a sample may be nearer to it than that.
        wanted_s = np.where(moving, wanted_s, self._until_s[k] - 1e-9)
        wanted_s = np.maximum.accumulate(wanted_s)
        moving &= since_s >= 0.0
        phases, _ = _around(self._path, wanted_s)
        position, row = sample_phases(phases, wanted_s)
        return position[:2], moving & phases.moves_xy[row] & (phases.direction[row, 3] > 0.0)

    def command(self, first: int, last: int) -> Array:
        t_s: Array = self._start_s + DT_S * np.arange(first, last, dtype=np.float64)
        return sample_phases(_around(self._written, t_s)[0], t_s)[0][:2]


class Judge:
    """Add up the errors of the continuous plants over the sections of a motion.

    A firmware that plans in steps moves its motors by whole steps, whoever made the command.

    The nominal plant answers at 10 kHz, the members at 2.5 kHz to save time (in four cases the
    members' ratio to the shaper moved by at most .001). Contour error: distance to the path within
    80 ms, every 2 ms (members 8 ms) of extruding motion. Tracking error: every sample that
    extrudes. Second difference of the command: 1 kHz, all motion.

    Attributes
    ----------
    contour : Tally
        In mm, as all tallies.
    members : list of Tally
        Contour error of each member.
    tracking, bend : Tally
        `bend` is the second difference of the commanded X Y.
    worst_s : float
        Where in its section the contour error is largest.
    """

    def __init__(self, machine: Machine, *, members: bool) -> None:
        axes = [machine.axes[axis] for axis in ("x", "y")]
        self._nominal = [plant_set(axis, DT_S).nominal for axis in axes]
        sets = [plant_set(axis, _MEMBER_EVERY * DT_S).members for axis in axes]
        self._pairs = list(zip(*sets, strict=False)) if members else []
        self._step_mm = max(adapter(machine).step_mm[:2])
        self._corexy = machine.kinematics == "corexy"
        self.contour, self.tracking, self.bend = Tally(), Tally(), Tally()
        self.members = [Tally() for _ in self._pairs]
        self.worst_s = 0.0

    def add(self, motion: Timed) -> None:
        """Judge one section, from rest."""
        nominal, members = PlantStream(self._nominal), [PlantStream(pair) for pair in self._pairs]
        window, n, every = round(WINDOW_S / DT_S), motion.samples, _MEMBER_EVERY
        tail = np.zeros((2, 0))
        for k0 in range(0, n, _BLOCK):
            k1 = min(n, k0 + _BLOCK)
            a, b = max(0, k0 - window), min(n, k1 + window)
            path, extruding = motion.path(a, b)
            u = self._stepped(motion.command(k0, k1))
            coarse = np.hstack([tail, u[:, ::10]])
            bend = np.diff(coarse, 2)
            self.bend.add(np.hypot(bend[0], bend[1]))
            tail = coarse[:, -2:]
            use = extruding[k0 - a : k1 - a]
            y = nominal.push(u)
            miss = y - path[:, k0 - a : k1 - a]
            self.tracking.add(np.hypot(miss[0], miss[1]), use)
            at = np.flatnonzero(use[::_CONTOUR_EVERY]) * _CONTOUR_EVERY
            error = PathDistances(path, DT_S, WINDOW_S).at(y[:, at], at + (k0 - a))
            if len(at) and error.max() > self.contour.max:
                self.worst_s = DT_S * (k0 + int(at[np.argmax(error)]))
            self.contour.add(error)
            step = every * _CONTOUR_EVERY
            at = np.flatnonzero(use[::step]) * _CONTOUR_EVERY
            path, u = path[:, ::every].copy(), u[:, ::every].copy()
            for stream, tally in zip(members, self.members, strict=True):
                y = stream.push(u)
                index = at + (k0 - a) // every
                tally.add(PathDistances(path, every * DT_S, WINDOW_S).at(y[:, at], index))

    def _stepped(self, u: Array) -> Array:
        """Command as the motors stand: on whole steps, where the firmware plans in steps."""
        if self._step_mm == 0.0:
            return u
        if not self._corexy:
            return np.asarray(self._step_mm * np.round(u / self._step_mm))
        motors = np.stack([u[0] + u[1], u[0] - u[1]])
        a, b = self._step_mm * np.round(motors / self._step_mm)
        return 0.5 * np.stack([a + b, a - b])

    @property
    def members_rms_mm(self) -> float:
        """Mean of the members' contour rms."""
        return float(np.mean([tally.rms for tally in self.members]))


def _stands_s(plan: Phases, since_s: Array, command: Array, most_s: float) -> float:
    """Time for which a plan stands before it moves, by least squares to a command (2, n)."""

    def path(stands_s: float) -> Array:
        return sample_phases(plan, plan.t_s[0] + np.maximum(since_s - stands_s, 0.0))[0][:2]

    found_s = 0.5 * most_s
    for _ in range(_ROUNDS):
        wanted = path(found_s)
        speed = np.gradient(wanted, since_s, axis=1)
        step_s = np.sum((wanted - command) * speed) / max(np.sum(speed**2), 1e-12)
        found_s = float(np.clip(found_s + step_s, 0.0, most_s))
    without, shifted = (np.sum((path(stands_s) - command) ** 2) for stands_s in (0.0, found_s))
    return found_s if shifted < without else 0.0


def _match(original: Motion, written: Motion) -> tuple[tuple[Ints, Ints], tuple[Ints, Ints]]:
    """Pair the stretches of both files by where they end; return their first and last rows."""
    ours, theirs = written.stretches(), original.stretches()
    ends_w = written.end_mm[written.phases.move_index[ours[1]]]
    ends_o = original.end_mm[original.phases.move_index[theirs[1]]]
    if len(ends_w) == len(ends_o) and bool(np.all(_same(ends_w, ends_o))):
        return theirs, ours
    pairs: list[tuple[int, int, int, int]] = []
    at, first = 0, 0
    for k, place in enumerate(ends_o):
        row = _next_match(ends_w, place, at)
        if row is None:
            # The written file does not rest here: this stretch and the next are one.
            if k - first >= _LOST or k == len(ends_o) - 1:
                line = int(original.line[original.phases.move_index[theirs[1][k]]])
                raise ReadBackError(f"the written file never comes to {place} (line {line})")
            continue
        pairs.append((theirs[0][first], theirs[1][k], ours[0][at], ours[1][row]))
        at, first = row + 1, k + 1
    rows = np.array(pairs, dtype=np.int64).T
    return (rows[0], rows[1]), (rows[2], rows[3])


def _next_match(places: Array, wanted: Array, start: int) -> int | None:
    size = 1000
    while start < len(places):
        rows = np.flatnonzero(_same(places[start : start + size], wanted))
        if len(rows):
            return start + int(rows[0])
        start += size
        size *= 4
    return None


def _same(places: Array, wanted: Array) -> Mask:
    gap = np.abs(places - wanted)
    return np.asarray(np.all(gap[:, :3] < _SAME_MM, axis=1) & (gap[:, 3] < _SAME_E_MM))


def _around(phases: Phases, t_s: Array) -> tuple[Phases, int]:
    """Rows needed for ascending times, and the number of the first of them."""
    first = max(int(np.searchsorted(phases.t_s, t_s[0], "right")) - 1, 0)
    last = max(int(np.searchsorted(phases.t_s, t_s[-1], "right")), first + 1)
    return _rows(phases, first, last), first


def _rows(table: T, first: int, last: int) -> T:
    return replace(table, **{f.name: getattr(table, f.name)[first:last] for f in fields(table)})
