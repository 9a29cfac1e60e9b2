"""Keeps the figures of identifications by the content of the machine that they led to."""

from __future__ import annotations

import re
from pathlib import Path

from pydantic import ValidationError

from models.errors import ModelError
from service.identification.figures import IdentificationReport
from service.pipeline.files import replacing

__all__ = ["Archive"]

_REVISION = re.compile(r"[0-9a-f]{12}")


class Archive:
    """A folder of reports; `Machine.revision` names the file.

    Parameters
    ----------
    root : Path
        Made when the first report is kept.
    """

    def __init__(self, root: Path) -> None:
        self._root = root

    def keep(self, report: IdentificationReport) -> None:
        """Write a report, whole or not at all."""
        self._root.mkdir(parents=True, exist_ok=True)
        with replacing(self._file(report.machine_revision)) as temporary:
            temporary.write_text(report.model_dump_json(), encoding="utf-8")

    def find(self, revision: str) -> IdentificationReport | None:
        """Return the report that led to a machine's content, None if there is none.

        Raises
        ------
        ModelError
            If the file is damaged.
        """
        file = self._file(revision)
        if not file.exists():
            return None
        try:
            return IdentificationReport.model_validate_json(file.read_bytes())
        except ValidationError:
            raise ModelError(f"{file}: damaged; identify the machine again") from None

    def _file(self, revision: str) -> Path:
        if not _REVISION.fullmatch(revision):
            raise ModelError(f"{revision!r} does not name the content of a machine")
        return self._root / f"{revision}.json"
