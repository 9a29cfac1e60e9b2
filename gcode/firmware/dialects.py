"""The dialect of a machine's firmware."""

from __future__ import annotations

import functools

from stillpath.gcode.dialect import Dialect
from stillpath.models.firmware import FirmwareFacts, Klipper, Marlin, RepRapFirmware

__all__ = ["dialect_of"]


@functools.lru_cache(maxsize=16)
def dialect_of(firmware: FirmwareFacts) -> Dialect:
    """Return how the firmware of a machine reads G-code.

    Its tables take longer to make than a short file to read, so the last ones are kept.
    """
    if isinstance(firmware, Klipper):
        from stillpath.gcode.firmware.klipper.dialect import klipper

        return klipper(firmware)
    if isinstance(firmware, Marlin):
        from stillpath.gcode.firmware.marlin.dialect import marlin

        return marlin(firmware)
    if isinstance(firmware, RepRapFirmware):
        from stillpath.gcode.firmware.reprapfirmware.dialect import reprapfirmware

        return reprapfirmware(firmware)
    raise TypeError(f"{type(firmware).__name__} has no dialect")
