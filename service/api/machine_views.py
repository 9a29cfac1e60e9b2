"""Response models of the routes of machines."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Literal

from pydantic import BaseModel, Field

from stillpath.applications.machines.diff import Change
from stillpath.applications.machines.drift import Drift
from stillpath.applications.machines.revision import Approval, Revision
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.models.provenance import Provenance, SourceFile

__all__ = ["DiffView", "HistoryView", "MachineSummary", "RevisionDocument", "RevisionView"]


class MachineSummary(BaseModel):
    """One line of the machine list."""

    name: str
    title: str
    kinematics: str
    revision: str = Field(description="Names the content of the document; also its ETag.")
    source: str
    origin: Literal["built in", "own"] = "built in"
    number: int | None = Field(default=None, description="Newest revision, if it is your own.")
    approved: int | None = Field(default=None, description="Newest approved revision.")
    problem: str | None = Field(default=None, description="What is damaged, if anything.")
    live_refusal: str | None = Field(
        default=None, description="Why it cannot print live, inside Klipper; null: it can."
    )

    @classmethod
    def of(cls, machine: Machine) -> MachineSummary:
        """Return the line of a machine."""
        return cls(
            name=machine.name,
            title=machine.title,
            kinematics=machine.kinematics,
            revision=machine.revision,
            source=machine.source,
            live_refusal=machine.live_refusal,
        )

    @classmethod
    def own(cls, current: Revision, approvals: Mapping[int, Approval]) -> MachineSummary:
        """Return the line of a user's machine."""
        return cls.of(current.machine).model_copy(
            update={
                "origin": "own",
                "number": current.number,
                "approved": max(approvals, default=None),
            }
        )

    @classmethod
    def damaged(cls, name: str, error: ModelError) -> MachineSummary:
        """Return the line of a machine whose file cannot be read."""
        return cls(
            name=name,
            title=f"{name} (damaged)",
            kinematics="",
            revision="",
            source="",
            origin="own",
            problem=str(error),
        )


class RevisionView(BaseModel):
    """One state of a machine, without the document."""

    number: int
    parent: int | None
    restored: int | None = Field(description="The earlier revision that it brings back.")
    when: datetime
    author: str
    message: str
    sources: tuple[SourceFile, ...]
    revision: str = Field(description="Names the content of the document; its ETag while current.")
    provenance: dict[str, Provenance] = Field(
        description="How the plants of the axes were found: residuals, modes with intervals."
    )
    approval: Approval | None

    @classmethod
    def of(cls, revision: Revision, approval: Approval | None) -> RevisionView:
        """Return the view of a revision."""
        axes = revision.machine.axes
        return cls(
            **revision.model_dump(
                include={"number", "parent", "restored", "when", "author", "message", "sources"}
            ),
            revision=revision.machine.revision,
            provenance={a: p.provenance for a, p in axes.items() if p.provenance is not None},
            approval=approval,
        )


class RevisionDocument(BaseModel):
    """One state of a machine with its document."""

    revision: RevisionView
    machine: Machine


class HistoryView(BaseModel):
    """All states of a machine, oldest first, and whether its resonances moved."""

    revisions: list[RevisionView]
    drift: tuple[Drift, ...]


class DiffView(BaseModel):
    """What one revision changed against another."""

    before: int
    after: int
    changes: tuple[Change, ...]
