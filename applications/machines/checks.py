"""Checks before a job: the age of the measurement, and whether the printer was changed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from stillpath.applications.machines.klipper_config import PrinterConfig, facts
from stillpath.models.complaints import explain
from stillpath.models.errors import ModelError
from stillpath.models.firmware import Klipper
from stillpath.models.firmware.common import AxisAllowance
from stillpath.models.machine import AxisLimits, CommandLimits, Machine, MotorLimits
from stillpath.models.typed_in import typed_in

__all__ = [
    "Difference",
    "StatedMachine",
    "age_warnings",
    "changed_to",
    "check_before_job",
    "check_config",
    "derived_envelope",
    "differences",
    "envelope_warnings",
    "machine_from_config",
    "not_followed",
    "not_planned",
    "put_fact",
    "read_as_older",
    "stated_axis",
    "with_firmware",
]

_DEFAULT_HZ = 50.0
_DEFAULT_ZETA = 0.07
_RESONANCES_HZ, _DAMPING = (1.0, 500.0), (1e-3, 1.0)
_ACCEL_ROOM, _SPEED_ROOM, _CORNERS = 1.5, 1.2, 6.0
"""Limits assumed for motors where none are stated: these multiples of the acceleration, speed and
corner speed that the printer allows a file."""
_QUEUE_ROOM, _QUEUE_MM_S2 = 3.0, 6000.0
"""Multiple of the acceleration on Marlin and RepRapFirmware, and up to where: with few short moves
in their queues they do not reach a print's speed on 1.5 times a low limit, and every piece would
stay as sliced."""
_LEAST_STEP_MM_S = 20.0
_ROUNDING = 1.001
"""Ratio up to which two limits count as equal."""
_RELATIVE = 1e-6


class Difference(BaseModel):
    """The printer's configuration says one thing, the machine document another."""

    model_config = ConfigDict(frozen=True)

    section: str
    option: str
    place: str
    machine: Any
    printer: Any

    @property
    def text(self) -> str:
        """One line: section, option, both values, remedy."""
        where = f"[{self.section}] {self.option}".rstrip()
        return (
            f"{where}: the printer has {_word(self.printer)}, the machine {_word(self.machine)}; "
            f"put {_word(self.printer)} at {self.place} of the machine, or set the printer back"
        )


def check_before_job(
    machine: Machine,
    now: datetime,
    *,
    max_age_days: float,
    config: PrinterConfig | None = None,
) -> list[str]:
    """Return reasons against using a machine now, one line each; empty if there are none.

    Parameters
    ----------
    max_age_days : float
        Largest age of a measurement.
    config : PrinterConfig, optional
        The printer's configuration as it is now.
    """
    found = [] if config is None else differences(machine, config)
    return [*age_warnings(machine, now, max_age_days), *(entry.text for entry in found)]


def age_warnings(machine: Machine, now: datetime, max_age_days: float) -> list[str]:
    """Return a line for each axis whose plants are old, undated or were never measured.

    Axes without provenance (the built-in machines) are not checked.
    """
    found = []
    for axis in ("x", "y"):
        known = machine.axes[axis].provenance
        start = f"axis {axis} of {machine.name}"
        if known is None:
            continue
        if known.kind == "typed in":
            found.append(f"{start}: its plants were typed in, not measured; measure the machine")
        elif known.measured_on is None:
            found.append(f"{start}: its measurement has no date; measure it again")
        elif (age := (now.date() - known.measured_on).days) > max_age_days:
            found.append(
                f"{start}: measured on {known.measured_on}, {age} days ago, more than "
                f"{max_age_days:g}; measure it again"
            )
    return found


def differences(machine: Machine, config: PrinterConfig) -> list[Difference]:
    """Return where a configuration and a machine disagree.

    Raises
    ------
    ModelError
        If the configuration lacks what Klipper requires or has text in place of numbers, or if the
        machine is not a Klipper machine.
    """
    if machine.firmware.kind != "klipper":
        raise ModelError(
            f"{machine.name} runs {machine.firmware.kind}; a printer.cfg is Klipper's and says "
            "nothing of it"
        )
    document = machine.model_dump(mode="json")
    extruder = document["firmware"]["extruder"]
    if extruder["max_extrude_cross_section_mm2"] is None:
        extruder["max_extrude_cross_section_mm2"] = 4.0 * extruder["nozzle_diameter_mm"] ** 2
    found = []
    for fact in facts(config):
        stands = _at(document, fact.place)
        if not _same(fact.place, stands, fact.value):
            found.append(
                Difference(
                    section=fact.section,
                    option=fact.option,
                    place=fact.place,
                    machine=stands,
                    printer=fact.value,
                )
            )
    return found


@dataclass(frozen=True, slots=True)
class StatedMachine:
    """What is known of a machine before it is measured.

    Attributes
    ----------
    title : str
        Empty: the name.
    f_hz : (float, float)
        Resonances of X and Y; None: unknown.
    zeta : float
        Damping ratio of both.
    """

    name: str
    title: str = ""
    f_hz: tuple[float | None, float | None] = (None, None)
    zeta: float = _DEFAULT_ZETA


def machine_from_config(config: PrinterConfig, stated: StatedMachine) -> Machine:
    """Return a machine with the facts of a printer.cfg and plants that were not measured.

    Each plant is one resonance with a wide set around it, marked as typed in, to be replaced by a
    measurement.

    Parameters
    ----------
    stated : StatedMachine
        Without resonances the input shaper's frequencies are used, else 50 Hz.

    Raises
    ------
    ModelError
        If the configuration lacks something, or is of an unknown kind of machine.
    """
    check_config(config)
    found = facts(config)
    shaper_hz = {fact.place: fact.value for fact in found}
    document: dict[str, Any] = {
        "name": stated.name,
        "title": stated.title or stated.name,
        "source": config.name,
        "axes": {
            axis: stated_axis(
                given or shaper_hz.get(f"firmware.shaper.freq_{axis}_hz", 0.0), stated.zeta
            )
            for axis, given in zip("xy", stated.f_hz, strict=True)
        },
    }
    for fact in found:
        put_fact(document, fact.place, fact.value)
    # No facts, so that machines from before these were noted do not differ from their printers.
    whole = not config.includes
    document.setdefault("firmware", {})["macros_known"] = whole
    document["firmware"]["no_input_shaper"] = whole and "input_shaper" not in config.sections
    try:
        machine = Machine.model_validate(document)
    except ValidationError as error:
        hint = "".join(f"; {line}" for line in not_followed(config))
        raise ModelError(f"{config.name}: {explain(error)}{hint}") from None
    return machine.model_copy(update={"command": derived_envelope(machine)})


def check_config(config: PrinterConfig) -> None:
    """Raise ModelError if a configuration is of a machine that cannot be compensated."""
    _check_kinematics(config)
    _check_shaper(config)


def _check_kinematics(config: PrinterConfig) -> None:
    """Refuse unknown kinematics, and a fork's with fixed limits by axis (Kalico, 2026)."""
    kinematics = config.text("printer", "kinematics") or ""
    if not kinematics and config.includes:
        raise config.lacks("printer", "kinematics")
    plain = kinematics.removeprefix("limited_")
    if plain and plain not in ("cartesian", "corexy"):
        raise ModelError(
            f"{config.name}: [printer] kinematics {kinematics}: only cartesian and corexy are "
            "compensated; print on such a machine as sliced"
        )
    if plain == kinematics:
        return
    names = ("max_accel", "max_x_accel", "max_y_accel")
    stated = [config.number("printer", name) for name in names if config.text("printer", name)]
    least = f"max_accel: {min(stated):g}" if stated else "the lower of both axes at max_accel"
    raise ModelError(
        f"{config.name}: [printer] kinematics {kinematics} holds X and Y to max_x_accel and "
        "max_y_accel whatever a file sets, so a stream would come late. Put kinematics: "
        f"{plain} and {least} there, without max_x_accel and max_y_accel, or use simulate and "
        "advise with a copy that says so"
    )


def _check_shaper(config: PrinterConfig) -> None:
    """Refuse a firmware that keeps its shaper elsewhere, and changes that with every file.

    Snapmaker's for the U1: its SET_INPUT_SHAPER writes into input_shaper.json, where its own
    measurement is (klippy/extras/input_shaper.py, 2026-04).
    """
    keeps = "shaper_freq_x_min"
    if config.text("input_shaper", keeps) is not None:
        raise ModelError(
            f"{config.name}: [input_shaper] {keeps}: this is Snapmaker's Klipper, which keeps the "
            "shaper that it measured in input_shaper.json, and a file that switches the shaper off "
            "and on again would write the frequencies of printer.cfg over it. Put types, "
            "frequencies and damping of input_shaper.json into [input_shaper] of printer.cfg, and "
            "give a copy of it without shaper_freq_x_min, _x_max, _y_min and _y_max"
        )


def not_followed(config: PrinterConfig) -> list[str]:
    """Return a warning for each included file that was not found."""
    return [
        f"[include {name}] in {config.name}: not read, for it is not beside it; what it says, "
        "macros too, is unknown"
        for name in config.includes
    ]


def not_planned(config: PrinterConfig) -> list[str]:
    """Return a note if G10 lifts the head, as only Kalico's does.

    Source: klippy/extras/firmware_retraction.py of Kalico, 2026-07. Coordinates do not see it.
    """
    section, option = "firmware_retraction", "z_hop_height"
    height_mm = config.number(section, option, 0.0)
    if height_mm <= 0.0:
        return []
    note = (
        f"[{section}] {option} {height_mm:g}: Kalico lifts the head at each G10 and lowers it at "
        "G11. These moves are not planned, so prints take longer than reports say, by the time of "
        "two moves of Z for each retraction; put 0 there and let the slicer lift"
    )
    return [note]


def read_as_older(config: PrinterConfig) -> list[str]:
    """Return a note where Klippers of two ages understand an option in two ways.

    Until 2024-03 max_accel_to_decel was a limit of its own, whatever ACCEL a file sets, then its
    ratio to max_accel; since 2025-08 it is refused (klippy/toolhead.py).
    """
    section, option = "printer", "max_accel_to_decel"
    if config.text(section, option) is None or config.text(section, "minimum_cruise_ratio"):
        return []
    limit = config.number(section, option)
    note = (
        f"[printer] max_accel_to_decel {limit:g}: read as Klipper before 2024-03 does, as most "
        f"vendors' is, which keeps {limit:g} whatever ACCEL a file sets. If yours is from 2024-03 "
        "to 2025-08, write minimum_cruise_ratio into printer.cfg instead, or short moves will be "
        "faster than as sliced"
    )
    return [note]


def stated_axis(f_hz: float, zeta: float) -> dict[str, Any]:
    """Return an unmeasured axis of one resonance; without a frequency (0), of 50 Hz.

    Raises
    ------
    ModelError
        For a resonance or a damping ratio that no axis has.
    """
    for what, value, (least, most), unit in (
        ("resonance", f_hz or _DEFAULT_HZ, _RESONANCES_HZ, " Hz"),
        ("damping ratio", zeta, _DAMPING, ""),
    ):
        if not least <= value <= most:
            raise ModelError(
                f"a {what} of {value:g}{unit} was stated; it must be {least:g} to {most:g}{unit}: "
                "give the one of the axis (--fx, --fy, --zeta, or the configuration's shaper)"
            )
    return typed_in(f_hz or _DEFAULT_HZ, zeta).model_dump(mode="json", exclude_none=True)


def derived_envelope(machine: Machine) -> CommandLimits:
    """Return the limits assumed for the motors, from those that the printer sets for a file.

    They are slightly higher, since a command has to lead the nozzle; the machine's `command` can
    state better values. `axes` are set if the printer has separate limits for X and Y; the motors
    of a CoreXY are assumed to follow what a file's diagonals need.
    """
    x, y = (_borne(machine, machine.firmware.allowance(axis)) for axis in ("x", "y"))
    least = {name: min(value, y[name]) for name, value in x.items()}
    if machine.kinematics == "corexy":
        # An integer, not below what a diagonal at the head's own limit needs.
        accel = math.ceil(_accel_borne(machine, machine.firmware.motor_accel_mm_s2()))
        return CommandLimits(**least, motors=MotorLimits(accel_mm_s2=accel))
    if machine.firmware.kind == "klipper":
        return CommandLimits(**least)
    more = {
        axis: AxisLimits(**{name: value for name, value in borne.items() if value > least[name]})
        for axis, borne in (("x", x), ("y", y))
        if borne != least
    }
    return CommandLimits(**least, axes=more)


def _borne(machine: Machine, allowed: AxisAllowance) -> dict[str, float]:
    # A command that cannot travel as the printer does comes late behind each travel.
    accel = max(allowed.accel_mm_s2, allowed.travel_accel_mm_s2)
    step = _CORNERS * allowed.corner_mm_s
    room = 1.0 if _capped(machine) else _SPEED_ROOM
    return {
        "velocity_mm_s": room * allowed.speed_mm_s,
        "accel_mm_s2": _accel_borne(machine, accel),
        "speed_step_mm_s": min(max(step, _LEAST_STEP_MM_S), CommandLimits().speed_step_mm_s),
    }


def _accel_borne(machine: Machine, allowed_mm_s2: float) -> float:
    usual = allowed_mm_s2 if _capped(machine) else _ACCEL_ROOM * allowed_mm_s2
    if machine.firmware.kind == "klipper":
        return usual
    return max(usual, min(_QUEUE_ROOM * allowed_mm_s2, _QUEUE_MM_S2))


def _capped(machine: Machine) -> bool:
    return isinstance(machine.firmware, Klipper) and machine.firmware.limits_capped


def with_firmware(machine: Machine, section: dict[str, Any]) -> Machine:
    """Return a machine with another firmware section.

    Limits of the motors are derived again if they were derived, and kept if they were stated.

    Raises
    ------
    ValidationError
        If the section, or the machine with it, is invalid.
    """
    return changed_to(machine, {**machine.model_dump(mode="json"), "firmware": section})


def changed_to(machine: Machine, document: dict[str, Any]) -> Machine:
    """Return a machine as its changed document has it; limits of the motors as `with_firmware`.

    Raises
    ------
    ValidationError
        If the document is invalid.
    """
    derived = machine.command == derived_envelope(machine)
    if derived:
        del document["command"]
    changed = Machine.model_validate(document)
    return changed.model_copy(update={"command": derived_envelope(changed)}) if derived else changed


def envelope_warnings(machine: Machine) -> list[str]:
    """Return a warning if a command may exceed what the printer's own limits suggest.

    Until 2026-11 machines were made with 20 000 mm/s2 whatever the printer's limit was.
    """
    derived, stated = derived_envelope(machine), machine.command
    found: dict[str, tuple[float, float]] = {}
    for axis in ("x", "y"):
        most, asked = derived.of(axis).accel_mm_s2, stated.of(axis).accel_mm_s2
        if asked > _ROUNDING * most:
            by_axis = axis in stated.axes and stated.axes[axis].accel_mm_s2 is not None
            place = f"axes.{axis}.accel_mm_s2" if by_axis else "accel_mm_s2"
            found[place] = (asked, min(most, found.get(place, (asked, most))[1]))
    motors = [limits.motors and limits.motors.accel_mm_s2 for limits in (stated, derived)]
    if motors[0] and motors[1] and motors[0] > _ROUNDING * motors[1]:
        found["motors.accel_mm_s2"] = (motors[0], motors[1])
    return [
        f"{machine.name}: a command may ask the motors for {asked:.0f} mm/s2 (command.{place}), "
        f"more than the {most:.0f} that the printer's own limits for a file suggest: right if the "
        f"motors were tested at that acceleration; otherwise put {most:.0f} there"
        for place, (asked, most) in found.items()
    ]


def _at(document: Any, place: str) -> Any:
    for part in place.split("."):
        if document is None:
            return None
        document = document[part]
    return document


def put_fact(document: dict[str, Any], place: str, value: Any) -> None:
    """Put a value at its place in a machine document; parts that lack are made."""
    *parts, last = place.split(".")
    for part in parts:
        if document.get(part) is None:
            document[part] = {}
        document = document[part]
    document[last] = value


def _same(place: str, stands: Any, value: Any) -> bool:
    if place == "firmware.stopping_macros":  # users add their own
        return set(value) <= {name.upper() for name in stands}
    if isinstance(stands, float) and isinstance(value, float):
        return abs(stands - value) <= _RELATIVE * max(abs(stands), abs(value))
    return bool(stands == value)


def _word(value: Any) -> str:
    match value:
        case None:
            return "none"
        case bool():
            return "on" if value else "off"
        case float():
            return f"{value:g}"
        case list() | tuple():
            return ", ".join(map(str, value)) or "none"
        case dict():
            return ", ".join(f"{key} {_word(entry)}" for key, entry in value.items())
        case _:
            return str(value)
