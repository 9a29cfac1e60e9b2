"""A database that goes away and comes back."""

from __future__ import annotations

import shutil
import signal
import sqlite3
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import text

from stillpath.service.database.engine import open_database
from stillpath.service.database.errors import DatabaseAway
from stillpath.service.database.transactions import reading
from stillpath.service.jobs.state import JobState
from stillpath.service.jobs.store import JobStore
from stillpath.service.settings import Settings
from tests.service.database.examples import finished, make_job
from tests.service.database.postgres import PostgresServer, running_server


@pytest.fixture
def server(postgres_server: PostgresServer) -> Iterator[PostgresServer]:
    """A server of the test's own; `postgres_server` only decides whether there can be one."""
    with running_server() as own:
        yield own


@pytest.mark.postgresql
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGQUIT], ids=["restart", "crash"])
def test_postgresql_comes_back(server: PostgresServer, tmp_path: Path, how: signal.Signals):
    engine = open_database(Settings(data_dir=tmp_path, database_url=server.new_database()))
    store = JobStore(engine)
    job = store.add(make_job())
    running = store.claim(job.id, 1500.0, "w")
    assert running is not None
    server.stop(how)
    with pytest.raises(DatabaseAway, match=r"127\.0\.0\.1:\d+/t\w+ does not answer"):
        store.beat(job.id, 1, 1501.0, "reading", 0.5, None)
    with pytest.raises(DatabaseAway):
        store.get(job.id)
    server.start()
    assert store.beat(job.id, 1, 1502.0, "reading", 0.5, None)
    assert store.apply(job.id, finished(running)) is not None
    assert store.counts()[JobState.DONE] == 1
    engine.dispose()


@pytest.mark.postgresql
def test_postgresql_that_takes_no_writes(postgres_url: str, tmp_path: Path):
    """As a standby after a change of the server, or a hosted one whose disk is full."""
    open_database(Settings(data_dir=tmp_path, database_url=postgres_url)).dispose()
    url = f"{postgres_url}?options=-c%20default_transaction_read_only%3Don"
    engine = open_database(Settings(data_dir=tmp_path, database_url=url))
    store = JobStore(engine)
    with pytest.raises(DatabaseAway, match="read-only transaction"):
        store.add(make_job())
    assert store.counts()[JobState.QUEUED] == 0
    with pytest.raises(DatabaseAway, match="takes no writes"):
        store.check()  # as /readyz does
    engine.dispose()


@pytest.mark.postgresql
def test_postgresql_behind_a_pooler(postgres_url: str, tmp_path: Path):
    """PgBouncer may run each transaction elsewhere: nothing may stay on a connection."""
    engine = open_database(Settings(data_dir=tmp_path, database_url=postgres_url))
    store = JobStore(engine)
    for _ in range(20):
        store.counts()
        store.check()
    with reading(engine) as connection:
        for kept in ("pg_prepared_statements", "pg_cursors", "pg_listening_channels()"):
            assert connection.scalar(text(f"SELECT count(*) FROM {kept}")) == 0
    engine.dispose()


def test_sqlite_that_is_damaged(tmp_path: Path):
    engine = open_database(Settings(data_dir=tmp_path))
    store = JobStore(engine)
    job = store.add(make_job())
    engine.dispose()  # its pages go from the log to the file
    file = tmp_path / "stillpath.sqlite3"
    file.write_bytes(b"rubbish " * (file.stat().st_size // 8))
    with pytest.raises(DatabaseAway, match=r"cannot be read: .*restore a backup"):
        store.get(job.id)
    engine.dispose()


@pytest.mark.skipif(sys.platform == "win32", reason="open files stay there")
@pytest.mark.parametrize("replaced", [False, True])
def test_sqlite_that_is_deleted_while_it_is_open_accepts_nothing(tmp_path: Path, replaced: bool):
    engine = open_database(Settings(data_dir=tmp_path))
    store = JobStore(engine)
    store.add(make_job())
    file = tmp_path / "stillpath.sqlite3"
    if replaced:
        shutil.copy(file, tmp_path / "copy")
        (tmp_path / "copy").replace(file)
    else:
        file.unlink()
    with pytest.raises(DatabaseAway, match="deleted or replaced while the service ran"):
        store.add(make_job())
    with pytest.raises(DatabaseAway, match="deleted or replaced while the service ran"):
        store.counts()
    engine.dispose()


def test_sqlite_kept_by_somebody_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("stillpath.service.database.engine.BUSY_TIMEOUT_MS", 50)
    engine = open_database(Settings(data_dir=tmp_path))
    store = JobStore(engine)
    job = store.add(make_job())
    other = sqlite3.connect(tmp_path / "stillpath.sqlite3", isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    with pytest.raises(DatabaseAway, match="locked"):
        store.claim(job.id, 1500.0, "w")
    assert store.get(job.id) == job  # readers do not wait
    other.close()
    assert store.claim(job.id, 1500.0, "w") is not None
    engine.dispose()
