"""Access to the database: one transaction per `with` block of `reading` or `writing`."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar, cast

from sqlalchemy import Connection, Engine

from stillpath.service.database.errors import DatabaseAway, shown, translated

if TYPE_CHECKING:
    from sqlalchemy import Table

_T = TypeVar("_T")

__all__ = ["BUSY_TIMEOUT_MS", "insert", "reading", "write_together", "writing"]

BUSY_TIMEOUT_MS = 30_000
"""How long a writer waits for the others, in this process and elsewhere."""
_WRITER = threading.Lock()
_WRITE_QUEUE: deque[_PendingWrite] = deque()
"""Pending writes of `write_together`."""


@contextmanager
def writing(engine: Engine) -> Iterator[Connection]:
    """Yield a connection for one transaction, which is rolled back if the block raises.

    Raises
    ------
    DatabaseAway
    """
    with _write_lock(engine), translated(engine), engine.begin() as connection:
        yield connection


def write_together(engine: Engine, work: Callable[[Connection], _T]) -> _T:
    """Return what `work` returns, done in a transaction that others may share (group commit).

    SQLite serialises writes, and each waits for the disk. So the first thread also executes the
    pending work of all others, each rolled back separately if it raises, and waits for the disk
    once. On PostgreSQL every call has its own transaction.

    Raises
    ------
    DatabaseAway
        Then nothing may have been written, or all.
    """
    if engine.dialect.name != "sqlite":
        with writing(engine) as connection:
            return work(connection)
    mine = _PendingWrite(engine, work)
    _WRITE_QUEUE.append(mine)
    try:
        with _write_lock(engine):
            if not mine.over.is_set():
                _commit_group(engine)
    except DatabaseAway:
        if _dequeue(mine):
            raise
        mine.over.wait()  # another thread is executing it: wait for the outcome
    finally:
        _dequeue(mine)
    if mine.error is not None:
        raise mine.error
    return cast("_T", mine.result)


@contextmanager
def reading(engine: Engine) -> Iterator[Connection]:
    """Yield a connection for reading; writers do not wait for it.

    Raises
    ------
    DatabaseAway
    """
    with (
        translated(engine),
        engine.execution_options(stillpath_reading=True).begin() as connection,
    ):
        yield connection


def insert(connection: Connection, table: Table) -> Any:
    """Return an INSERT that knows ``on_conflict_do_nothing`` and ``on_conflict_do_update``."""
    # Import only one of them: SQLAlchemy's PostgreSQL dialects load slowly.
    if connection.dialect.name == "postgresql":
        from sqlalchemy.dialects import postgresql

        return postgresql.insert(table)
    from sqlalchemy.dialects import sqlite

    return sqlite.insert(table)


@dataclass(eq=False, slots=True)
class _PendingWrite:
    """The pending write of a thread, and its outcome."""

    engine: Engine
    work: Callable[[Connection], Any]
    over: threading.Event = field(default_factory=threading.Event)
    result: Any = None
    error: BaseException | None = None

    def run(self, connection: Connection) -> None:
        try:
            with translated(self.engine), connection.begin_nested():
                self.result = self.work(connection)
        except Exception as error:  # belongs to its owner, not to the executing thread
            self.error = error
            if not _is_open(connection):
                raise  # SQLite has undone the others' as well


def _dequeue(write: _PendingWrite) -> bool:
    """Remove a write from the queue; False if it was already taken."""
    try:
        _WRITE_QUEUE.remove(write)
    except ValueError:
        return False
    return True


def _is_open(connection: Connection) -> bool:
    """Return whether SQLite's transaction is; it ends one by itself when the disk is full."""
    driver: Any = connection.connection.dbapi_connection
    return bool(driver.in_transaction)


def _commit_group(engine: Engine) -> None:
    # Skip writes that their owners are withdrawing.
    pending = [write for write in _WRITE_QUEUE.copy() if write.engine is engine and _dequeue(write)]
    try:
        with translated(engine), engine.begin() as connection:
            for write in pending:
                write.run(connection)
    except BaseException as error:
        for write in pending:
            write.error = error
        if not isinstance(error, Exception):
            raise
    finally:
        for write in pending:
            write.over.set()


@contextmanager
def _write_lock(engine: Engine) -> Iterator[None]:
    """Queue the writers of this process fairly: SQLite's own waiting starves some."""
    if engine.dialect.name != "sqlite":
        yield
        return
    if not _WRITER.acquire(timeout=BUSY_TIMEOUT_MS / 1000):
        raise DatabaseAway(
            f"the database {shown(engine)} is not free after {BUSY_TIMEOUT_MS / 1000:g} s; "
            "see whether its disk still answers"
        )
    try:
        yield
    finally:
        _WRITER.release()
