"""G-code that Klipper needs before and after a stream."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

from stillpath.gcode.firmware.klipper.limits import KlipperLimits
from stillpath.gcode.types import Limits
from stillpath.models.firmware import Klipper

__all__ = ["IN_STREAM_MARK_MM_S", "SIGNATURE", "KlipperStreamCommands"]

IN_STREAM_MARK_MM_S = 5e-7
"""Added to the square corner velocity of a stream, and of the file's own moves inside one: it tells
stillpath.cfg that a PAUSE here is in mid stream, with the shaper off."""

SIGNATURE = (
    rb"SET_VELOCITY_LIMIT VELOCITY=\S+ ACCEL=\S+ ACCEL_TO_DECEL=\S+ "
    rb"SQUARE_CORNER_VELOCITY=\S+ MINIMUM_CRUISE_RATIO=0\s"
)
"""Limits of a stream, for old and new Klipper at once, in an order that only this program uses."""


class KlipperStreamCommands:
    """Lines that Klipper understands; see `gcode.firmware.base.StreamCommands`."""

    notes = (
        "between 'stream on' and 'stream off' limits are the machine's own and",
        "every move is timed: leave the speed slider at 100 %. PAUSE and",
        "CANCEL_PRINT must restore the limits first: see stillpath.cfg.",
    )
    stand_still = b"G4 P0 ; stand still\n"
    fence = b""
    positioning_sets_extruder = False
    folds_case = True
    coarse_extruder = False
    relative_moves_count = True
    replays = False
    one_command = True
    first_wins = False
    ignores_subcodes = False
    marks = True
    factors_need_axes = False
    advance_off = b""
    advance_assumed = False

    def __init__(self, firmware: Klipper) -> None:
        self._shaper = firmware.shaper
        self.shaper_absent = firmware.no_input_shaper
        self._corner_words = [b"SQUARE_CORNER_VELOCITY"]
        if "M205" in firmware.limit_macros:
            self._corner_words.append(b"M205")
        off = f"SET_INPUT_SHAPER SHAPER_FREQ_X=0 SHAPER_FREQ_Y=0{self._smoothers(on=False)}\n"
        self.shaper_off = self.file_shaper_off = off.encode()

    @property
    def shaper_on(self) -> bytes | None:
        """Lines that set the shaper of printer.cfg, if the machine states it."""
        s = self._shaper
        if s is None:
            return None
        return (
            f"SET_INPUT_SHAPER SHAPER_TYPE_X={s.type_x} SHAPER_FREQ_X={s.freq_x_hz:g} "
            f"DAMPING_RATIO_X={s.damping_x:g} SHAPER_TYPE_Y={s.type_y} "
            f"SHAPER_FREQ_Y={s.freq_y_hz:g} DAMPING_RATIO_Y={s.damping_y:g}"
            f"{self._smoothers(on=True)}\n"
        ).encode()

    def _smoothers(self, *, on: bool) -> str:
        """Return the words to which smoothers of forks listen, which pass over SHAPER_FREQ."""
        if (s := self._shaper) is None:
            return " SMOOTHER_FREQ_X=0 SMOOTHER_FREQ_Y=0"  # Klipper's own shapers pass over them
        axes = (("X", s.type_x, s.freq_x_hz), ("Y", s.type_y, s.freq_y_hz))
        return "".join(
            f" SMOOTHER_FREQ_{axis}={f_hz if on else 0:g}"
            for axis, kind, f_hz in axes
            if kind.startswith("smooth_")
        )

    def shaped_axes(self, line: bytes) -> str:
        """Return the axes of SHAPER_FREQ_X and SHAPER_FREQ_Y."""
        code = line.split(b";", 1)[0].upper()
        return "".join(axis for axis in "XY" if b"SHAPER_FREQ_%b=" % axis.encode() in code)

    def advance(self, limits: Limits) -> bytes:  # noqa: ARG002
        """Return nothing: a stream leaves pressure advance on."""
        return b""

    advance_aside = advance

    def conflict(self, line: bytes) -> str | None:  # noqa: ARG002
        """Return None: nothing of Klipper's own stands in the way."""
        return None

    def limits(self, limits: Limits) -> bytes:
        """Return the line that sets the planner's limits."""
        own = cast(KlipperLimits, limits)
        # Klipper before 2024-03 reads ACCEL_TO_DECEL, a newer one MINIMUM_CRUISE_RATIO.
        to_decel = own.accel_to_decel_mm_s2 or own.accel_mm_s2 * (1.0 - own.minimum_cruise_ratio)
        return (
            f"SET_VELOCITY_LIMIT VELOCITY={own.velocity_mm_s:.10g} ACCEL={own.accel_mm_s2:.10g} "
            f"ACCEL_TO_DECEL={to_decel:.10g} "
            f"SQUARE_CORNER_VELOCITY={own.square_corner_velocity_mm_s:.10g} "
            f"MINIMUM_CRUISE_RATIO={own.minimum_cruise_ratio:.10g}\n"
        ).encode()

    def acceleration(self, accel_mm_s2: float) -> bytes:
        """Return the line that sets the acceleration."""
        return f"SET_VELOCITY_LIMIT ACCEL={accel_mm_s2:g}\n".encode()

    def axis_accelerations(self, limits: Limits) -> bytes:  # noqa: ARG002
        """Return nothing: Klipper has one acceleration."""
        return b""

    def acceleration_back(self, limits: Limits) -> bytes:
        """Return the line that sets the limits' acceleration."""
        return self.acceleration(cast(KlipperLimits, limits).accel_mm_s2)

    def in_stream(self, limits: Limits) -> Limits:
        """Mark the file's own limits as being in the middle of a stream."""
        own = cast(KlipperLimits, limits)
        # The mark is the seventh decimal.
        corner = round(own.square_corner_velocity_mm_s, 6) + IN_STREAM_MARK_MM_S
        return replace(own, square_corner_velocity_mm_s=corner)

    def unmarks(self, line: bytes) -> bool:
        """Return whether a line sets the corner velocity, which holds the mark."""
        code = line.split(b";", 1)[0].upper()
        return any(word in code for word in self._corner_words)
