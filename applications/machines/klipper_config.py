"""Read the motion settings of a Klipper printer.cfg and of the files that it includes.

Rules and defaults are those of klippy/configfile.py, toolhead.py, kinematics/extruder.py,
extras/input_shaper.py, firmware_retraction.py and gcode_arcs.py (2024 to 2026).
"""

from __future__ import annotations

import glob
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from stillpath.applications.machines.klipper_macros import (
    LONGEST_MACRO,
    limit_macros,
    other_macros,
    sets_shaper,
)
from stillpath.models.errors import ModelError
from stillpath.models.firmware.klipper import shaper_type
from stillpath.models.user_files import as_utf8, read_bytes

__all__ = [
    "Fact",
    "Option",
    "PrinterConfig",
    "facts",
    "looks_like_printer_config",
    "parse_printer_config",
    "read_printer_config",
]

_CAPS = "max_velocity_silent"
"""An option of Elegoo's Centauri Carbon, where SET_VELOCITY_LIMIT and M204 stop at printer.cfg's
limits, and M900 sets pressure advance (elegooofficial/CentauriCarbon, firmware/core/klippy/
toolhead.cpp, kinematics/extruder.cpp, 2025-09)."""
_KALICO = ("danger_options", "constants")
"""Sections of Kalico alone, which stops at each SET_PRESSURE_ADVANCE (extruder.py, 2026-07)."""
_LARGEST_BYTES = 4_000_000
_MOST_FILES = 500
_SAVED_PREFIX = "#*# "
_SECTION = re.compile(r"\[(?P<name>[^]]+)\]\s*$")
_OPTION = re.compile(r"(?P<name>[^\s:=][^:=]*)[:=]\s*(?P<value>.*)$")
_REFERENCE = re.compile(r"(?<!\\)\$\{(?:(?P<section>[^.:${}]+)[.:])?(?P<option>[^${}]+)\}")
"""To another option, as Kalico has them (klippy/configfile.py, 2026-07): ${constants.speed}."""
_MOST_REFERENCES = 10
_COMMENT = re.compile(r"#.*$|(?:^|\s);.*$")
_OWN_SECTION = re.compile(r"^\[(?:printer|extruder|stepper_[xyz]|include\s[^]]+)\]", re.MULTILINE)
"""Sections that each printer.cfg has, or gets by including others."""


class Option(NamedTuple):
    """Text of an option, its line, and the file of that if it was included."""

    value: str
    line: int
    file: str = ""


_Sections: TypeAlias = dict[str, dict[str, Option]]


@dataclass(frozen=True, slots=True)
class PrinterConfig:
    """Sections of a printer.cfg, each a dict of options; names in lower case.

    Attributes
    ----------
    includes : tuple of str
        Included files that were not found, so that their contents are unknown.
    included : tuple of Path
        Included files that were read.
    """

    name: str
    sections: _Sections = field(default_factory=dict)
    includes: tuple[str, ...] = ()
    included: tuple[Path, ...] = ()

    @property
    def texts(self) -> dict[str, dict[str, str]]:
        """The options' texts by section, as they are written."""
        return {
            section: {name: option.value for name, option in options.items()}
            for section, options in self.sections.items()
        }

    def text(self, section: str, option: str, default: str | None = None) -> str | None:
        """Return an option as text, or the default.

        Raises
        ------
        ModelError
            It refers to an option that is not there.
        """
        found = self._option(section, option)
        return default if found is None else found.value

    def number(self, section: str, option: str, default: float | None = None) -> float:
        """Return an option as a number, or the default.

        Raises
        ------
        ModelError
            Naming file, line, section and option: no number, or missing without a default.
        """
        found = self._option(section, option)
        if found is None:
            if default is None:
                raise self.lacks(section, option)
            return default
        try:
            value = float(found.value)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ModelError(
                f"{found.file or self.name} line {found.line}: [{section}] {option}: "
                f"{found.value!r:.60} is no number"
            )
        return value

    def lacks(self, section: str, option: str) -> ModelError:
        """Return the error that an option is missing, with where it may stand."""
        return ModelError(f"{self.name}: [{section}] lacks {option}{_elsewhere(self.includes)}")

    def positive(self, section: str, option: str) -> float:
        """Return a number that must be there and above 0."""
        value = self.number(section, option)
        if value <= 0.0:
            _, line, file = self.sections[section][option]
            raise ModelError(
                f"{file or self.name} line {line}: [{section}] {option}: {value:g} must be above 0"
            )
        return value

    def _option(self, section: str, option: str) -> Option | None:
        """Return an option with what it refers to in place of the references."""
        found = self.sections.get(section, {}).get(option)
        for _ in range(_MOST_REFERENCES):
            if found is None or (reference := _REFERENCE.search(found.value)) is None:
                break
            where, name = (reference["section"] or section).lower(), reference["option"].lower()
            other = self.sections.get(where, {}).get(name)
            if other is None:
                remedy = _elsewhere(self.includes) if self.includes else ": put it there"
                raise ModelError(
                    f"{found.file or self.name} line {found.line}: [{section}] {option}: "
                    f"{reference[0]} refers to {name} of [{where}], which is not there{remedy}"
                )
            begin, end = reference.span()
            value = f"{found.value[:begin]}{other.value}{found.value[end:]}"
            found = found._replace(value=value)
        return found


class Fact(NamedTuple):
    """What the configuration says about one field of a machine document."""

    section: str
    option: str
    place: str
    """Field of the machine document; its first parts may be None there."""
    value: Any


def looks_like_printer_config(text: str) -> bool:
    """Return whether a text is meant as a printer.cfg."""
    return _OWN_SECTION.search(text) is not None


def read_printer_config(path: Path) -> PrinterConfig:
    """Read a printer.cfg with its SAVE_CONFIG block and what it includes.

    As in Klipper, a later option wins over an earlier one, and one of the file's own over the
    same in the block; the name of an included file may be a pattern, and counts from the folder of
    the file that includes it.

    Raises
    ------
    ModelError
        If a file cannot be read, is no configuration, or includes itself.
    """
    return _whole(_Reader(path.name), _text_of(path), path)


def parse_printer_config(
    text: str, name: str, wanted: str = "Klipper's printer.cfg"
) -> PrinterConfig:
    """Return what `read_printer_config` does, of the text of a file called `name`, alone.

    An error asks for what is `wanted`.
    """
    return _whole(_Reader(name), text, None, wanted)


def facts(config: PrinterConfig) -> list[Fact]:
    """Return the facts of a configuration, with Klipper's defaults for missing ones.

    If an included file was not found, sections that are missing altogether yield no facts.
    """
    known = [_printer, _fork, _travel, _extruder, _shaper, _retraction, _arcs, _macros]
    return [fact for find in known for fact in find(config)]


def _text_of(path: Path) -> str:
    content = read_bytes(path, _LARGEST_BYTES, "not a printer.cfg")
    return as_utf8(content).decode(errors="replace").removeprefix("\ufeff")


def _whole(
    reader: _Reader, text: str, path: Path | None, wanted: str = "Klipper's printer.cfg"
) -> PrinterConfig:
    """Return a configuration of the text of a file; without its path nothing included is read."""
    lines = text.removeprefix("\ufeff").splitlines()
    reader.read(lines, [] if path is None else [path.absolute()])
    own, includes = reader.sections, tuple(reader.missing)
    if not own:
        elsewhere = _elsewhere(includes) if includes else f"; give {wanted}"
        raise ModelError(f"{reader.name}: no [section] in it{elsewhere}")
    block = _Reader(reader.name, saved=True)
    block.read(lines, [])
    names = dict.fromkeys([*own, *block.sections])
    sections = {name: block.sections.get(name, {}) | own.get(name, {}) for name in names}
    return PrinterConfig(reader.name, sections, includes, tuple(reader.included))


@dataclass(slots=True)
class _Reader:
    """Reads a configuration and what it includes, or with `saved` its SAVE_CONFIG block."""

    name: str
    saved: bool = False
    sections: _Sections = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    included: list[Path] = field(default_factory=list)

    def read(self, lines: list[str], within: list[Path]) -> None:
        """Add the lines of the last file of `within`, which the others include in turn."""
        file = within[-1].name if len(within) > 1 else ""
        current: dict[str, Option] = {}
        begun = ""
        begun_at: int | None = None  # indentation of the option that deeper lines go on with
        for number, full in enumerate(lines, 1):
            if full.startswith("#*#") is not self.saved:
                continue
            text = full[len(_SAVED_PREFIX) :] if self.saved else full
            indented = _COMMENT.sub("", text).rstrip()
            line = indented.lstrip()
            indent = len(indented) - len(line)
            if not line:
                continue
            if begun_at is not None and indent > begun_at:
                # Numbers have one line, which may be the next; more of lists is not needed.
                kept = current[begun].value
                if not kept:
                    current[begun] = Option(line, number, file)
                elif begun.endswith("gcode") and len(kept) < LONGEST_MACRO:
                    current[begun] = current[begun]._replace(value=f"{kept}\n{line}")
                continue
            begun_at = None
            if section := _SECTION.match(line):
                name = section["name"].strip()
                if name.startswith("include "):
                    self._include(name[len("include ") :].strip(), within)
                else:
                    current = self.sections.setdefault(name.lower(), {})
            elif option := _OPTION.match(line):
                begun = option["name"].strip().lower()
                current[begun] = Option(option["value"], number, file)
                begun_at = indent

    def _include(self, name: str, within: list[Path]) -> None:
        """Read the files of an [include], in the order of their names."""
        found: list[str] = []
        if within:
            pattern = Path(glob.escape(str(within[-1].parent))) / name
            found = sorted(glob.glob(str(pattern)))  # noqa: PTH207 (hidden ones do not match)
        files = [file for file in map(Path, found) if file.is_file()]
        if not files:
            self.missing.append(name)
        for file in files:
            if file in within or len(self.included) == _MOST_FILES:
                raise ModelError(
                    f"{self.name}: [include {name}] in {within[-1].name} includes itself, or more "
                    f"than {_MOST_FILES} files are included; Klipper does not start with it"
                )
            self.included.append(file)
            self.read(_text_of(file).splitlines(), [*within, file])


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


def _elsewhere(includes: tuple[str, ...]) -> str:
    """Return where that may stand which a file lacks, and what to do."""
    if not includes:
        return "; is it a printer.cfg?"
    return (
        f"; it may stand in {', '.join(includes)}, which was not read: put it beside the file (on "
        "the command line), or give one file that holds all (cat them together)"
    )


def _numbers(
    config: PrinterConfig, section: str, *wanted: tuple[str, str, float | None]
) -> list[Fact]:
    return [
        Fact(section, option, place, config.number(section, option, default))
        for option, place, default in wanted
    ]
