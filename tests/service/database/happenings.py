"""Anything that may happen to a job."""

from __future__ import annotations

from hypothesis import strategies as st

from stillpath.service.jobs.state import (
    Cancelled,
    Claimed,
    Event,
    Failed,
    Finished,
    Lost,
    Progressed,
)

__all__ = ["events"]


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
