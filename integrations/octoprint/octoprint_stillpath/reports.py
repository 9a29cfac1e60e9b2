"""Pages of reports."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["Reports"]


class Reports:
    """Pages of reports, in a folder of their own, named by the entries they are of.

    They stay here, so that their links work without the server and without its key.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def path(self, report_id: str) -> Path | None:
        """Return the file of a report, or None; whatever else the text is, it leads nowhere."""
        if not re.fullmatch(r"[0-9a-f]{32}", report_id):
            return None
        path = self._folder / f"{report_id}.html"
        return path if path.is_file() else None

    def add(self, report_id: str, page: bytes) -> None:
        """Keep a page."""
        self._folder.mkdir(parents=True, exist_ok=True)
        (self._folder / f"{report_id}.html").write_bytes(page)

    def keep_only(self, report_ids: set[str]) -> None:
        """Delete all others: their files are gone."""
        if self._folder.is_dir():
            for path in self._folder.glob("*.html"):
                if path.stem not in report_ids:
                    path.unlink()
