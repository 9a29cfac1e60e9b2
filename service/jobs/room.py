"""Room for jobs on the disks: for any to begin, and for those that had none before."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import structlog

from stillpath.service.jobs.state import Job
from stillpath.service.storage import Storage, StorageError
from stillpath.service.storage.disk import Disk, room_again_bytes

__all__ = ["RoomForJobs", "has_room_again"]

_MOST_REMEMBERED = 10_000
_NO_ROOM_S = 30.0
"""Delay before a job whose files had no room is retried: others may need less."""


@dataclass(frozen=True, slots=True)
class _Wait:
    """That a job which had no room in an attempt waits until a time of the monotonic clock."""

    attempt: int
    until_s: float


class RoomForJobs:
    """Says which jobs have room to begin.

    Parameters
    ----------
    is_own_disk : bool
        Workers use `disk`; those on other computers look at theirs themselves.
    """

    def __init__(self, disk: Disk, storage: Storage, *, is_own_disk: bool) -> None:
        self._disk, self._storage, self._is_own_disk = disk, storage, is_own_disk
        self._has_room = True
        self._waits: dict[str, _Wait] = {}
        self._log = structlog.get_logger("reconciler")

    def for_any(self) -> bool:
        """Return whether jobs may begin at all."""
        has_room = not self._is_own_disk or self._disk.lets_jobs_begin
        if has_room != self._has_room:
            self._has_room = has_room
            free_mib = self._disk.free_bytes() >> 20
            if has_room:
                self._log.info("the disk has room again", free_mib=free_mib)
            else:
                self._log.warning("jobs wait for room on the disk", free_mib=free_mib)
        return has_room

    def waiting(self, now_s: float) -> list[str]:
        """Return the ids of jobs that had no room and are not to be tried yet."""
        return [job_id for job_id, wait in self._waits.items() if wait.until_s > now_s]

    def for_retry(self, job: Job, now_s: float) -> bool:
        """Return whether a job whose files had no room may be tried again.

        It waits for a while; where the workers use our disk, also until there is enough room.
        """
        wait = self._waits.get(job.id)
        waited = wait is not None and wait.attempt == job.attempt
        if wait is not None and waited and wait.until_s > now_s:
            return False
        if waited and (not self._is_own_disk or has_room_again(job, self._disk, self._storage)):
            return True
        if len(self._waits) > _MOST_REMEMBERED:
            self._waits.clear()
        self._waits[job.id] = _Wait(job.attempt, now_s + _NO_ROOM_S)
        return False


def has_room_again(job: Job, disk: Disk, storage: Storage) -> bool:
    """Return whether a job that had no room has it now, on this disk and on the storage's."""
    more_bytes = room_again_bytes(job.room_bytes or 0)
    if not disk.has_room_for(more_bytes):
        return False
    with contextlib.suppress(StorageError):  # the worker will notice
        return storage.takes(more_bytes)
    return True
