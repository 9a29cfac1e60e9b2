"""Open the database, and migrate its schema."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, Engine, create_engine, event, func, inspect, select, text
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError
from sqlalchemy.pool import NullPool

from stillpath.service.database.errors import DatabaseAway, StoreError, reason, shown
from stillpath.service.database.migrations import LATEST
from stillpath.service.database.transactions import BUSY_TIMEOUT_MS, reading, writing
from stillpath.service.instance_lock import is_half_restored
from stillpath.service.permissions import private_file, private_folder
from stillpath.service.storage.base import StorageError

if TYPE_CHECKING:
    from stillpath.service.settings import Settings

__all__ = ["SQLITE_FILE", "database_url", "make_engine", "migrate", "open_database"]

SQLITE_FILE = "stillpath.sqlite3"
"""In the data directory."""
_AGAIN_S = 0.02
_OPENED = "stillpath_opened"
# Advisory lock for schema changes; a number not used otherwise in the database.
_MIGRATION_LOCK = 0x57111_0000
_ON_POSTGRESQL: dict[str, Any] = {
    # A pooler such as PgBouncer may run the next statement on another connection to the server.
    "prepare_threshold": None,
    # A server that vanished is noticed before a worker counts as lost.
    "connect_timeout": 5,
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
    "tcp_user_timeout": 10_000,
}


def database_url(settings: Settings) -> URL:
    """Return where the database is.

    Raises
    ------
    StoreError
        If it is neither SQLite nor PostgreSQL.
    """
    if settings.database_url is None:
        return URL.create("sqlite", database=str(Path(settings.data_dir) / SQLITE_FILE))
    try:
        url = make_url(settings.database_url)
    except ArgumentError:
        raise StoreError(
            "STILLPATH_DATABASE_URL is not an address; write for instance "
            "postgresql+psycopg://user@host/stillpath"
        ) from None
    if url.drivername in ("postgres", "postgresql"):
        return url.set(drivername="postgresql+psycopg")
    if url.drivername not in ("postgresql+psycopg", "sqlite"):
        raise StoreError(
            f"STILLPATH_DATABASE_URL begins with {url.drivername}; possible are postgresql+psycopg "
            "and sqlite"
        )
    return url


def open_database(settings: Settings, *, pooled: bool = True) -> Engine:
    """Return the database with the schema of this version, made or migrated if need be.

    Several processes may do so at once. The caller closes it with ``dispose``; if it is not
    `pooled`, there is nothing to close, and every transaction opens a connection of its own.

    Raises
    ------
    StoreError
        If it cannot be reached, was written by a newer version, or is missing beside files of jobs.
    """
    url = database_url(settings)
    if url.get_backend_name() == "sqlite" and url.database:
        if is_half_restored(Path(settings.data_dir)):
            raise StoreError(
                f"a restore into {settings.data_dir} was broken off; run stillpath restore again"
            )
        if not _has_content(Path(url.database)):
            # Before SQLite deletes the log beside a database without content.
            _check_is_first_start(settings, url)
        _make_private(Path(url.database))
    engine = make_engine(url, pooled=pooled)
    try:
        migrate(engine, before_making=lambda: _check_is_first_start(settings, url))
    except DBAPIError as error:
        engine.dispose()
        raise StoreError(
            f"the database {shown(engine)} cannot be opened: {reason(error)}; "
            "check STILLPATH_DATABASE_URL and STILLPATH_DATA_DIR, or restore a backup"
        ) from error
    except BaseException:
        engine.dispose()
        raise
    return engine


def make_engine(url: URL, *, pooled: bool = True) -> Engine:
    """Return an engine for a database as it is, without a look at its schema."""
    pool: dict[str, Any] = (
        {"pool_size": 8, "max_overflow": 8} if pooled else {"poolclass": NullPool}
    )
    if url.get_backend_name() == "sqlite":
        engine = create_engine(url, **pool)
        event.listen(engine, "connect", _prepare_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
        return engine
    given = {name: value for name, value in _ON_POSTGRESQL.items() if name not in url.query}
    return create_engine(url, **pool, pool_pre_ping=True, connect_args=given)


def migrate(engine: Engine, *, before_making: Callable[[], None] = lambda: None) -> None:
    """Migrate the schema to this version in one transaction, also if several processes do so.

    Parameters
    ----------
    before_making : callable
        Called where there are no tables; may raise to prevent the creation of the tables.

    Raises
    ------
    StoreError
        If the database does not answer, or was written by a newer version.
    """
    with reading(engine) as connection:
        if _version(connection) == LATEST:
            return
    with writing(engine) as connection:
        _lock_schema(connection)
        if not inspect(connection).get_table_names():
            before_making()
            _make_schema(connection)
            return
    # Imported late: it is slow, and most starts have nothing to migrate.
    from alembic import command
    from alembic.config import Config
    from alembic.script import ScriptDirectory

    config = Config()
    config.set_main_option(
        "script_location", str(Path(__file__).parent / "migrations").replace("%", "%%")
    )
    with writing(engine) as connection:
        _lock_schema(connection)
        version = _version(connection)
        known = {script.revision for script in ScriptDirectory.from_config(config).walk_revisions()}
        if version is not None and version not in known:
            raise StoreError(
                f"the database {shown(engine)} has schema {version}, this version knows up to "
                f"{LATEST}: a newer Stillpath wrote it; install that one, or restore a backup from "
                "before"
            )
        config.attributes["connection"] = connection
        command.upgrade(config, "head")


def _has_content(file: Path) -> bool:
    return file.name.startswith(":") or (file.exists() and file.stat().st_size > 0)


def _check_is_first_start(settings: Settings, url: URL) -> None:
    """Refuse to make a database anew where there are files of jobs: the sweep would delete them."""
    from stillpath.service.storage.factory import open_storage

    if settings.storage_url is None and not settings.data_dir.exists():
        return
    with suppress(StorageError):  # a bucket may be made later than the service
        found = next(iter(open_storage(settings).list("jobs/")), None)
        if found is not None:
            raise StoreError(
                f"the database {url.database} is missing or empty, but the storage has files of "
                f"jobs ({found.key}), which would be deleted; put the database back, check "
                "STILLPATH_DATABASE_URL and STILLPATH_DATA_DIR, or restore a backup; to begin "
                "without these jobs, move the folder jobs out of the storage"
            )


def _make_private(file: Path) -> None:
    """Make the file of a database, readable by its owner only; SQLite gives its log the same mode.

    A folder that is there may be open to others: the command line keeps machines in it.
    """
    if not file.parent.exists():
        private_folder(file.parent)
    if not file.name.startswith(":"):
        private_file(file)


def _lock_schema(connection: Connection) -> None:
    if connection.dialect.name == "postgresql":  # SQLite has locked all
        connection.execute(select(func.pg_advisory_xact_lock(_MIGRATION_LOCK)))


def _make_schema(connection: Connection) -> None:
    """Create the current tables, and stamp the version like Alembic."""
    from stillpath.service.database.tables import metadata

    metadata.create_all(connection)
    connection.exec_driver_sql(
        "CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL, "
        "CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num))"
    )
    connection.execute(text("INSERT INTO alembic_version VALUES (:it)"), {"it": LATEST})


def _prepare_sqlite(connection: Any, record: Any) -> None:
    connection.isolation_level = None  # BEGIN is ours, below
    connection.execute(f"PRAGMA busy_timeout = {BUSY_TIMEOUT_MS}").close()
    _use_write_ahead_log(connection)
    for pragma in ("synchronous = FULL", "foreign_keys = ON"):
        connection.execute(f"PRAGMA {pragma}").close()
    _, _, name = connection.execute("PRAGMA database_list").fetchone()
    record.info[_OPENED] = name, _identity(name)


def _identity(name: str) -> tuple[int, int] | None:
    """Return which file has a name now; None if none has, or the database is in memory."""
    if not name:
        return None
    try:
        status = Path(name).stat()
    except FileNotFoundError:
        return None
    return status.st_dev, status.st_ino


def _use_write_ahead_log(connection: Any) -> None:
    # The first connection of all changes the file, and while others open it SQLite refuses at once
    # instead of waiting for them, whatever the timeout says.
    until = time.monotonic() + BUSY_TIMEOUT_MS / 1000
    while True:
        try:
            connection.execute("PRAGMA journal_mode = WAL").close()
        except sqlite3.OperationalError:
            if time.monotonic() > until:
                raise
            time.sleep(_AGAIN_S)
        else:
            return


def _begin_sqlite(connection: Connection) -> None:
    # A transaction that read first and then wants to write fails at once if somebody else wrote
    # meanwhile; one that says so at its beginning waits for its turn.
    name, opened = connection.info[_OPENED]
    if _identity(name) != opened:
        # SQLite would go on in the deleted file, and what is accepted there is lost.
        raise DatabaseAway(
            f"the database {shown(connection.engine)} was deleted or replaced while the service "
            "ran; put it back if need be, and start the service again"
        )
    is_reading = connection.get_execution_options().get("stillpath_reading", False)
    connection.exec_driver_sql("BEGIN" if is_reading else "BEGIN IMMEDIATE")


def _version(connection: Connection) -> str | None:
    if not inspect(connection).has_table("alembic_version"):
        return None
    return connection.execute(text("SELECT version_num FROM alembic_version")).scalar()
