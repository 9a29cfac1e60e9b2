"""A database and a folder with jobs that are over, and senders for them."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stillpath.applications.machines.resolve import PinnedMachine
from stillpath.models.store import load_machine
from stillpath.service.database.engine import open_database
from stillpath.service.deliveries.checking import Checker
from stillpath.service.deliveries.printers import load_printers
from stillpath.service.deliveries.rows import Delivery, deliveries_of
from stillpath.service.deliveries.sender import Sender, SendingTimes
from stillpath.service.jobs.state import Claimed, Failed, Finished, Job
from stillpath.service.jobs.store import JobStore
from stillpath.service.settings import Settings
from stillpath.service.storage.factory import open_storage
from tests.service.database.examples import make_job
from tests.service.deliveries.listeners import until

__all__ = ["RESULT", "SECRET", "Place", "open_place"]

SECRET = "a secret that nobody else knows"
RESULT = b"; compensated\n" + b"G1 X10 Y10\n" * 20_000


class Place:
    """What a sender works on."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.engine = open_database(settings)
        self.store = JobStore(self.engine)
        self.storage = open_storage(settings)

    def sender(self, checker: Checker | None = None, **how: Any) -> Sender:
        """Return a sender in a hurry."""
        times = SendingTimes(**{"first_wait_s": 0.05, "poll_s": 0.05} | how)
        printers = load_printers(self.settings.printers)
        return Sender(
            self.engine, self.store, self.storage, self.settings, printers, checker, times
        )

    @contextmanager
    def sending(self, **how: Any) -> Iterator[None]:
        """Let a sender send during the `with` block."""
        sender = self.sender(**how)
        sender.start()
        try:
            yield
        finally:
            sender.stop()

    def finish(self, folder: Path, *, finished_at: float | None = None, **fields: Any) -> Job:
        """Return a job that was added and is done, with its result in the storage."""
        job = make_job(**fields)
        self.store.add(job)
        self.store.apply(job.id, Claimed(time.time(), "worker"))
        output = f"jobs/{job.id}/1"
        file = folder / job.id
        PinnedMachine(machine=load_machine(job.machine)).write(file)
        self.storage.put(job.machine_file, file)
        file.write_bytes(RESULT)
        self.storage.put(f"{output}/result/{job.result_name}", file)
        digest = hashlib.sha256(RESULT).hexdigest()
        size, at = len(RESULT), finished_at or time.time()
        event = Finished(1, at, output, size, size, digest, {"after_um": 1})
        done = self.store.apply(job.id, event)
        assert done is not None
        return done

    def fail(self, **fields: Any) -> Job:
        """Return a job that was added and has failed."""
        job = make_job(**fields)
        self.store.add(job)
        self.store.apply(job.id, Claimed(time.time(), "worker"))
        event = Failed(1, time.time(), {"status": 422, "detail": "line 7 is too large"})
        failed = self.store.apply(job.id, event)
        assert failed is not None
        return failed

    def delivery(self, job: Job, kind: str | None = None) -> Delivery:
        """Return the job's delivery as it stands."""
        [found] = [
            each
            for each in deliveries_of(self.engine, [job.id])[job.id]
            if kind in (None, each.kind)
        ]
        return found

    def settled(self, job: Job, kind: str | None = None) -> Delivery:
        """Return the job's delivery, once nothing more will come of it."""
        until(lambda: self.delivery(job, kind).state in ("done", "failed"))
        return self.delivery(job, kind)


@contextmanager
def open_place(data_dir: Path, **settings: Any) -> Iterator[Place]:
    """Open a place during the `with` block."""
    place = Place(Settings(data_dir=data_dir, webhook_secret=SECRET, **settings))
    try:
        yield place
    finally:
        place.engine.dispose()
