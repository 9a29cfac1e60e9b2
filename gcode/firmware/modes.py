"""Modal states of a piece's written moves, and the line that sets F."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.pieces import Piece
from stillpath.gcode.types import EventKind, ModalState

__all__ = ["WrittenModes", "feed_line", "written_modes"]


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


def written_modes(piece: Piece, index: NDArray[np.int64]) -> WrittenModes:
    """Return the modes; `index` is the written move before which each event is written."""
    changes = piece.events.kind == EventKind.MODE
    first = np.concatenate([[0], index[changes]])
    states = [piece.modal_before]
    states += [piece.modal[int(m)] for m in piece.events.modal_id[changes]]
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
