"""Klipper's printer.cfg as a machine, or a machine brought up to date with it."""

from __future__ import annotations

from typing import Any

from pydantic import ValidationError

from stillpath.applications.machines.envelope import changed_to, derived_envelope
from stillpath.applications.machines.klipper_config import PrinterConfig
from stillpath.applications.machines.klipper_facts import facts
from stillpath.applications.machines.stated import StatedMachine, stated_axis
from stillpath.models.complaints import explain
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine

__all__ = [
    "config_notes",
    "machine_from_config",
    "not_followed",
    "not_planned",
    "read_as_older",
    "with_config",
]

_MACROS = "firmware.stopping_macros"


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
    _check(config)
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
        _put(document, fact.place, fact.value)
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


def with_config(machine: Machine, config: PrinterConfig) -> Machine:
    """Return a machine with the limits and travel of a printer.cfg; its plants remain.

    So does what the configuration does not say, and macros that the user has named. Limits of the
    motors are derived again if they were derived, and kept if they were stated. A machine of
    another firmware becomes one with Klipper.

    Raises
    ------
    ModelError
        If the configuration lacks something, is of other kinematics, or makes no valid machine.
    """
    _check(config)
    document: dict[str, Any] = machine.model_dump(mode="json")
    if machine.firmware.kind != "klipper":
        document["firmware"] = {"kind": "klipper"}
    for fact in facts(config):
        value = fact.value
        if fact.place == "kinematics" and value != machine.kinematics:
            raise ModelError(
                f"{config.name}: [printer] kinematics {value}: {machine.name} was measured as "
                f"{machine.kinematics}; make a new machine (machines from-config) and measure it"
            )
        if fact.place == _MACROS:
            named = document["firmware"].get("stopping_macros", [])
            value = [*named, *(macro for macro in value if macro not in named)]
        _put(document, fact.place, value)
    whole = not config.includes
    document["firmware"]["macros_known"] = whole
    document["firmware"]["no_input_shaper"] = whole and "input_shaper" not in config.sections
    try:
        return changed_to(machine, document)
    except ValidationError as error:
        raise ModelError(f"{config.name}: {explain(error)}") from None


def config_notes(config: PrinterConfig) -> list[str]:
    """Return what a machine of this configuration does not know, or takes for granted."""
    notes = [*not_followed(config), *read_as_older(config), *not_planned(config)]
    return [f"note: {note}" for note in notes]


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


def _check(config: PrinterConfig) -> None:
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


def _put(document: dict[str, Any], place: str, value: Any) -> None:
    """Put a value at its place in a machine document; parts that lack are made."""
    *parts, last = place.split(".")
    for part in parts:
        if document.get(part) is None:
            document[part] = {}
        document = document[part]
    document[last] = value
