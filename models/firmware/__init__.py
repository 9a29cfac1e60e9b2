"""The firmware of a machine and its settings, one schema per firmware."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Discriminator, Tag

from stillpath.models.firmware.common import FirmwareFacts, FirmwareRetraction, Hotend
from stillpath.models.firmware.klipper import Klipper
from stillpath.models.firmware.marlin import Marlin
from stillpath.models.firmware.reprapfirmware import RepRapFirmware

__all__ = [
    "FIRMWARE_KINDS",
    "Firmware",
    "FirmwareFacts",
    "FirmwareRetraction",
    "Hotend",
    "Klipper",
    "Marlin",
    "RepRapFirmware",
]


FIRMWARE_KINDS = ("klipper", "marlin", "reprapfirmware")


def _kind(section: Any) -> str:
    # A section without `kind` is Klipper's.
    if isinstance(section, dict):
        return str(section.get("kind", "klipper"))
    return str(getattr(section, "kind", "klipper"))


Firmware = Annotated[
    Annotated[Klipper, Tag("klipper")]
    | Annotated[Marlin, Tag("marlin")]
    | Annotated[RepRapFirmware, Tag("reprapfirmware")],
    Discriminator(
        _kind,
        custom_error_type="unknown_firmware",
        custom_error_message="kind must be klipper, marlin or reprapfirmware",
    ),
]
"""The firmware section of a machine document; `kind` says which."""
