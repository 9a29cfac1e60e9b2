"""Print files as slicers make them: layers of loops, with what comes between loops.

A grammar and damaged files meet everything by chance, but seldom the same loop three layers long.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field

__all__ = ["layered"]

_LOOPS = (
    [(15.0, 0.0), (15.0, 15.0), (0.0, 15.0), (0.0, 0.0)],
    [(15.0, 0.0), (15.0, 0.1), (0.0, 15.0), (0.0, 0.09), (0.0, 0.0)],
    [(9.0 * math.sin(a), 9.0 - 9.0 * math.cos(a)) for a in [0.3 * k for k in range(1, 21)]],
    [(x, 0.5 * k) for k in range(6) for x in ((12.0, 0.0) if k % 2 else (0.0, 12.0))],
)
_BETWEEN = ("M105", "M117 X5", "M106 S128", "G4 P1", "M220 S100", "M221 S100", "; a remark")


@dataclass(slots=True)
class _Style:
    """What a slicer does alike in all of a file; drawn with equal odds."""

    dice: random.Random
    relative: bool = field(init=False)
    retract_mm: float = field(init=False)
    lift_mm: float = field(init=False)
    height_first: bool = field(init=False)
    same_place: bool = field(init=False)
    goes_there: bool = field(init=False)
    accelerations: bool = field(init=False)
    short_end: bool = field(init=False)
    fed_mm: float = field(init=False, default=0.0)

    def __post_init__(self) -> None:
        dice = self.dice
        self.retract_mm, self.lift_mm = dice.choice((0.0, 0.75, 2.0)), dice.choice((0.0, 0.4))
        self.relative, self.height_first, self.same_place, self.goes_there = (
            dice.random() < 0.5 for _ in range(4)
        )
        self.accelerations, self.short_end = (dice.random() < 0.5 for _ in range(2))

    def feed(self, mm: float) -> str:
        self.fed_mm += mm
        return f"E{mm if self.relative else self.fed_mm:.5f}"


def layered(dice: random.Random, layers: int = 4) -> bytes:
    """Return a print of some loops a layer; the same dice throw the same file."""
    style = _Style(dice)
    lines = ["G28", "G90", "M83" if style.relative else "M82", "G92 E0", "G1 Z0.6 F600"]
    objects, loop = dice.choice((1, 1, 2)), dice.choice(_LOOPS)
    for layer in range(layers):
        z = 0.2 + 0.2 * layer
        lines.append(";LAYER_CHANGE")
        for number in range(objects):
            shift = 0.0 if style.same_place else 0.3 * layer
            at = (100.0 + 30.0 * number + shift, 100.0)
            lines += _approach(style, at, z, first=layer == number == 0)
            for _ in range(dice.choice((1, 2))):
                lines += _loop(style, at, loop)
            lines += _leave(style, z)
    return ("\n".join([*lines, "G92 E0", "M84"]) + "\n").encode()


def _approach(style: _Style, at: tuple[float, float], z: float, *, first: bool) -> list[str]:
    there = f"G1 X{at[0]:.3f} Y{at[1]:.3f} F9000"
    height = f"G1 Z{z:.3f} F600"
    lines = [height, there] if style.height_first else [there, height]
    if not style.goes_there and style.same_place and not first:
        lines.remove(there)
    if style.retract_mm and not first:
        lines.append(f"G1 {style.feed(style.retract_mm)} F1800")
    return [*lines, "M204 S1000"] if style.accelerations else lines


def _loop(style: _Style, at: tuple[float, float], loop: list[tuple[float, float]]) -> list[str]:
    lines, last = [], (0.0, 0.0)
    for point in loop:
        fed = style.feed(0.033 * math.dist(point, last))
        speed = style.dice.choice(("", "", " F3000"))
        lines.append(f"G1 X{at[0] + point[0]:.3f} Y{at[1] + point[1]:.3f} {fed}{speed}")
        last = point
        if style.dice.random() < 0.02:
            lines.append(style.dice.choice(_BETWEEN))
    if style.short_end and style.dice.random() < 0.5:
        x, y = at[0] + last[0], at[1] + last[1] + 0.1
        lines.append(f"G1 X{x:.3f} Y{y:.3f} {style.feed(0.003)}")
    return lines


def _leave(style: _Style, z: float) -> list[str]:
    lines = ["M204 S3000"] if style.accelerations else []
    if style.retract_mm:
        lines.append(f"G1 {style.feed(-style.retract_mm)} F3000")
        if style.lift_mm:
            lines.append(f"G1 Z{z + style.lift_mm:.3f} F18000")
    return lines
