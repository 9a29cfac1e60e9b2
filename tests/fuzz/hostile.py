"""Files made to be slow, large or wrong, as streams of bytes of any size.

Each generator takes a size and yields the file in pieces, so that a file of hundreds of megabytes
costs no memory to make. Beside it stands the size at which the pipeline must still be quick and
small.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import cos, pi, sin

__all__ = ["HOSTILE", "Hostile", "pieces"]

Hostile = Callable[[int], Iterator[bytes]]
Sized = tuple[Hostile, int]

HEAD = b"G28\nG90\nM83\nG1 X100 Y100 Z5 F6000\n"
TAIL = b"G1 X110 Y100 E.4 F3000\nG1 X110 Y110 E.4\nG1 X100 Y100 E.5\nM84\n"
_PIECE = 1 << 20


def pieces(name: str, size: int) -> Iterator[bytes]:
    """Yield the file of that name and size in pieces of about a megabyte."""
    held = bytearray()
    for part in HOSTILE[name][0](size):
        held += part
        if len(held) >= _PIECE:
            yield bytes(held)
            held.clear()
    yield bytes(held)


def _lines(size: int, line: bytes | Callable[[int], bytes], per: int = 1) -> Sized:
    """Return a print of `size` lines, `per` at a time, made from their number."""

    def file(size: int) -> Iterator[bytes]:
        yield HEAD
        for k in range(size // per):
            yield line if isinstance(line, bytes) else line(k)
        yield TAIL

    return file, size


def _filling(size: int, before: bytes, pattern: bytes, after: bytes) -> Sized:
    """Return a file with `size` bytes of a pattern."""

    def file(size: int) -> Iterator[bytes]:
        yield before
        yield from _filled(pattern, size)
        yield after

    return file, size


def _filled(pattern: bytes, size: int) -> Iterator[bytes]:
    whole, rest = divmod(size, len(pattern))
    for _ in range(whole):
        yield pattern
    yield pattern[:rest]


def long_comment(size: int) -> Iterator[bytes]:
    yield HEAD + b"; " + b"c" * size + b"\n"
    yield b"G1 X101 E.1 ; " + b"c" * size + b"\n"
    yield TAIL


def no_rest(size: int) -> Iterator[bytes]:
    """A spiral that never stops, with Z in every move."""
    yield HEAD
    for k in range(size):
        a = 2 * pi * k / 97
        yield b"G1 X%.3f Y%.3f Z%.5f E.02\n" % (100 + 9 * sin(a), 100 + 9 * cos(a), 5 + 5e-6 * k)
    yield TAIL


def lines_with_checksums(size: int) -> Iterator[bytes]:
    for k in range(size):
        line = b"N%d G1 X%d Y100 E.01 F3000" % (k + 1, 100 + k % 7)
        sum_ = 0
        for byte in line:
            sum_ ^= byte
        yield line + b"*%d\n" % sum_


def deep_expression(size: int) -> Iterator[bytes]:
    yield HEAD + b"G1 X{" + b"(" * size + b"\n" + TAIL


def nested_loops(size: int) -> Iterator[bytes]:
    yield HEAD
    for k in range(size):
        yield b" " * k + b"while true\n"
    yield b" " * size + b"G1 X101 E.1\n"


def thumbnails(size: int) -> Iterator[bytes]:
    for _ in range(0, size, 100_000):
        yield b"; thumbnail begin 640x480 98000\n"
        yield from _filled(b"; " + b"iVBORw0KGgo" * 7 + b"\n", 99_840)
        yield b"; thumbnail end\n"
    yield HEAD + TAIL


HOSTILE: dict[str, Sized] = {
    # Lines and bytes
    "long_comment": (long_comment, 20_000),
    "one_long_comment_line": _filling(100_000_000, HEAD + b"; ", b"x" * 1000, b"\n" + TAIL),
    "one_long_command_line": _filling(100_000_000, HEAD, b"X1 Y2 ", b"\n" + TAIL),
    "one_long_command_with_comment": _filling(
        100_000_000, HEAD + b"G1 X101 E.1 ;", b"x" * 1000, b"\n" + TAIL
    ),
    "no_newline": _filling(100_000_000, b"", b"G1 X100 Y100 E1 F3000 ", b""),
    "only_newlines": _filling(100_000_000, b"", b"\n" * 4096, b""),
    "only_returns": _filling(100_000_000, b"", b"\r" * 4096, b""),
    "only_nul": _filling(100_000_000, b"", bytes(4096), b""),
    "nul_lines": _lines(1_000_000, b"\x00\n"),
    "distinct_comments": _lines(1_000_000, lambda k: b";TYPE:feature %d\n" % k),
    "distinct_plain_comments": _lines(1_000_000, lambda k: b"; comment %d\n" % k),
    "distinct_layers": _lines(1_000_000, lambda k: b";LAYER:%d\n" % k),
    "distinct_heights": _lines(1_000_000, lambda k: b";LAYER_CHANGE\n;Z:%.3f\n" % (0.001 * k), 2),
    "unknown_words": _lines(1_000_000, lambda k: b"FOO_%d BAR=%d\n" % (k, k)),
    "exponents": _lines(300_000, lambda k: b"G1 X1.00000000000000%de0\n" % (k % 7)),
    # Tables that grow
    "set_positions": _lines(1_000_000, lambda k: b"G92 E%d.%03d\n" % divmod(k, 1000)),
    "moved_origins": _lines(1_000_000, lambda k: b"G92 X%d.%03d\n" % divmod(k, 1000)),
    "accelerations": _lines(1_000_000, lambda k: b"M204 S%d.%03d\n" % (500 + k // 1000, k % 1000)),
    "velocity_limits": _lines(
        1_000_000, lambda k: b"SET_VELOCITY_LIMIT ACCEL=%d.%03d\n" % (500 + k // 1000, k % 1000)
    ),
    "accelerations_in_motion": _lines(
        300_000,
        lambda k: (
            b"M204 S%d.%03d\nG1 X%s E.01\n"
            % (500 + k // 1000, k % 1000, b"100.3" if k % 2 else b"100")
        ),
    ),
    "speed_factors": _lines(
        1_000_000, lambda k: b"M220 S%d.%04d\n" % (50 + k // 10_000, k % 10_000)
    ),
    "flow_factors": _lines(
        1_000_000, lambda k: b"M221 S%d.%04d\n" % (50 + k // 10_000, k % 10_000)
    ),
    "object_names": _lines(1_000_000, lambda k: b"EXCLUDE_OBJECT_START NAME=o%d\n" % k),
    "object_numbers": _lines(1_000_000, lambda k: b"M486 S%d\n" % k),
    "saved_states": _lines(10_000, lambda k: b"SAVE_GCODE_STATE NAME=s%d\n" % k),
    "retraction_settings": _lines(
        1_000_000, lambda k: b"SET_RETRACTION RETRACT_LENGTH=%d.%04d\n" % divmod(k, 10_000)
    ),
    "offsets": _lines(1_000_000, lambda k: b"SET_GCODE_OFFSET Z=%d.%06d\n" % divmod(k, 1_000_000)),
    "tool_changes": _lines(
        100_000, lambda k: b"T%d\nG1 X%d Y100 E.01 F3000\n" % (k % 5, 100 + k % 3)
    ),
    "objects_in_turn": _lines(
        100_000,
        lambda k: (
            b"EXCLUDE_OBJECT_START NAME=a%d\nG1 X%d E.01 F3000\nEXCLUDE_OBJECT_END NAME=a%d\n"
            % (k, 100 + k % 3, k)
        ),
    ),
    # Motion
    "tiny_arcs": _lines(
        1_000_000, b"G2 X%d.01 Y100 I.005 J0 E.0004\nG3 X%d Y100 I-.005 J0 E.0004\n" % (100, 100), 2
    ),
    "huge_arc": _lines(1, b"G2 X101 Y100 I1000000000 J0 E.1\n"),
    "nearly_straight_arc": _lines(1, b"G3 X101 Y100 I.5 J1000000000 E.1\n"),
    "slow_factor": _lines(1, b"M220 S1e-9\nM220 S.000000001\nG1 X120 F3000\n"),
    "slow_feed": _lines(1, b"G1 X120 F.000000001\n"),
    # 20 mm at just under an hour each: legal, and 1e3 of them last a month.
    "nearly_an_hour": _lines(1000, lambda k: b"G1 X%d E.1 F.4\n" % (100 + 20 * (k % 2))),
    "long_dwells": _lines(1000, b"G4 P999999999\n"),
    "retractions_in_place": _lines(1_000_000, b"G1 E-.8 F2100\nG1 E.8 F2100\n", 2),
    "retractions_under_way": _lines(
        1_000_000,
        lambda k: (
            b"G1 E-.8 F2100\nG1 X%d F6000\nG1 E.8 F2100\nG1 X%d.5 E.02 F3000\n"
            % (100 + k % 9, 100 + k % 9)
        ),
        4,
    ),
    "extruder_micro_moves": _lines(1_000_000, b"G1 E.00001\nG1 E-.00001\n", 2),
    "micro_moves": _lines(1_000_000, b"G1 X100.000000001\nG1 X100\n", 2),
    "small_moves": _lines(
        1_000_000, lambda k: b"G1 X%d.%03d E.00004\n" % (100 + k // 1000 % 50, k % 1000)
    ),
    "equal_points": _lines(1_000_000, b"G1 X100 Y100\n"),
    "jitter": _lines(
        300_000, lambda k: b"G1 X%s Y%s E.001\n" % ((b"100", b"100.2"), (b"100.2", b"100"))[k % 2]
    ),
    "hops": _lines(100_000, lambda k: b"G1 Z5.4 F600\nG1 X%d F6000\nG1 Z5 F600\n" % (100 + k % 9)),
    "no_rest": (no_rest, 300_000),
    "lines_with_checksums": (lines_with_checksums, 100_000),
    "modes": _lines(1_000_000, b"G91\nG90\nM82\nM83\n", 4),
    "modes_in_motion": _lines(
        300_000, b"G91\nG1 X.1 E.01\nG90\nG1 X100 E.01\nM82\nG92 E0\nG1 X100.2 E.01\nM83\n", 8
    ),
    # Words of every kind in motion
    "feeds_in_turn": _lines(
        300_000, lambda k: b"G1 X%d.1 E.01 F%d\n" % (100 + k % 2, 600 + k % 5000)
    ),
    "origins_in_motion": _lines(100_000, lambda k: b"G92 X100 Y100\nG1 X100.%d E.01\n" % (k % 10)),
    "corners_in_motion": _lines(
        100_000,
        lambda k: (
            b"SET_VELOCITY_LIMIT SQUARE_CORNER_VELOCITY=%d\nM205 X%d\nM566 X%d\nG1 X%d.1 E.01\n"
            % (1 + k % 9, 1 + k % 9, 60 * (1 + k % 9), 100 + k % 2)
        ),
    ),
    "waits_in_motion": _lines(
        100_000, lambda k: b"M204 S%d\nG1 X%d.1 E.01\nM400\n" % (900 + k % 99, 100 + k % 2)
    ),
    "fans_in_motion": _lines(
        300_000, lambda k: b"M106 S%d\nG1 X%d.1 E.01\n" % (k % 256, 100 + k % 2)
    ),
    "pressures_in_motion": _lines(
        100_000,
        lambda k: (
            b"SET_PRESSURE_ADVANCE ADVANCE=.0%d\nM900 K.0%d\nM572 D0 S.0%d\nG1 X%d.1 E.01\n"
            % (k % 9, k % 9, k % 9, 100 + k % 2)
        ),
    ),
    "shapers_in_motion": _lines(
        100_000,
        lambda k: (
            b"SET_INPUT_SHAPER SHAPER_FREQ_X=%d\nM593 X F%d\nG1 X%d.1 E.01\n"
            % (30 + k % 9, 30 + k % 9, 100 + k % 2)
        ),
    ),
    "switched_in_motion": _lines(
        100_000,
        lambda k: (
            b"; STILLPATH_OFF\nG1 X100.5 E.01\n; STILLPATH_ON\nG1 X%d.1 E.01\n" % (100 + k % 2)
        ),
    ),
    "states_in_motion": _lines(
        100_000,
        lambda k: (
            b"SAVE_GCODE_STATE NAME=a\nG60 S0\nG1 X%d.5 E.01\nRESTORE_GCODE_STATE NAME=a MOVE=1\n"
            b"G61 S0\n" % (100 + k % 2)
        ),
    ),
    "garbage_in_motion": _lines(
        100_000, lambda k: b"\xff\x00\x80\x1b[%d;\xe2\x28\n; ok\nG1 X%d.1 E.01\n" % (k, 100 + k % 2)
    ),
    "one_move_layers": _lines(
        100_000,
        lambda k: (
            b";LAYER_CHANGE\n;Z:%.3f\n;TYPE:Perimeter\nG1 Z%.3f F600\nG1 X%d E.1 F3000\n"
            % (5 + 0.001 * k, 5 + 0.001 * k, 100 + k % 9)
        ),
    ),
    "marks_in_motion": _lines(
        100_000,
        lambda k: b"M73 P%d R%d\n; PAUSE_PRINT\nG1 X%d.1 E.01\n" % (k % 100, k, 100 + k % 2),
    ),
    "large_circles": _lines(10_000, b"G2 X100 Y100 I80 J0 E20 F12000\n"),
    "large_spirals": _lines(
        10_000, lambda k: b"G3 X100 Y100 Z%.4f I0 J70 E20 F12000\n" % (5 + 1e-3 * k)
    ),
    "splines": _lines(
        100_000,
        lambda k: b"G5 X%d Y100 I0 J3 P0 Q-3 E.1\nG5 X100 Y100 P0 Q3 E.1\n" % (100 + k % 9),
        2,
    ),
    # Words on their own
    "many_tools": _lines(100_000, lambda k: b"T%d\n" % k),
    "dwells_of_nothing": _lines(1_000_000, b"G4 P0\n"),
    "progress": _lines(300_000, lambda k: b"M73 P%d R%d\n" % (k % 100, k)),
    "long_names": _lines(
        10_000,
        lambda k: (
            b";TYPE:%d%s\nEXCLUDE_OBJECT_START NAME=%d%s\n" % (k, b"n" * 3000, k, b"n" * 3000)
        ),
    ),
    "long_messages": _lines(
        10_000, lambda k: b'M117 "%s\nFOO_%d A="%s\n' % (b"n" * 3000, k, b"' " * 1500)
    ),
    "lines_of_many_words": _lines(10_000, b"M118 " + b"A1 " * 2000 + b"\n"),
    "long_numbers": _lines(
        10_000, b"G1 X100.%s1 E.1\nG1 X%s101 E.1\n" % (b"0" * 1000, b"0" * 1000)
    ),
    "huge_numbers": _lines(10_000, b"M204 S" + b"9" * 400 + b"\nM73 P" + b"9" * 400 + b"\n"),
    "subprograms": _lines(10_000, lambda k: b'M98 P"a%d.g"\nM808 L0\nO%d\nM808\nM99\n' % (k, k)),
    "nested_expressions": _lines(10_000, b"G1 X{" + b"(" * 200 + b"100" + b")" * 200 + b"} E.1\n"),
    "deep_expression": (deep_expression, 20_000),
    "nested_loops": (nested_loops, 1000),
    # What slicers say about a file
    "settings_without_end": _filling(
        1_000_000, b"", b"; prusaslicer_config = begin\n; CONFIG_BLOCK_START\n", b"\n" + HEAD + TAIL
    ),
    "settings_of_nothing": _filling(
        1_000_000, b"; prusaslicer_config = begin", b" \n", HEAD + TAIL
    ),
    "generators": _filling(
        1_000_000, b"", b";GENERATOR.NAME:x\n; KISSlicer\n; generated by x\n", b"\n" + HEAD + TAIL
    ),
    "long_generator": _filling(1_000_000, b";GENERATOR.NAME:", b"x", b"\n" + HEAD + TAIL),
    "deep_settings": _filling(1_000_000, b";SETTING_3 ", b"[", b"\n" + HEAD + TAIL),
    "wide_settings": _filling(
        1_000_000, b';SETTING_3 {"global_quality": "[values]\\\\na', b" ", b'b"}\n' + HEAD + TAIL
    ),
    "wide_limits": _filling(200_000, b"M201 X1 Y", b"1", b"\n" + HEAD + TAIL),
    "thumbnails": (thumbnails, 10_000_000),
}
"""Generators by name, each with the size that the issue asks for."""
