"""Switch the firmware's shaper and pressure advance off for streams, and on again behind them."""

from __future__ import annotations

from collections.abc import Iterator

from stillpath.gcode.firmware.base import StreamCommands
from stillpath.gcode.firmware.file_shapers import ADVANCE_LEFT_OFF, FileShapers
from stillpath.gcode.pieces import Piece
from stillpath.gcode.types import Limits

__all__ = ["ShaperSwitch"]


class ShaperSwitch:
    """The firmware's shaper and pressure advance, as the lines written so far leave them.

    Attributes
    ----------
    is_off : bool
        Our lines have switched the shaper off.
    """

    def __init__(self, commands: StreamCommands) -> None:
        self.is_off = False
        self._commands = commands
        self._advances = False
        """Pressure advance is on, although the shaper is off."""
        self._by_file = FileShapers()
        self._left_off: frozenset[str] = frozenset()
        """Axes whose shaper is not stated, so that it stays off behind a stream."""
        self._advance_left_off = False

    @property
    def is_known(self) -> bool:
        """Whether there are lines that set the shaper again: the machine's, or the file's."""
        return self._commands.shaper_on is not None or bool(self._by_file.lines)

    def warnings(self) -> Iterator[str]:
        """Yield warnings about the firmware's shaper, and about those that the file itself sets."""
        if self._left_off:
            whose = f" of {min(self._left_off)}" if len(self._left_off) == 1 else ""
            yield (
                f"The firmware's own input shaper{whose} is not known (firmware.shaper in the "
                "machine): it is switched off and stays off; set it again after the print."
            )
        if self._advance_left_off and not self._by_file.sets_advance:
            yield ADVANCE_LEFT_OFF
        yield from self._by_file.warnings()

    def set_by_file(self, line: bytes, number: int) -> None:
        """Note that a line of the file, of this number, sets the shaper or pressure advance."""
        self.is_off = False
        self._by_file.note(line, number)

    def test(self, piece: Piece) -> str | None:
        """Return why a piece seems to belong to a test of the firmware's shaper, or None."""
        return self._by_file.test(int(piece.moves.tool[0]))

    def off_lines(self) -> bytes:
        """Return the lines that a stream needs before it, without counting them as written."""
        if self.is_off:
            return self._commands.advance_off if self._advances else b""
        off = self._commands.shaper_off
        return off or (self._commands.file_shaper_off if self._by_file.lines else b"")

    def off(self) -> bytes:
        """Switch both off."""
        lines = self.off_lines()
        self.is_off, self._advances = self.is_off or bool(lines), False
        return lines

    def advance_on(self, limits: Limits) -> bytes:
        """Switch pressure advance on while the shaper stays off."""
        if not self.is_off or self._advances:
            return b""
        lines = self._commands.advance_aside(limits)
        self._advances = bool(lines)
        return lines

    def on(self, limits: Limits) -> bytes:
        """Set the shaper again, as far as it is known.

        The next stream switches it off in any case: a pause or a macro may have set it.
        """
        if not self.is_off:
            return b""
        self.is_off = self._advances = False
        stated, said = self._commands.shaper_on, self._by_file.lines.values()
        if stated is None and not self._commands.shaper_absent:
            set_again = [self._commands.shaped_axes(line) for line in said]
            self._left_off |= {"X", "Y"}.difference(*set_again)
        lines = (stated or b"") + b"".join(said)
        self._advance_left_off |= self._commands.advance_assumed
        advance = self._commands.advance(limits)
        return lines if lines.endswith(advance) else lines + advance
