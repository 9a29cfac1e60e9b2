"""Klipper's commands for shaper and acceleration, read and written."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

from stillpath.gcode.dialect import Dialect
from stillpath.gcode.firmware.klipper.limits import KlipperLimits
from stillpath.gcode.lexer import extended_parameters, split_line
from stillpath.gcode.types import Limits
from stillpath.models.firmware import Klipper
from stillpath.models.shaper_pulses import SHAPERS
from stillpath.models.shaping import OFF, AxisShaper, Shaping

__all__ = ["KlipperAdviser"]


class KlipperAdviser:
    """See `gcode.firmware.base.Adviser`.

    Source: klippy/extras/input_shaper.py, klippy/toolhead.py (Klipper, 2026-08). SET_INPUT_SHAPER
    exists where printer.cfg has a section [input_shaper], which may be empty.
    """

    shaper_word = "SET_INPUT_SHAPER"
    same_for_both = False
    skips_lines = False
    travel_apart = False

    def __init__(self, firmware: Klipper, dialect: Dialect) -> None:
        self._dialect = dialect
        self.highest_mm_s2 = firmware.planner.max_accel_mm_s2
        s = firmware.shaper
        self.shapers: tuple[str, ...] = () if firmware.no_input_shaper else SHAPERS
        self.stated: Shaping | None = OFF if firmware.no_input_shaper else None
        if s is not None:
            self.stated = Shaping(
                AxisShaper(s.type_x, s.freq_x_hz, s.damping_x),
                AxisShaper(s.type_y, s.freq_y_hz, s.damping_y),
            )

    def accel_mm_s2(self, limits: Limits) -> float:
        """Return the one acceleration that there is."""
        return cast(KlipperLimits, limits).accel_mm_s2

    def with_accel(self, limits: Limits, accel_mm_s2: float) -> Limits:
        """Return the limits with another acceleration."""
        return replace(cast(KlipperLimits, limits), accel_mm_s2=accel_mm_s2)

    def accel_lines(self, accel_mm_s2: float) -> tuple[bytes, ...]:
        """Return the line that sets the acceleration."""
        return (f"SET_VELOCITY_LIMIT ACCEL={accel_mm_s2:.10g}".encode(),)

    def sets_accel(self, text: str) -> bool:
        """Return whether a line sets the acceleration."""
        command = split_line(text, self._dialect)[0]
        if command.name == "M204":
            return "S" in command.words or {"P", "T"} <= command.words.keys()
        if command.name == "SET_VELOCITY_LIMIT":
            return "ACCEL" in extended_parameters(text, command.name)
        return False

    def stores(self, _text: str) -> bool:
        """Return False: SAVE_CONFIG writes what was calibrated, not what a file has set."""
        return False

    def shaper_lines(self, shaping: Shaping) -> tuple[bytes, ...]:
        """Return the line that sets both shapers."""
        words = ["SET_INPUT_SHAPER"]
        for axis, s in (("X", shaping.x), ("Y", shaping.y)):
            if s.type != "none":
                words.append(f"SHAPER_TYPE_{axis}={s.type}")
            if s.type.startswith("smooth_"):  # a fork's, which passes over SHAPER_FREQ
                words.append(f"SMOOTHER_FREQ_{axis}={s.f_hz:.10g}")
            words.append(f"SHAPER_FREQ_{axis}={s.f_hz:.10g} DAMPING_RATIO_{axis}={s.damping:.10g}")
        return (" ".join(words).encode(),)

    def read_shaper(self, text: str, now: Shaping) -> Shaping:
        """Return the shaper in force after a SET_INPUT_SHAPER."""
        command = split_line(text, self._dialect)[0]
        if command.name != "SET_INPUT_SHAPER":
            return now
        given = extended_parameters(text, command.name)
        axes = []
        for axis, s in (("X", now.x), ("Y", now.y)):
            kind = given.get(f"SHAPER_TYPE_{axis}", given.get("SHAPER_TYPE", s.type)).lower()
            option = "SMOOTHER_FREQ" if kind.startswith("smooth_") else "SHAPER_FREQ"
            axes.append(
                AxisShaper(
                    # Nothing said yet: Klipper's default type.
                    "mzv" if kind == "none" else kind,
                    float(given.get(f"{option}_{axis}", s.f_hz)),
                    float(given.get(f"DAMPING_RATIO_{axis}", s.damping)),
                )
            )
        return Shaping(*axes)
