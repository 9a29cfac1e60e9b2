"""The kit of a machine's firmware."""

from __future__ import annotations

from gcode.firmware.base import FirmwareKit
from models.errors import ModelError
from models.firmware import Klipper, Marlin, RepRapFirmware
from models.machine import Machine

__all__ = ["kit"]


def kit(machine: Machine) -> FirmwareKit:
    """Return what the machine's firmware offers.

    Raises
    ------
    ModelError
        The firmware can be described but there is no planner for it.
    """
    if isinstance(machine.firmware, Klipper):
        from gcode.firmware.klipper.kit import KlipperKit

        return KlipperKit(machine, machine.firmware)
    if isinstance(machine.firmware, RepRapFirmware):
        from gcode.firmware.reprapfirmware.kit import RepRapKit

        return RepRapKit(machine, machine.firmware)
    if isinstance(machine.firmware, Marlin):
        from gcode.firmware.marlin.kit import MarlinKit

        return MarlinKit(machine, machine.firmware)
    raise ModelError(f"{machine.name}: there is no planner for {machine.firmware.kind}")
