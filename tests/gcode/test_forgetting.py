"""Tables of modes and limits that have become large are begun anew; nobody notices."""

from __future__ import annotations

from dataclasses import fields
from itertools import pairwise

import numpy as np
import pytest

from stillpath.gcode import tables
from stillpath.gcode.firmware.planning import join_phases
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.pieces import Piece, VerbatimPart
from stillpath.gcode.types import Phases, ProgramBlock
from stillpath.models.machine import Machine
from tests.fuzz.machines import machine_of
from tests.gcode.cutting import HEAD, cut
from tests.gcode.prints import made_up_print

ROWS = 10_000
MOST_ROWS = tables._MOST_ROWS


@pytest.fixture(scope="module", params=["klipper", "marlin", "reprapfirmware"])
def machine(request: pytest.FixtureRequest) -> Machine:
    return machine_of(request.param)


def blocks_of(data: bytes, machine: Machine, chunk: int) -> list[ProgramBlock]:
    reader = Interpreter(machine)
    found = []
    for first in range(0, len(data), chunk):
        found += reader.push(data[first : first + chunk])
    return found + reader.flush()


def a_print(seed: int) -> bytes:
    """Acceleration and flow change between the moves, now and then to what was before."""
    lines = []
    for k, line in enumerate(made_up_print(seed, chapters=4).decode().splitlines()):
        lines.append(line)
        if k % 3 == 0 and k > 20:
            lines.append(f"M204 P{800 + k % 7} T{800 + k % 7}")
        if k % 5 == 0 and k > 20:
            lines.append(f"M221 S{90 + k % 11}")
    return "\n".join([*lines, ""]).encode()


def test_tables_stay_small(machine: Machine) -> None:
    """However many rows a file has; and what is in force is right all the same."""
    numbers = range(500, 500 + ROWS)
    moves = "G1 X60.5 E.01\nG1 X60 E.01\n"
    text = HEAD + "".join(f"M204 P{k} T{k}\nG92 X60.001\n{moves}" for k in numbers)
    blocks = blocks_of(text.encode(), machine, 1 << 17)
    rows_in_a_block = max(len(block.moves) for block in blocks)
    assert max(len(block.limits) for block in blocks) <= MOST_ROWS + rows_in_a_block
    assert max(len(block.modal) for block in blocks) <= MOST_ROWS + rows_in_a_block
    found = [block.limits[k].as_row() for block in blocks for k in block.moves.limits_id]
    column = found[-1].index(499 + ROWS)
    assert [row[column] for row in found[-2 * ROWS :: 2]] == list(numbers)


@pytest.mark.parametrize("seed", range(2))
def test_pieces_are_the_same(machine: Machine, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """Also where every block has tables of its own."""
    data = a_print(seed)
    wanted = cut(data, machine, longest_s=20.0)
    monkeypatch.setattr(tables, "_MOST_ROWS", 0)
    blocks = blocks_of(data, machine, 700)
    assert all(one.limits is not other.limits for one, other in pairwise(blocks))
    found = cut(data, machine, chunk=700, longest_s=20.0)
    pieces = [item for item in found if isinstance(item, Piece)]
    assert pieces
    for one, other in zip(pieces, [w for w in wanted if isinstance(w, Piece)], strict=True):
        assert one.text == other.text
        assert around(one) == around(other)
        assert same(one.phases, other.phases)
    # Where verbatim parts are cut depends on how the file arrives.
    assert along(found) == along(wanted)


@pytest.mark.parametrize("seed", range(2))
def test_plans_are_the_same(machine: Machine, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """A planner still has moves of the tables before when it gets to new ones."""
    data = a_print(seed)
    plans = []
    for most_rows in (MOST_ROWS, 0):
        monkeypatch.setattr(tables, "_MOST_ROWS", most_rows)
        planner = adapter(machine).planner()
        parts = [planner.push(block) for block in blocks_of(data, machine, 700)]
        plans.append(join_phases([*parts, planner.flush()]))
    assert same(*plans)


def around(item: VerbatimPart) -> tuple[object, ...]:
    return item.limits_before, item.limits_after, item.modal_before, item.modal_after


def along(items: list[Piece | VerbatimPart]) -> list[tuple[object, ...]]:
    """Return line, limits and modes of every row."""
    found = [
        (int(line), item.limits[a], item.modal[b])
        for item in items
        for rows in (item.moves, item.events)
        for line, a, b in zip(rows.line, rows.limits_id, rows.modal_id, strict=True)
    ]
    return sorted(found, key=lambda row: row[0])


def same(one: Phases, other: Phases) -> bool:
    return all(
        np.array_equal(getattr(one, field.name), getattr(other, field.name))
        for field in fields(Phases)
    )
