"""The record of jobs, on both databases."""

from __future__ import annotations

import base64
import json
import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import Engine, select, text

from stillpath.service.database.tables import deliveries
from stillpath.service.database.transactions import reading, writing
from stillpath.service.jobs.expiry import Expiry
from stillpath.service.jobs.state import (
    Cancelled,
    Event,
    Failed,
    Job,
    JobKind,
    JobState,
    Lost,
    Progressed,
    Stale,
    advance,
)
from stillpath.service.jobs.store import BadCursor, JobStore
from stillpath.service.jobs.submissions import IdempotencyConflict, Quota, QuotaExceeded
from tests.service.database.examples import finished, make_job
from tests.service.database.happenings import events

# The database is one for all examples; every example takes jobs and owners of its own.
many_examples = settings(
    max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture
def store(engine: Engine) -> JobStore:
    return JobStore(engine)


def run(store: JobStore, job: Job, at: float = 1500.0) -> Job:
    claimed = store.claim(job.id, at, "worker-1")
    assert claimed is not None
    return claimed


def due(store: JobStore, job: Job) -> dict[str, tuple[str, str, float]]:
    with reading(store.engine) as connection:
        rows = connection.execute(select(deliveries).where(deliveries.c.job_id == job.id)).all()
    return {row.kind: (row.target, row.state, row.next_at) for row in rows}


# One job


def test_a_job_comes_back_as_it_was(store: JobStore):
    job = store.add(
        make_job(
            options={"method": "fbf", "axes": ["x", "y"], "limit": 0.1 + 0.2, "name": "Größe 😀"},
            created_at=1790000000.123456789,
            webhook="https://farm.example/hook",
            print_after=True,
            priority=-3,
            source_bytes=1 << 40,
            batch="monday",
        )
    )
    assert store.get(job.id) == job
    assert store.get(job.id, "anna") == job
    assert store.get(job.id, "bob") is None
    assert store.get("none") is None
    done = store.apply(job.id, finished(run(store, job)))
    assert done is not None
    assert store.get(job.id) == done
    assert store.many([job.id, "none"]) == {job.id: done}
    assert store.many([]) == {}


@many_examples
@given(sequence=st.lists(events(), max_size=12))
def test_the_store_does_what_the_states_say(store: JobStore, sequence: list[Event]):
    job = store.add(make_job())
    for event in sequence:
        try:
            after = advance(job, event)
        except Stale:
            assert store.apply(job.id, event) is None
        else:
            assert store.apply(job.id, event) == after
            job = after
        assert store.get(job.id) == job
    store.forget(job.id)


@many_examples
@given(sequence=st.lists(events(), max_size=12))
def test_a_beat_is_a_progress_in_one_statement(store: JobStore, sequence: list[Event]):
    one, two = store.add(make_job()), store.add(make_job())
    for event in sequence:
        after = store.apply(one.id, event)
        if isinstance(event, Progressed):
            beat = store.beat(
                two.id, event.attempt, event.at, event.stage, event.fraction, event.eta_s
            )
            assert beat == (after is not None)
        else:
            store.apply(two.id, event)
    first, second = store.get(one.id), store.get(two.id)
    assert first is not None
    assert second is not None
    for name in ("state", "attempt", "stage", "progress", "eta_s", "heartbeat_at"):
        assert getattr(first, name) == getattr(second, name)


def test_an_event_that_changes_nothing_is_no_fault(store: JobStore):
    job = store.add(make_job())
    run(store, job, 1500.0)
    again = [store.apply(job.id, Progressed(1, 1510.0, "planning", 0.5, None)) for _ in range(2)]
    assert again[0] == again[1]


def test_a_stage_with_the_name_of_a_file_is_cut(store: JobStore):
    job = store.add(make_job())
    run(store, job, 1500.0)
    assert store.beat(job.id, 1, 1510.0, "reading " + 100 * "x" + ".csv", 0.0, None)
    after = store.get(job.id)
    assert after is not None
    assert (after.stage, after.heartbeat_at) == ("reading " + 56 * "x", 1510.0)


def test_what_is_silent(store: JobStore):
    early, late = (store.add(make_job()) for _ in range(2))
    store.add(make_job())
    run(store, early, 1500.0)
    run(store, late, 1500.0)
    store.beat(late.id, 1, 1510.0, "reading", 0.0, None)
    assert store.silent(1500.0) == []
    assert [job.id for job in store.silent(1510.0)] == [early.id]
    assert {job.id for job in store.silent(1511.0)} == {early.id, late.id}


# Submitting


def test_the_same_request_leads_to_the_same_job(store: JobStore):
    first = store.add(make_job(), idempotency=("key", "print"))
    assert store.add(make_job(), idempotency=("key", "print")) == first
    with pytest.raises(IdempotencyConflict, match="'key'"):
        store.add(make_job(), idempotency=("key", "other"))
    bobs = store.add(make_job(owner="bob"), idempotency=("key", "other"))
    assert bobs.owner == "bob"
    assert store.submitted("anna", "key") == ("print", first)
    assert store.submitted("anna", "new") is None
    assert sum(store.counts().values()) == 2
    done = store.apply(first.id, finished(run(store, first)))
    assert store.add(make_job(), idempotency=("key", "print")) == done


def test_idempotency_keys_are_kept_by_time_that_passed(store: JobStore):
    expiry = Expiry(store.engine)
    for name in ("old", "young"):
        store.add(make_job(), idempotency=(name, "print"))
        now = expiry.passed(100.0)
    assert expiry.forget_submissions(now - 50.0) == 1
    assert store.submitted("anna", "old") is None
    assert store.submitted("anna", "young") is not None
    store.forget(store.submitted("anna", "young")[1].id)
    store.add(make_job(), idempotency=("young", "print"))
    assert expiry.passed(100.0) == now + 100.0
    assert expiry.forget_submissions(now + 50.0) == 0  # it counted anew


def test_a_quota_of_jobs(store: JobStore):
    limits = Quota(max_jobs=2, max_bytes=10**9)
    first = store.add(make_job(), limits=limits)
    store.add(make_job(), limits=limits)
    with pytest.raises(QuotaExceeded, match=r"'anna' has 2 unfinished jobs, the limit is 2"):
        store.add(make_job(), idempotency=("key", "print"), limits=limits)
    # What was refused has left nothing behind.
    assert store.submitted("anna", "key") is None
    store.add(make_job(owner="bob"), limits=limits)
    store.apply(first.id, Cancelled(1500.0))
    store.add(make_job(), limits=limits)
    assert store.usage("anna") == (2, 300)


def test_a_quota_of_bytes(store: JobStore):
    limits = Quota(max_jobs=10, max_bytes=300)
    first = store.add(make_job(), limits=limits)
    store.apply(first.id, finished(run(store, first)))
    assert store.usage("anna") == (0, 170)
    store.add(make_job(), limits=limits)
    with pytest.raises(QuotaExceeded, match=r"270 bytes .* 100, .* 300"):
        store.add(make_job(), limits=limits)
    store.forget(first.id)
    store.add(make_job(), limits=limits)
    assert store.usage("nobody") == (0, 0)


def test_the_same_job(store: JobStore):
    key = "k" * 64

    def add(at: float) -> Job:
        return store.add(make_job(dedupe_key=key, created_at=at))

    assert store.find_same("anna", key) is None
    failed, cancelled = run(store, add(1001.0)), add(1002.0)
    store.apply(failed.id, Failed(1, 1600.0, {}))
    store.apply(cancelled.id, Cancelled(1600.0))
    assert store.find_same("anna", key) is None
    queued = add(1003.0)
    assert store.find_same("anna", key) == queued
    running = run(store, add(1000.0))
    assert store.find_same("anna", key) == running
    for at in (998.0, 999.0):
        store.apply((done := add(at)).id, finished(run(store, done)))
    assert store.find_same("anna", key) == store.get(done.id)
    assert store.find_same("bob", key) is None


def test_the_same_job_is_shared(store: JobStore):
    first, second = make_job(), make_job()
    assert store.add(first, shared=True) == first
    assert store.add(second, shared=True, idempotency=("key", "print")) == first
    # The key leads there as well from now on.
    assert store.submitted("anna", "key") == ("print", first)
    assert store.add(make_job(), shared=True, idempotency=("key", "print")) == first
    assert store.usage("anna")[0] == 1
    other = make_job(owner="bob")
    assert store.add(other, shared=True) == other
    assert store.add(second) == second


# Lists


def test_pages_are_newest_first_and_do_not_shift(store: JobStore):
    # Several at the same moment: the order must be whole all the same.
    jobs = [store.add(make_job(created_at=1000.0 + n // 3)) for n in range(10)]
    store.add(make_job(owner="bob"))
    newest_first = sorted(jobs, key=lambda job: (job.created_at, job.id), reverse=True)
    found, cursor = [], None
    for _ in range(4):
        page = store.page("anna", limit=3, cursor=cursor)
        found += page.jobs
        cursor = page.next_cursor
        store.add(make_job(created_at=9999.0))
    assert cursor is None
    assert found == newest_first
    assert len(store.page(None, limit=100).jobs) == 15


def test_a_cursor_that_no_page_gave(store: JobStore):
    contents = ([1.0, "\ud800"], [1.0, "\0"], [math.nan, "a"], [math.inf, "a"])
    for cursor in (
        *("", "x", "ä", "WzEsMl0", "e30", "W251bGwsImEiXQ", "WzFlOTk5OSwgMV0", "=" * 9),
        *(base64.urlsafe_b64encode(json.dumps(one).encode()).decode() for one in contents),
    ):
        with pytest.raises(BadCursor, match="without a cursor"):
            store.page("anna", limit=1, cursor=cursor)


def test_jobs_are_counted_by_state(store: JobStore):
    assert store.counts() == dict.fromkeys(JobState, 0)
    assert store.oldest_queued_at() is None
    jobs = [store.add(make_job(created_at=1000.0 + n)) for n in range(4)]
    run(store, jobs[0])
    store.apply(jobs[3].id, Cancelled(1500.0))
    assert store.counts() == dict.fromkeys(JobState, 0) | {
        JobState.QUEUED: 2,
        JobState.RUNNING: 1,
        JobState.CANCELLED: 1,
    }
    assert store.oldest_queued_at() == 1001.0
    assert [job.id for job in store.in_state(JobState.QUEUED)] == [jobs[1].id, jobs[2].id]


def test_what_has_been_kept_long_enough(store: JobStore):
    jobs = [store.add(make_job()) for _ in range(4)]
    expiry = Expiry(store.engine)
    for job, at in zip(jobs[:3], (3000.0, 2000.0, 4e9), strict=True):  # clocks say what they like
        store.apply(job.id, Cancelled(at))
        now = expiry.passed(10.0)
    assert now == 30.0
    assert expiry.old_jobs(30.0) == [jobs[0].id, jobs[1].id]
    assert expiry.old_jobs(10.0) == []


def test_answers_are_kept_for_a_shorter_time(store: JobStore):
    file = store.add(make_job())
    design = store.add(make_job(kind=JobKind.DESIGN))
    for job in (file, design):
        store.apply(job.id, Cancelled(3000.0))
    expiry = Expiry(store.engine)
    expiry.passed(10.0)
    assert expiry.old_jobs(5.0, 20.0) == [design.id]
    assert expiry.old_jobs(20.0) == sorted([file.id, design.id])


# The queue


def test_short_jobs_have_a_line_of_their_own(store: JobStore):
    files = [store.add(make_job(created_at=1000.0 + n)).id for n in range(2)]
    short = {"kind": JobKind.DESIGN}
    annas = [store.add(make_job(created_at=1010.0 + n, **short)).id for n in range(2)]
    bobs = store.add(make_job(owner="bob", created_at=1020.0, **short)).id
    traced = store.add(make_job(created_at=1030.0, kind=JobKind.TRAJECTORIES)).id
    assert [job.id for job in store.next_queued(9, short=True)] == [annas[0], bobs, annas[1]]
    # What is asked about a job that is done comes before its owner's further files.
    assert [job.id for job in store.next_queued(9)] == [traced, *files]
    # Positions count within a line, and so does what runs.
    assert store.queue_positions()[bobs] == 1
    assert store.claim(files[0], 1500.0, "w") is not None
    assert [job.id for job in store.next_queued(1, short=True)] == [annas[0]]
    assert store.claim(annas[0], 1500.0, "w") is not None
    assert [job.id for job in store.next_queued(9, short=True)] == [bobs, annas[1]]
    assert [job.kind for job in store.page(None, kinds=[JobKind.TRAJECTORIES], limit=9).jobs] == [
        JobKind.TRAJECTORIES
    ]


def test_owners_take_turns(store: JobStore):
    annas = [store.add(make_job(created_at=1000.0 + n)).id for n in range(3)]
    bobs = [store.add(make_job(owner="bob", created_at=1010.0 + n)).id for n in range(2)]
    carls = store.add(make_job(owner="carl", created_at=1020.0)).id
    order = [annas[0], bobs[0], carls, annas[1], bobs[1], annas[2]]
    assert [job.id for job in store.next_queued(9)] == order
    assert [job.id for job in store.next_queued(2)] == order[:2]
    # A running job was its owner's turn.
    assert store.claim(annas[0], 1500.0, "w") is not None
    order = [bobs[0], carls, annas[1], bobs[1], annas[2]]
    assert [job.id for job in store.next_queued(9)] == order
    # What is left out keeps its turn.
    left = [job.id for job in store.next_queued(9, exclude=[bobs[0], carls])]
    assert left == [annas[1], bobs[1], annas[2]]
    positions = {job.id: store.queue_position(job) for job in store.next_queued(9)}
    assert positions == {job_id: n for n, job_id in enumerate(order)}
    assert store.queue_positions() == positions
    running = store.get(annas[0])
    assert running is not None
    assert store.queue_position(running) == 0


waiting = st.lists(
    st.tuples(st.sampled_from("abc"), st.integers(-1, 1), st.integers(0, 5)), max_size=12
)


@many_examples
@given(waiting=waiting, running=st.lists(st.sampled_from("abcd"), max_size=4))
def test_the_order_is_that_of_one_choice_after_the_other(
    store: JobStore, waiting: list[tuple[str, int, int]], running: list[str]
):
    for owner in running:
        run(store, store.add(make_job(owner=owner)))
    jobs = [store.add(make_job(owner=o, priority=p, created_at=float(c))) for o, p, c in waiting]
    turns = {owner: running.count(owner) for owner in "abcd"}
    left, expected = list(jobs), []
    while left:
        heads = {
            owner: min(
                (job for job in left if job.owner == owner),
                key=lambda job: (-job.priority, job.created_at, job.id),
            )
            for owner in {job.owner for job in left}
        }
        chosen = min(
            heads.values(),
            key=lambda job: (-job.priority, turns[job.owner], job.created_at, job.id),
        )
        turns[chosen.owner] += 1
        left.remove(chosen)
        expected.append(chosen.id)
    assert [job.id for job in store.next_queued(99)] == expected
    # Starting some does not change the order of the others.
    for job_id in expected[:3]:
        store.claim(job_id, 1500.0, "w")
    assert [job.id for job in store.next_queued(99)] == expected[3:]
    for job in store.page(None, limit=99).jobs:
        store.forget(job.id)


# Deliveries


def test_who_is_told_of_the_end(store: JobStore):
    all_ = {
        "webhook": ("https://farm.example", "waiting", 2000.0),
        "printer": ("left", "waiting", 2000.0),
    }
    for event, kinds in (
        (None, {"webhook", "printer"}),
        (Failed(1, 2000.0, {}), {"webhook"}),
        (Lost(1, 2000.0, "killed", 1), {"webhook"}),
        (Cancelled(2000.0), {"webhook"}),
        (Lost(1, 2000.0, "killed", 2), set()),
        (Progressed(1, 2000.0, "a", 0.5, None), set()),
    ):
        job = run(store, store.add(make_job(webhook="https://farm.example", printer="left")))
        assert due(store, job) == {}
        assert store.apply(job.id, event or finished(job)) is not None
        assert due(store, job) == {kind: all_[kind] for kind in kinds}
        store.forget(job.id)
        assert due(store, job) == {}


def test_a_job_does_not_end_without_its_deliveries(store: JobStore):
    job = run(store, store.add(make_job(webhook="https://farm.example")))
    with writing(store.engine) as connection:
        connection.execute(text("ALTER TABLE deliveries RENAME TO elsewhere"))
    with pytest.raises(Exception, match="deliveries"):
        store.apply(job.id, finished(job))
    with writing(store.engine) as connection:
        connection.execute(text("ALTER TABLE elsewhere RENAME TO deliveries"))
    assert store.get(job.id) == job
    assert store.apply(job.id, finished(job)) is not None
    assert set(due(store, job)) == {"webhook"}


# Leases


def test_a_lease(store: JobStore):
    assert store.lease("reconciler", "one", 5.0, 1000.0)
    assert not store.lease("reconciler", "two", 5.0, 1004.9)
    assert store.lease("sweep", "two", 5.0, 1004.9)
    assert store.lease("reconciler", "one", 5.0, 1004.9)
    assert not store.lease("reconciler", "two", 5.0, 1009.8)
    assert store.lease("reconciler", "two", 5.0, 1009.9)
    assert not store.lease("reconciler", "one", 5.0, 1010.0)
    store.release("reconciler", "one", 1010.0)
    assert not store.lease("reconciler", "one", 5.0, 1010.0)
    store.release("reconciler", "two", 1010.0)
    assert store.leased_until("reconciler") == 1010.0
    assert store.lease("reconciler", "one", 5.0, 1010.0)


def test_a_lease_of_a_clock_that_was_set_back_since(store: JobStore):
    assert store.lease("reconciler", "one", 5.0, 10_000.0)
    assert not store.lease("reconciler", "two", 5.0, 9990.0)
    assert store.lease("reconciler", "two", 5.0, 6400.0)
    assert not store.lease("reconciler", "three", 5.0, 6401.0)
