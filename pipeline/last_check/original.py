"""Follow the original: its next lines, and the next that the written file must contain."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillpath.pipeline.last_check import _reader_kernels as at
from stillpath.pipeline.last_check.reader import Kind, Reader, code_of

__all__ = ["ALL", "Original", "Place", "Text", "Wanted"]

ALL = 1 << 60
"""More lines than any file has."""
_BLOCK_BYTES = 1 << 18
_MOST_PERHAPS = 1 << 12
_AT_A_TIME = 1 << 10
_BOM = b"\xef\xbb\xbf"


@dataclass(slots=True)
class Text:
    """A buffer of whole lines of a file.

    Attributes
    ----------
    data, array : bytes, uint8 array
        The same text in two forms.
    at, stop : int
        Where the next line begins, and where the last one ends.
    line : int
        Number of the line at `at`.
    bytes_before : int
        Offset of `data` in the file.
    """

    data: bytes = b""
    at: int = 0
    line: int = 1
    bytes_before: int = 0
    array: NDArray[np.uint8] = field(default_factory=lambda: np.frombuffer(b"", np.uint8))
    stop: int = 0

    @property
    def is_read(self) -> bool:
        """Whether the buffer is used up."""
        return self.at >= self.stop

    def take(self, data: bytes) -> None:
        """Replace the buffer by the lines that follow it."""
        self.bytes_before += len(self.data)
        self.data, self.at, self.stop = data, 0, len(data)
        self.array = np.frombuffer(data, np.uint8)

    def peek(self) -> tuple[bytes, int]:
        """Return the next line without its newline, and where the one after it begins."""
        end = self.data.index(b"\n", self.at)
        line = self.data[self.at : end]
        if self.line == 1 and line.startswith(_BOM):
            line = line[len(_BOM) :]
        return line, end + 1

    def skip(self, next_at: int, lines: int = 1) -> None:
        """Continue at a later line."""
        self.at = next_at
        self.line += lines


@dataclass(slots=True)
class Wanted:
    """The next line of the original that must be in the written file.

    Attributes
    ----------
    code, array : bytes, uint8 array
        The line in two forms; empty at the end of the file.
    mask : int
        Words of a plain move (`Reader.carry_out`).
    before : float array
        State before it, if it is a plain move without X and Y.
    """

    line: int = ALL
    code: bytes = b""
    kind: Kind = Kind.STAYS
    mask: int = 0
    array: NDArray[np.uint8] = field(default_factory=lambda: np.frombuffer(b"", np.uint8))
    before: NDArray[np.float64] = field(default_factory=lambda: np.zeros(at.SIZE))

    def counts_filament(self, state: NDArray[np.float64]) -> bool:
        """Return whether the filament fed is known both before it and in `state`."""
        return self.kind is Kind.RESTS and not np.isnan(self.before[at.FED] + state[at.FED])


class Place(NamedTuple):
    """A place in the original with the reader's state there."""

    bytes_before: int
    line: int
    kept: tuple[Any, ...]


class Original:
    """Follow the original.

    Parameters
    ----------
    source : binary file
        Read from its beginning, and again after `go_to`.

    Attributes
    ----------
    text : Text
    perhaps : deque of bytes
        Lines before the awaited one that may or may not move X or Y.
    """

    def __init__(self, source: BinaryIO, reader: Reader) -> None:
        source.seek(0)
        self._source, self.reader, self.text = source, reader, Text()
        self.perhaps: deque[bytes] = deque(maxlen=_MOST_PERHAPS)
        self._words, self._places = np.zeros(at.WORD_COUNT), np.zeros(_AT_A_TIME, int)
        self._still = np.zeros(at.SIZE)
        """State before the last line that stood still in X and Y."""
        self._ahead: tuple[Wanted, Place, tuple[bytes, ...]] | None = None

    def read_on(self) -> bool:
        """Read the next lines; return whether there are any."""
        parts = []
        while block := self._source.read(_BLOCK_BYTES):
            cut = block.rfind(b"\n") + 1
            if cut:
                parts.append(block[:cut])
                if cut < len(block):
                    self._source.seek(cut - len(block), 1)
                break
            parts.append(block)
        data = b"".join(parts)
        if data and not data.endswith(b"\n"):
            data += b"\n"
        if data:
            self.text.take(data)
        return bool(data)

    def place(self) -> Place:
        """Return the current place in the original."""
        text = self.text
        return Place(text.bytes_before + text.at, text.line, self.reader.keep())

    def go_to(self, place: Place) -> None:
        """Continue from a place."""
        text = self.text
        self.reader.restore(place.kept)
        if text.bytes_before <= place.bytes_before < text.bytes_before + len(text.data):
            text.at = place.bytes_before - text.bytes_before
        else:
            self._source.seek(place.bytes_before)
            text.take(b"")
            text.bytes_before = place.bytes_before
        text.line = place.line

    def peek(self) -> bytes:
        """Return the next line with a command; empty at the end."""
        text = self.text
        while not text.is_read or self.read_on():
            line, next_at = text.peek()
            if code := code_of(line):
                return code
            text.skip(next_at)
        return b""

    def skip(self) -> None:
        """Skip the next line."""
        self.text.skip(self.text.data.index(b"\n", self.text.at) + 1)

    def harmless(self) -> bytes:
        """Return the next line if it changes neither position nor modes; else nothing."""
        text = self.text
        line = text.data[text.at : text.data.find(b"\n", text.at) + 1]
        return line if self.reader.leaves_alone(line.rstrip()) else b""

    def wanted(self) -> Wanted:
        """Execute moves that a stream may replace; return the line after them, which must stay."""
        if self._ahead is not None:
            wanted, place, perhaps = self._ahead
            if wanted.line >= self.text.line:
                self.go_to(place)
                self.perhaps.extend(perhaps)
                return wanted
        while (found := self._next(ALL, self.perhaps))[0]:
            code, mask = found
            line, before, kind = self.text.line - 1, self._still, Kind.STAYS
            if mask < 0:
                if not self.reader.leaves_alone(code):
                    before = self.reader.state.copy()
                    kind, mask = self.reader.carry_out(code)
                self.skip()
                line += 1
            elif mask & at.WORDS:
                before, kind = before.copy(), Kind.RESTS
            if kind is Kind.PERHAPS:
                self.perhaps.append(code)
            elif kind is not Kind.MOVES:
                return Wanted(line, code, kind, mask, np.frombuffer(code, np.uint8), before)
        return Wanted()

    def look_ahead(self, wanted: Wanted) -> None:
        """Keep the next awaited line, after which the original stands.

        Many streams may end before it, and the file should not be searched again for each.
        """
        self._ahead = wanted, self.place(), tuple(self.perhaps)

    def forget_ahead(self) -> None:
        """Forget the line found ahead."""
        self._ahead = None

    def go_up_to(self, line: int) -> None:
        """Execute the lines before another one."""
        while (found := self._next(line, deque(maxlen=0)))[0]:
            if found[1] < 0:
                self.reader.carry_out(found[0])
                self.skip()

    def _next(self, before_line: int, perhaps: deque[bytes]) -> tuple[bytes, int]:
        """Execute moves of X and Y, and continue to the line after them.

        Parameters
        ----------
        before_line : int
            Where to stop.
        perhaps : deque of bytes
            Receives the lines that may or may not move X or Y.

        Returns
        -------
        (bytes, int)
            The line after them, not yet executed, and -1; or an executed one that does not move X
            and Y, and its words. Empty at the end of the file, and at `before_line`.
        """
        text, reader = self.text, self.reader
        while text.line < before_line:
            if text.is_read and not self.read_on():
                break
            next_at, lines, mask, found = at.carry_out_moves(
                text.array,
                text.at,
                text.stop,
                before_line - text.line,
                reader.shortest_mm,
                reader.knows_arcs,
                reader.rules.divides_extruder,
                reader.state,
                self._words,
                self._still,
                self._places,
            )
            text.skip(next_at, lines)
            if found:
                data = text.data
                for begin in self._places[:found].tolist():
                    perhaps.append(data[begin : data.index(b"\n", begin)].rstrip())
            if mask >= 0:
                begin = text.data.rfind(b"\n", 0, next_at - 1) + 1
                return text.data[begin : next_at - 1].rstrip(), mask
            if text.is_read or text.line >= before_line or found == _AT_A_TIME:
                continue
            line, next_at = text.peek()
            if code := code_of(line):
                return code, -1
            text.skip(next_at)
        return b"", -1
