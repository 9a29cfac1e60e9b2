"""Classifies a line of the file by its text alone, as far as the writer must know."""

from __future__ import annotations

import re

from stillpath.gcode.firmware.base import StreamCommands

__all__ = [
    "AXES",
    "EXTRUSION",
    "FEED",
    "NUMBERED",
    "POSITIONING",
    "SET_POSITION",
    "STANDS",
    "LineReader",
]

AXES = re.compile(rb"[XYZ]", re.IGNORECASE)
FEED = re.compile(rb"F\s*\+?[0.]*[1-9]", re.IGNORECASE)
"""Marlin passes over what is not above 0; the others refuse it."""
SET_POSITION = re.compile(rb"^\s*(?:N\d+\s*)?G92(?!\d)")
POSITIONING = re.compile(rb"^\s*(?:N\d+\s*)?G\s*0*9[01](?!\d)")
EXTRUSION = re.compile(rb"^\s*(?:N\d+\s*)?M\s*0*8[23](?!\d)")
NUMBERED = re.compile(rb"^\s*N\d+\s*")
STANDS = re.compile(
    rb"^\s*(?:N\d+\s*)?(?:G\s*0*4|M\s*0*400)(?![\d.])[^GMT;]*(?:;|$)", re.IGNORECASE
)
"""G4 or M400 and nothing else: the motion rests before and after it, on every printer. Other lines
may stop it or not: Klipper's M109 does only while the heater is not hot, Marlin's M114 only in some
builds (always in old versions, later with M114_LEGACY), and a macro may leave the head moving."""

_MOVE = re.compile(rb"^\s*(?:N\d+\s*)?(?:G-?0*[0-35](?![\d.])|[XYZEIJK]\s*[-+.\d])", re.IGNORECASE)
_MOVE_WITH_SUBCODE = re.compile(rb"^\s*(?:N\d+\s*)?G-?0*[0-35]\.\d", re.IGNORECASE)
_FURTHER_MOVE = re.compile(rb"(?:^|[\s\d])G-?0*[0-35](?![\d.])", re.IGNORECASE)
_E_WORD = re.compile(rb"E\s*([-+]?(?:\d+\.?\d*|\.\d+))")
_E_WORD_FOLDED = re.compile(_E_WORD.pattern, re.IGNORECASE)
_E_WORD_EXPONENT = re.compile(
    rb"(?:(?<![\d.])|(?<=G\d)|(?<=G0\d)|(?<=G92))E\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:E[-+]?\d+)?)",
    re.IGNORECASE,
)
"""An E right after a digit belongs to the number before it, but not to the command."""


class LineReader:
    """Classify lines by the rules of a firmware. Comments must be cut off."""

    def __init__(self, commands: StreamCommands) -> None:
        self._commands = commands
        self._e_word = _E_WORD_FOLDED if commands.folds_case else _E_WORD
        if commands.first_wins:
            self._e_word = _E_WORD_EXPONENT

    def is_move(self, code: bytes) -> bool:
        """Return whether a line holds a G0 to G3 or G5, or their words alone."""
        further = not self._commands.one_command and _FURTHER_MOVE.search(code)
        subcode = self._commands.ignores_subcodes and _MOVE_WITH_SUBCODE.match(code)
        return bool(_MOVE.match(code) or further or subcode)

    def extruder_word(self, code: bytes) -> float | None:
        """Return the E of a line, as the firmware reads it."""
        found = self._e_word.findall(code)
        return float(found[0 if self._commands.first_wins else -1]) if found else None
