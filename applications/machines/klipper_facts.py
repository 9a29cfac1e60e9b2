"""What a Klipper printer.cfg says of the fields of a machine document.

Defaults are those of klippy/toolhead.py, kinematics/extruder.py, extras/input_shaper.py,
firmware_retraction.py and gcode_arcs.py (2024 to 2026).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from stillpath.applications.machines.klipper_config import PrinterConfig
from stillpath.applications.machines.klipper_macros import limit_macros, other_macros, sets_shaper
from stillpath.models.errors import ModelError
from stillpath.models.firmware.klipper import shaper_type

__all__ = ["Fact", "facts"]

_CAPS = "max_velocity_silent"
"""An option of Elegoo's Centauri Carbon, where SET_VELOCITY_LIMIT and M204 stop at printer.cfg's
limits, and M900 sets pressure advance (elegooofficial/CentauriCarbon, firmware/core/klippy/
toolhead.cpp, kinematics/extruder.cpp, 2025-09)."""
_KALICO = ("danger_options", "constants")
"""Sections of Kalico alone, which stops at each SET_PRESSURE_ADVANCE (extruder.py, 2026-07)."""


class Fact(NamedTuple):
    """What the configuration says about one field of a machine document."""

    section: str
    option: str
    place: str
    """Field of the machine document; its first parts may be None there."""
    value: Any


def facts(config: PrinterConfig) -> list[Fact]:
    """Return the facts of a configuration, with Klipper's defaults for missing ones.

    If an included file was not found, sections that are missing altogether yield no facts.

    Raises
    ------
    ModelError
        An option that must be there is missing, or has a value that Klipper refuses.
    """
    known = [_printer, _fork, _travel, _extruder, _shaper, _retraction, _arcs, _macros]
    return [fact for find in known for fact in find(config)]


def _printer(config: PrinterConfig) -> list[Fact]:
    section = "printer"
    if section not in config.sections and config.includes:
        return []
    velocity = config.number(section, "max_velocity")
    accel = config.number(section, "max_accel")
    ratio, option, to_decel = 0.5, "minimum_cruise_ratio", 0.0
    if config.text(section, option) is None and config.text(section, "max_accel_to_decel"):
        # What it meant from 2024-03 until it was refused (2025-08): a ratio.
        option = "max_accel_to_decel"
        to_decel = config.positive(section, option)
        ratio = 1.0 - min(1.0, to_decel / config.positive(section, "max_accel"))
    else:
        ratio = config.number(section, option, ratio)
    planner, options = "firmware.planner", config.sections[section]
    older = f"{planner}.max_accel_to_decel_mm_s2"
    return [
        Fact(section, "kinematics", "kinematics", config.text(section, "kinematics")),
        Fact(section, "max_velocity", f"{planner}.max_velocity_mm_s", velocity),
        Fact(section, "max_accel", f"{planner}.max_accel_mm_s2", accel),
        Fact(section, option, f"{planner}.minimum_cruise_ratio", ratio),
        *([Fact(section, option, older, to_decel)] if to_decel else []),
        *_numbers(
            config,
            section,
            ("square_corner_velocity", f"{planner}.square_corner_velocity_mm_s", 5.0),
            ("max_z_velocity", f"{planner}.max_z_velocity_mm_s", velocity),
            ("max_z_accel", f"{planner}.max_z_accel_mm_s2", accel),
        ),
        # Only a firmware that has this option is known to cap what a file sets.
        *(
            Fact(section, _CAPS, place, value)
            for place, value in (
                ("firmware.limits_capped", True),
                ("firmware.stopping_macros", ["M900"]),
            )
            if _CAPS in options
        ),
    ]


def _fork(config: PrinterConfig) -> list[Fact]:
    stops = ["SET_PRESSURE_ADVANCE"]
    found = [section for section in _KALICO if section in config.sections]
    return [Fact(section, "", "firmware.stopping_macros", stops) for section in found[:1]]


def _travel(config: PrinterConfig) -> list[Fact]:
    """Return the ends of each axis; of one with two carriages, from the first's to the second's.

    Klipper holds each carriage to its own (klippy/kinematics/cartesian.py, idex_modes.py, 2026-08).
    """
    found = []
    for axis in "xyz":
        sections = [f"stepper_{axis}"]
        if (config.text("dual_carriage", "axis") or "").lower() == axis:
            sections.append("dual_carriage")
        ends = [
            _numbers(
                config,
                section,
                ("position_min", f"travel.{axis}.min_mm", 0.0),
                ("position_max", f"travel.{axis}.max_mm", None),
            )
            for section in sections
            if sections[0] in config.sections
        ]
        if ends:
            lows, highs = zip(*ends, strict=True)
            found.append(min(lows, key=lambda fact: float(fact.value)))
            found.append(max(highs, key=lambda fact: float(fact.value)))
    return found


def _extruder(config: PrinterConfig) -> list[Fact]:
    section, place = "extruder", "firmware.extruder"
    if section not in config.sections:
        return []
    nozzle = config.number(section, "nozzle_diameter")
    filament = config.positive(section, "filament_diameter")
    # Klipper: extrude-only moves may push as much as the widest line at the top speed.
    ratio = 4.0 * nozzle**2 / (math.pi * (0.5 * filament) ** 2)
    shared: list[Fact] = []
    if "printer" in config.sections:
        shared = _numbers(
            config,
            section,
            (
                "max_extrude_only_velocity",
                f"{place}.max_extrude_only_velocity_mm_s",
                ratio * config.number("printer", "max_velocity"),
            ),
            (
                "max_extrude_only_accel",
                f"{place}.max_extrude_only_accel_mm_s2",
                ratio * config.number("printer", "max_accel"),
            ),
        )
    return [
        Fact(section, "nozzle_diameter", f"{place}.nozzle_diameter_mm", nozzle),
        Fact(section, "filament_diameter", f"{place}.filament_diameter_mm", filament),
        *shared,
        *_numbers(
            config,
            section,
            (
                "instantaneous_corner_velocity",
                f"{place}.instantaneous_corner_velocity_mm_s",
                1.0,
            ),
            ("max_extrude_only_distance", f"{place}.max_extrude_only_distance_mm", 50.0),
            ("max_extrude_cross_section", f"{place}.max_extrude_cross_section_mm2", 4 * nozzle**2),
            ("pressure_advance", "pressure_advance_s", 0.0),
            ("pressure_advance_smooth_time", f"{place}.pressure_advance_smooth_time_s", 0.04),
        ),
    ]


def _shaper(config: PrinterConfig) -> list[Fact]:
    section, place = "input_shaper", "firmware.shaper"
    if section not in config.sections:
        return [] if config.includes else [Fact(section, "", place, None)]
    rates = [option for option in config.sections[section] if option[:-1].endswith("_freq_")]
    if sets_shaper(config.texts) and not any(config.number(section, option) for option in rates):
        return []  # what is in force is unknown, not off
    common = config.text(section, "shaper_type", "mzv")
    found = []
    for axis in "xy":
        kind = config.text(section, f"shaper_type_{axis}", common)
        try:
            kind = shaper_type(kind or "")
        except ValueError as error:
            raise ModelError(f"{config.name}: [{section}] shaper_type_{axis}: {error}") from None
        found.append(Fact(section, f"shaper_type_{axis}", f"{place}.type_{axis}", kind))
        option = "smoother_freq" if kind.startswith("smooth_") else "shaper_freq"
        found += _numbers(
            config,
            section,
            (f"{option}_{axis}", f"{place}.freq_{axis}_hz", 0.0),
            (f"damping_ratio_{axis}", f"{place}.damping_{axis}", 0.1),
        )
    return found


def _retraction(config: PrinterConfig) -> list[Fact]:
    section, place = "firmware_retraction", "firmware.retraction"
    if section not in config.sections:
        return [] if config.includes else [Fact(section, "", place, None)]
    return _numbers(
        config,
        section,
        ("retract_length", f"{place}.retract_length_mm", 0.0),
        ("retract_speed", f"{place}.retract_speed_mm_s", 20.0),
        ("unretract_extra_length", f"{place}.unretract_extra_length_mm", 0.0),
        ("unretract_speed", f"{place}.unretract_speed_mm_s", 10.0),
    )


def _arcs(config: PrinterConfig) -> list[Fact]:
    section = "gcode_arcs"
    if section not in config.sections:
        return [] if config.includes else [Fact(section, "", "firmware.arcs", False)]
    resolution = config.number(section, "resolution", 1.0)
    return [
        Fact(section, "", "firmware.arcs", True),
        Fact(section, "resolution", "firmware.arc_resolution_mm", resolution),
    ]


def _macros(config: PrinterConfig) -> list[Fact]:
    """Return macros that change how words of other firmwares are read, or M204."""
    texts = config.texts
    found = (
        ("firmware.macros", other_macros(texts)),
        ("firmware.limit_macros", limit_macros(texts)),
    )
    return [
        Fact("gcode_macro", "", place, names)
        for place, names in found
        if names or not config.includes
    ]


def _numbers(
    config: PrinterConfig, section: str, *wanted: tuple[str, str, float | None]
) -> list[Fact]:
    return [
        Fact(section, option, place, config.number(section, option, default))
        for option, place, default in wanted
    ]
