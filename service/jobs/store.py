"""The job store, in SQLite or PostgreSQL. Files are in `service.storage`.

Every change of a job goes through `service.jobs.state.advance` in one transaction; only `beat`,
which every worker calls twice a second, is a single equivalent statement.
"""

from __future__ import annotations

import base64
import json
import math
import uuid
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import (
    Connection,
    CursorResult,
    Engine,
    Select,
    bindparam,
    case,
    delete,
    func,
    or_,
    select,
    text,
    tuple_,
    update,
)

from stillpath.service.database import tables
from stillpath.service.database.errors import DatabaseAway
from stillpath.service.database.transactions import insert, reading, write_together, writing
from stillpath.service.jobs.queue_order import queue_order
from stillpath.service.jobs.state import (
    WAITING_FOR_ROOM,
    Claimed,
    Event,
    Job,
    JobKind,
    JobState,
    Stale,
    advance,
)
from stillpath.service.jobs.stored_rows import OVER, from_row, stored_job, to_row
from stillpath.service.jobs.submissions import Quota, same_job, submission, submit, usage

__all__ = ["BadCursor", "JobListing", "JobStore"]

_JOBS = tables.jobs.c
_IDENTITY = "database"
"""Lease that nobody gives up: its holder is the database's name."""
_CLOCKS_APART = 12
"""A lease that exceeds its duration by this factor dates from before the clock was set."""


# Frequent statements (uploads, reconciler) are built once: building takes longer than executing.
_QUEUE = queue_order()
_PLACE = select(_QUEUE.c.place).where(_QUEUE.c.id == bindparam("job_id"))
_IN_STATE = (
    select(tables.jobs)
    .where(_JOBS.state == bindparam("wanted"))
    .order_by(_JOBS.created_at, _JOBS.id)
)


class BadCursor(ValueError):
    """The cursor does not come from a page."""


@dataclass(frozen=True, slots=True)
class JobListing:
    """A page of jobs, newest first, and the cursor of the next page (None: there is none)."""

    jobs: list[Job]
    next_cursor: str | None


class JobStore:
    """The jobs in a database; safe to use from several threads, processes and computers.

    Parameters
    ----------
    engine : sqlalchemy.Engine
        From `service.database.engine.open_database`; the caller closes it.

    Notes
    -----
    Every method raises `service.database.errors.DatabaseAway` if the database does not answer.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine

    # Submitting

    def add(
        self,
        job: Job,
        *,
        idempotency: tuple[str, str] | None = None,
        limits: Quota | None = None,
        shared: bool = False,
        audit_row: Mapping[str, Any] | None = None,
    ) -> Job:
        """Add a new job, whose input must already be stored.

        Parameters
        ----------
        idempotency : (key, fingerprint), optional
            The caller's key, and a digest of the request that came with it.
        shared : bool
            Whether to reuse a job found by `find_same`.
        audit_row : mapping, optional
            From `AuditLog.row`; written if the job is new, in the same transaction: disks are slow.

        Returns
        -------
        Job
            `job`, or the earlier job of the same request, or the shared one.

        Raises
        ------
        IdempotencyConflict
            If the key is known with another fingerprint.
        QuotaExceeded
        """

        return write_together(
            self.engine, lambda c: submit(c, job, idempotency, limits, shared, audit_row)
        )

    def submitted(self, owner: str, idempotency_key: str) -> tuple[str, Job | None] | None:
        """Return the fingerprint that came with a key, and its job unless that was deleted."""
        with reading(self.engine) as connection:
            row = connection.execute(submission(owner, idempotency_key)).one_or_none()
            return row and (row.fingerprint, stored_job(connection, row.job_id))

    def find_same(self, owner: str, dedupe_key: str) -> Job | None:
        """Return the owner's newest job of a dedupe key: finished, or else in progress."""
        with reading(self.engine) as connection:
            return same_job(connection, owner, dedupe_key)

    # Reading

    def get(self, job_id: str, owner: str | None = None) -> Job | None:
        """Return a job, of this owner if one is given, or None."""
        with reading(self.engine) as connection:
            job = stored_job(connection, job_id)
        return job if job is not None and owner in (None, job.owner) else None

    def many(self, ids: Iterable[str]) -> dict[str, Job]:
        """Return those of the jobs that exist, by id."""
        found = self._jobs(select(tables.jobs).where(_JOBS.id.in_(list(ids))))
        return {job.id: job for job in found}

    def page(
        self,
        owner: str | None,
        *,
        kinds: Collection[JobKind] = (),
        states: Collection[JobState] = (),
        batch: str | None = None,
        limit: int,
        cursor: str | None = None,
    ) -> JobListing:
        """Return jobs, newest first.

        Parameters
        ----------
        owner : str or None
            None: everybody's.
        kinds, states, batch
            Which jobs; by default all.
        limit : int
            How many at most.
        cursor : str, optional
            `next_cursor` of the page before. Jobs that were added since do not shift the pages.

        Raises
        ------
        BadCursor
        """
        query = select(tables.jobs).order_by(_JOBS.created_at.desc(), _JOBS.id.desc())
        if owner is not None:
            query = query.where(_JOBS.owner == owner)
        if kinds:
            query = query.where(_JOBS.kind.in_([kind.value for kind in kinds]))
        if states:
            query = query.where(_JOBS.state.in_([state.value for state in states]))
        if batch is not None:
            query = query.where(_JOBS.batch == batch)
        if cursor is not None:
            query = query.where(tuple_(_JOBS.created_at, _JOBS.id) < tuple_(*_from_cursor(cursor)))
        found = self._jobs(query.limit(limit + 1))
        more = len(found) > limit
        return JobListing(found[:limit], _to_cursor(found[limit - 1]) if more else None)

    def in_state(self, state: JobState) -> list[Job]:
        """Return all jobs in a state, oldest first."""
        return self._jobs(_IN_STATE, {"wanted": state.value})

    def counts(self) -> dict[JobState, int]:
        """Return how many jobs are in each state."""
        with reading(self.engine) as connection:
            rows = connection.execute(select(_JOBS.state, func.count()).group_by(_JOBS.state)).all()
        return dict.fromkeys(JobState, 0) | {JobState(state): count for state, count in rows}

    def oldest_queued_at(self) -> float | None:
        """Return when the job that has waited longest was submitted."""
        with reading(self.engine) as connection:
            return connection.execute(
                select(func.min(_JOBS.created_at)).where(_JOBS.state == "queued")
            ).scalar()

    def check(self) -> None:
        """See whether jobs can be stored.

        Raises
        ------
        DatabaseAway
            If the database does not answer, or takes no writes: a standby, or one that is full.
        """
        with reading(self.engine) as connection:
            connection.execute(select(_JOBS.id).limit(1))
            on_server = self.engine.dialect.name == "postgresql"
            if on_server and connection.scalar(text("SHOW transaction_read_only")) == "on":
                shown = self.engine.url.render_as_string(hide_password=True)
                raise DatabaseAway(
                    f"the database {shown} takes no writes; see whether it is a standby or full"
                )

    def waiting_for_room(self) -> tuple[int, int]:
        """Return how many jobs wait for disk space, and the largest need of one."""
        query = select(func.count(), func.max(_JOBS.room_bytes)).where(
            _JOBS.state == "queued", _JOBS.stage == WAITING_FOR_ROOM
        )
        with reading(self.engine) as connection:
            jobs, most = connection.execute(query).one()
        return int(jobs), int(most or 0)

    def ended_between(self, after: float, until: float) -> list[Job]:
        """Return the jobs that ended after a time and not later than another."""
        ended = (_JOBS.finished_at > after, _JOBS.finished_at <= until)
        return self._jobs(select(tables.jobs).where(_JOBS.state.in_(OVER), *ended))

    def usage(self, owner: str) -> tuple[int, int]:
        """Return an owner's number of unfinished jobs, and the bytes of all kept ones."""
        with reading(self.engine) as connection:
            return usage(connection, owner)

    # The queue

    def next_queued(
        self, limit: int, *, short: bool = False, exclude: Collection[str] = ()
    ) -> list[Job]:
        """Return waiting jobs, short ones or the others, in the order of their start.

        Higher priority first; then owners take turns, running jobs included; then older first. Jobs
        in `exclude` use up their owners' turns but are not returned.
        """
        query = (
            select(tables.jobs)
            .join(_QUEUE, _QUEUE.c.id == _JOBS.id)
            .where(_QUEUE.c.is_short == int(short), _JOBS.id.not_in(list(exclude)))
            .order_by(_QUEUE.c.place)
            .limit(limit)
        )
        return self._jobs(query)

    def queue_position(self, job: Job) -> int:
        """Return how many jobs will be started before this one; 0 if it does not wait."""
        with reading(self.engine) as connection:
            place = connection.execute(_PLACE, {"job_id": job.id}).scalar()
        return int(place or 1) - 1

    def queue_positions(self) -> dict[str, int]:
        """Return the `queue_position` of every waiting job, by id."""
        with reading(self.engine) as connection:
            rows = connection.execute(select(_QUEUE.c.id, _QUEUE.c.place)).all()
        return {job_id: place - 1 for job_id, place in rows}

    # Changing

    def apply(self, job_id: str, event: Event) -> Job | None:
        """Apply `event` to a job.

        The transaction that ends a job also records the notifications to send.

        Returns
        -------
        Job or None
            The job afterwards; None if the job is gone or the event is stale.
        """
        with writing(self.engine) as connection:
            job = stored_job(connection, job_id, for_update=True)
            if job is None:
                return None
            try:
                after = advance(job, event)
            except Stale:
                return None
            before, row = to_row(job), to_row(after)
            changed = {name: value for name, value in row.items() if value != before[name]}
            if changed:  # an update without columns is no SQL
                connection.execute(update(tables.jobs).where(_JOBS.id == job_id).values(changed))
            if after.state.is_final:
                _note_deliveries(connection, after)
        return after

    def claim(self, job_id: str, at: float, worker: str) -> Job | None:
        """Start a job if it is still waiting; of several callers, one succeeds."""
        return self.apply(job_id, Claimed(at, worker))

    def beat(
        self,
        job_id: str,
        attempt: int,
        at: float,
        stage: str,
        fraction: float,
        eta_s: float | None,
    ) -> bool:
        """Record a heartbeat with progress; False: the worker has lost the job and must stop.

        The same as `apply` with `Progressed`, in one statement.
        """
        fraction = min(fraction, 1.0)
        stage = stage[: tables.LONGEST_STAGE]  # it may hold the name of a file
        statement = (
            update(tables.jobs)
            .where(_JOBS.id == job_id, _JOBS.state == "running", _JOBS.attempt == attempt)
            .values(
                stage=stage,
                progress=case((_JOBS.progress < fraction, fraction), else_=_JOBS.progress),
                eta_s=eta_s,
                heartbeat_at=at,
            )
        )
        return self._count(statement) > 0

    def silent(self, before: float) -> list[Job]:
        """Return the running jobs whose last heartbeat was before a time."""
        heard = func.coalesce(_JOBS.heartbeat_at, _JOBS.started_at, 0.0)
        return self._jobs(select(tables.jobs).where(_JOBS.state == "running", heard < before))

    def hold_back_starts(self, before: float, after: float = math.inf) -> int:
        """Let unfinished jobs start no printer that were submitted before a time; count them.

        Likewise those submitted after the time `after`, by a clock that was set back since.
        """
        old = or_(_JOBS.created_at < before, _JOBS.created_at > after)
        waits = (_JOBS.state.not_in(OVER), _JOBS.print_after, ~_JOBS.held_back, old)
        return self._count(update(tables.jobs).where(*waits).values(held_back=True))

    # Deleting

    def forget(self, job_id: str) -> bool:
        """Delete a job in any state. Return whether it existed.

        If it is running, its worker's next report fails; the sweep deletes its files.
        """
        return self._count(delete(tables.jobs).where(_JOBS.id == job_id)) > 0

    # Leases

    def lease(self, name: str, holder: str, seconds: float, now: float) -> bool:
        """Take or renew a lease for work that only one process may do.

        Returns
        -------
        bool
            Whether `holder` has the lease until `seconds` from `now`.
        """
        row = {"name": name, "holder": holder, "expires_at": now + seconds}
        leases = tables.leases.c
        with writing(self.engine) as connection:
            statement = insert(connection, tables.leases).values(row)
            taken = statement.on_conflict_do_update(
                index_elements=["name"],
                set_=row,
                where=or_(
                    leases.holder == holder,
                    leases.expires_at <= now,
                    # From a holder whose clock was far ahead: it would not expire for too long.
                    leases.expires_at > now + _CLOCKS_APART * seconds,
                ),
            ).returning(leases.holder)
            return connection.execute(taken).first() is not None

    def release(self, name: str, holder: str, now: float) -> None:
        """Give a lease back, if `holder` has it."""
        leases = tables.leases.c
        mine = (leases.name == name, leases.holder == holder, leases.expires_at > now)
        self._count(update(tables.leases).where(*mine).values(expires_at=now))

    def leased_until(self, name: str) -> float:
        """Return when a lease ends or ended, in seconds since the epoch; 0: nobody had it."""
        leases = tables.leases.c
        with reading(self.engine) as connection:
            query = select(leases.expires_at).where(leases.name == name)
            return float(connection.execute(query).scalar() or 0.0)

    def identity(self) -> str:
        """Return the name of this database, which is random and stays."""
        row = {"name": _IDENTITY, "holder": uuid.uuid4().hex, "expires_at": 0.0}
        query = select(tables.leases.c.holder).where(tables.leases.c.name == _IDENTITY)
        with reading(self.engine) as connection:
            known = connection.execute(query).scalar()
        if known is None:
            with writing(self.engine) as connection:
                named = insert(connection, tables.leases).values(row).on_conflict_do_nothing()
                connection.execute(named)
                known = connection.execute(query).scalar_one()
        return str(known)

    # Private

    def _jobs(self, query: Select[Any], values: Mapping[str, Any] | None = None) -> list[Job]:
        with reading(self.engine) as connection:
            return [from_row(row) for row in connection.execute(query, values or {})]

    def _count(self, statement: Any) -> int:
        with writing(self.engine) as connection:
            result: CursorResult[Any] = connection.execute(statement)
            return result.rowcount


def _note_deliveries(connection: Connection, job: Job) -> None:
    due = {"webhook": job.webhook}
    if job.state is JobState.DONE:
        due["printer"] = job.printer
    for kind, target in due.items():
        if target is not None:
            # A restore has held it back where there is one already.
            connection.execute(
                insert(connection, tables.deliveries)
                .values(
                    job_id=job.id,
                    kind=kind,
                    target=target,
                    state="waiting",
                    attempts=0,
                    next_at=job.finished_at,
                )
                .on_conflict_do_nothing()
            )


def _to_cursor(job: Job) -> str:
    content = json.dumps([job.created_at, job.id], separators=(",", ":"))
    return base64.urlsafe_b64encode(content.encode()).decode().rstrip("=")


def _from_cursor(cursor: str) -> Sequence[Any]:
    try:
        padded = cursor.encode("ascii") + b"=" * (-len(cursor) % 4)
        created_at, job_id = json.loads(base64.urlsafe_b64decode(padded))
        if type(created_at) not in (float, int) or type(job_id) is not str:
            raise ValueError
        if not (math.isfinite(created_at) and job_id.isascii() and job_id.isalnum()):
            raise ValueError  # not all databases take all texts and numbers
        return float(created_at), job_id
    except (ValueError, TypeError, OverflowError):
        raise BadCursor(
            f"cursor {cursor!r:.80} is not one of a page; begin without a cursor"
        ) from None
