"""RepRapFirmware's config.g as a machine, or a machine brought up to date with it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from stillpath.applications.machines.envelope import changed_to, derived_envelope
from stillpath.applications.machines.reprapfirmware_config import Setting, Settings
from stillpath.applications.machines.stated import StatedMachine, put_fields, stated_axis
from stillpath.models.complaints import explain
from stillpath.models.errors import ModelError
from stillpath.models.firmware import RepRapFirmware
from stillpath.models.machine import Machine

__all__ = ["ASSUMED", "config_g_notes", "machine_from_config_g", "with_config_g"]

ASSUMED = {
    "ring_length": "60 on Duet 3 6HC and 6XD",
    "step_clock_hz": "937500 on Duet 2",
    "prepare_least_s": "0 for 3.5 and older",
}
"""Fields that depend on board and version, and when they are not the default."""

_KINEMATICS = {0: "cartesian", 1: "corexy"}
_DRIVES = {"X": "x", "Y": "y", "Z": "z", "E": "extruder"}
_AXES = "XYZ"
_LEAST_JERK_MM_S = 0.1
_LEAST_RETRACTION_MM_S = 1.0
_MICROSTEPS = 16.0
"""Of every driver until M350 (src/Platform/Platform.cpp, 3.6)."""
_PER_MIN = 60.0
_DECIMALS = 6
_UNSTATED = {
    "M92": "steps per mm",
    "M201": "acceleration",
    "M203": "speed",
    "M566": "jerk",
}


def machine_from_config_g(
    settings: Settings, stated: StatedMachine, fields: Sequence[str] = ()
) -> Machine:
    """Return a machine with the limits of a config.g and unmeasured plants.

    Parameters
    ----------
    stated : StatedMachine
        Without resonances that of the firmware's shaper (M593) is used, else 50 Hz.
    fields : sequence of str
        ``FIELD=VALUE`` of the firmware section that config.g does not say.

    Raises
    ------
    ModelError
        If something is missing or invalid, or the printer is neither cartesian nor CoreXY.
    """
    section = _section(settings, RepRapFirmware().model_dump(mode="json"))
    put_fields(section, fields)
    shaper = section["shaper"]
    tuned_hz = 0.0 if shaper["type"] == "none" else shaper["freq_hz"]
    document = {
        "name": stated.name,
        "title": stated.title or stated.name,
        "source": settings.name,
        "kinematics": _kinematics(settings),
        "travel": _travel(settings),
        "firmware": section,
        "pressure_advance_s": _pressure_advance_s(settings) or 0.0,
        "axes": {
            axis: stated_axis(given or tuned_hz, stated.zeta)
            for axis, given in zip("xy", stated.f_hz, strict=True)
        },
    }
    try:
        machine = Machine.model_validate(document)
    except ValidationError as error:
        raise ModelError(f"{settings.name}: {explain(error)}") from None
    return machine.model_copy(update={"command": derived_envelope(machine)})


def with_config_g(machine: Machine, settings: Settings) -> Machine:
    """Return a machine with the limits and travel of a config.g; its plants remain.

    So does what the file does not say, as the board's ring. Limits of the motors are derived again
    if they were derived, and kept if they were stated. A machine of another firmware becomes one
    with RepRapFirmware.

    Raises
    ------
    ModelError
        As of `machine_from_config_g`, and if the kinematics are others.
    """
    kinematics = _kinematics(settings)
    if kinematics != machine.kinematics:
        raise ModelError(
            f"{settings.name}: {machine.name} was measured as {machine.kinematics}, and this is of "
            f"a {kinematics} printer; make a new machine (machines from-config) and measure it"
        )
    document: dict[str, Any] = machine.model_dump(mode="json")
    known = RepRapFirmware().model_dump(mode="json")
    if machine.firmware.kind == "reprapfirmware":
        own = document["firmware"]
        known |= {name: own[name] for name in own if name not in (*_DRIVES.values(), "shaper")}
        for name in ("nozzle_diameter_mm", "filament_diameter_mm"):
            known["extruder"][name] = own["extruder"][name]
    document["firmware"] = _section(settings, known)
    document["travel"] = _travel(settings)
    advance_s = _pressure_advance_s(settings)
    if advance_s is not None:
        document["pressure_advance_s"] = advance_s
    try:
        return changed_to(machine, document)
    except ValidationError as error:
        raise ModelError(f"{settings.name}: {explain(error)}") from None


def config_g_notes(
    settings: Settings, fields: Sequence[str] = (), *, kept: bool = False
) -> list[str]:
    """Return what a machine of this config.g does not know, or takes for granted.

    Parameters
    ----------
    fields : sequence of str
        As of `machine_from_config_g`.
    kept : bool
        What config.g does not say was known, and is kept.
    """
    said = {field.partition("=")[0].strip() for field in fields}
    default = RepRapFirmware()
    if any("P" in line.words for line in settings.of("M595")):
        said.add("ring_length")
    assumed = [
        f"{name}={getattr(default, name):g} ({otherwise})"
        for name, otherwise in ASSUMED.items()
        if name not in said
    ]
    notes = []
    if assumed and not kept:
        notes.append(
            f"assumed, for config.g does not say it: {', '.join(assumed)}; --set says otherwise"
        )
    notes += [f"{called}: not read, so what it sets is unknown" for called in settings.unread]
    for line in settings.of("M92", "M201", "M203", "M566"):
        if len(set(line.numbers("E"))) > 1:
            notes.append(
                f"{line.place}: {line.name} E{line.words['E']}: extruders differ; the machine has "
                + ("the first one's" if line.name == "M92" else "the least of it")
            )
    for line in settings.of("M207"):
        if (line.number("Z") or 0.0) > 0.0:
            notes.append(
                f"{line.place}: M207 Z{line.words['Z']}: the machine does not know that G10 lifts; "
                "where the slicer retracts by G10, put this line into its start G-code"
            )
    for line in settings.of("M563"):
        if moved := {"X", "Y"} & line.words.keys():
            notes.append(
                f"{line.place}: this tool moves another axis as its {' and '.join(sorted(moved))}; "
                "leave what it prints as sliced (;STILLPATH_OFF)"
            )
    return [f"note: {note}" for note in notes]


def _section(settings: Settings, known: dict[str, Any]) -> dict[str, Any]:
    """Return the firmware section `known` with what a config.g sets."""
    section = known | {"kind": "reprapfirmware"}
    _set_steps(settings, section)
    _set_limits(settings, section)
    for line in settings.of("M204"):
        for letters, name in (("SP", "print_accel_mm_s2"), ("ST", "travel_accel_mm_s2")):
            for letter in letters:
                if (value := line.number(letter)) is not None:
                    section[name] = value
    for line in settings.of("M404"):
        if width := line.number("N"):
            section["extruder"]["filament_diameter_mm"] = width
    for line in settings.of("M595"):
        # The ring only grows.
        section["ring_length"] = max(section["ring_length"], int(line.number("P") or 0))
    _set_shaper(settings, section)
    _set_retraction(settings, section)
    return section


def _set_steps(settings: Settings, section: dict[str, Any]) -> None:
    """Set steps per mm. M350 scales those of M92 before it, and S is the microstepping of M92's."""
    microsteps = dict.fromkeys(_DRIVES, _MICROSTEPS)
    _check_stated(settings, "M92", "XYZE")
    for line in settings.of("M92", "M350"):
        for letter, drive in _DRIVES.items():
            value = line.number(letter)
            if value is None or value <= 0.0:
                continue
            if line.name == "M350":
                section[drive]["steps_per_mm"] *= value / microsteps[letter]
                microsteps[letter] = value
            else:
                of = line.number("S") or microsteps[letter]
                section[drive]["steps_per_mm"] = value * microsteps[letter] / of


def _set_limits(settings: Settings, section: dict[str, Any]) -> None:
    for name, also, field in (
        ("M201", "M201", "max_accel_mm_s2"),
        ("M203", "M203", "max_speed_mm_s"),
        ("M566", "M205", "jerk_mm_s"),
    ):
        _check_stated(settings, name, "XYZE")
        for line in settings.of(name, also):
            for letter, drive in _DRIVES.items():
                if found := line.numbers(letter):
                    section[drive][field] = round(min(found) / _unit(line), _DECIMALS)
    for drive in _DRIVES.values():
        section[drive]["jerk_mm_s"] = max(section[drive]["jerk_mm_s"], _LEAST_JERK_MM_S)
    for line in settings.of("M203"):
        if (least := line.number("I")) is not None:
            section["min_speed_mm_s"] = round(least / _unit(line), _DECIMALS)
    for line in settings.of("M566"):
        if (policy := line.number("P")) is not None:
            section["jerk_policy"] = int(policy)


def _unit(line: Setting) -> float:
    """Return how much of a command's unit makes 1 mm/s or mm/s2."""
    per_s = line.name in ("M201", "M205") or line.number("S") == 1.0
    return 1.0 if per_s else _PER_MIN


def _check_stated(settings: Settings, name: str, letters: str) -> None:
    """Refuse to take the firmware's defaults for what a file may set that was not read."""
    if not settings.unread:
        return
    lacking = [
        letter for letter in letters if not any(letter in line.words for line in settings.of(name))
    ]
    if lacking:
        raise ModelError(
            f"{settings.name}: no {name} {' '.join(lacking)} in it ({_UNSTATED.get(name, 'limits')}"
            f"); it may be in {', '.join(settings.unread)}, which was not found beside it: put "
            "these files into the same folder, or their lines into a copy"
        )


def _set_shaper(settings: Settings, section: dict[str, Any]) -> None:
    """Set the firmware's shaper. With F alone it is ZVD, since 3.4."""
    shaper = dict(section["shaper"])
    for line in settings.of("M593"):
        frequency_hz, damping = line.number("F"), line.number("S")
        if "P" in line.words:
            kind = line.words["P"].lower().replace("-", "").replace("_", "")
            if kind in ("custom", "daa"):
                raise ModelError(
                    f'{line.place}: M593 P"{kind}" cannot be restored behind a stream; use mzv, '
                    "zvd, zvdd, zvddd, ei2 or ei3 (3.4 and later), or none"
                )
            shaper["type"] = kind
        elif frequency_hz == 0.0:  # how it was switched off before 3.4
            shaper["type"] = "none"
        elif shaper["type"] == "none" and frequency_hz is not None:
            shaper["type"] = "zvd"
        if frequency_hz:
            shaper["freq_hz"] = frequency_hz
        if damping is not None:
            shaper["damping"] = damping
    section["shaper"] = shaper


def _set_retraction(settings: Settings, section: dict[str, Any]) -> None:
    found = dict(section.get("retraction") or {})
    for line in settings.of("M207"):
        length, extra = line.number("S"), line.number("R")
        speed, back = line.number("F"), line.number("T")
        if length is not None:
            found["retract_length_mm"] = max(length, 0.0)
        if extra is not None:
            found["unretract_extra_length_mm"] = extra
        if speed is not None:
            found["retract_speed_mm_s"] = _retracting_mm_s(speed)
            found["unretract_speed_mm_s"] = found["retract_speed_mm_s"]
        if back is not None:
            found["unretract_speed_mm_s"] = _retracting_mm_s(back)
    if found:
        section["retraction"] = found


def _retracting_mm_s(speed_mm_min: float) -> float:
    return max(round(speed_mm_min / _PER_MIN, _DECIMALS), _LEAST_RETRACTION_MM_S)


def _kinematics(settings: Settings) -> str:
    """Return the kinematics; M667 is that of RepRapFirmware 2, M665 a delta's."""
    number = 0
    for line in settings.of("M665", "M667", "M669"):
        if line.name == "M665":
            number = 3
        elif line.name == "M667":
            number = int(line.number("S") or 0)
        elif (kind := line.number("K")) is not None:
            number = int(kind)
        _check_plain(line)
    if number not in _KINEMATICS:
        raise ModelError(
            f"{settings.name}: its kinematics (M669 K{number}) are neither cartesian nor CoreXY, "
            "which alone are compensated: print on this machine as sliced"
        )
    return _KINEMATICS[number]


def _check_plain(line: Setting) -> None:
    if line.name == "M669" and {*_AXES} & line.words.keys():
        raise ModelError(
            f"{line.place}: M669 with a matrix of its own: which motors move X and Y then is not "
            "known here; print on this machine as sliced"
        )
    if line.name == "M669" and (line.number("S") or 0.0) > 0.0 and (line.number("T") or 0.0) > 0.0:
        raise ModelError(
            f"{line.place}: M669 S and T cut moves into segments, and a stream's short moves would "
            "be late; leave S and T out"
        )


def _travel(settings: Settings) -> dict[str, dict[str, float]]:
    _check_stated(settings, "M208", _AXES)
    travel = {axis.lower(): {"min_mm": 0.0, "max_mm": 200.0} for axis in _AXES}
    for line in settings.of("M208"):
        begins = line.number("S") == 1.0
        for axis in _AXES:
            match line.numbers(axis):
                case [begin, end, *_]:
                    travel[axis.lower()] = {"min_mm": begin, "max_mm": end}
                case [place]:
                    travel[axis.lower()]["min_mm" if begins else "max_mm"] = place
    return travel


def _pressure_advance_s(settings: Settings) -> float | None:
    """Return that of the first extruder; None if it is not set."""
    advance_s = None
    for line in settings.of("M572"):
        # Without D it is that of all extruders of the tool in use.
        if 0.0 in (line.numbers("D") or [0.0]) and (value := line.number("S")) is not None:
            advance_s = value
    return advance_s
