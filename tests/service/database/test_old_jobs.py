"""Data directories of version 0.1, which kept jobs in `jobs.sqlite3`."""

from __future__ import annotations

import hashlib
import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stillpath.applications.machines.resolve import PinnedMachine
from stillpath.models.store import load_machine
from stillpath.service.database.engine import StoreError, open_database
from stillpath.service.jobs.state import Job, JobState
from stillpath.service.jobs.store import JobStore
from stillpath.service.settings import Settings

ROOT = Path(__file__).resolve().parents[3]

# As version 0.1 made it.
SCHEMA = """
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
PRAGMA user_version = 1;
"""
ROWS = {
    "done": (1, "done", 1.0, None, None, 1500.0, 1600.0),
    "failed": (2, "failed", 0.4, None, '{"status": 422, "title": "No"}', 1500.0, 1600.0),
    "running": (1, "compensating", 0.5, 9.0, None, 1500.0, None),
    "queued": (0, "waiting", 0.0, None, None, None, None),
}
SOURCE, RESULT, REPORT = b"G1 X1\n" * 50, b"G1 X2\n" * 60, b"<html>"


def old_directory(data_dir: Path, copies: int = 1) -> sqlite3.Connection:
    """Write a data directory of version 0.1; what is in the log alone stays there until close."""
    data_dir.mkdir(exist_ok=True)
    connection = sqlite3.connect(data_dir / "jobs.sqlite3", isolation_level=None)
    connection.execute("PRAGMA journal_mode = WAL").fetchone()
    connection.executescript(SCHEMA)
    for n in range(copies):
        for state, (attempt, stage, progress, eta_s, problem, started, finished) in ROWS.items():
            job_id = hashlib.md5(f"{state}{n}".encode()).hexdigest()
            folder = data_dir / "jobs" / job_id
            (folder / "source").mkdir(parents=True)
            (folder / "source" / "part.gcode").write_bytes(SOURCE)
            PinnedMachine(machine=load_machine("ender3")).write(folder / "machine.json")
            if state == "done":
                (folder / "result").mkdir()
                (folder / "result" / "part.out.gcode").write_bytes(RESULT)
                (folder / "report").mkdir()
                (folder / "report" / "report.html").write_bytes(REPORT)
            row = (job_id, "ender3", '{"method": "fbf"}', "part.gcode", "part.out.gcode", 300)
            row += (1000.0 + n, state, attempt, attempt // 2, stage, progress, eta_s, problem)
            row += (started, finished)
            marks = ", ".join("?" * len(row))
            connection.execute(f"INSERT INTO jobs VALUES ({marks})", row)
    return connection


def jobs_of(data_dir: Path) -> dict[JobState, list[Job]]:
    engine = open_database(Settings(data_dir=data_dir))
    store = JobStore(engine)
    found = {state: store.in_state(state) for state in JobState}
    engine.dispose()
    return found


def test_old_jobs_go_on(tmp_path: Path):
    old_directory(tmp_path).close()
    found = jobs_of(tmp_path)
    assert {state.value: len(jobs) for state, jobs in found.items()} == {
        **dict.fromkeys(ROWS, 1),
        "cancelled": 0,
    }
    (done,), (failed,) = found[JobState.DONE], found[JobState.FAILED]
    assert done.owner == "local"
    assert (done.machine, done.machine_revision) == ("ender3", load_machine("ender3").revision)
    assert done.options == {"method": "fbf"}
    assert done.source_sha256 == hashlib.sha256(SOURCE).hexdigest()
    assert done.output == f"jobs/{done.id}"
    assert (tmp_path / done.output / "result" / done.result_name).read_bytes() == RESULT
    assert done.result_sha256 == hashlib.sha256(RESULT).hexdigest()
    assert done.result_bytes == len(RESULT)
    assert done.output_bytes == len(RESULT) + len(REPORT)
    assert (done.created_at, done.started_at, done.finished_at) == (1000.0, 1500.0, 1600.0)
    assert (failed.problem, failed.output) == ({"status": 422, "title": "No"}, None)
    assert (failed.attempt, failed.losses) == (2, 1)
    assert found[JobState.RUNNING][0].attempt == 1
    left = sorted(path.name for path in tmp_path.glob("jobs.*"))
    assert left == ["jobs.sqlite3.imported"]


def test_what_was_deleted_since_does_not_come_back(tmp_path: Path):
    old_directory(tmp_path).close()
    (done,) = jobs_of(tmp_path)[JobState.DONE]
    engine = open_database(Settings(data_dir=tmp_path))
    JobStore(engine).forget(done.id)
    engine.dispose()
    assert jobs_of(tmp_path)[JobState.DONE] == []


def test_killed_between_copy_and_name(tmp_path: Path):
    old_directory(tmp_path).close()
    before = jobs_of(tmp_path)
    (tmp_path / "jobs.sqlite3.imported").rename(tmp_path / "jobs.sqlite3")
    assert jobs_of(tmp_path) == before
    assert not (tmp_path / "jobs.sqlite3").exists()


def test_rows_that_only_the_log_holds(tmp_path: Path):
    """As a service leaves it that was killed."""
    open_elsewhere = old_directory(tmp_path)
    copy = tmp_path / "copy"
    copy.mkdir()
    for file in tmp_path.glob("jobs.sqlite3*"):
        (copy / file.name).write_bytes(file.read_bytes())
    open_elsewhere.close()
    assert (copy / "jobs.sqlite3-wal").stat().st_size > 0
    assert sum(len(jobs) for jobs in jobs_of(copy).values()) == 4
    assert sorted(path.name for path in copy.glob("jobs.*")) == ["jobs.sqlite3.imported"]


def test_files_that_are_gone(tmp_path: Path):
    """A job without its result is not one that has one; the rest is taken over."""
    old_directory(tmp_path).close()
    for file in (tmp_path / "jobs").rglob("*.*"):
        file.unlink()
    (done,) = jobs_of(tmp_path)[JobState.DONE]
    assert (done.output, done.source_sha256, done.machine_revision) == (None, "", "")


def test_an_empty_one(tmp_path: Path):
    sqlite3.connect(tmp_path / "jobs.sqlite3").close()
    (tmp_path / "jobs.sqlite3").touch()
    assert sum(len(jobs) for jobs in jobs_of(tmp_path).values()) == 0


@pytest.mark.parametrize("damage", ["version", "bytes"])
def test_one_that_cannot_be_read(tmp_path: Path, damage: str):
    file = tmp_path / "jobs.sqlite3"
    connection = old_directory(tmp_path)
    if damage == "version":
        connection.execute("PRAGMA user_version = 7")
    connection.close()
    if damage == "bytes":
        file.write_bytes(b"no database at all " * 99)
    content = file.read_bytes()
    for _ in range(2):
        with pytest.raises(StoreError, match=r"jobs\.sqlite3: .*move"):
            open_database(Settings(data_dir=tmp_path))
    assert file.read_bytes() == content


@pytest.mark.slow
def test_kills_at_any_moment(tmp_path: Path):
    old_directory(tmp_path, copies=60).close()
    code = (
        "import sys; from pathlib import Path; from stillpath.service.settings import Settings; "
        "from stillpath.service.database.engine import open_database; print('go', flush=True); "
        "open_database(Settings(data_dir=Path(sys.argv[1]))).dispose()"
    )
    chance = random.Random(3)
    for _ in range(4):
        starting = subprocess.Popen(
            [sys.executable, "-c", code, str(tmp_path)],
            stdout=subprocess.PIPE,
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        )
        assert starting.stdout is not None
        starting.stdout.readline()
        time.sleep(1.5 * chance.random())
        starting.send_signal(signal.SIGKILL)
        starting.wait()
        starting.stdout.close()
    found = jobs_of(tmp_path)
    assert [len(found[JobState(state)]) for state in ROWS] == [60] * 4
