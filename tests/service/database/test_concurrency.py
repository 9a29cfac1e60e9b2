"""Many at once, in threads and in processes: nothing happens twice, nothing is lost."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from functools import partial
from pathlib import Path

import pytest
from sqlalchemy import URL, Connection, Engine, select

from stillpath.service.database import tables
from stillpath.service.database.engine import make_engine, open_database
from stillpath.service.database.errors import DatabaseAway
from stillpath.service.database.transactions import reading, write_together, writing
from stillpath.service.jobs.state import Cancelled, Event, Failed, JobState, Lost
from stillpath.service.jobs.store import JobStore
from stillpath.service.jobs.submissions import Quota, QuotaExceeded
from stillpath.service.settings import Settings
from tests.checkout import PYTHONPATH
from tests.service.at_once import at_once
from tests.service.database.examples import finished, make_job, take_all

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def store(engine: Engine) -> JobStore:
    return JobStore(engine)


def test_many_first_starts_at_once(settings: Settings):
    engines = at_once(*[lambda: open_database(settings)] * 6)
    for engine in engines:
        assert isinstance(engine, Engine), engine
        assert JobStore(engine).counts()[JobState.QUEUED] == 0
        engine.dispose()


def test_no_job_is_taken_by_two_threads(store: JobStore):
    jobs = [store.add(make_job(owner=f"owner-{n % 3}")) for n in range(24)]
    taken = at_once(*[lambda n=n: take_all(store, f"worker-{n}") for n in range(8)])
    assert Counter(job_id for ids in taken for job_id in ids) == {job.id: 1 for job in jobs}  # type: ignore[attr-defined]


def test_a_job_ends_once(store: JobStore):
    """Reports, losses and cancels of one attempt, all at the same moment."""
    for _ in range(6):
        job = store.add(make_job(webhook="https://farm.example"))
        claimed = store.claim(job.id, 1500.0, "w")
        assert claimed is not None
        ends: list[Event] = [
            finished(claimed),
            Failed(1, 2000.0, {"status": 422}),
            Lost(1, 2000.0, "killed", 1),
            Cancelled(2000.0),
        ]
        results = at_once(*[lambda e=e: store.apply(job.id, e) for e in ends * 2])  # noqa: B023
        (after,) = [result for result in results if result is not None]
        assert store.get(job.id) == after
        assert not store.beat(job.id, 1, 2001.0, "reading", 0.5, None)


def test_one_of_many_gets_the_lease(store: JobStore):
    now = 1000.0
    for _ in range(5):
        results = at_once(
            *[
                lambda n=n, now=now: store.lease("reconciler", f"api-{n}", 5.0, now)
                for n in range(8)
            ]
        )
        assert sorted(results) == [False] * 7 + [True]  # type: ignore[type-var]
        now += 5.0


def test_the_same_request_many_times_at_once_is_one_job(store: JobStore):
    jobs = at_once(*[lambda: store.add(make_job(), idempotency=("key", "print")) for _ in range(8)])
    assert len({job.id for job in jobs}) == 1  # type: ignore[attr-defined]
    assert store.counts()[JobState.QUEUED] == 1


def test_the_same_file_many_times_at_once_is_one_job(store: JobStore):
    answers = at_once(*[lambda: store.add(make_job(), shared=True)] * 8)
    assert len({answer.id for answer in answers}) == 1
    assert store.usage("anna")[0] == 1


def test_many_at_once_stay_within_the_quota(store: JobStore):
    limits = Quota(max_jobs=3, max_bytes=10**9)
    results = at_once(*[lambda: store.add(make_job(), limits=limits) for _ in range(8)])
    assert sum(isinstance(result, QuotaExceeded) for result in results) == 5
    assert store.counts()[JobState.QUEUED] == 3


def test_beats_and_readers_beside_submissions(store: JobStore):
    """More threads than connections: they wait for each other and none is refused."""
    jobs = [store.add(make_job()) for _ in range(8)]
    for job in jobs:
        store.claim(job.id, 1500.0, "w")

    def beat(job_id: str) -> bool:
        return all(store.beat(job_id, 1, 1500.0 + n, "a", n / 20, None) for n in range(20))

    def look() -> bool:
        return all(len(store.page("anna", limit=99).jobs) >= 8 for _ in range(20))

    def submit() -> bool:
        return all(store.add(make_job()) for _ in range(20))

    calls = [*[lambda job=job: beat(job.id) for job in jobs], *[look] * 8, *[submit] * 8]
    assert at_once(*calls) == [True] * 24
    assert store.counts() == dict.fromkeys(JobState, 0) | {
        JobState.RUNNING: 8,
        JobState.QUEUED: 160,
    }


# Processes

_PRELUDE = """
import json, sys
from stillpath.service.database.engine import open_database
from stillpath.service.jobs.store import JobStore
from stillpath.service.settings import Settings
from tests.service.database.examples import make_job, take_all
print("loaded", flush=True)
sys.stdin.readline()
engine = open_database(Settings(**json.loads(sys.argv[1])))
store = JobStore(engine)
"""


def process(settings: Settings, code: str) -> subprocess.Popen[str]:
    """Start a process that waits for `go`, opens the database as `store`, and runs `code`."""
    given = settings.model_dump(mode="json", include={"data_dir", "database_url"})
    return subprocess.Popen(
        [sys.executable, "-c", _PRELUDE + code, json.dumps(given)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": PYTHONPATH},
    )


def go(started: subprocess.Popen[str]) -> None:
    assert started.stdin is not None
    started.stdin.write("go\n")
    started.stdin.flush()


def line_of(started: subprocess.Popen[str]) -> str:
    assert started.stdout is not None
    return started.stdout.readline().strip()


def close(started: subprocess.Popen[str]) -> int:
    assert started.stdin is not None
    assert started.stdout is not None
    started.stdin.close()
    started.stdout.close()
    return started.wait()


@pytest.mark.slow
def test_no_job_is_taken_by_two_processes(settings: Settings, store: JobStore):
    jobs = [store.add(make_job(owner=f"owner-{n % 3}")) for n in range(60)]
    code = "print(json.dumps(take_all(store, sys.argv[1])), flush=True); engine.dispose()"
    workers = [process(settings, code) for _ in range(3)]
    for worker in workers:
        assert line_of(worker) == "loaded"
    for worker in workers:
        go(worker)
    taken = [json.loads(line_of(worker)) for worker in workers]
    assert [close(worker) for worker in workers] == [0] * 3
    assert Counter(job_id for ids in taken for job_id in ids) == {job.id: 1 for job in jobs}


@pytest.mark.slow
def test_what_was_accepted_survives_a_kill(settings: Settings):
    chance = random.Random(7)
    accepted: list[str] = []
    for _ in range(3):
        writer = process(
            settings,
            "while True:\n"
            "    job = store.add(make_job(), idempotency=(make_job().id, 'print'))\n"
            "    print(job.id, flush=True)\n",
        )
        assert line_of(writer) == "loaded"
        go(writer)
        accepted.append(line_of(writer))
        time.sleep(0.2 * chance.random())
        writer.send_signal(signal.SIGKILL)
        assert writer.stdout is not None
        accepted += writer.stdout.read().split()
        assert close(writer) == -signal.SIGKILL
    engine = open_database(settings)
    store = JobStore(engine)
    # The last one may have been cut off in the middle of its line.
    whole = [job_id for job_id in accepted if len(job_id) == 32]
    assert set(store.many(whole)) == set(whole)
    assert store.counts()[JobState.QUEUED] <= len(whole) + 3
    engine.dispose()


def test_what_many_want_at_once_is_written_together(engine: Engine):
    """Each gets its own answer; what one breaks is undone, and the others' stands."""

    def wish(n: int) -> object:
        def work(connection: Connection) -> int:
            row = {"name": f"lease{n}", "holder": "me", "expires_at": 0.0}
            connection.execute(tables.leases.insert().values(row))
            if n % 3 == 0:
                raise ValueError(n)
            return n

        return write_together(engine, work)

    answers = at_once(*(partial(wish, n) for n in range(12)))
    for n, answer in enumerate(answers):
        assert answer == n if n % 3 else isinstance(answer, ValueError) and answer.args == (n,)
    with reading(engine) as connection:
        names = set(connection.execute(select(tables.leases.c.name)).scalars())
    assert names == {f"lease{n}" for n in range(12) if n % 3}


def test_who_shares_a_transaction_with_a_full_disk_is_told(tmp_path: Path):
    """SQLite undoes all of it at once, and not only what did not fit."""
    engine = make_engine(URL.create("sqlite", database=str(tmp_path / "x.sqlite3")))
    with writing(engine) as connection:
        connection.exec_driver_sql("CREATE TABLE t (n INTEGER, text TEXT)")

    def wish(n: int) -> object:
        def work(connection: Connection) -> int:
            time.sleep(0.01)  # for others to stand in line
            pages = 3 if n == 4 else 1_000_000
            connection.exec_driver_sql(f"PRAGMA max_page_count = {pages}")
            connection.exec_driver_sql("INSERT INTO t VALUES (?, ?)", (n, "x" * 100_000))
            return n

        return write_together(engine, work)

    answers = at_once(*(partial(wish, n) for n in range(8)))
    assert isinstance(answers[4], DatabaseAway)
    with reading(engine) as connection:
        kept = set(connection.exec_driver_sql("SELECT n FROM t").scalars())
    assert {answer for answer in answers if isinstance(answer, int)} == kept
    engine.dispose()


def test_who_loses_patience_hears_the_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Told that the database is away, nobody finds his wish fulfilled later."""
    engine = make_engine(URL.create("sqlite", database=str(tmp_path / "x.sqlite3")))
    with writing(engine) as connection:
        connection.exec_driver_sql("CREATE TABLE t (n INTEGER)")
    monkeypatch.setattr("stillpath.service.database.transactions.BUSY_TIMEOUT_MS", 60)

    def wish(n: int) -> object:
        def work(connection: Connection) -> int:
            time.sleep(0.04)
            connection.exec_driver_sql("INSERT INTO t VALUES (?)", (n,))
            return n

        return write_together(engine, work)

    answers = at_once(*(partial(wish, n) for n in range(6)))
    assert all(isinstance(answer, int | DatabaseAway) for answer in answers)
    with reading(engine) as connection:
        kept = set(connection.exec_driver_sql("SELECT n FROM t").scalars())
    assert {answer for answer in answers if isinstance(answer, int)} == kept
    engine.dispose()


def test_a_database_that_is_away_is_so_for_all_who_wait(tmp_path: Path):
    engine = make_engine(URL.create("sqlite", database=str(tmp_path / "gone" / "x.sqlite3")))
    calls = [partial(write_together, engine, lambda connection: 1)] * 4
    assert all(isinstance(answer, DatabaseAway) for answer in at_once(*calls))
    engine.dispose()
