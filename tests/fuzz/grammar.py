"""Print files made by a grammar: every command that changes motion, in any order, undamaged.

What `mutations.py` takes from real files has what slicers write; here everything meets everything.
"""

from __future__ import annotations

import random
from collections.abc import Callable

__all__ = ["written"]

_WEIRD = ("-0", "+1", ".5", "5.", "00012.50", "0.0000001", "1e3", "")
_MODES = ("G90", "G91", "M82", "M83", "G20", "G21", "G17")
_WAITS = ("M400", "M105", "G4 P1", "G4 S0", "M106 S80", "M107", "M117 X5 Y5", "M73 P5", "T0", "G28")
_OBJECTS = (
    *("EXCLUDE_OBJECT_START NAME=a", "EXCLUDE_OBJECT_END NAME=a", "SAVE_GCODE_STATE NAME=s"),
    *("RESTORE_GCODE_STATE NAME=s", "RESTORE_GCODE_STATE NAME=s MOVE=1 MOVE_SPEED=50", "G10"),
    *("G11", "G92 E0", "G92 X10 Y10", "M220 S80", "M221 S95", "M221 S100", "M220 S100"),
)


def written(dice: random.Random, lines: int) -> bytes:
    """Return a file with about so many lines; the same dice throw the same file."""
    kinds: list[tuple[int, Callable[[random.Random], str]]] = [
        (60, _move),
        (8, _arc),
        (6, lambda d: d.choice(_MODES)),
        (6, lambda d: d.choice(_WAITS)),
        (6, lambda d: d.choice(_OBJECTS)),
        (5, _limit),
        (3, lambda d: f"; {d.choice(('LAYER_CHANGE', 'TYPE:External perimeter', 'G1 X9'))}"),
        (1, lambda _: ""),
    ]
    weights = [weight for weight, _ in kinds]
    made = ["G28", "G90", "M83", "G1 X100 Y100 Z1 F6000"]
    for _ in range(lines):
        ((_, kind),) = dice.choices(kinds, weights)
        line = kind(dice)
        if dice.random() < 0.03:
            line = f"N{len(made)} {line}"
        if dice.random() < 0.05:
            line += dice.choice((" ; said", "  ", "\t", " (said)"))
        made.append(line)
    end = dice.choice(("\n", "\n", "\r\n"))
    return (end.join(made) + dice.choice((end, ""))).encode()


def _move(dice: random.Random) -> str:
    words = [dice.choice(("G1", "G1", "G1", "G0", "G01", "g1"))]
    for axis, share in (("X", 0.8), ("Y", 0.8), ("Z", 0.05)):
        if dice.random() < share:
            words.append(axis + _place(dice))
    if dice.random() < 0.6:
        words.append(f"E{dice.choice((0.01, 0.05, 0.2, 1.0, -0.8, 0.0)) * dice.random():.5f}")
    if dice.random() < 0.2:
        words.append(f"F{dice.choice((30, 600, 1800, 6000, 18000))}")
    if dice.random() < 0.05:
        dice.shuffle(words[1:])
    return dice.choice((" ", " ", " ", "")).join(words)


def _arc(dice: random.Random) -> str:
    word = dice.choice(("G2", "G3"))
    radius = dice.choice((0.1, 1.0, 10.0))
    if dice.random() < 0.8:
        centre = f"I{dice.uniform(-radius, radius):.3f} J{dice.uniform(-radius, radius):.3f}"
    else:
        centre = f"R{radius:.3f}"
    return f"{word} X{_place(dice)} Y{_place(dice)} {centre} E.05"


def _limit(dice: random.Random) -> str:
    accel = dice.choice((1, 50, 500, 1000, 5000, 20000))
    return dice.choice(
        (
            f"M204 S{accel}",
            f"M204 P{accel} T{accel}",
            f"M205 X{dice.choice((0.1, 5, 20))}",
            f"M203 X{dice.choice((10, 500))}",
            f"SET_VELOCITY_LIMIT ACCEL={accel}",
            f"SET_VELOCITY_LIMIT SQUARE_CORNER_VELOCITY={dice.choice((0, 1, 5, 20))}",
            f"SET_PRESSURE_ADVANCE ADVANCE={dice.choice((0, 0.05))}",
            f"M900 K{dice.choice((0, 0.05))}",
        )
    )


def _place(dice: random.Random) -> str:
    if dice.random() < 0.02:
        return dice.choice(_WEIRD)
    digits = dice.choice((0, 1, 3, 3, 5))
    return f"{dice.gauss(100, dice.choice((0.05, 1, 20))):.{digits}f}"
