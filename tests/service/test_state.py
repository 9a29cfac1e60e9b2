"""The states of a job: what may happen to it, and what never does."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from stillpath.service.jobs.state import (
    Cancelled,
    Claimed,
    Event,
    JobState,
    Lost,
    OutOfRoom,
    Progressed,
    Stale,
    advance,
)
from tests.service.database.examples import finished, make_job
from tests.service.database.happenings import events

QUEUED = make_job(id="a")
RUNNING = advance(QUEUED, Claimed(1.0, "worker-1"))
FINISHED = finished(RUNNING, at=2.0)
MOVING = {
    *("state", "attempt", "losses", "worker", "stage", "progress", "eta_s", "problem", "summary"),
    *("output", "output_bytes", "result_bytes", "result_sha256"),
    *("started_at", "heartbeat_at", "finished_at"),
}


def test_the_straight_way():
    assert RUNNING.state is JobState.RUNNING
    assert (RUNNING.attempt, RUNNING.worker) == (1, "worker-1")
    assert (RUNNING.started_at, RUNNING.heartbeat_at) == (1.0, 1.0)
    half = advance(RUNNING, Progressed(1, 1.5, "compensating", 0.5, 3.0))
    assert (half.stage, half.progress, half.eta_s) == ("compensating", 0.5, 3.0)
    assert (half.started_at, half.heartbeat_at) == (1.0, 1.5)
    done = advance(half, FINISHED)
    assert done.state is JobState.DONE
    assert (done.progress, done.eta_s, done.finished_at) == (1.0, None, 2.0)
    assert (done.output, done.output_bytes) == ("jobs/a/1", 70)
    assert (done.result_bytes, done.result_sha256) == (50, "7" * 64)
    assert done.summary == {"before_um": 9.5}


def test_progress_never_runs_backwards_nor_over_the_end():
    half = advance(RUNNING, Progressed(1, 1.5, "a", 0.5, None))
    assert advance(half, Progressed(1, 1.6, "b", 0.2, None)).progress == 0.5
    assert advance(half, Progressed(1, 1.6, "b", 1.2, None)).progress == 1.0


def test_a_lost_worker_is_forgiven_once():
    again = advance(RUNNING, Lost(1, 2.0, "killed", 2))
    assert (again.state, again.progress) == (JobState.QUEUED, 0.0)
    assert (again.started_at, again.heartbeat_at) == (None, None)
    over = advance(advance(again, Claimed(3.0, "w")), Lost(2, 4.0, "killed by signal 9", 2))
    assert over.state is JobState.FAILED
    assert over.problem is not None
    assert "signal 9" in over.problem["detail"]
    assert "2 times" in over.problem["detail"]


def test_a_print_that_waited_long_for_room_is_held_back():
    """Nobody may be there to watch; a queue that is honestly long is expected."""
    asked = make_job(id="a", printer="m", print_after=True, created_at=0.0)
    began = advance(asked, Claimed(9000.0, "w"))
    assert not began.held_back
    waits = advance(began, OutOfRoom(1, 9001.0, 5))
    assert advance(waits, Claimed(9100.0, "w")).held_back
    soon = advance(replace(waits, created_at=9000.0), Claimed(9100.0, "w"))
    assert not soon.held_back


def test_a_stopped_service_is_not_the_jobs_fault():
    job = RUNNING
    for _ in range(5):
        job = advance(job, Lost(job.attempt, 2.0, "stopped", 2, blame=False))
        job = advance(job, Claimed(3.0, "w"))
    assert (job.state, job.attempt, job.losses) == (JobState.RUNNING, 6, 0)


@given(st.lists(events(), max_size=30))
def test_whatever_happens(sequence: list[Event]):
    job = QUEUED
    for event in sequence:
        try:
            after = advance(job, event)
        except Stale:
            # Refused only for a reason: it is over, or not this attempt's turn.
            assert (
                job.state.is_final
                or (isinstance(event, Claimed) and job.state is JobState.RUNNING)
                or (job.state is JobState.QUEUED and not isinstance(event, Cancelled))
                or getattr(event, "attempt", job.attempt) != job.attempt
            )
            continue
        assert not job.state.is_final
        if not isinstance(event, Claimed | Cancelled):
            assert (event.attempt, job.state) == (job.attempt, JobState.RUNNING)
        assert after.attempt == job.attempt + isinstance(event, Claimed)
        assert job.losses <= after.losses <= after.attempt
        if after.state is JobState.RUNNING and after.attempt == job.attempt:
            assert after.progress >= job.progress
        assert 0 <= after.progress <= 1
        assert (after.finished_at is not None) == after.state.is_final
        assert (after.output is not None) == (after.state is JobState.DONE)
        assert (after.problem is not None) == (after.state is JobState.FAILED)
        assert (after.started_at is None) <= (after.state is not JobState.RUNNING)
        still = {name: getattr(QUEUED, name) for name in MOVING}
        assert replace(after, **still) == QUEUED
        job = after
