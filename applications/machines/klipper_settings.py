"""Bring a machine up to date with Klipper's printer.cfg; what was measured stays."""

from __future__ import annotations

from typing import Any

from pydantic import ValidationError

from stillpath.applications.machines.checks import (
    changed_to,
    check_config,
    not_followed,
    not_planned,
    put_fact,
    read_as_older,
)
from stillpath.applications.machines.klipper_config import PrinterConfig, facts
from stillpath.models.complaints import explain
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine

__all__ = ["config_notes", "with_config"]

_MACROS = "firmware.stopping_macros"


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
    check_config(config)
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
        put_fact(document, fact.place, value)
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
