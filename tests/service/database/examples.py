"""Jobs to begin with."""

from __future__ import annotations

import time
import uuid
from typing import Any

from stillpath.models.store import load_machine
from stillpath.service.jobs.state import Finished, Job
from stillpath.service.jobs.store import JobStore

__all__ = ["finished", "make_job", "take_all"]


def make_job(**fields: Any) -> Job:
    """Return a job that nobody has seen yet."""
    given = {
        "id": uuid.uuid4().hex,
        "owner": "anna",
        "machine": "ender3",
        "machine_revision": load_machine("ender3").revision,
        "options": {"method": "fbf"},
        "dedupe_key": "d" * 64,
        "source_name": "part.gcode",
        "source_bytes": 100,
        "source_sha256": "5" * 64,
        "result_name": "part.stillpath.gcode",
        "created_at": 1000.0,
    }
    return Job(**(given | fields))


def finished(job: Job, at: float = 2000.0) -> Finished:
    """Return the event that ends a running job well."""
    output = f"jobs/{job.id}/{job.attempt}"
    return Finished(job.attempt, at, output, 70, 50, "7" * 64, {"before_um": 9.5})


def take_all(store: JobStore, worker: str) -> list[str]:
    """Claim until nothing waits any more, and return what was claimed."""
    taken = []
    while waiting := store.next_queued(3):
        for job in waiting:
            claimed = store.claim(job.id, time.time(), worker)
            if claimed is not None:
                assert (claimed.worker, claimed.attempt) == (worker, 1)
                taken.append(job.id)
    return taken
