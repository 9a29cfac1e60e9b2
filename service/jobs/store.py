"""What the service remembers: jobs in SQLite, files in one folder per job."""

from __future__ import annotations

import json
import shutil
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from service.jobs.state import Claimed, Event, Job, JobState, Stale, advance

__all__ = ["JobFiles", "JobStore"]

_SCHEMA = """
CREATE TABLE IF NOT EXISTS jobs (
    id           TEXT PRIMARY KEY,
    machine      TEXT NOT NULL,
    options      TEXT NOT NULL,
    source_name  TEXT NOT NULL,
    result_name  TEXT NOT NULL,
    source_bytes INTEGER NOT NULL,
    created_at   REAL NOT NULL,
    state        TEXT NOT NULL,
    attempt      INTEGER NOT NULL,
    losses       INTEGER NOT NULL,
    stage        TEXT NOT NULL,
    progress     REAL NOT NULL,
    eta_s        REAL,
    problem      TEXT,
    started_at   REAL,
    finished_at  REAL
);
CREATE INDEX IF NOT EXISTS jobs_by_state ON jobs (state, created_at);
"""
_SCHEMA_VERSION = 1
_COLUMNS = tuple(field.name for field in fields(Job))
_AS_JSON = ("options", "problem")


class JobFiles:
    """Where the files of one job lie.

    Parameters
    ----------
    root : Path
        Folder of all jobs.
    job_id : str
    """

    def __init__(self, root: Path, job_id: str) -> None:
        self.folder = root / job_id

    def source(self, name: str) -> Path:
        """Return the place of the uploaded file."""
        return self.folder / "source" / name

    @property
    def machine(self) -> Path:
        """Machine that the job was accepted with (`service.machines.resolve.PinnedMachine`)."""
        return self.folder / "machine.json"

    def result(self, name: str) -> Path:
        """Return the place of the written file."""
        return self.folder / "result" / name

    @property
    def report(self) -> Path:
        """Folder of report.html and report.json."""
        return self.folder / "report"


class JobStore:
    """Jobs on disk; safe to use from several threads of one process.

    Every change of a job goes through `service.jobs.state.advance` inside one transaction.

    Parameters
    ----------
    data_dir : Path
        Made if it does not exist.

    Raises
    ------
    sqlite3.DatabaseError
        If the database cannot be opened or is of another version.
    """

    def __init__(self, data_dir: Path) -> None:
        self.jobs_dir = data_dir / "jobs"
        self.incoming_dir = data_dir / "incoming"
        self.cache_dir = data_dir / "cache"
        for folder in (self.jobs_dir, self.incoming_dir, self.cache_dir):
            folder.mkdir(parents=True, exist_ok=True)
        self._lock = threading.RLock()
        self._connection = sqlite3.connect(
            data_dir / "jobs.sqlite3", isolation_level=None, check_same_thread=False, timeout=30.0
        )
        self._connection.row_factory = sqlite3.Row
        self._connection.execute("PRAGMA journal_mode = WAL")
        self._connection.execute("PRAGMA synchronous = FULL")
        self._migrate()

    def close(self) -> None:
        """Close the database."""
        with self._lock:
            self._connection.close()

    def files(self, job_id: str) -> JobFiles:
        """Return where the files of a job lie."""
        return JobFiles(self.jobs_dir, job_id)

    def add(self, job: Job) -> None:
        """Remember a new job; its input must already be stored."""
        row = _to_row(job)
        names, marks = ", ".join(row), ", ".join("?" * len(row))
        with self._transaction() as connection:
            connection.execute(f"INSERT INTO jobs ({names}) VALUES ({marks})", tuple(row.values()))

    def get(self, job_id: str) -> Job | None:
        """Return a job, or None."""
        with self._lock:
            row = self._connection.execute("SELECT * FROM jobs WHERE id = ?", (job_id,)).fetchone()
        return None if row is None else _from_row(row)

    def in_state(self, state: JobState) -> list[Job]:
        """Return all jobs in a state, oldest first."""
        with self._lock:
            rows = self._connection.execute(
                "SELECT * FROM jobs WHERE state = ? ORDER BY created_at, id", (state.value,)
            ).fetchall()
        return [_from_row(row) for row in rows]

    def queue_position(self, job: Job) -> int:
        """Return how many jobs will be started before this one."""
        with self._lock:
            (count,) = self._connection.execute(
                "SELECT COUNT(*) FROM jobs WHERE state = ? AND (created_at, id) < (?, ?)",
                (JobState.QUEUED.value, job.created_at, job.id),
            ).fetchone()
        return int(count)

    def apply(self, job_id: str, event: Event) -> Job | None:
        """Let `event` happen to a job; return the new job, or None if it is too late for it."""
        with self._transaction() as connection:
            job = self.get(job_id)
            if job is None:
                return None
            try:
                job = advance(job, event)
            except Stale:
                return None
            row = _to_row(job)
            row.pop("id")
            places = ", ".join(f"{name} = ?" for name in row)
            connection.execute(f"UPDATE jobs SET {places} WHERE id = ?", (*row.values(), job_id))
        return job

    def claim(self, at: float) -> Job | None:
        """Start the oldest waiting job, or return None."""
        with self._transaction():
            waiting = self.in_state(JobState.QUEUED)
            return self.apply(waiting[0].id, Claimed(at)) if waiting else None

    def forget(self, job_id: str) -> bool:
        """Drop a job; its files go with `sweep`. Return whether it existed."""
        with self._transaction() as connection:
            return connection.execute("DELETE FROM jobs WHERE id = ?", (job_id,)).rowcount > 0

    def remove_files(self, job_id: str) -> None:
        """Delete what a forgotten job left on disk."""
        shutil.rmtree(self.files(job_id).folder, ignore_errors=True)

    def sweep(self) -> None:
        """Delete the files that belong to no job: broken uploads, forgotten jobs.

        Only at the start of the service, while nothing is being uploaded.
        """
        for leftover in self.incoming_dir.iterdir():
            leftover.unlink(missing_ok=True)
        for folder in self.jobs_dir.iterdir():
            if self.get(folder.name) is None:
                shutil.rmtree(folder, ignore_errors=True)

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._lock:
            if self._connection.in_transaction:  # nested: the outer one commits
                yield self._connection
                return
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield self._connection
            except BaseException:
                self._connection.execute("ROLLBACK")
                raise
            self._connection.execute("COMMIT")

    def _migrate(self) -> None:
        (version,) = self._connection.execute("PRAGMA user_version").fetchone()
        if version not in (0, _SCHEMA_VERSION):
            self._connection.close()
            raise sqlite3.DatabaseError(
                f"the job database has schema {version}, this version reads {_SCHEMA_VERSION}; "
                "use another data directory or the version that wrote it"
            )
        self._connection.executescript(_SCHEMA)
        self._connection.execute(f"PRAGMA user_version = {_SCHEMA_VERSION}")


def _to_row(job: Job) -> dict[str, Any]:
    row = asdict(job)
    row["state"] = job.state.value
    for name in _AS_JSON:
        row[name] = None if row[name] is None else json.dumps(row[name], sort_keys=True)
    return row


def _from_row(row: sqlite3.Row) -> Job:
    values = {name: row[name] for name in _COLUMNS}
    values["state"] = JobState(values["state"])
    for name in _AS_JSON:
        values[name] = None if values[name] is None else json.loads(values[name])
    return Job(**values)
