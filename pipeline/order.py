"""The options of a compensation, and the pieces reverted after the last check."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from stillpath.models.machine import Machine
from stillpath.pipeline.last_check.errors import LastCheckError
from stillpath.pipeline.options import Options
from stillpath.pipeline.progress import ProgressCallback

__all__ = ["Order"]

_ALL = -1
_MOST_REFUSED = 3
"""Pieces reverted singly after the last check; then all are."""


@dataclass(frozen=True, slots=True)
class Order:
    """Options of a compensation, and pieces to leave as sliced.

    Attributes
    ----------
    refused : dict
        Reasons by a line of the piece (`_ALL`: every piece).
    """

    machine: Machine
    options: Options
    cache_dir: Path | None = None
    progress: ProgressCallback | None = None
    refused: dict[int, str] = field(default_factory=dict)

    def reverting(self, error: LastCheckError, pieces: Sequence[tuple[int, int]]) -> Order:
        """Return an order that reverts the piece refused by the last check.

        Parameters
        ----------
        pieces : sequence of (int, int)
            First and last lines of the compensated pieces, rising.

        Raises
        ------
        LastCheckError
            If every piece was already reverted.
        """
        piece = next((first for first, last in pieces if last >= error.stream_line), None)
        if piece is None or error.stream_line == 0 or _ALL in self.refused:
            raise error
        if len(self.refused) == _MOST_REFUSED:
            others = f"as the last check refused more than {_MOST_REFUSED} pieces, all are reverted"
            return replace(self, refused={**self.refused, _ALL: others})
        reason = (
            f"line {piece}: internal error (the last check refuses the compensated lines: "
            f"{error.reason}); please report it with the file"
        )
        return replace(self, refused={**self.refused, piece: reason})

    def refusal(self, first: int, last: int) -> str | None:
        """Return the reason why a piece with these lines stays as sliced; else None."""
        found = (reason for line, reason in self.refused.items() if first <= line <= last)
        return next(found, self.refused.get(_ALL))
