"""Follow the original and the written file in parallel, comparing them at every shared line.

Outside of streams the written file holds every line of the original. Within one, straight lines of
ours replace its moves of X and Y; all other lines are there in order, or commented out.
The original contains no marks of ours: such files are refused.
"""

from __future__ import annotations

import re
import time
from collections import deque
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from numpy.typing import NDArray

from stillpath.models.machine import Machine
from stillpath.pipeline.last_check import _reader_kernels as at
from stillpath.pipeline.last_check.coverage import Coverage
from stillpath.pipeline.last_check.errors import LastCheckError, shown
from stillpath.pipeline.last_check.original import ALL, Original, Place, Text, Wanted
from stillpath.pipeline.last_check.reader import NAN, Kind, Reader, code_of, is_same
from stillpath.pipeline.last_check.rules import rules_of
from stillpath.pipeline.result import LastCheckFigures

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

__all__ = ["LastCheck"]

_PLACE_MM, _FILAMENT_MM = 1e-5, 1e-4
_MOST_IDLE = 1 << 10
_ON, _HELD = b"; stillpath: stream on", b"; stillpath, held back: "
_OFF = re.compile(rb"; stillpath: stream off(?:, line (\d+) of the original)?\s*$")
_NAMES = ("x", "y", "z", "the extruder", "filament fed", "F", "", "relative", "relative E")
_UNITS = ("mm", "mm", "mm", "mm", "mm", "mm/min", "", "", "")
_ANYWHERE = re.compile(
    rb"G4 P0 ;|M400\b|G1$|(?:SET_VELOCITY_LIMIT|SET_INPUT_SHAPER|M20[1345]|M566|M572|M593|M74|M493"
    rb"|M900|M97[45])(?![\d.])",
    re.IGNORECASE,
)
"""Lines of ours that may also stand outside of streams: dwells, limits, the firmware's shaper."""
_SHAPER = re.compile(rb"SET_INPUT_SHAPER|M593(?!\d)|M493(?!\d)", re.IGNORECASE)
"""The file's own shaper line, which we repeat, may contain other commands."""
_STATE = re.compile(rb"G1 F[\d.]+$|G9[01]$|M8[23]$|G92 E-?[\d.]+$", re.IGNORECASE)
"""Lines of ours that set the file's modes again, also behind a mark by which hosts skip objects."""
_IN_STREAM = re.compile(
    rb"%b|%b|G1 (?:[XYZEF]-?[\d.]+ ?)+$" % (_ANYWHERE.pattern, _STATE.pattern), re.IGNORECASE
)


class LastCheck:
    """A writable file that compares what passes through it with the original.

    Parameters
    ----------
    target : file
        Receives what is written.
    original : binary file
        Text of the original, read from its beginning.
    step_mm : tuple of float
        Grid of the firmware's x, y, z; 0: none. Streams may end one grid step off.
    shortest_mm : float
        The firmware merges shorter moves into the next one; 0: it does not.

    Attributes
    ----------
    cpu_s : float
        CPU time that reading and comparing took.
    """

    def __init__(
        self,
        target: SupportsWrite[bytes],
        original: BinaryIO,
        machine: Machine,
        step_mm: tuple[float, ...] = (0.0, 0.0, 0.0),
        shortest_mm: float = 0.0,
    ) -> None:
        self._target = target
        rules = rules_of(machine.firmware)
        self._before, self._after = Reader(rules, shortest_mm), Reader(rules)
        self._original, self._written = Original(original, self._before), Text()
        self._rest: list[bytes] = []
        self._place_mm = _PLACE_MM + np.array(step_mm[:3], float)
        self._words = np.zeros(at.WORD_COUNT)
        self._idle: set[bytes] = set()
        """Lines of ours that change neither position nor modes."""
        self._streaming, self._stream_line = False, 0
        self._begun: deque[Place] = deque(maxlen=16)
        """Places in the original after its last lines within the stream."""
        self._wanted: Wanted | None = None
        self._earlier: deque[bytes] = deque(maxlen=64)
        """Lines matched to the first of several equal ones, or to ours, perhaps wrongly."""
        self._coverage = Coverage(self._before)
        self.cpu_s = 0.0

    def write(self, data: bytes) -> int:
        """Forward and compare what is written.

        Raises
        ------
        LastCheckError
        """
        self._target.write(data)
        began = time.process_time()
        cut = data.rfind(b"\n") + 1
        if cut:
            self._written.take(b"".join((*self._rest, data[:cut])))
            self._rest = []
            self._compare_all()
        if cut < len(data):
            self._rest.append(data[cut:])
        self.cpu_s += time.process_time() - began
        return len(data)

    def finish(self) -> LastCheckFigures:
        """Compare the end, and return the figures of the check.

        Raises
        ------
        LastCheckError
        """
        began = time.process_time()
        if self._rest:
            self._written.take(b"".join((*self._rest, b"\n")))
            self._rest = []
            self._compare_all()
        if expected := self._original.peek():
            error = self._missing(self._original.text.line, expected)
            error.stream_line = self._stream_line
            raise error
        self.cpu_s += time.process_time() - began
        return self._coverage.figures()

    # The written file

    def _compare_all(self) -> None:
        written = self._written
        try:
            while not written.is_read:
                if self._streaming:
                    self._stream()
                else:
                    self._lines()
        except LastCheckError as error:
            error.stream_line = self._stream_line
            raise

    def _lines(self) -> None:
        """Compare shared moves outside of streams, and the line after them."""
        written, original = self._written, self._original.text
        if original.is_read:
            self._original.read_on()
        before, after = original.line, written.at
        states = self._before.state, self._after.state
        if np.isnan(sum(state[at.E] + state[at.FED] for state in states)):
            self._original.forget_ahead()  # which counts filament from earlier on
        original.at, written.at, *counts, known, found = at.compare_moves(
            original.array,
            original.at,
            original.stop,
            written.array,
            written.at,
            written.stop,
            self._before.state,
            self._after.state,
            self._words,
            self._place_mm,
            self._filament_mm,
        )
        lines, written_lines, moves, unknown = counts
        original.line += lines
        written.line += written_lines
        if found != at.SAME:
            end = written.at - 1
            start = written.data.rfind(b"\n", after, end) + 1
            code = written.data[max(start, after) : end]
            place = original.line - 1, written.line - 1
            raise self._differs(found, self._before.state, "after", code, *place)
        self._coverage.note(moves, unknown, before, before + known)
        if written.is_read or (lines and original.is_read):
            return
        line, next_at = written.peek()
        code = code_of(line)
        if not code:
            written.skip(next_at)
            if line.startswith(_ON):
                self._streaming, self._wanted = True, None
                self._stream_line = original.line
                self._begun.clear()
                self._begun.append(self._original.place())
            return
        expected = self._original.peek()
        if is_same(code, expected):
            _, mask = self._before.carry_out(expected)
            self._after.carry_out(code)
            self._check(self._before.state, mask, code, original.line)
            self._count(original.line)
            self._original.skip()
        elif _ANYWHERE.match(code) or _STATE.match(code) or _SHAPER.search(code):
            self._after.carry_out(code)
        else:
            raise self._strange(code, expected)
        written.skip(next_at)

    def _stream(self) -> None:
        """Follow our moves in a stream, and the line after them."""
        written = self._written
        if self._wanted is None:
            self._wanted = self._original.wanted()
        wanted = self._wanted
        written.at, lines, taken, found = at.ours(
            written.array,
            written.at,
            written.stop,
            self._after.state,
            self._words,
            wanted.array,
            wanted.kind is Kind.RESTS,
            wanted.code in self._earlier,
            wanted.before,
            self._before.state,
            self._place_mm,
            self._filament_mm,
        )
        written.line += lines
        known = found == at.SAME and wanted.counts_filament(self._after.state)
        if taken and not known and wanted.code in self._original.perhaps:
            is_next = found != at.SAME and written.data.startswith(wanted.code, written.at)
            if is_next:
                written.skip(written.data.index(b"\n", written.at) + 1)
            self._take_earlier(wanted.code, carry_out=is_next)
            return
        if taken:
            if found != at.SAME:
                is_before = written.data.startswith(wanted.code, written.at)
                raise self._differs(
                    found,
                    wanted.before if is_before else self._before.state,
                    "before" if is_before else "after",
                    wanted.code,
                    wanted.line,
                    written.line - (not is_before),
                )
            self._take(wanted, compared=wanted.kind is Kind.RESTS)
            return
        if written.at >= written.stop:
            return
        end = written.data.index(b"\n", written.at)
        line = written.data[written.at : end]
        if line in self._idle and line != wanted.code:
            written.skip(end + 1)
            return
        if self._takes_line(line, wanted):
            written.skip(end + 1)
            if self._streaming and self._wanted is None:
                self._take_harmless()

    def _takes_line(self, line: bytes, wanted: Wanted) -> bool:
        """Accept a line that is not a move of ours, unless the awaited one came before."""
        code = line if line == wanted.code else code_of(line)
        if code:
            if self._takes(code, held_back=False):
                return True
            if not (_IN_STREAM.match(code) or _SHAPER.search(code)):
                if self._came_already():
                    return False
                raise self._strange(code, wanted.code)
            if self._earlier:
                self._earlier.append(code)
            self._after.carry_out(code)
            if _ANYWHERE.match(code) is not None and len(self._idle) < _MOST_IDLE:
                self._idle.add(line)
        elif line.startswith(_HELD):
            if not self._takes(code_of(line[len(_HELD) :]), held_back=True):
                if self._came_already():
                    return False
                raise self._strange(line, wanted.code)
        elif (off := _OFF.match(line)) is not None:
            self._leave(int(off[1]) if off[1] else ALL)
        return True

    def _takes(self, code: bytes, *, held_back: bool) -> bool:
        """Match a line of a stream to one of the original; return whether there is one."""
        wanted, in_doubt = self._wanted, code in self._original.perhaps
        if (
            wanted is not None
            and is_same(code, wanted.code)
            and (not in_doubt or self._stands_before(wanted, held_back=held_back))
        ):
            compared = wanted.kind is Kind.RESTS and not held_back
            if compared:
                # Compare before it too: with absolute E, the line undoes any excess filament.
                if np.isnan(wanted.before[at.FED] + self._after.state[at.FED]):
                    self._before.state[at.FED] = NAN
                self._check(wanted.before, at.WITHIN, code, wanted.line, "before")
            if not held_back:
                self._after.carry_out(code)
            if compared:
                self._check(self._before.state, wanted.mask | at.WITHIN, code, wanted.line)
            self._take(wanted, compared=compared)
            return True
        if in_doubt:
            self._take_earlier(code, carry_out=not held_back)
        return in_doubt

    def _stands_before(self, wanted: Wanted, *, held_back: bool) -> bool:
        """Whether place and filament are the original's: an earlier line would do the same here.

        When a line that is held back comes, a shaper may have begun the next move.
        """
        before, after = wanted.before, self._after.state
        if held_back:
            same = abs(before[at.FED] - after[at.FED]) <= self._filament_mm
        else:
            found = at.compare(before, after, at.WITHIN, self._place_mm, self._filament_mm)
            same = found == at.SAME
        return bool(same) and wanted.counts_filament(after)

    def _take_earlier(self, code: bytes, *, carry_out: bool) -> None:
        """Match a line to the first possible one with its text, not to the awaited one.

        If that has the same text, filament is counted anew from the next line that is compared.
        """
        while self._original.perhaps.popleft() != code:
            pass
        if carry_out:
            self._after.carry_out(code)
        if self._wanted is not None and is_same(code, self._wanted.code):
            self._earlier.append(self._wanted.code)
            self._count_anew()
        self._coverage.kept += 1

    def _came_already(self) -> bool:
        """Continue after the awaited line if it was matched to an earlier one; return whether."""
        wanted = self._wanted
        if wanted is None or wanted.code not in self._earlier:
            return False
        self._earlier.remove(wanted.code)
        self._take(wanted, compared=False)
        self._coverage.kept -= 1
        self._count_anew()
        return True

    def _count_anew(self) -> None:
        """Restart counting filament at the next line that is compared."""
        states = [self._after.state, self._before.state]
        if self._wanted is not None:
            states.append(self._wanted.before)
        for state in states:
            state[at.FED] = NAN
        self._original.forget_ahead()  # which counts filament from earlier on

    def _take(self, wanted: Wanted, *, compared: bool) -> None:
        """Continue after an awaited line."""
        if compared:
            self._count(wanted.line)
        else:
            self._coverage.kept += 1
        # We write such lines too: this one may be ours, and the file's own may still come.
        if not (_IN_STREAM.match(wanted.code) or _SHAPER.search(wanted.code)):
            self._original.perhaps.clear()
        self._original.forget_ahead()
        self._wanted = None
        self._begun.append(self._original.place())

    def _take_harmless(self) -> None:
        """Skip lines next in both files that change neither position nor modes."""
        written, original = self._written, self._original
        while line := original.harmless():
            if not written.data.startswith(line, written.at):
                return
            self._coverage.kept += 1
            written.skip(written.at + len(line))
            original.text.skip(original.text.at + len(line))
            self._begun.append(original.place())

    def _leave(self, number: int) -> None:
        """Leave a stream after which the file goes on with a line of the original."""
        original = self._original
        wanted = self._wanted or original.wanted()
        while wanted.line < number and wanted.code in self._earlier:
            self._wanted = wanted
            self._came_already()
            wanted = original.wanted()
        if wanted.code and wanted.line < number:
            raise self._missing(wanted.line, wanted.code)
        self._streaming, self._wanted = False, None
        if number == ALL:
            self._check(self._before.state, at.WORDS, b"the last stream", original.text.line)
            return
        # Go back to before the line: the awaited one may lie after it, and lines of ours that set
        # modes or F may have been mistaken for the file's.
        original.look_ahead(wanted)
        original.perhaps.clear()
        while len(self._begun) > 1 and self._begun[-1].line > number:
            self._begun.pop()
            self._coverage.kept -= 1
            original.forget_ahead()
        original.go_to(self._begun[-1])
        original.go_up_to(number)
        if original.text.line != number:
            raise LastCheckError(
                f"a stream ends before line {number} of the original, which was already written",
                original.text.line,
                self._written.line,
            )
        self._check(self._before.state, at.WORDS, b"a stream", number)

    # Comparisons and errors

    def _check(
        self, before: NDArray[np.float64], mask: int, code: bytes, line: int, where: str = "after"
    ) -> None:
        """Compare a state of the original with the current state of the written file."""
        if np.isnan(before[at.FED] + self._after.state[at.FED]):
            self._original.forget_ahead()  # which counts filament from earlier on
        found = at.compare(before, self._after.state, mask, self._place_mm, self._filament_mm)
        if found != at.SAME:
            raise self._differs(found, before, where, code, line, self._written.line)

    @property
    def _filament_mm(self) -> float:
        """Return the tolerance of E in units of the file."""
        return _FILAMENT_MM / self._before.least_flow

    def _count(self, line: int) -> None:
        before, after = self._before.state, self._after.state
        unknown = before[at.X] + before[at.Y] + after[at.X] + after[at.Y]
        self._coverage.note(1, int(unknown != unknown), line, line)

    def _differs(
        self,
        found: int,
        before: NDArray[np.float64],
        where: str,
        code: bytes,
        line: int,
        written_line: int,
    ) -> LastCheckError:
        one, other = float(before[found]), float(self._after.state[found])
        limit = {at.F: 1e-4, at.RELATIVE: 0.0, at.RELATIVE_E: 0.0}.get(found, self._filament_mm)
        if found < 3:
            limit = float(self._place_mm[found])
        unit = _UNITS[found] and " " + _UNITS[found]
        return LastCheckError(
            f"{where} {shown(code)!r} {_NAMES[found]} is {other:.7g}{unit}, in the original "
            f"{one:.7g}{unit}; they may differ by {limit:.3g}{unit}",
            line,
            written_line,
        )

    def _missing(self, line: int, code: bytes) -> LastCheckError:
        return LastCheckError(
            f"a line of the original is missing ({shown(code)!r})", line, self._written.line
        )

    def _strange(self, code: bytes, expected: bytes) -> LastCheckError:
        wanted = repr(shown(expected)) if expected else "the end of the file"
        return LastCheckError(
            f"{shown(code)!r} is not what comes next in the original ({wanted}), and no line that "
            "Stillpath adds there",
            self._original.text.line,
            self._written.line,
        )
