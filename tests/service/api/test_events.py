"""Progress as server-sent events: one poller, ends with the job, nothing lost by a reconnect."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event
from starlette.testclient import TestClient

from stillpath.service.api.hub import Hub
from stillpath.service.database.engine import open_database
from stillpath.service.jobs.state import Cancelled, Claimed, Progressed
from stillpath.service.jobs.store import JobStore
from stillpath.service.settings import Settings
from tests.service.api.serving import post
from tests.service.database.examples import make_job
from tests.service.test_api import assert_problem, until
from tests.service.test_server import until as waiting


def events(text: str) -> list[dict[str, str]]:
    found = []
    for block in text.split("\n\n"):
        lines = [line for line in block.split("\n") if line and not line.startswith(":")]
        if lines:
            found.append(dict(line.split(": ", 1) for line in lines))
    return found


@contextmanager
def once_watched(client: TestClient, do: Callable[[], Any]) -> Iterator[None]:
    """Do something from elsewhere as soon as somebody watches."""

    def wait() -> None:
        waiting(lambda: client.app.state.hub.watchers)
        do()

    thread = threading.Thread(target=wait)
    thread.start()
    try:
        yield
    finally:
        thread.join()


def test_a_job_is_watched_to_its_end(client: TestClient):
    where = post(client, b"nap 1").headers["location"]
    answer = client.get(f"{where}/events")
    assert answer.headers["content-type"].startswith("text/event-stream")
    retry, *found = events(answer.text)
    assert retry == {"retry": "1000"}
    assert {one["event"] for one in found} == {"job"}
    jobs = [json.loads(one["data"]) for one in found]
    assert jobs[-1] == client.get(where).json()
    assert jobs[-1]["state"] == "done"
    progress = [job["progress"] for job in jobs]
    assert progress == sorted(progress)
    assert len({one["id"] for one in found}) == len(found)
    # Whoever comes late, or again, is told the end all the same.
    for headers in ({}, {"Last-Event-ID": found[-1]["id"]}):
        (_, last) = events(client.get(f"{where}/events", headers=headers).text)
        assert last["id"] == found[-1]["id"]


def test_a_deleted_job_ends_the_stream(client: TestClient):
    where = post(client, b"slow").headers["location"]
    until(client, where, lambda job: job["state"] == "running")
    with once_watched(client, lambda: client.delete(where)):
        assert events(client.get(f"{where}/events").text)[-1]["event"] == "gone"
    assert_problem(client.get(f"{where}/events"), 404)


def test_heartbeats_are_comments(client: TestClient, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("stillpath.service.api.events._HEARTBEAT_S", 0.1)
    where = post(client, b"nap 2").headers["location"]
    text = client.get(f"{where}/events").text
    assert ": still here\n\n" in text
    assert "\r" not in text
    assert {one.get("event", "job") for one in events(text)} == {"job"}


def test_head_does_not_wait(client: TestClient):
    where = post(client, b"G1 X3").headers["location"]
    assert client.head(f"{where}/events").status_code in (200, 405)


class Store:
    """A store with some jobs, that counts what it is asked."""

    def __init__(self, folder: Path) -> None:
        self.engine = open_database(Settings(data_dir=folder))
        self.jobs = JobStore(self.engine)
        self.queries = 0
        event.listen(self.engine, "before_cursor_execute", self._count)

    def _count(self, *_: Any) -> None:
        self.queries += 1


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    made = Store(tmp_path)
    yield made
    made.engine.dispose()


def test_a_thousand_watchers_cost_one_query(store: Store):
    made = [make_job() for _ in range(3)]
    for job in made:
        store.jobs.add(job)
        store.jobs.apply(job.id, Claimed(at=2.0, worker="w"))

    async def watch(hub: Hub, job_id: str) -> list[bytes]:
        return [snapshot.message async for snapshot in hub.watch(job_id)]

    async def main() -> list[list[bytes]]:
        hub = Hub(store.jobs)
        await hub.start()
        try:
            watching = [asyncio.create_task(watch(hub, job.id)) for job in made for _ in range(350)]
            while hub.watchers < len(watching):
                await asyncio.sleep(0.01)
            store.queries = 0
            for fraction in (0.1, 0.2, 0.3):
                await asyncio.sleep(0.6)
                for job in made:
                    told = Progressed(1, 3.0, "compensating", fraction, None)
                    await asyncio.to_thread(store.jobs.apply, job.id, told)
            for job in made:
                await asyncio.to_thread(store.jobs.apply, job.id, Cancelled(4.0))
            found = await asyncio.wait_for(asyncio.gather(*watching), 300)
            assert hub.watchers == 0
            return found
        finally:
            await hub.stop()

    told = asyncio.run(main())
    assert all(b'"cancelled"' in one[-1] for one in told)
    assert all(2 <= len(one) <= 6 for one in told)
    # Twelve changes of two or three statements each, and a few a second: none for a watcher.
    assert store.queries < len(told)


def test_a_slow_watcher_sees_the_newest_state(store: Store):
    job = make_job()
    store.jobs.add(job)
    store.jobs.apply(job.id, Claimed(at=2.0, worker="w"))

    async def main() -> list[Any]:
        hub = Hub(store.jobs)
        await hub.start()
        found: list[Any] = []
        try:
            async for snapshot in hub.watch(job.id):
                found.append(snapshot)
                if len(found) == 1:
                    for n in range(1, 4):
                        told = Progressed(1, 3.0, "compensating", n / 10, None)
                        await asyncio.to_thread(store.jobs.apply, job.id, told)
                        await asyncio.sleep(0.6)
                    await asyncio.to_thread(store.jobs.apply, job.id, Cancelled(4.0))
                    await asyncio.sleep(1.5)
                    hub.nudge()
        finally:
            await hub.stop()
        return found

    first, *_, last = asyncio.run(asyncio.wait_for(main(), 300))
    assert last.is_final
    assert b'"progress":0.3' in last.message
    assert not first.is_final


def test_it_stops_also_while_something_changes(store: Store):
    job = make_job()
    store.jobs.add(job)

    async def main() -> None:
        for pauses in range(20):
            hub = Hub(store.jobs)
            await hub.start()
            watching = asyncio.create_task(anext(hub.watch(job.id)))
            while not hub.watchers:
                await asyncio.sleep(0)
            for _ in range(pauses):
                await asyncio.sleep(0.001)
            hub.nudge()
            await hub.stop()
            watching.cancel()
            await asyncio.wait([watching])

    asyncio.run(asyncio.wait_for(main(), 300))
