"""Checks before a job: the age of the measurement, and whether the printer was changed."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from pydantic import BaseModel, ConfigDict

from stillpath.applications.machines.klipper_config import PrinterConfig
from stillpath.applications.machines.klipper_facts import facts
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine

__all__ = ["Difference", "age_warnings", "check_before_job", "differences"]

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


def _at(document: Any, place: str) -> Any:
    for part in place.split("."):
        if document is None:
            return None
        document = document[part]
    return document


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
