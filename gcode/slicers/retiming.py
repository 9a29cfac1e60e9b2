"""Update the times that the slicer wrote into the file to those of the new motion.

The slicer counts what we do not plan (heating, homing, changes of filament) and has its own
planner. Its times are therefore kept, and only the additional time of the written motion is added:
at every place the delay accumulated so far. A shift of the last second changes no line.
"""

from __future__ import annotations

import re
from array import array
from bisect import bisect_left
from collections.abc import Iterator, Mapping
from functools import lru_cache
from heapq import merge
from typing import TYPE_CHECKING, BinaryIO, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillpath.gcode.pieces import VerbatimPart
from stillpath.gcode.slicers.marks import MarkKind, read_mark
from stillpath.gcode.slicers.times import TimeField, TimeKind, may_tell_time, read_times

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

__all__ = ["Retiming", "behind_last_command", "retimed"]

_COPIED_BYTES = 1 << 20
_COMMENTS = re.compile(rb"(?:\xef\xbb\xbf)?(?:[ \t\r]*(?:;[^\n]*)?\n)*")
_COMMAND = re.compile(rb"^[ \t\r\f\v]*(?:[^\s;]|; stillpath)[^\n]*\n?", re.MULTILINE)
_LOOKED_THROUGH_BYTES = 1 << 16
_STOPS = (MarkKind.COLOR_CHANGE, MarkKind.PAUSE)
_BEGINS, _TELLS = (np.isin(np.arange(256), list(found)) for found in (b";M \t", b"TPRemfCE- "))
"""Possible first bytes of a line that states times, and those after its semicolon."""


class Retiming:
    """Records a text while it is written, then copies it with new times.

    A line that states times is stored as three numbers, and read again when the text is copied.

    Parameters
    ----------
    head, tail : bytes
        Lines of ours to insert before the first command and after the last one. The comments around
        stay at the very ends of the file, where slicers and hosts look for them.
    keep_times : bool
        Change no time.
    """

    def __init__(self, head: bytes = b"", tail: bytes = b"", *, keep_times: bool = False) -> None:
        self._head, self._tail = head, tail
        self._keeps = keep_times
        self._places, self._stops = _Places(), _Places()
        self._told_s: dict[tuple[TimeKind, bool], float] = {}
        """The longest time of every kind, and whether it is of the silent mode."""
        self._size = self._added_lines = 0
        self._head_end: int | None = None
        self._tail_start = 0
        self._tail_lead = b""
        self._layer_delay_s: float | None = None
        """Delay where the second layer begins."""

    def push(self, text: bytes, item: VerbatimPart | None = None, delay_s: ArrayLike = 0.0) -> None:
        """Take the next part of the written text.

        Parameters
        ----------
        item : VerbatimPart, optional
            The lines that came, whose times are looked for in the text.
        delay_s : float or array_like, shape (n + 1,)
            How much later than in the original each move of the item begins, and the item ends.
        """
        if self._head_end is None:
            leading = _COMMENTS.match(text)
            end = leading.end() if leading is not None else 0
            if end < len(text):
                self._head_end = self._size + end
        if end := behind_last_command(text):
            self._tail_start = self._size + end
            self._tail_lead = b"" if text[end - 1 : end] == b"\n" else b"\n"
        if item is not None and not self._keeps:
            self._note(text, item, np.broadcast_to(delay_s, (len(item.moves) + 1,)))
        self._size += len(text)
        self._added_lines += text.count(b"\n") - (item.text.count(b"\n") if item else 0)

    def end(self, lines: bytes) -> int:
        """Insert more lines of ours behind the last command, before the tail; return their size."""
        self._tail = lines + self._tail
        return len(lines)

    def copy(self, source: BinaryIO, target: SupportsWrite[bytes], delay_s: float) -> int:
        """Copy the text, with the new times in it.

        Parameters
        ----------
        source : BinaryIO
            What was pushed, at its beginning.
        target : file to write to
        delay_s : float
            How much later the print ends.

        Returns
        -------
        int
            Bytes written.
        """
        tail = self._tail_lead + self._tail if self._tail else b""
        lines = self._added_lines + (self._head + tail).count(b"\n")
        times = _Times(self._told_s, self._stops, self._layer_delay_s, delay_s, lines)
        ours: list[tuple[int, int, bytes | float]] = [
            (self._size if self._head_end is None else self._head_end, 0, self._head),
            (self._tail_start, 0, tail),
        ]
        done = written = 0
        for offset, length, what in merge(
            sorted(ours, key=lambda edit: edit[:2]), self._places, key=lambda edit: edit[:2]
        ):
            written += _copy(source, target, offset - done)
            if isinstance(what, bytes):
                target.write(what)
                written += len(what)
            else:
                line = times.line(source.read(length), offset, what)
                target.write(line)
                written += len(line)
            done = offset + length
        return written + _copy(source, target, self._size - done)

    def _note(self, text: bytes, item: VerbatimPart, delay_s: NDArray[np.float64]) -> None:
        if self._layer_delay_s is None:
            second = np.flatnonzero(item.moves.layer >= 1)
            if len(second):
                self._layer_delay_s = float(delay_s[second[0]])
        at = 0
        for row in _candidates(item):
            line = item.line(item.events, row)
            kind = _line_kind(line)
            if kind is None:
                continue
            found = _find_line(text, line, at)
            if found < 0:
                continue
            at = found + len(line)
            into = self._stops if kind == "stop" else self._places
            late_s = float(delay_s[int(item.events.move_index[row])])
            into.append(self._size + found, len(line), late_s)
            for field in read_times(line) if kind == "time" else ():
                key = field.kind, field.silent
                self._told_s[key] = max(self._told_s.get(key, 0.0), field.seconds)


class _Places:
    """Lines of the written text: where each begins, its bytes, how much later it comes."""

    def __init__(self) -> None:
        self.offset, self._length, self.delay_s = array("q"), array("l"), array("d")

    def append(self, offset: int, length: int, delay_s: float) -> None:
        self.offset.append(offset)
        self._length.append(length)
        self.delay_s.append(delay_s)

    def __iter__(self) -> Iterator[tuple[int, int, float]]:
        return zip(self.offset, self._length, self.delay_s, strict=True)


class _Times:
    """New times for the lines of one file."""

    def __init__(
        self,
        told_s: Mapping[tuple[TimeKind, bool], float],
        stops: _Places,
        second_layer_delay_s: float | None,
        delay_s: float,
        added_lines: int,
    ) -> None:
        self._stops, self._added_lines = stops, added_lines
        self._delay_s = delay_s
        self._first_layer_delay_s = (
            delay_s if second_layer_delay_s is None else second_layer_delay_s
        )
        self._total_s = {silent: _total(told_s, silent=silent) for silent in (False, True)}

    def line(self, line: bytes, offset: int, late_s: float) -> bytes:
        """Return the line at `offset` with its times updated; it comes `late_s` later."""
        written, done = b"", 0
        for field in read_times(line):
            written += line[done : field.start] + field.written(self._time(field, offset, late_s))
            done = field.end
        return written + line[done:]

    def _time(self, field: TimeField, offset: int, late_s: float) -> float:
        match field.kind:
            case TimeKind.TOTAL:
                return field.seconds + self._delay_s
            case TimeKind.FIRST_LAYER:
                return field.seconds + self._first_layer_delay_s
            case TimeKind.ELAPSED:
                return field.seconds + late_s
            case TimeKind.REMAINING:
                return field.seconds + self._delay_s - late_s
            case TimeKind.LINES:
                return field.seconds + self._added_lines
            case TimeKind.UNTIL_STOP:
                stop = bisect_left(self._stops.offset, offset)
                if stop == len(self._stops.offset):
                    return field.seconds
                return field.seconds + self._stops.delay_s[stop] - late_s
        total_s = self._total_s[field.silent] or self._total_s[not field.silent]
        if not total_s or total_s + self._delay_s <= 0.0:
            return field.seconds
        elapsed_s = 0.01 * field.seconds * total_s + late_s
        return min(100.0 * elapsed_s / (total_s + self._delay_s), 100.0)


def retimed(text: bytes, delay_s: float) -> bytes:
    """Return metadata, lines that tell times of the whole print, for one that takes longer."""
    lines = []
    for line in text.splitlines(keepends=True):
        told = [field for field in read_times(line) if field.kind is TimeKind.TOTAL]
        done = 0
        for field in told:
            lines += [line[done : field.start], field.written(field.seconds + delay_s)]
            done = field.end
        lines.append(line[done:])
    return b"".join(lines)


def _total(told_s: Mapping[tuple[TimeKind, bool], float], *, silent: bool) -> float:
    """Return the slicer's estimate of the print time; 0 if there is none."""
    for wanted in (TimeKind.TOTAL, TimeKind.ELAPSED, TimeKind.REMAINING):
        if (wanted, silent) in told_s:
            return told_s[wanted, silent]
    return 0.0


@lru_cache(maxsize=256)
def _line_kind(line: bytes) -> Literal["time", "stop"] | None:
    """Return whether a line states times or marks a stop; cached, as slicers repeat lines."""
    if may_tell_time(line) and read_times(line):
        return "time"
    mark = read_mark(line.decode("latin-1")) if line[:1] == b";" else None
    return "stop" if mark is not None and mark.kind in _STOPS else None


def _candidates(item: VerbatimPart) -> NDArray[np.int64]:
    """Rows of the events whose lines may be worth reading."""
    events = item.events
    if len(events) == 0 or not item.text:
        return np.zeros(0, np.int64)
    text = np.frombuffer(item.text, np.uint8)
    start = events.byte_start - item.text_offset
    last = len(text) - 1
    rows = np.flatnonzero(_BEGINS[text[np.minimum(start, last)]])
    first, second, third = (text[np.minimum(start[rows] + k, last)] for k in range(3))
    letter = np.where(second == ord(" "), third, second)
    comment = (first == ord(";")) & _TELLS[letter]
    progress = (first == ord("M")) & (second == ord("7")) & (third == ord("3"))
    indented = (first == ord(" ")) | (first == ord("\t"))
    return np.asarray(rows[comment | progress | indented])


def behind_last_command(text: bytes) -> int:
    """Return the end of the last line that is not a comment of others; 0 if there is none."""
    end, width = len(text), 128
    while end > 0:
        # It is usually near the end, but thumbnails and settings may have thousands of lines.
        start = text.rfind(b"\n", 0, max(end - width, 0)) + 1
        ends = [line.end() for line in _COMMAND.finditer(text, start, end)]
        if ends:
            return ends[-1]
        end, width = start, min(2 * width, _LOOKED_THROUGH_BYTES)
    return 0


def _find_line(text: bytes, line: bytes, at: int) -> int:
    """Return where a whole line stands in a text from `at` on, or -1."""
    while True:
        found = text.find(line, at)
        if found <= 0 or text[found - 1 : found] == b"\n":
            return found
        at = found + 1


def _copy(source: BinaryIO, target: SupportsWrite[bytes], count: int) -> int:
    left = count
    while left > 0:
        data = source.read(min(left, _COPIED_BYTES))
        if not data:
            break
        target.write(data)
        left -= len(data)
    return count - left
