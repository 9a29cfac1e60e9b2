"""G-code that RepRapFirmware needs before and after a stream."""

from __future__ import annotations

from typing import cast

from stillpath.gcode.firmware.reprapfirmware.limits import RepRapLimits
from stillpath.gcode.types import Limits
from stillpath.models.firmware import RepRapFirmware

__all__ = ["SIGNATURE", "RepRapStreamCommands"]

_AXES = ("x", "y", "z", "e")
_FENCE = "G1"
"""Limits hold as soon as they are read, also for the move before them while it waits for room in
the ring and is not planned yet. A G1 without words waits until that is planned, and is no move
itself (RepRapFirmware src/GCodes/GCodes2.cpp, cases 1, 201, 203, 204 and 566; GCodes.cpp,
DoStraightMove; 3.5)."""

SIGNATURE = (
    rb"G1\s+M201 X\S+ Y\S+ Z\S+ E\S+\s+M203 X\S+ Y\S+ Z\S+ E\S+ I\S+\s+"
    rb"M204 P\S+ T\S+\s+M566 X\S+ Y\S+ Z\S+ E\S+ P1\s"
)
"""Limits of a stream after their fence, a G1 without words, which nobody else writes."""


class RepRapStreamCommands:
    """Lines that RepRapFirmware understands; see `gcode.firmware.base.StreamCommands`.

    Parameters
    ----------
    pressure_advance_s : float
        The machine's M572 S: the stream's filament holds it already, so the firmware's is off
        together with the shaper.
    """

    notes = (
        "between 'stream on' and 'stream off' M201, M203, M204 and M566 are raised, M593 and",
        "M572 are off, and every move is timed: leave the speed slider at 100 %. cancel.g",
        "must put your own values back first: see Stillpath's docs/safety.md.",
    )
    stand_still = b"M400\n"
    fence = f"{_FENCE}\n".encode()
    positioning_sets_extruder = False
    folds_case = True
    coarse_extruder = False
    relative_moves_count = False
    replays = True
    one_command = False
    first_wins = True
    ignores_subcodes = False
    marks = False
    factors_need_axes = True
    shaper_absent = False

    def __init__(self, firmware: RepRapFirmware, pressure_advance_s: float) -> None:
        shaper = firmware.shaper
        self.advance_off = _advance(0.0)
        self.advance_assumed = pressure_advance_s == 0.0
        self.shaper_off = b'M593 P"none"\n' + self.advance_off
        self.file_shaper_off = self.shaper_off
        restored = 'M593 P"none"\n'
        if shaper.type != "none":
            restored = f'M593 P"{shaper.type}" F{shaper.freq_hz:g} S{shaper.damping:g}\n'
        self.shaper_on: bytes | None = restored.encode() + _advance(pressure_advance_s)

    def shaped_axes(self, line: bytes) -> str:  # noqa: ARG002
        """Return both: M593 is of all axes."""
        return "XY"

    def advance(self, limits: Limits) -> bytes:
        """Return M572 for the tool in use."""
        return _advance(cast(RepRapLimits, limits).pressure_advance_s)

    def advance_aside(self, limits: Limits) -> bytes:
        """Return M572 for the tool in use, unless it is 0."""
        return self.advance(limits) if cast(RepRapLimits, limits).pressure_advance_s > 0.0 else b""

    def conflict(self, line: bytes) -> str | None:  # noqa: ARG002
        """Return None: nothing of RepRapFirmware's own stands in the way."""
        return None

    def limits(self, limits: Limits) -> bytes:
        """Lines that set the planner's limits for the moves after them, M572 left out."""
        own = cast(RepRapLimits, limits)
        lines = [
            _FENCE,
            "M201" + _words(own, "accel_{}_mm_s2", 1.0),
            "M203" + _words(own, "speed_{}_mm_s", 60.0) + f" I{_number(60.0 * own.min_speed_mm_s)}",
            f"M204 P{_number(own.print_accel_mm_s2)} T{_number(own.travel_accel_mm_s2)}",
            "M566" + _words(own, "max_jerk_{}_mm_s", 60.0) + f" P{own.jerk_policy:.0f}",
        ]
        jerks = [
            axis
            for axis in _AXES
            if getattr(own, f"jerk_{axis}_mm_s") != getattr(own, f"max_jerk_{axis}_mm_s")
        ]
        if jerks:
            lines.append("M205" + _words(own, "jerk_{}_mm_s", 1.0, jerks))
        return "".join(f"{line}\n" for line in lines).encode()

    def acceleration(self, accel_mm_s2: float) -> bytes:
        """Return the line that limits the acceleration of X and Y; M201 still limits each axis."""
        accel = _number(accel_mm_s2)
        return f"{_FENCE}\nM204 P{accel} T{accel}\n".encode()

    def axis_accelerations(self, limits: Limits) -> bytes:
        """Return M201 of X and Y."""
        own = cast(RepRapLimits, limits)
        words = _words(own, "accel_{}_mm_s2", 1.0, ["x", "y"])
        return f"{_FENCE}\nM201{words}\n".encode()

    def acceleration_back(self, limits: Limits) -> bytes:
        """Return the line that sets the limits' M204."""
        own = cast(RepRapLimits, limits)
        accels = _number(own.print_accel_mm_s2), _number(own.travel_accel_mm_s2)
        return "{}\nM204 P{} T{}\n".format(_FENCE, *accels).encode()

    def in_stream(self, limits: Limits) -> Limits:
        """Return the file's own limits."""
        return limits

    def unmarks(self, line: bytes) -> bool:  # noqa: ARG002
        """Return False: there is no mark."""
        return False


def _advance(seconds: float) -> bytes:
    return f"M572 S{_number(seconds)}\n".encode()


def _words(
    limits: RepRapLimits, field: str, scale: float, axes: tuple[str, ...] | list[str] = _AXES
) -> str:
    values = [(axis.upper(), scale * getattr(limits, field.format(axis))) for axis in axes]
    return "".join(f" {letter}{_number(value)}" for letter, value in values)


def _number(value: float) -> str:
    # What rounds to 0 would be taken for the firmware's least.
    decimals = 6 if abs(value) >= 1e-3 else 15
    text = f"{value:.{decimals}f}".rstrip("0").rstrip(".")
    return text or "0"
