"""Jobs to begin with."""

from __future__ import annotations

import uuid
from typing import Any

from hypothesis import strategies as st

from service.jobs.state import Cancelled, Claimed, Event, Failed, Finished, Job, Lost, Progressed

__all__ = ["events", "finished", "make_job"]


def make_job(**fields: Any) -> Job:
    """Return a job that nobody has seen yet."""
    given = {
        "id": uuid.uuid4().hex,
        "owner": "anna",
        "machine": "ender3",
        "machine_revision": "0123456789ab",
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


def events() -> st.SearchStrategy[Event]:
    """Return anything that may happen to a job in its first attempts."""
    at, attempt = st.floats(1e3, 1e4), st.integers(0, 4)
    words = st.sampled_from(["reading", "compensating", "measuring"])
    problem = st.just({"status": 422, "detail": "out of range"})
    eta_s = st.none() | st.floats(0, 1e4)
    return st.one_of(
        st.builds(Claimed, at, st.sampled_from(["worker-1", "worker-2"])),
        st.builds(Progressed, attempt, at, words, st.floats(-0.5, 1.5), eta_s),
        st.builds(
            lambda attempt, at: Finished(attempt, at, f"a/{attempt}", 9, 7, "7" * 64, {"x": 1}),
            attempt,
            at,
        ),
        st.builds(Failed, attempt, at, problem),
        st.builds(Lost, attempt, at, words, st.integers(1, 3), st.booleans()),
        st.builds(Cancelled, at),
    )
