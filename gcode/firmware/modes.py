"""Where events are written, modal states of a piece's written moves, and the line that sets F."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.firmware.encoding import Encoded
from stillpath.gcode.pieces import Piece
from stillpath.gcode.types import EventKind, ModalState

__all__ = ["WrittenModes", "event_places", "feed_line", "written_modes"]


@dataclass(frozen=True, slots=True)
class WrittenModes:
    """states[i] holds from written move first[i] on.

    They are the file's, except that our lines use absolute X Y Z and relative E.
    """

    first: NDArray[np.int64]
    states: list[ModalState]

    def at(self, move: int) -> ModalState:
        """Return the state of a written move."""
        return self.states[int(np.searchsorted(self.first, move, "right")) - 1]


def event_places(piece: Piece, encoded: Encoded) -> NDArray[np.int64]:
    """Return the index of the written move before which each event is written, shape (events,)."""
    first = np.full(len(piece.moves) + 1, len(encoded.row), np.int64)
    # The move that begins nearest to the moment; the encoder's times are slightly off the plan.
    between_s = 0.5 * (encoded.start_s[1:] + encoded.start_s[:-1])
    first[:-1] = np.searchsorted(between_s, encoded.row_start_s - 1e-6)
    rest = encoded.row >= 0
    rows, places = encoded.row[rest], np.flatnonzero(rest)
    # What the file says at rest comes before a shaper begins to move, ahead of the plan.
    first[rows + 1] = places + 1
    # An event never moves across a rest, in either direction, not even across one that takes no
    # time or follows a stretch without written moves.
    first[rows] = places
    first = np.maximum.accumulate(first)
    until = np.full(len(first), len(encoded.row))
    until[rows] = places
    first = np.minimum(first, np.minimum.accumulate(until[::-1])[::-1])
    return first[np.minimum(piece.events.move_index, len(piece.moves))]


def written_modes(piece: Piece, encoded: Encoded, index: NDArray[np.int64]) -> WrittenModes:
    """Return the modes; `index` is the written move before which each event is written."""
    moves, changes = piece.moves, piece.events.kind == EventKind.MODE
    # G10 and G11 are moves, and a hop shifts the origin of Z.
    rests = np.flatnonzero(encoded.row >= 0)
    behind = moves.modal_id[np.minimum(encoded.row[rests] + 1, len(moves) - 1)]
    shifts = behind != moves.modal_id[encoded.row[rests]]
    first = np.concatenate([[0], rests[shifts] + 1, index[changes]])
    states = [piece.modal_before]
    states += [
        piece.modal[int(m)]
        for m in np.concatenate([behind[shifts], piece.events.modal_id[changes]])
    ]
    order = np.argsort(first, kind="stable")
    first, states = first[order], [states[k] for k in order.tolist()]
    # Of several changes at one move the last one counts.
    last = np.append(first[1:] != first[:-1], True)
    ours = [
        replace(state, absolute_xyz=True, absolute_e=False)
        for state, keep in zip(states, last, strict=True)
        if keep
    ]
    return WrittenModes(first[last], ours)


def feed_line(feedrate_mm_min: float) -> bytes:
    """Return the line that sets F alone."""
    digits = f"{feedrate_mm_min:.5f}".rstrip("0").rstrip(".")
    return f"G1 F{digits}\n".encode()
