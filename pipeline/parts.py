"""A file as a sequence of parts: pieces that may be compensated, and verbatim parts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO

import numpy as np

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.pieces import Piece, VerbatimPart
from stillpath.gcode.splitter import Splitter
from stillpath.gcode.types import EventKind, ProgramBlock
from stillpath.pipeline.clock import StageClock

__all__ = ["FileParts"]


class FileParts:
    """Read a file from where it is, block by block.

    Parameters
    ----------
    source : binary file
    reader : Interpreter
    splitter : Splitter
    clock : StageClock
        Counts reading and planning.
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
            _refuse_compensated(block)
            yield from self._clock.each("plan", self._splitter.push(block))
        yield from self._clock.each("plan", self._splitter.flush())


def _refuse_compensated(block: ProgramBlock) -> None:
    stamped = np.flatnonzero(block.events.kind == EventKind.STAMP)
    if len(stamped):
        raise GcodeError(
            "this file was already processed by stillpath; compensate the original",
            line=int(block.events.line[stamped[0]]),
        )
