"""Split a file into pieces that may be compensated, and verbatim parts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO

import numpy as np

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.signatures import signed_at
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.pieces import Piece, VerbatimPart
from stillpath.gcode.splitter import Splitter
from stillpath.gcode.types import EventKind, ProgramBlock
from stillpath.pipeline.clock import StageClock

__all__ = ["FileParts", "refuse_processed"]


class FileParts:
    """Read a file block by block from its current position.

    Parameters
    ----------
    source : binary file
    clock : StageClock
        Times reading and planning.
    """

    def __init__(
        self, source: BinaryIO, reader: Interpreter, splitter: Splitter, clock: StageClock
    ) -> None:
        self._source, self._reader, self._splitter = source, reader, splitter
        self._clock = clock

    def __iter__(self) -> Iterator[Piece | VerbatimPart]:
        """Yield the parts in order.

        Raises
        ------
        GcodeError
            The file was compensated before.
        """
        for block in self._clock.each("read", self._reader.blocks(self._source)):
            refuse_processed(block)
            yield from self._clock.each("plan", self._splitter.push(block))
        yield from self._clock.each("plan", self._splitter.flush())


def refuse_processed(block: ProgramBlock, do: str = "compensate") -> None:
    """Raise GcodeError for a block written by this program, even if its comments were removed.

    Parameters
    ----------
    do : str
        What the message tells the user to do with the original.
    """
    stamped = np.flatnonzero(block.events.kind == EventKind.STAMP)
    if len(stamped):
        raise GcodeError(
            f"this file was already processed by stillpath; {do} the original",
            line=int(block.events.line[stamped[0]]),
        )
    place = signed_at(block.text)
    if place is not None:
        raise GcodeError(
            "this file was already processed by stillpath, and its comments were stripped: these "
            f"limits are those of a compensated stretch; {do} the original",
            line=_line_at(block, place),
            text=block.text[place : block.text.index(b"\n", place)].decode("latin-1"),
        )


def _line_at(block: ProgramBlock, place: int) -> int | None:
    """Return the line number at an offset of the block's text, counted from an event."""
    events, offset = block.events, block.text_offset
    before = int(np.searchsorted(events.byte_start, offset + place, side="right")) - 1
    if before < 0:
        return None
    begin = int(events.byte_start[before]) - offset
    return int(events.line[before]) + block.text.count(b"\n", begin, place)
