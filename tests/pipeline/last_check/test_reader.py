"""The last check's own reader, by cases worked out by hand from the firmwares' sources."""

from __future__ import annotations

import io
import math
import random
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillpath.models.firmware import Firmware, Klipper, Marlin, RepRapFirmware
from stillpath.pipeline.last_check import _reader_kernels as at
from stillpath.pipeline.last_check.original import Original
from stillpath.pipeline.last_check.reader import Kind, Reader, code_of
from stillpath.pipeline.last_check.rules import rules_of
from tests.gcode.plain_reader import read

KLIPPER, MARLIN, REPRAP = Klipper(), Marlin(), RepRapFirmware()
INCHES = Marlin(inch_mode=True)
FOLDING = Marlin(case_insensitive=True)


def after(text: str, firmware: Firmware) -> Reader:
    reader = Reader(rules_of(firmware))
    for line in text.encode().split(b"\n"):
        if code_of(line):
            reader.carry_out(line)
    return reader


CASES: list[tuple[str, Firmware, dict[str, float]]] = [
    # Klipper: names go on to the next letter.
    ("G1 X5 Y6 Z7\nG0 X8", KLIPPER, {"X": 8, "Y": 6, "Z": 7}),
    ("G91\nG90 (said)\nG1 X5", KLIPPER, {"X": math.nan}),
    ("g1x5y6", KLIPPER, {"X": 5, "Y": 6}),
    ("G1 X5\nG01 X9", KLIPPER, {"X": math.nan}),  # may be a macro
    ("M82\nG1 X0 E1\nG91\nG1 E1", KLIPPER, {"FED": 2, "E": 2}),
    ("G1 X5 Y5\nG92", KLIPPER, {"X": 0, "Y": 0, "Z": 0}),
    ("G1 X1\nM83\nSAVE_GCODE_STATE NAME=s\nM82\nRESTORE_GCODE_STATE NAME=s", KLIPPER, {"REL": 1}),
    ("M82\nG1 X0 Y0 E1\nG2 X2 I1 E5", KLIPPER, {"FED": math.nan}),
    ("M83\nG1 X0 Y0 E1\nG2 X2 I1 E5", KLIPPER, {"FED": 6, "X": 2}),
    ("G1 X5 Y5\nSTART_PRINT\nG1 X6", KLIPPER, {"X": 6, "Y": math.nan}),
    # Marlin: G90 and G91 are of E too; lower case is no command.
    ("G1 X5\nG01 X9", MARLIN, {"X": 9}),
    ("G1 X5\ng1 X9", MARLIN, {"X": 5}),
    ("G1 X5\ng1 X9", FOLDING, {"X": 9}),
    ("M83\nG90\nG1 E5\nG1 E7", MARLIN, {"FED": 7, "REL": 0}),
    ("G91\nG1 E5\nG1 E7", MARLIN, {"FED": 12, "REL": 1}),
    ("G1 X5\nG92\nG92 X2", MARLIN, {"X": 2}),
    ("G20\nG1 X1", INCHES, {"X": 25.4}),
    ("G20\nG1 X1", MARLIN, {"X": 1}),
    ("G1 X5\nG1 X5E2", MARLIN, {"X": 5, "FED": 2}),
    ("N7 G1 X5*33", MARLIN, {"X": 5}),
    ("G1 X5 F100\nG1 X6 F0", MARLIN, {"F": 100}),
    ("G1 X0 Y0\nG2 X9 Y9", MARLIN, {"X": math.nan}),  # passed over: no centre
    # Perhaps passed over: from its centre the end lies where the beginning does.
    ("G1 X127.4 Y92.279\nG3 X100 Y104.303 I.082 J-.036", MARLIN, {"X": math.nan}),
    ("G1 X0 Y0\nG2 X10 Y0 I5 J0", MARLIN, {"X": 10}),
    ("G1 X0 Y0\nG2 X0 Y0 I5 J0", MARLIN, {"X": 0}),
    # Whether E is relative depends on G91 too, which nobody knows after an odd line.
    ("G91\n\\G90\nM82", KLIPPER, {"REL": math.nan}),
    ("G91\n\\G90\nM83", KLIPPER, {"REL": 1}),
    ("G91\n\\G90\nM82\nG90", KLIPPER, {"REL": 0}),
    # Numbers after the point of a command's name are passed over.
    ("M83\nG90.638\nG1 E5\nG1 E6", MARLIN, {"FED": 6}),
    # What stands after an odd character may be carried out, or not.
    ("M82\nG1 E1\nM83\rG1 X3\nG1 E3", MARLIN, {"FED": math.nan}),
    # RepRapFirmware: an E after a digit is an exponent, sums are checked, conditions hold lines.
    ("M83\nG91\nG1 E5\nG90\nG1 E5", REPRAP, {"FED": 10}),
    ("G1 X5 Y5\nG1X1Y1E2", REPRAP, {"X": math.nan}),
    ("G1 X5\nN1 G1 X7*98", REPRAP, {"X": 5}),
    ("G1 X5\nN1 G1 X7*102", REPRAP, {"X": 7}),
    ("G1 X5\nif true\n  G1 X9\nG1 Y2", REPRAP, {"X": math.nan}),
    ("G1 X5\nM120\nG91\nM121\nG1 X6", REPRAP, {"X": 6}),
    ("G1 X5 G1 Y5\nG1 Z3", REPRAP, {"X": math.nan}),
    ("G1 X5\nG10 P1 X3", REPRAP, {"X": math.nan}),
    ("G1 X5 ; G1 X9\n;G1 X9\nN3 ; G1 X9\nM117 G1 X9", REPRAP, {"X": 5}),
]


@pytest.mark.parametrize(("text", "firmware", "wanted"), CASES)
def test_firmwares(text: str, firmware: Firmware, wanted: dict[str, float]) -> None:
    state = after(text, firmware).state
    slots = {"X": at.X, "Y": at.Y, "Z": at.Z, "E": at.E, "F": at.F, "FED": at.FED}
    slots["REL"] = at.RELATIVE_E
    for name, value in wanted.items():
        np.testing.assert_allclose(state[slots[name]], value, err_msg=name)


def test_what_may_become_of_a_line() -> None:
    reader = after("G28\nG1 X5 Y5 Z1", MARLIN)
    kinds = [
        ("G1 X6", Kind.MOVES),
        ("G1 X6 E1", Kind.RESTS),
        ("G1 Z2", Kind.RESTS),
        ("G1 F600", Kind.STAYS),
        ("M105", Kind.STAYS),
        ("G3 X8 I1", Kind.PERHAPS),
        ("G1 X7 ABC", Kind.PERHAPS),
        ("G1 X8", Kind.PERHAPS),  # from where nobody knows
        ("M9999", Kind.STAYS),
    ]
    for text, kind in kinds:
        assert reader.carry_out(text.encode())[0] is kind, text


def test_after_a_move_that_may_wait_nobody_knows_what_moves() -> None:
    reader = Reader(rules_of(MARLIN), shortest_mm=0.15)
    for line in (b"G28", b"M83", b"G1 X5 Y5 Z1"):
        reader.carry_out(line)
    kinds = [
        ("G1 X6", Kind.MOVES),
        ("G1 X6 E.00004", Kind.RESTS),
        ("G1 X6.001 E.00004", Kind.PERHAPS),
        ("G1 X6.001 E.00004", Kind.PERHAPS),  # moves X by what waits
        ("G1 X6.001 E2", Kind.PERHAPS),
        ("G1 X6.001 E2", Kind.RESTS),  # nothing waits behind a long move
        ("G1 Y5.001", Kind.PERHAPS),
        ("G1 X9", Kind.MOVES),
        ("G1 X9 E1", Kind.RESTS),
    ]
    for text, kind in kinds:
        assert reader.carry_out(text.encode())[0] is kind, text


PLAIN = st.lists(
    st.one_of(
        st.builds(
            "G{} {} F{}".format,
            st.sampled_from("01"),
            st.permutations(["X{:.3f}", "Y{:.2f}", "Z{:.1f}", "E{:.5f}"]).flatmap(
                lambda words: st.tuples(*(st.floats(-50, 50) for _ in words[:3])).map(
                    lambda v: " ".join(w.format(n) for w, n in zip(words, v, strict=False))
                )
            ),
            st.integers(1, 9000),
        ),
        st.sampled_from(["G90", "G91", "M82", "M83", "G92 E0", "G92 X1 Y2", "M105", "; G1 X9"]),
    ),
    max_size=40,
)


@given(PLAIN, st.sampled_from(["klipper", "marlin"]))
def test_plain_programs_against_the_tests_reader(lines: list[str], name: Any) -> None:
    text = "\n".join(["G92 X0 Y0 Z0 E0", *lines])
    state = after(text, KLIPPER if name == "klipper" else MARLIN).state
    known = read(text.encode(), name)
    np.testing.assert_allclose(state[at.FED], sum(known.extruded_mm.values()), atol=1e-9)
    if not any(line.startswith("G92 X") for line in lines):
        np.testing.assert_allclose(state[: at.Z + 1], known.position_mm, atol=1e-9)


@given(PLAIN)
def test_kernels_read_as_the_slow_way_does(lines: list[str]) -> None:
    moves = [line for line in lines if line.startswith(("G0", "G1"))]
    text = np.frombuffer("".join(f"{line}\n" for line in moves).encode(), np.uint8)
    slow = after("\n".join(["M83", *moves]), MARLIN)
    quick = after("M83", MARLIN)
    nothing, (before, behind) = np.frombuffer(b"", np.uint8), np.zeros((2, at.SIZE))
    words, near_mm = np.zeros(at.WORD_COUNT), np.zeros(3)
    found = at.ours(
        text, 0, len(text), quick.state, words, nothing, False, False, before, behind, near_mm, 0.0
    )
    assert found == (len(text), len(moves), False, at.SAME)
    known = slice(at.WAITS)  # moves of ours do not wait
    np.testing.assert_allclose(quick.state[known], slow.state[known], rtol=1e-12)


# fmt: off
STEPS = [
    "G1 X5.01", "G1 X5", "G1  X5.02  Y5 ", "G0 Z.1", "G1 Z.1 E.00004", "G1 E2",
    "G1 E2.00003", "G1 F900", "G1 X9 Y9 F600", "G1 X5 ; moves", "G1 Y5.005", "g1 z3",
    "G2 X9 Y9 I2", "G3 X5 I1 J-2 E5", "G2 X5 I0 J0", "G2 X5 R5", "G17", "G18",
    "G90", "G91", "M82", "M83", "G92 E0", "G92 X5",
    "M204 S500", "M105", "START_PRINT", ";",
]
# fmt: on


@given(
    st.lists(st.sampled_from(STEPS), max_size=40),
    st.sampled_from([KLIPPER, MARLIN, FOLDING]),
    st.booleans(),
)
def test_what_is_waited_for_is_what_line_by_line_would_be(
    lines: list[str], firmware: Firmware, plain_start: bool
) -> None:
    lines = [*(["G92 X5 Y5 Z0 E0"] if plain_start else []), *lines]
    slow = Reader(rules_of(firmware), 0.05)
    steps = []
    perhaps: list[bytes] = []
    for number, line in enumerate(lines, 1):
        before, code = slow.state.copy(), code_of(line.encode())
        if not code:
            continue
        kind, _ = slow.carry_out(code)
        if kind is Kind.PERHAPS:
            perhaps.append(code)
        elif kind is not Kind.MOVES:
            steps.append((number, code, kind, perhaps, before, slow.state.copy()))
            perhaps = []
    original = Original(io.BytesIO("\n".join(lines).encode()), Reader(rules_of(firmware), 0.05))
    for number, code, kind, may_move, before, behind in steps:
        wanted = original.wanted()
        assert (wanted.line, wanted.code, wanted.kind) == (number, code, kind)
        assert list(original.perhaps) == may_move
        np.testing.assert_array_equal(original.reader.state, behind)
        if kind is Kind.RESTS:
            np.testing.assert_array_equal(wanted.before, before)
        original.perhaps.clear()
    assert original.wanted().code == b""
    np.testing.assert_array_equal(original.reader.state, slow.state)


def test_any_bytes_are_read() -> None:
    dice = random.Random(5)
    for firmware in (KLIPPER, MARLIN, REPRAP):
        reader = Reader(rules_of(firmware))
        for _ in range(3000):
            line = bytes(dice.choices(b'GMXYZEF0123. -;*N("{\x00\xff\\\t', k=dice.randrange(12)))
            if code_of(line):
                reader.carry_out(line)
