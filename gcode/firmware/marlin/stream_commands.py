"""G-code that Marlin needs before and after a stream."""

from __future__ import annotations

import re
from decimal import Decimal
from typing import cast

from stillpath.gcode.firmware.marlin.limits import MarlinLimits, without_advance
from stillpath.gcode.types import Limits
from stillpath.models.firmware import Marlin

__all__ = ["SIGNATURE", "MarlinStreamCommands"]

SIGNATURE = (
    rb"M203 X\S+ Y\S+ Z\S+ E\S+\s+M204 P\S+ R\S+ T\S+\s+"
    rb"M205 B0 S0 T0 (?:J\S+|X\S+ Y\S+ Z\S+ E\S+)\s"
)
"""Limits of a stream: M503 has the same order, but decimals, and no B of 0 by default."""

_NOTES = (
    "between 'stream on' and 'stream off' the limits of M201, M203, M204 and M205",
    "are the motors' and every move is timed: leave the speed at 100 %. A print that is",
    "stopped in there leaves them in force: send M501; see Stillpath's docs/safety.md.",
)

# M493 V asks for the version, and S without a number is S1.
_FIXED_TIME = re.compile(rb"\s*(?:N\d+\s*)?M493(?!\d)\s*(?!V\s*(?:[;*]|$))[A-Z]", re.IGNORECASE)
_FIXED_TIME_OFF = re.compile(rb"[^;]*\bM493(?!\d)[^;]*S0+(?![\d.])", re.IGNORECASE)

# AnkerMake-Marlin, gcode/anker_gcode/M4200_M4900.cpp and config/M200-M205.cpp (2023-09).
_ANKER = re.compile(rb"\s*(?:N\d+\s*)?M4899(?!\d)[^;]*T", re.IGNORECASE)


class MarlinStreamCommands:
    """Lines that Marlin understands; see `gcode.firmware.base.StreamCommands`.

    Sources: Marlin/src/gcode/config/M200-M205.cpp, gcode/feature/input_shaping/M593.cpp,
    gcode/geometry/G92.cpp, feature/advance/M900.cpp and parser.cpp, release 2.1.2 (2023-01);
    feature/ft_motion/M493.cpp, bugfix-2.1.x, 2026-08.
    """

    stand_still = b"M400 ; stand still\n"
    fence = b""
    positioning_sets_extruder = True
    coarse_extruder = True
    relative_moves_count = True
    replays = False
    one_command = True
    first_wins = False
    ignores_subcodes = True
    marks = False
    factors_need_axes = False
    advance_off = b""
    advance_assumed = False
    shaper_absent = False
    file_shaper_off = b"M593 F0\n"

    def __init__(self, firmware: Marlin) -> None:
        self.folds_case = firmware.case_insensitive
        self._shaper = firmware.shaper
        self._has_shaper = firmware.variant != "2.0"
        if firmware.shaper is not None:
            self._has_shaper = firmware.shaper.freq_x_hz + firmware.shaper.freq_y_hz > 0.0
        self._advances = firmware.linear_advance is not False
        self._classic_jerk = firmware.junction == "classic_jerk"
        self._least_steps = firmware.min_steps_per_segment
        self._least_mm = firmware.shortest_move_mm

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines of the header: what to mind in a stream, and what short moves cost."""
        if self._least_steps <= 1:
            return _NOTES
        least = f"{self._least_steps} steps ({1e3 * self._least_mm:.0f} um)"
        return (
            *_NOTES,
            f"this firmware swallows moves below {least}: slow turns are",
            "cut off; a build with MIN_STEPS_PER_SEGMENT 1 follows them.",
        )

    @property
    def shaper_off(self) -> bytes:
        """Line that sets both axes to 0 Hz; a build without a shaper passes it over."""
        return b"M593 F0\n" if self._has_shaper else b""

    @property
    def shaper_on(self) -> bytes | None:
        """Lines that set the shaper that the machine states; None: it does not say."""
        s = self._shaper
        if not self._has_shaper:
            return b""
        if s is None:
            return None
        x = f"M593 X F{s.freq_x_hz:g} D{s.damping_x:g}\n"
        y = f"M593 Y F{s.freq_y_hz:g} D{s.damping_y:g}\n"
        # A build that shapes X alone passes over the Y, and takes its line for X.
        return (x + y if s.freq_y_hz > 0.0 else y + x).encode()

    def shaped_axes(self, line: bytes) -> str:
        """Return those of X and Y that an M593 with F names, or both if it names none."""
        code = line.split(b";", 1)[0].upper().decode("latin-1")
        named = "".join(axis for axis in "XYZ" if axis in code) or "XY"
        return named.replace("Z", "") if "F" in code else ""

    def advance(self, limits: Limits) -> bytes:  # noqa: ARG002
        """Return nothing: it comes with the limits."""
        return b""

    def advance_aside(self, limits: Limits) -> bytes:
        """Return the line that sets K, which `in_stream` has left off."""
        k_s = cast(MarlinLimits, limits).linear_advance_k_s
        return f"M900 K{_number(k_s)}\n".encode() if self._advances and k_s > 0.0 else b""

    def conflict(self, line: bytes) -> str | None:
        """Return why not, for a line that switches another kind of motion on."""
        if _ANKER.match(line):
            return (
                "M4899 T is of AnkerMake's Marlin, which sets limits and S-curve by it, and cuts "
                "down those of M201 to M205 that a stream needs: print as sliced"
            )
        if not _FIXED_TIME.match(line) or _FIXED_TIME_OFF.match(line):
            return None
        return (
            "M493 sets fixed-time motion, whose planner and shapers would work on top of the "
            "compensation; take it out of the start code (M493 S0 is fine), or use method advise"
        )

    def limits(self, limits: Limits) -> bytes:
        """Return the lines that set the planner's limits."""
        own = cast(MarlinLimits, limits)
        if self._classic_jerk:
            corner = (
                f"X{_number(own.jerk_x_mm_s)} Y{_number(own.jerk_y_mm_s)} "
                f"Z{_number(own.jerk_z_mm_s)} E{_number(own.jerk_e_mm_s)}"
            )
        else:
            corner = f"J{_number(own.junction_deviation_mm)}"
        k_s = 0.0 if own.advance_in_filament else own.linear_advance_k_s
        advance = f"M900 K{_number(k_s)}\n" if self._advances and own.linear_advance_k_s else ""
        return (
            f"M201 X{_number(own.accel_x_mm_s2)} Y{_number(own.accel_y_mm_s2)} "
            f"Z{_number(own.accel_z_mm_s2)} E{_number(own.accel_e_mm_s2)}\n"
            f"M203 X{_number(own.feedrate_x_mm_s)} Y{_number(own.feedrate_y_mm_s)} "
            f"Z{_number(own.feedrate_z_mm_s)} E{_number(own.feedrate_e_mm_s)}\n"
            f"M204 P{_number(own.print_accel_mm_s2)} R{_number(own.retract_accel_mm_s2)} "
            f"T{_number(own.travel_accel_mm_s2)}\n"
            f"M205 B{_number(own.min_segment_time_us)} S{_number(own.min_feedrate_mm_s)} "
            f"T{_number(own.min_travel_feedrate_mm_s)} {corner}\n{advance}"
        ).encode()

    def acceleration(self, accel_mm_s2: float) -> bytes:
        """Return the line that sets the acceleration of moves with and without filament."""
        accel = _number(float(f"{accel_mm_s2:g}"))
        return f"M204 P{accel} T{accel}\n".encode()

    def axis_accelerations(self, limits: Limits) -> bytes:
        """Return M201 of X and Y."""
        own = cast(MarlinLimits, limits)
        x, y = _number(own.accel_x_mm_s2), _number(own.accel_y_mm_s2)
        return f"M201 X{x} Y{y}\n".encode()

    def acceleration_back(self, limits: Limits) -> bytes:
        """Return the line that sets the limits' accelerations of these moves."""
        own = cast(MarlinLimits, limits)
        accels = _number(own.print_accel_mm_s2), _number(own.travel_accel_mm_s2)
        return "M204 P{} T{}\n".format(*accels).encode()

    def in_stream(self, limits: Limits) -> Limits:
        """Return the limits with linear advance off: a rest's own moves know none.

        M900 makes the firmware stand still where K changes. Marlin has no macros that could read a
        mark.
        """
        return without_advance(cast(MarlinLimits, limits))

    def unmarks(self, line: bytes) -> bool:  # noqa: ARG002
        """Return False: there is no mark."""
        return False


def _number(value: float) -> str:
    """Ten digits without an exponent, at which Marlin stops reading."""
    return f"{Decimal(f'{value:.10g}'):f}"
