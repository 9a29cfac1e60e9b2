"""The states of a job and what may happen to it. Pure: no clock, no files, no database.

::

                claimed                finished
    QUEUED ------------------> RUNNING ---------> DONE
      ^                          |  |
      |   lost, attempts left    |  |  failed, or lost once too often
      +--------------------------+  +-------------------------------> FAILED

A job may be deleted in every state. `attempt` is a fence: what a worker reports counts only for
the attempt it was given.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

__all__ = [
    "Claimed",
    "Event",
    "Failed",
    "Finished",
    "Job",
    "JobState",
    "Lost",
    "Progressed",
    "Stale",
    "advance",
]


class JobState(StrEnum):
    """Where a job stands."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"

    @property
    def is_final(self) -> bool:
        """Whether nothing more will happen."""
        return self in (JobState.DONE, JobState.FAILED)


@dataclass(frozen=True, slots=True)
class Job:
    """One job as the store remembers it.

    Attributes
    ----------
    id : str
    machine : str
        Name of a machine; the document it stood for is kept in the job's folder.
    options : dict
        The fields of `service.pipeline.options.Options`.
    source_name, result_name : str
        File names in the job's folder.
    attempt : int
        How often the job was started; it only grows, so it is the fence for reports.
    losses : int
        How often its worker died with it.
    problem : dict or None
        Why the job failed, as a problem document (RFC 9457).
    created_at, started_at, finished_at : float or None
        Seconds since the epoch.
    """

    id: str
    machine: str
    options: dict[str, Any]
    source_name: str
    result_name: str
    source_bytes: int
    created_at: float
    state: JobState = JobState.QUEUED
    attempt: int = 0
    losses: int = 0
    stage: str = "waiting"
    progress: float = 0.0
    eta_s: float | None = None
    problem: dict[str, Any] | None = None
    started_at: float | None = None
    finished_at: float | None = None


@dataclass(frozen=True, slots=True)
class Claimed:
    """A worker takes the job."""

    at: float


@dataclass(frozen=True, slots=True)
class Progressed:
    """The worker says how far it is."""

    attempt: int
    stage: str
    fraction: float
    eta_s: float | None


@dataclass(frozen=True, slots=True)
class Finished:
    """The result and the report are in their places."""

    attempt: int
    at: float


@dataclass(frozen=True, slots=True)
class Failed:
    """The input cannot be processed, or the road broke."""

    attempt: int
    at: float
    problem: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Lost:
    """The worker died, or the service stopped, in the middle of the job.

    `blame` says whether the job may be the reason: a service that was stopped is not.
    """

    attempt: int
    at: float
    reason: str
    max_attempts: int
    blame: bool = True


Event = Claimed | Progressed | Finished | Failed | Lost


class Stale(Exception):
    """The event belongs to an earlier attempt or to a state that is over; drop it."""


def advance(job: Job, event: Event) -> Job:
    """Return the job after `event`.

    Raises
    ------
    Stale
        If the event does not belong to the job's present attempt and state.
    """
    if isinstance(event, Claimed):
        if job.state is not JobState.QUEUED:
            raise Stale(f"job {job.id} is {job.state}, not queued")
        return replace(
            job,
            state=JobState.RUNNING,
            attempt=job.attempt + 1,
            stage="starting",
            progress=0.0,
            eta_s=None,
            started_at=event.at,
        )
    if job.state is not JobState.RUNNING or job.attempt != event.attempt:
        raise Stale(f"job {job.id} is {job.state} in attempt {job.attempt}")
    match event:
        case Progressed():
            # Progress never runs backwards, whatever the stages think.
            fraction = min(max(event.fraction, job.progress), 1.0)
            return replace(job, stage=event.stage, progress=fraction, eta_s=event.eta_s)
        case Finished():
            return replace(
                job,
                state=JobState.DONE,
                stage="done",
                progress=1.0,
                eta_s=None,
                finished_at=event.at,
            )
        case Failed():
            return _failed(job, event.problem, event.at)
        case Lost():
            if not event.blame:
                return _waiting(job)
            lost = replace(job, losses=job.losses + 1)
            if lost.losses < event.max_attempts:
                return _waiting(lost)
            return _failed(lost, _lost_problem(lost, event), event.at)


def _waiting(job: Job) -> Job:
    return replace(
        job, state=JobState.QUEUED, stage="waiting", progress=0.0, eta_s=None, started_at=None
    )


def _failed(job: Job, problem: dict[str, Any], at: float) -> Job:
    return replace(
        job, state=JobState.FAILED, stage="failed", eta_s=None, problem=problem, finished_at=at
    )


def _lost_problem(job: Job, event: Lost) -> dict[str, Any]:
    tries = "once" if job.losses == 1 else f"{job.losses} times"
    return {
        "type": "about:blank",
        "title": "The worker was lost",
        "status": 500,
        "detail": f"The job took its worker down {tries}: {event.reason}. "
        "Look into the service's log; memory is the usual reason.",
    }
