"""The record of jobs, in SQLite or PostgreSQL. Files lie elsewhere (`service.storage`).

Every change of a job goes through `service.jobs.state.advance` in one transaction; only `beat`,
which every worker sends twice a second, is a single statement of the same meaning.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from sqlalchemy import (
    Connection,
    CursorResult,
    Engine,
    Row,
    Select,
    Subquery,
    and_,
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
from stillpath.service.database.engine import insert, reading, write_together, writing
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

__all__ = [
    "BadCursor",
    "IdempotencyConflict",
    "JobStore",
    "Page",
    "Quota",
    "QuotaExceeded",
    "SpaceExceeded",
]

_JOBS = tables.jobs.c
_FIELDS = tuple(field.name for field in fields(Job))
_NOT_OVER = tuple(state.value for state in JobState if not state.is_final)
_OVER = tuple(state.value for state in JobState if state.is_final)
_SHORT = tuple(kind.value for kind in JobKind if kind.is_short)
_CLOCKS_APART = 12
"""A lease that lasts for longer than so many times what it may was taken before clocks were set."""


def _in_order() -> Subquery:
    """Return id and place, from 1, of every waiting job in the order of dispatch.

    Short jobs stand in a line of their own.
    """
    is_short = case((_JOBS.kind.in_(_SHORT), 1), else_=0).label("is_short")
    # Of one owner, what is asked about a job that is done comes before further files.
    is_file = case((_JOBS.kind == "compensation", 1), else_=0).label("is_file")
    present = (
        select(
            _JOBS.id,
            _JOBS.owner,
            _JOBS.state,
            _JOBS.priority,
            _JOBS.created_at,
            is_short,
            is_file,
        )
        .where(_JOBS.state.in_(_NOT_OVER))
        .subquery("present")
    )
    job = present.c
    running = (
        select(job.owner, job.is_short, func.count().label("jobs"))
        .where(job.state == "running")
        .group_by(job.owner, job.is_short)
        .subquery("running")
    )
    own_turn = func.row_number().over(
        partition_by=(job.owner, job.is_short),
        order_by=(job.priority.desc(), job.is_file, job.created_at, job.id),
    )
    turn = (own_turn + func.coalesce(running.c.jobs, 0)).label("turn")
    waiting = (
        select(job.id, job.created_at, job.priority, job.is_short, turn)
        .outerjoin_from(
            present,
            running,
            and_(running.c.owner == job.owner, running.c.is_short == job.is_short),
        )
        .where(job.state == "queued")
        .subquery("waiting")
    )
    row = waiting.c
    order = (row.priority.desc(), row.turn, row.created_at, row.id)
    place = func.row_number().over(partition_by=row.is_short, order_by=order).label("place")
    return select(row.id, row.is_short, place).subquery("queue")


# Statements of every upload and every look of the reconciler are made once: to put one together
# takes longer than to execute it.
_QUEUE = _in_order()
_PLACE = select(_QUEUE.c.place).where(_QUEUE.c.id == bindparam("job_id"))
_GET = select(tables.jobs).where(_JOBS.id == bindparam("job_id"))
_IN_STATE = (
    select(tables.jobs)
    .where(_JOBS.state == bindparam("wanted"))
    .order_by(_JOBS.created_at, _JOBS.id)
)
_SAME = (
    select(tables.jobs)
    .where(_JOBS.owner == bindparam("owner"), _JOBS.dedupe_key == bindparam("key"))
    .where(_JOBS.state.in_(("done", *_NOT_OVER)))
    .order_by(
        case({"done": 0, "running": 1, "queued": 2}, value=_JOBS.state),
        _JOBS.created_at.desc(),
        _JOBS.id.desc(),
    )
    .limit(1)
)
_USAGE = select(
    func.count().filter(_JOBS.state.in_(_NOT_OVER)),
    func.sum(_JOBS.source_bytes + func.coalesce(_JOBS.output_bytes, 0)),
).where(_JOBS.owner == bindparam("owner"))
_ADD, _ADD_AUDIT = tables.jobs.insert(), tables.audit.insert()


@dataclass(frozen=True, slots=True)
class Quota:
    """What one owner may have: jobs that are not over, and bytes of all jobs that are kept."""

    max_jobs: int
    max_bytes: int


class QuotaExceeded(Exception):
    """The owner has too many jobs already."""


class SpaceExceeded(QuotaExceeded):
    """The owner keeps too many bytes already."""


class IdempotencyConflict(Exception):
    """The idempotency key was used before, with another request."""


class BadCursor(ValueError):
    """The cursor is not one that a page gave."""


@dataclass(frozen=True, slots=True)
class Page:
    """Some jobs of a list, newest first, and where the next ones begin (None: the list ends)."""

    jobs: list[Job]
    next_cursor: str | None


class JobStore:
    """The jobs in a database; safe to use from several threads, processes and computers.

    Parameters
    ----------
    engine : sqlalchemy.Engine
        From `service.database.engine.open_database`; whoever opened it closes it.

    Notes
    -----
    Every method raises `service.database.engine.DatabaseAway` if the database does not answer.
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
        """Remember a new job, whose input must be stored already.

        Parameters
        ----------
        job : Job
        idempotency : (key, fingerprint), optional
            The caller's key, and a digest of the request that came with it.
        limits : Quota, optional
        shared : bool
            Whether a job that `find_same` finds will do.
        audit_row : mapping, optional
            From `AuditLog.row`; written if the job is new, in the same transaction: disks are slow.

        Returns
        -------
        Job
            `job`, or the one that the same request led to before, or the shared one.

        Raises
        ------
        IdempotencyConflict
            If the key is known with another fingerprint.
        QuotaExceeded
        """

        def add(connection: Connection) -> Job:
            if idempotency is not None:
                earlier = _earlier(connection, job, *idempotency)
                if earlier is not None:
                    return earlier
            if shared or limits is not None:
                _stand_in_line(connection, job.owner)
            same = _same(connection, job.owner, job.dedupe_key) if shared else None
            if same is not None:
                if idempotency is not None:
                    _lead_to(connection, job.owner, idempotency[0], {"job_id": same.id})
                return same
            if limits is not None:
                _check_quota(connection, job, limits)
            connection.execute(_ADD, _to_row(job))
            if audit_row is not None:
                connection.execute(_ADD_AUDIT, dict(audit_row))
            return job

        return write_together(self.engine, add)

    def submitted(self, owner: str, idempotency_key: str) -> tuple[str, Job | None] | None:
        """Return the fingerprint that came with a key, and its job unless that was deleted."""
        with reading(self.engine) as connection:
            row = connection.execute(_submission(owner, idempotency_key)).one_or_none()
            return row and (row.fingerprint, _get(connection, row.job_id))

    def find_same(self, owner: str, dedupe_key: str) -> Job | None:
        """Return the owner's newest job of a dedupe key: one that is done, else under way."""
        with reading(self.engine) as connection:
            return _same(connection, owner, dedupe_key)

    # Looking

    def get(self, job_id: str, owner: str | None = None) -> Job | None:
        """Return a job, of this owner if one is given, or None."""
        with reading(self.engine) as connection:
            job = _get(connection, job_id)
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
    ) -> Page:
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
        return Page(found[:limit], _to_cursor(found[limit - 1]) if more else None)

    def in_state(self, state: JobState) -> list[Job]:
        """Return all jobs in a state, oldest first."""
        return self._jobs(_IN_STATE, {"wanted": state.value})

    def counts(self) -> dict[JobState, int]:
        """Return how many jobs are in each state."""
        with reading(self.engine) as connection:
            rows = connection.execute(select(_JOBS.state, func.count()).group_by(_JOBS.state)).all()
        return dict.fromkeys(JobState, 0) | {JobState(state): count for state, count in rows}

    def oldest_queued_at(self) -> float | None:
        """Return when the job was submitted that has been waiting for the longest time."""
        with reading(self.engine) as connection:
            return connection.execute(
                select(func.min(_JOBS.created_at)).where(_JOBS.state == "queued")
            ).scalar()

    def waiting_for_room(self) -> tuple[int, int]:
        """Return how many jobs wait for room on the disk, and the most that one of them needs."""
        query = select(func.count(), func.max(_JOBS.room_bytes)).where(
            _JOBS.state == "queued", _JOBS.stage == WAITING_FOR_ROOM
        )
        with reading(self.engine) as connection:
            jobs, most = connection.execute(query).one()
        return int(jobs), int(most or 0)

    def ended_between(self, after: float, until: float) -> list[Job]:
        """Return the jobs that ended after a time and not later than another."""
        ended = (_JOBS.finished_at > after, _JOBS.finished_at <= until)
        return self._jobs(select(tables.jobs).where(_JOBS.state.in_(_OVER), *ended))

    def usage(self, owner: str) -> tuple[int, int]:
        """Return how many jobs of an owner are not over, and the bytes of all that are kept."""
        with reading(self.engine) as connection:
            return _usage(connection, owner)

    # The queue

    def next_queued(
        self, limit: int, *, short: bool = False, exclude: Collection[str] = ()
    ) -> list[Job]:
        """Return waiting jobs, short ones or the others, in the order of their start.

        Higher priority first; then owners take turns, where a job that runs was its owner's turn;
        then the older first. Jobs to `exclude` take their owners' turns but are not returned.
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
        """Let `event` happen to a job.

        The transaction that ends a job also notes down who is to be told of it.

        Returns
        -------
        Job or None
            The job afterwards; None if the job is gone, or it is too late for the event.
        """
        with writing(self.engine) as connection:
            job = _get(connection, job_id, for_update=True)
            if job is None:
                return None
            try:
                after = advance(job, event)
            except Stale:
                return None
            before, row = _to_row(job), _to_row(after)
            changed = {name: value for name, value in row.items() if value != before[name]}
            connection.execute(update(tables.jobs).where(_JOBS.id == job_id).values(changed))
            if after.state.is_final:
                _note_deliveries(connection, after)
        return after

    def claim(self, job_id: str, at: float, worker: str) -> Job | None:
        """Start a job unless it no longer waits; of several callers one gets it."""
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
        """Say that a worker lives and how far it is; False: it has lost the job and must stop.

        The same as `apply` with `Progressed`, in one statement.
        """
        fraction = min(fraction, 1.0)
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
        """Return the running jobs whose worker was last heard of before a time."""
        heard = func.coalesce(_JOBS.heartbeat_at, _JOBS.started_at, 0.0)
        return self._jobs(select(tables.jobs).where(_JOBS.state == "running", heard < before))

    # Deleting

    def forget(self, job_id: str) -> bool:
        """Drop a job in whatever state. Return whether it existed.

        If it runs, its worker's next report fails; its files go with the sweep.
        """
        return self._count(delete(tables.jobs).where(_JOBS.id == job_id)) > 0

    # Leases

    def lease(self, name: str, holder: str, seconds: float, now: float) -> bool:
        """Take or renew the right to do what only one process may do.

        Returns
        -------
        bool
            Whether `holder` has it until `seconds` from `now`.
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
                    # Of a holder whose clock was far ahead: nobody could wait for that.
                    leases.expires_at > now + _CLOCKS_APART * seconds,
                ),
            ).returning(leases.holder)
            return connection.execute(taken).first() is not None

    def release(self, name: str, holder: str) -> None:
        """Give a lease back, if `holder` has it."""
        leases = tables.leases.c
        self._count(delete(tables.leases).where(leases.name == name, leases.holder == holder))

    # Private

    def _jobs(self, query: Select[Any], values: Mapping[str, Any] | None = None) -> list[Job]:
        with reading(self.engine) as connection:
            return [_from_row(row) for row in connection.execute(query, values or {})]

    def _count(self, statement: Any) -> int:
        with writing(self.engine) as connection:
            result: CursorResult[Any] = connection.execute(statement)
            return result.rowcount


def _get(connection: Connection, job_id: str, *, for_update: bool = False) -> Job | None:
    # SQLite needs no lock of a row: its transaction has locked the database.
    query = _GET.with_for_update() if for_update else _GET
    row = connection.execute(query, {"job_id": job_id}).one_or_none()
    return None if row is None else _from_row(row)


def _submission(owner: str, key: str) -> Select[Any]:
    row = tables.submissions.c
    return select(tables.submissions).where(row.owner == owner, row.idempotency_key == key)


def _earlier(connection: Connection, job: Job, key: str, fingerprint: str) -> Job | None:
    """Return the job of the same request, or note down that `job` is the first one."""
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
    known = connection.execute(_submission(job.owner, key).with_for_update()).one()
    if known.fingerprint != fingerprint:
        raise IdempotencyConflict(
            f"the idempotency key {key!r:.80} came before with another request; take a new key for "
            "a new request"
        )
    earlier = _get(connection, known.job_id)
    if earlier is None:  # deleted meanwhile: the request counts anew
        _lead_to(connection, job.owner, key, row)
    return earlier


def _lead_to(connection: Connection, owner: str, key: str, values: dict[str, Any]) -> None:
    """Let the request of an idempotency key lead to another job."""
    row = tables.submissions.c
    known = and_(row.owner == owner, row.idempotency_key == key)
    connection.execute(update(tables.submissions).where(known).values(values))


def _same(connection: Connection, owner: str, dedupe_key: str) -> Job | None:
    row = connection.execute(_SAME, {"owner": owner, "key": dedupe_key}).one_or_none()
    return None if row is None else _from_row(row)


def _stand_in_line(connection: Connection, owner: str) -> None:
    """Let submissions of one owner come one after the other, so that none overlooks another."""
    if connection.dialect.name == "postgresql":  # SQLite has locked all
        lock = text("SELECT pg_advisory_xact_lock(hashtextextended(:owner, 7))")
        connection.execute(lock, {"owner": owner})


def _usage(connection: Connection, owner: str) -> tuple[int, int]:
    jobs, size = connection.execute(_USAGE, {"owner": owner}).one()
    return int(jobs), int(size or 0)


def _check_quota(connection: Connection, job: Job, limits: Quota) -> None:
    jobs, size = _usage(connection, job.owner)
    if jobs >= limits.max_jobs:
        raise QuotaExceeded(
            f"{job.owner!r} has {jobs} jobs that are not over, the limit is {limits.max_jobs}; "
            "wait for some or cancel them"
        )
    if size + job.source_bytes > limits.max_bytes:
        raise SpaceExceeded(
            f"{job.owner!r} keeps {size} bytes and this upload has {job.source_bytes}, the limit "
            f"is {limits.max_bytes}; delete old jobs"
        )


def _note_deliveries(connection: Connection, job: Job) -> None:
    due = {"webhook": job.webhook}
    if job.state is JobState.DONE:
        due["printer"] = job.printer
    for kind, target in due.items():
        if target is not None:
            connection.execute(
                tables.deliveries.insert().values(
                    job_id=job.id,
                    kind=kind,
                    target=target,
                    state="waiting",
                    next_at=job.finished_at,
                )
            )


def _to_row(job: Job) -> dict[str, Any]:
    return asdict(job) | {"state": job.state.value, "kind": job.kind.value}


def _from_row(row: Row[Any]) -> Job:
    values = row._mapping
    named = {"state": JobState(values["state"]), "kind": JobKind(values["kind"])}
    return Job(**{name: values[name] for name in _FIELDS} | named)


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
