"""Choose the dialect in which a job's file is read, and warn if it looks like another."""

from __future__ import annotations

import io
from typing import BinaryIO

from stillpath.gcode.detection import detect
from stillpath.gcode.dialect import Dialect
from stillpath.gcode.firmware.dialects import dialect_of
from stillpath.gcode.interpreter import Interpreter
from stillpath.models.errors import ModelError
from stillpath.models.firmware import Marlin
from stillpath.models.machine import Machine
from stillpath.pipeline.options import DialectName

__all__ = ["dialect_for", "doubts", "passed_over"]

_SHOWN = 5
_END_BYTES = 1 << 18
_OFFSHOOTS = ("prusa", "bambu")
"""Dialects that may be requested for a Marlin machine."""
_EXPECTED = ("klipper", "marlin")


def dialect_for(machine: Machine, name: DialectName | None = None) -> Dialect:
    """Return the dialect in which a file for a machine is read.

    Parameters
    ----------
    name : str, optional
        A dialect that the machine's firmware reads; None: its own.

    Raises
    ------
    ModelError
        The firmware does not read this dialect.
    """
    firmware = machine.firmware
    if isinstance(firmware, Marlin) and name in _OFFSHOOTS:
        return dialect_of(firmware.model_copy(update={"variant": name}))
    if isinstance(firmware, Marlin) and name == "marlin" and firmware.variant in _OFFSHOOTS:
        return dialect_of(firmware.model_copy(update={"variant": "2.1"}))
    own = dialect_of(firmware)
    if name not in (None, own.name):
        raise ModelError(
            f"{machine.name} runs {own.title} and reads every file as {own.title} does, not as "
            f"{name}: slice for {own.title}, or give the machine the other firmware (stillpath "
            "machines set-firmware)"
        )
    return own


def doubts(file: BinaryIO, machine: Machine, name: DialectName | None = None) -> list[str]:
    """Return a warning if a file looks as if it were made for another firmware.

    Parameters
    ----------
    file : binary file
        Its text; the position is preserved.
    name : str, optional
        A requested dialect: then there are no warnings.

    Notes
    -----
    Klipper reads Marlin's flavour: it skips commands that it does not know, as slicers expect.
    """
    if name is not None:
        return []
    own = dialect_for(machine)
    place = file.tell()
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    head = file.read(_END_BYTES)
    file.seek(max(size - _END_BYTES, 0))
    found = detect(head, file.read(_END_BYTES))
    file.seek(place)
    if found.doubtful or found.dialect == own.name or (own.name, found.dialect) == _EXPECTED:
        return []
    why = "; ".join(found.reasons)
    text = (
        f"the file looks as if it were written for {found.dialect} ({why}), and {machine.name} "
        f"reads it as {own.title} does: slice for {own.title}, or say that "
        f"it is written for {own.title} (dialect {own.name})"
    )
    return [text]


def passed_over(reader: Interpreter) -> list[str]:
    """Return a few warnings about commands that the firmware skips or that are unknown."""
    found = reader.warnings
    more = [f"... and {len(found) - _SHOWN} more lines like these"] if len(found) > _SHOWN else []
    return [*found[:_SHOWN], *more]
