"""Hatches of scanning (laser) machines: straight moves with the beam on or off, and their samples.

A galvo has no planner: it draws every G1 at its F, and between lines it jumps and waits until the
mirrors have settled. Words as laser senders and slicers write them: G0 G1 X Y F, motion modal, M3
or M4 and M5 with a power S for the beam, or, in files without those, an extruder that moves on. Z
is ignored.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.lexer import split_classic
from stillpath.models.arrays import Array

__all__ = ["Hatches", "ScanSamples", "Timing", "read_hatches", "sample_hatches"]

_INCH_MM = 25.4
_TURN_COSINE = math.cos(math.radians(45))
_IGNORED = frozenset(
    {"G17", "G21", "G40", "G49", "G54", "G80", "G94", "M2", "M7", "M8", "M9", "M30"}
    | {"M106", "M107", "M117", "M118"}
)
_MOTION = frozenset({"G0", "G1", "G2", "G3", "G92"})
_MOST_MOVES = 1_000_000
_MOST_SAMPLES = 5_000_000
_COMMENT = re.compile(r"\([^)]*(?:\)|$)")
_LINE_END = re.compile(r"\r\n?|\n")
_CODES = re.compile(r"(?<![A-Z_])([GM]) *0*(\d+)")


@dataclass(frozen=True, slots=True, eq=False)
class Hatches:
    """Straight moves in file order.

    Attributes
    ----------
    start_mm, end_mm : ndarray, shape (n, 2)
    speed_mm_s : ndarray, shape (n,)
        F; 0 for G0, which jumps as fast as the machine does.
    beam : ndarray of bool, shape (n,)
    dwell_s : ndarray, shape (n,)
        Standing time after the move (G4).
    line : ndarray of int64, shape (n,)
    passed_over : tuple of str
        Commands that mean nothing here.
    """

    start_mm: Array
    end_mm: Array
    speed_mm_s: Array
    beam: NDArray[np.bool_]
    dwell_s: Array
    line: NDArray[np.int64]
    passed_over: tuple[str, ...]

    def tracks(self) -> NDArray[np.int64]:
        """Return the track of every move, shape (n,): -1 with the beam off.

        A track goes on while the beam stays on and the path does not turn by more than 45 degrees.
        """
        out = np.full(len(self.line), -1, np.int64)
        ways = self.end_mm - self.start_mm
        lengths = np.hypot(*ways.T)
        count, before = -1, -1
        for i in np.flatnonzero(self.beam & (lengths > 0)):
            joined = before >= 0 and bool(np.all(self.beam[before : i + 1]))
            straight = joined and float(ways[i] @ ways[before]) >= (
                _TURN_COSINE * lengths[i] * lengths[before]
            )
            count += not straight
            out[i], before = count, int(i)
        return out


@dataclass(frozen=True, slots=True)
class Timing:
    """How a scanner moves between lines.

    Attributes
    ----------
    jump_mm_s : float
        Speed with the beam off, where the file does not say less.
    settle_s : float
        Wait at the end of a jump.
    lead_s : float
        Standing time before the first and after the last move, at least.
    """

    jump_mm_s: float = 2000.0
    settle_s: float = 0.5e-3
    lead_s: float = 2e-3


@dataclass(frozen=True, slots=True, eq=False)
class ScanSamples:
    """Hatches at the rate of a loop.

    Attributes
    ----------
    t_s : ndarray, shape (n,)
    xy_mm : ndarray, shape (2, n)
    track : ndarray of int64, shape (n,)
        -1 with the beam off.
    """

    t_s: Array
    xy_mm: Array
    track: NDArray[np.int64]


def read_hatches(text: str) -> Hatches:
    """Read the moves of a file.

    Raises
    ------
    GcodeError
        With the line: a number that is none, a G1 without a speed, an arc; or if the file marks
        nothing.
    """
    reader = _Reader(text)
    for number, line in enumerate(_LINE_END.split(text), 1):
        reader.take(number, line)
    return reader.hatches()


def sample_hatches(hatches: Hatches, dt_s: float, timing: Timing) -> ScanSamples:
    """Return the path at constant speed along every move, sampled every `dt_s`.

    Raises
    ------
    GcodeError
        If there would be more than five million.
    """
    lengths = np.hypot(*(hatches.end_mm - hatches.start_mm).T)
    jumps = ~hatches.beam
    speed = np.where(
        jumps & ((hatches.speed_mm_s == 0) | (hatches.speed_mm_s > timing.jump_mm_s)),
        timing.jump_mm_s,
        hatches.speed_mm_s,
    )
    moving = lengths / speed
    standing = hatches.dwell_s + np.where(jumps & (lengths > 0), timing.settle_s, 0.0)
    ends = timing.lead_s + np.cumsum(moving + standing)
    count = int((ends[-1] + timing.lead_s) / dt_s) + 1
    if count > _MOST_SAMPLES:
        raise GcodeError(
            f"the scan takes {ends[-1]:.4g} s, {count} samples at {1 / dt_s:g} Hz; up to "
            f"{_MOST_SAMPLES} are computed at once: give one layer, or a part of it"
        )
    t: Array = np.arange(count, dtype=np.float64) * dt_s
    starts = ends - standing - moving
    knots = np.stack([starts, starts + moving], 1).ravel()
    xy = np.stack([hatches.start_mm, hatches.end_mm], 1).reshape(-1, 2)
    path = np.array([np.interp(t, knots, xy[:, k]) for k in range(2)])
    move = np.clip(np.searchsorted(starts, t, "right") - 1, 0, None)
    on = (t >= starts[move]) & (t <= starts[move] + moving[move])
    return ScanSamples(t, path, np.where(on, hatches.tracks()[move], -1))


class _Reader:
    """Parser with its state between lines."""

    def __init__(self, text: str) -> None:
        codes = {letter + digits for letter, digits in _CODES.findall(text.upper())}
        self._laser = bool(codes & {"M3", "M4", "M5"})
        self._scale, self._absolute, self._jumping = 1.0, True, True
        self._absolute_e: bool | None = None
        """What M82 or M83 said last; None: neither, so E follows G90 and G91."""
        self._position = np.zeros(2)
        self._origin = np.zeros(2)
        self._speed, self._filament = 0.0, 0.0
        self._spindle, self._power = False, math.nan
        self._rows: list[tuple[float, ...]] = []
        self._passed_over: dict[str, None] = {}

    def take(self, number: int, line: str) -> None:
        plain = _COMMENT.sub(" ", line).split(";", 1)[0].upper()
        command = split_classic(plain)
        words = command.words
        codes = [letter + digits for letter, digits in _CODES.findall(plain)]
        odd = [letter for letter in words if len(letter) > 1]
        if odd:
            if _MOTION & set(codes):
                raise GcodeError(f"cannot read {odd[0]!r} in a move", line=number, text=line)
            self._passed_over[command.name] = None
            return
        for code in codes:
            self._code(code, words, number, line)
        if "S" in words and "G4" not in codes:
            self._power = _number(words, "S", number, line)
        if "F" in words:
            self._speed = self._scale * _number(words, "F", number, line) / 60.0
            if self._speed <= 0:
                raise GcodeError("F must be above 0 mm/min", line=number, text=line)
        if not {"G92", "G4"} & set(codes) and {"X", "Y", "E"} & set(words):
            self._move(words, number, line)

    def _code(self, code: str, words: Mapping[str, str], number: int, line: str) -> None:
        if code in ("G0", "G1"):
            self._jumping = code == "G0"
        elif code in ("M3", "M4", "M5"):
            self._spindle = code != "M5"
        elif code == "G4":
            self._dwell(words, number, line)
        elif code in ("G20", "G21"):
            self._scale = _INCH_MM if code == "G20" else 1.0
        elif code in ("G90", "G91"):
            self._absolute = code == "G90"
        elif code in ("M82", "M83"):
            self._absolute_e = code == "M82"
        elif code == "G92":
            self._shift(words, number, line)
        elif code in ("G2", "G3"):
            raise GcodeError(
                "arcs are not read; let the sender cut them into straight moves",
                line=number,
                text=line,
            )
        elif code not in _IGNORED:
            self._passed_over[code] = None

    def hatches(self) -> Hatches:
        rows = np.array(self._rows).reshape(-1, 8)
        found = Hatches(
            rows[:, 0:2],
            rows[:, 2:4],
            rows[:, 4],
            rows[:, 5] > 0,
            rows[:, 6],
            rows[:, 7].astype(np.int64),
            tuple(self._passed_over),
        )
        lengths = np.hypot(*(found.end_mm - found.start_mm).T)
        if not np.any(found.beam & (lengths > 0)):
            raise GcodeError(
                "the file marks nothing: no G1 with the beam on (M3, S above 0, or E moving on)"
            )
        return found

    def _move(self, words: Mapping[str, str], number: int, line: str) -> None:
        target = self._position.copy()
        for k, axis in enumerate("XY"):
            if axis in words:
                value = self._scale * _number(words, axis, number, line)
                target[k] = value + (self._origin[k] if self._absolute else target[k])
        fed = self._fed(words, number, line)
        beam = not self._jumping and (self._spindle and self._power != 0.0 if self._laser else fed)
        if "X" not in words and "Y" not in words:
            return
        if self._speed == 0.0 and not self._jumping:
            raise GcodeError("G1 before any speed; give an F in mm/min", line=number, text=line)
        if len(self._rows) >= _MOST_MOVES:
            raise GcodeError(
                f"more than {_MOST_MOVES} moves; give one layer", line=number, text=line
            )
        speed = 0.0 if self._jumping else self._speed
        self._rows.append((*self._position, *target, speed, float(beam), 0.0, float(number)))
        self._position = target

    def _shift(self, words: Mapping[str, str], number: int, line: str) -> None:
        for k, axis in enumerate("XY"):
            if axis in words:
                here = self._scale * _number(words, axis, number, line)
                self._origin[k] = self._position[k] - here
        if "E" in words:
            self._filament = _number(words, "E", number, line)

    def _fed(self, words: Mapping[str, str], number: int, line: str) -> bool:
        """Return whether the extruder moves on, in files without a laser's words."""
        if "E" not in words:
            return False
        value = _number(words, "E", number, line)
        absolute = self._absolute if self._absolute_e is None else self._absolute_e
        step = value - self._filament if absolute else value
        self._filament += step
        return step > 0

    def _dwell(self, words: Mapping[str, str], number: int, line: str) -> None:
        wait = 1e-3 * _number(words, "P", number, line) if "P" in words else 0.0
        wait += _number(words, "S", number, line) if "S" in words else 0.0
        if wait < 0:
            raise GcodeError("a dwell must not be negative", line=number, text=line)
        if self._rows:
            *row, dwell, where = self._rows[-1]
            self._rows[-1] = (*row, dwell + wait, where)


def _number(words: Mapping[str, str], letter: str, number: int, line: str) -> float:
    try:
        value = float(words[letter])
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or abs(value) > 1e6:
        raise GcodeError(
            f"{letter} is {words[letter]!r}, not a number up to 1e6", line=number, text=line
        )
    return value
