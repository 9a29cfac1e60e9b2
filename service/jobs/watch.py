"""Watch one attempt from a separate thread: send heartbeats, and end it when necessary.

The pipeline is stopped in its progress callback. If that is not called, the process is ended, and
its supervisor starts another.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import psutil
import structlog

from stillpath.pipeline.progress import Progress, StopWork
from stillpath.service.database.errors import DatabaseAway
from stillpath.service.jobs.problems import TOO_LONG, TOO_MUCH_MEMORY, problem
from stillpath.service.jobs.state import Event, Failed, Job, JobKind, Lost, OutOfRoom
from stillpath.service.jobs.store import JobStore
from stillpath.service.settings import Settings

__all__ = ["STUCK_EXIT_CODE", "AttemptLimits", "Watch", "held_bytes"]

STUCK_EXIT_CODE = 70
_BEAT_S = 0.5
_MIB = 1 << 20
_SHORT_GRACE_S = 1.0
"""Short jobs rarely report progress; restarting the process costs less than waiting."""
_SHORT_REMEDIES = {
    JobKind.IDENTIFICATION: "Send the test as the firmware wrote it, fewer files at once",
    JobKind.DESIGN: "Give the machine fewer members or places",
    JobKind.CONTROLLER: "Give the machine fewer states or plants",
    JobKind.LOOPS: "Ask again",
    JobKind.LIVE: "Give the machine fewer members",
}


@dataclass(frozen=True, slots=True)
class AttemptLimits:
    """Limits of an attempt, and the settings that define them (`service.settings.Settings`)."""

    max_s: float
    max_bytes: int
    cancel_grace_s: float
    seconds_setting: str = "STILLPATH_MAX_JOB_S"
    bytes_setting: str = "STILLPATH_MAX_JOB_BYTES"
    remedy: str = "Cut the print into several files"

    @classmethod
    def of(cls, kind: JobKind, settings: Settings) -> Self:
        """Return the limits of a kind of job."""
        if not kind.is_short:
            return cls(settings.max_job_s, settings.max_job_bytes, settings.cancel_grace_s)
        return cls(
            settings.max_computing_s,
            settings.max_computing_bytes,
            min(settings.cancel_grace_s, _SHORT_GRACE_S),
            "STILLPATH_MAX_COMPUTING_S",
            "STILLPATH_MAX_COMPUTING_BYTES",
            _SHORT_REMEDIES[kind],
        )

    def too_long(self, seconds: float) -> dict[str, object]:
        """Return the problem of a job that took too long."""
        return problem(
            422,
            TOO_LONG,
            f"It was stopped after {seconds:.0f} s; the limit is {self.max_s:g} s "
            f"({self.seconds_setting}). {self.remedy}, or have the limit raised.",
        )

    def too_large(self, what: str) -> dict[str, object]:
        """Return the problem of a job that needs too much memory; `what` happened."""
        return problem(
            422,
            TOO_MUCH_MEMORY,
            f"{what}; the limit is {self.max_bytes // _MIB} MiB ({self.bytes_setting}). "
            f"{self.remedy}, or have the limit raised.",
        )


def held_bytes() -> int:
    """Return how much memory this process holds."""
    return int(psutil.Process().memory_info().rss)


class Watch:
    """Watches one attempt during a `with` block around the work.

    Parameters
    ----------
    interrupted : callable
        Returns why this worker has to give its job back, or None.
    has_room : callable
        Whether the disk has room for more, apart from the database's reserve.
    end : callable
        Ends this process with an exit code.
    no_room : callable
        Returns the job's event if there is no room.

    Attributes
    ----------
    outgrown : bool
        Whether the process is too large to continue after this job.
    """

    def __init__(
        self,
        store: JobStore,
        job: Job,
        limits: AttemptLimits,
        *,
        interrupted: Callable[[], str | None],
        has_room: Callable[[], bool] = lambda: True,
        no_room: Callable[[], Event] | None = None,
        end: Callable[[int], object],
    ) -> None:
        self._store = store
        self._job = job
        self._limits = limits
        self._interrupted = interrupted
        self._has_room = has_room
        self._no_room = no_room or (lambda: OutOfRoom(job.attempt, time.time()))
        self._end = end
        self._began = time.monotonic()
        self._latest = Progress("starting", 0.0, 0.0, 0.0, None)
        self._stop = threading.Event()
        self._over = threading.Event()
        self._verdict: Event | None = None
        self._thread = threading.Thread(target=self._run, name=f"watch-{job.id}", daemon=True)
        # bound_contextvars does not reach into threads
        self._log = structlog.get_logger("watch").bind(job=job.id, attempt=job.attempt)
        self.outgrown = False

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over.set()
        self._thread.join()

    @property
    def verdict(self) -> Event | None:
        """Decision of the watch that is not in the database yet."""
        return self._verdict

    def tell(self, progress: Progress) -> None:
        """Record the pipeline's progress.

        Raises
        ------
        StopWork
            If the attempt has to stop, whatever the reason.
        """
        self._latest = progress
        self.check()

    def check(self) -> None:
        """Raise `StopWork` if the attempt has to stop."""
        if self._stop.is_set():
            raise StopWork

    def pause(self, seconds: float) -> None:
        """Sleep, but not when the attempt has to stop: then raise `StopWork`."""
        self._stop.wait(seconds)
        self.check()

    def _run(self) -> None:
        stopped_at = None
        while not self._over.wait(_BEAT_S):
            try:
                if self._verdict is not None:
                    self._store.apply(self._job.id, self._verdict)
                    self._verdict = None
                elif not self._stop.is_set():
                    self._look()
            except DatabaseAway as error:
                # The work continues: when the database is back, the fencing token decides.
                self._log.warning("database away", error=str(error))
            except Exception:
                self._log.exception("the watch of a job failed")
            if self._stop.is_set():
                stopped_at = stopped_at or time.monotonic()
                if time.monotonic() - stopped_at > self._limits.cancel_grace_s:
                    self._log.error("stuck worker ended", code=STUCK_EXIT_CODE)
                    self._end(STUCK_EXIT_CODE)
                    return

    def _look(self) -> None:
        now, attempt = time.time(), self._job.attempt
        if (reason := self._interrupted()) is not None:
            self._decide(Lost(attempt, now, reason, max_attempts=0, blame=False))
        elif (found := self._limit_reached()) is not None:
            self._decide(Failed(attempt, now, found))
        elif not self._has_room():
            self._decide(self._no_room())
        else:
            at = self._latest
            if not self._store.beat(self._job.id, attempt, now, at.stage, at.fraction, at.eta_s):
                self._log.info("job taken away")
                self._stop.set()

    def _decide(self, verdict: Event) -> None:
        self._verdict = verdict
        self._stop.set()
        self._log.warning("attempt stopped", verdict=type(verdict).__name__)
        self._store.apply(self._job.id, verdict)
        self._verdict = None

    def _limit_reached(self) -> dict[str, object] | None:
        if (seconds := time.monotonic() - self._began) > self._limits.max_s:
            return self._limits.too_long(seconds)
        if (size := held_bytes()) > self._limits.max_bytes:
            self.outgrown = True
            return self._limits.too_large(f"Its process grew to {size // _MIB} MiB")
        return None
