"""One look after the other, with workers that do what the test says."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from stillpath.service.database.errors import DatabaseAway
from stillpath.service.jobs import reconciler, room
from stillpath.service.jobs.attempt import WorkerContext
from stillpath.service.jobs.reconciler import Reconciler
from stillpath.service.jobs.state import WAITING_FOR_ROOM, Claimed, Job, JobState, Lost, OutOfRoom
from stillpath.service.jobs.worker import execute
from tests.service.jobs.site import Site
from tests.service.runners import light
from tests.service.small_disk import small_disk

_MIB = 1 << 20


@dataclass
class Handed:
    """What Dask promises of a job: it ended with its process once `broken`."""

    broken: bool = False
    status: str = "error"

    def done(self) -> bool:
        return self.broken

    def exception(self, timeout: float) -> Exception:
        return type("KilledWorker", (Exception,), {})()


@dataclass
class Workers:
    """A cluster with one place; jobs that are handed over lie there."""

    is_connected: bool = True
    is_own: bool = True
    handed: list[Handed] = field(default_factory=list)

    def connect(self) -> None:
        self.is_connected = True

    def slots(self) -> int:
        return 1

    def submit(self, job: Job, when_done: Callable[[], object]) -> Handed:
        self.handed.append(Handed())
        return self.handed[-1]


def looking(site: Site, workers: Workers) -> Reconciler:
    made: Any = workers
    return Reconciler(site.settings, site.store, site.storage, made)


def test_every_attempt_has_its_moment_of_grace(site: Site, monkeypatch: pytest.MonkeyPatch):
    """A worker that closes gives its job back itself, in this attempt as in an earlier one."""
    monkeypatch.setattr(reconciler, "_GIVE_BACK_S", 0.3)
    workers = Workers(is_own=False)
    look = looking(site, workers)
    job_id = site.submit("G1")
    look._tick()
    site.store.apply(job_id, Claimed(time.time(), "w"))
    workers.handed[0].broken = True
    look._tick()  # it is seen to be broken
    site.store.apply(job_id, Lost(1, time.time(), "the worker was stopped", 2, blame=False))
    workers.is_connected = False
    look._tick()  # another scheduler: all is handed over anew
    assert len(workers.handed) == 2
    site.store.apply(job_id, Claimed(time.time(), "w"))
    time.sleep(0.4)
    workers.handed[1].broken = True
    look._tick()
    job = site.get(job_id)
    assert (job.state, job.attempt, job.losses) == (JobState.RUNNING, 2, 0)
    time.sleep(0.4)
    look._tick()
    assert site.get(job_id).losses == 1


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("ours", [True, False])
def test_a_service_that_was_killed_is_no_loss_of_its_jobs(site: Site, own: bool, ours: bool):
    """With PostgreSQL its jobs are found by silence; remote workers outlive a service."""
    look = looking(site, Workers(is_own=own))
    job_id = site.submit("G1")
    look._tick()
    site.store.apply(job_id, Claimed(time.time() - 3600.0, "w"))
    if not ours:
        look._forget()
    look._steady._since_s -= 3600.0
    look._tick()
    job = site.get(job_id)
    assert (job.state, job.losses) == (JobState.QUEUED, int(ours or not own))


@pytest.mark.parametrize("own_database", [True, False])
def test_a_job_that_freezes_the_computer_is_not_begun_for_ever(site: Site, own_database: bool):
    """Somebody switches it off and on again; the job would freeze it as soon as it is on."""
    job_id = site.submit("G1")
    ends = 0
    while site.get(job_id).state is JobState.QUEUED:
        began = time.time() if own_database else time.time() - 3600.0
        site.store.apply(job_id, Claimed(began, "w"))
        ends += 1
        look = looking(site, Workers())
        look._took_over = not own_database  # PostgreSQL tells of it by silence
        look._steady._since_s -= 3600.0
        look._tick()
        site.store.release("reconciler", look._holder, time.time())
        assert ends < 9
    job = site.get(job_id)
    assert (job.state, ends) == (JobState.FAILED, 4)
    assert job.problem is not None
    assert "the computer went down while the job was under way" in job.problem["detail"]


def test_a_disk_that_held_everybody_up_is_no_silence(site: Site, monkeypatch: pytest.MonkeyPatch):
    """A worker's heartbeat waits for the disk as the reconciler does, and may come after it."""
    look = looking(site, Workers())
    look._settings = site.settings.model_copy(update={"heartbeat_timeout_s": 2.0})
    look._tick()
    job_id = site.submit("G1")
    site.store.apply(job_id, Claimed(time.time(), "w"))
    look._steady._since_s -= 3600.0
    look._leased_at -= 3600.0

    def slow(*_: object) -> bool:
        time.sleep(2.5)
        return True

    with monkeypatch.context() as disk:
        disk.setattr(site.store, "lease", slow)
        look._tick()
    assert site.get(job_id).state is JobState.RUNNING
    look._steady._since_s -= 3600.0  # and still no heartbeat
    look._tick()
    assert site.get(job_id).state is JobState.QUEUED


@pytest.mark.parametrize("away_h", [0.5, 72.0])
@pytest.mark.parametrize("submitted_h", [0.0, 73.0])
def test_a_print_is_not_started_days_after_it_was_expected(
    site: Site, away_h: float, submitted_h: float
):
    """Somebody switches the computer on again: a queue that was honestly long goes on."""
    now = time.time()
    look = looking(site, Workers())
    site.store.lease("reconciler", "the last service", 5.0, now - away_h * 3600)
    created_at = now - submitted_h * 3600
    job_id = site.submit("G1", printer="left", print_after=True, created_at=created_at)
    look._tick()
    job = site.get(job_id)
    assert (job.print_after, job.held_back) == (True, min(away_h, submitted_h) > 1.0)


@pytest.mark.parametrize("slept", [False, True])
def test_a_clock_that_is_put_right_keeps_no_print_from_starting(
    site: Site, monkeypatch: pytest.MonkeyPatch, slept: bool
):
    """A board without a battery goes on where it was switched off, until the network tells it."""
    look = looking(site, Workers())
    switched_off_at = time.time() - 8 * 3600.0

    @dataclass
    class Clock:
        ahead_s: float = 0.0
        CLOCK_BOOTTIME: int = 7

        def time(self) -> float:
            return switched_off_at + self.ahead_s

        def monotonic(self) -> float:
            return time.monotonic()

        def clock_gettime(self, _: int) -> float:
            return time.monotonic() + (self.ahead_s if slept else 0.0)

    clock = Clock()
    monkeypatch.setattr(reconciler, "time", clock)
    yesterdays = site.submit("G1", printer="left", print_after=True, created_at=clock.time() - 9e3)
    look._tick()
    todays = site.submit("G1 X", printer="left", print_after=True, created_at=clock.time() + 20.0)
    clock.ahead_s = 8 * 3600.0
    look._leased_at -= 3.0
    look._tick()
    assert site.get(yesterdays).held_back
    assert site.get(todays).held_back == slept


def test_a_print_from_before_the_clock_was_set_back_is_not_started(
    site: Site, monkeypatch: pytest.MonkeyPatch
):
    """A board without a battery begins in 1970; for how long it was off nobody knows."""

    @dataclass
    class Clock:
        CLOCK_BOOTTIME: int = 7

        def time(self) -> float:
            return 100.0

        def monotonic(self) -> float:
            return time.monotonic()

        def clock_gettime(self, _: int) -> float:
            return time.monotonic()

    site.store.lease("reconciler", "before the power cut", 5.0, time.time())
    before = site.submit("G1", printer="left", print_after=True)
    monkeypatch.setattr(reconciler, "time", Clock())
    look = looking(site, Workers())
    since = site.submit("G1 X", printer="left", print_after=True, created_at=100.0)
    look._tick()
    assert site.get(before).held_back
    assert not site.get(since).held_back


@pytest.mark.parametrize("lacking", ["workers", "room"])
@pytest.mark.parametrize("hours", [0.5, 72.0])
def test_a_print_for_which_nothing_could_be_done_for_days_is_not_started(
    site: Site, monkeypatch: pytest.MonkeyPatch, lacking: str, hours: float
):
    """The service ran, but its workers were away, or the disk was full."""
    workers = Workers()
    look = looking(site, workers)
    look._tick()
    days = 0.0
    monkeypatch.setattr(reconciler, "_since_boot_s", lambda: since + days)
    since = look._able_at
    with monkeypatch.context() as trouble:
        if lacking == "workers":
            trouble.setattr(workers, "slots", lambda: 0)
        else:
            trouble.setattr(look._room, "for_any", lambda: False)
        look._tick()
        created_at = time.time() - 3600.0 * hours
        old = site.submit("G1", printer="left", print_after=True, created_at=created_at)
        new = site.submit("G1 X", printer="left", print_after=True)
        days = 3600.0 * hours
        look._tick()
    look._tick()
    assert site.get(old).held_back == (hours > 1.0)
    assert not site.get(new).held_back


def test_who_takes_over_the_work_starts_prints(site: Site, monkeypatch: pytest.MonkeyPatch):
    """It was ready for days, while another service did the jobs."""
    site.store.lease("reconciler", "another", 5.0, time.time())
    look = looking(site, Workers())
    look._tick()
    since = look._able_at
    monkeypatch.setattr(reconciler, "_since_boot_s", lambda: since + 72 * 3600.0)
    site.store.release("reconciler", "another", time.time())
    created_at = time.time() - 5000.0
    job_id = site.submit("G1", printer="left", print_after=True, created_at=created_at)
    look._tick()
    assert not site.get(job_id).held_back


def test_a_database_that_takes_no_writes_is_trouble_that_lasts(
    site: Site, monkeypatch: pytest.MonkeyPatch
):
    """Workers alone do no jobs: `/readyz` says so once it has lasted."""
    look = looking(site, Workers())
    look._tick()
    assert look._trouble is None
    look._leased_at -= 3600.0
    with monkeypatch.context() as broken:

        def lease(*_: object) -> bool:
            raise DatabaseAway("attempt to write a readonly database")

        broken.setattr(site.store, "lease", lease)
        broken.setattr(look._stopping, "wait", lambda _: tries.append(look._trouble))
        broken.setattr(look._stopping, "is_set", lambda: len(tries) == 3)
        tries: list[str | None] = []
        begun = time.monotonic()
        look._run()
        assert tries == ["attempt to write a readonly database"] * 3
        assert begun <= look._trouble_since
        since = look._trouble_since
        tries.clear()
        look._run()
        assert look._trouble_since == since
    look._tick()
    assert look._trouble is None


def test_jobs_that_wait_for_room_let_others_pass(site: Site):
    """However many there are: each is looked at again every half minute only."""
    workers = Workers()
    for number in range(6):
        job_id = site.submit("G1", created_at=1000.0 + number)
        if number < 5:
            site.store.apply(job_id, Claimed(time.time(), "w"))
            site.store.apply(job_id, OutOfRoom(1, time.time(), 1 << 60))
    look = looking(site, workers)
    look._tick()
    assert list(look._in_flight) == [job_id]


def test_a_job_waits_until_the_disk_of_the_storage_has_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(room, "_NO_ROOM_S", 0.0)
    with small_disk(tmp_path / "disk", 12) as disk:
        site = Site(tmp_path / "data", storage_url=(disk / "store").as_uri())
        place = WorkerContext(site.settings, site.store, site.storage, site.data_dir / "scratch")
        other = disk / "other"
        other.write_bytes(b"x" * (8 * _MIB))
        job_id = site.submit("long 6")
        execute(job_id, place, light)
        job = site.get(job_id)
        assert (job.state, job.stage, job.losses) == (JobState.QUEUED, WAITING_FOR_ROOM, 0)
        assert (job.room_bytes or 0) > 6 * _MIB
        workers = Workers()
        look = looking(site, workers)
        for _ in range(3):
            look._tick()
        assert not workers.handed  # it would be computed again, and find no room again
        other.unlink()
        for _ in range(3):
            look._tick()
        assert len(workers.handed) == 1
        execute(job_id, place, light)
        assert site.get(job_id).state is JobState.DONE
        large = site.submit("long 13")
        execute(large, place, light)
        job = site.get(large)
        assert job.state is JobState.FAILED
        assert job.problem is not None
        assert (job.problem["status"], job.problem["title"]) == (
            507,
            "The job is larger than the disk",
        )
        assert "STILLPATH_STORAGE_URL" in job.problem["detail"]
        site.close()
