import pytest

from service.jobs.state import (
    Claimed,
    Failed,
    Finished,
    Job,
    JobState,
    Lost,
    Progressed,
    Stale,
    advance,
)

QUEUED = Job(
    id="a",
    machine="ender3",
    options={},
    source_name="a.gcode",
    result_name="b.gcode",
    source_bytes=1,
    created_at=0.0,
)
RUNNING = advance(QUEUED, Claimed(at=1.0))


def test_the_straight_way():
    assert RUNNING.state is JobState.RUNNING
    assert RUNNING.attempt == 1
    half = advance(RUNNING, Progressed(1, "compensating", 0.5, 3.0))
    assert (half.stage, half.progress, half.eta_s) == ("compensating", 0.5, 3.0)
    done = advance(half, Finished(1, at=2.0))
    assert done.state is JobState.DONE
    assert done.progress == 1.0
    assert done.finished_at == 2.0


def test_progress_never_runs_backwards_nor_over_the_end():
    half = advance(RUNNING, Progressed(1, "a", 0.5, None))
    assert advance(half, Progressed(1, "b", 0.2, None)).progress == 0.5
    assert advance(half, Progressed(1, "b", 1.2, None)).progress == 1.0


def test_a_failure_keeps_its_reason():
    failed = advance(RUNNING, Failed(1, 2.0, {"status": 422}))
    assert failed.state is JobState.FAILED
    assert failed.problem == {"status": 422}


@pytest.mark.parametrize(
    "event",
    [Progressed(1, "a", 0.5, None), Finished(1, 2.0), Failed(1, 2.0, {}), Lost(1, 2.0, "x", 2)],
)
def test_an_earlier_attempt_has_no_say(event):
    second = advance(advance(RUNNING, Lost(1, 2.0, "killed", 2)), Claimed(3.0))
    assert second.attempt == 2
    with pytest.raises(Stale):
        advance(second, event)
    with pytest.raises(Stale):
        advance(advance(RUNNING, Finished(1, 2.0)), event)


def test_a_lost_worker_is_forgiven_once():
    again = advance(RUNNING, Lost(1, 2.0, "killed", 2))
    assert (again.state, again.progress) == (JobState.QUEUED, 0.0)
    over = advance(advance(again, Claimed(3.0)), Lost(2, 4.0, "killed by signal 9", 2))
    assert over.state is JobState.FAILED
    assert over.problem is not None
    assert "signal 9" in over.problem["detail"]
    assert "2 times" in over.problem["detail"]


def test_a_stopped_service_is_not_the_jobs_fault():
    job = RUNNING
    for _ in range(5):
        job = advance(advance(job, Lost(job.attempt, 2.0, "stopped", 2, blame=False)), Claimed(3.0))
    assert job.state is JobState.RUNNING
    assert job.attempt == 6


def test_only_a_waiting_job_is_claimed():
    with pytest.raises(Stale):
        advance(RUNNING, Claimed(2.0))
