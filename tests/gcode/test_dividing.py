"""A divided piece: nothing is lost or said twice, and what remains may be compensated."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.gcode.dividing import divided, sections
from stillpath.gcode.pieces import LeftOut, Piece
from tests.gcode.cutting import ender3_with, pieces_of
from tests.gcode.prints import small_arcs

EXAMPLES = Path(__file__).parents[2] / "examples"
KINDS = ("klipper", "marlin", "reprapfirmware")


@lru_cache(maxsize=3)
def longest_piece(kind: str) -> Piece:
    """The piece with most sections of two layers with retractions."""
    text = (EXAMPLES / "ps_ender3_pauses_hept24f.gcode").read_bytes()
    return max(pieces_of(text, ender3_with(kind)), key=lambda piece: len(sections(piece)))


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
@settings(max_examples=25)
def test_the_parts_are_the_piece(kind: str, data: st.DataObject) -> None:
    piece, machine = longest_piece(kind), ender3_with(kind)
    n = len(sections(piece))
    assert n > 4
    wanted = np.array(data.draw(st.lists(st.booleans(), min_size=n, max_size=n)))
    parts = list(divided(piece, wanted, machine))
    assert b"".join(part.text for part in parts) == piece.text
    assert np.concatenate([p.moves.line for p in parts]).tolist() == piece.moves.line.tolist()
    assert sum(len(p.events) for p in parts) == len(piece.events)
    for part in parts:
        assert np.all(part.events.move_index >= 0)
        assert np.all(part.events.move_index <= len(part.moves))
    for before, after in pairwise(parts):
        assert before.limits_after == after.limits_before
        assert before.modal_after == after.modal_before
        assert isinstance(before, LeftOut) != isinstance(after, LeftOut)
    ends = [part for part in parts if isinstance(part, Piece)]
    assert len(ends) == np.sum(np.diff(np.append(False, wanted).astype(int)) == 1)
    for part in ends:
        travel = part.moves.end_mm - part.moves.start_mm
        assert np.all(np.any(travel[[0, -1], :2] != 0.0, axis=1))
        # Marlin and RepRapFirmware start and stop with a step of speed.
        assert part.phases.start_mm_s[0] <= (0.0 if kind == "klipper" else 20.0)
        assert part.phases.end_mm_s[-1] <= (0.0 if kind == "klipper" else 20.0)


@pytest.mark.parametrize("kind", KINDS)
def test_an_arc_is_not_cut(kind: str) -> None:
    for piece in pieces_of(small_arcs(), ender3_with(kind)):
        line = piece.moves.line
        bounds = [bound for section in sections(piece) for bound in section]
        inner = [bound for bound in bounds if 0 < bound < len(line)]
        assert inner
        assert all(line[b - 1] != line[b] for b in inner)


def test_all_of_a_piece_is_the_piece() -> None:
    piece = longest_piece("klipper")
    assert list(divided(piece, np.ones(len(sections(piece)), bool), ender3_with("klipper"))) == [
        piece
    ]
