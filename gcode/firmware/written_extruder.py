"""The printer's E beside the file's: lines that set it, and what they make of it."""

from __future__ import annotations

from stillpath.gcode.firmware.base import StreamCommands

__all__ = ["WrittenExtruder"]

_LEAST_GAP_MM = 1e-7
_FAR_MM = 10.0
"""32-bit floats resolve a micrometre up to here."""


class WrittenExtruder:
    """What the printer's E reads after the lines written so far.

    Attributes
    ----------
    zero_mm : float
        The file's E where the printer's reads 0.
    """

    def __init__(self, commands: StreamCommands) -> None:
        self.zero_mm = 0.0
        self._commands = commands
        self._far_mm: float | None = None
        """What it reads, if it must be set to 0 before a stream continues."""
        self._uncounted = False
        """It may not count what our lines have fed."""

    def reads(self, extruder_mm: float) -> None:
        """Note what it reads now."""
        far = self._commands.coarse_extruder and abs(extruder_mm) > _FAR_MM
        self._far_mm = extruder_mm if far else None

    def fed(self, feed_mm: float, factor: float) -> None:
        """Note that a line of the file has fed so much, at this factor of M221."""
        if self._far_mm is not None:
            self.reads(self._far_mm + feed_mm / factor)

    def streams(self, *, absolute: bool) -> bytes:
        """Return lines before those of a stream; `absolute` is the E of the file around it."""
        self._uncounted |= absolute and not self._commands.relative_moves_count
        if self._far_mm is None:
            return b""
        self.zero_mm += self._far_mm
        self._far_mm = None
        return b"G92 E0\n"

    def set_by_file(self, value_mm: float, ahead_mm: float) -> bytes:
        """Return the line after a G92 E that accounts for a lead of the extruder over the plan.

        The file counts from there whenever its E is absolute, which may be much later.
        """
        reads_mm = value_mm + ahead_mm
        self.zero_mm, self._uncounted = 0.0, False
        self.reads(reads_mm)
        return b"" if abs(ahead_mm) < _LEAST_GAP_MM else f"G92 E{reads_mm:.7f}\n".encode()

    def file_again(self, file_mm: float) -> bytes:
        """Return the line that sets it to the file's E, if it may differ."""
        if self.zero_mm == 0.0 and not self._uncounted:
            return b""
        self.zero_mm, self._uncounted = 0.0, False
        return f"G92 E{file_mm:.7f}\n".encode()
