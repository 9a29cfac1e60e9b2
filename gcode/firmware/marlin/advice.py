"""Marlin's commands for shaper and acceleration, read and written."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

from stillpath.gcode.dialect import Dialect
from stillpath.gcode.firmware.marlin.limits import MarlinLimits
from stillpath.gcode.lexer import Command, split_line
from stillpath.gcode.types import Limits
from stillpath.models.firmware import Marlin
from stillpath.models.shaping import OFF, AxisShaper, Shaping

__all__ = ["MarlinAdviser"]

_WITH_SHAPER = ("2.1", "bugfix")
_COMPENSATORS = {"zv": 1, "ei": 5, "2hump_ei": 6, "3hump_ei": 7, "mzv": 8}
"""Our names to M493 C. ZVD, ZVDD and ZVDDD have no model here."""
_BUDDY_TYPES = ("zv", "zvd", "mzv", "ei", "2hump_ei", "3hump_ei")
"""M593 T of Prusa's Buddy; without T the type stays, at first MZV (EI on a CORE One)."""
_MODELLED = {str(number): name for name, number in _COMPENSATORS.items()} | {"0": "none"}


class MarlinAdviser:
    """See `gcode.firmware.base.Adviser`.

    M593 sets a ZV shaper; a build may lack it, so it is only written where the machine states a
    shaper (`firmware.shaper` with a frequency above 0), M493 where it says `ft_motion`, in the
    words of `ft_motion_version`. Sources:
    Marlin/src/gcode/feature/input_shaping/M593.cpp and gcode/config/M200-M205.cpp, 2.1.2 (2023-01);
    gcode/feature/ft_motion/M493.cpp, bugfix-2.1.x: version 1 of 2024-03 (#26848), version 2 of
    2025-10 (#28127), as of 2026-08; module/settings.cpp for M500.
    """

    same_for_both = False
    travel_apart = True

    def __init__(self, firmware: Marlin, dialect: Dialect) -> None:
        self._dialect = dialect
        self.skips_lines = firmware.variant == "bambu"
        axes = firmware.planner.max_accel_mm_s2
        self.highest_mm_s2 = min(axes.x, axes.y)
        s = firmware.shaper
        self.stated: Shaping | None = None
        if s is not None:
            self.stated = Shaping(
                AxisShaper("zv" if s.freq_x_hz else "none", s.freq_x_hz, s.damping_x),
                AxisShaper("zv" if s.freq_y_hz else "none", s.freq_y_hz, s.damping_y),
            )
        elif firmware.variant == "2.0":
            self.stated = OFF
        self._fixed_time = firmware.ft_motion
        self._buddy = firmware.variant == "prusa"
        self._version = firmware.ft_motion_version
        self.shaper_word = "M493" if self._fixed_time else "M593"
        if self._fixed_time:
            # What M593 states is not what fixed-time motion does.
            self.stated = None
            self.shapers: tuple[str, ...] = tuple(_COMPENSATORS)
            return
        has_shaper = self.stated is not None and self.stated.is_on
        self.shapers = ("zv",) if has_shaper and firmware.variant in _WITH_SHAPER else ()

    def accel_mm_s2(self, limits: Limits) -> float:
        """Return M204 P."""
        return cast(MarlinLimits, limits).print_accel_mm_s2

    def with_accel(self, limits: Limits, accel_mm_s2: float) -> Limits:
        """Return the limits with another M204 P."""
        return replace(cast(MarlinLimits, limits), print_accel_mm_s2=accel_mm_s2)

    def accel_lines(self, accel_mm_s2: float) -> tuple[bytes, ...]:
        """Return the line that sets the acceleration of moves that print."""
        return (f"M204 P{accel_mm_s2:.10g}".encode(),)

    def sets_accel(self, text: str) -> bool:
        """Return whether a line sets M204 P."""
        return any(
            c.name == "M204" and bool(c.words.keys() & {"P", "S"})
            for c in split_line(text, self._dialect)
        )

    def stores(self, text: str) -> bool:
        """Return whether a line holds M500: it writes accelerations and shaper to the EEPROM."""
        return any(c.name == "M500" for c in split_line(text, self._dialect))

    def shaper_lines(self, shaping: Shaping) -> tuple[bytes, ...]:
        """Return the lines that set both shapers."""
        if self._fixed_time and self._version == 1:
            x, y = shaping.x, shaping.y
            modes = f"M493 X{_COMPENSATORS[x.type]} Y{_COMPENSATORS[y.type]}"
            hertz = f" A{x.f_hz:.6g} B{y.f_hz:.6g} I{x.damping:.6g} J{y.damping:.6g}"
            return ((modes + hertz).encode(),)
        if self._fixed_time:
            return tuple(
                f"M493 {axis} C{_COMPENSATORS[s.type]} A{s.f_hz:.6g} I{s.damping:.6g}".encode()
                for axis, s in (("X", shaping.x), ("Y", shaping.y))
            )
        lines = [
            f"M593 {axis} F{s.f_hz:.6g} D{s.damping:.6g}".encode()
            for axis, s in (("X", shaping.x), ("Y", shaping.y))
        ]
        # A build that shapes X alone passes over the Y, and takes its line for X.
        x_alone = self.stated is not None and not self.stated.y.f_hz
        return tuple(lines[::-1] if x_alone else lines)

    def read_shaper(self, text: str, now: Shaping) -> Shaping:
        """Return the shaper in force after an M593 or M493."""
        for command in split_line(text, self._dialect):
            if command.name != self.shaper_word:
                continue
            if self._fixed_time and self._version == 1:
                now = _read_version_1(command, now)
                continue
            both = not command.words.keys() & ({"X", "Y", "Z"} if self._buddy else {"X", "Y"})
            hertz, zeta = ("A", "I") if self._fixed_time else ("F", "D")
            given = {k: float(v) for k, v in command.words.items() if k in (hertz, zeta) and v}
            axes = []
            for axis, s in (("X", now.x), ("Y", now.y)):
                if not both and axis not in command.words:
                    axes.append(s)
                    continue
                kind = self._type(command, s.type)
                axes.append(AxisShaper(kind, given.get(hertz, s.f_hz), given.get(zeta, s.damping)))
            now = Shaping(*axes)
        return now

    def _type(self, command: Command, now: str) -> str:
        if self._buddy:
            number = int(float(command.words.get("T") or -1))
            if 0 <= number < len(_BUDDY_TYPES):
                return _BUDDY_TYPES[number]
            return "mzv" if now == "none" else now
        if not self._fixed_time:
            return "zv"
        mode = command.words.get("C", "")
        return _MODELLED.get(mode, f"M493 C{mode}") if mode else now


def _read_version_1(command: Command, now: Shaping) -> Shaping:
    """Return the shaper after an M493 of version 1, where each axis has its own letters."""
    axes = []
    for s, (axis, hertz, zeta) in ((now.x, "XAI"), (now.y, "YBJ")):
        mode, f_hz, damping = (command.words.get(letter, "") for letter in (axis, hertz, zeta))
        axes.append(
            AxisShaper(
                _MODELLED.get(mode, f"M493 {axis}{mode}") if mode else s.type,
                float(f_hz) if f_hz else s.f_hz,
                float(damping) if damping else s.damping,
            )
        )
    return Shaping(*axes)
