"""One attempt at a job: fetch its input, compute, store its files, and say how it ended.

Each attempt's files have their own prefix, so that attempts never collide, and the row names the
prefix of the valid one.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import shutil
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import structlog

from stillpath.pipeline.progress import StopWork
from stillpath.service.database.errors import DatabaseAway
from stillpath.service.jobs.patience import patiently
from stillpath.service.jobs.problems import (
    input_damaged,
    input_gone,
    never_fits,
    problem_of,
    storage_away,
    storage_never_fits,
)
from stillpath.service.jobs.room import has_room_again
from stillpath.service.jobs.state import Event, Failed, Finished, Job, Lost, OutOfRoom
from stillpath.service.jobs.store import JobStore
from stillpath.service.jobs.task import Runner, Task
from stillpath.service.jobs.watch import AttemptLimits, Watch
from stillpath.service.settings import Settings
from stillpath.service.storage import Storage, StorageError, sha256_of
from stillpath.service.storage.disk import DISK_FULL, Disk, PeakDiskUse, written_bytes

__all__ = ["Attempt", "WorkerContext"]

_DISK_AWAY = tuple(
    getattr(errno, name)
    for name in ("EIO", "EROFS", "ESTALE", "ENODEV", "ENXIO", "ENOTCONN", "ETIMEDOUT", "EHOSTDOWN")
    if hasattr(errno, name)
)
"""Error numbers of a disk that was pulled, broke down, or whose server is away."""
_AGAIN_S = 5.0
"""Delay before a job is given back that nothing can be stored for."""


@dataclass(frozen=True, slots=True)
class WorkerContext:
    """What the attempts of a worker process share.

    Attributes
    ----------
    scratch : Path
        Folder for temporary files.
    interrupted : callable
        Returns why the worker has to give its job back, or None.
    end : callable
        Ends this process with an exit code.
    """

    settings: Settings
    store: JobStore
    storage: Storage
    scratch: Path
    name: str = field(default_factory=lambda: f"{socket.gethostname()}:{os.getpid()}")
    interrupted: Callable[[], str | None] = lambda: None
    end: Callable[[int], object] = os._exit


class Attempt:
    """An attempt at a job that was claimed, in a folder of its own.

    Parameters
    ----------
    job : Job
        As it was claimed.
    """

    def __init__(self, job: Job, context: WorkerContext, limits: AttemptLimits) -> None:
        settings = context.settings
        self._job, self._limits = job, limits
        self._settings, self._store, self._storage = settings, context.store, context.storage
        self._folder = context.scratch / f"{job.id}-{job.attempt}"
        self._disk = Disk(settings.data_dir, settings.disk_reserve_bytes)
        self._written = PeakDiskUse(self._folder)
        self._log = structlog.get_logger("worker")

    def has_room(self) -> bool:
        """Return whether the disk lets it go on; called from time to time, in another thread."""
        self._written.look()
        return self._disk.lets_jobs_go_on

    def no_room(self) -> Event:
        """Return how it ends without disk space, by what it has written."""
        room_bytes = self._written.look()
        if self._disk.fits_ever(room_bytes + self._job.source_bytes):
            return OutOfRoom(self._job.attempt, time.time(), room_bytes)
        return self._failed(never_fits(room_bytes, self._disk.total_bytes()))

    def run(self, runner: Runner, watch: Watch) -> Event | None:
        """Do the work; return how it ended, None if it was stopped from outside.

        A full disk is not a failure: the job waits for room.
        """
        if self._job.room_bytes and not has_room_again(self._job, self._disk, self._storage):
            # Where workers have disks of their own only they know; to compute would be in vain.
            return OutOfRoom(self._job.attempt, time.time())
        try:
            with _new_folder(self._folder):
                try:
                    return self._work(runner, watch)
                except OSError as error:
                    if error.errno not in DISK_FULL:
                        raise
                    self._log.warning("no room for the job", reason=str(error))
                    # Now, while what it has put into the folder still exists.
                    if isinstance(error, StorageError) and self._settings.storage_url is not None:
                        return self._no_room_in_storage()
                    return self.no_room()
        except StopWork:
            return None
        except MemoryError:
            return self._failed(
                self._limits.too_large("The system refused its process more memory")
            )
        except _InputBroken as error:
            return self._failed(error.problem)
        except OSError as error:
            if error.errno in DISK_FULL:
                return OutOfRoom(self._job.attempt, time.time())  # not even for its folder
            self._log_crash()
            if isinstance(error, StorageError) or error.errno in _DISK_AWAY:
                return self._lost_disk(error, watch)
            return self._failed(problem_of(error, self._job.kind))
        except Exception as error:
            found = problem_of(error, self._job.kind)
            if found["status"] >= 500:
                self._log_crash()
            return self._failed(found)

    def tidy(self) -> None:
        """Delete its stored files unless the job's row refers to them.

        The job may have been deleted, cancelled or reassigned meanwhile.
        """
        job = self._job
        with contextlib.suppress(DatabaseAway, StorageError):  # otherwise the sweep deletes them
            row = self._store.get(job.id)
            if row is None:
                self._storage.delete(job.files)
            elif row.output != job.attempt_files:
                self._storage.delete(f"{job.attempt_files}/")

    # The work

    def _work(self, runner: Runner, watch: Watch) -> Finished:
        target, report = self._folder / "result" / self._job.result_name, self._folder / "report"
        target.parent.mkdir()
        with contextlib.ExitStack() as stack:
            task = self._task(target, report, functools.partial(self._fetched, stack, watch))
            summary = runner(task, watch.tell)
        digest, result_bytes = sha256_of(target), target.stat().st_size
        output_bytes = self._store_files(watch)
        return Finished(
            self._job.attempt,
            time.time(),
            self._job.attempt_files,
            output_bytes,
            result_bytes,
            digest,
            summary,
        )

    def _task(self, target: Path, report: Path, fetch: Callable[[str], Path]) -> Task:
        """Fetch the input, and return what is to be computed."""
        job = self._job
        try:
            sources = tuple(fetch(key) for key in job.sources)
        except FileNotFoundError:
            raise _InputBroken(input_gone(job.source_name)) from None
        # What a disk has cut or garbled may still look like G-code: half a print.
        if job.source_sha256 and sha256_of(sources[0]) != job.source_sha256:
            raise _InputBroken(input_damaged(job.source_name))
        try:
            machine = fetch(job.machine_file)
        except FileNotFoundError:
            machine = self._folder / "machine.json"  # does it need one? `Task.pinned` knows
        cache = self._settings.data_dir / "cache"
        cache.mkdir(parents=True, exist_ok=True)
        return Task(
            machine=job.machine,
            machine_revision=job.machine_revision,
            machine_file=machine,
            options=job.options,
            sources=sources,
            target=target,
            report=report,
            cache_dir=cache,
            kind=job.kind,
            attempt=job.attempt,
        )

    def _fetched(self, stack: contextlib.ExitStack, watch: Watch, key: str) -> Path:
        return patiently(
            lambda: stack.enter_context(self._storage.local(key)), StorageError, watch.pause
        )

    def _store_files(self, watch: Watch) -> int:
        """Store what is in the folder; return its size in bytes."""
        files = sorted(path for path in self._folder.rglob("*") if path.is_file())
        output_bytes = sum(path.stat().st_size for path in files)
        for path in files:
            key = f"{self._job.attempt_files}/{path.relative_to(self._folder).as_posix()}"
            watch.check()
            patiently(functools.partial(self._storage.put, key, path), StorageError, watch.pause)
        return output_bytes

    # How it ended

    def _failed(self, problem: dict[str, Any]) -> Failed:
        return Failed(self._job.attempt, time.time(), problem)

    def _lost_disk(self, error: OSError, watch: Watch) -> Lost:
        """Return the event for a disk or storage that is away: another attempt may succeed."""
        answers = self._storage_answers()
        if not answers:
            with contextlib.suppress(StopWork):
                watch.pause(_AGAIN_S)
        return Lost(
            self._job.attempt,
            time.time(),
            str(error),
            self._settings.max_attempts,
            blame=answers,  # while nothing is stored, it waits
            problem=storage_away(error),
        )

    def _storage_answers(self) -> bool:
        with contextlib.suppress(StorageError):
            self._storage.check()
            return True
        return False

    def _no_room_in_storage(self) -> Event:
        """Return the event for a job whose result does not fit into the storage."""
        job = self._job
        needed = written_bytes(self._folder)
        room = None
        with contextlib.suppress(StorageError):
            stored = self._storage.list(f"{job.attempt_files}/")
            needed += sum(stat.size_bytes for stat in stored)
            room = self._storage.room()
        if room is not None and needed + job.source_bytes > room.total_bytes:
            return self._failed(storage_never_fits(needed, room.total_bytes))
        return OutOfRoom(job.attempt, time.time(), needed)

    def _log_crash(self) -> None:
        self._log.exception("job broke", pid=os.getpid())


class _InputBroken(Exception):
    """A job's input is gone from the storage or damaged."""

    def __init__(self, found: dict[str, Any]) -> None:
        super().__init__(found["detail"])
        self.problem = found


@contextlib.contextmanager
def _new_folder(folder: Path) -> Iterator[None]:
    folder.mkdir(parents=True)
    try:
        yield
    finally:
        shutil.rmtree(folder, ignore_errors=True)
