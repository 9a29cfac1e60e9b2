"""Conversion between rows of the job table and jobs."""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import Any

from sqlalchemy import Connection, Row, bindparam, select

from stillpath.service.database import tables
from stillpath.service.jobs.state import Job, JobKind, JobState

__all__ = ["NOT_OVER", "OVER", "from_row", "stored_job", "to_row"]

OVER = tuple(state.value for state in JobState if state.is_final)
NOT_OVER = tuple(state.value for state in JobState if not state.is_final)
_FIELDS = tuple(field.name for field in fields(Job))
_GET = select(tables.jobs).where(tables.jobs.c.id == bindparam("job_id"))


def stored_job(connection: Connection, job_id: str, *, for_update: bool = False) -> Job | None:
    """Return a job, or None; with `for_update` nobody else changes it in this transaction."""
    # SQLite needs no lock of a row: its transaction has locked the database.
    query = _GET.with_for_update() if for_update else _GET
    row = connection.execute(query, {"job_id": job_id}).one_or_none()
    return None if row is None else from_row(row)


def to_row(job: Job) -> dict[str, Any]:
    """Return what the table holds of a job."""
    return asdict(job) | {"state": job.state.value, "kind": job.kind.value}


def from_row(row: Row[Any]) -> Job:
    """Return the job of a row."""
    values = row._mapping
    named = {"state": JobState(values["state"]), "kind": JobKind(values["kind"])}
    return Job(**{name: values[name] for name in _FIELDS} | named)
