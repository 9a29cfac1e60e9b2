"""What the macros of a Klipper printer.cfg say about how its G-code is read.

Sections are mappings of their names, in lower case, to their options: names and texts.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TypeAlias

from stillpath.gcode.firmware.klipper.dialect import FOREIGN

__all__ = ["LONGEST_MACRO", "limit_macros", "other_macros", "sets_shaper"]

LONGEST_MACRO = 4000
"""Characters of a macro beyond which no more of it is kept."""
_HALVES = re.compile(r"ACCEL_TO_DECEL=\{[^{}\n]*(/\s*2(\.0*)?|\*\s*0?\.50*)\s*\}")
"""In M204 of QIDI's printers (QIDITECH, gcode_macro.cfg, 2023 to 2025), and of a tool changer with
KTCC (AkeemA/DakshV2-350-5Tools-Backup, 2025-08)."""
_LIMITS = {"M203": "VELOCITY", "M205": "SQUARE_CORNER_VELOCITY"}
"""Macros that makers have for Cura's files, and what they set."""
_STATEMENT, _EXPRESSION = re.compile(r"\{%.*?%\}", re.DOTALL), re.compile(r"\{[^{}]*\}")
_OURS = "gcode_macro stillpath_"

_Sections: TypeAlias = Mapping[str, Mapping[str, str]]


def limit_macros(sections: _Sections) -> list[str]:
    """Return macros that set their limit from X and Y as they are, and do nothing else."""
    bodies = _bodies(sections)
    return [name for name in _LIMITS if name in bodies and _only_limits(name, bodies[name])]


def other_macros(sections: _Sections) -> list[str]:
    """Return macros that would be taken for words of another firmware, or for Klipper's M204."""
    bodies = _bodies(sections)
    found = sorted(bodies.keys() & FOREIGN.keys() - set(limit_macros(sections)))
    return sorted([*found, "M204"]) if _HALVES.search(bodies.get("M204", "")) else found


def sets_shaper(sections: _Sections) -> bool:
    """Return whether what sets the shaper may be SET_INPUT_SHAPER, and not [input_shaper].

    With two carriages nothing else does (klippy/extras/input_shaper.py, 2026-08). A tool changer's
    macros set the one of each tool (viesturz/klipper-toolchanger, 2025), from options such as
    params_input_shaper_freq_x.
    """
    return "dual_carriage" in sections or any(
        "SET_INPUT_SHAPER" in text.upper() or "_input_shaper_freq_" in option
        for section, options in sections.items()
        if not section.startswith(_OURS)
        for option, text in options.items()
    )


def _bodies(sections: _Sections) -> dict[str, str]:
    return {
        section.partition("gcode_macro ")[2].strip().upper(): options.get("gcode", "")
        for section, options in sections.items()
        if section.startswith("gcode_macro ")
    }


def _only_limits(name: str, body: str) -> bool:
    if not body or len(body) >= LONGEST_MACRO or re.search(r"[*/+]", body):
        return False
    line = re.compile(rf"SET_VELOCITY_LIMIT(\s+{_LIMITS[name]}=(\{{}}|\"\{{}}\"))?\s*")
    plain = _EXPRESSION.sub("{}", _STATEMENT.sub("", body))
    return all(line.fullmatch(row.strip()) for row in plain.split("\n") if row.strip())
