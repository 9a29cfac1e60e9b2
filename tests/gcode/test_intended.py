"""What a file asks for, beside what motors with whole steps make of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillpath.gcode.firmware.planning import intended
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.pieces import Piece
from stillpath.gcode.types import Phases
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from tests.gcode.cutting import HEAD, pieces_of

FIRMWARES = Path(__file__).parents[2] / "examples" / "firmware"


def machine_with(kind: str) -> Machine:
    section = json.loads((FIRMWARES / f"{kind}.json").read_text())
    document = load_machine("ender3").model_dump(mode="json")
    return Machine.model_validate(document | {"firmware": section})


MACHINES = {kind: machine_with(kind) for kind in ("marlin", "reprapfirmware")}


def asked_for(piece: Piece, machine: Machine) -> Phases:
    return intended(
        piece.phases, piece.moves.start_mm, piece.moves.end_mm, adapter(machine).step_mm
    )


def ends_mm(phases: Phases) -> np.ndarray:
    begin, top, end = phases.start_mm_s, phases.cruise_mm_s, phases.end_mm_s
    ramps = 0.5 * (begin + top) * phases.accel_s + 0.5 * (top + end) * phases.decel_s
    return np.asarray(phases.start_mm + phases.direction * (ramps + top * phases.cruise_s)[:, None])


@pytest.mark.parametrize("kind", sorted(MACHINES))
@given(places=st.lists(st.tuples(st.integers(0, 30_000), st.integers(0, 30_000)), min_size=2))
def test_moves_end_where_the_file_says(kind: str, places: list[tuple[int, int]]) -> None:
    """In the firmware's times; Z and filament as they are."""
    machine = MACHINES[kind]
    lines = [f"G1 X{65 + x / 1e3:.3f} Y{55 + y / 1e3:.3f} E.1 F3000" for x, y in places]
    lines = [line for i, line in enumerate(lines) if i == 0 or line != lines[i - 1]]
    for piece in pieces_of(HEAD + "\n".join(lines) + "\nG1 E-1 F1800\n", machine):
        asked, stepped = asked_for(piece, machine), piece.phases
        np.testing.assert_array_equal(asked.t_s, stepped.t_s)
        np.testing.assert_array_equal(asked.direction[:, 2:], stepped.direction[:, 2:])
        way = np.abs(np.diff(np.vstack([piece.moves.start_mm[:1], piece.moves.end_mm]), axis=0))
        long = np.max(way[:, :2], axis=1) > 0.2  # shorter ones are swallowed
        wanted = piece.moves.end_mm[:, :2]
        np.testing.assert_allclose(ends_mm(asked)[long, :2], wanted[long], rtol=0, atol=1e-8)
        # The motion has no gaps.
        np.testing.assert_allclose(
            asked.start_mm[1:, :2], ends_mm(asked)[:-1, :2], rtol=0, atol=1e-8
        )
        assert np.max(np.abs(ends_mm(asked) - ends_mm(stepped))[:, :2]) < 0.0127 / 2.0


def test_what_is_swallowed_is_not_asked_for() -> None:
    """A move of less than six steps: the machine stays where it is, and so does what is asked."""
    machine = MACHINES["marlin"]
    text = "G1 X70.005 E1\nG1 X70.03\nG1 X80.005 Y60 E1\n"
    piece = pieces_of(HEAD + text, machine)[-1]
    asked = asked_for(piece, machine)
    assert piece.phases.cruise_s[1] == 0.0
    np.testing.assert_allclose(asked.start_mm[:, 0], [60.0, 70.005, 70.005], atol=1e-9)


def test_firmware_that_keeps_all_digits_does_what_is_asked() -> None:
    machine = load_machine("ender3")
    piece = pieces_of(HEAD + "G1 X70.00512 E1\nG1 X80 Y60 E1\n", machine)[-1]
    assert asked_for(piece, machine) is piece.phases


def test_nothing_is_asked_of_nothing() -> None:
    phases = pieces_of(HEAD + "G1 X70 E1\n", MACHINES["marlin"])[-1].phases
    none = replace(phases, **{name: getattr(phases, name)[:0] for name in Phases.__slots__})
    assert len(intended(none, np.zeros((0, 4)), np.zeros((0, 4)), (0.0125, 0.0125))) == 0
