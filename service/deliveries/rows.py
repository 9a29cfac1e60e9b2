"""The table of deliveries: what is due, who is sending it, and how it ended.

::

    waiting --claimed--> sending --> done
       ^                    |  +---> failed
       +---- tried again ---+

A claim lasts until `next_at` and is extended while sending; the number of attempts is its fencing
token. Several processes may send, each delivery is sent by one at a time, and one whose sender was
killed is resumed by another.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import Engine, Select, and_, case, or_, select, update

from stillpath.service.database.tables import deliveries, jobs
from stillpath.service.database.transactions import reading, writing
from stillpath.service.jobs.state import Job

__all__ = [
    "Delivery",
    "bring_forward",
    "claim",
    "deliveries_of",
    "is_behind",
    "overtaken",
    "prolong",
    "settle",
]

_AT_ONCE = 500


@dataclass(frozen=True, slots=True)
class Delivery:
    """One row.

    Attributes
    ----------
    kind : str
        ``webhook`` or ``printer``.
    target : str
        Address, or name of the printer.
    state : str
        ``waiting``, ``sending``, ``done`` or ``failed``.
    attempts : int
        How often it was begun.
    next_at : float
        Seconds since the epoch: when it is tried next, or until when its sender has claimed it.
    error : str or None
        Error of the last attempt.
    """

    id: int
    job_id: str
    kind: str
    target: str
    state: str
    attempts: int
    next_at: float
    error: str | None


def deliveries_of(engine: Engine, job_ids: Iterable[str]) -> dict[str, list[Delivery]]:
    """Return the deliveries of jobs, by their ids."""
    wanted = list(dict.fromkeys(job_ids))
    found: defaultdict[str, list[Delivery]] = defaultdict(list)
    for start in range(0, len(wanted), _AT_ONCE):
        query = (
            select(deliveries)
            .where(deliveries.c.job_id.in_(wanted[start : start + _AT_ONCE]))
            .order_by(deliveries.c.id)
        )
        with reading(engine) as connection:
            for row in connection.execute(query).mappings():
                found[row["job_id"]].append(Delivery(**row))
    return dict(found)


def claim(engine: Engine, *, now: float, until: float) -> tuple[Delivery, bool] | None:
    """Take the delivery that has been due for longest.

    Returns
    -------
    Delivery, bool
        As claimed; and whether an earlier attempt ended without an answer, so that it is unknown
        whether it arrived. None: nothing is due.
    """
    # What was never tried need not wait, whatever the clock said on the worker that recorded it.
    new = and_(deliveries.c.state == "waiting", deliveries.c.attempts == 0)
    due = (
        select(deliveries)
        .where(
            deliveries.c.state.in_(("waiting", "sending")), or_(new, deliveries.c.next_at <= now)
        )
        .order_by(deliveries.c.next_at, deliveries.c.id)
        .limit(1)
    )
    with reading(engine) as connection:
        row = connection.execute(due).mappings().first()
    if row is None:
        return None
    before = Delivery(**row)
    after = replace(before, state="sending", attempts=before.attempts + 1, next_at=until)
    if not _changed(engine, before, after):
        return None  # another process was faster; try again next time
    return after, before.state == "sending"


def overtaken(engine: Engine, claimed: Delivery, job: Job) -> str | None:
    """Return how far a later job is that brings the same printer a file of the same name.

    Later by its submission, and by its delivery's number unless it was done while this one waited
    or ran: of a clock that was set back, one time is wrong.

    Returns
    -------
    str or None
        ``done``, ``sending``, or None: there is no such job, or it is not being sent.
    """
    row = deliveries.c
    outran = jobs.c.finished_at <= job.finished_at
    later = (
        _rivals(claimed, job)
        .where(row.state.in_(("done", "sending")), jobs.c.created_at > job.created_at)
        .where(or_(row.id > claimed.id, outran))
        .order_by(row.state)
    )
    with reading(engine) as connection:
        return connection.execute(later).scalars().first()


def is_behind(engine: Engine, claimed: Delivery, job: Job, *, now: float) -> bool:
    """Return whether an earlier job's file of the same name is on its way to the same printer."""
    row = deliveries.c
    sending = (row.state == "sending", row.next_at > now)
    earlier = _rivals(claimed, job).where(*sending, jobs.c.created_at < job.created_at)
    with reading(engine) as connection:
        return connection.execute(earlier).first() is not None


def _rivals(claimed: Delivery, job: Job) -> Select[Any]:
    """Select the states of what else brings the same printer a file of the same name."""
    row = deliveries.c
    return (
        select(row.state)
        .join(jobs, jobs.c.id == row.job_id)
        .where(row.kind == "printer", row.target == claimed.target, row.id != claimed.id)
        .where(jobs.c.result_name == job.result_name)
    )


def bring_forward(engine: Engine, *, waiting: Sequence[float], sending: float) -> None:
    """Let nothing be due later than these times, because the clock was set back.

    Parameters
    ----------
    waiting : sequence of float
        Latest time after one attempt, two, ...; the last one also applies to more.
    sending : float
        A sender that is alive extends its claim before then.
    """
    row = deliveries.c
    latest = [(row.attempts <= k, at) for k, at in enumerate(waiting, 1)]
    due = case((row.state == "sending", sending), *latest, else_=waiting[-1])
    statement = update(deliveries).where(row.state.in_(("waiting", "sending")), row.next_at > due)
    with writing(engine) as connection:
        connection.execute(statement.values(next_at=due))


def prolong(engine: Engine, claimed: Delivery, *, until: float) -> bool:
    """Keep a claim; False: it is lost, or the job was deleted."""
    return _changed(engine, claimed, replace(claimed, next_at=until))


def settle(
    engine: Engine, claimed: Delivery, state: str, *, next_at: float, error: str | None = None
) -> bool:
    """Record the outcome of a claimed delivery; False: the claim is lost."""
    text = None
    if error is not None:
        # What receivers say may hold what databases refuse: half a character, and NUL.
        text = error[:2000].encode(errors="replace").decode().replace("\0", "?")
    return _changed(engine, claimed, replace(claimed, state=state, next_at=next_at, error=text))


def _changed(engine: Engine, before: Delivery, after: Delivery) -> bool:
    statement = (
        update(deliveries)
        .where(
            deliveries.c.id == before.id,
            deliveries.c.job_id == before.job_id,  # SQLite reuses the ids of deleted rows
            deliveries.c.state == before.state,
            deliveries.c.attempts == before.attempts,
        )
        .values(
            state=after.state, attempts=after.attempts, next_at=after.next_at, error=after.error
        )
    )
    with writing(engine) as connection:
        return connection.execute(statement).rowcount == 1
