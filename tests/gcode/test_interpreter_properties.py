from __future__ import annotations

import re
from itertools import pairwise

import numpy as np
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.types import Events, Moves, ProgramBlock
from stillpath.models.machine import Machine
from tests.gcode.cutting import blocks_of

relaxed = settings(
    max_examples=60,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)

WORDS = st.sampled_from(
    [
        "G1", "G0", "g1", "G2", "G3", "G4", "G10", "G11", "G17", "G18", "G28", "G90", "G91", "G92",
        "M82", "M83", "M204", "M220", "M221", "M486", "M117", "T0", "N5", "G01", "G92.1",
        "SET_VELOCITY_LIMIT", "SAVE_GCODE_STATE", "RESTORE_GCODE_STATE", "SET_GCODE_OFFSET",
        "SET_RETRACTION", "EXCLUDE_OBJECT_START", "START_PRINT", ";TYPE:a", ";LAYER_CHANGE", ";Z:1",
        "X", "Y", "Z", "E", "F", "I", "J", "K", "S", "P", "T", "R", "X_ADJUST=", "MOVE=", "ACCEL=",
        "NAME=", "RETRACT_LENGTH=", "1", "2.5", "-.5", "+3", "0", "1e-2", "nan", "inf", "1e999",
        "1.2.3", "-", ".", "'", '"', "*", "*12", "(", ")",
        "#", "/", "_", "\t", "\r", "\x00", "\x0b",
        "µ", "\ufeff",
    ]
)  # fmt: skip
LINES = st.lists(st.lists(st.tuples(WORDS, st.sampled_from(["", " "])), max_size=7), max_size=12)
GRAMMAR = LINES.map(
    lambda lines: "\n".join("".join(a + b for a, b in line) for line in lines).encode()
)
NUMBERS = st.one_of(
    st.integers(-999, 999).map(str),
    st.floats(-999, 999, allow_nan=False).map(lambda v: f"{v:.4f}"),
    st.sampled_from(["+5", "5.", ".5", "-0", "-.5", "00012", "1.0000000000000000001"]),
)
PLAIN = st.lists(
    st.tuples(
        st.sampled_from(["G1", "G0", "M83", "M82", "G90", "G91", "G92", "M204", "; c", "G3 I1"]),
        st.lists(st.tuples(st.sampled_from("XYZE"), NUMBERS), max_size=4),
        st.sampled_from(["", "\r", " ", " ; end"]),
    ),
    max_size=30,
).map(
    lambda rows: "".join(
        f"{c} {' '.join(a + v for a, v in words)}{tail}\n" for c, words, tail in rows
    ).encode()
)


def outcome(data: bytes, cuts: list[int], machine: Machine) -> tuple[list[ProgramBlock], str]:
    interpreter = Interpreter(machine)
    blocks: list[ProgramBlock] = []
    bounds = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    try:
        for a, b in pairwise(bounds):
            blocks += interpreter.push(data[a:b])
        blocks += interpreter.flush()
    except GcodeError as error:
        return blocks, str(error)
    return blocks, ""


def column(blocks: list[ProgramBlock], part: str, name: str) -> np.ndarray:
    return np.concatenate([getattr(getattr(block, part), name) for block in blocks])


@relaxed
@given(st.one_of(st.binary(max_size=300), GRAMMAR))
@example(b"G1 X\xff5\n")
@example(b"\xef\xbb\xbf")
@example(b"G28\nG18\nG2 X1 K1\n")
def test_any_bytes(golden_machine: Machine, data: bytes) -> None:
    """Nothing but GcodeError comes out, and every byte belongs to exactly one line."""
    blocks, error = outcome(data, [], golden_machine)
    if error:
        assert re.match(r"line [1-9]\d*: ", error)
        return
    assert b"".join(block.text for block in blocks) == data
    if not blocks:
        return
    spans = {
        (int(a), int(b))
        for part in ("moves", "events")
        for a, b in zip(
            column(blocks, part, "byte_start"), column(blocks, part, "byte_end"), strict=True
        )
    }
    ordered = sorted(spans)
    assert ordered[0][0] == 0
    assert [a for a, _ in ordered[1:]] == [b for _, b in ordered[:-1]]
    assert ordered[-1][1] == len(data)
    assert np.all(np.isfinite(column(blocks, "moves", "end_mm")))
    assert np.all(column(blocks, "moves", "speed_mm_s") > 0)


@relaxed
@given(st.one_of(PLAIN, GRAMMAR), st.lists(st.integers(0, 600), max_size=6))
def test_cutting_does_not_matter(golden_machine: Machine, data: bytes, cuts: list[int]) -> None:
    whole, error = outcome(data, [], golden_machine)
    pieces, piece_error = outcome(data, cuts, golden_machine)
    assert piece_error == error
    if error or not whole:
        return
    for part, kind in (("moves", Moves), ("events", Events)):
        for name in kind.__dataclass_fields__:
            np.testing.assert_array_equal(column(pieces, part, name), column(whole, part, name))
    assert pieces[-1].modal == whole[-1].modal
    assert pieces[-1].limits == whole[-1].limits


@relaxed
@given(PLAIN)
def test_python_reads_as_the_kernel_does(golden_machine: Machine, data: bytes) -> None:
    """A word that the kernel cannot read sends the whole line to Python; nothing else changes."""
    slow = b"".join(
        line.replace(b" ", b" Q1.2.3 ", 1) if line.startswith((b"G", b"M")) else line
        for line in data.splitlines(keepends=True)
    )
    fast_blocks, error = outcome(data, [], golden_machine)
    slow_blocks, slow_error = outcome(slow, [], golden_machine)
    assert bool(error) == bool(slow_error)
    if error or not fast_blocks:
        return
    for name in ("start_mm", "end_mm", "speed_mm_s", "line", "known"):
        np.testing.assert_array_equal(
            column(fast_blocks, "moves", name), column(slow_blocks, "moves", name)
        )


def test_long_arcs_and_many_lines(golden_machine: Machine) -> None:
    """Blocks are flushed when full; one arc may be longer than a block."""
    text = "G28\nG1 X900\n" + "G2 I-900 J0\n" * 2 + "G1 X0\nG1 X1\n" * 30_000
    blocks = blocks_of(text.encode(), golden_machine)
    assert len(blocks) > 2
    assert sum(len(block.moves) for block in blocks) == 1 + 2 * 56_548 + 60_000
    assert b"".join(block.text for block in blocks) == text.encode()
    firsts = np.cumsum([0, *(len(block.moves) for block in blocks)])[:-1]
    assert [block.first_move for block in blocks] == firsts.tolist()
