"""Several computers, as processes: PostgreSQL, S3, a scheduler and workers, and their failures."""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from stillpath.service.jobs.state import JobState
from tests.service.database.postgres import PostgresServer
from tests.service.database.postgres import postgres_server as postgres_server
from tests.service.jobs.site import Process, Site, until
from tests.service.storage.s3_server import BUCKET, CREDENTIALS, Cable, free_port, s3_server

pytestmark = [
    pytest.mark.slow,
    pytest.mark.postgresql,
    pytest.mark.skipif(os.name != "posix", reason="kills processes"),
]


class Far:
    """A service on several computers."""

    def __init__(self, stack: ExitStack, folder: Path, postgres: PostgresServer) -> None:
        address = stack.enter_context(s3_server())
        self.s3 = Cable(int(address.rsplit(":", 1)[1]))
        stack.callback(self.s3.cut)
        self.database = Cable(postgres.port)
        stack.callback(self.database.cut)
        url = postgres.new_database()
        self.port = free_port()
        self.site = Site(
            folder,
            database_url=url.replace(f":{postgres.port}/", f":{self.database.port}/"),
            storage_url=f"s3://{BUCKET}/farm?endpoint=http://127.0.0.1:{self.s3.port}",
            scheduler=f"tcp://127.0.0.1:{self.port}",
            heartbeat_timeout_s="5",
        )
        stack.callback(postgres.drop_database, url)
        stack.callback(self.site.close)
        self._stack = stack

    def scheduler(self) -> Process:
        return self._stack.enter_context(self.site.command("scheduler", "--port", str(self.port)))

    def workers(self, count: int = 2) -> Process:
        return self._stack.enter_context(
            self.site.command("worker", "--workers", str(count), data_dir=self.site.data_dir / "w")
        )

    def api(self) -> Process:
        return self._stack.enter_context(self.site.work())


@pytest.fixture
def far(
    tmp_path: Path, postgres_server: PostgresServer, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Far]:
    for name, value in CREDENTIALS.items():
        monkeypatch.setenv(name, value)
    with ExitStack() as stack:
        yield Far(stack, tmp_path / "data", postgres_server)


def all_done(site: Site, ids: list[str]) -> None:
    for job_id in ids:
        assert site.ended(job_id).state is JobState.DONE, site.get(job_id)
    site.check_files()


def test_scheduler_storage_and_database_may_go_away_in_mid_job(far: Far):
    site = far.site
    scheduler, _, _ = far.scheduler(), far.workers(), far.api()
    first = [site.submit("nap 5") for _ in range(2)] + [site.submit("G1")]
    for job_id in first[:2]:
        site.running(job_id)
    scheduler.kill()
    time.sleep(1)
    far.scheduler()
    all_done(site, first)
    assert all(site.get(job_id).losses <= 1 for job_id in first)

    second = [site.submit("nap 1.5") for _ in range(2)]
    for job_id in second:
        site.running(job_id)
    far.s3.cut()
    time.sleep(3)
    far.s3.mend()
    all_done(site, second)

    third = [site.submit("nap 3") for _ in range(2)]
    for job_id in third:
        site.running(job_id)
    far.database.cut()
    time.sleep(6)  # longer than a worker may be silent
    far.database.mend()
    all_done(site, third)
    assert all(site.get(job_id).attempt == 1 for job_id in second + third)


def test_two_services_share_the_work_and_one_may_die(far: Far):
    site = far.site
    far.scheduler()
    workers = far.workers()
    apis = [far.api(), far.api()]
    ids = [site.submit("nap 0.3", owner=f"o{n % 3}") for n in range(12)]
    until(lambda: site.store.counts()[JobState.DONE] > 2)
    apis[0].kill()
    ids += [site.submit("nap 0.3") for _ in range(6)]
    all_done(site, ids)
    assert all(site.get(job_id).attempt == 1 for job_id in ids)

    last = site.submit("slow-once")
    site.running(last)
    workers.stop()
    assert until(lambda: site.get(last)).state is JobState.QUEUED
    assert site.get(last).losses == 0
    far.workers(1)
    all_done(site, [last])


def test_what_a_bucket_has_lost_or_damaged_is_told(far: Far):
    site = far.site
    ids = [site.submit(f"G1 X{n} ; as submitted") for n in range(3)]
    gone, cut, garbled = (site.get(job_id) for job_id in ids)
    site.storage.delete(gone.files)
    for job, content in ((cut, b"G1 X1"), (garbled, b"G1 X7 ; as submitted")):
        file = site.data_dir / "rubbish"
        file.write_bytes(content)
        site.storage.put(job.sources[0], file)
    _ = far.scheduler(), far.workers(), far.api()
    titles = [site.ended(job_id).problem["title"] for job_id in ids]
    assert titles == ["The file is gone", "The file is damaged", "The file is damaged"]
    assert all(site.get(job_id).output is None for job_id in ids)


@pytest.mark.skipif(not hasattr(signal, "SIGQUIT"), reason="crashes PostgreSQL")
def test_a_database_that_crashes_forgets_nothing(tmp_path: Path):
    # Short, and open to the user that PostgreSQL runs as.
    folder = Path(tempfile.mkdtemp(prefix="sp-pg-"))
    folder.chmod(0o755)
    own = PostgresServer(folder / "server", "fsync=on")
    own.start()
    try:
        site = Site(tmp_path / "data", database_url=own.new_database())
        try:
            with site.work():
                ids = [site.submit("nap 2"), site.submit("G1")]
                site.running(ids[0])
                own.stop(signal.SIGQUIT)
                time.sleep(2)
                own.start()
                all_done(site, ids)
        finally:
            site.close()
    finally:
        own.stop()
        shutil.rmtree(folder, ignore_errors=True)
