"""A second reader of G-code, small and slow, that shares nothing with the interpreter.

It follows G0 to G3, G5, G28, G90 to G92, M82, M83, M220, M221 and T as the firmwares' own
documents say, and adds up what leaves the nozzle. Tests hold both a file and its compensated twin
against it.
"""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass, field
from typing import Literal

__all__ = ["Reading", "is_motion", "read"]

Firmware = Literal["klipper", "marlin", "reprapfirmware"]

_LINE = re.compile(rb"^\s*(?:[Nn]\s*\d+\s*)?([A-Za-z])\s*(\d+)(?![\d.])(.*)$", re.DOTALL)
_WORD = re.compile(rb"([A-Za-z])\s*([-+]?(?:\d+\.?\d*|\.\d+))")
_EXPONENTS = re.compile(rb"([A-Za-z])\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)")
"""RepRapFirmware's numbers: Y9E2 is 900."""
_MOTION = {b"G0", b"G1", b"G2", b"G3", b"G5"}


@dataclass
class Reading:
    """What a file does, added up.

    Attributes
    ----------
    extruded_mm : dict
        Filament by tool: what all moves together feed.
    low_mm, high_mm : list of float
        Extremes of x y z at ends of moves whose position the file itself has named since the
        last homing, in machine axes.
    position_mm : list of float
        x y z at the end.
    """

    extruded_mm: dict[int, float] = field(default_factory=lambda: defaultdict(float))
    low_mm: list[float] = field(default_factory=lambda: [float("inf")] * 3)
    high_mm: list[float] = field(default_factory=lambda: [float("-inf")] * 3)
    position_mm: list[float] = field(default_factory=lambda: [0.0] * 3)
    absolute_xyz: bool = True
    absolute_e: bool = True
    feed_mm_min: float = 0.0
    speed_percent: float = 100.0
    flow_percent: float = 100.0
    tool: int = 0
    moves: int = 0

    def modes(self) -> tuple[object, ...]:
        """Return what the next line would be read with."""
        return self.absolute_xyz, self.absolute_e, self.speed_percent, self.flow_percent, self.tool


def is_motion(line: bytes) -> bool:
    """Tell whether a line moves an axis by itself."""
    code = line.split(b";", 1)[0].upper()
    found = _LINE.match(code)
    if found is None or found[1] + found[2].lstrip(b"0").rjust(1, b"0") not in _MOTION:
        return False
    return re.search(rb"[XYZEIJR]", found[3]) is not None


def read(
    data: bytes, firmware: Firmware = "klipper", *, relative_moves_count: bool = True
) -> Reading:
    """Read a whole file; of RepRapFirmware, most versions do not count relative moves."""
    out = Reading()
    place, offset = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    named = [False, False, False]
    register = 0.0
    for line in data.split(b"\n"):
        code = line.split(b";", 1)[0]
        found = _LINE.match(code)
        if found is None or (firmware == "marlin" and code != code.upper()):
            continue  # Marlin knows no lower case, as it is set up by default
        name = found[1].upper() + (found[2].lstrip(b"0") or b"0")
        rest = found[3].split(b"*", 1)[0]
        if name in (b"M117", b"M118", b"M23"):
            continue
        pattern = _EXPONENTS if firmware == "reprapfirmware" else _WORD
        words = {k.upper(): float(v) for k, v in pattern.findall(rest)}
        if name in _MOTION:
            out.feed_mm_min = words.get(b"F", out.feed_mm_min)
            before = list(place)
            for k, axis in enumerate((b"X", b"Y", b"Z")):
                if axis in words:
                    place[k] = words[axis] + (offset[k] if out.absolute_xyz else place[k])
                    named[k] = named[k] or out.absolute_xyz
            if b"E" in words:
                relative = not out.absolute_e or (firmware == "klipper" and not out.absolute_xyz)
                fed = words[b"E"] - (0.0 if relative else register)
                # An absolute register counts in the file's own millimetres.
                register += fed if relative_moves_count or not relative else 0.0
                out.extruded_mm[out.tool] += fed * out.flow_percent / 100.0
            if place != before:
                out.moves += 1
                for k in range(3):
                    if named[k]:
                        out.low_mm[k] = min(out.low_mm[k], place[k])
                        out.high_mm[k] = max(out.high_mm[k], place[k])
        elif name == b"G28":
            axes = [k for k, axis in enumerate(b"XYZ") if bytes([axis]) in rest.upper()]
            for k in axes or range(3):
                place[k] = offset[k] = 0.0
            named = [False] * 3
        elif name in (b"G90", b"G91"):
            out.absolute_xyz = name == b"G90"
            if firmware == "marlin":
                out.absolute_e = out.absolute_xyz
        elif name in (b"M82", b"M83"):
            out.absolute_e = name == b"M82"
        elif name == b"G92":
            for k, axis in enumerate((b"X", b"Y", b"Z")):
                if axis in words:
                    offset[k] = place[k] - words[axis]
            register = words.get(b"E", register)
            if not words and firmware == "klipper":
                register, offset = 0.0, list(place)
        elif name == b"M220":
            out.speed_percent = words.get(b"S", out.speed_percent)
        elif name == b"M221":
            out.flow_percent = words.get(b"S", out.flow_percent)
        elif name[:1] == b"T":
            out.tool = int(found[2])
    out.position_mm = place
    return out
