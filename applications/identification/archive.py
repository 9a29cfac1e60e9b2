"""Store identification reports by the digest of the resulting machine."""

from __future__ import annotations

import re
from pathlib import Path

from pydantic import ValidationError

from stillpath.applications.identification.figures import IdentificationReport
from stillpath.applications.machines.documents import DocumentFolder, Documents
from stillpath.models.errors import ModelError

__all__ = ["Archive"]

_REVISION = re.compile(r"[0-9a-f]{12}")


class Archive:
    """Identification reports by the resulting `Machine.revision`.

    Parameters
    ----------
    place : Path or Documents
        Storage of the reports; a folder is made for the first report.
    """

    def __init__(self, place: Path | Documents) -> None:
        self._documents = DocumentFolder(place) if isinstance(place, Path) else place

    def keep(self, report: IdentificationReport) -> None:
        """Write a report, whole or not at all."""
        self._documents.replace(_file(report.machine_revision), report.model_dump_json())

    def find(self, revision: str) -> IdentificationReport | None:
        """Return the report of a machine's content, None if there is none.

        Raises
        ------
        ModelError
            If the file is damaged.
        """
        file = _file(revision)
        try:
            return IdentificationReport.model_validate_json(self._documents.read(file))
        except FileNotFoundError:
            return None
        except ValidationError:
            raise ModelError(
                f"{self._documents.place(file)}: damaged; identify the machine again"
            ) from None


def _file(revision: str) -> str:
    if not _REVISION.fullmatch(revision):
        raise ModelError(f"{revision!r} does not name the content of a machine")
    return f"{revision}.json"
