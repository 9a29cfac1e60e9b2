"""RepRapFirmware's commands for shaper and acceleration, read and written."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

from stillpath.gcode.dialect import Dialect
from stillpath.gcode.firmware.reprapfirmware.limits import RepRapLimits
from stillpath.gcode.lexer import split_line
from stillpath.gcode.types import Limits
from stillpath.models.firmware import RepRapFirmware
from stillpath.models.shaping import AxisShaper, Shaping

__all__ = ["RepRapAdviser"]

_NAMES = {"mzv": "mzv", "2hump_ei": "ei2", "3hump_ei": "ei3"}
"""Our names to M593 P's. ZVD, ZVDD and ZVDDD have no model here."""
_MODELLED = {theirs: ours for ours, theirs in _NAMES.items()}
_FENCE = b"G1"
"""Limits hold as soon as they are read: see `gcode.firmware.reprapfirmware.stream_commands`."""


class RepRapAdviser:
    """See `gcode.firmware.base.Adviser`.

    One shaper with one frequency serves X and Y. Source: RepRapFirmware
    src/Movement/AxisShaper.cpp and src/GCodes/GCodes2.cpp, 3.5.
    """

    shapers = tuple(_NAMES)
    shaper_word = "M593"
    same_for_both = True
    skips_lines = False
    travel_apart = True

    def __init__(self, firmware: RepRapFirmware, dialect: Dialect) -> None:
        self._dialect = dialect
        self.highest_mm_s2 = min(firmware.x.max_accel_mm_s2, firmware.y.max_accel_mm_s2)
        s = firmware.shaper
        kind = "none" if s.type == "none" else _MODELLED.get(s.type, s.type)
        axis = AxisShaper(kind, s.freq_hz if kind != "none" else 0.0, s.damping)
        self.stated: Shaping | None = Shaping(axis, axis)

    def accel_mm_s2(self, limits: Limits) -> float:
        """Return M204 P."""
        return cast(RepRapLimits, limits).print_accel_mm_s2

    def with_accel(self, limits: Limits, accel_mm_s2: float) -> Limits:
        """Return the limits with another M204 P."""
        return replace(cast(RepRapLimits, limits), print_accel_mm_s2=accel_mm_s2)

    def accel_lines(self, accel_mm_s2: float) -> tuple[bytes, ...]:
        """Return the lines that set the acceleration of moves that print."""
        return _FENCE, f"M204 P{accel_mm_s2:.10g}".encode()

    def sets_accel(self, text: str) -> bool:
        """Return whether a line sets M204 P."""
        return any(
            c.name == "M204" and bool(c.words.keys() & {"P", "S"})
            for c in split_line(text, self._dialect)
        )

    def stores(self, _text: str) -> bool:
        """Return False: M500 writes neither M204 nor M593 to config-override.g."""
        return False

    def shaper_lines(self, shaping: Shaping) -> tuple[bytes, ...]:
        """Return the line that sets the shaper; that of X counts."""
        s = shaping.x
        if not s.is_on:
            return (b'M593 P"none"',)
        name = _NAMES.get(s.type, s.type)
        return (f'M593 P"{name}" F{s.f_hz:.6g} S{s.damping:.6g}'.encode(),)

    def read_shaper(self, text: str, now: Shaping) -> Shaping:
        """Return the shaper in force after an M593."""
        for command in split_line(text, self._dialect):
            if command.name != "M593" or command.uncertain:
                continue
            words, s = command.words, now.x
            kind = words.get("P", s.type).strip('"').lower()
            kind = _MODELLED.get(kind, kind)
            f_hz = float(words.get("F") or s.f_hz or 40.0)
            axis = AxisShaper(
                kind, 0.0 if kind == "none" else f_hz, float(words.get("S") or s.damping)
            )
            now = Shaping(axis, axis)
        return now
