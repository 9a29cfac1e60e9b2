from service.jobs.store import JobStore
from tests.service.database.examples import finished, make_job


def test_smoke(engine):
    store = JobStore(engine)
    job = store.add(make_job(webhook="http://x", printer="p"))
    assert store.get(job.id) == job
    run = store.claim(job.id, 1500.0, "w")
    assert store.beat(job.id, 1, 1501.0, "compensating", 0.5, 3.0)
    assert not store.beat(job.id, 2, 1501.0, "compensating", 0.5, 3.0)
    assert store.apply(job.id, finished(run)).summary == {"before_um": 9.5}
    assert store.find_same("anna", job.dedupe_key).id == job.id
    assert store.lease("a", "x", 5, 0)
    assert not store.lease("a", "y", 5, 1)
    assert store.lease("a", "y", 5, 5)
    print(
        store.usage("anna"),
        store.counts(),
        store.next_queued(5),
        store.page("anna", limit=3),
        store.queue_positions(),
    )
