"""Export and import machines as files: a document, or the whole history."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import ValidationError
from pydantic_core import from_json

from stillpath.applications.machines.revision import (
    Approval,
    Revision,
    document_text,
    source_file,
)
from stillpath.applications.machines.store import MachineStore
from stillpath.models.complaints import explain
from stillpath.models.document import Document
from stillpath.models.errors import ModelError
from stillpath.models.store import read_machine
from stillpath.models.user_files import as_utf8, read_bytes

__all__ = ["export_history", "import_file"]

_LARGEST_BYTES = 64_000_000


class _History(Document):
    """A machine with all its revisions.

    Approvals are there to be read: they do not hold in another store.
    """

    format: Literal["stillpath machine history"] = "stillpath machine history"
    name: str
    revisions: tuple[Revision, ...]
    approvals: tuple[Approval, ...] = ()


def export_history(store: MachineStore, name: str) -> str:
    """Return a machine with all its revisions as JSON."""
    return document_text(
        _History(
            name=name,
            revisions=tuple(store.history(name)),
            approvals=tuple(store.approvals(name).values()),
        )
    )


def import_file(
    store: MachineStore, file: Path, *, author: str, message: str = "", name: str | None = None
) -> Revision:
    """Add the machine of a file, a machine document or an exported history, as a new machine.

    Parameters
    ----------
    name : str, optional
        Another name for it. Of a history, only the newest machine is taken then.

    Returns
    -------
    Revision
        The current one.

    Raises
    ------
    Conflict
        If there is a machine of that name.
    ModelError
        If the file is neither, or the name cannot be used.
    """
    content = read_bytes(file, _LARGEST_BYTES, "neither machine nor history")
    history = _as_history(content, file)
    machine = read_machine(content, str(file)) if history is None else history.revisions[-1].machine
    if history is not None and name in (None, history.name):
        store.add_history(history.name, history.revisions)
        return store.current(history.name)
    name = machine.name if name is None else name
    return store.add_revision(
        name,
        machine.model_copy(update={"name": name}),
        author=author,
        message=message or f"imported from {file.name}",
        sources=[source_file(file.name, content)],
        expected=0,
    )


def _as_history(content: bytes, file: Path) -> _History | None:
    """Return the history in a file, None if it is something else."""
    try:
        document = from_json(as_utf8(content))
    except ValueError:
        return None
    if not isinstance(document, dict) or "revisions" not in document:
        return None
    try:
        history = _History.model_validate(document)
    except ValidationError as error:
        raise ModelError(f"{file}: {explain(error)}; export the machine again") from None
    if not history.revisions:
        raise ModelError(f"{file}: the history holds no revision; export the machine again")
    return history
