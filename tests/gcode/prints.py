"""Made-up prints: what slicers write, drawn at random from a seed."""

from __future__ import annotations

import math
import random

__all__ = ["made_up_print", "polygon", "small_arcs", "vase"]


def polygon(
    corners: int, radius: float, centre: tuple[float, float] = (100.0, 100.0), *, feed: float = 3600
) -> list[str]:
    """Lines of a closed polygon with filament; the tool must stand at its first corner."""
    lines = []
    side = 2 * radius * math.sin(math.pi / corners)
    for k in range(1, corners + 1):
        angle = 2 * math.pi * k / corners
        x, y = centre[0] + radius * math.cos(angle), centre[1] + radius * math.sin(angle)
        lines.append(f"G1 X{x:.3f} Y{y:.3f} E{0.04 * side:.5f} F{feed:g}")
    return lines


class _Print:
    """A slicer with dice."""

    def __init__(self, seed: int, *, wild: bool) -> None:
        self._random = random.Random(seed)
        self._wild = wild
        self._lines: list[str] = ["; made up", "M107", "G28", "M83", "G92 E0", "G1 Z5 F600"]
        self._at = [50.0, 50.0, 5.0]
        self._e = 0.0
        self._absolute_e = self._absolute = False
        self._absolute = True
        self._feed = 0

    def make(self, chapters: int) -> str:
        self._move(50, 50, feed=6000)
        for layer in range(chapters):
            self._lines += [";LAYER_CHANGE", f";Z:{0.2 * (layer + 1):.1f}", ";TYPE:Perimeter"]
            for _ in range(self._random.randint(1, 4)):
                self._figure()
                self._between()
        self._lines += ["M104 S0", "G28 X", "M84"]
        return "\n".join(self._lines) + "\n"

    def _figure(self) -> None:
        r = self._random
        self._travel(r.uniform(20, 180), r.uniform(20, 180))
        speed = r.choice([600, 1200, 1800, 3600, 6000, 9000])
        size = r.uniform(0.5, 12)
        count = r.choice([3, 4, 6, 24, 60])
        x, y = self._at[:2]
        turn = r.uniform(0, 6)
        for k in range(1, count + 1):
            a = turn + 2 * math.pi * k / count
            self._move(
                x + size * (math.cos(a) - math.cos(turn)),
                y + size * (math.sin(a) - math.sin(turn)),
                feed=speed,
                feeds=0.04,
            )
            if r.random() < 0.05:
                self._harmless()
        if r.random() < 0.3:
            # A wipe: filament goes back while X and Y move.
            for _ in range(r.randint(1, 3)):
                self._move(
                    self._at[0] + r.uniform(-1, 1), self._at[1] + r.uniform(-1, 1),
                    feed=7200, feeds=-0.3,
                )  # fmt: skip

    def _travel(self, x: float, y: float) -> None:
        r = self._random
        retract, hop = r.random() < 0.6, r.random() < 0.4
        z = self._at[2]
        if retract:
            self._extrude(-0.8, r.choice([2100, 2400, None]))
        if hop:
            self._climb(z + 0.4)
        self._move(x, y, feed=r.choice([9000, 12000]))
        if hop:
            self._climb(z)
        if retract:
            self._extrude(0.8, r.choice([2100, 1500, None]))

    def _harmless(self) -> None:
        choices = ["M106 S120", "; a word", "", "M73 P10 R5", "M204 S800", "M204 P1500 T2000"]
        choices += ["SET_VELOCITY_LIMIT ACCEL=2500", "SET_PRESSURE_ADVANCE ADVANCE=0.03"]
        choices += ["SET_VELOCITY_LIMIT SQUARE_CORNER_VELOCITY=8", "M117 layer", "M105"]
        choices += ["G92 E0"] if not self._absolute_e or self._zero() else []
        if self._wild:
            choices += ["G90", "G91", "M82", "M83", "M220 S80", "M220 S100"]
            choices += ["M221 S95", "M221 S100"]
            choices += ["G1 F2400", "G1 F5400", "G92 X", "G92 XY"]
        line = self._random.choice(choices)
        if line in ("G90", "G91"):
            self._absolute = line == "G90"
        elif line in ("M82", "M83"):
            self._absolute_e = line == "M82"
        elif line.startswith("G92 X"):
            x = self._at[0] + self._random.choice([0.0, 5.0, -3.0])
            self._origin_x = getattr(self, "_origin_x", 0.0) + self._at[0] - x
            line = f"G92 X{x:.5f}"
            self._at[0] = float(f"{x:.5f}")
        elif line.startswith("G92 E"):
            self._e = 0.0
        elif line.startswith("G1 F"):
            self._feed = int(line[4:])
        self._lines.append(line)

    def _zero(self) -> bool:
        return self._random.random() < 0.5

    def _between(self) -> None:
        r = self._random
        for _ in range(r.randint(0, 3)):
            self._harmless()
        if r.random() < 0.3:
            self._lines.append(r.choice(["G4 P20", "M400", "M109 S210", "G10", "M400"]))
            if self._lines[-1] == "G10":
                self._lines.append("G11")
        if self._wild and r.random() < 0.15:
            self._lines.append(r.choice(["PURGE_LINE", "BED_MESH_CALIBRATE", "T0"]))
            self._absolute = True
            self._lines.append("G90")
            self._move(60, 60, feed=6000)
            self._climb(5.0)
        if r.random() < 0.2:
            name = r.choice(["a", "b"])
            self._lines += [f"EXCLUDE_OBJECT_END NAME={name}", f"EXCLUDE_OBJECT_START NAME={name}"]

    def _move(self, x: float, y: float, *, feed: int, feeds: float = 0.0) -> None:
        origin = getattr(self, "_origin_x", 0.0)
        x, y = min(max(x, 2 - origin), 198 - origin), min(max(y, 2), 198)
        way = math.hypot(x - self._at[0], y - self._at[1])
        words = self._xyz(0, x) + self._xyz(1, y)
        if feeds and way > 0.01:
            words += self._e_word(feeds * way)
        self._lines.append(f"G1{words}{self._f(feed)}")

    def _climb(self, z: float) -> None:
        self._lines.append(f"G1{self._xyz(2, z)}{self._f(self._random.choice([600, 900]))}")

    def _extrude(self, e: float, feed: int | None) -> None:
        self._lines.append(f"G1{self._e_word(e)}{self._f(feed) if feed else ''}")

    def _xyz(self, axis: int, value: float) -> str:
        # A line that is relative is rounded; remember where it leads.
        if self._absolute:
            text = f"{value:.3f}"
            self._at[axis] = float(text)
        else:
            text = f"{value - self._at[axis]:.3f}"
            self._at[axis] += float(text)
        return f" {'XYZ'[axis]}{text}"

    def _e_word(self, by: float) -> str:
        # Klipper's G91 makes E relative too.
        if self._absolute_e and self._absolute:
            self._e = round(self._e + by, 5)
            return f" E{self._e:.5f}"
        self._e = round(self._e + round(by, 5), 5)
        return f" E{by:.5f}"

    def _f(self, feed: int) -> str:
        if feed == self._feed:
            return ""
        self._feed = feed
        return f" F{feed}"


def made_up_print(seed: int, *, chapters: int = 2, wild: bool = False) -> bytes:
    """Return a print of some seconds; `wild` ones also change modes and leave the position."""
    return _Print(seed, wild=wild).make(chapters).encode()


def small_arcs(layers: int = 4) -> str:
    """Outer walls of arcs to and fro, whose segments feed less than a step each; inner walls."""
    lines = ["G28", "G90", "M82", "G92 E0", "M204 P500 T500", "G1 Z.2 F600", "G1 X60 Y60 F6000"]
    e = 0.0
    for layer in range(layers):
        y = 40 + 12 * layer
        lines += [";TYPE:WALL-OUTER", f"G1 X60 Y{y} F9000"]
        for arc in range(12):
            e += 0.06 + 0.011 * layer
            lines.append(f"G2 X{61.5 + 1.5 * arc} Y{y} I.75 J0 E{e:.5f} F2400")
        lines.append(";TYPE:WALL-INNER")
        for line in range(6):
            e += 1.0
            lines.append(f"G1 X{78 + 30 * (line % 2)} Y{y + 4 + 0.4 * line:.1f} E{e:.5f}")
    return "\n".join([*lines, "G4 P10", ""])


def vase(speed_mm_s: float, *, turns: int = 2, lobes: int = 5) -> str:
    """A wall that climbs by .2 mm a turn."""
    lines = ["G28", "G90", "M83", "G1 Z.2 F600", "G1 X130 Y110 F6000", "G4 P10"]
    lines += [";TYPE:WALL-OUTER", f"G1 F{60 * speed_mm_s:g}"]
    x, y = 130.0, 110.0
    for k in range(1, 120 * turns + 1):
        angle = 2 * math.pi * k / 120
        radius = 20 + 3 * math.sin(lobes * angle)
        before = x, y
        x, y = 110 + radius * math.cos(angle), 110 + radius * math.sin(angle)
        e = 0.033 * math.hypot(x - before[0], y - before[1])
        lines.append(f"G1 X{x:.3f} Y{y:.3f} Z{0.2 + k / 600:.3f} E{e:.5f}")
    return "\n".join([*lines, "G4 P10", ""])
