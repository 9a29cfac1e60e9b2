"""Generate G-code: lines, layers and regions within the travel, with correct extrusion.

Everything is written with absolute X Y Z and relative E. Moves are planned (`STILLPATH_OFF`) unless
a part asks for compensation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from stillpath.gcode.firmware.registry import adapter
from stillpath.models.errors import ModelError
from stillpath.models.firmware import FirmwareRetraction
from stillpath.models.machine import Machine

__all__ = ["Place", "PrintSettings", "Program", "place"]

Point = tuple[float, float]

_MARGIN_MM = 5.0
"""Least distance of prints from the ends of the travel."""
_GENTLE_MM_S2 = 2000.0
_TRAVEL_MM_S = 200.0
_BASE_MM_S = (50.0, 100.0)
"""Speeds of the first and second layer of the base."""
_LETTER_MM_S = 40.0
_LETTERS: dict[str, tuple[tuple[Point, ...], ...]] = {
    "O": (((0, 0), (3, 0), (3, 5), (0, 5), (0, 0)),),
    "N": (((0, 0), (0, 5), (3, 0), (3, 5)),),
    "F": (((0, 0), (0, 5), (3, 5)), ((0, 2.6), (2.4, 2.6))),
}
LETTER_PITCH_MM, LETTER_HEIGHT_MM = 5.0, 5.0


@dataclass(frozen=True, slots=True)
class PrintSettings:
    """Print settings that are not in the machine's model.

    Attributes
    ----------
    max_flow_mm3_s : float
        Melting rate of the hotend; bounds the speed of walls.
    centre_mm : tuple of float, optional
        Centre of the print; None: the middle of the travel.
    start_gcode, end_gcode : str, optional
        Instead of the lines that home and heat before the first of ours, and those that switch
        off and park after the last.
    """

    nozzle_temp_c: float = 210.0
    bed_temp_c: float = 60.0
    fan_percent: float = 100.0
    max_flow_mm3_s: float = 12.0
    centre_mm: Point | None = None
    start_gcode: str | None = None
    end_gcode: str | None = None


@dataclass(frozen=True, slots=True)
class Place:
    """The rectangle of a print on the bed."""

    low_mm: Point
    high_mm: Point


def place(
    machine: Machine, settings: PrintSettings, width_mm: float, depth_mm: float, what: str
) -> Place:
    """Return the place of a print of this size.

    Raises
    ------
    ModelError
        If it does not fit into the travel with its margin, or the temperatures make no sense.
    """
    _check(settings)
    travel = [machine.travel[a] for a in ("x", "y")]
    middle = tuple(0.5 * (t.min_mm + t.max_mm) for t in travel)
    low, high = [], []
    centre = settings.centre_mm or middle
    for axis, t, c, size in zip("xy", travel, centre, (width_mm, depth_mm), strict=True):
        room = min(c - t.min_mm, t.max_mm - c) - _MARGIN_MM
        if not 0.5 * size <= room:  # a centre may be nan
            raise ModelError(
                f"the {what} is {width_mm:.0f} x {depth_mm:.0f} mm; around {axis} = {c:g} mm the "
                f"travel of {axis} ({t.min_mm:g} to {t.max_mm:g} mm) leaves {2 * room:.0f} mm with "
                f"a margin of {_MARGIN_MM:g} mm: correct the machine's travel, or move it (--at)"
            )
        low.append(c - 0.5 * size)
        high.append(c + 0.5 * size)
    return Place((low[0], low[1]), (high[0], high[1]))


class Program:
    """Write a print.

    Attributes
    ----------
    width_mm, layer_mm : float
        Of a line.
    section_mm2 : float
        Of a line, ends round.
    gentle_mm_s2 : float
        Acceleration of everything that is not examined.
    """

    def __init__(self, machine: Machine, settings: PrintSettings) -> None:
        self._firmware_adapter = adapter(machine)
        self._stream_commands = self._firmware_adapter.stream_commands()
        extruder = machine.firmware.hotend
        self._machine, self._settings = machine, settings
        self.width_mm = 1.125 * extruder.nozzle_diameter_mm
        self.layer_mm = 0.5 * extruder.nozzle_diameter_mm
        self.section_mm2 = self.layer_mm * (self.width_mm - (1 - math.pi / 4) * self.layer_mm)
        self._filament_mm2 = math.pi * (0.5 * extruder.filament_diameter_mm) ** 2
        self._retraction = machine.firmware.retraction or FirmwareRetraction()
        firmware = machine.firmware
        self._travel_mm_s = min(_TRAVEL_MM_S, firmware.fastest_mm_s)
        self._z_mm_s = min(10.0, firmware.fastest_z_mm_s)
        self.gentle_mm_s2 = min(_GENTLE_MM_S2, firmware.largest_accel_mm_s2)
        self._out: list[str] = []
        self._at: Point | None = None
        self._z_mm = 0.0
        self._retracted = False

    def text(self) -> str:
        """Return all lines."""
        return "\n".join(self._out) + "\n"

    def begin(self, purge_from: Point, purge_mm: float) -> None:
        """Home, heat, and purge along X."""
        s = self._settings
        own = (
            f"M140 S{s.bed_temp_c:g}",
            f"M104 S{s.nozzle_temp_c:g}",
            "G28",
            f"M190 S{s.bed_temp_c:g}",
            f"M109 S{s.nozzle_temp_c:g}",
        )
        self._add(*(s.start_gcode.splitlines() if s.start_gcode is not None else own))
        self._add(
            "; STILLPATH_OFF",
            "G90",
            "M83",
            "G92 E0",
            "M220 S100",
            "M221 S100",
            "M107",
            # Planned motion is predicted and compared without the firmware's shaper.
            *self._stream_commands.shaper_off.decode().splitlines(),
        )
        self.limit_accel(self.gentle_mm_s2)
        self.region("purge")
        self._rise(5.0)
        self._go(purge_from)
        self._rise(1.4 * self.layer_mm)
        self._add("G1 E4 F300")
        self._line((purge_from[0] + purge_mm, purge_from[1]), 20.0, 2.0)

    def finish(self) -> None:
        """Restore limits and shaper, switch heaters off, move the nozzle up and aside."""
        machine = self._machine
        self._retract()
        own = self._stream_commands.acceleration_back(self._firmware_adapter.initial_limits())
        self._add(*(own + (self._stream_commands.shaper_on or b"")).decode().splitlines())
        if self._settings.end_gcode is not None:
            self._add(*self._settings.end_gcode.splitlines())
            return
        x, y, z = (machine.travel[a] for a in ("x", "y", "z"))
        self._add("M104 S0", "M140 S0", "M107")
        self._rise(min(self._z_mm + 20.0, z.max_mm))
        self._go((x.min_mm + _MARGIN_MM, y.max_mm - _MARGIN_MM))

    def layer(self, z_mm: float) -> None:
        """Begin a layer whose top is at `z_mm`.

        Raises
        ------
        ModelError
            If that is above the travel of Z.
        """
        highest_mm = self._machine.travel["z"].max_mm
        if z_mm > highest_mm:
            raise ModelError(
                f"the print reaches z = {z_mm:.2f} mm and the travel of z ends at {highest_mm:g} "
                "mm: take fewer bands (--bands), or correct the machine's travel"
            )
        self._retract()
        self._add(";LAYER_CHANGE", f";Z:{z_mm:.3f}")
        self._rise(z_mm)

    def region(self, name: str) -> None:
        """Start a named region, for which figures are computed."""
        self._add(f";TYPE:{name}")

    @contextmanager
    def compensated(self) -> Iterator[None]:
        """Let the moves of a `with` block be compensated."""
        self._add("; STILLPATH_ON")
        yield
        self._add("; STILLPATH_OFF")

    def limit_accel(self, accel_mm_s2: float) -> None:
        """Set the acceleration of the following moves."""
        self._add(*self._stream_commands.acceleration(accel_mm_s2).decode().splitlines())

    def stand(self, seconds: float) -> None:
        """Stand still with filament retracted."""
        self._retract()
        self._add(f"G4 P{1e3 * seconds:.0f}")

    def trace(self, points: Sequence[Point], speed_mm_s: float) -> None:
        """Travel to the first point and extrude along all others."""
        if self._at is None or math.dist(self._at, points[0]) > self.width_mm:
            self._retract()
            self._go(points[0])
        self._unretract()
        for point in points[1:]:
            self._line(point, speed_mm_s)

    def base(self, low_mm: Point, high_mm: Point) -> float:
        """Print two solid layers, fan off; return their height."""
        self.region("base")
        for number, speed in enumerate(_BASE_MM_S):
            self.layer((number + 1) * self.layer_mm)
            self.trace(_meander(low_mm, high_mm, self.width_mm, along_y=number == 1), speed)
        self._add(f"M106 S{255 * self._settings.fan_percent / 100:.0f}")
        return 2 * self.layer_mm

    def word(self, letters: str, middle_mm: Point) -> None:
        """Print a word of O, F and N, as wide lines, around a point."""
        x = middle_mm[0] - 0.5 * (LETTER_PITCH_MM * len(letters) - 2.0)
        for k, letter in enumerate(letters):
            for stroke in _LETTERS[letter]:
                left, low = x + k * LETTER_PITCH_MM, middle_mm[1] - 0.5 * LETTER_HEIGHT_MM
                self.trace([(left + a, low + b) for a, b in stroke], _LETTER_MM_S)

    def _add(self, *lines: str) -> None:
        self._out.extend(lines)

    def _go(self, point: Point) -> None:
        self._add(f"G1 X{point[0]:.3f} Y{point[1]:.3f} F{60 * self._travel_mm_s:.0f}")
        self._at = point

    def _rise(self, z_mm: float) -> None:
        self._add(f"G1 Z{z_mm:.3f} F{60 * self._z_mm_s:.0f}")
        self._z_mm = z_mm

    def _line(self, point: Point, speed_mm_s: float, thickness: float = 1.0) -> None:
        assert self._at is not None
        section_mm2 = self.section_mm2 * thickness
        feed = math.dist(self._at, point) * section_mm2 / self._filament_mm2
        speed_mm_s = min(speed_mm_s, self._settings.max_flow_mm3_s / section_mm2)
        self._add(f"G1 X{point[0]:.3f} Y{point[1]:.3f} E{feed:.5f} F{60 * speed_mm_s:.0f}")
        self._at = point

    def _retract(self) -> None:
        if not self._retracted:
            r = self._retraction
            self._add(f"G1 E-{r.retract_length_mm:.3f} F{60 * r.retract_speed_mm_s:.0f}")
            self._retracted = True

    def _unretract(self) -> None:
        if self._retracted:
            r = self._retraction
            length = r.retract_length_mm + r.unretract_extra_length_mm
            self._add(f"G1 E{length:.3f} F{60 * r.unretract_speed_mm_s:.0f}")
            self._retracted = False


def _check(settings: PrintSettings) -> None:
    for name, value, low, high in (
        ("nozzle temperature", settings.nozzle_temp_c, 150.0, 350.0),
        ("bed temperature", settings.bed_temp_c, 0.0, 150.0),
        ("fan", settings.fan_percent, 0.0, 100.0),
        ("largest flow", settings.max_flow_mm3_s, 2.0, 100.0),
    ):
        if not low <= value <= high:
            raise ModelError(f"{name} {value:g} is outside {low:g} to {high:g}")


def _meander(low: Point, high: Point, pitch: float, *, along_y: bool) -> list[Point]:
    """Return lines that fill a rectangle back and forth."""
    if along_y:
        turned = _meander((low[1], low[0]), (high[1], high[0]), pitch, along_y=False)
        return [(x, y) for y, x in turned]
    rows = int((high[1] - low[1] - pitch) / pitch) + 1
    out: list[Point] = []
    for k in range(rows):
        y = low[1] + pitch * (k + 0.5)
        ends = [(low[0] + 0.5 * pitch, y), (high[0] - 0.5 * pitch, y)]
        out += ends if k % 2 == 0 else ends[::-1]
    return out
