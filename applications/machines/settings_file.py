"""A machine from the file in which a printer says what it is, of whichever firmware."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pydantic import ValidationError

from stillpath.applications.machines.envelope import with_firmware
from stillpath.applications.machines.klipper_config import (
    looks_like_printer_config,
    read_printer_config,
)
from stillpath.applications.machines.klipper_settings import (
    config_notes,
    machine_from_config,
    with_config,
)
from stillpath.applications.machines.marlin_settings import looks_like_m503, with_m503
from stillpath.applications.machines.reprapfirmware_config import looks_like_config_g, read_config_g
from stillpath.applications.machines.reprapfirmware_settings import (
    config_g_notes,
    machine_from_config_g,
    with_config_g,
)
from stillpath.applications.machines.revision import source_file
from stillpath.applications.machines.stated import StatedMachine
from stillpath.models.complaints import explain
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.models.provenance import SourceFile
from stillpath.models.user_files import as_json, as_utf8, read_bytes

__all__ = ["machine_from_file", "with_firmware_file"]

_LARGEST_BYTES = 64_000_000
_Made = tuple[Machine, list[SourceFile], list[str]]
"""A machine, the files that were read, and notes."""


def machine_from_file(file: Path, stated: StatedMachine, fields: Sequence[str] = ()) -> _Made:
    """Return a machine with the limits of a printer.cfg or a config.g and unmeasured plants.

    Parameters
    ----------
    fields : sequence of str
        ``FIELD=VALUE`` of the firmware section that config.g does not say.

    Raises
    ------
    ModelError
        If something is missing or invalid.
    """
    text = _text_of(file)
    if looks_like_config_g(text):
        settings = read_config_g(file)
        machine = machine_from_config_g(settings, stated, fields)
        return machine, _sources(file, settings.called), config_g_notes(settings, fields)
    if looks_like_m503(text):
        raise ModelError(
            f"{file}: this is Marlin's answer to M503, which does not say how far the axes reach: "
            "machines from-m503 takes it, with --travel"
        )
    if fields:
        raise ModelError(f"--set {fields[0]!r}: a printer.cfg says all; change it there")
    config = read_printer_config(file)
    machine = machine_from_config(config, stated)
    return machine, _sources(file, config.included), config_notes(config)


def with_firmware_file(machine: Machine, file: Path) -> _Made:
    """Return the machine with the firmware that a file tells, the files that were read, and notes.

    Parameters
    ----------
    file : Path
        A section as JSON, or what Marlin answers to M503, Klipper's printer.cfg or
        RepRapFirmware's config.g: of these, what they do not say stays.

    Raises
    ------
    ModelError
        Naming the first field of the section that is wrong.
    """
    text = _text_of(file)
    if looks_like_config_g(text):
        settings = read_config_g(file)
        made = with_config_g(machine, settings)
        kept = machine.firmware.kind == "reprapfirmware"
        return made, _sources(file, settings.called), config_g_notes(settings, kept=kept)
    if looks_like_m503(text):
        return with_m503(machine, text, file.name), _sources(file), []
    if looks_like_printer_config(text):
        config = read_printer_config(file)
        return with_config(machine, config), _sources(file, config.included), config_notes(config)
    try:
        section = as_json(text.encode(), str(file))
    except ModelError as error:
        raise ModelError(
            f"{error}; a firmware section as JSON is needed, an answer to M503 with its M92, "
            "Klipper's printer.cfg with its sections, or RepRapFirmware's config.g"
        ) from None
    if not isinstance(section, dict) or "kind" not in section:
        raise ModelError(f"{file}: a firmware section is an object that says its kind")
    try:
        changed = with_firmware(machine, section)
    except ValidationError as error:
        raise ModelError(f"{file}: {explain(error)}") from None
    return changed, _sources(file), []


def _text_of(file: Path) -> str:
    content = read_bytes(file, _LARGEST_BYTES, "no settings of a printer")
    return as_utf8(content).decode(errors="replace")


def _sources(file: Path, others: Sequence[Path] = ()) -> list[SourceFile]:
    return [source_file(each.name, each.read_bytes()) for each in (file, *others)]
