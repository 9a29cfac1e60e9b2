"""The dispatch order of waiting jobs: owners take turns, short jobs have their own queue."""

from __future__ import annotations

from sqlalchemy import Subquery, and_, case, func, select

from stillpath.service.database import tables
from stillpath.service.jobs.state import JobKind
from stillpath.service.jobs.stored_rows import NOT_OVER

__all__ = ["queue_order"]

_JOBS = tables.jobs.c
_SHORT = tuple(kind.value for kind in JobKind if kind.is_short)


def queue_order() -> Subquery:
    """Return id and place, from 1, of every waiting job in the order of dispatch.

    Short jobs have a separate queue.
    """
    is_short = case((_JOBS.kind.in_(_SHORT), 1), else_=0).label("is_short")
    # For one owner, requests about finished jobs come before further files.
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
        .where(_JOBS.state.in_(NOT_OVER))
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
