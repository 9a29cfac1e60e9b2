"""Read Marlin's reply to M503 as the firmware section of a machine."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from typing import Any

from pydantic import ValidationError

from stillpath.applications.machines.envelope import derived_envelope, with_firmware
from stillpath.applications.machines.stated import StatedMachine, put_fields, stated_axis
from stillpath.models.complaints import explain
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine

__all__ = [
    "ASSUMED",
    "firmware_section",
    "looks_like_m503",
    "machine_from_m503",
    "of_other_tools",
    "read_travel",
    "rounded",
    "with_m503",
]

ASSUMED = {
    "variant": "2.1",
    "board": "32bit",
    "min_steps_per_segment": 6,
    "block_buffer_size": 16,
    "s_curve": False,
    "step_smoothing_hz": 0,
}
"""Settings that a stream depends on but M503 does not report, as in most builds."""

_COMMAND = re.compile(r"(M\d{2,3})((?:\s+[A-Z](?:-?\d+(?:\.\d*)?)?)+)\s*(?:;.*)?$")
_REPRAP = re.compile(r"(?m)^[^;\n]*\b(M566|M584)\b")
"""Jerk and drivers, which each config.g sets and no Marlin prints."""
_WORD = re.compile(r"([A-Z])(-?\d+(?:\.\d*)?)?")
_MARLIN_2_0 = re.compile(r"Advanced: B<|FIRMWARE_NAME:Marlin 2\.0\b")
"""Heading of M205 in 2.0.5 to 2.0.9.1 and forks of them (settings.cpp; since 2.0.9.2 `Advanced
(B<`), or what M115 says."""
_MARLIN_1 = re.compile(r"Advanced(?: variables: S=|: [QS]<)")
"""Heading of M205 in Marlin 1, which runs on 8-bit boards: 1.0 and Prusa's for the MK3 (3.13,
ConfigurationStore.cpp), 1.1.0 to 1.1.8 and 1.1.9 (configuration_store.cpp)."""
_BUDDY = re.compile(r"(?m)^[^;\n]*Unified Bed Leveling:")
"""A heading of M503 in Prusa's Buddy firmware, and with that option in Marlin before 2.0.5; later
ones have a semicolon before it."""
_ROUNDED = (
    "planner.junction_deviation_mm",
    "linear_advance_k_s",
    "shaper.damping_x",
    "shaper.damping_y",
)
_ROUNDING = 0.00501
"""Marlin prints two decimals of everything, which is little of these."""
_PER_TOOL = {"M92", "M201", "M203", "M900"}
_LONGEST_LINE = 500

_Words = dict[str, float | None]
_PLANNER: dict[str, tuple[str, str] | tuple[str, str, float]] = {
    "accel_mm_s2": ("M204", "P"),
    "retract_accel_mm_s2": ("M204", "R"),
    "travel_accel_mm_s2": ("M204", "T"),
    "min_segment_time_us": ("M205", "B", 20_000.0),
    "min_feedrate_mm_s": ("M205", "S", 0.0),
    "min_travel_feedrate_mm_s": ("M205", "T", 0.0),
}
"""Command and word of each planner limit, and its value if the word is not printed."""


def looks_like_m503(text: str) -> bool:
    """Return whether a text is an answer to M503, whole or in part."""
    return not {"M92", "M201", "M203", "M204", "M205"}.isdisjoint(_commands(text))


def firmware_section(text: str, name: str) -> dict[str, Any]:
    """Return those fields of a Marlin section that a printed M503 contains.

    Parameters
    ----------
    text : str
        The printer's reply, or a host's log of it; of repeated commands the last counts, of several
        tools the first.
    name : str
        The file, for messages.

    Raises
    ------
    ModelError
        If a command that every Marlin prints is missing or lacks a word, if units are inches, or
        if the printer runs another firmware, is a delta, or has a shaper that stays on.
    """
    _check_text(text, name)
    found = _commands(text)
    _rename_of_1_0(found)
    _check_printer(found, name)

    def word(command: str, letter: str, default: float | None = None) -> float:
        value = found.get(command, {}).get(letter)
        if value is None and default is None:
            raise ModelError(
                f"{name}: no {command} {letter} in it; send M503 and save all of the answer"
            )
        return float(value if value is not None else default or 0.0)

    def per_axis(command: str) -> dict[str, float]:
        return {axis: word(command, axis.upper()) for axis in "xyze"}

    by_deviation = found.get("M205", {}).get("J") is not None
    planner = {
        "max_feedrate_mm_s": per_axis("M203"),
        "max_accel_mm_s2": per_axis("M201"),
        **{field: word(*where) for field, where in _PLANNER.items()},
        **(
            {"junction_deviation_mm": word("M205", "J")}
            if by_deviation
            else {"jerk_mm_s": per_axis("M205")}
        ),
    }
    return _versions(found, text) | {
        "kind": "marlin",
        "steps_per_mm": per_axis("M92"),
        "planner": planner,
        "junction": "deviation" if by_deviation else "classic_jerk",
        # Each is printed by every build that has it.
        "linear_advance": "M900" in found,
        "linear_advance_k_s": word("M900", "K", 0.0),
        # A Buddy has one, of which its answer says nothing (M593 without words does).
        "shaper": None if _is_buddy(found, text) else _shaper(found),
        "ft_motion": word("M493", "S", 0.0) > 0.0,
        "retraction": _retraction(found, word),
        **_arcs(found),
    }


def _rename_of_1_0(found: dict[str, _Words]) -> None:
    """Give what Marlin 1.0 prints today's names: M204 S and T (of retractions), M205 X of X and Y.

    So do Prusa's for the MK2 and MK3 of old (ConfigurationStore.cpp).
    """
    old, jerk = found.get("M204", {}), found.get("M205", {})
    if "S" in old and "P" not in old:
        found["M204"] = {"P": old["S"], "R": old.get("T", old["S"]), "T": old["S"]}
    if "X" in jerk:
        jerk.setdefault("Y", jerk["X"])


def _check_text(text: str, name: str) -> None:
    """Refuse inches, and RepRapFirmware's answer; `name` is the file's."""
    if re.search(r"(?m)^(?:.*:)?\s*G20\b", text):
        raise ModelError(f"{name}: the printer works in inches; send G21, then M503 again")
    if line := _REPRAP.search(text):
        raise ModelError(
            f"{name}: {line[1]} says that these are RepRapFirmware's settings, which answers M503 "
            "with config.g: give that to machines from-config, or to machines set-firmware"
        )


def _check_printer(found: dict[str, _Words], name: str) -> None:
    """Refuse printers that cannot execute a stream; `name` is the file's."""
    if "M665" in found:
        # Printed by builds with DELTA, SCARA or POLAR alone (calibrate/M665.cpp, 2.1.x, 2024).
        raise ModelError(
            f"{name}: M665 says that the printer is a delta, or another one whose motors are not X "
            "and Y; only cartesian and corexy are compensated: print on it as sliced"
        )
    if "P" in found.get("M593 X", {}):
        # Snapmaker's for the J1 (SnapmakerController-IDEX, AxisManager.cpp, 2024-08): M593 F0 is an
        # error there, as in no other Marlin with this word.
        raise ModelError(
            f"{name}: M593 X P.. says that this is the Marlin of Snapmaker's J1, whose shaper F0 "
            "does not switch off: it would act on top of the compensation. Print on it as sliced"
        )


def _versions(found: dict[str, _Words], text: str) -> dict[str, Any]:
    """Return what an answer tells of the firmware's version."""
    section: dict[str, Any] = {}
    if _is_buddy(found, text):
        section["variant"] = "prusa"
        section["block_buffer_size"] = 32  # of all printers, since 5.0
    elif _MARLIN_2_0.search(text):
        section["variant"] = "2.0"
    if _MARLIN_1.search(text):
        section["board"] = "avr"
    if "M493" in found:
        # Version 1 reports Y's frequency as B, version 2 one line for each axis.
        section["ft_motion_version"] = 1 if "B" in found["M493"] else 2
    return section


def _is_buddy(found: dict[str, _Words], text: str) -> bool:
    """Return whether Prusa's Buddy firmware answered (configuration_store.cpp, 4.4 to 6.3)."""
    if "Prusa-Firmware-Buddy" in text or "M970" in found:
        return True  # M115; or phase stepping, which no other has, but not every Buddy either
    if "FIRMWARE_NAME:" in text or "M145" in found or _MARLIN_1.search(text):
        return False  # the rest is also said by Marlin before 2.0.5, with M145 if it has a display
    return "B" in found.get("M205", {}) and "J" not in found["M205"] and bool(_BUDDY.search(text))


def machine_from_m503(
    text: str,
    file: str,
    stated: StatedMachine,
    *,
    travel_mm: Sequence[tuple[float, float]],
    kinematics: str = "cartesian",
    fields: Sequence[str] = (),
) -> Machine:
    """Return a machine with the limits of M503 and unmeasured plants.

    Parameters
    ----------
    text, file : str
        What the printer answered, and the name of the file it stands in.
    stated : StatedMachine
        Without resonances those of the firmware's shaper (M593) are used, else 50 Hz.
    travel_mm : sequence of (float, float)
        Where X, Y and Z begin and end.
    fields : sequence of str
        ``FIELD=VALUE`` of the firmware section that M503 does not say.

    Raises
    ------
    ModelError
        If something is missing or invalid.
    """
    section = {**ASSUMED, **firmware_section(text, file)}
    shaper = section["shaper"] or {}
    tuned = (shaper.get("freq_x_hz", 0.0), shaper.get("freq_y_hz", 0.0))
    put_fields(section, fields)
    document = {
        "name": stated.name,
        "title": stated.title or stated.name,
        "source": f"M503 in {file}",
        "kinematics": kinematics,
        "travel": {
            axis: {"min_mm": begin, "max_mm": end}
            for axis, (begin, end) in zip("xyz", travel_mm, strict=True)
        },
        "firmware": section,
        "axes": {
            axis: stated_axis(given or of_shaper, stated.zeta)
            for axis, given, of_shaper in zip("xy", stated.f_hz, tuned, strict=True)
        },
    }
    try:
        machine = Machine.model_validate(document)
    except ValidationError as error:
        raise ModelError(f"{file}: {explain(error)}") from None
    return machine.model_copy(update={"command": derived_envelope(machine)})


def with_m503(machine: Machine, text: str, file: str) -> Machine:
    """Return a machine with the limits of a printed M503; those it lacks remain.

    So do exact values that M503 prints rounded (`rounded`).

    A machine of another firmware becomes one with Marlin, with what most builds have (`ASSUMED`)
    where M503 says nothing.

    Raises
    ------
    ModelError
        As of `machine_from_m503`.
    """
    said = firmware_section(text, file)
    before: dict[str, Any] = dict(ASSUMED)
    if machine.firmware.kind == "marlin":
        before = machine.firmware.model_dump(mode="json", exclude_unset=True)
        _unrounded(said, before)
    for part in ("planner", "shaper"):
        said[part] = {**(before.get(part) or {}), **(said[part] or {})} or None
    try:
        return with_firmware(machine, {**before, **said})
    except ValidationError as error:
        raise ModelError(f"{file}: {explain(error)}") from None


def rounded(section: dict[str, Any]) -> dict[str, float]:
    """Return what M503 has printed with too few decimals of a section, by the field's place."""
    found = {}
    for place in _ROUNDED:
        part, _, field = place.rpartition(".")
        value = (section.get(part) or {} if part else section).get(field)
        if value:
            found[place] = value
    return found


def _unrounded(said: dict[str, Any], before: dict[str, Any]) -> None:
    """Keep earlier values that M503 would print as it did."""
    exact = rounded(before)
    for place in _ROUNDED:
        part, _, field = place.rpartition(".")
        inner = said[part] if part else said
        if field in inner and abs(exact.get(place, math.inf) - inner[field]) <= _ROUNDING:
            inner[field] = exact[place]


def of_other_tools(text: str) -> list[str]:
    """Return settings of M503 in which another tool differs from the first, as it prints them."""
    first, found = _commands(text), []
    for command, words in _lines(text):
        tool = (words.pop("T", None) or 0) if command in _PER_TOOL else 0
        if tool > 0:
            found += [
                f"{command} T{tool:.0f} {letter}{value:g}"
                for letter, value in words.items()
                if value is not None and value != first.get(command, {}).get(letter)
            ]
    return found


def read_travel(text: str) -> list[tuple[float, float]]:
    """Parse where X, Y and Z begin and end, in mm: ``235x235x250``, or ``-4:220x-17:227x250``.

    Raises
    ------
    ModelError
        If it is not that.
    """
    ends = [part.split(":") for part in re.split(r"[x,]", text.strip().lower())]
    try:
        pairs = [(float("0" if len(part) == 1 else part[0]), float(part[-1])) for part in ends]
    except ValueError:
        pairs = []
    if len(pairs) != 3 or max(map(len, ends)) > 2:
        raise ModelError(
            f"--travel {text!r}: give where X, Y and Z end in mm, like 235x235x250, or where each "
            "begins and ends, like -4:220x-17:227x0:250"
        )
    return pairs


def _lines(text: str) -> Iterator[tuple[str, _Words]]:
    """Yield the commands of a reply in order, each with its words.

    Prusa's MK3 prints the limits of its stealth mode, too, behind those of the normal one.
    """
    before = ""
    for line in text.splitlines():
        heading, before = before, line
        if len(line) > _LONGEST_LINE or (match := _COMMAND.search(line)) is None:
            continue
        if ";" not in line[: match.start()] and "- stealth (" not in heading:
            found = _WORD.findall(match[2])
            yield match[1], {letter: float(value) if value else None for letter, value in found}


def _commands(text: str) -> dict[str, _Words]:
    """Return each command's words; M593 stands under ``M593 X``, ``M593 Y``, ..."""
    found: dict[str, _Words] = {}
    for command, words in _lines(text):
        if command in _PER_TOOL and (words.pop("T", None) or 0) > 0:
            continue
        names = [command]
        if command == "M593":
            # Without an axis it counts for all.
            names = [f"M593 {axis}" for axis in "XYZ" if axis in words] or ["M593 X", "M593 Y"]
        for name in names:
            found.setdefault(name, {}).update(words)
    return found


def _shaper(found: dict[str, _Words]) -> dict[str, float]:
    shaper = {}
    for axis in "xy":
        words = found.get(f"M593 {axis.upper()}", {})
        shaper[f"freq_{axis}_hz"] = words.get("F") or 0.0
        if (damping := words.get("D")) is not None:
            shaper[f"damping_{axis}"] = damping
    return shaper


def _arcs(found: dict[str, _Words]) -> dict[str, float]:
    """Return how finely Prusa's MK3 cuts arcs (M214 of 3.11 and later, motion_control.cpp)."""
    words = found.get("M214", {})
    fields = {"arc_resolution_mm": "P", "min_arc_segment_mm": "S", "min_circle_segments": "R"}
    return {field: value for field, letter in fields.items() if (value := words.get(letter))}


def _retraction(found: dict[str, _Words], word: Any) -> dict[str, float] | None:
    if "M207" not in found:
        return None
    speed_mm_s = word("M207", "F") / 60.0
    return {
        "retract_length_mm": word("M207", "S"),
        "retract_speed_mm_s": speed_mm_s,
        "unretract_extra_length_mm": word("M208", "S", 0.0),
        "unretract_speed_mm_s": word("M208", "F", 60.0 * speed_mm_s) / 60.0,
    }
