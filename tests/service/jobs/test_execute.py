"""One attempt, in this process: whatever happens, the row says it and the files agree."""

from __future__ import annotations

import errno
import shutil
import time
from dataclasses import dataclass, field
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from stillpath.pipeline.progress import Progress
from stillpath.service.database.errors import DatabaseAway
from stillpath.service.jobs import attempt, patience
from stillpath.service.jobs.attempt import WorkerContext
from stillpath.service.jobs.room import RoomForJobs
from stillpath.service.jobs.state import WAITING_FOR_ROOM, Finished, Job, JobState, Lost
from stillpath.service.jobs.watch import STUCK_EXIT_CODE
from stillpath.service.jobs.worker import execute
from stillpath.service.storage import StorageError
from stillpath.service.storage.disk import Disk
from tests.service.jobs.site import Site, until
from tests.service.runners import light

_RESULT_BYTES = 3 << 20


@dataclass
class Bench:
    """A worker, and what happened in it."""

    site: Site
    limits: dict[str, Any] = field(default_factory=dict)
    reason: str | None = None
    ends: list[int] = field(default_factory=list)

    def run(self, job_id: str, runner: Any = light, storage: Any = None) -> Job:
        context = WorkerContext(
            self.site.settings.model_copy(update=self.limits),
            self.site.store,
            storage or self.site.storage,
            self.site.data_dir / "scratch",
            interrupted=lambda: self.reason,
            end=self.ends.append,
        )
        execute(job_id, context, runner)
        scratch = self.site.data_dir / "scratch"
        assert not scratch.exists() or not list(scratch.iterdir())
        return self.site.get(job_id)


def test_a_job_is_claimed_once(site: Site):
    job_id = site.submit("G1 X1")
    first = Bench(site).run(job_id)
    assert Bench(site).run(job_id) == first
    execute("0" * 32, WorkerContext(site.settings, site.store, site.storage, site.data_dir), light)


@pytest.mark.parametrize(("word", "status"), [("bad", 422), ("crash", 500)])
def test_a_job_that_cannot_be_done_says_why(site: Site, word: str, status: int):
    job = Bench(site).run(site.submit(word))
    assert job.state is JobState.FAILED
    assert job.problem["status"] == status
    assert "secret" not in str(job.problem)
    site.check_files()


def during(job_id: str, site: Site, act: Any) -> Thread:
    thread = Thread(target=lambda: (site.running(job_id), act()))
    thread.start()
    return thread


def test_a_deleted_job_stops_the_work(site: Site):
    job_id = site.submit("slow")
    thread = during(job_id, site, lambda: site.store.forget(job_id))
    with pytest.raises(AssertionError):
        Bench(site).run(job_id)
    thread.join()
    site.check_files()


@pytest.mark.parametrize("content", ["G1 X1\nG1", "G1 X1\nG1 X3\n"], ids=["cut", "garbled"])
def test_an_upload_that_the_disk_has_damaged_is_not_printed(site: Site, content: str):
    job_id = site.submit("G1 X1\nG1 X2\n")
    (site.data_dir / "jobs" / job_id / "source" / "part.gcode").write_text(content)
    job = Bench(site).run(job_id)
    assert (job.state, job.attempt) == (JobState.FAILED, 1)
    assert job.problem["title"] == "The file is damaged"
    assert "submit the file again" in job.problem["detail"]
    site.check_files()


def test_a_lost_job_stops_and_its_files_do_not_count(site: Site):
    job_id = site.submit("nap 1")
    lost = Lost(1, time.time(), "test", 2, blame=True)
    thread = during(job_id, site, lambda: site.store.apply(job_id, lost))
    assert Bench(site).run(job_id).state is JobState.QUEUED
    thread.join()
    assert Bench(site).run(job_id).output == f"jobs/{job_id}/2"
    site.check_files()


def test_an_attempt_that_finishes_too_late_changes_nothing(site: Site):
    job_id = site.submit("G1 X1")

    def late(task: Any, progress: Any) -> dict[str, Any]:
        summary = light(task, progress)
        site.store.apply(job_id, Lost(1, time.time(), "test", 3))
        other = WorkerContext(site.settings, site.store, site.storage, site.data_dir / "other")
        execute(job_id, other, light)
        return summary

    job = Bench(site).run(job_id, late)
    assert (job.state, job.output) == (JobState.DONE, f"jobs/{job_id}/2")
    site.check_files()


def test_a_job_deleted_while_its_result_is_made_leaves_nothing(site: Site):
    job_id = site.submit("G1 X1")

    def late(task: Any, progress: Any) -> dict[str, Any]:
        summary = light(task, progress)
        site.store.forget(job_id)
        site.storage.delete(f"jobs/{job_id}/")
        return summary

    with pytest.raises(AssertionError):
        Bench(site).run(job_id, late)
    assert list(site.storage.list("jobs/")) == []  # before any sweep


def test_a_worker_that_is_stopped_gives_its_job_back(site: Site):
    bench = Bench(site)
    job_id = site.submit("slow")
    thread = during(job_id, site, lambda: setattr(bench, "reason", "the worker was stopped"))
    job = bench.run(job_id)
    thread.join()
    assert (job.state, job.losses) == (JobState.QUEUED, 0)


def test_a_runner_that_does_not_listen_costs_its_process(site: Site):
    bench = Bench(site, {"cancel_grace_s": 0.1})
    job_id = site.submit("G1")

    def deaf(task: Any, progress: Any) -> dict[str, Any]:
        site.cancel(job_id)
        until(lambda: bench.ends)
        return light(task, lambda _: None)

    assert bench.run(job_id, deaf).state is JobState.CANCELLED
    assert bench.ends == [STUCK_EXIT_CODE]


def test_progress_reaches_the_row(site: Site):
    job_id = site.submit("G1")

    def shows(task: Any, progress: Any) -> dict[str, Any]:
        progress(Progress("measuring", 0.25, 1.0, 1.0, 9.0))
        job = until(lambda: (job := site.get(job_id)).stage == "measuring" and job)
        assert (job.progress, job.eta_s) == (0.25, 9.0)
        return light(task, progress)

    assert Bench(site).run(job_id, shows).state is JobState.DONE


class _Broken:
    """A storage that takes nothing for some time."""

    def __init__(self, storage: Any, error: StorageError, times: int) -> None:
        self._storage = storage
        self._error = error
        self.times = times

    def __getattr__(self, name: str) -> Any:
        return getattr(self._storage, name)

    def put(self, key: str, file: Path) -> None:
        if self.times > 0:
            self.times -= 1
            raise self._error
        self._storage.put(key, file)


def test_a_storage_that_is_away_for_a_moment_is_waited_for(site: Site):
    broken = _Broken(site.storage, StorageError(5, "away", "s3://b"), 2)
    assert Bench(site).run(site.submit("G1"), storage=broken).state is JobState.DONE
    site.check_files()


def test_a_storage_that_stays_away_is_the_reason_in_the_end(
    site: Site, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(patience, "_PATIENCE_S", 0.0)
    broken = _Broken(site.storage, StorageError(5, "away", "s3://b"), 99)
    job_id = site.submit("G1")
    assert Bench(site).run(job_id, storage=broken).state is JobState.QUEUED
    job = Bench(site).run(job_id, storage=broken)
    assert job.state is JobState.FAILED
    assert (job.problem["status"], job.problem["title"]) == (503, "Storage unavailable")
    assert "away" in job.problem["detail"]
    assert "memory" not in job.problem["detail"]


@pytest.mark.parametrize("stopped", [False, True])
def test_what_took_hours_waits_for_a_database_that_is_away(
    site: Site, monkeypatch: pytest.MonkeyPatch, stopped: bool
):
    """As while PostgreSQL is moved to another computer."""
    monkeypatch.setattr(patience, "_PATIENCE_S", 0.0)
    bench, apply, away = Bench(site), site.store.apply, 3

    def later(job_id: str, event: Any) -> Any:
        nonlocal away
        if isinstance(event, Finished) and away:
            away -= 1
            bench.reason = "the worker was stopped" if stopped else None
            raise DatabaseAway("no connection")
        return apply(job_id, event)

    monkeypatch.setattr(site.store, "apply", later)
    job = bench.run(site.submit("G1"))
    assert (job.state, away) == ((JobState.RUNNING, 2) if stopped else (JobState.DONE, 0))


def test_a_job_waits_for_a_disk_that_is_away(site: Site, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(patience, "_PATIENCE_S", 0.0)
    monkeypatch.setattr(attempt, "_AGAIN_S", 0.0)
    job_id = site.submit("G1")
    (site.data_dir / ".fresh").rename(site.data_dir / ".away")
    for _ in range(3):
        job = Bench(site).run(job_id)
        assert (job.state, job.losses) == (JobState.QUEUED, 0)
    (site.data_dir / ".away").rename(site.data_dir / ".fresh")
    assert Bench(site).run(job_id).state is JobState.DONE


@pytest.mark.parametrize("again", [False, True])
def test_a_disk_that_fails_once_fails_no_job(site: Site, again: bool):
    """As a memory card does, or a disk that is pulled."""

    def breaks(task: Any, progress: Any) -> dict[str, Any]:
        if task.attempt == 1 or again:
            raise OSError(errno.EROFS, "Read-only file system", str(task.target))
        return light(task, progress)

    job = Bench(site).run(site.submit("G1"), breaks)
    assert (job.state, job.losses) == (JobState.QUEUED, 1)
    job = Bench(site).run(job.id, breaks)
    assert job.state is (JobState.FAILED if again else JobState.DONE)
    if again:
        assert (job.problem["status"], job.problem["title"]) == (503, "Storage unavailable")
        assert "Read-only file system" in job.problem["detail"]


def test_a_job_without_room_waits_in_the_queue(site: Site):
    broken = _Broken(site.storage, StorageError(28, "No space left", "/"), 1)
    job = Bench(site).run(site.submit("G1"), storage=broken)
    assert (job.state, job.stage, job.losses) == (JobState.QUEUED, WAITING_FOR_ROOM, 0)
    assert Bench(site).run(job.id).state is JobState.DONE
    site.check_files()


def test_what_a_quota_has_no_room_for_is_not_computed_again_in_vain(
    site: Site, monkeypatch: pytest.MonkeyPatch
):
    """The disk has room: of a quota only asking for it tells."""
    quota_bytes = computed = 0

    def reserves(_: int, __: int, more_bytes: int) -> None:
        if more_bytes > quota_bytes:
            raise OSError(errno.EDQUOT, "Disk quota exceeded")

    def writes(task: Any, progress: Any) -> dict[str, Any]:
        nonlocal computed
        computed += 1
        task.target.write_bytes(bytes(_RESULT_BYTES))
        if quota_bytes < _RESULT_BYTES:
            raise OSError(errno.EDQUOT, "Disk quota exceeded")
        return light(task, progress)

    monkeypatch.setattr("stillpath.service.storage.disk.os.posix_fallocate", reserves)
    monkeypatch.setattr("stillpath.service.jobs.room._NO_ROOM_S", 0.0)
    look = RoomForJobs(Disk(site.data_dir, 0), site.storage, is_own_disk=True)
    job_id = site.submit("G1")
    for _ in range(3):
        job = Bench(site).run(job_id, writes)  # as where workers have disks of their own
        assert (job.state, job.stage) == (JobState.QUEUED, WAITING_FOR_ROOM)
        assert not any(look.for_retry(job, time.monotonic()) for _ in range(3))
    assert computed == 1
    assert (job.room_bytes or 0) >= _RESULT_BYTES
    quota_bytes = 64 * _RESULT_BYTES
    assert look.for_retry(job, time.monotonic())
    assert Bench(site).run(job_id, writes).state is JobState.DONE
    site.check_files()


def test_what_is_left_of_the_disk_belongs_to_the_database(site: Site):
    everything = shutil.disk_usage(site.data_dir).free * 8
    bench = Bench(site, limits={"disk_reserve_bytes": everything})
    job = bench.run(site.submit("slow"))
    assert (job.state, job.stage) == (JobState.QUEUED, WAITING_FOR_ROOM)
