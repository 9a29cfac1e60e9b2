"""Expiry of jobs and idempotency keys, measured in running time of the service.

System clocks jump: a computer without a battery begins in 1970. Ages are therefore counted by the
sweep itself with the monotonic clock, and the sum is kept in the database. Time while no service
runs does not count, so expiry is late rather than early.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import CursorResult, Engine, and_, delete, or_, select, update

from stillpath.service.database import tables
from stillpath.service.database.transactions import insert, reading, writing
from stillpath.service.jobs.state import JobKind
from stillpath.service.jobs.stored_rows import OVER

__all__ = ["Expiry"]

_NAME = "sweep"


class Expiry:
    """The age of finished jobs and of idempotency keys.

    Notes
    -----
    Every method raises `service.database.errors.DatabaseAway` if the database does not answer.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    def passed(self, seconds: float) -> float:
        """Add elapsed time; return the total. New entries start at this total."""
        seen, jobs, submissions = tables.seen_time, tables.jobs, tables.submissions
        with writing(self._engine) as connection:
            statement = insert(connection, seen).values(name=_NAME, seconds=seconds)
            added = statement.on_conflict_do_update(
                index_elements=["name"], set_={"seconds": seen.c.seconds + seconds}
            ).returning(seen.c.seconds)
            now = float(connection.execute(added).scalar_one())
            connection.execute(
                update(jobs)
                .where(jobs.c.state.in_(OVER), jobs.c.kept_from_s.is_(None))
                .values(kept_from_s=now)
            )
            connection.execute(
                update(submissions)
                .where(submissions.c.kept_from_s.is_(None))
                .values(kept_from_s=now)
            )
        return now

    def old_jobs(self, before: float, answers_before: float | None = None) -> list[str]:
        """Return ids of jobs that had finished by a time, as counted by `passed`; oldest first.

        `answers_before` is the time for jobs other than compensations, if different.
        """
        row = tables.jobs.c
        is_old = row.kept_from_s < before
        if answers_before is not None:
            is_answer = row.kind != JobKind.COMPENSATION.value
            is_old = or_(is_old, and_(is_answer, row.kept_from_s < answers_before))
        query = select(row.id).where(row.state.in_(OVER), is_old)
        with reading(self._engine) as connection:
            return list(connection.execute(query.order_by(row.kept_from_s, row.id)).scalars())

    def forget_submissions(self, before: float) -> int:
        """Delete idempotency keys older than a time; return their number."""
        row = tables.submissions.c
        with writing(self._engine) as connection:
            result: CursorResult[Any] = connection.execute(
                delete(tables.submissions).where(row.kept_from_s < before)
            )
            return result.rowcount
