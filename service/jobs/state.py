"""The states of a job and their transitions. Pure: no clock, no files, no database.

::

                claimed                finished
    QUEUED ------------------> RUNNING ---------> DONE
     | ^                       | |  |
     | |  lost, may be retried;| |  |  failed, or lost once too often
     | |  no room on the disk  | |  |
     | +-----------------------+ |  +-------------------------------> FAILED
     |                           |
     +---------------------------+----------------------------------> CANCELLED
                  cancelled

A job may be deleted in every state. `attempt` is a fencing token: a worker's report counts only for
its own attempt, and only while that runs. This is also how a worker learns of a cancellation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

__all__ = [
    "START_WITHIN_S",
    "WAITING_FOR_ROOM",
    "Cancelled",
    "Claimed",
    "Event",
    "Failed",
    "Finished",
    "Job",
    "JobKind",
    "JobState",
    "Lost",
    "OutOfRoom",
    "Progressed",
    "Stale",
    "advance",
]

START_WITHIN_S = 3600.0
"""How long after its job ended, or after jobs could last be done, a print may still start: later
nobody may be there to watch."""
WAITING_FOR_ROOM = "waiting for room on the disk"
"""Stage of a requeued job whose files had no room."""


class JobKind(StrEnum):
    """What is computed."""

    COMPENSATION = "compensation"
    TRAJECTORIES = "trajectories"
    IDENTIFICATION = "identification"
    DESIGN = "design"
    CONTROLLER = "controller"
    LOOPS = "loops"
    LIVE = "live"

    @property
    def is_short(self) -> bool:
        """Whether it is short (minutes, not hours), so that it does not queue behind long jobs."""
        return self not in (JobKind.COMPENSATION, JobKind.TRAJECTORIES)


class JobState(StrEnum):
    """State of a job."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def is_final(self) -> bool:
        """Whether the state is final."""
        return self not in (JobState.QUEUED, JobState.RUNNING)


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One job as stored; the fields are the columns of the table `jobs`.

    Attributes
    ----------
    kind : JobKind
        Compensations have an uploaded file and a report; other kinds only a result.
    owner : str
        Whose job it is.
    batch : str or None
        Label of a group of jobs, chosen by their owner.
    machine, machine_revision : str
        Name and revision of a machine; the document is kept with the job's files.
    options : dict
        The fields of `pipeline.options.Options`; for other kinds, the request.
    dedupe_key : str
        Digest of input, machine, options and version: equal jobs have the same result.
    priority : int
        Higher ones go first.
    source_bytes, source_sha256 : int, str
        Of the upload.
    output : str or None
        Prefix in the storage under which result and report lie; None until they do.
    output_bytes, result_bytes, result_sha256 : int, int, str or None
        Of everything under `output`, and of the result alone.
    summary : dict or None
        The figures that lists show.
    attempt : int
        Number of starts; it only grows, so it serves as fencing token.
    losses : int
        Number of times its worker died.
    worker : str or None
        Who runs it, or ran it last.
    stage, progress, eta_s : str, float, float or None
        Current stage, share done (0 to 1), and estimated remaining time.
    problem : dict or None
        Why the job failed, as a problem document (RFC 9457).
    created_at, started_at, heartbeat_at, finished_at : float or None
        Seconds since the epoch. `heartbeat_at`: when the worker was last heard of.
    room_bytes : int or None
        Disk space that it needs at least, if there was too little before.
    webhook : str or None
        Address that is notified when the job ends.
    printer, print_after : str or None, bool
        Printer that the result is uploaded to, and whether it then starts to print.
    held_back : bool
        Whether it does not start after all: for too long nobody could do the job.
    """

    id: str
    owner: str
    machine: str
    machine_revision: str
    options: dict[str, Any]
    dedupe_key: str
    source_name: str
    source_bytes: int
    source_sha256: str
    result_name: str
    created_at: float
    kind: JobKind = JobKind.COMPENSATION
    batch: str | None = None
    priority: int = 0
    output: str | None = None
    output_bytes: int | None = None
    result_bytes: int | None = None
    result_sha256: str | None = None
    summary: dict[str, Any] | None = None
    state: JobState = JobState.QUEUED
    attempt: int = 0
    losses: int = 0
    worker: str | None = None
    stage: str = "waiting"
    progress: float = 0.0
    eta_s: float | None = None
    problem: dict[str, Any] | None = None
    started_at: float | None = None
    heartbeat_at: float | None = None
    finished_at: float | None = None
    room_bytes: int | None = None
    webhook: str | None = None
    printer: str | None = None
    print_after: bool = False
    held_back: bool = False

    @property
    def sources(self) -> list[str]:
        """Keys of its input in the storage."""
        match self.kind:
            case JobKind.COMPENSATION | JobKind.TRAJECTORIES:
                return [f"{self._origin}/source/{self.source_name}"]
            case JobKind.IDENTIFICATION:
                return [f"{self._origin}/source/{n}" for n in range(len(self.options["files"]))]
            case _:
                return []

    @property
    def machine_file(self) -> str:
        """Key of its machine in the storage, if it has one."""
        return f"{self._origin}/machine.json"

    @property
    def result(self) -> str:
        """Key of its result in the storage, once it is done."""
        return f"{self.output}/result/{self.result_name}"

    @property
    def files(self) -> str:
        """Prefix of all its files in the storage."""
        return f"jobs/{self.id}/"

    @property
    def attempt_files(self) -> str:
        """Prefix of the files of the current or last attempt."""
        return f"jobs/{self.id}/{self.attempt}"

    @property
    def waits_for_room(self) -> bool:
        """Whether it only waits for disk space."""
        return self.state is JobState.QUEUED and self.stage == WAITING_FOR_ROOM

    @property
    def _origin(self) -> str:
        # Trajectories are those of another job.
        return f"jobs/{self.options['of'] if self.kind is JobKind.TRAJECTORIES else self.id}"


@dataclass(frozen=True, slots=True)
class Claimed:
    """A worker takes the job; a print is held back if it waited long for disk space."""

    at: float
    worker: str


@dataclass(frozen=True, slots=True)
class Progressed:
    """The worker reports that it is alive, and its progress."""

    attempt: int
    at: float
    stage: str
    fraction: float
    eta_s: float | None


@dataclass(frozen=True, slots=True)
class Finished:
    """The result and the report are in their places."""

    attempt: int
    at: float
    output: str
    output_bytes: int
    result_bytes: int
    result_sha256: str
    summary: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Failed:
    """The input cannot be processed, a limit was reached, or the pipeline broke."""

    attempt: int
    at: float
    problem: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Lost:
    """The worker died, the service stopped, or the storage failed in the middle of the job.

    `max_attempts` is the number of losses with which the job fails; `blame` says whether the job
    may have killed its worker: only then does the loss count. `problem` is what the job finally
    fails with, if more is known than that its worker is gone.
    """

    attempt: int
    at: float
    reason: str
    max_attempts: int
    blame: bool = True
    problem: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class OutOfRoom:
    """The disk is full, or nearly: the job waits until there is room again.

    `room_bytes` is the least that it needs: what it had written when it was stopped.
    """

    attempt: int
    at: float
    room_bytes: int = 0


@dataclass(frozen=True, slots=True)
class Cancelled:
    """The job was cancelled, in whatever attempt."""

    at: float


Event = Claimed | Progressed | Finished | Failed | Lost | OutOfRoom | Cancelled


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
        return _running(job, event)
    if isinstance(event, Cancelled):
        if job.state.is_final:
            raise Stale(f"job {job.id} is {job.state} already")
        return _over(job, JobState.CANCELLED, event.at)
    if job.state is not JobState.RUNNING or job.attempt != event.attempt:
        raise Stale(f"job {job.id} is {job.state} in attempt {job.attempt}")
    match event:
        case Progressed():
            # Progress never decreases, whatever the stages report.
            fraction = max(min(event.fraction, 1.0), job.progress)
            return replace(
                job,
                stage=event.stage,
                progress=fraction,
                eta_s=event.eta_s,
                heartbeat_at=event.at,
            )
        case Finished():
            return replace(
                _over(job, JobState.DONE, event.at),
                progress=1.0,
                output=event.output,
                output_bytes=event.output_bytes,
                result_bytes=event.result_bytes,
                result_sha256=event.result_sha256,
                summary=event.summary,
            )
        case Failed():
            return _failed(job, event.problem, event.at)
        case OutOfRoom():
            room_bytes = max(job.room_bytes or 0, event.room_bytes)
            return replace(_waiting(job), stage=WAITING_FOR_ROOM, room_bytes=room_bytes)
        case Lost():
            if not event.blame:
                return _waiting(job)
            lost = replace(job, losses=job.losses + 1)
            if lost.losses < event.max_attempts:
                return _waiting(lost)
            return _failed(lost, event.problem or _lost_problem(lost, event), event.at)


def _running(job: Job, event: Claimed) -> Job:
    late = job.waits_for_room and abs(event.at - job.created_at) > START_WITHIN_S
    return replace(
        job,
        held_back=job.held_back or (job.print_after and late),
        state=JobState.RUNNING,
        attempt=job.attempt + 1,
        worker=event.worker,
        stage="starting",
        progress=0.0,
        eta_s=None,
        started_at=event.at,
        heartbeat_at=event.at,
    )


def _waiting(job: Job) -> Job:
    return replace(
        job,
        state=JobState.QUEUED,
        stage="waiting",
        progress=0.0,
        eta_s=None,
        started_at=None,
        heartbeat_at=None,
    )


def _over(job: Job, state: JobState, at: float) -> Job:
    return replace(job, state=state, stage=state.value, eta_s=None, finished_at=at)


def _failed(job: Job, problem: dict[str, Any], at: float) -> Job:
    return replace(_over(job, JobState.FAILED, at), problem=problem)


def _lost_problem(job: Job, event: Lost) -> dict[str, Any]:
    tries = "once" if job.losses == 1 else f"{job.losses} times"
    return {
        "type": "about:blank",
        "title": "The worker was lost",
        "status": 500,
        "detail": f"The job lost its worker {tries}: {event.reason}. Submit it again; if that does "
        "not help, cut the print into several files, or give the computer more memory. The "
        "service's log says more.",
    }
