"""MeatPack: worked examples, round trips, and data that is no MeatPack."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillpath.gcode.containers.meatpack import Unpacker, pack
from stillpath.gcode.errors import GcodeError
from tests.gcode.container_files import normal

ON, OFF, RESET = b"\xff\xff\xfb", b"\xff\xff\xfa", b"\xff\xff\xf9"
NO_SPACES, SPACES = b"\xff\xff\xf7", b"\xff\xff\xf6"

numbers = st.from_regex(rb"-?[0-9]{0,3}(\.[0-9]{0,5})?", fullmatch=True)
moves = st.lists(st.tuples(st.sampled_from(b"XYZEFIJR"), numbers), max_size=5).map(
    lambda words: b"G1" + b"".join(b" %c%s" % word for word in words)
)
others = st.sampled_from(
    [
        b"; a comment, Gx E1",
        b"M73 P1 R2",
        b'M862.3 P "MINI"',
        b"EXCLUDE_OBJECT_START NAME=G1X",
        b"SET_VELOCITY_LIMIT ACCEL=1e4",
        "M117 22 \N{DEGREE SIGN}C".encode(),
        b"G28 X Y",
        b"T0\r",
        b" G1 X5Y6",
        b"g1x1",
        b";",
    ]
)
prints = st.lists(moves | others, min_size=1).map(lambda lines: b"\n".join(lines) + b"\n")
anything = st.binary(max_size=300).map(lambda data: data.replace(b"\xff", b"\n"))


def unpack(data: bytes) -> bytes:
    return Unpacker().push(data)


@pytest.mark.parametrize(
    ("text", "packed"),
    [
        # Digits are themselves, then 10 '.', 11 'E', 12 line end, 13 'G', 14 'X', 15 not packed;
        # the first character of a pair is in the low half.
        (b"G1 X10\n", b"\x1d\x1e\xc0"),
        (b"G1 X1\n", b"\x1d\x1e\xcc"),
        (b"G1 Y2\n", b"\x1d\x2fY\xcc"),
        (b"G1 E.5\n", b"\x1d\xab\xc5"),
        (b"M3\n", b"\x3fM\xcc"),
        (b"M T\n", b"\xffM \xcfT"),
    ],
)
def test_lines_packed_by_hand(text: bytes, packed: bytes):
    assert pack(text) == ON + NO_SPACES + packed
    assert unpack(ON + NO_SPACES + packed) == text


@pytest.mark.parametrize(
    ("packed", "text"),
    [
        (b"M1\nM2", b"M1\nM2"),
        (ON + b"\x1d\xeb\xc1", b"G1 X1\n"),
        (ON + NO_SPACES + b"\x1d\x1e\xcc" + SPACES + b"\x1d\xeb\xc2", b"G1 X1\nG1 X2\n"),
        (ON + b"\x1d\x1e\xcc" + RESET + b"M3\n", b"G1 X1\nM3\n"),
        # After a line end the second half is void.
        (ON + NO_SPACES + b"\x1d\x1e\x9c\x1d\xc2", b"G1 X1\nG12\n"),
        # Line ends are padding; spaces come back in lines of G only.
        (OFF + b"\n\nG1X1Y2\n\n\nM3X1\n;G1X2\n", b"G1 X1 Y2\nM3X1\n;G1X2\n"),
        (OFF + b"G92E0\nG1  X1\tY2B3\n", b"G92 E0\nG1  X1\t Y2B3\n"),
        (OFF + b"a\xffb", b"a\xffb"),
    ],
)
def test_what_others_write(packed: bytes, text: bytes):
    assert unpack(packed) == text


def test_a_line_may_go_on_in_the_next_block():
    unpacker = Unpacker()
    assert unpacker.push(ON + NO_SPACES + b"\x1d\x1e") == b"G1 X1"
    assert unpacker.push(OFF + b"2Y3\n") == b"2 Y3\n"
    assert unpacker.push(OFF + b"\nM1\n") == b"M1\n"


@pytest.mark.parametrize(
    "packed", [ON + b"\x0f", ON + b"\xf1", ON + b"\xffa", b"\xff", b"\xff\xff"]
)
def test_an_open_character_is_told(packed: bytes):
    with pytest.raises(ValueError, match="in the middle"):
        unpack(packed)


def test_the_signal_is_no_character():
    with pytest.raises(GcodeError, match=r"255 .*'; caf"):
        pack(b"G1 X1\n; caf\xff\n")


@given(prints)
def test_lines_come_back(text: bytes):
    assert unpack(pack(text)) == normal(text)
    assert unpack(pack(normal(text))) == normal(text)


@given(anything)
def test_any_text_comes_back_in_its_normal_form(text: bytes):
    assert unpack(pack(text)) == normal(text)


@given(st.binary(max_size=300), st.booleans())
def test_any_data_is_text_or_an_error(data: bytes, packing: bool):
    try:
        text = unpack((ON if packing else b"") + data)
    except ValueError:
        return
    assert len(text) <= 4 * len(data)
