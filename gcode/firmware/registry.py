"""The kit of a machine's firmware."""

from __future__ import annotations

from stillpath.gcode.firmware.base import FirmwareKit
from stillpath.models.errors import ModelError
from stillpath.models.firmware import Klipper, Marlin, RepRapFirmware
from stillpath.models.machine import Machine

__all__ = ["kit"]


def kit(machine: Machine) -> FirmwareKit:
    """Return what the machine's firmware offers.

    Raises
    ------
    ModelError
        The firmware can be described but there is no planner for it.
    """
    if isinstance(machine.firmware, Klipper):
        from stillpath.gcode.firmware.klipper.kit import KlipperKit

        return KlipperKit(machine, machine.firmware)
    if isinstance(machine.firmware, RepRapFirmware):
        from stillpath.gcode.firmware.reprapfirmware.kit import RepRapKit

        return RepRapKit(machine, machine.firmware)
    if isinstance(machine.firmware, Marlin):
        from stillpath.gcode.firmware.marlin.kit import MarlinKit

        return MarlinKit(machine, machine.firmware)
    raise ModelError(f"{machine.name}: there is no planner for {machine.firmware.kind}")
