"""Excerpts of print files, damaged at random from a seed.

Damage is of three sorts: of bytes (bits, NUL, broken UTF-8, mixed ends of lines), of lines (lost,
twice, swapped, cut, foreign) and of numbers (huge, tiny, negative, exponents, no numbers).
"""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Iterator, Sequence

__all__ = ["excerpts", "mutated"]

_NUMBER = re.compile(rb"(?<=[A-Za-z=])[-+]?(?:\d+\.?\d*|\.\d+)")
_NUMBERS = [
    *(b"0 -0 1 -1 .5 5. + - . -- 1e3 1e-9 1E5 1e999 -1e999 nan -nan inf 0x10 1_000 1,5").split(),
    *(b"99999999999 -99999999999 1e15 .000000001 -.000000001 1000000000 0000012 1.2.3").split(),
    *(b"123456789012345678901234567890 1.0000000000000000000000001 4294967296 2147483648").split(),
    *(b"180 179.9999 90 360 +5 1e 1e+ .e5 1d5 3.4e38 5e-324 65536 1024 1023").split(),
    b"",
    b" ",
]
_LINES = re.split(
    rb" \| |\n",
    rb"""
G28 | G28 X | G29 | G90 | G91 | M82 | M83 | G92 | G92 E0 | G92 X0 Y0 | G92 X5 E3 | G92.1 | G20
G21 | G53 | G53 G1 X5 | G54 | G55 | G59.3 | G17 | G18 | G19 | G2 X10 Y10 I5 | G2 X10 Y10 R20
G2 X10 Y10 R-20 | G3 I5 J0 P2 | G2 I2 | G3 X12 Z3 I1 K1 | G2 Z3 I2 J2 P1 | G5 X10 Y10 I1 J1 P-1 Q1
G5.1 X1 Y1 I1 J1 | G10 | G11 | G10 S1 | G10 P0 X1 | G10 L2 P1 X5 | G4 P100 | G4 S1 | G4 S-1
G4 P1e9 | G60 | G60 S1 | G61 | G61 XYZ F100 | G61 S1 X Y | G0 R1 | G1 R2 X1 | G0 X10Y10
g1x5y5e.1 | G1X5Y5Z5E5F5 | G1 E-5 F2400 | G1 E5 | G1 F.001 | G1 F0 | G1 F-1 | G1 Z500 | G12 | G26
G27 | G30 | G80 | G38.2 Z-5 | M0 | M1 stop | M18 X | M84 | M17 | M106 S255 | M107 P1
M104 S200 T1 | M109 S200 | M109 R20 | M117 hi ; there | M118 {value} | M140 S60 | M190 S60
M201 X100 Y100 | M201 E0 | M203 X1 Y1 Z1 E1 | M203 I1 | M204 S1 | M204 P500 R500 T500 | M204 P0
M205 X8 Y8 Z.4 E5 | M205 J.013 B20000 | M205 S0 T0 | M206 X5 | M207 S2 F2400 Z.2 | M208 S0 F1000
M211 S0 | M218 T1 X20 | M220 S1 | M220 S100 | M220 B | M220 R | M220 S1e-9 | M221 S90
M221 S100 T1 | M221 X0 Y0 Z0 | M290 Z.05 | M400 | M400 U1 | M420 S1 | M425 F1 | M486 S1 | M486 S-1
M486 T5 | M486 AName | M500 | M502 | M566 X100 Y100 Z10 E100 P1 | M572 D0 S.05 | M593 F50 D.1
M593 P"none" | M600 | M601 | M605 S1 | M624 AQAAAAAAAAA= | M625 | M701 | M862.3 P "MK3S"
M900 K.05 | M906 X800 | M970.3 Q1 | M974 Q0 | M975 S1 | M1002 gcode_claim_action : 2 | M9999 | T0
T1 | T-1 | T255 | T1000 | Tx | T? | Tc | N10 G1 X1*99 | N10G1X1 | N-1 | N | * | *71 | G | M | X10
X10 Y20 E1 | E5 | F3000 | I5 J5 | /G1 X5 | % | (G1 X5) | (unclosed | G1 (in) X5 (side) Y5 | "quote
G1 X"5" | ' | G1 X{1+2} | {global.x} | if {move.axes[0].homed} |   G1 X5 | while true | var x = 5
set global.x = 3 | echo "hi" | abort | G1 X5 G1 X10 | G90 G1 X5 | M83 G1 E1 | ;TYPE:Perimeter
;LAYER:5 | ;LAYER_CHANGE | ;Z:.4 | ;HEIGHT:nan | ; FEATURE: x | ;TIME_ELAPSED:5
; stop printing object | ; printing object a id:0 copy 0 | ; CONFIG_BLOCK_START
; CONFIG_BLOCK_END | ; prusaslicer_config = begin | ; thumbnail begin 16x16 100 | ; thumbnail end
; STILLPATH_OFF | ; STILLPATH_ON | ; stillpath: stream on | ; stillpath: stream off
; stillpath, held back: G1 X5 | SET_VELOCITY_LIMIT VELOCITY=100 ACCEL=100
SET_VELOCITY_LIMIT ACCEL=0 | SET_VELOCITY_LIMIT SQUARE_CORNER_VELOCITY=0 MINIMUM_CRUISE_RATIO=.99
SET_VELOCITY_LIMIT ACCEL= | SET_VELOCITY_LIMIT ACCEL='1 | SET_GCODE_OFFSET X=1 MOVE=1
SET_GCODE_OFFSET Z_ADJUST=.1 MOVE=1 MOVE_SPEED=5 | SET_GCODE_OFFSET | SAVE_GCODE_STATE NAME=a
SAVE_GCODE_STATE | RESTORE_GCODE_STATE NAME=a MOVE=1
RESTORE_GCODE_STATE NAME=a MOVE=1 MOVE_SPEED=0 | RESTORE_GCODE_STATE
SET_RETRACTION RETRACT_LENGTH=5 RETRACT_SPEED=1 | SET_INPUT_SHAPER SHAPER_FREQ_X=50
SET_PRESSURE_ADVANCE ADVANCE=.05 | EXCLUDE_OBJECT_START NAME=a | EXCLUDE_OBJECT_END NAME=a
EXCLUDE_OBJECT_DEFINE NAME=a CENTER=1,1 POLYGON=[[1,1]] | START_PRINT BED=60 | PRINT_END | _MACRO
TIMELAPSE_TAKE_FRAME | BED_MESH_CALIBRATE | SET_KINEMATIC_POSITION X=5
ACTIVATE_EXTRUDER EXTRUDER=extruder1 | TURN_OFF_HEATERS
""".strip(),
)
_ENDS = [b"\n", b"\r\n", b"\r", b"\n\n", b"\n\r", b" \n", b"\x0b\n", b"\x1a\n", b"\xc2\x85\n"]
_BYTES = [
    *(bytes([k]) for k in (0, 1, 8, 9, 11, 12, 13, 26, 27, 32, 34, 39, 40, 41, 42, 47, 59, 92)),
    *(bytes([k]) for k in (95, 96, 123, 127, 128, 160, 192, 237, 255)),
    b"\xef\xbb\xbf",
    b"\xe2\x80\xa8",
    b"\xff\xfe",
    "µ".encode(),
    "µ".encode("latin-1"),
    "ı".encode(),
    "ſ".encode(),
    "２".encode(),
]

Mutation = Callable[[random.Random, list[bytes]], None]


def excerpts(
    files: Sequence[bytes], total: int, dice: random.Random, *, size: int = 20_000
) -> Iterator[bytes]:
    """Yield damaged excerpts of the files until they have `total` bytes together."""
    done = 0
    while done < total:
        text = dice.choice(files)
        length = int(size * dice.choice((0.1, 0.5, 1.0, 2.0)))
        start = 0 if dice.random() < 0.4 else dice.randrange(max(len(text) - length, 1))
        start = text.rfind(b"\n", 0, start) + 1
        part = text[start : start + length]
        if dice.random() < 0.6:
            part = b"G28\nG90\nM83\n" + part
        part = mutated(part, dice)
        done += max(len(part), 1)
        yield part


def mutated(text: bytes, dice: random.Random) -> bytes:
    """Return a text with some damage."""
    lines = text.splitlines(keepends=True)
    kinds = dice.sample(_OF_LINES, dice.randint(1, 4))
    for _ in range(dice.choice((0, 1, 3, 10, 30))):
        if lines:
            dice.choice(kinds)(dice, lines)
    text = b"".join(lines)
    if dice.random() < 0.4:
        text = _bytes_damaged(dice, text)
    if dice.random() < 0.2:
        text = text[: dice.randrange(len(text) + 1)]
    return text


def _any(dice: random.Random, lines: list[bytes]) -> int:
    return dice.randrange(len(lines))


def _lose(dice: random.Random, lines: list[bytes]) -> None:
    first = _any(dice, lines)
    del lines[first : first + dice.choice((1, 1, 1, 20))]


def _twice(dice: random.Random, lines: list[bytes]) -> None:
    first = _any(dice, lines)
    part = lines[first : first + dice.choice((1, 1, 5, 30))]
    lines[first:first] = part * dice.choice((1, 1, 3))


def _swap(dice: random.Random, lines: list[bytes]) -> None:
    a, b = _any(dice, lines), _any(dice, lines)
    lines[a], lines[b] = lines[b], lines[a]


def _number(dice: random.Random, lines: list[bytes]) -> None:
    for _ in range(20):
        at = _any(dice, lines)
        found = list(_NUMBER.finditer(lines[at].split(b";", 1)[0]))
        if found:
            one = dice.choice(found)
            lines[at] = lines[at][: one.start()] + _some_number(dice) + lines[at][one.end() :]
            return


def _some_number(dice: random.Random) -> bytes:
    if dice.random() < 0.6:
        return dice.choice(_NUMBERS)
    places = dice.choice((0, 1, 3, 9))
    return b"%.*f" % (places, dice.choice((0.01, 1.0, 30.0, 300.0, 1e5)) * dice.uniform(-0.2, 1.0))


def _foreign(dice: random.Random, lines: list[bytes]) -> None:
    lines.insert(_any(dice, lines), dice.choice(_LINES) + dice.choice(_ENDS[:2]))


def _foreign_number(dice: random.Random, lines: list[bytes]) -> None:
    line = dice.choice(_LINES)
    found = list(_NUMBER.finditer(line))
    if found:
        one = dice.choice(found)
        line = line[: one.start()] + _some_number(dice) + line[one.end() :]
    lines.insert(_any(dice, lines), line + b"\n")


def _end(dice: random.Random, lines: list[bytes]) -> None:
    at = _any(dice, lines)
    lines[at] = lines[at].rstrip(b"\r\n") + dice.choice(_ENDS)


def _joined(dice: random.Random, lines: list[bytes]) -> None:
    at = _any(dice, lines)
    lines[at] = lines[at].rstrip(b"\r\n") + dice.choice((b"", b" ", b"\r"))


def _cut(dice: random.Random, lines: list[bytes]) -> None:
    at = _any(dice, lines)
    lines[at] = lines[at][: dice.randrange(len(lines[at]) + 1)]


_OF_LINES: list[Mutation] = [
    *(_lose, _twice, _swap, _number, _number, _foreign, _foreign, _foreign, _foreign_number),
    *(_end, _joined, _cut),
]


def _bytes_damaged(dice: random.Random, text: bytes) -> bytes:
    out = bytearray(text)
    for _ in range(dice.choice((1, 2, 5, 20))):
        if not out:
            break
        at = dice.randrange(len(out))
        kind = dice.random()
        if kind < 0.4:
            out[at] ^= 1 << dice.randrange(8)
        elif kind < 0.7:
            out[at:at] = dice.choice(_BYTES) * dice.choice((1, 1, 1, 40))
        elif kind < 0.9:
            out[at] = dice.randrange(256)
        else:
            del out[at : at + dice.choice((1, 3, 100))]
    return bytes(out)
