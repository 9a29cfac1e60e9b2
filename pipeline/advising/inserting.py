"""Write the advised file: the lines of the original with lines of our own between them.

Every inserted line stands by itself and carries `MARK`: deleting the marked lines restores the
original, byte for byte.

The file's own commands keep their meaning. After a line that sets an acceleration or a shaper, ours
is set again. Before lines that may do anything (homing, macros, pauses, tool changes) the printer
gets the file's settings back, and after them ours again.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from typing import BinaryIO

import numpy as np

from stillpath.gcode.firmware.base import Adviser
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.slicers.features import feature_of
from stillpath.gcode.slicers.retiming import behind_last_command
from stillpath.gcode.types import EventKind, Limits, ProgramBlock
from stillpath.models.shaping import AxisShaper, Shaping
from stillpath.pipeline.advising.advice import Advice, wanted_accel

__all__ = ["MARK", "AdviceWriter", "write_advised"]

MARK = b"; stillpath advise"
"""Every inserted line holds it, and no line of a file that is advised."""

_BLOCK_BYTES = 1 << 17
_COMMAND = re.compile(rb"^(?!\xef\xbb\xbf)[^\S\n]*[^;\s]", re.MULTILINE)
_VALUE = re.compile(rb"(?<=[A-Z=])\s*[-+]?[.\d]+")
_OURS = AxisShaper("ours")
_HEEDED = np.array(
    [
        *(EventKind.LIMITS, EventKind.STOP, EventKind.UNKNOWN, EventKind.OBJECT),
        *(EventKind.SHAPER, EventKind.STATE),
    ]
)


class AdviceWriter:
    """Write a file with advice.

    Parameters
    ----------
    names : list of str
        Feature names of the reader; the list grows as the file is read.
    initial : Limits
        Limits before the first line.
    stamp : str
        Version and options, for the header.

    Attributes
    ----------
    lines, shapers_set : int
        Inserted lines, and places at which a shaper of ours is set.
    shaper_left : bool
        At the end the printer's previous shaper was unknown: ours stays, at least in part.
    """

    def __init__(
        self, adviser: Adviser, advice: Advice, names: list[str], initial: Limits, stamp: str
    ) -> None:
        self._adviser, self._advice, self._names, self._stamp = adviser, advice, names, stamp
        self._file = adviser.accel_mm_s2(initial)
        """Acceleration that the file has set."""
        self._now: float | None = self._file
        """Acceleration of the printer; None: unknown."""
        self._layer = -1
        self._shaper: Shaping | None = None
        """Our own shaper in force; None: another one, or unknown."""
        self._shaped = False
        self._own_shaper: dict[bytes, bytes] = {}
        """The file's own commands that set a shaper, the last of each form."""
        # One line may contain several commands.
        self._sets_shaper = re.compile(
            rb"\b%s\b(?:(?![GMT]\d)[^;])*" % adviser.shaper_word.encode(), re.IGNORECASE
        )
        self._rests = True
        self.lines = self.shapers_set = 0
        self.shaper_left = False

    def header(self) -> bytes:
        """Return lines that say who processed the file, and how to undo it."""
        return self.footer() + self._line(
            b"", "without the lines that hold this mark, the file is as it came"
        )

    def footer(self) -> bytes:
        """Return the line that says who processed the file."""
        self.lines += 1
        return f"; Processed by stillpath {self._stamp} ".encode() + MARK + b"\n"

    def block(self, block: ProgramBlock) -> bytes:
        """Return the text of a block with our lines inserted."""
        parts: list[bytes] = []
        done = 0
        for at, is_move, row in self._places(block):
            lead = self._move(block, row) if is_move else self._event(block, row)
            if lead:
                parts += [block.text[done:at], lead]
                done = at
        parts.append(block.text[done:])
        return b"".join(parts)

    def end(self) -> bytes:
        """Return the lines for the end of the file that restore the printer's settings."""
        text = self._give_back()
        if self._shaped:
            text += self._give_shaper_back()
        return text + self.footer()

    def _places(self, block: ProgramBlock) -> list[tuple[int, bool, int]]:
        """Return where lines may be needed: text offset, whether a move, and row."""
        moves, events, start = block.moves, block.events, block.text_offset
        relevant = np.flatnonzero(np.isin(events.kind, _HEEDED))
        places = [(int(events.byte_start[k]) - start, False, k) for k in relevant.tolist()]
        if len(moves):
            self._wanted, self._theirs = wanted_accel(
                moves, block.limits, self._advice, self._adviser
            )
            due = np.zeros(len(moves), dtype=bool)
            due[0] = True
            # NaN never equals NaN: replace it, so that only the first of several travels is due.
            self._kept = self._advice.keeps(moves)
            key = np.where(np.isnan(self._wanted), -1.0 - self._kept, self._wanted)
            due[1:] = (key[1:] != key[:-1]) | (moves.layer[1:] != moves.layer[:-1])
            due[1:] |= moves.limits_id[1:] != moves.limits_id[:-1]
            after = events.move_index[relevant] - block.first_move
            due[after[after < len(moves)]] = True
            # A line can be inserted only before the first segment of an arc.
            due[1:] &= moves.byte_start[1:] != moves.byte_start[:-1]
            rows = np.flatnonzero(due).tolist()
            places += [(int(moves.byte_start[k]) - start, True, k) for k in rows]
        return sorted(places)

    def _event(self, block: ProgramBlock, row: int) -> bytes:
        events = block.events
        kind = int(events.kind[row])
        line = block.line(events, row)
        lead = b""
        if kind == EventKind.UNKNOWN:
            lead = self._give_back()
            if self._shaped and self._adviser.stores(line.decode("utf-8", "replace")):
                lead += self._give_shaper_back()
            self._now, self._shaper, self._rests = None, None, True
        elif kind == EventKind.OBJECT and self._adviser.skips_lines:
            # A host that excludes an object skips our lines inside it.
            lead = self._give_back()
            self._now = None
        elif kind == EventKind.SHAPER:
            self._rests = True
            for code in self._sets_shaper.findall(line.split(b";", 1)[0]):
                form = _VALUE.sub(b"", code.upper())
                self._own_shaper = {k: v for k, v in self._own_shaper.items() if k != form}
                self._own_shaper[form] = code.strip()
                self._shaper = None
        self._file = self._adviser.accel_mm_s2(block.limits[int(events.limits_id[row])])
        sets_accel = self._adviser.sets_accel(line.decode("utf-8", "replace"))
        if kind != EventKind.UNKNOWN and sets_accel:
            self._now = self._file
        return lead

    def _move(self, block: ProgramBlock, row: int) -> bytes:
        wanted, file_accel = float(self._wanted[row]), float(self._theirs[row])
        if file_accel != self._file:
            # The line of the move itself sets the acceleration.
            self._file = self._now = file_accel
        self._layer = int(block.moves.layer[row])
        prints = not np.isnan(wanted)
        lead = self._set_shaper(prints)
        self._rests = False
        if prints:
            file_accel_in_force = self._now is None and wanted == self._file
            if self._now != wanted and not file_accel_in_force:
                lead += self._accel(wanted, self._title(int(block.moves.feature[row])))
        elif self._now is not None and (
            (self._now < self._file and not self._adviser.travel_apart)
            or (self._now != self._file and self._kept[row])
        ):
            # Travel is never slower than in the file, nor faster where nothing may change
            # (Marlin wipes with the acceleration of moves that print).
            lead += self._accel(self._file, "travel")
        return lead

    def _set_shaper(self, prints: bool) -> bytes:
        """Set the shaper of the layer, where the machine rests or nothing is printed."""
        wanted = self._advice.shaping(self._layer)
        if wanted is None or wanted == self._shaper or (prints and not self._rests):
            return b""
        self._shaper, self._shaped = wanted, True
        self.shapers_set += 1
        layer = f" from layer {self._layer} on" if self._layer > 0 else ""
        lines = self._adviser.shaper_lines(wanted)
        return b"".join(self._line(line, f"shaper{layer}") for line in lines)

    def _give_shaper_back(self) -> bytes:
        """Restore the shaper of the machine document, and then the file's settings."""
        stated = self._adviser.stated
        lines = () if stated is None else self._adviser.shaper_lines(stated)
        lines = (*lines, *self._own_shaper.values())
        self.shaper_left = stated is None and not self._sets_all(lines)
        return b"".join(self._line(line, "the printer's own shaper") for line in lines)

    def _sets_all(self, lines: Sequence[bytes]) -> bool:
        """Return whether these lines replace our shaper on both axes."""
        remaining = Shaping(_OURS, _OURS)
        with contextlib.suppress(ValueError):
            for line in lines:
                remaining = self._adviser.read_shaper(line.decode("utf-8", "replace"), remaining)
        return _OURS.type not in (remaining.x.type, remaining.y.type)

    def _give_back(self) -> bytes:
        """Return the lines that restore the acceleration set by the file."""
        if self._now is None or self._now == self._file:
            return b""
        return self._accel(self._file, "as the file has it")

    def _accel(self, accel_mm_s2: float, why: str) -> bytes:
        self._now = accel_mm_s2
        return b"".join(self._line(line, why) for line in self._adviser.accel_lines(accel_mm_s2))

    def _line(self, code: bytes, why: str) -> bytes:
        self.lines += 1
        return code + (b" " if code else b"") + MARK + f": {why}\n".encode()

    def _title(self, feature: int) -> str:
        found = feature_of(self._names[feature]) if feature >= 0 else None
        return found.value if found is not None else "print"


def write_advised(
    source: BinaryIO, out: BinaryIO, reader: Interpreter, writer: AdviceWriter
) -> None:
    """Write a text with advice to `out`, replacing its contents, and rewind it.

    Parameters
    ----------
    source, out : binary files
    reader : Interpreter
        Unused so far; the writer shares its list of feature names.
    """
    out.seek(0)
    out.truncate()
    source.seek(0)
    header, tail = writer.header(), 0
    while data := source.read(_BLOCK_BYTES):
        for block in reader.push(data):
            text = writer.block(block)
            at = _first_command(text) if header else -1
            if at >= 0:
                text, header = text[:at] + header + text[at:], b""
            if end := behind_last_command(text):
                tail = out.tell() + end
            out.write(text)
    rest = b"".join(block.text for block in reader.flush())
    # Nothing can follow a line without a newline: our end goes before it.
    if header or behind_last_command(rest):
        tail = out.tell()
    out.write(rest)
    _insert(out, tail, header + writer.end())
    out.seek(0)


def _first_command(text: bytes) -> int:
    """Return the offset of the first line that is not a comment, after the slicer's header."""
    found = _COMMAND.search(text)
    return found.start() if found else -1


def _insert(file: BinaryIO, at: int, text: bytes) -> None:
    """Insert text into a file: the slicer's settings must stay at its very end."""
    for stop in range(file.seek(0, io.SEEK_END), at, -_BLOCK_BYTES):
        start = max(stop - _BLOCK_BYTES, at)
        file.seek(start)
        tail = file.read(stop - start)
        file.seek(start + len(text))
        file.write(tail)
    file.seek(at)
    file.write(text)
