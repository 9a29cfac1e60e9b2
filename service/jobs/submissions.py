"""Submit jobs exactly once: idempotency keys, quotas, and requests that share a job."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Select, and_, bindparam, case, func, select, text, update

from stillpath.service.database import tables
from stillpath.service.database.transactions import insert
from stillpath.service.jobs.state import Job
from stillpath.service.jobs.stored_rows import NOT_OVER, from_row, stored_job, to_row

__all__ = [
    "IdempotencyConflict",
    "Quota",
    "QuotaExceeded",
    "SpaceExceeded",
    "same_job",
    "submission",
    "submit",
    "usage",
]

_JOBS = tables.jobs.c
# Frequent statements are built once: building takes longer than executing.
_SAME = (
    select(tables.jobs)
    .where(_JOBS.owner == bindparam("owner"), _JOBS.dedupe_key == bindparam("key"))
    .where(_JOBS.state.in_(("done", *NOT_OVER)))
    .order_by(
        case({"done": 0, "running": 1, "queued": 2}, value=_JOBS.state),
        _JOBS.created_at.desc(),
        _JOBS.id.desc(),
    )
    .limit(1)
)
_USAGE = select(
    func.count().filter(_JOBS.state.in_(NOT_OVER)),
    func.sum(_JOBS.source_bytes + func.coalesce(_JOBS.output_bytes, 0)),
).where(_JOBS.owner == bindparam("owner"))
_ADD, _ADD_AUDIT = tables.jobs.insert(), tables.audit.insert()


@dataclass(frozen=True, slots=True)
class Quota:
    """Limits of one owner: unfinished jobs, and bytes of all kept jobs."""

    max_jobs: int
    max_bytes: int

    def check(
        self, owner: str, jobs: int, kept_bytes: int, upload_bytes: int | None = None
    ) -> None:
        """Refuse a further job that exceeds the quota.

        Parameters
        ----------
        jobs, kept_bytes : int
            Current use of the owner; see `usage`.
        upload_bytes : int, optional
            Size of the job's file; if not yet known, at least one byte.

        Raises
        ------
        QuotaExceeded, SpaceExceeded
        """
        if jobs >= self.max_jobs:
            raise QuotaExceeded(
                f"{owner!r} has {jobs} unfinished jobs, the limit is {self.max_jobs}; wait for "
                "some, or cancel them."
            )
        if kept_bytes + (1 if upload_bytes is None else upload_bytes) > self.max_bytes:
            upload = "" if upload_bytes is None else f" and this upload has {upload_bytes}"
            raise SpaceExceeded(
                f"{owner!r} keeps {kept_bytes} bytes{upload}, the limit is {self.max_bytes}; "
                "delete finished jobs."
            )


class QuotaExceeded(Exception):
    """The owner has too many jobs already."""


class SpaceExceeded(QuotaExceeded):
    """The owner keeps too many bytes already."""


class IdempotencyConflict(Exception):
    """The idempotency key was used before, with another request."""


def submit(
    connection: Connection,
    job: Job,
    idempotency: tuple[str, str] | None,
    limits: Quota | None,
    shared: bool,
    audit_row: Mapping[str, Any] | None,
) -> Job:
    """Add a job in the caller's transaction; parameters and errors are those of `JobStore.add`."""
    if idempotency is not None:
        earlier = _earlier(connection, job, *idempotency)
        if earlier is not None:
            return earlier
    if shared or limits is not None:
        _stand_in_line(connection, job.owner)
    same = same_job(connection, job.owner, job.dedupe_key) if shared else None
    if same is not None:
        if idempotency is not None:
            _lead_to(connection, job.owner, idempotency[0], {"job_id": same.id})
        return same
    if limits is not None:
        limits.check(job.owner, *usage(connection, job.owner), job.source_bytes)
    connection.execute(_ADD, to_row(job))
    if audit_row is not None:
        connection.execute(_ADD_AUDIT, dict(audit_row))
    return job


def submission(owner: str, key: str) -> Select[Any]:
    """Select what came with an idempotency key."""
    row = tables.submissions.c
    return select(tables.submissions).where(row.owner == owner, row.idempotency_key == key)


def _earlier(connection: Connection, job: Job, key: str, fingerprint: str) -> Job | None:
    """Return the earlier job of the same request, or record `job` as the first."""
    row = {
        "owner": job.owner,
        "idempotency_key": key,
        "fingerprint": fingerprint,
        "job_id": job.id,
        "created_at": job.created_at,
        "kept_from_s": None,
    }
    # If somebody else is about to insert the same key, this waits for that transaction.
    statement = insert(connection, tables.submissions).values(row).on_conflict_do_nothing()
    is_first = (
        connection.execute(statement.returning(tables.submissions.c.job_id)).first() is not None
    )
    if is_first:
        return None
    known = connection.execute(submission(job.owner, key).with_for_update()).one()
    if known.fingerprint != fingerprint:
        raise IdempotencyConflict(
            f"the idempotency key {key!r:.80} came before with another request; take a new key for "
            "a new request"
        )
    earlier = stored_job(connection, known.job_id)
    if earlier is None:  # deleted meanwhile: treat it as a new request
        _lead_to(connection, job.owner, key, row)
    return earlier


def _lead_to(connection: Connection, owner: str, key: str, values: dict[str, Any]) -> None:
    """Let the request of an idempotency key lead to another job."""
    row = tables.submissions.c
    known = and_(row.owner == owner, row.idempotency_key == key)
    connection.execute(update(tables.submissions).where(known).values(values))


def same_job(connection: Connection, owner: str, dedupe_key: str) -> Job | None:
    """Return the owner's newest job of a dedupe key: finished, or else in progress."""
    row = connection.execute(_SAME, {"owner": owner, "key": dedupe_key}).one_or_none()
    return None if row is None else from_row(row)


def _stand_in_line(connection: Connection, owner: str) -> None:
    """Serialise the submissions of an owner, so that each sees the others."""
    if connection.dialect.name == "postgresql":  # SQLite locks the whole database
        lock = text("SELECT pg_advisory_xact_lock(hashtextextended(:owner, 7))")
        connection.execute(lock, {"owner": owner})


def usage(connection: Connection, owner: str) -> tuple[int, int]:
    """Return an owner's number of unfinished jobs, and the bytes of all kept ones."""
    jobs, size = connection.execute(_USAGE, {"owner": owner}).one()
    return int(jobs), int(size or 0)
