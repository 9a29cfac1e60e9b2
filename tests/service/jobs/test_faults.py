"""One computer, real processes, and what can happen to them: no job is lost, none is done twice."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator

import psutil
import pytest

from stillpath.service.database.errors import DatabaseAway
from stillpath.service.jobs.state import JobState
from tests.service.jobs.site import Site, until

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="kills processes")]


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """Give a service that goes on, whatever happens to its workers."""
    site = Site(tmp_path_factory.mktemp("shared") / "data")
    with site.work(cancel_grace_s=1.0):
        yield site
    site.check_files()
    site.close()


def worker_pid(site: Site, job_id: str) -> int:
    return int(site.running(job_id).worker.rsplit(":", 1)[1])


def test_a_worker_that_is_killed_costs_its_job_one_attempt(shared: Site):
    job_id, other = shared.submit("slow-once"), shared.submit("G1")
    os.kill(worker_pid(shared, job_id), signal.SIGKILL)
    job = shared.ended(job_id)
    assert (job.state, job.attempt, job.losses) == (JobState.DONE, 2, 1)
    assert shared.ended(other).attempt == 1


def test_a_job_that_kills_every_worker_fails_and_the_others_go_on(shared: Site):
    killer, other = shared.submit("die"), shared.submit("G1")
    job = shared.ended(killer)
    assert (job.state, job.attempt) == (JobState.FAILED, 2)
    assert "its process ended" in job.problem["detail"]
    assert shared.ended(other).state is JobState.DONE


def test_a_service_that_is_killed_takes_its_workers_along_and_its_jobs_up_again(site: Site):
    with site.work() as first:
        job_id, waiting = site.submit("slow-once"), site.submit("G1")
        site.running(job_id)
        family = first.family()
        first.kill()
        until(lambda: not any(_lives(process) for process in family))
        assert site.get(job_id).state is JobState.RUNNING
    with site.work():
        job = site.ended(job_id)
        assert (job.state, job.attempt, job.losses) == (JobState.DONE, 2, 0)
        assert site.ended(waiting).state is JobState.DONE
    site.check_files()


@pytest.mark.parametrize("to", ["service", "everybody"])
def test_a_service_that_is_stopped_gives_its_jobs_back(site: Site, to: str):
    with site.work() as first:
        job_id = site.submit("slow-once")
        site.running(job_id)
        family = first.family()
        if to == "everybody":  # as a supervisor does
            for process in family:
                with contextlib.suppress(psutil.NoSuchProcess):
                    process.send_signal(signal.SIGTERM)
        assert first.stop() == 0
        until(lambda: not any(_lives(process) for process in family))
        job = site.get(job_id)
        assert (job.state, job.losses) == (JobState.QUEUED, 0)
    with site.work():
        assert site.ended(job_id).state is JobState.DONE
    site.check_files()


def test_a_worker_that_is_deaf_to_a_cancel_is_ended(shared: Site):
    deaf = shared.submit("deaf")
    pid = worker_pid(shared, deaf)
    shared.cancel(deaf)
    job = shared.ended(shared.submit("G1"))
    assert (job.state, job.attempt) == (JobState.DONE, 1)
    assert worker_pid_of(job.worker) != pid
    assert shared.get(deaf).state is JobState.CANCELLED


def test_limits_end_a_job_and_nothing_else(site: Site):
    with site.work(max_job_s=4.0, cancel_grace_s=1.0, max_job_bytes=250 << 20):
        ids = [site.submit(text) for text in ("deaf", "grow 300", "grow 4000", "G1")]
        long, large, larger, good = (site.ended(job_id) for job_id in ids)
        assert "STILLPATH_MAX_JOB_S" in long.problem["detail"]
        assert "STILLPATH_MAX_JOB_BYTES" in large.problem["detail"]
        if sys.platform == "linux":  # at once, however much it asked for
            assert "The system refused" in larger.problem["detail"]
        assert good.state is JobState.DONE
    site.check_files()


def test_silence_is_a_loss(site: Site):
    with site.work(heartbeat_timeout_s=5.0, max_attempts=3):
        job_id = site.submit("slow-once")
        pid = worker_pid(site, job_id)
        os.kill(pid, signal.SIGSTOP)  # neither dead nor alive
        until(lambda: site.get(job_id).state is JobState.QUEUED)
        os.kill(pid, signal.SIGCONT)
        job = site.ended(job_id)
        assert (job.state, job.losses) == (JobState.DONE, 1)
    site.check_files()


def test_ends_at_random_moments_leave_every_job_done_once(site: Site):
    """Kill and start the service again and again, while jobs come in."""
    ids: list[str] = []
    stop = threading.Event()

    def submit() -> None:
        while not stop.is_set() and len(ids) < 40:
            with contextlib.suppress(DatabaseAway):
                ids.append(site.submit("nap 0.15"))
            time.sleep(0.2)

    submitter = threading.Thread(target=submit)
    submitter.start()
    try:
        for n in range(2):
            with site.work(workers=2) as process:
                done = site.store.counts()[JobState.DONE]
                until(lambda done=done: site.store.counts()[JobState.DONE] > done + 2)
                time.sleep(0.05 * n)
                process.kill()
    finally:
        stop.set()
        submitter.join()
    with site.work(workers=2):
        for job_id in ids:
            assert site.ended(job_id).state is JobState.DONE
    site.check_files()


def worker_pid_of(name: str | None) -> int:
    assert name is not None
    return int(name.rsplit(":", 1)[1])


def _lives(process: psutil.Process) -> bool:
    with contextlib.suppress(psutil.NoSuchProcess):
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    return False
