"""What the last check has compared, and where it could not compare positions."""

from __future__ import annotations

from stillpath.pipeline.last_check.errors import shown
from stillpath.pipeline.last_check.reader import Reader
from stillpath.pipeline.result import LastCheckFigures

__all__ = ["Coverage"]

_SHOWN = 5


class Coverage:
    """Counts lines of the original, and lists where its position is not known.

    Parameters
    ----------
    original : Reader
        Of the original; it knows by which line the position was lost.

    Attributes
    ----------
    kept : int
        Lines found in the written file.
    """

    def __init__(self, original: Reader) -> None:
        self._original = original
        self.kept = self._compared = 0
        self._gap_line = 0
        self._gaps: list[str] = []
        self._more_gaps = 0

    def note(self, lines: int, unknown: int, line: int, known_line: int) -> None:
        """Count lines from `line` on, `unknown` of them without a position.

        The position is known from `known_line` on.
        """
        self.kept += lines
        self._compared += lines - unknown
        if unknown and not self._gap_line:
            self._gap_line = line
        if lines > unknown and self._gap_line:
            self._close_gap(f"line {known_line}")

    def figures(self) -> LastCheckFigures:
        """Return the figures of the check at the end of the file."""
        if self._gap_line:
            self._close_gap("the end")
        gaps = list(self._gaps)
        if self._more_gaps:
            gaps.append(f"... and {self._more_gaps} more")
        return LastCheckFigures(
            kept_lines=self.kept, compared_lines=self._compared, not_compared=gaps
        )

    def _close_gap(self, until: str) -> None:
        line, self._gap_line = self._gap_line, 0
        why = shown(self._original.lost) or "no line has named one yet"
        if len(self._gaps) < _SHOWN:
            self._gaps.append(
                f"from line {line} up to {until}: filament and modes only, since the position is "
                f"not known there ({why})"
            )
        else:
            self._more_gaps += 1
