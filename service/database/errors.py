"""Errors of the database in our words: what is wrong, and what to do."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sqlalchemy import Engine
from sqlalchemy.exc import DatabaseError, InterfaceError, InternalError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from stillpath.service.storage.disk import refuses_more

__all__ = ["DatabaseAway", "DatabaseFull", "StoreError", "reason", "shown", "translated"]

_READ_ONLY = "25006"
"""PostgreSQL's code of a server that takes no writes: a standby, or one whose disk is full."""
_IOERR = (sqlite3.SQLITE_IOERR_WRITE, sqlite3.SQLITE_IOERR_FSYNC, sqlite3.SQLITE_IOERR_SHMSIZE)


class StoreError(RuntimeError):
    """The database cannot be used; the message says what to do."""

    exit_code = 1


class DatabaseAway(StoreError):
    """The database does not respond, or not in time; a retry may help."""


class DatabaseFull(DatabaseAway):
    """There is no space for the database to write."""


@contextmanager
def translated(engine: Engine) -> Iterator[None]:
    """Raise our errors where SQLAlchemy raises those of a database that cannot be used.

    Raises
    ------
    DatabaseAway
    """
    try:
        yield
    except (OperationalError, InterfaceError, InternalError, PoolTimeout) as error:
        original = getattr(error, "orig", None)
        if isinstance(error, InternalError) and getattr(original, "sqlstate", None) != _READ_ONLY:
            raise  # a bug of ours
        code, file = getattr(original, "sqlite_errorcode", 0), Path(engine.url.database or "")
        # An exceeded quota is to SQLite an error like any other.
        beyond = code in _IOERR and refuses_more(file.parent)
        if code == sqlite3.SQLITE_FULL or beyond:
            raise DatabaseFull(
                f"the disk of the database {shown(engine)}, or a quota on it, is full; make room"
            ) from error
        raise DatabaseAway(
            f"the database {shown(engine)} does not answer: {reason(error)}; see whether it runs "
            "and has space left"
        ) from error
    except DatabaseError as error:
        if type(error) is not DatabaseError:
            raise  # a bug of ours
        raise DatabaseAway(
            f"the database {shown(engine)} cannot be read: {reason(error)}; check "
            "STILLPATH_DATABASE_URL and STILLPATH_DATA_DIR, or restore a backup"
        ) from error


def shown(engine: Engine) -> str:
    """Return where a database is, without its password."""
    return engine.url.render_as_string(hide_password=True)


def reason(error: Exception) -> str:
    """Return what the driver said, in one line."""
    original = getattr(error, "orig", None) or error
    return " ".join(str(original).split())
