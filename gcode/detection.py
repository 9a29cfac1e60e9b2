"""Detect the firmware that a file was written for.

A file never states it reliably: Klipper users slice with Marlin's flavour and add macros, and
slicers write commands of all firmwares into every file. So every sign has a weight, commands more
than the slicer's stated flavour, and a result includes its certainty and reasons.

Sources: the output of the slicers in `gcode.slicers.marks`; `gcode_flavor` of PrusaSlicer 2.9
(src/libslic3r/PrintConfig.cpp) and OrcaSlicer 2.3; ``;FLAVOR:`` of CuraEngine 4.13.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

__all__ = ["DIALECTS", "EIGHT_BIT_PRUSA", "Detection", "detect"]

DIALECTS = ("klipper", "marlin", "reprapfirmware", "prusa", "bambu")
EIGHT_BIT_PRUSA = "printer_model is one with Prusa's 8-bit Marlin"
"""Reason of a file for the MK3 and its forerunners."""
_HEAD_BYTES = 1 << 18
_TAIL_BYTES = 1 << 18
_SURE = 4.0
"""Sum of weights from which an uncontradicted result is certain."""


@dataclass(frozen=True, slots=True)
class Detection:
    """The firmware that a file was probably written for.

    Attributes
    ----------
    dialect : str
        One of `DIALECTS`.
    certainty : float
        From 0 (nothing tells) to 1.
    reasons : tuple of str
        Evidence for it and, after "but", for another one.
    """

    dialect: str
    certainty: float
    reasons: tuple[str, ...]

    @property
    def doubtful(self) -> bool:
        """Whether a user should check."""
        return self.certainty < 0.5


@dataclass(frozen=True, slots=True)
class _Sign:
    """Evidence for a dialect, but not where the machine has one that is `shared_with`."""

    dialect: str
    weight: float
    pattern: re.Pattern[bytes]
    reason: str
    shared_with: str = ""


def _sign(
    dialect: str, weight: float, pattern: bytes, reason: str, *, shared_with: str = ""
) -> _Sign:
    return _Sign(dialect, weight, re.compile(pattern, re.MULTILINE), reason, shared_with)


_MOVES = re.compile(rb"^(?:G[01] .*\n)+", re.MULTILINE)
# Commands stand at the start of a line, after blanks and a line number.
_LINE = rb"^[ \t]*(?:N\d+[ \t]+)?"
_BUDDY = "commands of the Buddy firmware (M555, M74, M572 S, ...)"
_SIGNS = (
    # What the slicer calls its flavour, and the printer it sliced for.
    _sign("klipper", 3, rb"^; ?gcode_flavor = klipper\b", "gcode_flavor = klipper"),
    _sign("klipper", 3, rb"^;FLAVOR:Klipper", ";FLAVOR:Klipper"),
    _sign(
        "reprapfirmware",
        4,
        rb"^; ?gcode_flavor = reprapfirmware\b",
        "gcode_flavor = reprapfirmware",
    ),
    _sign("reprapfirmware", 3, rb"^;FLAVOR:RepRap \(?RepRap", ";FLAVOR:RepRap (RepRap)"),
    _sign("marlin", 2, rb"^; ?gcode_flavor = marlin2?\b", "gcode_flavor = marlin"),
    _sign(
        "marlin",
        1,
        rb"^; ?gcode_flavor = (?:reprap|sprinter|repetier|teacup)\s*$",
        "a relative of Marlin's flavour",
    ),
    _sign("marlin", 2, rb"^;FLAVOR:(?:Marlin|UltiGCode|Griffin)", ";FLAVOR: of the Marlin family"),
    _sign("marlin", 1, rb"^;FLAVOR:RepRap\s*$", ";FLAVOR:RepRap"),
    _sign(
        "prusa",
        4,
        rb"^; ?printer_model = (?:MINI(?:IS)?|MK4(?:S|IS)?|MK3\.[59]S?|XL\d?(?:IS)?|COREONE\w*"
        rb"|HT90|iX)(?:MMU\d)?[ \t\r]*$",
        "printer_model is one with Prusa's Buddy firmware",
    ),
    _sign(
        "prusa",
        3,
        _LINE + rb"M862\.3 P ?\"(?:MINI|MK4S?|MK3\.[59]S?|XL|COREONE\w*|iX)\"",
        "M862.3 asks for a printer with Prusa's Buddy firmware",
    ),
    _sign(
        "marlin",
        3,
        rb"^; ?printer_model = (?:MK3S?|MK2\.?5?S?)(?:MMU?\dS?|MM)?\b(?!\.)",
        EIGHT_BIT_PRUSA,
    ),
    _sign("bambu", 4, rb"^; ?printer_model = Bambu Lab", "printer_model is Bambu Lab's"),
    # Commands.
    _sign(
        "klipper",
        4,
        _LINE + rb"(?i:EXCLUDE_OBJECT_(?:DEFINE|START|END))\b",
        "EXCLUDE_OBJECT commands",
    ),
    _sign(
        "klipper",
        4,
        _LINE
        + rb"(?i:SET_(?:VELOCITY_LIMIT|PRESSURE_ADVANCE|INPUT_SHAPER|GCODE_OFFSET|RETRACTION))\b",
        "SET_... commands",
    ),
    _sign(
        "klipper",
        3,
        _LINE
        + rb"(?i:START_PRINT|PRINT_START|END_PRINT|PRINT_END|BED_MESH_\w+"
        + rb"|[A-Z]+_[A-Z_]+[ \t]+[A-Z_]+=)",
        "macros by name",
    ),
    _sign(
        "reprapfirmware",
        4,
        _LINE + rb"(?:M566 [XYZEP]|M572 D|M593 P\"|M98 P|M563 P|M950 |M671 |M558 )",
        "RepRapFirmware's commands (M566, M572 D, M98, ...)",
    ),
    _sign(
        "reprapfirmware",
        2,
        _LINE + rb"(?:M116\b|G10 P\d+ [SRXYZ]|M557 |G32\b)",
        "G10 P, G32, M116 or M557",
    ),
    _sign(
        "reprapfirmware",
        4,
        _LINE + rb"(?:(?:if|elif|while) .*[={(]|(?:var|global) \w+ ?=|echo )",
        "meta commands",
    ),
    _sign(
        "bambu",
        5,
        _LINE + rb"(?:M1002 |M620 S|M621 S|M622 J|M970\.3|M975 S)",
        "Bambu's commands (M1002, M620, M975, ...)",
    ),
    _sign("prusa", 2, _LINE + rb"(?:M555 X|M74 W|P0 S1|M593 [XY].*A)", _BUDDY),
    # Without D it is for the tool in use (Move::ConfigurePressureAdvance, Move.cpp, 2024-10).
    _sign("prusa", 2, _LINE + rb"M572 S", _BUDDY, shared_with="reprapfirmware"),
    _sign("marlin", 1, _LINE + rb"M900 K", "M900 K"),
    _sign("marlin", 1, _LINE + rb"(?:M205 [XYJ]|M420 S|M413 S)", "M205, M420 or M413"),
    _sign("marlin", 0.5, _LINE + rb"M201 X\S+ Y\S.*\n.*M203 X\d{1,3}\b", "M203 with mm/s"),
)


def detect(head: bytes, tail: bytes = b"", *, machine: str | None = None) -> Detection:
    """Return the firmware that a file was written for.

    Parameters
    ----------
    head, tail : bytes
        The two ends of its text; a quarter of a megabyte of each is looked at.
    machine : str, optional
        Dialect of the machine that is to print it: commands that it reads are no sign of another.
    """
    # Moves are most of the text, and no sign matches them.
    text = _MOVES.sub(b"\n", head[:_HEAD_BYTES] + b"\n" + tail[-_TAIL_BYTES:])
    signs = [sign for sign in _SIGNS if machine is None or sign.shared_with != machine]
    found = [sign for sign in signs if sign.pattern.search(text)]
    weights = dict.fromkeys(DIALECTS, 0.0)
    for sign in found:
        weights[sign.dialect] += sign.weight
    # Prusa's and Bambu's firmwares are of Marlin's family: its signs do not speak against them.
    for relative in ("prusa", "bambu"):
        if weights[relative] > 0.0 and weights[relative] >= weights["marlin"]:
            weights[relative] += weights["marlin"] / 2.0
            weights["marlin"] = 0.0
    ranked = sorted(DIALECTS, key=lambda name: -weights[name])
    best, second = ranked[0], ranked[1]
    if weights[best] == 0.0:
        return Detection("marlin", 0.0, ("nothing in the file says which firmware it is for",))
    lead = (weights[best] - weights[second]) / weights[best]
    certainty = lead * min(1.0, weights[best] / _SURE)
    family = {best, "marlin"} if best in ("prusa", "bambu") else {best}
    reasons = [sign.reason for sign in found if sign.dialect in family]
    reasons += [f"but {sign.reason}" for sign in found if sign.dialect not in family]
    return Detection(best, round(certainty, 3), tuple(dict.fromkeys(reasons)))
