"""Recognise files of this program whose comments were removed."""

from __future__ import annotations

import re

from stillpath.gcode.firmware.klipper import stream_commands as klipper
from stillpath.gcode.firmware.marlin import stream_commands as marlin
from stillpath.gcode.firmware.reprapfirmware import stream_commands as reprapfirmware

__all__ = ["signed_at"]

_SIGNATURES = (klipper.SIGNATURE, marlin.SIGNATURE, reprapfirmware.SIGNATURE)
_SIGNED = re.compile(rb"\n(?:%b)" % b"|".join(_SIGNATURES))


def signed_at(text: bytes) -> int | None:
    """Return the offset of limits that only this program writes, or None.

    All firmwares are checked: the file may have been written for another machine.
    """
    found = _SIGNED.search(text)
    return None if found is None else found.start() + 1
