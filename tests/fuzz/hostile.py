"""Files made to be slow, large or wrong, as streams of bytes of any size.

Each generator takes a size and yields the file in pieces, so that a file of hundreds of megabytes
costs no memory to make. `SIZES` are the sizes at which the pipeline must still be quick and small.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import cos, pi, sin

__all__ = ["HOSTILE", "Hostile", "pieces"]

Hostile = Callable[[int], Iterator[bytes]]

HEAD = b"G28\nG90\nM83\nG1 X100 Y100 Z5 F6000\n"
TAIL = b"G1 X110 Y100 E.4 F3000\nG1 X110 Y110 E.4\nG1 X100 Y100 E.5\nM84\n"
_PIECE = 1 << 20

HOSTILE: dict[str, tuple[Hostile, int]] = {}
"""Generators by name, each with the size that the issue asks for."""


def hostile(size: int) -> Callable[[Hostile], Hostile]:
    def enter(generator: Hostile) -> Hostile:
        HOSTILE[generator.__name__] = (generator, size)
        return generator

    return enter


def pieces(name: str, size: int) -> Iterator[bytes]:
    """Yield the file of that name and size in pieces of about a megabyte."""
    held = bytearray()
    for part in HOSTILE[name][0](size):
        held += part
        if len(held) >= _PIECE:
            yield bytes(held)
            held.clear()
    yield bytes(held)


def _framed(lines: Iterator[bytes]) -> Iterator[bytes]:
    yield HEAD
    yield from lines
    yield TAIL


# Lines and bytes


@hostile(20_000)
def long_comment(size: int) -> Iterator[bytes]:
    yield HEAD + b"; " + b"c" * size + b"\n"
    yield b"G1 X101 E.1 ; " + b"c" * size + b"\n"
    yield TAIL


@hostile(100_000_000)
def one_long_comment_line(size: int) -> Iterator[bytes]:
    yield HEAD + b"; "
    yield from _filled(b"x" * 1000, size)
    yield b"\n" + TAIL


@hostile(100_000_000)
def one_long_command_line(size: int) -> Iterator[bytes]:
    yield HEAD
    yield from _filled(b"X1 Y2 ", size)
    yield b"\n" + TAIL


@hostile(100_000_000)
def one_long_command_with_comment(size: int) -> Iterator[bytes]:
    yield HEAD + b"G1 X101 E.1 ;"
    yield from _filled(b"x" * 1000, size)
    yield b"\n" + TAIL


@hostile(100_000_000)
def no_newline(size: int) -> Iterator[bytes]:
    yield from _filled(b"G1 X100 Y100 E1 F3000 ", size)


@hostile(100_000_000)
def only_newlines(size: int) -> Iterator[bytes]:
    yield from _filled(b"\n" * 4096, size)


@hostile(100_000_000)
def only_returns(size: int) -> Iterator[bytes]:
    yield from _filled(b"\r" * 4096, size)


@hostile(100_000_000)
def only_nul(size: int) -> Iterator[bytes]:
    yield from _filled(bytes(4096), size)


@hostile(1_000_000)
def nul_lines(size: int) -> Iterator[bytes]:
    yield from _framed(b"\x00\n" for _ in range(size))


@hostile(1_000_000)
def distinct_comments(size: int) -> Iterator[bytes]:
    yield from _framed(b";TYPE:feature %d\n" % k for k in range(size))


@hostile(1_000_000)
def distinct_plain_comments(size: int) -> Iterator[bytes]:
    yield from _framed(b"; comment %d\n" % k for k in range(size))


@hostile(1_000_000)
def distinct_layers(size: int) -> Iterator[bytes]:
    yield from _framed(b";LAYER:%d\n" % k for k in range(size))


@hostile(1_000_000)
def distinct_heights(size: int) -> Iterator[bytes]:
    yield from _framed(b";LAYER_CHANGE\n;Z:%.3f\n" % (0.001 * k) for k in range(size // 2))


@hostile(1_000_000)
def unknown_words(size: int) -> Iterator[bytes]:
    yield from _framed(b"FOO_%d BAR=%d\n" % (k, k) for k in range(size))


@hostile(300_000)
def exponents(size: int) -> Iterator[bytes]:
    yield from _framed(b"G1 X1.00000000000000%de0\n" % (k % 7) for k in range(size))


# Tables that grow


@hostile(1_000_000)
def set_positions(size: int) -> Iterator[bytes]:
    yield from _framed(b"G92 E%d.%03d\n" % divmod(k, 1000) for k in range(size))


@hostile(1_000_000)
def moved_origins(size: int) -> Iterator[bytes]:
    yield from _framed(b"G92 X%d.%03d\n" % divmod(k, 1000) for k in range(size))


@hostile(1_000_000)
def accelerations(size: int) -> Iterator[bytes]:
    yield from _framed(b"M204 S%d.%03d\n" % (500 + k // 1000, k % 1000) for k in range(size))


@hostile(1_000_000)
def velocity_limits(size: int) -> Iterator[bytes]:
    yield from _framed(
        b"SET_VELOCITY_LIMIT ACCEL=%d.%03d\n" % (500 + k // 1000, k % 1000) for k in range(size)
    )


@hostile(300_000)
def accelerations_in_motion(size: int) -> Iterator[bytes]:
    yield from _framed(
        b"M204 S%d.%03d\nG1 X%s E.01\n" % (500 + k // 1000, k % 1000, b"100.3" if k % 2 else b"100")
        for k in range(size)
    )


@hostile(1_000_000)
def speed_factors(size: int) -> Iterator[bytes]:
    yield from _framed(b"M220 S%d.%04d\n" % (50 + k // 10_000, k % 10_000) for k in range(size))


@hostile(1_000_000)
def flow_factors(size: int) -> Iterator[bytes]:
    yield from _framed(b"M221 S%d.%04d\n" % (50 + k // 10_000, k % 10_000) for k in range(size))


@hostile(1_000_000)
def object_names(size: int) -> Iterator[bytes]:
    yield from _framed(b"EXCLUDE_OBJECT_START NAME=o%d\n" % k for k in range(size))


@hostile(1_000_000)
def object_numbers(size: int) -> Iterator[bytes]:
    yield from _framed(b"M486 S%d\n" % k for k in range(size))


@hostile(10_000)
def saved_states(size: int) -> Iterator[bytes]:
    yield from _framed(b"SAVE_GCODE_STATE NAME=s%d\n" % k for k in range(size))


@hostile(1_000_000)
def retraction_settings(size: int) -> Iterator[bytes]:
    yield from _framed(b"SET_RETRACTION RETRACT_LENGTH=%d.%04d\n" % divmod(k, 10_000)
                       for k in range(size))  # fmt: skip


@hostile(1_000_000)
def offsets(size: int) -> Iterator[bytes]:
    yield from _framed(b"SET_GCODE_OFFSET Z=%d.%06d\n" % divmod(k, 1_000_000)
                       for k in range(size))  # fmt: skip


@hostile(100_000)
def tool_changes(size: int) -> Iterator[bytes]:
    yield from _framed(b"T%d\nG1 X%d Y100 E.01 F3000\n" % (k % 5, 100 + k % 3)
                       for k in range(size))  # fmt: skip


@hostile(100_000)
def objects_in_turn(size: int) -> Iterator[bytes]:
    yield from _framed(
        b"EXCLUDE_OBJECT_START NAME=a%d\nG1 X%d E.01 F3000\nEXCLUDE_OBJECT_END NAME=a%d\n"
        % (k, 100 + k % 3, k)
        for k in range(size)
    )


# Motion


@hostile(1_000_000)
def tiny_arcs(size: int) -> Iterator[bytes]:
    yield from _framed(b"G2 X%d.01 Y100 I.005 J0 E.0004\nG3 X%d Y100 I-.005 J0 E.0004\n"
                       % (100, 100) for _ in range(size // 2))  # fmt: skip


@hostile(1)
def huge_arc(size: int) -> Iterator[bytes]:
    yield from _framed(b"G2 X101 Y100 I1000000000 J0 E.1\n" for _ in range(size))


@hostile(1)
def nearly_straight_arc(size: int) -> Iterator[bytes]:
    yield from _framed(b"G3 X101 Y100 I.5 J1000000000 E.1\n" for _ in range(size))


@hostile(1)
def slow_factor(size: int) -> Iterator[bytes]:
    yield from _framed(b"M220 S1e-9\nM220 S.000000001\nG1 X120 F3000\n" for _ in range(size))


@hostile(1)
def slow_feed(size: int) -> Iterator[bytes]:
    yield from _framed(b"G1 X120 F.000000001\n" for _ in range(size))


@hostile(1000)
def nearly_an_hour(size: int) -> Iterator[bytes]:
    # 20 mm at just under an hour each: legal, and 1e3 of them last a month.
    yield from _framed(b"G1 X%d E.1 F.4\n" % (100 + 20 * (k % 2)) for k in range(size))


@hostile(1000)
def long_dwells(size: int) -> Iterator[bytes]:
    yield from _framed(b"G4 P999999999\n" for _ in range(size))


@hostile(1_000_000)
def retractions_in_place(size: int) -> Iterator[bytes]:
    yield from _framed(b"G1 E-.8 F2100\nG1 E.8 F2100\n" for _ in range(size // 2))


@hostile(1_000_000)
def retractions_under_way(size: int) -> Iterator[bytes]:
    yield from _framed(b"G1 E-.8 F2100\nG1 X%d F6000\nG1 E.8 F2100\nG1 X%d.5 E.02 F3000\n"
                       % (100 + k % 9, 100 + k % 9) for k in range(size // 4))  # fmt: skip


@hostile(1_000_000)
def extruder_micro_moves(size: int) -> Iterator[bytes]:
    yield from _framed(b"G1 E.00001\nG1 E-.00001\n" for _ in range(size // 2))


@hostile(1_000_000)
def micro_moves(size: int) -> Iterator[bytes]:
    yield from _framed(b"G1 X100.000000001\nG1 X100\n" for _ in range(size // 2))


@hostile(1_000_000)
def small_moves(size: int) -> Iterator[bytes]:
    yield from _framed(b"G1 X%d.%03d E.00004\n" % (100 + k // 1000 % 50, k % 1000)
                       for k in range(size))  # fmt: skip


@hostile(1_000_000)
def equal_points(size: int) -> Iterator[bytes]:
    yield from _framed(b"G1 X100 Y100\n" for _ in range(size))


@hostile(300_000)
def jitter(size: int) -> Iterator[bytes]:
    yield from _framed(b"G1 X%s Y%s E.001\n" % ((b"100", b"100.2"), (b"100.2", b"100"))[k % 2]
                       for k in range(size))  # fmt: skip


@hostile(100_000)
def hops(size: int) -> Iterator[bytes]:
    yield from _framed(b"G1 Z5.4 F600\nG1 X%d F6000\nG1 Z5 F600\n" % (100 + k % 9)
                       for k in range(size))  # fmt: skip


@hostile(300_000)
def no_rest(size: int) -> Iterator[bytes]:
    """A spiral that never stops, with Z in every move."""
    yield HEAD
    for k in range(size):
        a = 2 * pi * k / 97
        yield b"G1 X%.3f Y%.3f Z%.5f E.02\n" % (100 + 9 * sin(a), 100 + 9 * cos(a), 5 + 5e-6 * k)
    yield TAIL


@hostile(100_000)
def lines_with_checksums(size: int) -> Iterator[bytes]:
    for k in range(size):
        line = b"N%d G1 X%d Y100 E.01 F3000" % (k + 1, 100 + k % 7)
        sum_ = 0
        for byte in line:
            sum_ ^= byte
        yield line + b"*%d\n" % sum_


@hostile(1_000_000)
def modes(size: int) -> Iterator[bytes]:
    yield from _framed(b"G91\nG90\nM82\nM83\n" for _ in range(size // 4))


@hostile(300_000)
def modes_in_motion(size: int) -> Iterator[bytes]:
    yield from _framed(
        b"G91\nG1 X.1 E.01\nG90\nG1 X100 E.01\nM82\nG92 E0\nG1 X100.2 E.01\nM83\n"
        for _ in range(size // 8)
    )


# Words of every kind in motion


@hostile(300_000)
def feeds_in_turn(size: int) -> Iterator[bytes]:
    yield from _framed(b"G1 X%d.1 E.01 F%d\n" % (100 + k % 2, 600 + k % 5000)
                       for k in range(size))  # fmt: skip


@hostile(100_000)
def origins_in_motion(size: int) -> Iterator[bytes]:
    yield from _framed(b"G92 X100 Y100\nG1 X100.%d E.01\n" % (k % 10) for k in range(size))


@hostile(100_000)
def corners_in_motion(size: int) -> Iterator[bytes]:
    yield from _framed(
        b"SET_VELOCITY_LIMIT SQUARE_CORNER_VELOCITY=%d\nM205 X%d\nM566 X%d\nG1 X%d.1 E.01\n"
        % (1 + k % 9, 1 + k % 9, 60 * (1 + k % 9), 100 + k % 2)
        for k in range(size)
    )


@hostile(100_000)
def waits_in_motion(size: int) -> Iterator[bytes]:
    yield from _framed(b"M204 S%d\nG1 X%d.1 E.01\nM400\n" % (900 + k % 99, 100 + k % 2)
                       for k in range(size))  # fmt: skip


@hostile(300_000)
def fans_in_motion(size: int) -> Iterator[bytes]:
    yield from _framed(b"M106 S%d\nG1 X%d.1 E.01\n" % (k % 256, 100 + k % 2) for k in range(size))


@hostile(100_000)
def pressures_in_motion(size: int) -> Iterator[bytes]:
    yield from _framed(
        b"SET_PRESSURE_ADVANCE ADVANCE=.0%d\nM900 K.0%d\nM572 D0 S.0%d\nG1 X%d.1 E.01\n"
        % (k % 9, k % 9, k % 9, 100 + k % 2)
        for k in range(size)
    )


@hostile(100_000)
def shapers_in_motion(size: int) -> Iterator[bytes]:
    yield from _framed(
        b"SET_INPUT_SHAPER SHAPER_FREQ_X=%d\nM593 X F%d\nG1 X%d.1 E.01\n"
        % (30 + k % 9, 30 + k % 9, 100 + k % 2)
        for k in range(size)
    )


@hostile(100_000)
def switched_in_motion(size: int) -> Iterator[bytes]:
    yield from _framed(
        b"; STILLPATH_OFF\nG1 X100.5 E.01\n; STILLPATH_ON\nG1 X%d.1 E.01\n" % (100 + k % 2)
        for k in range(size)
    )


@hostile(100_000)
def states_in_motion(size: int) -> Iterator[bytes]:
    yield from _framed(
        b"SAVE_GCODE_STATE NAME=a\nG60 S0\nG1 X%d.5 E.01\nRESTORE_GCODE_STATE NAME=a MOVE=1\n"
        b"G61 S0\n" % (100 + k % 2)
        for k in range(size)
    )


@hostile(100_000)
def garbage_in_motion(size: int) -> Iterator[bytes]:
    yield from _framed(b"\xff\x00\x80\x1b[%d;\xe2\x28\n; ok\nG1 X%d.1 E.01\n" % (k, 100 + k % 2)
                       for k in range(size))  # fmt: skip


@hostile(100_000)
def one_move_layers(size: int) -> Iterator[bytes]:
    yield from _framed(
        b";LAYER_CHANGE\n;Z:%.3f\n;TYPE:Perimeter\nG1 Z%.3f F600\nG1 X%d E.1 F3000\n"
        % (5 + 0.001 * k, 5 + 0.001 * k, 100 + k % 9)
        for k in range(size)
    )


@hostile(100_000)
def marks_in_motion(size: int) -> Iterator[bytes]:
    yield from _framed(b"M73 P%d R%d\n; PAUSE_PRINT\nG1 X%d.1 E.01\n" % (k % 100, k, 100 + k % 2)
                       for k in range(size))  # fmt: skip


@hostile(10_000)
def large_circles(size: int) -> Iterator[bytes]:
    yield from _framed(b"G2 X100 Y100 I80 J0 E20 F12000\n" for _ in range(size))


@hostile(10_000)
def large_spirals(size: int) -> Iterator[bytes]:
    yield from _framed(b"G3 X100 Y100 Z%.4f I0 J70 E20 F12000\n" % (5 + 1e-3 * k)
                       for k in range(size))  # fmt: skip


@hostile(100_000)
def splines(size: int) -> Iterator[bytes]:
    yield from _framed(b"G5 X%d Y100 I0 J3 P0 Q-3 E.1\nG5 X100 Y100 P0 Q3 E.1\n" % (100 + k % 9)
                       for k in range(size // 2))  # fmt: skip


# Words on their own


@hostile(100_000)
def many_tools(size: int) -> Iterator[bytes]:
    yield from _framed(b"T%d\n" % k for k in range(size))


@hostile(1_000_000)
def dwells_of_nothing(size: int) -> Iterator[bytes]:
    yield from _framed(b"G4 P0\n" for _ in range(size))


@hostile(300_000)
def progress(size: int) -> Iterator[bytes]:
    yield from _framed(b"M73 P%d R%d\n" % (k % 100, k) for k in range(size))


@hostile(10_000)
def long_names(size: int) -> Iterator[bytes]:
    yield from _framed(
        b";TYPE:%d%s\nEXCLUDE_OBJECT_START NAME=%d%s\n" % (k, b"n" * 3000, k, b"n" * 3000)
        for k in range(size)
    )


@hostile(10_000)
def long_messages(size: int) -> Iterator[bytes]:
    yield from _framed(b'M117 "%s\nFOO_%d A="%s\n' % (b"n" * 3000, k, b"' " * 1500)
                       for k in range(size))  # fmt: skip


@hostile(10_000)
def lines_of_many_words(size: int) -> Iterator[bytes]:
    yield from _framed(b"M118 " + b"A1 " * 2000 + b"\n" for _ in range(size))


@hostile(10_000)
def long_numbers(size: int) -> Iterator[bytes]:
    digits = b"0" * 1000
    yield from _framed(b"G1 X100.%s1 E.1\nG1 X%s101 E.1\n" % (digits, digits) for _ in range(size))


@hostile(10_000)
def huge_numbers(size: int) -> Iterator[bytes]:
    yield from _framed(
        b"M204 S" + b"9" * 400 + b"\nM73 P" + b"9" * 400 + b"\n" for _ in range(size)
    )


@hostile(10_000)
def subprograms(size: int) -> Iterator[bytes]:
    yield from _framed(b'M98 P"a%d.g"\nM808 L0\nO%d\nM808\nM99\n' % (k, k) for k in range(size))


@hostile(10_000)
def nested_expressions(size: int) -> Iterator[bytes]:
    yield from _framed(
        b"G1 X{" + b"(" * 200 + b"100" + b")" * 200 + b"} E.1\n" for _ in range(size)
    )


@hostile(20_000)
def deep_expression(size: int) -> Iterator[bytes]:
    yield from _framed(b"G1 X{" + b"(" * size + b"\n" for _ in range(1))


@hostile(1000)
def nested_loops(size: int) -> Iterator[bytes]:
    yield HEAD
    for k in range(size):
        yield b" " * k + b"while true\n"
    yield b" " * size + b"G1 X101 E.1\n"


# What slicers say about a file


@hostile(1_000_000)
def settings_without_end(size: int) -> Iterator[bytes]:
    yield from _filled(b"; prusaslicer_config = begin\n; CONFIG_BLOCK_START\n", size)
    yield b"\n" + HEAD + TAIL


@hostile(1_000_000)
def settings_of_nothing(size: int) -> Iterator[bytes]:
    yield b"; prusaslicer_config = begin"
    yield from _filled(b" \n", size)
    yield HEAD + TAIL


@hostile(1_000_000)
def generators(size: int) -> Iterator[bytes]:
    yield from _filled(b";GENERATOR.NAME:x\n; KISSlicer\n; generated by x\n", size)
    yield b"\n" + HEAD + TAIL


@hostile(1_000_000)
def long_generator(size: int) -> Iterator[bytes]:
    yield b";GENERATOR.NAME:"
    yield from _filled(b"x", size)
    yield b"\n" + HEAD + TAIL


@hostile(1_000_000)
def deep_settings(size: int) -> Iterator[bytes]:
    yield b";SETTING_3 "
    yield from _filled(b"[", size)
    yield b"\n" + HEAD + TAIL


@hostile(1_000_000)
def wide_settings(size: int) -> Iterator[bytes]:
    yield b';SETTING_3 {"global_quality": "[values]\\\\na'
    yield from _filled(b" ", size)
    yield b'b"}\n' + HEAD + TAIL


@hostile(200_000)
def wide_limits(size: int) -> Iterator[bytes]:
    yield b"M201 X1 Y"
    yield from _filled(b"1", size)
    yield b"\n" + HEAD + TAIL


@hostile(10_000_000)
def thumbnails(size: int) -> Iterator[bytes]:
    for _ in range(0, size, 100_000):
        yield b"; thumbnail begin 640x480 98000\n"
        yield from _filled(b"; " + b"iVBORw0KGgo" * 7 + b"\n", 99_840)
        yield b"; thumbnail end\n"
    yield HEAD + TAIL


def _filled(pattern: bytes, size: int) -> Iterator[bytes]:
    whole, rest = divmod(size, len(pattern))
    for _ in range(whole):
        yield pattern
    yield pattern[:rest]
