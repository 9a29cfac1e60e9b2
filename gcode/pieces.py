"""Parts of a file: pieces to compensate, and verbatim parts that are not changed.

A *piece* starts and ends with a move of X or Y, at rest, with X and Y known throughout; nothing in
it stops the machine but its own retractions and Z hops. It lasts at most a minute and has at most
so many moves and lines, so that memory does not grow with the file and a fault costs little.
Everything else is a *verbatim part*. `gcode.splitter` cuts files into them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.types import (
    AFTER_MARK,
    EventKind,
    Events,
    Limits,
    ModalState,
    Moves,
    Phases,
    TextLines,
)

__all__ = ["LeftOut", "Piece", "VerbatimPart"]


@dataclass(frozen=True, slots=True)
class VerbatimPart(TextLines):
    """Lines of the file in order, to stay as sliced.

    Attributes
    ----------
    moves, events : Moves, Events
        `Events.move_index` counts within this part.
    text : bytes
        The part's own bytes.
    text_offset : int
        Where they start in the file; `byte_start` and `byte_end` columns are absolute.
    limits, modal : lists
        Tables of the rows' `limits_id` and `modal_id`.
    limits_before, limits_after : Limits
        Planner limits in force before the first line, and after the last.
    modal_before, modal_after : ModalState
        Modes before the first and after the last line.
    """

    moves: Moves
    events: Events
    text: bytes
    text_offset: int
    limits: list[Limits]
    modal: list[ModalState]
    limits_before: Limits
    limits_after: Limits
    modal_before: ModalState
    modal_after: ModalState

    @property
    def first_line(self) -> int:
        """Number of its first line in the file, from 1; it must hold one."""
        return min(int(rows.line[0]) for rows in (self.moves, self.events) if len(rows))


@dataclass(frozen=True, slots=True)
class Piece(VerbatimPart):
    """Lines to compensate, with the firmware's own plan of their moves, from rest to rest."""

    phases: Phases

    @classmethod
    def planned(cls, lines: VerbatimPart, phases: Phases) -> Piece:
        """Return the lines of a verbatim part with the plan of its moves."""
        columns = {f.name: getattr(lines, f.name) for f in fields(lines)}
        # The row of a G10 before it does not have the origin that its hop leaves.
        columns["modal_before"] = lines.modal[int(lines.moves.modal_id[0])]
        return cls(**columns, phases=phases)

    @property
    def after_mark(self) -> bool:
        """Whether the firmware may come from elsewhere, because it skipped an object."""
        return bool(self.moves.known[0] & AFTER_MARK)

    @property
    def marked_rows(self) -> NDArray[np.int64]:
        """Rows (k,) of moves before which a fan, an output or a message is switched, in motion."""
        events = self.events
        inside = (events.kind == EventKind.HARMLESS) & (events.move_index < len(self.moves))
        begins = events.byte_start[inside] - self.text_offset
        letters = np.frombuffer(self.text, np.uint8)[begins] | 32
        is_command = (letters >= ord("a")) & (letters <= ord("z"))
        return np.asarray(events.move_index[inside][is_command])


class LeftOut(VerbatimPart):
    """Lines that could be compensated but stay as sliced on request."""
