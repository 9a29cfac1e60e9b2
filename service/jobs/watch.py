"""Watches one attempt from a thread of its own: says that it lives, and ends it when it must.

The road learns of it in its progress callback. If it never asks, the process is ended; the one
that looks after the workers starts another.
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

from service.database.engine import DatabaseAway
from service.jobs.problems import problem
from service.jobs.state import Event, Failed, Job, Lost, NoRoom
from service.jobs.store import JobStore
from service.pipeline.progress import Cancelled, Progress

__all__ = ["STUCK_EXIT_CODE", "Limits", "Watch", "too_large"]

STUCK_EXIT_CODE = 70
_BEAT_S = 0.5
_MIB = 1 << 20


@dataclass(frozen=True, slots=True)
class Limits:
    """What an attempt may take; see `service.settings.Settings`."""

    max_job_s: float
    max_job_bytes: int
    cancel_grace_s: float


class Watch:
    """The eye on one attempt, for a `with` block around the work.

    Parameters
    ----------
    store : JobStore
    job : Job
        As it was claimed.
    limits : Limits
    interrupted : callable
        Says why this worker has to give its job back, or None.
    has_room : callable
        Whether the disk has room for more; the rest of it belongs to the database.
    end : callable
        Ends this process with an exit code.

    Attributes
    ----------
    outgrown : bool
        Whether the process is too large to go on after this job.
    """

    def __init__(
        self,
        store: JobStore,
        job: Job,
        limits: Limits,
        *,
        interrupted: Callable[[], str | None],
        has_room: Callable[[], bool] = lambda: True,
        end: Callable[[int], object],
    ) -> None:
        self._store = store
        self._job = job
        self._limits = limits
        self._interrupted = interrupted
        self._has_room = has_room
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
        """What the watch decided on and the database does not know yet."""
        return self._verdict

    def tell(self, progress: Progress) -> None:
        """Take the road's progress.

        Raises
        ------
        Cancelled
            If the attempt has to stop, whatever the reason.
        """
        self._latest = progress
        self.check()

    def check(self) -> None:
        """Raise `Cancelled` if the attempt has to stop."""
        if self._stop.is_set():
            raise Cancelled

    def pause(self, seconds: float) -> None:
        """Sleep, but not when the attempt has to stop: then raise `Cancelled`."""
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
                # The work goes on: when the database is back, the fence tells whose job it is.
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
            self._decide(Lost(attempt, now, reason, 0, blame=False))
        elif (found := self._limit_reached()) is not None:
            self._decide(Failed(attempt, now, found))
        elif not self._has_room():
            self._decide(NoRoom(attempt, now))
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
        if (seconds := time.monotonic() - self._began) > self._limits.max_job_s:
            return problem(
                422,
                "The job takes too long",
                f"It was stopped after {seconds:.0f} s; the limit is "
                f"{self._limits.max_job_s:g} s (STILLPATH_MAX_JOB_S). Cut the print into several "
                "files, or have the limit raised.",
            )
        size = psutil.Process().memory_info().rss
        if size > self._limits.max_job_bytes:
            self.outgrown = True
            return too_large(f"Its process grew to {size // _MIB} MiB", self._limits.max_job_bytes)
        return None


def too_large(what: str, max_job_bytes: int) -> dict[str, object]:
    """Return the problem of a job that needs too much memory; `what` happened."""
    return problem(
        422,
        "The job needs too much memory",
        f"{what}; the limit is {max_job_bytes // _MIB} MiB (STILLPATH_MAX_JOB_BYTES). Cut the "
        "print into several files, or have the limit raised.",
    )
