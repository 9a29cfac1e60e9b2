"""Revisions and approvals of machines as stored on disk."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    AwareDatetime,
    BaseModel,
    Field,
    ValidationError,
    model_validator,
)

from stillpath.models.complaints import explain
from stillpath.models.document import Document
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.models.provenance import SourceFile

__all__ = [
    "Approval",
    "Conflict",
    "NotApproved",
    "Revision",
    "UnknownMachine",
    "document_text",
    "identified_from",
    "source_file",
]

Who = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]{1,100}$")]
Message = Annotated[str, Field(pattern=r"^[^\x00-\x08\x0b-\x1f\x7f]{0,2000}$")]
Number = Annotated[int, Field(ge=1, le=999_999)]
_MOST_NAMED = 8
_Kind = TypeVar("_Kind", bound=BaseModel)
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class UnknownMachine(ModelError):
    """There is no machine, or no revision, of that name."""


class Conflict(ModelError):
    """The machine is not as the caller thinks it is."""


class NotApproved(ModelError):
    """Only approved revisions may be used, and the machine has none."""


class Revision(Document):
    """One state of a machine; written once, never changed.

    How its plants were found (residuals, modes with intervals) stands in the machine document, at
    `axes.*.provenance`.

    Attributes
    ----------
    number : int
        Counts from 1 without gaps.
    parent : int, optional
        The revision it was made from; None for the first.
    restored : int, optional
        The earlier revision whose machine this one brings back.
    when : datetime
        With its time zone (UTC).
    sources : tuple of SourceFile
        Files the change was made from.
    content_sha256 : str
        Of the machine document as it stands here, against damage; `machine.revision` names it.
    """

    schema_version: Literal[1] = 1
    number: Number
    parent: Number | None = None
    restored: Number | None = None
    when: AwareDatetime
    author: Who
    message: Message = ""
    sources: tuple[SourceFile, ...] = ()
    content_sha256: Digest
    machine: Machine

    @model_validator(mode="before")
    @classmethod
    def _intact(cls, document: Any) -> Any:
        """Check the machine against its hash before fields of a newer version are filled in."""
        if isinstance(document, dict) and isinstance(document.get("machine"), dict):
            found = _digest(document["machine"])
            if document.get("content_sha256") != found:
                raise ValueError(f"the machine is not the one of content_sha256, but {found}")
        return document

    @classmethod
    def of(cls, machine: Machine, **fields: Any) -> Revision:
        """Return a revision of a machine; `fields` are the others, without the hash.

        Raises
        ------
        ModelError
            Naming the field that cannot be.
        """
        document = machine.model_dump(mode="json")
        return _checked(cls, {**fields, "machine": document, "content_sha256": _digest(document)})


class Approval(Document):
    """Approval of a revision for use in jobs."""

    number: Number
    content_sha256: Digest
    when: AwareDatetime
    author: Who
    message: Message = ""

    @classmethod
    def of(cls, revision: Revision, **fields: Any) -> Approval:
        """Return the approval of a revision. See `Revision.of`."""
        of_it = {"number": revision.number, "content_sha256": revision.content_sha256}
        return _checked(cls, fields | of_it)


def document_text(document: BaseModel) -> str:
    """Return a document as the store writes it; reading it back gives the same numbers."""
    return json.dumps(document.model_dump(mode="json"), indent=1) + "\n"


def source_file(name: str, content: bytes) -> SourceFile:
    """Return the name (no folder) and hash of a file that was read."""
    return SourceFile(name=name, sha256=hashlib.sha256(content).hexdigest())


def identified_from(sources: Sequence[SourceFile]) -> str:
    """Return the reason of a revision whose author gave none; `sources` names all files."""
    names = ["".join(c if c.isprintable() else "?" for c in s.name)[:100] for s in sources]
    more = len(names) - _MOST_NAMED
    return f"identified from {', '.join(names[:_MOST_NAMED])}" + (
        f" and {more} more" if more > 0 else ""
    )


def _checked(kind: type[_Kind], fields: dict[str, Any]) -> _Kind:
    try:
        return kind.model_validate(fields)
    except ValidationError as error:
        raise ModelError(explain(error)) from None


def _digest(machine: dict[str, Any]) -> str:
    text = json.dumps(machine, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
