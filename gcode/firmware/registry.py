"""The adapter of a machine's firmware."""

from __future__ import annotations

from stillpath.gcode.firmware.base import FirmwareAdapter
from stillpath.models.errors import ModelError
from stillpath.models.firmware import Klipper, Marlin, RepRapFirmware
from stillpath.models.machine import Machine

__all__ = ["adapter"]


def adapter(machine: Machine) -> FirmwareAdapter:
    """Return the adapter of the machine's firmware.

    Raises
    ------
    ModelError
        The firmware can be described but there is no planner for it.
    """
    if isinstance(machine.firmware, Klipper):
        from stillpath.gcode.firmware.klipper.adapter import KlipperAdapter

        return KlipperAdapter(machine, machine.firmware)
    if isinstance(machine.firmware, RepRapFirmware):
        from stillpath.gcode.firmware.reprapfirmware.adapter import RepRapAdapter

        return RepRapAdapter(machine, machine.firmware)
    if isinstance(machine.firmware, Marlin):
        from stillpath.gcode.firmware.marlin.adapter import MarlinAdapter

        return MarlinAdapter(machine, machine.firmware)
    raise ModelError(f"{machine.name}: there is no planner for {machine.firmware.kind}")
