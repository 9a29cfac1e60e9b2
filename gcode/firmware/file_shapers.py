"""Track the firmware's input shaper as set by the file itself."""

from __future__ import annotations

import re
from collections.abc import Iterator

from stillpath.gcode.firmware.line_reader import NUMBERED

__all__ = ["ADVANCE_LEFT_OFF", "FILE_SETS_SHAPER", "FileShapers"]

FILE_SETS_SHAPER = "The file sets the firmware's input shaper"
"""Beginning of the warning."""
ADVANCE_LEFT_OFF = (
    "M572 S0 stands in and behind compensated stretches, since the machine states no "
    "pressure_advance_s and the file no M572. If config.g, a tool's macro or a filament's config.g "
    "sets M572, the print lacks pressure advance: put its S into the machine, or M572 into the "
    "slicer's start code."
)

_SETTINGS_OF_A_TEST = 4
_VALUE = re.compile(rb"(?<=[SF=])\s*[-+.\d]+")
_ADVANCE, _FURTHER_SHAPER = "M572", re.compile(rb"M593(?!\d)", re.IGNORECASE)
"""Pressure advance, which a stream has off like the shaper (RepRapFirmware)."""


class FileShapers:
    """Lines of the file that set the shaper, to be repeated after a stream.

    Attributes
    ----------
    lines : dict of bytes to bytes
        The last line of each form.
    sets_advance : bool
        A line has set pressure advance.
    """

    def __init__(self) -> None:
        self.lines: dict[bytes, bytes] = {}
        self._names: dict[str, tuple[int, int]] = {}
        """Commands that set a shaper: number of the first line, and how many."""
        self.sets_advance = False
        self._printed_with: dict[int, list[tuple[bytes, ...]]] = {}
        """By tool, the settings under which it printed."""
        self._returned: set[int] = set()
        """Tools that printed under one again, after another."""

    def test(self, tool: int) -> str | None:
        """Note that a tool prints under the settings so far; return why this seems to be a test.

        Prints that try shapers out, as OrcaSlicer makes them, go on to another setting at each
        layer, and never back.
        """
        settings = self._printed_with.setdefault(tool, [])
        now = tuple(self.lines.values())
        if now and settings[-1:] != [now]:
            if now in settings:
                self._returned.add(tool)
            else:
                settings.append(now)
        if len(settings) < _SETTINGS_OF_A_TEST or tool in self._returned:
            return None
        said = " and ".join(f"{name} from line {line}" for name, (line, _) in self._names.items())
        return (
            f"the file tries one setting of the firmware's shaper after the other ({said}), which "
            "it would not show any more; slice one setting for the whole print if it is no test"
        )

    def note(self, line: bytes, number: int) -> None:
        """Record a line that sets the shaper or pressure advance."""
        words = NUMBERED.sub(b"", line).split()
        name = words[0].decode("ascii", "replace").upper() if words else ""
        if name.startswith(_ADVANCE):
            self.sets_advance = True
            if _FURTHER_SHAPER.search(line) is None:
                return
        else:
            first, count = self._names.get(name, (number, 0))
            self._names[name] = (first, count + 1)
        form = _VALUE.sub(b"", line.split(b";", 1)[0])
        others = {k: text for k, text in self.lines.items() if k != form}
        self.lines = {**others, form: line.rstrip() + b"\n"}

    def warnings(self) -> Iterator[str]:
        """Yield which commands of the file set a shaper, and where; often nothing."""
        said = ", ".join(
            f"{name} (line {line}{f' and {count - 1} more' if count > 1 else ''})"
            for name, (line, count) in self._names.items()
        )
        if said:
            yield (
                f"{FILE_SETS_SHAPER}: {said}. Compensation and shaper do "
                "not add up: in compensated stretches it is off, around them as the file sets it."
            )
