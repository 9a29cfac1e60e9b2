"""The kernel of plain lines against the kernel of all lines, and its numbers against Python's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from stillpath.gcode import _slots as at
from stillpath.gcode._plain_kernels import decimal
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.types import Events, Moves, ProgramBlock
from stillpath.models.firmware import Klipper, Marlin, RepRapFirmware
from stillpath.models.machine import Machine

relaxed = settings(
    max_examples=60,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
DIGITS = st.text("0123456789", max_size=9)
NUMBERS = st.builds(
    lambda sign, whole, point, fraction: sign + whole + point + fraction,
    st.sampled_from(["", "", "-", "+"]),
    DIGITS,
    st.sampled_from(["", ".", ".."]),
    DIGITS,
)
WORDS = st.builds(lambda a, b: a + b, st.sampled_from("XXYYZEFxeSG"), NUMBERS)
LINES = st.one_of(
    st.builds(
        lambda head, words, tail: " ".join([head, *words]) + tail,
        st.sampled_from(["G1", "G0", "G1", "g1", "G01", "N3 G1", "G92", "M106", "M204", "M73"]),
        st.lists(WORDS, max_size=5),
        st.sampled_from(["", "", " ", "\r", " ; end", ";end", "*3"]),
    ),
    st.sampled_from(
        ["", " ", ";", "; text", ";TYPE:a", ";WIDTH:0.4", ";LAYER_CHANGE", ";Z:0.2", "M83", "M82",
         "G91", "G90", "G28", "M221 S50", "M220 S70", "T1", "G20", "G21", "M117 hello G1"]
    ),
)  # fmt: skip


def outcome(data: bytes, machine: Machine, *, plain: bool) -> tuple[list[ProgramBlock], str]:
    interpreter = Interpreter(machine)
    interpreter.state.i[at.I_PLAIN] = int(plain)
    blocks: list[ProgramBlock] = []
    try:
        blocks += [*interpreter.push(data), *interpreter.flush()]
    except GcodeError as error:
        return blocks, str(error)
    return blocks, ""


@pytest.mark.slow
@pytest.mark.parametrize("firmware", [Klipper(), Marlin(), RepRapFirmware()])
@relaxed
@given(lines=st.lists(LINES, max_size=30))
@example(lines=["G1 X1 F60", "M220 S50", "G1 E1", "G1 X5 E1"])
@example(lines=["G28", "G1 X1 Y1 Z1 F600", "G1 X1000.0005"])
@example(lines=["G28", "G1 X1 F600", "G1 X1234567.1234567"])
def test_same_as_the_slow_kernel(golden_machine: Machine, firmware, lines: list[str]) -> None:
    facts = firmware.model_copy(update={"home_mm": (0.0, 0.0, 0.0)})
    machine = golden_machine.model_copy(update={"firmware": facts})
    data = "\n".join(lines).encode()
    fast, error = outcome(data, machine, plain=True)
    slow, slow_error = outcome(data, machine, plain=False)
    assert error == slow_error
    for part, kind in (("moves", Moves), ("events", Events)):
        for name in kind.__dataclass_fields__:
            columns = [
                [getattr(getattr(block, part), name) for block in blocks] for blocks in (fast, slow)
            ]
            np.testing.assert_array_equal(*(np.concatenate(c) if c else [] for c in columns))
    assert [block.modal for block in fast] == [block.modal for block in slow]


@relaxed
@given(NUMBERS, st.sampled_from([" ", "\n", "E", ";", "/", ":", "\xff"]))
def test_numbers_are_read_as_python_reads_them(text: str, behind: str) -> None:
    """A number that is read is the double that Python reads, and ends where it ends."""
    raw = np.frombuffer((text + behind + "\n" * 16).encode("latin-1"), np.uint8)
    value, end = decimal(raw, 0)
    if end < 0:
        digits = text.lstrip("+-")
        whole, _, fraction = digits.partition(".")
        # What is left to the slow kernel: no digits, two points, parts of more than 7.
        assert (
            not digits.strip(".") or digits.count(".") > 1 or max(map(len, (whole, fraction))) >= 7
        )
        return
    assert (value, end) == (float(text[:end]), end)
    assert text[end : end + 1] in ("", ".")


def test_hostile_input(golden_machine: Machine) -> None:
    """Linear in time and bounded in memory, or refused with the reason."""
    interpreter = Interpreter(golden_machine, strict_bounds=False)
    interpreter.push(
        b";" + b"x" * 20_000 + b"\nEXCLUDE_OBJECT_DEFINE NAME=a POLYGON=" + b"1" * 7500
    )
    interpreter.push(b"\n")
    endless = b"x" * (1 << 25)
    with pytest.raises(GcodeError, match="bytes; is this G-code"):
        interpreter.push(endless)
    command = Interpreter(golden_machine)
    with pytest.raises(GcodeError, match="65536 characters"):
        command.push(b"G1 X" + b"1" * 70_000 + b"\n")
    arcs = Interpreter(golden_machine, strict_bounds=False)
    arcs.push(b"G28\nG1 X1 F600\n")
    count = sum(len(b.moves) for b in arcs.push(b"G2 X1.001 I.0005\nG2 X1 I-.0005\n" * 50_000))
    assert count == 100_000
    with pytest.raises(GcodeError, match="pieces"):
        arcs.push(b"G2 X5 I1000000000 J0\n")
