"""Delete what is no longer needed: files without a job, stale attempts, old jobs."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import structlog

from stillpath.service.database.errors import DatabaseAway, DatabaseFull
from stillpath.service.jobs.expiry import Expiry
from stillpath.service.jobs.state import Job, JobState
from stillpath.service.jobs.storage_owner import StorageOwner
from stillpath.service.jobs.store import JobStore
from stillpath.service.settings import Settings
from stillpath.service.storage import Stat, Storage
from stillpath.service.storage.disk import Disk

__all__ = ["Sweep", "sweep_files"]

_JOBS = "jobs/"
_AT_ONCE = 500
"""Ids per database query."""
_DAY_S = 86400.0
_SUBMISSIONS_KEPT_S = _DAY_S
_ANSWERS_KEPT_S = _DAY_S
"""Results of other kinds can be computed again on request."""
_ORPHAN_S = 3600.0
"""Files without a row may belong to an upload, until seen without one for this long."""
_UPLOAD_S = _DAY_S
"""Uploads that have not grown for this long are abandoned; slow senders may pause."""


class Sweep:
    """Repeated sweeps, which track ages themselves instead of trusting file times.

    Parameters
    ----------
    clock : callable
        Monotonic seconds.
    """

    def __init__(
        self,
        settings: Settings,
        store: JobStore,
        storage: Storage,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._settings = settings
        self._store = store
        self._storage = storage
        self._clock = clock
        self._expiry = Expiry(store.engine)
        self._disk = Disk(settings.data_dir, settings.disk_reserve_bytes)
        self._counted_at: float | None = None
        # A folder of data has one service at a time (`service.instance_lock`).
        self._owner = settings.storage_url and StorageOwner(store, storage, settings.data_dir)
        self._orphans: dict[str, float] = {}
        self._uploads: dict[tuple[str, int, float], float] = {}

    def run(self) -> None:
        """Sweep once.

        Raises
        ------
        DatabaseAway, StorageError
        """
        self._sweep_incoming()
        try:
            self._forget_expired()
        except DatabaseAway as error:
            if self._disk.is_full or isinstance(
                error, DatabaseFull
            ):  # then the next time there is room to delete
                self._disk.give_up()
            raise
        self._sweep_orphans()
        self._disk.hold()

    def pause(self) -> None:
        """Note that another process sweeps and counts the time meanwhile."""
        self._counted_at = None

    def _forget_expired(self) -> None:
        """Delete old finished jobs and idempotency keys."""
        at, counted_at = self._clock(), self._counted_at
        now = self._expiry.passed(0.0 if counted_at is None else at - counted_at)
        self._counted_at = at
        cutoff = now - self._settings.keep_days * _DAY_S
        for job_id in self._expiry.old_jobs(cutoff, max(cutoff, now - _ANSWERS_KEPT_S)):
            # The row first, so that no job without files is ever shown.
            if self._store.forget(job_id):
                self._storage.delete(f"{_JOBS}{job_id}/")
        self._expiry.forget_submissions(now - _SUBMISSIONS_KEPT_S)

    def _sweep_orphans(self) -> None:
        now, before = self._clock(), self._orphans
        self._orphans = {}
        is_alone = not self._owner or self._owner.is_alone()

        def is_old(job_id: str) -> bool:
            if not is_alone:
                return False
            self._orphans[job_id] = before.get(job_id, now)
            return now - self._orphans[job_id] > _ORPHAN_S

        sweep_files(self._store, self._storage, is_old=is_old)

    def _sweep_incoming(self) -> None:
        """Delete abandoned uploads, such as those of a killed service."""
        now, before = self._clock(), self._uploads
        self._uploads = {}
        with contextlib.suppress(FileNotFoundError):
            for upload in (self._settings.data_dir / "incoming").iterdir():
                with contextlib.suppress(FileNotFoundError):
                    status = upload.stat()
                    key = (upload.name, status.st_size, status.st_mtime)
                    self._uploads[key] = before.get(key, now)
                    if now - self._uploads[key] > _UPLOAD_S:
                        _delete(upload)


def sweep_files(store: JobStore, storage: Storage, *, is_old: Callable[[str], bool]) -> int:
    """Delete files of deleted jobs and of stale attempts.

    Files are listed before rows are read, so a row is never older than the files compared with it.

    Parameters
    ----------
    is_old : callable
        Whether files of an id without a row are too old to belong to a current upload.

    Returns
    -------
    int
        Number of deleted prefixes.
    """
    found: dict[str, list[Stat]] = defaultdict(list)
    for stat in storage.list(_JOBS):
        found[stat.key.split("/")[1]].append(stat)
    deleted = 0
    ids = sorted(found)
    for start in range(0, len(ids), _AT_ONCE):
        some = ids[start : start + _AT_ONCE]
        jobs = store.many(some)
        for job_id in some:
            job = jobs.get(job_id)
            if job is not None:
                doomed = _dead_attempts(job, found[job_id])
            elif is_old(job_id):
                doomed = {f"{_JOBS}{job_id}/"}
            else:
                doomed = set()
            for prefix in sorted(doomed):
                storage.delete(prefix)
                deleted += 1
    if deleted:
        structlog.get_logger("sweep").info("orphans deleted", prefixes=deleted)
    return deleted


def _delete(path: Path) -> None:
    """Delete an abandoned upload; one that cannot be deleted must not keep the rest."""
    try:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    except FileNotFoundError:
        return  # its sender has ended meanwhile
    except OSError as error:
        log = structlog.get_logger("sweep")
        log.warning("an abandoned upload cannot be deleted", path=str(path), reason=str(error))


def _dead_attempts(job: Job, files: list[Stat]) -> set[str]:
    """Return the prefixes of a job's attempts that will never count.

    An abandoned one may still be writing; the next sweep finds the rest.
    """
    alive = {job.output}
    if job.state is JobState.RUNNING:
        alive.add(job.attempt_files)
    attempts = {
        f"{_JOBS}{job.id}/{part}"
        for part in (stat.key.split("/")[2] for stat in files)
        if part.isdecimal()
    }
    return {f"{prefix}/" for prefix in attempts - alive}
