"""Choose the dialect in which a job's file is read, and warn if it looks like another."""

from __future__ import annotations

import io
import re
from math import hypot
from typing import BinaryIO

from stillpath.gcode import _slots as at
from stillpath.gcode.commands import awaiting_extruder_mode
from stillpath.gcode.detection import EIGHT_BIT_PRUSA, detect
from stillpath.gcode.dialect import Dialect
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.dialects import dialect_of
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.slicers.facts import SlicerFacts
from stillpath.models.errors import ModelError
from stillpath.models.firmware import Klipper, Marlin, RepRapFirmware
from stillpath.models.machine import Machine
from stillpath.pipeline.options import DialectName

__all__ = [
    "cut_off_warnings",
    "dialect_for",
    "dialect_warnings",
    "extruder_mode_awaited",
    "no_moves",
    "skipped_notes",
    "skipped_warnings",
]

_SHOWN = 5
_END_BYTES = 1 << 18
_BEGINNING_BYTES = 1 << 23
"""Pictures may come first."""
_MODE = re.compile(rb"^(?:[^;\s][^;\n]*)?\bM8[23](?!\d)", re.MULTILINE | re.IGNORECASE)
"""Not indented, for that may be under a condition."""
_FEEDS = re.compile(rb"^[ \t]*(?:N\d+[ \t]*)?G0*[0-3](?!\d)[^;\n]*E", re.MULTILINE | re.IGNORECASE)
_E_LINE = re.compile(
    rb"^[ \t]*(?:N\d+[ \t]*)?"
    rb"(?:(?P<move>G0*[0-3](?!\d)[^;\n]*)|(?P<mode>G9(?:0|(?P<steps>1)))(?!\d)|G92(?!\d))",
    re.MULTILINE | re.IGNORECASE,
)
_WORD = re.compile(rb"([XYE])[ \t]*([-+]?\d*\.?\d+)", re.IGNORECASE)
_MOST_PAIRS = 1000
_MOST_PER_MM = 1.0
"""Filament that no line takes, in mm per mm: an absolute E soon is above that."""
_FITTING, _FALLING, _REPEATED = 0.9, 0.1, 0.6
"""Shares of lines. Wipes let an absolute E fall, KISSlicer repeats it on the way to the next line;
of relative ones about half fall, or all are the same."""
_EIGHT_BIT = (
    "the file was sliced for an MK3 or its forerunners (printer_model), whose own board has 8 bits "
    "and cannot execute a compensated file, and {} has a board of 32: unless you replaced the "
    "board, set board to avr in the machine, and print the file as sliced"
)
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


def extruder_mode_awaited(
    file: BinaryIO, machine: Machine, dialect: Dialect
) -> tuple[Dialect, list[str]]:
    """Return a dialect that leaves moves as they are until M82 or M83, if the file needs that.

    With RepRapFirmware a file begins with the mode that config.g has left, with Klipper with that
    of its start macro or of the print before. A stream could not give that back, and what is fed
    before the file says a mode is not known. With Klipper nearly all such files have absolute E,
    which is what it starts with; those are read so unless their numbers tell otherwise.

    Parameters
    ----------
    file : binary file
        Its text; the position is preserved.

    Returns
    -------
    dialect, warnings : Dialect, list of str
        The one given, without a warning, for other firmwares and where the file says a mode first.
    """
    if not isinstance(machine.firmware, Klipper | RepRapFirmware):
        return dialect, []
    place = file.tell()
    file.seek(0)
    head = file.read(_BEGINNING_BYTES)
    file.seek(place)
    mode, feeds = _MODE.search(head), _FEEDS.search(head)
    if feeds is None or (mode is not None and mode.start() < feeds.start()):
        return dialect, []
    line = head.count(b"\n", 0, feeds.start()) + 1
    warning = f"line {line} feeds filament before the file says M82 or M83. "
    if isinstance(machine.firmware, Klipper):
        if not _looks_relative(head[: mode.start() if mode is not None else len(head)]):
            return dialect, []
        warning += (
            "Its numbers look relative, and Klipper reads E there as the start macro or the print "
            "before has left it, which is not known: moves up to the first of them stay as sliced. "
            "Put M83 (M82, where E is absolute) behind the macro in the slicer's start code"
        )
    else:
        warning += (
            "RepRapFirmware reads E there as config.g says, which is not known: moves up to the "
            "first of them stay as sliced. Put M83 (M82, where E is absolute) at the beginning of "
            "the slicer's start code"
        )
    return awaiting_extruder_mode(dialect), [warning]


def _looks_relative(text: bytes) -> bool:
    """Tell whether E of lines in X and Y is what they take themselves, and often does not grow."""
    x, y, before, in_steps = 0.0, 0.0, 0.0, False
    pairs, fits, falls, repeats = 0, 0, 0, 0
    for line in _E_LINE.finditer(text):
        # What stands alone (a retraction, and its end) and G92 tell nothing.
        found, before = before, 0.0
        if line["move"] is None:
            in_steps = line["steps"] is not None if line["mode"] else in_steps
            continue
        words = {word[1].upper(): float(word[2]) for word in _WORD.finditer(line["move"])}
        from_x, from_y, x, y = x, y, words.get(b"X", x), words.get(b"Y", y)
        way_mm = hypot(x - from_x, y - from_y)
        if b"E" not in words:
            before = found
        elif way_mm > 0.0 and not in_steps:
            before = words[b"E"]
            if before > 0.0 and found > 0.0:
                pairs += 1
                fits += before < _MOST_PER_MM * way_mm
                falls += before < found
                repeats += before == found
        if pairs == _MOST_PAIRS:
            break
    return fits > _FITTING * pairs and (falls > _FALLING * pairs or repeats > _REPEATED * pairs)


def dialect_warnings(
    file: BinaryIO, machine: Machine, name: DialectName | None = None
) -> list[str]:
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
    found = detect(head, file.read(_END_BYTES), machine=own.name)
    file.seek(place)
    firmware = machine.firmware
    if own.name == "marlin" and EIGHT_BIT_PRUSA in found.reasons:
        has_8_bits = isinstance(firmware, Marlin) and firmware.board == "avr"
        return [] if has_8_bits else [_EIGHT_BIT.format(machine.name)]
    if found.doubtful or found.dialect == own.name or (own.name, found.dialect) == _EXPECTED:
        return []
    why = "; ".join(found.reasons)
    text = (
        f"the file looks as if it were written for {found.dialect} ({why}), and {machine.name} "
        f"reads it as {own.title} does: slice for {own.title}, or say that "
        f"it is written for {own.title} (dialect {own.name})"
    )
    if isinstance(firmware, Marlin) and found.dialect in _OFFSHOOTS:
        text += (
            f"; if the printer runs {found.dialect.title()}'s own firmware, which cannot execute a "
            f"file compensated for {own.title}, set variant to {found.dialect} in its machine"
        )
    return [text]


def no_moves(dialect: Dialect) -> GcodeError:
    """Return the error for a file in which the firmware finds no move."""
    title = dialect.title
    return GcodeError(
        f"the file contains no moves that {title} reads; is it G-code for {title}, with LF line "
        "ends? Klipper has no G01, and most builds of Marlin no g1: write G1"
    )


def cut_off_warnings(facts: SlicerFacts, reader: Interpreter) -> list[str]:
    """Return a warning if a file that was read to its end lacks what its slicer ends files with."""
    if not facts.missing_end:
        return []
    line = int(reader.state.i[at.I_LINE]) - 1
    text = (
        f"the file ends behind line {line} without {facts.missing_end!r}, which "
        f"{facts.slicer or 'its slicer'} writes at the end of every file: it was cut off, so "
        "layers may be missing, and the lines that switch the heaters off; compare its size, and "
        "copy or export it again"
    )
    return [text]


def skipped_warnings(reader: Interpreter) -> list[str]:
    """Return a few warnings about commands that the firmware skips or that are unknown."""
    return _few(reader.warnings)


def skipped_notes(reader: Interpreter) -> list[str]:
    """Return a few notes on commands that the firmware skips unless the printer has them."""
    return _few([f"line {line}: {text}" for text, line in reader.state.notes.items()])


def _few(found: list[str]) -> list[str]:
    more = [f"... and {len(found) - _SHOWN} more lines like these"] if len(found) > _SHOWN else []
    return [*found[:_SHOWN], *more]
